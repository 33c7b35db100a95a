"""The scene JSON that SceneFactory publishes: polylines, and a start and an end pose for each agent."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import file_content, scene_parts, values
from scenefactory_jax.data.formats.values import Node

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
    document = Node(file_content.load_json(path, file_limit_mb=file_limit_mb), f"{path}: ")
    road = document.get("road", {})
    if not isinstance(road.value, dict) or "polylines" not in road:
        raise OtherContent(f"{path}: expected SceneFactory JSON with 'road.polylines', got the keys {values.list_keys(document.value)}")
    if len(size_m) != 3:
        raise SceneError(f"formats.scenefactory.size_m: expected [length, width, height], got {size_m!r}")
    agents, meta = document["agents"], document.get("meta", {}).expect(dict)
    records = list(agents["items"].entries(list).values())
    sdc = len(records) if include_sdc and agents.get("sdc", None).value is not None else None
    if sdc is not None:
        records.append(agents["sdc"])
    ends = [_end(record.get("end", None)) for record in records]
    steps = 1 + max((step for step, _ in ends), default=0)
    yield RawScene(
        name=Path(path).name,
        source=str(path),
        roads=tuple(_polyline(record, i) for i, record in road["polylines"].entries(list).items()),
        tracks=tuple(_track(record, end, steps, size_m, all_vehicles) for record, end in zip(records, ends, strict=True)),
        times=step_s * np.arange(steps),
        current=0,
        sdc=sdc,
        metadata={"dataset": "WOMD", "format": "scenefactory"}
        | {"record": meta.get("source_file"), "record_index": meta.get("scene_index_global")},
    )


def _polyline(record: Node, index: int) -> Polyline:
    """One polyline; points may lack z."""
    rows = record["xyz"].entries(list)
    xyz = np.zeros((len(rows), 3))
    for place, row in rows.items():
        point = row.numbers()
        if len(point) not in (2, 3):
            raise SceneError(f"{row.where}: expected [x, y] or [x, y, z], got {row.value!r}")
        xyz[place, : len(point)] = point
    values.check_finite(xyz, f"{record.where}.xyz")
    return Polyline(kind=record["type"].expect(int), xyz=xyz, id=record.get("id", index).expect(int))


def _pose(record: Node) -> Pose:
    """A pose; z and yaw may be missing."""
    x, y = (record[key].expect(float) for key in ("x", "y"))
    z, yaw = (record.get(key, 0.0).expect(float) for key in ("z", "yaw"))
    pose = np.array([x, y, z, yaw], np.float64)
    values.check_finite(pose, record.where)
    return pose


def _end(end: Node) -> tuple[int, Pose | None]:
    """Step and pose of an agent's end; 0 and None for an agent without an end, which stays at its start."""
    if end.value is None:
        return 0, None
    step = end.get("t_idx", 0)
    if not 0 <= step.expect(int) < MAX_STEPS:
        raise SceneError(f"{step.where}: expected a step from 0 (the first future sample) to {MAX_STEPS - 1}, got {step.value}")
    return step.value + 1, _pose(end)


def _track(record: Node, end: tuple[int, Pose | None], steps: int, size_m: list[float], all_vehicles: bool) -> Track:
    """An agent as a track that is valid at its start and at its end, with zero velocity, which the format does not have."""
    poses, valid = np.zeros((steps, 4)), np.zeros(steps, bool)
    for step, pose in ((0, _pose(record["start"])), end):
        if pose is not None:
            poses[step], valid[step] = pose, True
    code, number = record.get("agent_type", "vehicle").value, record["agent_id"]  # a float in tf.Example
    kind = TYPES.get(code, "other") if values.is_number(code) else scene_parts.road_user(str(code).lower().removeprefix("type_"))
    if not np.isfinite(number.expect(float)):
        raise SceneError(f"{number.where}: expected a finite number, got {number.value}")
    length, width, height = map(float, size_m)
    return Track(
        id=int(number.value),
        kind="vehicle" if all_vehicles else kind,
        size=(length, width, height),
        xyz=poses[:, :3].copy(),
        yaw=poses[:, 3].copy(),
        velocity=np.zeros((steps, 2)),
        valid=valid,
    )
