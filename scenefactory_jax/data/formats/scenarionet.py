"""ScenarioNet's and MetaDrive's scenario pickles (https://scenarionet.readthedocs.io, "Scenario Description").

`{id, version, length, metadata{ts, dataset, sdc_id, ...}, tracks{}, dynamic_map_states{}, map_features{}}`, one scenario a file, converted
from WOMD, nuScenes, nuPlan, Argoverse 2 or MetaDrive's own maps; coordinates are right-handed, boxes are given by their centres. Earlier
layouts are read, too (`scenarionet_legacy`).

This reader undoes four things of the converters: nuScenes' lanes are poses, whose third column is a heading instead of a height; length
and width of nuScenes' recording car are exchanged; the outline of the drivable area is stored as white lines (`boundary_7`); and
MetaDrive's own maps have solid lines in place of road edges (`metadrive_map`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, Light, OtherContent, Polyline, RawScene, SceneError, Track
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
    SPEED_BUMP,
    STOP_SIGN,
)
from scenefactory_jax.data.formats import metadrive_map, polylines, safe_pickle, scenarionet_legacy, scene_parts, values

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"  # beside the scenarios of a database
LANE_UNKNOWN, LINE_UNKNOWN, EDGE_UNKNOWN = 0, 5, 14  # map elements of WOMD for features of an unknown kind
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
MAX_SPEED_LIMIT = 160 / 3.6  # m/s, the highest on any sign (United Arab Emirates)
METADRIVE = "metadrive"  # `dataset` of its own maps
SOLID = (LINE_UNKNOWN, 7, 8, 11, 12)  # lines that may not be crossed, and lines of an unknown kind
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
    document = safe_pickle.load(path, file_limit_mb=file_limit_mb, opcode_limit=opcode_limit)
    if not isinstance(document, dict):
        raise OtherContent(f"{path}: expected a ScenarioNet pickle with a dict, got {type(document).__name__}")
    if "tracks" not in document or not {"map_features", "map"} & set(document):
        raise OtherContent(f"{path}: expected a ScenarioNet pickle with 'tracks' and a map, got the keys {values.list_keys(document)}")
    where = f"{path}: "
    document = scenarionet_legacy.convert_legacy(document, where)
    metadata, features = document["metadata"], document["map_features"]
    ids = {"tracks": scene_parts.assign_ids(document["tracks"]), "features": scene_parts.assign_ids(features)}
    times = _times(metadata, f"{where}metadata")
    current = values.get({"current_time_index": current} | metadata, "current_time_index", int, f"{where}metadata")
    values.check_current(current, len(times), f"{where}metadata.current_time_index or formats.scenarionet.current")
    dataset = metadata["dataset"] if isinstance(metadata.get("dataset"), str) else "unknown"
    tracks = [_track(track, ids["tracks"][str(key)], len(times), f"{where}tracks[{key!r}]") for key, track in document["tracks"].items()]
    sdc = _sdc(metadata, document["tracks"], f"{where}metadata.sdc_id")
    if sdc is not None and dataset == "nuscenes":
        length, width, height = tracks[sdc].size  # exchanged; MetaDrive repairs it in the same way
        tracks[sdc] = replace(tracks[sdc], size=(max(length, width), min(length, width), height))
    lights = _lights(document["dynamic_map_states"], ids["features"], len(times), f"{where}dynamic_map_states")
    roads, left_out = _roads(features, ids["features"], outlines_are_edges, dataset, f"{where}map_features")
    rims = _find_rims(roads, features, f"{where}map_features") if outlines_are_edges and dataset == METADRIVE else []
    roads = [replace(line, kind=EDGE_BOUNDARY) if place in rims else line for place, line in enumerate(roads)]
    if dataset != "waymo":
        dense = lambda line: line.kind not in POLYGONS and len(line.xyz) > 0  # noqa: E731
        roads = [replace(line, xyz=polylines.densify(line.xyz, point_spacing_m)) if dense(line) else line for line in roads]
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


def _times(metadata: Mapping[str, Any], where: str) -> Float[np.ndarray, " L"]:
    """Times of the steps."""
    times = values.array(values.get(metadata, "ts", None, where), f"{where}.ts")
    if times.ndim != 1 or not len(times):
        raise SceneError(f"{where}.ts: expected a time for each step, got an array of the shape {times.shape}")
    values.check_finite(times, f"{where}.ts")
    return times


def _sdc(metadata: Mapping[str, Any], tracks: Mapping[Any, Any], where: str) -> int | None:
    """Index of the recording car's track."""
    key, keys = metadata.get("sdc_id"), [str(track) for track in tracks]
    if key is not None and str(key) not in keys:
        raise SceneError(f"{where}: expected the key of one of the {len(keys)} tracks, got {key!r}")
    return None if key is None else keys.index(str(key))


