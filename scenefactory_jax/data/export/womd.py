"""Writes scenes as TFRecords of WOMD's tf.Examples, with paths of the recording car: for Waymax (`include_sdc_paths`) and V-Max.

Features, shapes and padding (-1; 0 for flags) are those of WOMD (waymo.com/open/data/motion/tfexample) and of Waymax's
`get_features_description`; the paths are those that ScenarioMax lists (`roadgraph.route_sets`). The encoding has float32 coordinates, so
scenes far from their origin are moved; it has no links between lanes, limits, lanes of stop signs, cycles of lights beyond the log, and no
other steps than WOMD's: ten before the current one and 80 behind it, 0.1 s apart.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.raw_scene import Polyline, RawScene, SceneError
from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import POLYGONS, ROUTE_SPACING_M
from scenefactory_jax.data.formats import polylines, tfrecord, womd_schema
from scenefactory_jax.data.formats.scene_parts import WOMD_TYPES
from scenefactory_jax.data.formats.womd_example import ELEMENTS, PERIODS
from scenefactory_jax.roadgraph import lane_graph, route_sets

FILE = "scenes.tfrecord"
STEP_S, STEPS = 0.1, dict(zip(PERIODS, (10, 1, 80), strict=True))
UNEVEN = 0.05  # fraction of a step by which a log's steps may be off
FAR_M = 20_000.0  # float32 has steps of 2 mm there
MAX_ID = 2**24  # ids of objects are float32
PADDING = -1


@dataclass(frozen=True)
class Shapes:
    """Sizes of the features; what goes beyond them is left out, farthest from the recording car first."""

    objects: Count
    map_points: Count
    map_spacing_m: Positive  # maximum between the points of a line
    lights: Count
    paths: Count
    path_points: Count  # one a metre


def write_all(scenes: Iterable[RawScene], folder: Path | str, refused: list[str], shapes: Shapes) -> int:
    """Writes one TFRecord file with a record for each scene, and adds a line to `refused` for each that is left out; returns their number.

    Raises:
        SceneError: the folder or the file cannot be written.
    """
    path, written = Path(folder) / FILE, 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as part, part.open("wb") as file:
            for raw in scenes:
                try:
                    data = encode(raw, shapes)
                except SceneError as error:
                    refused.append(f"{raw.name}: {error}")
                    continue
                head = tfrecord.HEADER.pack(len(data), tfrecord.mask(len(data).to_bytes(8, "little")))
                file.write(head + data + tfrecord.FOOTER.pack(tfrecord.mask(data)))
                written += 1
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error
    return written


def encode(raw: RawScene, shapes: Shapes) -> bytes:
    """The tf.Example of a scene.

    Raises:
        SceneError: no recording car at the current step, other steps than WOMD's, or a map element that WOMD does not have.
    """
    message = womd_schema.Example()
    for key, value in make_features(raw, shapes).items():
        entry = message.features.feature.add(key=key.encode())
        if isinstance(value, bytes):
            entry.value.bytes_list.value.append(value)
        elif value.dtype == np.int64:
            entry.value.int64_list.value.extend(value.ravel().tolist())
        else:
            entry.value.float_list.value.extend(value.astype(np.float32).ravel().tolist())
    return message.SerializeToString()


def make_features(raw: RawScene, shapes: Shapes) -> dict[str, Any]:
    """The features of a scene by their keys: bytes, or arrays of integers and floats in Waymax's shapes."""
    where = f"{raw.source}: scene {raw.name!r}"
    if raw.sdc is None or not raw.tracks[raw.sdc].valid[raw.current]:
        raise SceneError(f"{where}: expected a recording car that is present at the current step, which Waymax drives, got none")
    if len(raw.times) > 1 and (bad := np.abs(np.diff(raw.times) / STEP_S - 1)).max() > UNEVEN:
        raise SceneError(f"{where}: times: expected steps of {STEP_S:g} s, got {np.diff(raw.times)[np.argmax(bad)]:g} s")
    if strange := [line for line in raw.roads if line.kind not in ELEMENTS]:
        raise SceneError(f"{where}: road {strange[0].id}: WOMD has no map element {strange[0].kind}; expected 0 to 20 without 4")
    car = raw.tracks[raw.sdc].xyz[raw.current]
    largest = max((np.abs(line.xyz).max(initial=0.0) for line in raw.roads), default=0.0)
    shift = np.array([*np.round(car[:2], -3), 0.0]) * (largest > FAR_M)
    number = str(raw.metadata.get("scenario_id") or raw.name)
    return {
        "scenario/id": number.encode(),
        **_make_states(raw, shapes.objects, shift),
        **_make_lights(raw, shapes.lights, shift),
        **_make_map(raw.roads, shapes, car, shift),
        **_make_paths(raw, shapes, shift),
    }


