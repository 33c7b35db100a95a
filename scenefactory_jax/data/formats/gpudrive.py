"""GPUDrive's and Nocturne's scene JSON, from the Waymo Open Motion Dataset (WOMD).

`{name, scenario_id, objects[], roads[], tl_states{}, metadata{}}`. A light lists, for a lane, the steps at which it was observed, and
columns over these: `{state[], x[], y[], z[], time_index[]}` (GPUDrive's `process_waymo_files.py`). The old layout of Nocturne has neither
ids nor map elements nor metadata nor heights, and its headings are in degrees.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.data.formats import file_content, scene_parts, values
from scenefactory_jax.data.formats.scene_parts import AXES

# map element of a type where `map_element_id` is missing
ELEMENTS = {"lane": 2, "road_line": 6, "road_edge": 15, "stop_sign": 17, "crosswalk": 18, "speed_bump": 19, "driveway": 20}


def read(
    path: Path, *, step_s: float, current: int, heading_unit: Literal["layout", "degrees", "radians"], height_m: float, file_limit_mb: int
) -> Iterator[RawScene]:
    """Reads the scene of a file: JSON, plain, gzip or xz.

    Args:
        path, step_s, current, file_limit_mb: see `formats`.
        heading_unit: `layout`: degrees in the old layout (no map elements, no metadata), else radians.
        height_m: height of objects without one (old layout).
    """
    document = file_content.load_json(path, file_limit_mb=file_limit_mb)
    if missing := [key for key in ("objects", "roads") if key not in document]:
        raise OtherContent(f"{path}: expected GPUDrive JSON with {missing[0]!r}, got the keys {values.list_keys(document)}")
    where = f"{path}: "
    objects, roads = (
        [values.expect(record, dict, f"{where}{key}[{i}]") for i, record in enumerate(values.get(document, key, list, where))]
        for key in ("objects", "roads")
    )
    if not objects:
        raise SceneError(f"{where}objects: expected at least one, got none")
    old = "metadata" not in document and not any("map_element_id" in record for record in roads)
    degrees = old if heading_unit == "layout" else heading_unit == "degrees"
    steps = len(values.get(objects[0], "valid", list, f"{where}objects[0]"))
    values.check_current(current, steps, f"{where}formats.gpudrive.current")
    tracks = tuple(_track(record, i, steps, f"{where}objects[{i}]", degrees, height_m) for i, record in enumerate(objects))
    metadata, sdc = _metadata(document, tracks, where)
    if experts := [track.id for track, record in zip(tracks, objects, strict=True) if record.get("mark_as_expert")]:
        metadata["experts"] = experts
    yield RawScene(
        name=str(document.get("name") or Path(path).name),
        source=str(path),
        roads=tuple(_polyline(record, i, f"{where}roads[{i}]") for i, record in enumerate(roads)),
        tracks=tracks,
        times=scene_parts.even_times(steps, step_s),
        current=current,
        sdc=sdc,
        lights=_lights(document.get("tl_states") or {}, steps, f"{where}tl_states"),
        metadata=metadata | {"dataset": "WOMD", "format": "gpudrive", "layout": "old" if old else "new"},
    )


def _points(rows: Any, where: str, length: int | None = None) -> Float[np.ndarray, "N 3"]:
    """Points with or without z."""
    flat = isinstance(rows, list) and bool(rows) and isinstance(rows[0], dict) and "z" not in rows[0]
    return scene_parts.to_xyz(values.points(rows, AXES[:2] if flat else AXES, where, length=length))


def _track(record: dict[str, Any], index: int, steps: int, where: str, degrees: bool, height_m: float) -> Track:
    """One object. Invalid steps are -10000 in the files."""
    valid = _flags(values.get(record, "valid", list, where), steps, f"{where}.valid")
    xyz = _points(values.get(record, "position", list, where), f"{where}.position", steps)
    velocity = values.points(values.get(record, "velocity", list, where), AXES[:2], f"{where}.velocity", length=steps)
    heading = values.numbers(values.get(record, "heading", list, where), f"{where}.heading", length=steps)
    scene_parts.check_motion(where, valid, position=xyz, velocity=velocity, heading=heading, degrees=degrees)
    size = {"height": height_m} | record
    length, width, height = (float(values.get(size, key, float, where)) for key in ("length", "width", "height"))
    return scene_parts.make_track(
        id=values.expect(record.get("id", index), int, f"{where}.id"),
        kind=scene_parts.road_user(values.get(record, "type", str, where)),
        size=(length, width, height),
        xyz=xyz,
        yaw=np.deg2rad(heading) if degrees else heading,
        velocity=velocity,
        valid=valid,
    )


def _flags(flags: list[Any], steps: int, where: str) -> Bool[np.ndarray, " L"]:
    """A flag for each step: true, false, 1 or 0."""
    values.check_length(flags, steps, where)
    for place, flag in enumerate(flags):
        if flag is not True and flag is not False and flag not in (0, 1):
            raise SceneError(f"{where}[{place}]: expected true or false, got {flag!r}")
    return np.array(flags, bool)


def _polyline(record: dict[str, Any], index: int, where: str) -> Polyline:
    """One road feature; the geometry of a stop sign may be a point outside any list."""
    geometry = record.get("geometry")
    rows = [geometry] if isinstance(geometry, dict) else values.get(record, "geometry", list, where)
    xyz = _points(rows, f"{where}.geometry")
    values.check_finite(xyz, f"{where}.geometry", keys=AXES)
    if "map_element_id" in record:
        kind = values.get(record, "map_element_id", int, where)
    elif (name := values.get(record, "type", str, where)) in ELEMENTS:
        kind = ELEMENTS[name]
    else:
        raise SceneError(f"{where}.type: expected {', '.join(ELEMENTS)} where there is no map_element_id, got {name!r}")
    return Polyline(kind=kind, xyz=xyz, id=values.expect(record.get("id", index), int, f"{where}.id"))


def _lights(states: Any, steps: int, where: str) -> tuple[Light, ...]:
    """The light of each lane that has one."""
    lights = []
    for key, record in values.expect(states, dict, where).items():
        place = f"{where}.{key}"
        if not scene_parts.INTEGER.fullmatch(key):
            raise SceneError(f"{place}: expected the id of a lane, got {key!r}")
        values.expect(record, dict, place)
        names, indices = (values.get(record, name, list, place) for name in ("state", "time_index"))
        if len(names) != len(indices):
            raise SceneError(f"{place}.state: expected {len(indices)} entries, as time_index has, got {len(names)}")
        codes = np.full(steps, -1)
        for entry, (name, step) in enumerate(zip(names, indices, strict=True)):
            if name not in LIGHT_STATES:
                raise SceneError(f"{place}.state[{entry}]: expected one of {', '.join(LIGHT_STATES)}, got {name!r}")
            index = f"{place}.time_index[{entry}]"
            codes[values.check_index(values.expect(step, int, index), range(steps), "step", index)] = LIGHT_STATES.index(name)
        lights.append(scene_parts.make_light(int(key), codes, _stop(record, len(names), place)))
    return tuple(lights)


def _stop(record: dict[str, Any], entries: int, where: str) -> Float[np.ndarray, "3"] | None:
    """The last of a light's stop points; every step repeats it."""
    if not entries or "x" not in record:
        return None
    columns = {"z": [0.0] * entries} | record
    points = np.stack([values.numbers(values.get(columns, axis, list, where), f"{where}.{axis}", length=entries) for axis in AXES], axis=1)
    values.check_finite(points, where, keys=AXES)
    return points[-1]


def _metadata(document: Mapping[str, Any], tracks: tuple[Track, ...], where: str) -> tuple[dict[str, Any], int | None]:
    """The metadata of the file, with objects by their ids, and the index of the recording car's track."""
    where = f"{where}metadata"
    source = values.expect(document.get("metadata") or {}, dict, where)
    found: dict[str, Any] = {"scenario_id": str(document["scenario_id"])} if "scenario_id" in document else {}
    if "objects_of_interest" in source:
        chosen = values.get(source, "objects_of_interest", list, where)
        found["objects_of_interest"] = [values.expect(entry, int, f"{where}.objects_of_interest[{i}]") for i, entry in enumerate(chosen)]
    if "tracks_to_predict" in source:
        chosen = values.get(source, "tracks_to_predict", list, where)
        indices = [entry.get("track_index") if isinstance(entry, dict) else entry for entry in chosen]
        found["tracks_to_predict"] = [tracks[i].id for i in indices if isinstance(i, int) and 0 <= i < len(tracks)]
    sdc = source.get("sdc_track_index")
    if sdc is None or sdc == -1:
        return found, None
    where = f"{where}.sdc_track_index"
    return found, values.check_index(values.expect(sdc, int, where), tracks, "track", where)