def _points(value: Any, where: str) -> Float[np.ndarray, "N 3"]:
    """Points with or without a height."""
    return scene_parts.to_xyz(values.table(value, where, columns=(2, 3)))


def _point(value: Any, where: str) -> Float[np.ndarray, "1 3"]:
    """One point, as a table of one row."""
    points = _points([value], where)
    if len(points) != 1:
        raise SceneError(f"{where}: expected two or three numbers, got none")
    values.check_finite(points, where)
    return points


def _track(track: Mapping[str, Any], number: int, steps: int, where: str) -> Track:
    """One object; its size is that of its last valid step."""
    state, where_state = track["state"], f"{where}.state"
    column = lambda key: values.column(values.get(state, key, None, where_state), f"{where_state}.{key}", length=steps)  # noqa: E731
    valid, yaw = column("valid") != 0, column("heading")
    xyz, velocity = (_points(values.get(state, key, None, where_state), f"{where_state}.{key}") for key in ("position", "velocity"))
    for name, table in (("position", xyz), ("velocity", velocity)):
        values.check_length(table, steps, f"{where_state}.{name}")
    scene_parts.check_motion(where_state, valid, position=xyz, velocity=velocity, heading=yaw, degrees=True)
    last = np.flatnonzero(valid)[-1] if valid.any() else -1
    length, width, height = (float(column(key)[last]) for key in ("length", "width", "height"))
    kind = scene_parts.road_user(values.get(track, "type", str, where))
    return scene_parts.make_track(
        id=number, kind=kind, size=(length, width, height), xyz=xyz, yaw=yaw, velocity=velocity[:, :2], valid=valid
    )


def _roads(
    features: Mapping[Any, Any], ids: Mapping[str, int], outlines_are_edges: bool, dataset: str, where: str
) -> tuple[list[Polyline], Counter[str]]:
    """The features of the map, and the number of features of each type that WOMD has no map element for, such as sidewalks."""
    roads, left_out = [], Counter()
    for key, feature in features.items():
        place = f"{where}[{key!r}]"
        name = values.get(values.expect(feature, dict, place), "type", str, place)
        kind = ELEMENTS.get(name, OTHER_NAMES.get(name))
        if name == "UNKNOWN" and "entry_lanes" in feature:  # the type of a lane in older layouts
            kind = LANE_UNKNOWN
        elif outlines_are_edges and kind in LINES and str(key).startswith("boundary_"):
            kind = EDGE_BOUNDARY
        if kind is None:
            left_out[name] += 1
        else:
            roads.append(_polyline(feature, ids[str(key)], kind, ids, dataset == "nuscenes", place))
    return roads, left_out


def _polyline(feature: Mapping[str, Any], number: int, kind: int, ids: Mapping[str, int], poses: bool, where: str) -> Polyline:
    """One feature of the map: a line, the outline of a polygon, or a stop sign's point."""
    shape = next((key for key in ("polyline", "polygon", "position") if key in feature), "polyline")
    xyz = (_point if shape == "position" else _points)(values.get(feature, shape, None, where), f"{where}.{shape}")
    values.check_finite(xyz, f"{where}.{shape}")
    if kind not in LANES:
        return Polyline(kind=kind, xyz=xyz, id=number)
    keys = {"entry": "entry_lanes", "exit": "exit_lanes", "left": "left_neighbor", "right": "right_neighbor"}
    links: dict[str, Any] = {name: _lanes(feature.get(key), ids, f"{where}.{key}") for name, key in keys.items()}
    return Polyline(
        kind=kind,
        xyz=xyz * (1.0, 1.0, 0.0) if poses else xyz,
        id=number,
        speed_limit=_speed_limit(feature, where),
        **links,
    )


