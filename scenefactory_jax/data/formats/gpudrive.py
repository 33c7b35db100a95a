"""GPUDrive's and Nocturne's scene JSON, from the Waymo Open Motion Dataset (WOMD).

`{name, scenario_id, objects[], roads[], tl_states{}, metadata{}}`. A light lists, for a lane, the steps at which it was observed, and
columns over these: `{state[], x[], y[], z[], time_index[]}` (GPUDrive's `process_waymo_files.py`). The old layout of Nocturne has neither
ids nor map elements nor metadata nor heights, and its headings are in degrees. Links and limits of lanes and the lanes of stop signs are
read where `export.gpudrive` wrote them: under the names of WOMD's `map.proto`, which other readers pass over.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import FULL_TURN
from scenefactory_jax.data.formats import file_content, scene_parts, values
from scenefactory_jax.data.formats.values import AXES, Node

# map element of a type where `map_element_id` is missing
ELEMENTS = {"lane": 2, "road_line": 6, "road_edge": 15, "stop_sign": 17, "crosswalk": 18, "speed_bump": 19, "driveway": 20}

LINKS = {"entry": "entry_lanes", "exit": "exit_lanes", "left": "left_neighbors", "right": "right_neighbors"}
SIGN_LANES, SPEED_LIMIT, MPH = "lane", "speed_limit_mph", 1609.344 / 3600  # m/s


def read(
    path: Path, *, step_s: float, current: int, heading_unit: Literal["layout", "degrees", "radians"], height_m: float, file_limit_mb: int
) -> Iterator[RawScene]:
    """Reads the scene of a file: JSON, plain, gzip or xz.

    Args:
        path, step_s, current, file_limit_mb: see `formats`.
        heading_unit: `layout`: degrees in the old layout (no map elements, no metadata), else radians.
        height_m: height of objects without one (old layout).
    """
    document = Node(file_content.load_json(path, file_limit_mb=file_limit_mb), f"{path}: ")
    if missing := [key for key in ("objects", "roads") if key not in document]:
        raise OtherContent(f"{path}: expected GPUDrive JSON with {missing[0]!r}, got the keys {values.list_keys(document.value)}")
    objects, roads = (document[key].entries(list) for key in ("objects", "roads"))
    if not objects:
        raise SceneError(f"{path}: objects: expected at least one, got none")
    old = "metadata" not in document and not any("map_element_id" in record for record in roads.values())
    degrees = old if heading_unit == "layout" else heading_unit == "degrees"
    steps = len(objects[0]["valid"].expect(list))
    values.check_index(current, range(steps), "step of the log", f"{path}: formats.gpudrive.current")
    tracks = tuple(_track(record, i, steps, degrees, height_m) for i, record in objects.items())
    metadata, sdc = _metadata(document, tracks)
    if experts := [track.id for track, record in zip(tracks, objects.values(), strict=True) if record.value.get("mark_as_expert")]:
        metadata["experts"] = experts
    yield RawScene(
        name=str(document.value.get("name") or Path(path).name),
        source=str(path),
        roads=tuple(_polyline(record, i) for i, record in roads.items()),
        tracks=tracks,
        times=step_s * np.arange(steps),
        current=current,
        sdc=sdc,
        lights=_lights(document.get("tl_states", {}), steps),
        metadata=metadata | {"dataset": "WOMD", "format": "gpudrive", "layout": "old" if old else "new"},
    )


def _points(rows: Node, length: int | None = None) -> Float[np.ndarray, "N 3"]:
    """Points with or without z."""
    first = (rows.expect(list) or [{}])[0]
    flat = isinstance(first, dict) and "z" not in first
    return scene_parts.to_xyz(rows.points(AXES[:2] if flat else AXES, length=length))


def _track(record: Node, index: int, steps: int, degrees: bool, height_m: float) -> Track:
    """One object. Invalid steps are -10000 in the files."""
    flags = record["valid"]
    values.check_length(flags.expect(list), steps, flags.where)
    for step, flag in enumerate(flags.value):
        if flag not in (0, 1):
            raise SceneError(f"{flags.where}[{step}]: expected true or false, got {flag!r}")
    heading = record["heading"].numbers(length=steps)
    return scene_parts.make_track(
        record.where,
        id=record.get("id", index).expect(int),
        kind=scene_parts.road_user(record["type"].expect(str)),
        size=[record["length"].expect(float), record["width"].expect(float), record.get("height", height_m).expect(float)],
        position=_points(record["position"], steps),
        heading=np.deg2rad(heading) if degrees else heading,
        velocity=record["velocity"].points(AXES[:2], length=steps),
        valid=np.array(flags.value, bool),
        max_heading=np.inf if degrees else FULL_TURN,
    )


def _polyline(record: Node, index: int) -> Polyline:
    """One road feature; the geometry of a stop sign may be a point outside any list."""
    geometry = record["geometry"]
    xyz = _points(Node([geometry.value], geometry.where) if isinstance(geometry.value, dict) else geometry)
    values.check_finite(xyz, geometry.where, keys=AXES)
    if "map_element_id" in record:
        kind = record["map_element_id"].expect(int)
    elif (name := record["type"].expect(str)) in ELEMENTS:
        kind = ELEMENTS[name]
    else:
        raise SceneError(f"{record.where}.type: expected {', '.join(ELEMENTS)} where there is no map_element_id, got {name!r}")
    links: dict[str, Any] = {name: tuple(record[key].integers()) for name, key in LINKS.items() if key in record}
    if SIGN_LANES in record:
        links["lanes"] = tuple(record[SIGN_LANES].integers())
    if SPEED_LIMIT in record:
        links["speed_limit"] = record[SPEED_LIMIT].expect(float) * MPH
    return Polyline(kind=kind, xyz=xyz, id=record.get("id", index).expect(int), **links)


def _lights(states: Node, steps: int) -> tuple[Light, ...]:
    """The light of each lane that has one."""
    lights = []
    for lane, record in states.entries(dict).items():
        if not scene_parts.INTEGER.fullmatch(lane):
            raise SceneError(f"{record.where}: expected the id of a lane, got {lane!r}")
        names, indices = record["state"].entries(list), record["time_index"].entries(list)
        if len(names) != len(indices):
            raise SceneError(f"{record.where}.state: expected {len(indices)} entries, as time_index has, got {len(names)}")
        codes = np.full(steps, -1)
        for name, index in zip(names.values(), indices.values(), strict=True):
            if name.value not in LIGHT_STATES:
                raise SceneError(f"{name.where}: expected one of {', '.join(LIGHT_STATES)}, got {name.value!r}")
            step = values.check_index(index.expect(int), range(steps), "step", index.where)
            codes[step] = LIGHT_STATES.index(name.value)
        lights.append(scene_parts.make_light(int(lane), codes, _stop(record, len(names))))
    return tuple(lights)


def _stop(record: Node, entries: int) -> Float[np.ndarray, "3"] | None:
    """The last of a light's stop points; every step repeats it."""
    if not entries or "x" not in record:
        return None
    points = np.stack([record.get(axis, [0.0] * entries).numbers(length=entries) for axis in AXES], axis=1)
    values.check_finite(points, record.where, keys=AXES)
    return points[-1]


def _metadata(document: Node, tracks: tuple[Track, ...]) -> tuple[dict[str, Any], int | None]:
    """The metadata of the file, with objects by their ids, and the index of the recording car's track."""
    source = document.get("metadata", {})
    metadata: dict[str, Any] = {"scenario_id": str(document["scenario_id"].value)} if "scenario_id" in document else {}
    if "objects_of_interest" in source:
        metadata["objects_of_interest"] = source["objects_of_interest"].integers()
    if "tracks_to_predict" in source:
        chosen = source["tracks_to_predict"].expect(list)
        indices = [entry.get("track_index") if isinstance(entry, dict) else entry for entry in chosen]
        metadata["tracks_to_predict"] = [tracks[i].id for i in indices if isinstance(i, int) and 0 <= i < len(tracks)]
    sdc = source.get("sdc_track_index", None)
    if sdc.value is None or sdc.value == -1:
        return metadata, None
    return metadata, values.check_index(sdc.expect(int), tracks, "track", sdc.where)
