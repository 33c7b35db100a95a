"""PufferDrive's binary maps, made from GPUDrive's JSON (`save_map_binary` in its `drive.py`, the layout of 2025 without scenario ids).

Little endian, integers and floats of 32 bits:

    number of objects, number of roads; then each of them:
    type, n, x[n], y[n], z[n];  objects also: vx[n], vy[n], vz[n], heading[n], valid[n];  then width, length, height, goal x, y, z, expert

Objects are of type 1 vehicle, 2 pedestrian, 3 cyclist. Roads are of type 4 to 10: the kinds of lanes, lines and edges are lost, bicycle
lanes look like any other, polylines are thinned out. There are no ids, lights, times and no recording car.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenefactory_jax.core.raw_scene import FormatMismatch, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import FULL_TURN, wrap_angles
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, EDGE_BOUNDARY, LANE_STREET, LINES, SPEED_BUMP, STOP_SIGN, RoadUser
from scenefactory_jax.data.formats import json_documents, polylines

OBJECTS: dict[int, RoadUser] = {1: "vehicle", 2: "pedestrian", 3: "cyclist"}
ROADS = {4: LANE_STREET, 5: LINES[0], 6: EDGE_BOUNDARY, 7: STOP_SIGN, 8: CROSSWALK, 9: SPEED_BUMP, 10: DRIVEWAY}
THINNED = (4, 5, 6)  # roads of which points were dropped
WORD = 4  # bytes of a number
OBJECT_COLUMNS, ROAD_COLUMNS, HEAD, TAIL = 8, 3, 2, 7  # numbers for each step, for each point, before and after them


@dataclass(frozen=True)
class _Entity:
    """Where one object or road lies in the file, in words."""

    type: int
    count: int  # of steps or points
    start: int  # of its columns


def read(
    path: Path, *, step_s: float, current: int, point_spacing_m: float, file_limit_mb: int = json_documents.FILE_LIMIT_MB
) -> Iterator[RawScene]:
    """The one scene of a file. Its objects and roads are numbered in their order.

    Args:
        path: the binary map.
        step_s: time between two steps; the format does not say it.
        current: the step at which the simulation takes over; the format does not say it (10 in WOMD).
        point_spacing_m: between the points of lanes, lines and edges, at most; the format has dropped those on straight pieces.
        file_limit_mb: files that hold more, unpacked if they are compressed, are refused; the configs of older runs do not say it.

    Raises:
        FormatMismatch: the head and the first object are not of this layout.
        SceneError: they are, but the file is cut short, has more than its head says, or a value that cannot be.
    """
    _require_start(path)
    content = json_documents.unpack(path, file_limit_mb=file_limit_mb)
    words = np.frombuffer(content, "<i4", len(content) // WORD)
    objects, roads = _layout(words, len(content), path)
    steps = {entity.count for entity in objects}
    if len(steps) != 1 or not 0 <= current < min(steps):
        raise SceneError(f"{path}: objects of {sorted(steps)} steps; all must have as many, and more than `current`: {current}")
    values = words.view("<f4")
    tracks = tuple(_track(entity, index, words, values, f"{path}: objects[{index}]") for index, entity in enumerate(objects))
    experts = [index for index, entity in enumerate(objects) if words[entity.start + OBJECT_COLUMNS * entity.count + TAIL - 1]]
    yield RawScene(
        name=Path(path).stem,
        source=str(path),
        roads=tuple(_polyline(entity, index, values, point_spacing_m, f"{path}: roads[{index}]") for index, entity in enumerate(roads)),
        tracks=tracks,
        times=step_s * np.arange(min(steps), dtype=np.float64),
        current=current,
        metadata={"dataset": "WOMD", "format": "pufferdrive", "experts": experts},
    )


def _require_start(path: Path) -> None:
    """Refuse what cannot be such a map by its first numbers, before the whole file is read."""
    start = json_documents.read_head(path)[: WORD * (HEAD + 1)]
    numbers = np.frombuffer(start, "<i4", len(start) // WORD).tolist()
    if len(numbers) <= HEAD or numbers[0] < 1 or numbers[1] < 0 or numbers[HEAD] not in OBJECTS:
        raise FormatMismatch(f"{path}: no PufferDrive map: it begins with the numbers {numbers}")


def _layout(words: np.ndarray, size: int, path: Path) -> tuple[list[_Entity], list[_Entity]]:
    """Where everything lies. Every count is held against the size of the file before anything is read by it."""
    counts = [int(count) for count in words[:HEAD]]
    least = counts[0] * (HEAD + TAIL + OBJECT_COLUMNS) + counts[1] * (HEAD + TAIL) if len(counts) == HEAD else 0
    if size % WORD or len(counts) < HEAD or counts[0] < 1 or counts[1] < 0 or HEAD + least > len(words):
        raise FormatMismatch(f"{path}: no PufferDrive map: {size} bytes that begin with the numbers {counts}")
    entities: list[_Entity] = []
    place = HEAD
    for index in range(sum(counts)):
        kinds, columns = (OBJECTS, OBJECT_COLUMNS) if index < counts[0] else (ROADS, ROAD_COLUMNS)
        name = f"objects[{index}]" if index < counts[0] else f"roads[{index - counts[0]}]"
        kind, count = (int(word) for word in words[place : place + HEAD]) if place + HEAD <= len(words) else (0, 0)
        end = place + HEAD + columns * count + TAIL
        if kind not in kinds or count < 1 or end > len(words):
            error = OtherContent if index == 0 else SceneError
            raise error(f"{path}: {name}: type {kind} with {count} entries at byte {WORD * place} of {size}; damaged or cut short")
        entities.append(_Entity(kind, count, place + HEAD))
        place = end
    if place != len(words):
        raise SceneError(f"{path}: {WORD * (len(words) - place)} bytes more than {counts[0]} objects and {counts[1]} roads have")
    return entities[: counts[0]], entities[counts[0] :]


def _track(entity: _Entity, index: int, words: np.ndarray, values: np.ndarray, where: str) -> Track:
    """One object. Invalid steps hold -10000 in the files and zero here."""
    count, span = entity.count, slice(entity.start, entity.start + OBJECT_COLUMNS * entity.count)
    x, y, z, vx, vy, _, heading, _ = values[span].reshape(OBJECT_COLUMNS, count).astype(np.float64)
    flags = words[span.stop - count : span.stop]
    if np.any((flags != 0) & (flags != 1)):
        raise SceneError(f"{where}.valid: {flags[(flags != 0) & (flags != 1)][0]} is not 0 or 1")
    valid = flags == 1
    xyz, velocity = np.stack([x, y, z], axis=1), np.stack([vx, vy], axis=1)
    for name, table in (("position", xyz), ("velocity", velocity), ("heading", heading)):
        json_documents.check_finite(table, f"{where}.{name}", rows=valid)
    if np.any(np.abs(heading[valid]) > FULL_TURN):
        raise SceneError(f"{where}.heading: {np.abs(heading[valid]).max()} is no angle in radians")
    width, length, height = (float(value) for value in values[span.stop : span.stop + 3])
    mask = valid[:, None]
    return Track(
        id=index,
        kind=OBJECTS[entity.type],
        size=(length, width, height),
        xyz=np.where(mask, xyz, 0.0),
        yaw=np.where(valid, wrap_angles(heading), 0.0),
        velocity=np.where(mask, velocity, 0.0),
        valid=valid,
    )


def _polyline(entity: _Entity, index: int, values: np.ndarray, spacing_m: float, where: str) -> Polyline:
    """One road feature."""
    columns = values[entity.start : entity.start + ROAD_COLUMNS * entity.count].reshape(ROAD_COLUMNS, entity.count)
    xyz = columns.T.astype(np.float64)
    json_documents.check_finite(xyz, f"{where}.geometry", keys=("x", "y", "z"))
    return Polyline(kind=ROADS[entity.type], xyz=polylines.densify(xyz, spacing_m) if entity.type in THINNED else xyz, id=index)