def _find_rims(roads: list[Polyline], features: Mapping[Any, Any], where: str) -> list[int]:
    """Places in `roads` of the solid or unknown lines that are the rim of a MetaDrive map; none if the map has edges."""
    if any(line.kind in EDGES for line in roads):
        return []
    lanes = []
    for key, feature in features.items():
        if "polygon" in feature and feature["type"].startswith("LANE_"):
            lanes.append(_points(feature["polygon"], f"{where}[{key!r}].polygon"))
            values.check_finite(lanes[-1], f"{where}[{key!r}].polygon")
    solid = [place for place, line in enumerate(roads) if line.kind in SOLID and len(line.xyz) > 1]
    rims = metadrive_map.find_rims([roads[place].xyz for place in solid], [lane[:, :2] for lane in lanes])
    return [place for place, rim in zip(solid, rims, strict=True) if rim]


def _lanes(entries: Any, ids: Mapping[str, int], where: str) -> tuple[int, ...]:
    """Ids of other lanes, listed as such or as records with a `feature_id`; each once."""
    entries = entries.tolist() if isinstance(entries, np.ndarray) else [] if entries is None else entries
    keys = [
        values.get(entry, "feature_id", None, where) if isinstance(entry, dict) else entry for entry in values.expect(entries, list, where)
    ]
    found = (scene_parts.look_up_id(key, ids) for key in keys)
    return tuple(dict.fromkeys(lane for lane in found if lane is not None))


def _speed_limit(feature: Mapping[str, Any], where: str) -> float | None:
    """Speed limit in m/s; where a lane has none, WOMD's converter writes 0 and MetaDrive 1,000 km/h."""
    for key, unit in UNITS.items():
        if feature.get(key) is not None:
            limit = values.expect(feature[key], float, f"{where}.{key}") * unit
            return limit if 0 < limit <= MAX_SPEED_LIMIT else None
    return None


def _lights(records: Mapping[Any, Any], ids: Mapping[str, int], steps: int, where: str) -> list[Light | None]:
    """The lights, with None for those whose lane is not on the map."""
    lights = []
    for key, record in records.items():
        place = f"{where}[{key!r}]"
        states = values.get(values.get(record, "state", dict, place), "object_state", None, f"{place}.state")
        states = states.tolist() if isinstance(states, np.ndarray) else states
        if not isinstance(states, (list, tuple)) or len(states) != steps:
            raise SceneError(f"{place}.state.object_state: expected a list of {steps}, one for each step, got {type(states).__name__}")
        codes = np.array([_code(state, f"{place}.state.object_state[{step}]") for step, state in enumerate(states)])
        lane = scene_parts.look_up_id(key if record.get("lane") is None else record["lane"], ids)
        stop = None if record.get("stop_point") is None else _point(record["stop_point"], f"{place}.stop_point")[0]
        lights.append(None if lane is None else scene_parts.make_light(lane, codes, stop))
    return lights


def _code(state: Any, where: str) -> int:
    """Index into LIGHT_STATES; -1 for None. Older layouts have the numbers of WOMD."""
    if state is None:
        return -1
    if isinstance(state, str) and state in SIGNALS:
        return SIGNALS[state]
    if isinstance(state, int) and 0 <= state < len(LIGHT_STATES):
        return state
    raise SceneError(f"{where}: expected None or one of {', '.join(SIGNALS)}, got {state!r}")


def _metadata(document: Mapping[str, Any], ids: Mapping[str, Mapping[str, int]], where: str) -> dict[str, Any]:
    """The metadata of the file, with objects by their ids, and the texts of ids that are not integers."""
    source, features = document["metadata"], document["map_features"]
    found: dict[str, Any] = {"format": "scenarionet"}
    found |= {key: source[key] for key in TEXTS if isinstance(source.get(key), str)}
    for key in ("objects_of_interest", "tracks_to_predict"):
        if key in source:
            chosen = values.expect(source[key], dict if isinstance(source[key], dict) else list, f"{where}metadata.{key}")
            found[key] = [ids["tracks"][str(track)] for track in chosen if str(track) in ids["tracks"]]
    signs = {key: record for key, record in features.items() if record["type"] == "STOP_SIGN"}
    if signs:
        lanes = {key: _lanes(record.get("lane"), ids["features"], f"{where}map_features[{key!r}].lane") for key, record in signs.items()}
        found["stop_sign_lanes"] = {str(ids["features"][str(key)]): list(chosen) for key, chosen in lanes.items() if chosen}
    tokens = {part: scene_parts.list_tokens(table) for part, table in ids.items()}
    return found | ({"tokens": tokens} if any(tokens.values()) else {})