def _pad(table: np.ndarray, rows: int, padding: int = PADDING) -> np.ndarray:
    """A table with rows of the padding behind its own; flags have zeros there."""
    return np.concatenate([table, np.full((rows - len(table), *table.shape[1:]), padding, table.dtype)])


def _window(raw: RawScene) -> tuple[Int[np.ndarray, " 91"], np.ndarray]:
    """WOMD's steps as steps of the log, and which of them the log has."""
    steps = raw.current + np.arange(-STEPS["past"], STEPS["future"] + 1)
    inside = (steps >= 0) & (steps < len(raw.times))
    return np.where(inside, steps, raw.current), inside


def _split(name: str, table: np.ndarray, axis: int) -> dict[str, np.ndarray]:
    """A column over all steps as one a period: `PREFIX/{past,current,future}/KEY`."""
    prefix, _, key = name.partition("/")
    parts = np.split(table, np.cumsum([*STEPS.values()])[:-1], axis=axis)
    return {f"{prefix}/{period}/{key}": part for period, part in zip(PERIODS, parts, strict=True)}


def _choose_tracks(raw: RawScene, count: int) -> list[int]:
    """The tracks that are written: the recording car, those to predict, and the nearest to the car at any step, in the log's order."""
    assert raw.sdc is not None
    car, predicted = raw.tracks[raw.sdc], set(raw.metadata.get("tracks_to_predict", ()))

    def rank(index: int) -> tuple[bool, bool, float]:
        track = raw.tracks[index]
        both = track.valid & car.valid
        near = np.linalg.norm(track.xyz[both, :2] - car.xyz[both, :2], axis=1).min(initial=np.inf)
        return index != raw.sdc, track.id not in predicted, float(near)

    return sorted(sorted(range(len(raw.tracks)), key=rank)[:count])


def _make_states(raw: RawScene, count: int, shift: Float[np.ndarray, "3"]) -> dict[str, np.ndarray]:
    chosen, (steps, inside) = _choose_tracks(raw, count), _window(raw)
    tracks = [raw.tracks[index] for index in chosen]
    ids = np.array([track.id for track in tracks])
    if len(set(ids.tolist())) < len(ids) or ids.min() < 0 or ids.max() > MAX_ID:
        ids = np.array(chosen)
    valid = np.stack([track.valid[steps] for track in tracks]) & inside
    xyz, velocity = (np.stack([getattr(track, name)[steps] for track in tracks]) for name in ("xyz", "velocity"))
    xyz = xyz - shift
    sizes = np.broadcast_to(np.array([track.size for track in tracks])[:, None], xyz.shape)
    columns = {name: xyz[..., axis] for axis, name in enumerate("xyz")}
    columns |= {name: sizes[..., axis] for axis, name in enumerate(("length", "width", "height"))}
    columns |= {"velocity_x": velocity[..., 0], "velocity_y": velocity[..., 1], "speed": np.linalg.norm(velocity, axis=-1)}
    columns |= {"vel_yaw": np.arctan2(velocity[..., 1], velocity[..., 0]), "bbox_yaw": np.stack([t.yaw[steps] for t in tracks])}
    features = {}
    for name, table in columns.items():
        features |= _split(f"state/{name}", _pad(np.where(valid, table, PADDING), count), 1)
    stamps = np.where(inside, np.round(1e6 * raw.times[steps]), PADDING) * np.ones((len(tracks), 1))  # also where no object is valid
    features |= _split("state/timestamp_micros", _pad(stamps.astype(np.int64), count), 1)
    features |= _split("state/valid", _pad(valid.astype(np.int64), count, 0), 1)
    kinds = np.array([WOMD_TYPES.index(track.kind, 1) for track in tracks])
    features |= {"state/id": _pad(ids.astype(np.float64), count), "state/type": _pad(kinds.astype(np.float64), count)}
    features["state/is_sdc"] = _pad(np.array([int(index == raw.sdc) for index in chosen]), count, 0)
    for key in ("tracks_to_predict", "objects_of_interest"):
        named = set(raw.metadata.get(key, ()))
        features[f"state/{key}"] = _pad(np.array([int(track.id in named) for track in tracks]), count, 0)
    return features


