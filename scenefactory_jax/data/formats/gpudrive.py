"""GPUDrive's and Nocturne's scene JSON, from the Waymo Open Motion Dataset.

`{name, scenario_id, objects[], roads[], tl_states{}, metadata{}}`. A light: for a lane the steps at which it was seen, and columns over
these, `{state[], x[], y[], z[], time_index[]}` (GPUDrive's `process_waymo_files.py`). The old layout of Nocturne has neither ids nor map
elements nor metadata nor heights, and its headings are in degrees.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import FULL_TURN, wrap_angles
from scenefactory_jax.core.types import ROAD_USERS
from scenefactory_jax.data.formats import integer_ids, json_documents

# the map element that a type's name stands for where `map_element_id` is missing
ELEMENTS = {"lane": 2, "road_line": 6, "road_edge": 15, "stop_sign": 17, "crosswalk": 18, "speed_bump": 19, "driveway": 20}


def read(
    path: Path,
    *,
    step_s: float,
    current: int,
    headings: Literal["layout", "degrees", "radians"],
    height_m: float,
    file_limit_mb: int = json_documents.FILE_LIMIT_MB,
) -> Iterator[RawScene]:
    """The one scene of a file.

    Args:
        path: JSON, plain, gzip or xz.
        step_s: time between two steps; the format does not say it.
        current: the step at which the simulation takes over; the format does not say it (10 in WOMD).
        headings: their unit; `layout`: degrees in the old layout (no map elements, no metadata), else radians.
        height_m: height of objects that have none (old layout).
        file_limit_mb: files that hold more, unpacked if they are compressed, are refused; the configs of older runs do not say it.

    Raises:
        FormatMismatch: the file has no `objects` and `roads`.
        SceneError: it has, but a value is missing, of a wrong type or not finite, naming its key.
    """
    document = json_documents.load(path, file_limit_mb=file_limit_mb)
    if missing := [key for key in ("objects", "roads") if key not in document]:
        raise OtherContent(f"{path}: no GPUDrive JSON: it has no {missing[0]!r}, but {', '.join(map(str, document)) or 'nothing'}")
    where = f"{path}: "
    objects = json_documents.expect(document["objects"], list, f"{where}objects")
    roads = json_documents.expect(document["roads"], list, f"{where}roads")
    records = [json_documents.expect(record, dict, f"{where}roads[{i}]") for i, record in enumerate(roads)]
    old = "metadata" not in document and not any("map_element_id" in record for record in records)
    degrees = old if headings == "layout" else headings == "degrees"
    steps = _count_steps(objects, where)
    if not 0 <= current < steps:
        raise SceneError(f"{path}: {steps} steps, so no step {current}; set formats.gpudrive.current to a step of this log")
    tracks = tuple(
        _track(json_documents.expect(record, dict, f"{where}objects[{i}]"), i, steps, f"{where}objects[{i}]", degrees, height_m)
        for i, record in enumerate(objects)
    )
    metadata, sdc = _metadata(document, tracks, where)
    if experts := [track.id for track, record in zip(tracks, objects, strict=True) if record.get("mark_as_expert")]:
        metadata["experts"] = experts
    yield RawScene(
        name=str(document.get("name") or Path(path).name),
        source=str(path),
        roads=tuple(_polyline(record, i, f"{where}roads[{i}]") for i, record in enumerate(records)),
        tracks=tracks,
        times=step_s * np.arange(steps, dtype=np.float64),
        current=current,
        sdc=sdc,
        lights=_lights(document.get("tl_states") or {}, steps, f"{where}tl_states"),
        metadata=metadata | {"dataset": "WOMD", "format": "gpudrive", "layout": "old" if old else "new"},
    )


def _count_steps(objects: list[Any], where: str) -> int:
    """Length of the log: that of the first object's `valid`."""
    if not objects:
        raise SceneError(f"{where}objects: none; a scene needs at least one")
    first = json_documents.expect(objects[0], dict, f"{where}objects[0]")
    return len(json_documents.get(first, "valid", list, f"{where}objects[0]"))


def _track(record: dict[str, Any], index: int, steps: int, where: str, degrees: bool, height_m: float) -> Track:
    """One object. Invalid steps hold -10000 in the files and zero here."""
    flags = json_documents.get(record, "valid", list, where)
    if len(flags) != steps:
        raise SceneError(f"{where}.valid: {len(flags)} entries; there must be {steps}, as objects[0] has")
    for place, flag in enumerate(flags):
        if flag is not True and flag is not False and flag not in (0, 1):
            raise SceneError(f"{where}.valid[{place}]: {flag!r} is not true or false")
    valid = np.array(flags, bool)
    rows = json_documents.get(record, "position", list, where)
    flat = bool(rows) and isinstance(rows[0], dict) and "z" not in rows[0]
    axes = ("x", "y") if flat else ("x", "y", "z")
    xyz = json_documents.points(rows, axes, f"{where}.position", length=steps)
    velocity = json_documents.points(json_documents.get(record, "velocity", list, where), ("x", "y"), f"{where}.velocity", length=steps)
    heading = json_documents.numbers(json_documents.get(record, "heading", list, where), f"{where}.heading", length=steps)
    for name, table, keys in (("position", xyz, axes), ("velocity", velocity, axes), ("heading", heading, ())):
        json_documents.check_finite(table, f"{where}.{name}", rows=valid, keys=keys)
    if not degrees and valid.any() and np.abs(heading[valid]).max() > FULL_TURN:
        place = int(np.argmax(np.where(valid, np.abs(heading), 0.0)))
        raise SceneError(f"{where}.heading[{place}]: {heading[place]} is no angle in radians; for degrees set formats.gpudrive.headings")
    yaw = np.deg2rad(heading) if degrees else heading
    kind = json_documents.get(record, "type", str, where).lower()
    mask = valid[:, None]
    return Track(
        id=json_documents.expect(record.get("id", index), int, f"{where}.id"),
        kind=kind if kind in ROAD_USERS else "other",  # pyright: ignore[reportArgumentType]
        size=_size(record, where, height_m),
        xyz=np.where(mask, np.pad(xyz, ((0, 0), (0, 1))) if flat else xyz, 0.0),
        yaw=np.where(valid, wrap_angles(yaw), 0.0),
        velocity=np.where(mask, velocity, 0.0),
        valid=valid,
    )


