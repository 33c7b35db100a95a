"""The scene JSON that SceneFactory publishes: polylines, and a start and an end pose for each agent."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import file_content, scene_parts, values

MAX_STEPS = 9_999  # of an end: every agent has an array as long as the last; `scenes.check.max_steps` less the first step
TYPES: dict[int, RoadUser] = {1: "vehicle", 2: "pedestrian", 3: "cyclist", 4: "other"}  # WOMD's object types
Pose = Float[np.ndarray, "4"]  # x, y, z, yaw


def read(
    path: Path, *, step_s: float, size_m: list[float], include_sdc: bool, all_vehicles: bool, file_limit_mb: int
) -> Iterator[RawScene]:
    """Reads the scene of a file. Each agent is a track of two valid steps: its start at step 0, its end at step `t_idx + 1`.

    Args:
        path, step_s, file_limit_mb: see `formats`.
        size_m: length, width and height of every agent, which the format does not have.
        include_sdc: whether the recording car is an agent (the published loader leaves it out).
        all_vehicles: whether every agent is a vehicle (the published loader turns pedestrians and cyclists into cars).
    """
    document = file_content.load_json(path, file_limit_mb=file_limit_mb)
    road = document.get("road")
    if not isinstance(road, dict) or "polylines" not in road:
        raise OtherContent(f"{path}: expected SceneFactory JSON with 'road.polylines', got the keys {values.list_keys(document)}")
    if len(size_m) != 3:
        raise SceneError(f"formats.scenefactory.size_m: expected [length, width, height], got {size_m!r}")
    lines = values.get(road, "polylines", list, f"{path}: road")
    agents = values.get(document, "agents", dict, f"{path}: ")
    items = values.get(agents, "items", list, f"{path}: agents")
    records = [(record, f"{path}: agents.items[{i}]") for i, record in enumerate(items)]
    sdc = len(records) if include_sdc and agents.get("sdc") is not None else None
    if sdc is not None:
        records.append((agents["sdc"], f"{path}: agents.sdc"))
    ends = [_end(values.expect(record, dict, where), where) for record, where in records]
    steps = 1 + max((step for step, _ in ends), default=0)
    size = (float(size_m[0]), float(size_m[1]), float(size_m[2]))
    meta = values.expect(document.get("meta") or {}, dict, f"{path}: meta")
    yield RawScene(
        name=Path(path).name,
        source=str(path),
        roads=tuple(_polyline(record, i, f"{path}: road.polylines[{i}]") for i, record in enumerate(lines)),
        tracks=tuple(_track(record, end, steps, size, all_vehicles, where) for (record, where), end in zip(records, ends, strict=True)),
        times=scene_parts.even_times(steps, step_s),
        current=0,
        sdc=sdc,
        metadata={"dataset": "WOMD", "format": "scenefactory"}
        | {"record": meta.get("source_file"), "record_index": meta.get("scene_index_global")},
    )


def _polyline(record: Any, index: int, where: str) -> Polyline:
    """One polyline; points may lack z."""
    values.expect(record, dict, where)
    rows = values.get(record, "xyz", list, where)
    xyz = np.zeros((len(rows), 3))
    for place, row in enumerate(rows):
        point = values.numbers(row, f"{where}.xyz[{place}]")
        if len(point) not in (2, 3):
            raise SceneError(f"{where}.xyz[{place}]: expected [x, y] or [x, y, z], got {row!r}")
        xyz[place, : len(point)] = point
    values.check_finite(xyz, f"{where}.xyz")
    number = values.expect(record.get("id", index), int, f"{where}.id")
    return Polyline(kind=values.get(record, "type", int, where), xyz=xyz, id=number)


def _pose(record: dict[str, Any], where: str) -> Pose:
    """A pose; z and yaw may be missing."""
    complete = {"z": 0.0, "yaw": 0.0} | record
    pose = np.array([values.get(complete, key, float, where) for key in ("x", "y", "z", "yaw")], np.float64)
    values.check_finite(pose, where)
    return pose


def _end(record: dict[str, Any], where: str) -> tuple[int, Pose | None]:
    """Step and pose of an agent's end; 0 and None for an agent without an end, which stays at its start."""
    end = record.get("end")
    if end is None:
        return 0, None
    values.expect(end, dict, f"{where}.end")
    step = values.expect(end.get("t_idx", 0), int, f"{where}.end.t_idx")
    if not 0 <= step < MAX_STEPS:
        raise SceneError(f"{where}.end.t_idx: expected a step from 0 (the first future sample) to {MAX_STEPS - 1}, got {step}")
    return step + 1, _pose(end, f"{where}.end")


def _track(
    record: dict[str, Any], end: tuple[int, Pose | None], steps: int, size: tuple[float, float, float], all_vehicles: bool, where: str
) -> Track:
    """An agent as a track that is valid at its start and at its end, with zero velocity, which the format does not have."""
    poses, valid = np.zeros((steps, 4)), np.zeros(steps, bool)
    poses[0], valid[0] = _pose(values.get(record, "start", dict, where), f"{where}.start"), True
    if end[1] is not None:
        poses[end[0]], valid[end[0]] = end[1], True
    kind = record.get("agent_type", "vehicle")
    named = TYPES.get(kind, "other") if values.is_number(kind) else scene_parts.road_user(str(kind).lower().removeprefix("type_"))
    number = values.get(record, "agent_id", float, where)  # a float in tf.Example
    if not np.isfinite(number):
        raise SceneError(f"{where}.agent_id: expected a finite number, got {number}")
    return Track(
        id=int(number),
        kind="vehicle" if all_vehicles else named,
        size=size,
        xyz=poses[:, :3].copy(),
        yaw=poses[:, 3].copy(),
        velocity=np.zeros((steps, 2)),
        valid=valid,
    )
