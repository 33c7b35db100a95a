"""PufferDrive's binary maps, made from GPUDrive's JSON (`save_map_binary` in its `drive.py`, the layout of 2025 without scenario ids).

Little endian, integers and floats of 32 bits:

    number of objects, number of roads; then each of them:
    type, n, x[n], y[n], z[n];  objects also: vx[n], vy[n], vz[n], heading[n], valid[n];  then width, length, height, goal x, y, z, expert

Objects are of type 1 vehicle, 2 pedestrian, 3 cyclist. Roads are of type 4 to 10: the kinds of lanes, lines and edges are lost, bicycle
lanes look like any other, polylines are thinned out. There are no ids, lights, times and no recording car.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.raw_scene import FormatMismatch, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, EDGE_BOUNDARY, LANE_STREET, LINES, SPEED_BUMP, STOP_SIGN, RoadUser
from scenefactory_jax.data.formats import file_content, polylines, scene_parts, values

OBJECTS: dict[int, RoadUser] = {1: "vehicle", 2: "pedestrian", 3: "cyclist"}
ROADS = {4: LANE_STREET, 5: LINES[0], 6: EDGE_BOUNDARY, 7: STOP_SIGN, 8: CROSSWALK, 9: SPEED_BUMP, 10: DRIVEWAY}
THINNED = (4, 5, 6)  # roads of which points were dropped
WORD = 4  # bytes of a number
OBJECT_COLUMNS, ROAD_COLUMNS, HEAD, TAIL = 8, 3, 2, 7  # numbers per step, per point, before and after them


class _Entity(NamedTuple):
    """Place of one object or road in the file, in words."""

    type: int
    count: int  # of steps or points
    start: int  # of its columns


def read(path: Path, *, step_s: float, current: int, point_spacing_m: float, file_limit_mb: int) -> Iterator[RawScene]:
    """Reads the scene of a file; see `formats` for the numbers. Objects and roads are numbered in their order."""
    _check_start(path)
    content = file_content.unpack(path, file_limit_mb=file_limit_mb)
    words = np.frombuffer(content, "<i4", len(content) // WORD)
    objects, roads = _find_entities(words, len(content), path)
    steps = objects[0].count
    if any(entity.count != steps for entity in objects):
        raise SceneError(f"{path}: expected objects of one number of steps, got {sorted({entity.count for entity in objects})}")
    values.check_current(current, steps, f"{path}: formats.pufferdrive.current")
    numbers = words.view("<f4")
    yield RawScene(
        name=Path(path).stem,
        source=str(path),
        roads=tuple(_polyline(entity, index, numbers, point_spacing_m, f"{path}: roads[{index}]") for index, entity in enumerate(roads)),
        tracks=tuple(_track(entity, index, words, numbers, f"{path}: objects[{index}]") for index, entity in enumerate(objects)),
        times=scene_parts.even_times(steps, step_s),
        current=current,
        metadata={"dataset": "WOMD", "format": "pufferdrive"}
        | {"experts": [index for index, entity in enumerate(objects) if words[entity.start + OBJECT_COLUMNS * steps + TAIL - 1]]},
    )


def _check_start(path: Path) -> None:
    """Refuses a file by its first numbers, before all of it is read."""
    start = file_content.read_head(path)[: WORD * (HEAD + 1)]
    numbers = np.frombuffer(start, "<i4", len(start) // WORD).tolist()
    if len(numbers) <= HEAD or numbers[0] < 1 or numbers[1] < 0 or numbers[HEAD] not in OBJECTS:
        raise FormatMismatch(f"{path}: expected a PufferDrive map, got a file that begins with the numbers {numbers}")


def _find_entities(words: np.ndarray, size: int, path: Path) -> tuple[list[_Entity], list[_Entity]]:
    """Places of objects and roads. Every count is compared with the size of the file before anything is read by it."""
    counts = [int(count) for count in words[:HEAD]]
    smallest = counts[0] * (HEAD + TAIL + OBJECT_COLUMNS) + counts[1] * (HEAD + TAIL) if len(counts) == HEAD else 0
    if size % WORD or len(counts) < HEAD or counts[0] < 1 or counts[1] < 0 or HEAD + smallest > len(words):
        raise FormatMismatch(f"{path}: expected a PufferDrive map, got {size} bytes that begin with the numbers {counts}")
    entities: list[_Entity] = []
    place = HEAD
    for index in range(sum(counts)):
        kinds, columns = (OBJECTS, OBJECT_COLUMNS) if index < counts[0] else (ROADS, ROAD_COLUMNS)
        kind, count = (int(word) for word in words[place : place + HEAD]) if place + HEAD <= len(words) else (0, 0)
        end = place + HEAD + columns * count + TAIL
        if kind not in kinds or count < 1 or end > len(words):
            name = f"objects[{index}]" if index < counts[0] else f"roads[{index - counts[0]}]"
            fault = f"type {kind} with {count} entries at byte {WORD * place} of {size}; damaged or cut short"
            raise (OtherContent if index == 0 else SceneError)(f"{path}: {name}: {fault}")
        entities.append(_Entity(kind, count, place + HEAD))
        place = end
    if place != len(words):
        raise SceneError(f"{path}: {WORD * (len(words) - place)} bytes more than {counts[0]} objects and {counts[1]} roads have")
    return entities[: counts[0]], entities[counts[0] :]


def _track(entity: _Entity, index: int, words: np.ndarray, numbers: np.ndarray, where: str) -> Track:
    """One object. Invalid steps are -10000 in the files."""
    end = entity.start + OBJECT_COLUMNS * entity.count
    x, y, z, vx, vy, _, heading, _ = numbers[entity.start : end].reshape(OBJECT_COLUMNS, entity.count).astype(np.float64)
    flags = words[end - entity.count : end]
    if np.any(wrong := (flags != 0) & (flags != 1)):
        raise SceneError(f"{where}.valid: expected 0 or 1, got {flags[wrong][0]}")
    xyz, velocity, valid = np.stack([x, y, z], axis=1), np.stack([vx, vy], axis=1), flags == 1
    scene_parts.check_motion(where, valid, position=xyz, velocity=velocity, heading=heading)
    width, length, height = (float(number) for number in numbers[end : end + 3])
    return scene_parts.make_track(
        id=index, kind=OBJECTS[entity.type], size=(length, width, height), xyz=xyz, yaw=heading, velocity=velocity, valid=valid
    )


def _polyline(entity: _Entity, index: int, numbers: np.ndarray, spacing_m: float, where: str) -> Polyline:
    """One road feature."""
    columns = numbers[entity.start : entity.start + ROAD_COLUMNS * entity.count].reshape(ROAD_COLUMNS, entity.count)
    xyz = columns.T.astype(np.float64)
    values.check_finite(xyz, f"{where}.geometry", keys=scene_parts.AXES)
    return Polyline(kind=ROADS[entity.type], xyz=polylines.densify(xyz, spacing_m) if entity.type in THINNED else xyz, id=index)