def _size(record: dict[str, Any], where: str, height_m: float) -> tuple[float, float, float]:
    """Length, width, height; only the height may be missing."""
    length, width = (float(json_documents.get(record, key, float, where)) for key in ("length", "width"))
    return length, width, float(json_documents.get({"height": height_m} | record, "height", float, where))


def _polyline(record: dict[str, Any], index: int, where: str) -> Polyline:
    """One road feature; a stop sign's geometry may be a point outside any list."""
    geometry = record.get("geometry")
    rows = [geometry] if isinstance(geometry, dict) else json_documents.get(record, "geometry", list, where)
    flat = bool(rows) and isinstance(rows[0], dict) and "z" not in rows[0]
    axes = ("x", "y") if flat else ("x", "y", "z")
    xyz = json_documents.points(rows, axes, f"{where}.geometry")
    json_documents.check_finite(xyz, f"{where}.geometry", keys=axes)
    if "map_element_id" in record:
        kind = json_documents.get(record, "map_element_id", int, where)
    else:
        name = json_documents.get(record, "type", str, where)
        if name not in ELEMENTS:
            raise SceneError(f"{where}.type: {name!r} is no road feature and there is no map_element_id; valid: {', '.join(ELEMENTS)}")
        kind = ELEMENTS[name]
    identity = json_documents.expect(record.get("id", index), int, f"{where}.id")
    return Polyline(kind=kind, xyz=np.pad(xyz, ((0, 0), (0, 1))) if flat else xyz, id=identity)


def _lights(states: Any, steps: int, where: str) -> tuple[Light, ...]:
    """A light for each lane that has one."""
    lights = []
    for key, record in json_documents.expect(states, dict, where).items():
        place = f"{where}.{key}"
        if not integer_ids.NUMBER.fullmatch(key):
            raise SceneError(f"{place}: {key!r} is no id of a lane")
        json_documents.expect(record, dict, place)
        names, indices = (json_documents.get(record, name, list, place) for name in ("state", "time_index"))
        state, valid = np.zeros(steps, int), np.zeros(steps, bool)
        if len(names) != len(indices):
            raise SceneError(f"{place}.state: {len(names)} entries; there must be {len(indices)}, as time_index has")
        for entry, (name, step) in enumerate(zip(names, indices, strict=True)):
            if name not in LIGHT_STATES:
                raise SceneError(f"{place}.state[{entry}]: {name!r} is no state of a light; valid: {', '.join(LIGHT_STATES)}")
            if not 0 <= json_documents.expect(step, int, f"{place}.time_index[{entry}]") < steps:
                raise SceneError(f"{place}.time_index[{entry}]: {step} is no step of the log; valid: 0 to {steps - 1}")
            state[step], valid[step] = LIGHT_STATES.index(name), True
        lights.append(Light(lane=int(key), state=state, valid=valid, stop=_stop(record, len(names), place)))
    return tuple(lights)


def _stop(record: dict[str, Any], entries: int, where: str) -> Float[np.ndarray, "3"] | None:
    """A light's stop point, as it was last seen; the steps repeat it."""
    if not entries or "x" not in record:
        return None
    columns = {"z": [0.0] * entries} | {axis: record[axis] for axis in ("x", "y", "z") if axis in record}
    table = [
        json_documents.numbers(json_documents.get(columns, axis, list, where), f"{where}.{axis}", length=entries)
        for axis in ("x", "y", "z")
    ]
    points = np.stack(table, axis=1)
    json_documents.check_finite(points, where, keys=("x", "y", "z"))
    return points[-1]


def _metadata(document: Mapping[str, Any], tracks: tuple[Track, ...], where: str) -> tuple[dict[str, Any], int | None]:
    """What the file says of itself, objects by their id (an index would not survive dropped tracks), and the SDC's index."""
    where = f"{where}metadata"
    source = json_documents.expect(document.get("metadata") or {}, dict, where)
    found: dict[str, Any] = {"scenario_id": str(document["scenario_id"])} if "scenario_id" in document else {}
    if "objects_of_interest" in source:
        found["objects_of_interest"] = json_documents.get(source, "objects_of_interest", list, where)
    if "tracks_to_predict" in source:
        chosen = json_documents.get(source, "tracks_to_predict", list, where)
        indices = [entry.get("track_index") if isinstance(entry, dict) else entry for entry in chosen]
        found["tracks_to_predict"] = [tracks[i].id for i in indices if isinstance(i, int) and 0 <= i < len(tracks)]
    sdc = source.get("sdc_track_index")
    if sdc is None or sdc == -1:
        return found, None
    json_documents.expect(sdc, int, f"{where}.sdc_track_index")
    if not 0 <= sdc < len(tracks):
        raise SceneError(f"{where}.sdc_track_index: {sdc} is no object; valid: 0 to {len(tracks) - 1}")
    return found, sdc
