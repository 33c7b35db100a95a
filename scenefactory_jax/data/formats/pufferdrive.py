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
from scenefactory_jax.core.scene_arrays import FULL_TURN
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, EDGE_BOUNDARY, LANE_STREET, LINES, SPEED_BUMP, STOP_SIGN, RoadUser
from scenefactory_jax.data.formats import file_content, polylines, scene_parts, values

OBJECTS: dict[int, RoadUser] = {1: "vehicle", 2: "pedestrian", 3: "cyclist"}
ROADS = {4: LANE_STREET, 5: LINES[0], 6: EDGE_BOUNDARY, 7: STOP_SIGN, 8: CROSSWALK, 9: SPEED_BUMP, 10: DRIVEWAY}
THINNED = (4, 5, 6)  # roads of which points were dropped
WORD = 4  # bytes of a number
OBJECT_COLUMNS, ROAD_COLUMNS, HEAD, TAIL = 8, 3, 2, 7  # numbers per step, per point, before and after them


class _Entity(NamedTuple):
    """One object or road of the file, as views of its words."""

    kind: int
    columns: np.ndarray  # [C, steps or points], integers
    tail: np.ndarray


def read(path: Path, *, step_s: float, current: int, point_spacing_m: float, file_limit_mb: int) -> Iterator[RawScene]:
    """Reads the scene of a file; see `formats` for the numbers. Objects and roads are numbered in their order."""
    start = file_content.read_head(path)[: WORD * (HEAD + 1)]
    numbers = np.frombuffer(start, "<i4", len(start) // WORD).tolist()
    if len(numbers) <= HEAD or numbers[0] < 1 or numbers[1] < 0 or numbers[HEAD] not in OBJECTS:
        raise FormatMismatch(f"{path}: expected a PufferDrive map, got a file that begins with the numbers {numbers}")
    objects, roads = _split(file_content.unpack(path, file_limit_mb=file_limit_mb), path)
    steps = objects[0].columns.shape[1]
    if any(entity.columns.shape[1] != steps for entity in objects):
        counts = sorted({entity.columns.shape[1] for entity in objects})
        raise SceneError(f"{path}: expected objects of one number of steps, got {counts}")
    values.check_index(current, range(steps), "step of the log", f"{path}: formats.pufferdrive.current")
    yield RawScene(
        name=Path(path).stem,
        source=str(path),
        roads=tuple(_polyline(entity, index, point_spacing_m, f"{path}: roads[{index}]") for index, entity in enumerate(roads)),
        tracks=tuple(_track(entity, index, f"{path}: objects[{index}]") for index, entity in enumerate(objects)),
        times=step_s * np.arange(steps),
        current=current,
        metadata={"dataset": "WOMD", "format": "pufferdrive"}
        | {"experts": [index for index, entity in enumerate(objects) if entity.tail[-1]]},
    )


def _split(content: bytes, path: Path) -> tuple[list[_Entity], list[_Entity]]:
    """Objects and roads. Every count is compared with the size of the file before anything is read by it."""
    words = np.frombuffer(content, "<i4", len(content) // WORD)
    num_objects, num_roads = words[:HEAD].tolist()
    smallest = HEAD + num_objects * (HEAD + TAIL + OBJECT_COLUMNS) + num_roads * (HEAD + TAIL)
    if len(content) % WORD or smallest > len(words):
        raise FormatMismatch(f"{path}: expected a PufferDrive map of {num_objects} objects and {num_roads} roads, got {len(content)} bytes")
    entities: list[_Entity] = []
    place = HEAD
    for index in range(num_objects + num_roads):
        kinds, num_columns = (OBJECTS, OBJECT_COLUMNS) if index < num_objects else (ROADS, ROAD_COLUMNS)
        kind, count = words[place : place + HEAD].tolist() if place + HEAD <= len(words) else (0, 0)
        start, end = place + HEAD, place + HEAD + num_columns * count
        if kind not in kinds or count < 1 or end + TAIL > len(words):
            name = f"objects[{index}]" if index < num_objects else f"roads[{index - num_objects}]"
            fault = f"type {kind} with {count} entries at byte {WORD * place} of {len(content)}; damaged or cut short"
            raise (OtherContent if index == 0 else SceneError)(f"{path}: {name}: {fault}")
        entities.append(_Entity(kind, words[start:end].reshape(num_columns, count), words[end : end + TAIL]))
        place = end + TAIL
    if place != len(words):
        raise SceneError(f"{path}: {WORD * (len(words) - place)} bytes more than {num_objects} objects and {num_roads} roads have")
    return entities[:num_objects], entities[num_objects:]


def _track(entity: _Entity, index: int, where: str) -> Track:
    """One object. Invalid steps are -10000 in the files."""
    x, y, z, vx, vy, _, heading, _ = entity.columns.view("<f4").astype(np.float64)
    flags = entity.columns[-1]
    if np.any(wrong := (flags != 0) & (flags != 1)):
        raise SceneError(f"{where}.valid: expected 0 or 1, got {flags[wrong][0]}")
    width, length, height = entity.tail[:3].view("<f4").tolist()
    return scene_parts.make_track(
        where,
        id=index,
        kind=OBJECTS[entity.kind],
        size=(length, width, height),
        position=np.stack([x, y, z], axis=1),
        heading=heading,
        velocity=np.stack([vx, vy], axis=1),
        valid=flags == 1,
        max_heading=FULL_TURN,
    )


def _polyline(entity: _Entity, index: int, spacing_m: float, where: str) -> Polyline:
    """One road feature."""
    xyz = entity.columns.view("<f4").T.astype(np.float64)
    values.check_finite(xyz, f"{where}.geometry", keys=values.AXES)
    return Polyline(kind=ROADS[entity.kind], xyz=polylines.densify(xyz, spacing_m) if entity.kind in THINNED else xyz, id=index)