def _make_lights(raw: RawScene, count: int, shift: Float[np.ndarray, "3"]) -> dict[str, np.ndarray]:
    """The lights nearest to the recording car."""
    assert raw.sdc is not None
    lanes, (steps, inside) = {line.id: line for line in raw.roads}, _window(raw)
    placed = [(light, light.stop if light.stop is not None else lanes[light.lane].xyz[0]) for light in raw.lights if light.lane in lanes]
    car = raw.tracks[raw.sdc].xyz[raw.current]
    placed = sorted(placed, key=lambda entry: float(np.linalg.norm(entry[1][:2] - car[:2])))[:count]
    valid = np.array([light.valid[steps] & inside for light, _ in placed], bool).reshape(len(placed), len(steps))
    columns = {axis: [np.full(len(steps), stop[place] - shift[place]) for _, stop in placed] for place, axis in enumerate("xyz")}
    numbers = {"id": [np.full(len(steps), light.lane) for light, _ in placed], "state": [light.state[steps] for light, _ in placed]}
    features = {}
    for kind, tables in ((np.float64, columns), (np.int64, numbers | {"valid": list(valid)})):
        for name, rows in tables.items():
            padding = 0 if name == "valid" else PADDING
            table = np.where(valid, np.array(rows, kind).reshape(valid.shape), padding).astype(kind)
            features |= _split(f"traffic_light_state/{name}", _pad(table, count, padding).T, 0)
    stamps = np.where(inside, np.round(1e6 * raw.times[steps]), PADDING).astype(np.int64)
    return features | _split("traffic_light_state/timestamp_micros", stamps, 0)


def _make_map(
    roads: Sequence[Polyline], shapes: Shapes, car: Float[np.ndarray, "3"], shift: Float[np.ndarray, "3"]
) -> Mapping[str, np.ndarray]:
    """The points of all lines, with the direction to the next one; of too many those nearest to the recording car."""
    lines = [line.xyz if line.kind in POLYGONS else polylines.densify(line.xyz, shapes.map_spacing_m) for line in roads]
    steps = [np.diff(xyz, axis=0, append=2 * xyz[-1:] - xyz[-2:-1]) if len(xyz) > 1 else np.zeros_like(xyz) for xyz in lines]
    xyz, step = (np.concatenate([*parts, np.zeros((0, 3))]) for parts in (lines, steps))
    direction = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    sizes = [len(line) for line in lines]
    kinds, ids = (np.repeat(np.array([getattr(line, name) for line in roads], np.int64), sizes)[:, None] for name in ("kind", "id"))
    near = np.sort(np.argsort(np.linalg.norm(xyz[:, :2] - car[:2], axis=1), kind="stable")[: shapes.map_points])
    columns = {"xyz": xyz[near] - shift, "dir": direction[near], "type": kinds[near], "id": ids[near]}
    features = {f"roadgraph_samples/{name}": _pad(table, shapes.map_points) for name, table in columns.items()}
    features["roadgraph_samples/valid"] = (np.arange(shapes.map_points) < len(near)).astype(np.int64)[:, None]
    return features


def _make_paths(raw: RawScene, shapes: Shapes, shift: Float[np.ndarray, "3"]) -> dict[str, np.ndarray]:
    """The paths that the recording car may have meant, the nearest to its log first; one on its log itself if it left all lanes."""
    assert raw.sdc is not None
    graph, track = lane_graph.make(raw.roads), raw.tracks[raw.sdc]
    size = (shapes.paths, shapes.path_points)
    xyz, valid, ids, arcs = (np.full((*size, *more), PADDING, kind) for more, kind in (((3,), float), ((), int), ((), int), ((), float)))
    valid, on_route = valid * 0, np.zeros((shapes.paths, 1), np.int64)
    path = track.xyz[track.valid, :2]
    if len(graph.id) and np.linalg.norm(path - path[0], axis=1).max() >= ROUTE_SPACING_M:
        ground = KDTree(graph.xyz[:, :2])
        found = route_sets.find_track_routes(
            route_sets.make_lane_map(graph), path, float(track.yaw[track.valid][0]), count=shapes.paths,
            max_length_m=ROUTE_SPACING_M * (shapes.path_points - 1), max_distance_m=np.inf,
        )  # fmt: skip
        for row, route in enumerate(found):
            points = route.xy[: shapes.path_points]
            count = len(points)
            xyz[row, :count] = np.column_stack([points, graph.xyz[ground.query(points)[1], 2]]) - shift
            valid[row, :count], on_route[row] = 1, int(route.on_route)
            ids[row, :count] = np.where(route.lane[:count] >= 0, graph.id[route.lane[:count]], PADDING)
            arcs[row, :count] = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    names = {"xyz": xyz, "valid": valid, "id": ids, "arc_length": arcs, "on_route": on_route}
    return {f"path_samples/{name}": table for name, table in names.items()}
