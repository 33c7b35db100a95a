"""ScenarioNet's and MetaDrive's scenario pickles (https://scenarionet.readthedocs.io, "Scenario Description").

`{id, version, length, metadata{ts, dataset, sdc_id, ...}, tracks{}, dynamic_map_states{}, map_features{}}`, one scenario a file, converted
from WOMD, nuScenes, nuPlan, Argoverse 2 or MetaDrive's own maps; coordinates are right-handed, boxes are given by their centres. Earlier
layouts are read, too (`scenarionet_legacy`).

This reader undoes four things of the converters: nuScenes' lanes are poses, whose third column is a heading instead of a height; length
and width of nuScenes' recording car are exchanged; the outline of the drivable area is stored as white lines (`boundary_7`); and
MetaDrive's own maps have solid lines in place of road edges, and links to all lanes of the next road (`metadrive_map`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, Light, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import EDGE_BOUNDARY, EDGES, LINES, POLYGONS, STOP_SIGN
from scenefactory_jax.data.formats import metadrive_map, polylines, safe_pickle, scenarionet_legacy, scene_parts, values
from scenefactory_jax.data.formats.values import Node

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"  # beside the scenarios of a database
ELEMENTS = {  # MetaDriveType -> WOMD map element, see `core.types`
    "LANE_UNKNOWN": 0, "LANE_FREEWAY": 1, "LANE_SURFACE_STREET": 2, "LANE_BIKE_LANE": 3,
    "UNKNOWN_LINE": 5, "ROAD_LINE_BROKEN_SINGLE_WHITE": 6, "ROAD_LINE_SOLID_SINGLE_WHITE": 7, "ROAD_LINE_SOLID_DOUBLE_WHITE": 8,
    "ROAD_LINE_BROKEN_SINGLE_YELLOW": 9, "ROAD_LINE_BROKEN_DOUBLE_YELLOW": 10, "ROAD_LINE_SOLID_SINGLE_YELLOW": 11,
    "ROAD_LINE_SOLID_DOUBLE_YELLOW": 12, "ROAD_LINE_PASSING_DOUBLE_YELLOW": 13,
    "UNKNOWN": 14, "ROAD_EDGE_BOUNDARY": 15, "ROAD_EDGE_MEDIAN": 16,
    "STOP_SIGN": 17, "CROSSWALK": 18, "SPEED_BUMP": 19, "DRIVEWAY": 20,
}  # fmt: skip
OTHER_NAMES = {"LANE_SURFACE_UNSTRUCTURE": 2, "CROSS_WALK": 18, "ROAD_LINE_DOUBLE_WHITE": 8}  # nuPlan's; older ones
LANES = (0, 1, 2, 3)
SIGNALS = {f"LANE_STATE_{name.upper()}": index for index, name in enumerate(LIGHT_STATES)} | {
    f"TRAFFIC_LIGHT_{colour}": LIGHT_STATES.index(name)  # nuPlan's and MetaDrive's own
    for colour, name in (("UNKNOWN", "unknown"), ("RED", "stop"), ("YELLOW", "caution"), ("GREEN", "go"))
}
DATASETS = {"waymo": "WOMD", "nuscenes": "nuScenes", "nuplan": "nuPlan", "av2": "argoverse2"}
UNITS = {"speed_limit_mph": 1609.344 / 3600, "speed_limit_kmh": 1 / 3.6}  # in m/s
MAX_SPEED_LIMIT = 160 / 3.6  # m/s, the highest on any sign (United Arab Emirates)
METADRIVE = "metadrive"  # `dataset` of its own maps
SOLID = (5, 7, 8, 11, 12)  # lines that may not be crossed, and lines of an unknown kind
TEXTS = ("scenario_id", "source_file", "map", "date")  # keys of the file's metadata that are kept where they are texts


def read(
    path: Path, *, current: int, outlines_are_edges: bool, point_spacing_m: float, file_limit_mb: int, opcode_limit: int
) -> Iterator[RawScene]:
    """Reads the scene of a file. Ids that are not integers are numbered after the largest; `metadata["tokens"]` keeps the texts.

    Args:
        path, current, point_spacing_m, file_limit_mb: see `formats`; only WOMD's files have a current step, and dense lines.
        outlines_are_edges: whether lines named `boundary_N`, the drivable area's outline in nuScenes and nuPlan, become road edges, and
            the rim of MetaDrive's own maps, of which `metadata["edges_from_lines"]` counts the lines.
        opcode_limit: longer pickles are refused.
    """
    if Path(path).name in (SUMMARY, MAPPING):  # by name: those of large databases are larger than any scenario
        raise Companion(f"{path}: ScenarioNet's {'summary' if Path(path).name == SUMMARY else 'mapping'} of a database")
    content = safe_pickle.load(path, file_limit_mb=file_limit_mb, opcode_limit=opcode_limit)
    if not isinstance(content, dict):
        raise OtherContent(f"{path}: expected a ScenarioNet pickle with a dict, got {type(content).__name__}")
    if "tracks" not in content or not {"map_features", "map"} & set(content):
        raise OtherContent(f"{path}: expected a ScenarioNet pickle with 'tracks' and a map, got the keys {values.list_keys(content)}")
    document = scenarionet_legacy.convert_legacy(Node(content, f"{path}: "))
    metadata, name = document["metadata"], document.get("id", None).value
    track_ids, feature_ids = (scene_parts.assign_ids(document[key].value) for key in ("tracks", "map_features"))
    times = metadata["ts"].array()
    if times.ndim != 1 or not len(times):
        raise SceneError(f"{path}: metadata.ts: expected a time for each step, got an array of the shape {times.shape}")
    values.check_finite(times, f"{path}: metadata.ts")
    current = metadata.get("current_time_index", current).expect(int)
    where = f"{path}: metadata.current_time_index or formats.scenarionet.current"
    values.check_index(current, range(len(times)), "step of the log", where)
    dataset = metadata.value["dataset"] if isinstance(metadata.value.get("dataset"), str) else "unknown"
    tracks = [_track(track, track_ids[str(key)], len(times)) for key, track in document["tracks"].entries(dict).items()]
    sdc = metadata.get("sdc_id", None)
    keys = [str(track) for track in document["tracks"].value]
    if sdc.value is not None and str(sdc.value) not in keys:
        raise SceneError(f"{sdc.where}: expected the key of one of the {len(keys)} tracks, got {sdc.value!r}")
    sdc_index = None if sdc.value is None else keys.index(str(sdc.value))
    if sdc_index is not None and dataset == "nuscenes":
        length, width, height = tracks[sdc_index].size  # exchanged; MetaDrive repairs it in the same way
        tracks[sdc_index] = replace(tracks[sdc_index], size=(max(length, width), min(length, width), height))
    lights = [_light(light, key, feature_ids, len(times)) for key, light in document["dynamic_map_states"].entries(dict).items()]
    roads, left_out = _roads(document["map_features"], feature_ids, outlines_are_edges, dataset)
    rims = _find_rims(roads, document["map_features"]) if outlines_are_edges and dataset == METADRIVE else []
    roads = [replace(line, kind=EDGE_BOUNDARY) if place in rims else line for place, line in enumerate(roads)]
    if dataset == METADRIVE:
        roads, sideways = metadrive_map.keep_meeting_links(roads)
        left_out.update(["LINK_SIDEWAYS"] * sideways)
    if dataset != "waymo":
        sparse = lambda line: line.kind not in POLYGONS and len(line.xyz) > 0  # noqa: E731
        roads = [replace(line, xyz=polylines.densify(line.xyz, point_spacing_m)) if sparse(line) else line for line in roads]
    left_out.update("TRAFFIC_LIGHT" for light in lights if light is None)
    yield RawScene(
        name=name if isinstance(name, str) and name else Path(path).stem,
        source=str(path),
        roads=tuple(roads),
        tracks=tuple(tracks),
        times=times,
        current=current,
        sdc=sdc_index,
        lights=tuple(light for light in lights if light is not None),
        metadata=_metadata(document, track_ids, feature_ids)
        | {"dataset": DATASETS.get(dataset, dataset), "left_out": dict(left_out)}
        | ({"edges_from_lines": len(rims)} if rims else {}),
    )


def _points(value: Node) -> Float[np.ndarray, "N 3"]:
    """Points with or without a height."""
    return scene_parts.to_xyz(value.table(2, 3))


def _point(value: Node) -> Float[np.ndarray, "1 3"]:
    """One point, as a table of one row."""
    points = _points(Node([value.value], value.where))
    if len(points) != 1:
        raise SceneError(f"{value.where}: expected two or three numbers, got none")
    values.check_finite(points, value.where)
    return points


def _track(track: Node, number: int, steps: int) -> Track:
    """One object; its size is that of its last valid step."""
    state = track["state"]
    valid = state["valid"].column(steps) != 0
    position, velocity = (_points(state[key]) for key in ("position", "velocity"))
    for name, table in (("position", position), ("velocity", velocity)):
        values.check_length(table, steps, f"{state.where}.{name}")
    last = np.flatnonzero(valid)[-1] if valid.any() else -1
    return scene_parts.make_track(
        state.where,
        id=number,
        kind=scene_parts.road_user(track["type"].expect(str)),
        size=[state[key].column(steps)[last] for key in ("length", "width", "height")],
        position=position,
        heading=state["heading"].column(steps),
        velocity=velocity[:, :2],
        valid=valid,
    )


def _roads(features: Node, ids: Mapping[str, int], outlines_are_edges: bool, dataset: str) -> tuple[list[Polyline], Counter[str]]:
    """The features of the map, and the number of features of each type that WOMD has no map element for, such as sidewalks."""
    roads, left_out = [], Counter()
    for key, feature in features.entries(dict).items():
        name = feature["type"].expect(str)
        kind = ELEMENTS.get(name, OTHER_NAMES.get(name))
        if name == "UNKNOWN" and "entry_lanes" in feature:  # the type of a lane in older layouts
            kind = ELEMENTS["LANE_UNKNOWN"]
        elif outlines_are_edges and kind in LINES and str(key).startswith("boundary_"):
            kind = EDGE_BOUNDARY
        if kind is None:
            left_out[name] += 1
        else:
            roads.append(_polyline(feature, ids[str(key)], kind, ids, dataset == "nuscenes"))
    return roads, left_out


def _polyline(feature: Node, number: int, kind: int, ids: Mapping[str, int], poses: bool) -> Polyline:
    """One feature of the map: a line, the outline of a polygon, or a stop sign's point."""
    key = next((key for key in ("polyline", "polygon", "position") if key in feature), "polyline")
    shape = feature[key]
    xyz = (_point if key == "position" else _points)(shape)
    values.check_finite(xyz, shape.where)
    if kind not in LANES:
        return Polyline(kind=kind, xyz=xyz, id=number, lanes=_lanes(feature.get("lane", []), ids) if kind == STOP_SIGN else ())
    keys = {"entry": "entry_lanes", "exit": "exit_lanes", "left": "left_neighbor", "right": "right_neighbor"}
    links: dict[str, Any] = {name: _lanes(feature.get(key, []), ids) for name, key in keys.items()}
    xyz = xyz * (1.0, 1.0, 0.0) if poses else xyz
    return Polyline(kind=kind, xyz=xyz, id=number, speed_limit=_speed_limit(feature), **links)


