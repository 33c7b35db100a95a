"""The scene JSON that SceneFactory publishes: polylines, and a start and an end pose for each agent."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import ROAD_USERS
from scenefactory_jax.data.formats import json_documents

STEPS_MOST = 9_999  # of an end: every agent has an array as long as the last; `scenes.check.max_steps` less the first step
TYPES = {1: "vehicle", 2: "pedestrian", 3: "cyclist", 4: "other"}  # WOMD's object types


def read(
    path: Path,
    *,
    step_s: float,
    size_m: list[float],
    include_sdc: bool,
    all_vehicles: bool,
    file_limit_mb: int = json_documents.FILE_LIMIT_MB,
) -> Iterator[RawScene]:
    """The one scene of a file. Each agent is a track of two valid steps: its start at step 0, its end at step `t_idx + 1`.

    Args:
        path: JSON, plain, gzip or xz.
        step_s: time between two steps of the log that the file was made from (0.1 in WOMD).
        size_m: length, width and height of every agent; the format has none.
        include_sdc: whether the recording car is an agent too (the published loader leaves it out).
        all_vehicles: whether every agent is a vehicle (the published loader makes cars of pedestrians and cyclists).
        file_limit_mb: files that hold more, unpacked if they are compressed, are refused; the configs of older runs do not say it.

    Raises:
        FormatMismatch: the file has no `road.polylines`.
        SceneError: it has, but a value is missing, of a wrong type or not finite, naming its key.
    """
    document = json_documents.load(path, file_limit_mb=file_limit_mb)
    road = document.get("road")
    if not isinstance(road, dict) or "polylines" not in road:
        raise OtherContent(f"{path}: no SceneFactory JSON: it has no 'road.polylines', but {', '.join(map(str, document)) or 'nothing'}")
    if len(size_m) != 3:
        raise SceneError(f"formats.scenefactory.size_m: {size_m!r} is not [length, width, height]")
    polylines = json_documents.get(road, "polylines", list, f"{path}: road")
    agents = json_documents.get(document, "agents", dict, f"{path}: ")
    items = json_documents.get(agents, "items", list, f"{path}: agents")
    records = [(record, f"{path}: agents.items[{i}]") for i, record in enumerate(items)]
    sdc = None
    if include_sdc and agents.get("sdc") is not None:
        sdc = len(records)
        records.append((agents["sdc"], f"{path}: agents.sdc"))
    ends = [_end(json_documents.expect(record, dict, where), where) for record, where in records]
    steps = 1 + max((step for step, _ in ends), default=0)
    size = (float(size_m[0]), float(size_m[1]), float(size_m[2]))
    tracks = tuple(
        _track(record, end, steps, size, all_vehicles, where) for (record, where), end in zip(records, ends, strict=True)
    )
    meta = json_documents.expect(document.get("meta") or {}, dict, f"{path}: meta")
    yield RawScene(
        name=Path(path).name,
        source=str(path),
        roads=tuple(_polyline(record, i, f"{path}: road.polylines[{i}]") for i, record in enumerate(polylines)),
        tracks=tracks,
        times=step_s * np.arange(steps, dtype=np.float64),
        current=0,
        sdc=sdc,
        metadata={"dataset": "WOMD", "format": "scenefactory"}
        | {"record": meta.get("source_file"), "record_index": meta.get("scene_index_global")},
    )


def _polyline(record: Any, index: int, where: str) -> Polyline:
    """One polyline; points may lack z."""
    json_documents.expect(record, dict, where)
    rows = json_documents.get(record, "xyz", list, where)
    xyz = np.zeros((len(rows), 3))
    for place, row in enumerate(rows):
        values = json_documents.numbers(row, f"{where}.xyz[{place}]")
        if len(values) not in (2, 3):
            raise SceneError(f"{where}.xyz[{place}]: {row!r} is no point; valid: [x, y] or [x, y, z]")
        xyz[place, : len(values)] = values
    json_documents.check_finite(xyz, f"{where}.xyz")
    identity = json_documents.expect(record.get("id", index), int, f"{where}.id")
    return Polyline(kind=json_documents.get(record, "type", int, where), xyz=xyz, id=identity)


def _pose(record: dict[str, Any], where: str) -> Float[np.ndarray, "4"]:
    """x, y, z, yaw; z and yaw may be missing."""
    known = {"z": 0.0, "yaw": 0.0} | record
    pose = np.array([json_documents.get(known, key, float, where) for key in ("x", "y", "z", "yaw")], np.float64)
    json_documents.check_finite(pose, where)
    return pose


def _end(record: dict[str, Any], where: str) -> tuple[int, Float[np.ndarray, "4"] | None]:
    """Step and pose of an agent's end; no end: step 0 and nothing, an agent that goes nowhere."""
    end = record.get("end")
    if end is None:
        return 0, None
    json_documents.expect(end, dict, f"{where}.end")
    step = json_documents.expect(end.get("t_idx", 0), int, f"{where}.end.t_idx")
    if not 0 <= step < STEPS_MOST:
        raise SceneError(f"{where}.end.t_idx: {step} is no step; valid: 0 to {STEPS_MOST - 1}, counted from the first future sample")
    return step + 1, _pose(end, f"{where}.end")


def _track(
    record: dict[str, Any],
    end: tuple[int, Float[np.ndarray, "4"] | None],
    steps: int,
    size: tuple[float, float, float],
    all_vehicles: bool,
    where: str,
) -> Track:
    """An agent as a track that is known at its start and at its end, and at rest: the format has no velocities."""
    poses, valid = np.zeros((steps, 4)), np.zeros(steps, bool)
    poses[0], valid[0] = _pose(json_documents.get(record, "start", dict, where), f"{where}.start"), True
    if end[1] is not None:
        poses[end[0]], valid[end[0]] = end[1], True
    kind = record.get("agent_type", "vehicle")
    kind = TYPES.get(kind, "other") if json_documents.is_number(kind) else str(kind).lower().removeprefix("type_")
    return Track(
        id=int(json_documents.get(record, "agent_id", float, where)),  # tf.Example keeps ids as floats
        kind="vehicle" if all_vehicles else kind if kind in ROAD_USERS else "other",  # pyright: ignore[reportArgumentType]
        size=size,
        xyz=poses[:, :3].copy(),
        yaw=poses[:, 3].copy(),
        velocity=np.zeros((steps, 2)),
        valid=valid,
    )
