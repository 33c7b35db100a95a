"""ScenarioNet's and MetaDrive's scenario pickles (https://scenarionet.readthedocs.io, "Scenario Description").

`{id, version, length, metadata{ts, dataset, sdc_id, ...}, tracks{}, dynamic_map_states{}, map_features{}}`, one scenario a file, converted
from WOMD, nuScenes, nuPlan, Argoverse 2 or MetaDrive's own maps; coordinates are right-handed, boxes are given by their centres. Layouts
before today's are read too (`scenarionet_layouts`).

Four things that the converters do and this reader undoes: nuScenes' lanes are poses, their third column a heading and no height; the
recording car of nuScenes has its length and width exchanged; the outline of the drivable area comes as white lines (`boundary_7`);
and MetaDrive's own maps have solid lines for road edges (`metadrive_map`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, Light, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import (
    CROSSWALK,
    DRIVEWAY,
    EDGE_BOUNDARY,
    EDGE_MEDIAN,
    EDGES,
    LANE_BIKE,
    LANE_FREEWAY,
    LANE_STREET,
    LINES,
    POLYGONS,
    ROAD_USERS,
    SPEED_BUMP,
    STOP_SIGN,
)
from scenefactory_jax.data.formats import integer_ids, json_documents, metadrive_map, polylines, safe_pickle, scenarionet_legacy

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"  # beside the scenarios of a database
LANE_UNKNOWN, LINE_UNKNOWN, EDGE_UNKNOWN = 0, 5, 14  # map elements of WOMD that say no more
ELEMENTS = {  # MetaDriveType -> WOMD map element
    "LANE_UNKNOWN": LANE_UNKNOWN, "LANE_FREEWAY": LANE_FREEWAY, "LANE_SURFACE_STREET": LANE_STREET, "LANE_BIKE_LANE": LANE_BIKE,
    "UNKNOWN_LINE": LINE_UNKNOWN, "ROAD_LINE_BROKEN_SINGLE_WHITE": 6, "ROAD_LINE_SOLID_SINGLE_WHITE": 7,
    "ROAD_LINE_SOLID_DOUBLE_WHITE": 8, "ROAD_LINE_BROKEN_SINGLE_YELLOW": 9, "ROAD_LINE_BROKEN_DOUBLE_YELLOW": 10,
    "ROAD_LINE_SOLID_SINGLE_YELLOW": 11, "ROAD_LINE_SOLID_DOUBLE_YELLOW": 12, "ROAD_LINE_PASSING_DOUBLE_YELLOW": 13,
    "UNKNOWN": EDGE_UNKNOWN, "ROAD_EDGE_BOUNDARY": EDGE_BOUNDARY, "ROAD_EDGE_MEDIAN": EDGE_MEDIAN,
    "STOP_SIGN": STOP_SIGN, "CROSSWALK": CROSSWALK, "SPEED_BUMP": SPEED_BUMP, "DRIVEWAY": DRIVEWAY,
}  # fmt: skip
OTHER_NAMES = {"LANE_SURFACE_UNSTRUCTURE": LANE_STREET, "CROSS_WALK": CROSSWALK, "ROAD_LINE_DOUBLE_WHITE": 8}  # nuPlan's; older ones
LANES = (LANE_UNKNOWN, LANE_FREEWAY, LANE_STREET, LANE_BIKE)
SIGNALS = {f"LANE_STATE_{name.upper()}": index for index, name in enumerate(LIGHT_STATES)} | {
    f"TRAFFIC_LIGHT_{colour}": LIGHT_STATES.index(name)  # nuPlan's and MetaDrive's own
    for colour, name in (("UNKNOWN", "unknown"), ("RED", "stop"), ("YELLOW", "caution"), ("GREEN", "go"))
}
DATASETS = {"waymo": "WOMD", "nuscenes": "nuScenes", "nuplan": "nuPlan", "av2": "argoverse2"}
UNITS = {"speed_limit_mph": 1609.344 / 3600, "speed_limit_kmh": 1 / 3.6}  # in m/s
SPEED_LIMIT_MOST = 160 / 3.6  # m/s, of any country's signs: that of the United Arab Emirates
METADRIVE = "metadrive"  # `dataset` of its own maps
SOLID = (LINE_UNKNOWN, 7, 8, 11, 12)  # lines that may not be crossed, and those of no known type
KEPT = ("scenario_id", "source_file", "map", "date")  # of the file's metadata, where they are texts


def read(
    path: Path, *, current: int, outlines_are_edges: bool, point_spacing_m: float, file_limit_mb: int, opcode_limit: int
) -> Iterator[RawScene]:
    """The one scene of a file. Ids that are no numbers are counted on after the largest; `metadata["tokens"]` keeps what they stood for.

    Args:
        path: a pickle, read by `pickles.load`.
        current: the step at which the simulation takes over, where the file names none (all but WOMD's).
        outlines_are_edges: whether lines named `boundary_N`, the drivable area's outline in nuScenes and nuPlan, become road edges, and
            the rim of MetaDrive's own maps, of which `metadata["edges_from_lines"]` counts the lines.
        point_spacing_m: between the points of a line, at most; WOMD's are dense as they are, the others may have corners only.
        file_limit_mb: larger files are refused.
        opcode_limit: longer pickles are refused.

    Raises:
        FormatMismatch: no pickle, or no scenario in it.
        Companion: a database's summary or mapping, told by its name: those of large databases are larger than any scenario.
        SceneError: more than data in it, or a value that is missing, of a wrong type or not finite, naming its key.
    """
    if Path(path).name in (SUMMARY, MAPPING):
        raise Companion(f"{path}: ScenarioNet's {'summary' if Path(path).name == SUMMARY else 'mapping'} of a database")
    document = safe_pickle.load(path, file_limit_mb=file_limit_mb, opcode_limit=opcode_limit)
    if not isinstance(document, dict):
        raise OtherContent(f"{path}: no ScenarioNet pickle: it holds no dict but {type(document).__name__}")
    if "tracks" not in document or not {"map_features", "map"} & set(document):
        raise OtherContent(f"{path}: no ScenarioNet pickle: no 'tracks' and map, but {', '.join(map(str, document)) or 'nothing'}")
    where = f"{path}: "
    document = scenarionet_legacy.convert_legacy(document, where)
    metadata, features = document["metadata"], document["map_features"]
    ids = {"tracks": integer_ids.assign_ids(document["tracks"]), "features": integer_ids.assign_ids(features)}
    times = _times(metadata, where)
    current = json_documents.get({"current_time_index": current} | metadata, "current_time_index", int, f"{where}metadata")
    if not 0 <= current < len(times):
        raise SceneError(f"{path}: {len(times)} steps, so no step {current}; set formats.scenarionet.current to a step of this log")
    dataset = metadata["dataset"] if isinstance(metadata.get("dataset"), str) else "unknown"
    tracks = [_track(track, ids["tracks"][str(key)], len(times), f"{where}tracks[{key!r}]") for key, track in document["tracks"].items()]
    sdc = _sdc(metadata, document["tracks"], where)
    if sdc is not None and dataset == "nuscenes":
        tracks[sdc] = _turned(tracks[sdc])
    kinds = {key: _kind(key, record, outlines_are_edges, f"{where}map_features[{key!r}]") for key, record in features.items()}
    lights = _lights(document["dynamic_map_states"], ids["features"], len(times), f"{where}dynamic_map_states")
    roads = [
        _polyline(record, ids["features"][str(key)], kind, ids["features"], dataset == "nuscenes", f"{where}map_features[{key!r}]")
        for (key, record), kind in zip(features.items(), kinds.values(), strict=True)
        if kind is not None
    ]
    rims = _find_rims(roads, features, f"{where}map_features") if outlines_are_edges and dataset == METADRIVE else []
    roads = [replace(line, kind=EDGE_BOUNDARY) if place in rims else line for place, line in enumerate(roads)]
    if dataset != "waymo":
        roads = [line if line.kind in POLYGONS else _densify(line, point_spacing_m) for line in roads]
    left_out = Counter(record["type"] for key, record in features.items() if kinds[key] is None)
    left_out.update("TRAFFIC_LIGHT" for light in lights if light is None)
    yield RawScene(
        name=document["id"] if isinstance(document.get("id"), str) and document["id"] else Path(path).stem,
        source=str(path),
        roads=tuple(roads),
        tracks=tuple(tracks),
        times=times,
        current=current,
        sdc=sdc,
        lights=tuple(light for light in lights if light is not None),
        metadata=_metadata(document, ids, where)
        | {"dataset": DATASETS.get(dataset, dataset), "left_out": dict(left_out)}
        | ({"edges_from_lines": len(rims)} if rims else {}),
    )


def _densify(line: Polyline, spacing_m: float) -> Polyline:
    return replace(line, xyz=polylines.densify(line.xyz, spacing_m)) if len(line.xyz) else line


def _find_rims(roads: list[Polyline], features: Mapping[Any, Any], where: str) -> list[int]:
    """Places in `roads` of the solid or unknown lines that are the rim of a MetaDrive map; none if it has edges."""
    if any(line.kind in EDGES for line in roads):
        return []
    shaped = {key: record["polygon"] for key, record in features.items() if "polygon" in record and str(record["type"]).startswith("LANE_")}
    lanes = [_points(polygon, f"{where}[{key!r}].polygon") for key, polygon in shaped.items()]
    for lane in lanes:
        json_documents.check_finite(lane, f"{where}: polygon")
    solid = [place for place, line in enumerate(roads) if line.kind in SOLID and len(line.xyz) > 1]
    rims = metadrive_map.find_rims([roads[place].xyz for place in solid], [lane[:, :2] for lane in lanes])
    return [place for place, rim in zip(solid, rims, strict=True) if rim]


def _times(metadata: Mapping[str, Any], where: str) -> Float[np.ndarray, " L"]:
    """The steps' times."""
    times = safe_pickle.numeric(_value(metadata, "ts", f"{where}metadata"), f"{where}metadata.ts")
    if times.ndim != 1 or not len(times):
        raise SceneError(f"{where}metadata.ts: an array of the shape {times.shape}; there must be a time for each step")
    json_documents.check_finite(times, f"{where}metadata.ts")
    return times


def _sdc(metadata: Mapping[str, Any], tracks: Mapping[Any, Any], where: str) -> int | None:
    """Index of the recording car's track."""
    key = metadata.get("sdc_id")
    if key is None:
        return None
    keys = [str(track) for track in tracks]
    if str(key) not in keys:
        raise SceneError(f"{where}metadata.sdc_id: {key!r} is none of the {len(keys)} tracks")
    return keys.index(str(key))


def _value(record: Mapping[str, Any], key: str, where: str) -> Any:
    """`record[key]`, whatever its type."""
    if key not in record:
        raise SceneError(f"{where}.{key}: missing; there are: {', '.join(map(str, record)) or 'none'}")
    return record[key]


def _points(value: Any, where: str) -> Float[np.ndarray, "N 3"]:
    """Points with or without a height."""
    table = safe_pickle.table(value, where, columns=(2, 3))
    return np.pad(table, ((0, 0), (0, 3 - table.shape[1])))


def _point(value: Any, where: str) -> Float[np.ndarray, "3"]:
    """One point."""
    points = _points([value], where)
    if len(points) != 1:
        raise SceneError(f"{where}: no point; valid: two or three numbers")
    json_documents.check_finite(points, where)
    return points[0]


def _track(track: Mapping[str, Any], identity: int, steps: int, where: str) -> Track:
    """One object; its size is the one at its last valid step."""
    state = track["state"]
    column = lambda key: safe_pickle.column(_value(state, key, where), f"{where}.state.{key}", length=steps)  # noqa: E731
    valid, yaw = column("valid") != 0, column("heading")
    xyz, velocity = (_points(_value(state, key, where), f"{where}.state.{key}") for key in ("position", "velocity"))
    for name, table in (("position", xyz), ("velocity", velocity), ("heading", yaw)):
        if len(table) != steps:
            raise SceneError(f"{where}.state.{name}: {len(table)} rows; there must be {steps}, one for each step")
        json_documents.check_finite(table, f"{where}.state.{name}", rows=valid)
    last = np.flatnonzero(valid)[-1] if valid.any() else -1
    length, width, height = (float(column(key)[last]) for key in ("length", "width", "height"))
    kind = json_documents.get(track, "type", str, where).lower()  # pyright: ignore[reportArgumentType]
    mask = valid[:, None]
    return Track(
        id=identity,
        kind=kind if kind in ROAD_USERS else "other",  # pyright: ignore[reportArgumentType]
        size=(length, width, height),
        xyz=np.where(mask, xyz, 0.0),
        yaw=np.where(valid, wrap_angles(yaw), 0.0),
        velocity=np.where(mask, velocity[:, :2], 0.0),
        valid=valid,
    )


def _turned(track: Track) -> Track:
    """nuScenes' recording car with the longer side as its length (MetaDrive repairs it in the same way)."""
    length, width, height = track.size
    return replace(track, size=(max(length, width), min(length, width), height))


def _kind(key: Any, feature: Any, outlines_are_edges: bool, where: str) -> int | None:
    """The map element of a feature; None: WOMD has none for it, such as sidewalks and guardrails."""
    name = json_documents.get(json_documents.expect(feature, dict, where), "type", str, where)
    kind = ELEMENTS.get(name, OTHER_NAMES.get(name))
    if name == "UNKNOWN" and "entry_lanes" in feature:  # a lane's type in older layouts
        return LANE_UNKNOWN
    if outlines_are_edges and kind in LINES and str(key).startswith("boundary_"):
        return EDGE_BOUNDARY
    return kind


def _polyline(feature: Mapping[str, Any], identity: int, kind: int, ids: Mapping[str, int], poses: bool, where: str) -> Polyline:
    """One feature of the map: a line, the outline of a polygon, or a stop sign's point."""
    shape = next((key for key in ("polyline", "polygon", "position") if key in feature), "polyline")
    table = _value(feature, shape, where)
    xyz = _point(table, f"{where}.{shape}")[None] if shape == "position" else _points(table, f"{where}.{shape}")
    json_documents.check_finite(xyz, f"{where}.{shape}")
    if kind not in LANES:
        return Polyline(kind=kind, xyz=xyz, id=identity)
    lanes = lambda key: _lanes(feature.get(key), ids, f"{where}.{key}")  # noqa: E731
    return Polyline(
        kind=kind,
        xyz=xyz * (1.0, 1.0, 0.0) if poses else xyz,
        id=identity,
        entry=lanes("entry_lanes"),
        exit=lanes("exit_lanes"),
        left=lanes("left_neighbor"),
        right=lanes("right_neighbor"),
        speed_limit=_speed_limit(feature, where),
    )


def _lanes(entries: Any, ids: Mapping[str, int], where: str) -> tuple[int, ...]:
    """Ids of other lanes, listed as such or as records with a `feature_id`; each once."""
    entries = entries.tolist() if isinstance(entries, np.ndarray) else [] if entries is None else entries
    keys = [
        _value(entry, "feature_id", where) if isinstance(entry, dict) else entry for entry in json_documents.expect(entries, list, where)
    ]
    found = (integer_ids.look_up_id(key, ids) for key in keys)
    return tuple(dict.fromkeys(lane for lane in found if lane is not None))


def _speed_limit(feature: Mapping[str, Any], where: str) -> float | None:
    """In m/s; where there is none, WOMD's converter writes 0 and MetaDrive 1,000 km/h."""
    for key, unit in UNITS.items():
        if feature.get(key) is not None:
            limit = json_documents.expect(feature[key], float, f"{where}.{key}") * unit
            return limit if 0 < limit <= SPEED_LIMIT_MOST else None
    return None


def _lights(records: Mapping[Any, Any], ids: Mapping[str, int], steps: int, where: str) -> list[Light | None]:
    """The lights, with None for those whose lane is not on the map."""
    lights = []
    for key, record in records.items():
        place = f"{where}[{key!r}]"
        states = _value(json_documents.get(record, "state", dict, place), "object_state", place)
        states = states.tolist() if isinstance(states, np.ndarray) else states
        if not isinstance(states, (list, tuple)) or len(states) != steps:
            raise SceneError(f"{place}.state.object_state: {type(states).__name__}; there must be a list of {steps}, one for each step")
        codes = np.array([_code(state, f"{place}.state.object_state[{step}]") for step, state in enumerate(states)])
        lane = integer_ids.look_up_id(key if record.get("lane") is None else record["lane"], ids)
        stop = record.get("stop_point")
        stop = None if stop is None else _point(stop, f"{place}.stop_point")
        lights.append(None if lane is None else Light(lane=lane, state=np.maximum(codes, 0), valid=codes >= 0, stop=stop))
    return lights


def _code(state: Any, where: str) -> int:
    """Index into LIGHT_STATES; -1 where nothing is said. The older layouts have WOMD's numbers."""
    if state is None:
        return -1
    if isinstance(state, str) and state in SIGNALS:
        return SIGNALS[state]
    if isinstance(state, int) and 0 <= state < len(LIGHT_STATES):
        return state
    raise SceneError(f"{where}: {state!r} is no state of a light; valid: {', '.join(SIGNALS)}, or nothing")


def _metadata(document: Mapping[str, Any], ids: Mapping[str, Mapping[str, int]], where: str) -> dict[str, Any]:
    """What the file says of itself, objects by their ids, and what the ids that are no numbers stood for."""
    source, features = document["metadata"], document["map_features"]
    found: dict[str, Any] = {"format": "scenarionet"}
    found |= {key: source[key] for key in KEPT if isinstance(source.get(key), str)}
    for key in ("objects_of_interest", "tracks_to_predict"):
        if key in source:
            chosen = json_documents.expect(source[key], dict if isinstance(source[key], dict) else list, f"{where}metadata.{key}")
            found[key] = [ids["tracks"][str(track)] for track in chosen if str(track) in ids["tracks"]]
    signs = {key: record for key, record in features.items() if record["type"] == "STOP_SIGN"}
    if signs:
        lanes = {key: _lanes(record.get("lane"), ids["features"], f"{where}map_features[{key!r}].lane") for key, record in signs.items()}
        found["stop_sign_lanes"] = {str(ids["features"][str(key)]): list(chosen) for key, chosen in lanes.items() if chosen}
    tokens = {part: integer_ids.list_tokens(table) for part, table in ids.items()}
    return found | ({"tokens": tokens} if any(tokens.values()) else {})