def _find_rims(roads: list[Polyline], features: Node) -> list[int]:
    """Places in `roads` of the solid or unknown lines that are the rim of a MetaDrive map; none if the map has edges."""
    if any(line.kind in EDGES for line in roads):
        return []
    outlines = [entry["polygon"] for entry in features.entries(dict).values() if "polygon" in entry and entry["type"].value[:5] == "LANE_"]
    lanes = [_points(outline) for outline in outlines]
    for outline, xyz in zip(outlines, lanes, strict=True):
        values.check_finite(xyz, outline.where)
    solid = [place for place, line in enumerate(roads) if line.kind in SOLID and len(line.xyz) > 1]
    rims = metadrive_map.find_rims([roads[place].xyz for place in solid], [lane[:, :2] for lane in lanes])
    return [place for place, rim in zip(solid, rims, strict=True) if rim]


def _lanes(entries: Node, ids: Mapping[str, int]) -> tuple[int, ...]:
    """Ids of other lanes, listed as such or as records with a `feature_id`; each once."""
    if isinstance(entries.value, np.ndarray):
        entries = Node(entries.value.tolist(), entries.where)
    keys = [entry["feature_id"].value if isinstance(entry.value, dict) else entry.value for entry in entries.entries(list).values()]
    lanes = (scene_parts.look_up_id(key, ids) for key in keys)
    return tuple(dict.fromkeys(lane for lane in lanes if lane is not None))


def _speed_limit(feature: Node) -> float | None:
    """Speed limit in m/s; where a lane has none, WOMD's converter writes 0 and MetaDrive 1,000 km/h."""
    for key, unit in UNITS.items():
        if feature.get(key, None).value is not None:
            limit = feature[key].expect(float) * unit
            return limit if 0 < limit <= MAX_SPEED_LIMIT else None
    return None


def _light(record: Node, key: Any, ids: Mapping[str, int], steps: int) -> Light | None:
    """One light; None if its lane is not on the map."""
    entry = record["state"]["object_state"]
    states = entry.value.tolist() if isinstance(entry.value, np.ndarray) else entry.value
    if not isinstance(states, (list, tuple)) or len(states) != steps:
        raise SceneError(f"{entry.where}: expected a list of {steps}, one for each step, got {type(states).__name__}")
    codes = np.array([_code(state, f"{entry.where}[{step}]") for step, state in enumerate(states)])
    lane, stop = scene_parts.look_up_id(record.get("lane", key).value, ids), record.get("stop_point", None)
    point = None if stop.value is None else _point(stop)[0]
    return None if lane is None else scene_parts.make_light(lane, codes, point)


def _code(state: Any, where: str) -> int:
    """Index into LIGHT_STATES; -1 for None. Older layouts have the numbers of WOMD."""
    if state is None:
        return -1
    if isinstance(state, str) and state in SIGNALS:
        return SIGNALS[state]
    if isinstance(state, int) and 0 <= state < len(LIGHT_STATES):
        return state
    raise SceneError(f"{where}: expected None or one of {', '.join(SIGNALS)}, got {state!r}")


def _metadata(document: Node, track_ids: Mapping[str, int], feature_ids: Mapping[str, int]) -> dict[str, Any]:
    """The metadata of the file, with objects by their ids, and the texts of ids that are not integers."""
    source = document["metadata"]
    texts = {key: source.value.get(key) for key in TEXTS}
    metadata: dict[str, Any] = {"format": "scenarionet"} | {key: text for key, text in texts.items() if isinstance(text, str)}
    for key in ("objects_of_interest", "tracks_to_predict"):
        if key in source:
            chosen = source[key].expect(dict if isinstance(source[key].value, dict) else list)
            metadata[key] = [track_ids[str(track)] for track in chosen if str(track) in track_ids]
    tokens = {"tracks": scene_parts.list_tokens(track_ids), "features": scene_parts.list_tokens(feature_ids)}
    return metadata | ({"tokens": tokens} if any(tokens.values()) else {})
