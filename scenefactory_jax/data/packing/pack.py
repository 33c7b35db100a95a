"""RawScene -> Scene: which part of the map, which cars and who else, in float32 metres around the scene's centre.

Nothing disappears silently: the report counts what was kept and what was dropped, by reason.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.instantiate import ConfigError, check_number
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Unpackable
from scenefactory_jax.core.scene_arrays import Logs, join_lines, segment_lengths, stack_tracks, wrap_angles
from scenefactory_jax.core.types import DRIVABLE, POLYGONS, ROAD_USERS, Scene
from scenefactory_jax.data.formats.polylines import densify
from scenefactory_jax.data.packing import columns

DEGENERATE_M = 1e-6  # shorter segments have no direction
DROPS: tuple[str, ...] = (
    "not_a_vehicle", "absent_at_start", "start_outside_box", "goal_outside_box", "too_short", "overlaps", "over_capacity",
)  # fmt: skip
TRAFFIC_DROPS: tuple[str, ...] = ("absent_from_start_on", "outside_box", "overlaps_agent", "over_capacity")
REFUSALS: tuple[str, ...] = ("no_lane_in_box", "no_agent_left")  # why a scene is not packed
CUTS: tuple[str, ...] = ("outside_box", "gap", "degenerate")


@dataclass(frozen=True)
class PackReport:
    """The account of one packed scene, and what of its source the tensors do not hold."""

    name: str
    source: str
    centre: tuple[float, float, float]  # of the scene, in the source's coordinates
    centred_on: str  # "sdc", "mean", or "mean: ..." with the reason why not on the SDC
    steps: int  # of the packed log
    current: int  # index in the packed log of the step at which the cars start
    track_ids: tuple[int, ...]  # of the agents, slot by slot
    agents_kept: int
    agents_dropped: dict[str, int]  # reason -> count, every reason of DROPS
    traffic_kept: int  # everybody who is no agent is counted here or in the next
    traffic_dropped: dict[str, int]  # reason -> count, every reason of TRAFFIC_DROPS
    segments_kept: int
    segments_cut: dict[str, int]  # reason -> count, every reason of CUTS
    relief_m: float  # height between the lowest and the highest kept road point: the packed scene is flat
    repairs: tuple[str, ...] = ()
    metadata: dict[str, Any] = field(default_factory=dict)


class Packed(NamedTuple):
    """A scene of its own size, and its account."""

    scene: Scene
    report: PackReport


def prepare(raw: RawScene, *, check: Callable[..., Any], pack: Callable[..., Any]) -> Packed:
    """Check, then pack: both bound to their numbers. The report holds what the check repaired.

    Raises:
        SceneError: a scene that cannot be used, by name.
    """
    checked, repairs = check(raw)
    scene, report = pack(checked)
    return Packed(scene, replace(report, repairs=(*report.repairs, *repairs)))


def pack(
    raw: RawScene,
    *,
    scene_size_m: float,
    centre: Literal["sdc", "mean"],
    gap_m: float,
    agents: int,
    min_travel_m: float,
    car_size_m: list[float] | None,
    start_speed: Literal["logged", "zero"],
    log_from: Literal["start", "current"],
    require_agents: bool,
    traffic: int,
    min_traffic_size_m: float,
    outline_m: float,
) -> tuple[Scene, PackReport]:
    """The scene as the graph sees it, of its own size: numpy leaves, no padding but absent agent slots.

    Args:
        raw: a checked scene.
        scene_size_m: side of the square around the centre in which segments, starts and goals must lie (bounds included).
        centre: "sdc": the recording car at the current step; "mean": of all points of polylines with two points or more (SceneFactory).
        gap_m: longer steps between two points of a lane, line or edge are gaps, not segments (SceneFactory).
        agents, require_agents: slots, for the cars nearest to the centre; whether a scene in which none is left is refused.
        min_travel_m: a car whose goal is not farther than that from its start is no agent.
        car_size_m: length and width of every car; null: as logged.
        start_speed: "logged": along the heading, never backwards; "zero".
        log_from: first step of the packed log: the recording's first, or the current one.
        traffic: most of those who are no agents and in the box at some step from the current one on, nearest to an agent's start first.
        min_traffic_size_m: shortest and narrowest that they may be.
        outline_m: longest segment of a polygon's outline (crosswalk, speed bump, driveway).

    Raises:
        Unpackable: no lane segment in the box, or no agent where one is required.
        ConfigError: a number that makes no sense.
    """
    _check(scene_size_m, car_size_m, traffic, outline_m)
    (origin, centred_on), half = _centre(raw, centre), scene_size_m / 2
    road, cut, relief = _segments(raw, origin, half, gap_m, outline_m)
    _require_lane(raw, road, f"{half:g} m of {np.round(origin, 2).tolist()} ({centred_on}); cut: {cut}")
    logs = _around(stack_tracks(raw.tracks, len(raw.times)), origin)
    chosen, dropped = _choose(raw, logs, half, min_travel_m, agents, car_size_m)
    if require_agents and not chosen:
        raise Unpackable("no_agent_left", f"{raw.source}: tracks: no agent is left of {len(raw.tracks)}: {_reasons(dropped)}")
    first = raw.current if log_from == "current" else 0
    leaves = columns.with_subsets(road) | _agents(chosen, logs, raw.current, agents, car_size_m, start_speed)
    leaves |= _log(chosen, logs, raw, first, agents) | {"weather.film_mm": np.zeros(()), "weather.surface": np.zeros(())}
    beside, traffic_dropped = _others(raw, logs, chosen, leaves, half, first, traffic, min_traffic_size_m)
    report = PackReport(
        name=raw.name,
        source=raw.source,
        centre=(float(origin[0]), float(origin[1]), float(origin[2])),
        centred_on=centred_on,
        steps=len(raw.times) - first,
        current=raw.current - first,
        track_ids=tuple(raw.tracks[i].id for i in chosen),
        agents_kept=len(chosen),
        agents_dropped=dropped,
        traffic_kept=len(beside["traffic_log.kind"]),
        traffic_dropped=traffic_dropped,
        segments_kept=len(road["road.kind"]),
        segments_cut=cut,
        relief_m=relief,
        metadata=dict(raw.metadata),
    )
    return _scene(leaves | beside), report


def _scene(leaves: dict[str, np.ndarray]) -> Scene:
    """The struct of these columns, in their types."""
    return columns.assemble_columns(Scene, {name: np.asarray(leaf, columns.COLUMNS[name].dtype) for name, leaf in leaves.items()})


def _check(scene_size_m: float, car_size_m: list[float] | None, traffic: int, outline_m: float) -> None:
    """Refuse numbers that make no sense."""
    check_number(scene_size_m, where="scenes.pack.scene_size_m", above=0)
    check_number(outline_m, where="scenes.pack.outline_m", above=0)
    if car_size_m is not None and not (len(car_size_m) == 2 and min(car_size_m) > 0):
        raise ConfigError(f"scenes.pack.car_size_m: {car_size_m}; wanted are length and width, both above 0, or null")
    check_number(traffic, where="scenes.pack.traffic", least=0)


def _around(logs: Logs, origin: Float[np.ndarray, "3"]) -> Logs:
    """The same tracks, in the plane around the scene's centre."""
    return logs._replace(xyz=logs.xyz - np.array([origin[0], origin[1], 0.0]))


def _require_lane(raw: RawScene, road: dict[str, np.ndarray], place: str) -> None:
    if not np.isin(road["road.kind"], DRIVABLE).any():
        raise Unpackable("no_lane_in_box", f"{raw.source}: roads: no driving lane within {place}")


def _reasons(dropped: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count) or "no tracks"


def _centre(raw: RawScene, wanted: str) -> tuple[Float[np.ndarray, "3"], str]:
    """Where the scene's zero lies, and what it was taken from."""
    reason = ""
    if wanted == "sdc":
        if raw.sdc is None:
            reason = ": the source names no sdc"
        elif not raw.tracks[raw.sdc].valid[raw.current]:
            reason = ": the sdc is absent at the current step"
        else:
            return raw.tracks[raw.sdc].xyz[raw.current].copy(), "sdc"
    return np.concatenate([line.xyz for line in raw.roads if len(line.xyz) >= 2]).mean(axis=0), f"mean{reason}"


def _segments(
    raw: RawScene, origin: Float[np.ndarray, "3"], half: float, gap_m: float, outline_m: float
) -> tuple[dict[str, np.ndarray], dict[str, int], float]:
    """Columns of `road` in storage order, the count of segments cut by reason, and the heights' range."""
    order = sorted((i for i, line in enumerate(raw.roads) if len(line.xyz) >= 2), key=lambda i: raw.roads[i].kind)  # stable
    xyz, bounds = join_lines([_outlined(raw.roads[i], outline_m) for i in order])
    kind = np.array([raw.roads[i].kind for i in order], int)
    x, y = xyz[:, 0] - origin[0], xyz[:, 1] - origin[1]
    along_x, along_y = np.diff(x), np.diff(y)
    length = np.sqrt(along_x * along_x + along_y * along_y)
    joints = np.ones(len(length), bool)
    joints[bounds[1:-1] - 1] = False  # from a line's last point to the next one's first
    within = (np.abs(x) <= half) & (np.abs(y) <= half)
    inside = within[1:] & within[:-1]
    outline = np.repeat(np.isin(kind, POLYGONS), np.diff(bounds))[:-1]
    degenerate, gap = length <= DEGENERATE_M, (length > gap_m) & ~outline
    kept = joints & inside & ~degenerate & ~gap
    masks = (~inside, inside & gap, inside & degenerate)
    cut = {reason: int((joints & mask).sum()) for reason, mask in zip(CUTS, masks, strict=True)}
    rows = np.flatnonzero(kept)
    line = np.repeat(np.arange(len(order)), np.diff(bounds))[rows]
    arc = np.zeros(len(length))
    for number in np.flatnonzero(np.bincount(line)).tolist():  # sums start anew with each line
        span = slice(bounds[number], bounds[number + 1] - 1)
        np.cumsum(length[span], out=arc[span])
    own = length[rows]
    road = {
        "midpoint": np.stack([(x[rows + 1] + x[rows]) / 2, (y[rows + 1] + y[rows]) / 2], axis=1),
        "direction": np.stack([along_x[rows] / own, along_y[rows] / own], axis=1),
        "half_length": own / 2,
        "arc": arc[rows] - own / 2,
        "kind": kind[line],
        "polyline": np.array(order)[line],
    }
    return _road(road), cut, float(np.ptp(xyz[rows + 1, 2])) if len(rows) else 0.0


def _outlined(line: Polyline, outline_m: float) -> Polyline:
    """A polygon with its side from the last point to the first, in segments of at most `outline_m`; other lines as they are."""
    if line.kind not in POLYGONS:
        return line
    xyz = line.xyz
    if len(xyz) > 2 and np.hypot(*(xyz[-1, :2] - xyz[0, :2])) > DEGENERATE_M:
        xyz = np.concatenate([xyz, xyz[:1]])
    return replace(line, xyz=densify(xyz, outline_m))


def _road(leaves: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of `road`, all of them valid."""
    road = {f"road.{name}": leaf.astype(columns.COLUMNS[f"road.{name}"].dtype) for name, leaf in leaves.items()}
    return road | {"road.valid": np.ones(len(road["road.kind"]), bool)}


def _choose(
    raw: RawScene, logs: Logs, half: float, min_travel_m: float, slots: int, car_size_m: list[float] | None
) -> tuple[list[int], dict[str, int]]:
    """Indices of the tracks that become agents, nearest to the centre first, and the others counted by reason."""
    current = raw.current
    everybody, last = np.arange(len(logs.valid)), logs.valid.shape[1] - 1 - np.argmax(logs.valid[:, ::-1], axis=1)
    start, goal = logs.xyz[:, current, :2], logs.xyz[everybody, last, :2]
    objections = {
        "not_a_vehicle": np.array([track.kind != "vehicle" for track in raw.tracks], bool),
        "absent_at_start": ~logs.valid[:, current],
        "start_outside_box": np.abs(start).max(axis=1) > half,
        "goal_outside_box": np.abs(goal).max(axis=1) > half,
        "too_short": np.hypot(*(goal - start).T) <= min_travel_m,
    }
    dropped, candidates = dict.fromkeys(DROPS, 0), np.ones(len(everybody), bool)
    for reason, objection in objections.items():  # the first one counts
        dropped[reason] = int((candidates & objection).sum())
        candidates &= ~objection
    rows = np.flatnonzero(candidates)
    rows = rows[np.argsort(np.hypot(*start[rows].T), kind="stable")]
    size = np.tile(car_size_m, (len(rows), 1)) if car_size_m else logs.size[rows, :2]
    boxes = box_corners(start[rows], logs.yaw[rows, current], size[:, 0], size[:, 1])
    near = _near(start[rows], size, start[rows], size)
    kept: list[int] = []
    for candidate in range(len(rows)):
        rivals = [other for other in kept if near[candidate, other]]
        if rivals and overlaps(boxes[candidate], boxes[rivals]).any():
            dropped["overlaps"] += 1
        elif len(kept) == slots:
            dropped["over_capacity"] += 1
        else:
            kept.append(candidate)
    return rows[kept].tolist(), dropped


def _near(
    one: Float[np.ndarray, "N 2"], size: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"], others_size: Float[np.ndarray, "M 2"]
) -> Bool[np.ndarray, "N M"]:
    """Whether the circles around boxes touch: boxes apart from that need no test."""
    reach = segment_lengths(size)[:, None] / 2 + segment_lengths(others_size) / 2
    return segment_lengths(one[:, None] - other) <= reach + DEGENERATE_M


def box_corners(
    centre: Float[np.ndarray, "*N 2"],
    yaw: float | Float[np.ndarray, "*N"],
    length: float | Float[np.ndarray, "*N"],
    width: float | Float[np.ndarray, "*N"],
) -> Float[np.ndarray, "*N 4 2"]:
    """Corners of oriented boxes, counter-clockwise."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = np.stack([cos * length / 2, sin * length / 2], axis=-1)
    across = np.stack([-sin * width / 2, cos * width / 2], axis=-1)
    return centre[..., None, :] + np.stack([along - across, along + across, -along + across, -along - across], axis=-2)


def overlaps(box: Float[np.ndarray, "*#N 4 2"], others: Float[np.ndarray, "N 4 2"]) -> Bool[np.ndarray, " N"]:
    """Whether a box, or each of as many, shares area with each of the others: no side separates them (separating axis theorem)."""
    separated = np.zeros(len(others), bool)
    own = np.broadcast_to(box, others.shape)
    for sides in (own, others):
        axes = sides[:, 1:3] - sides[:, 0:2]  # two neighbouring sides: their directions are the normals of all four
        first, second = np.einsum("nad,npd->nap", axes, own), np.einsum("nad,npd->nap", axes, others)
        separated |= ((first.max(2) <= second.min(2)) | (second.max(2) <= first.min(2))).any(axis=1)
    return ~separated


def _agents(
    chosen: list[int], logs: Logs, current: int, slots: int, car_size_m: list[float] | None, start_speed: str
) -> dict[str, np.ndarray]:
    """Columns of `agents`. Absent slots hold zeros, and a size so that nobody divides by zero."""
    rows = {name: np.zeros((slots, 2)) for name in ("position", "goal")}
    rows |= {name: np.zeros(slots) for name in ("yaw", "speed", "route_length")}
    sizes = np.tile(car_size_m, (len(chosen), 1)) if car_size_m else logs.size[chosen, :2]
    absent = car_size_m or (sizes.mean(axis=0) if len(sizes) else np.ones(2))
    size = np.concatenate([sizes.reshape(-1, 2), np.tile(absent, (slots - len(chosen), 1))])
    for slot, index in enumerate(chosen):
        path = logs.xyz[index, current:][logs.valid[index, current:], :2]
        yaw = logs.yaw[index, current]
        along = float(logs.velocity[index, current] @ np.array([np.cos(yaw), np.sin(yaw)]))
        rows["position"][slot], rows["goal"][slot], rows["yaw"][slot] = path[0], path[-1], wrap_angles(yaw)
        rows["speed"][slot] = max(along, 0.0) if start_speed == "logged" else 0.0
        rows["route_length"][slot] = max(segment_lengths(np.diff(path, axis=0)).sum(), np.linalg.norm(path[-1] - path[0]))
    present = np.arange(slots) < len(chosen)
    return {f"agents.{name}": leaf for name, leaf in (rows | {"size": size, "present": present}).items()}


def _log(chosen: list[int], logs: Logs, raw: RawScene, first: int, slots: int) -> dict[str, np.ndarray]:
    """Columns of `log`."""
    step = np.median(np.diff(raw.times)) if len(raw.times) > 1 else 1.0
    return {f"log.{name}": leaf for name, leaf in _recording(chosen, logs, first, slots).items()} | {"log.dt": np.asarray(step)}


def _recording(chosen: list[int], logs: Logs, first: int, slots: int) -> dict[str, np.ndarray]:
    """What tracks did from a step on, in so many slots: zeros where the recording has nothing."""
    valid = logs.valid[chosen, first:]
    rows = {
        "position": np.where(valid[..., None], logs.xyz[chosen, first:, :2], 0.0),
        "velocity": np.where(valid[..., None], logs.velocity[chosen, first:], 0.0),
        "yaw": np.where(valid, wrap_angles(logs.yaw[chosen, first:]), 0.0),
        "valid": valid,
    }
    return {name: np.concatenate([leaf, np.zeros((slots - len(chosen), *leaf.shape[1:]), leaf.dtype)]) for name, leaf in rows.items()}


def _choose_others(
    logs: Logs, agents: list[int], leaves: dict[str, np.ndarray], current: int, half: float, limit: int, least: float
) -> tuple[list[int], dict[str, int]]:
    """Indices of the tracks that become others, nearest to an agent's start (without agents: to the centre) first, and the rest by reason.

    Whose box overlaps an agent's at the start is left out: the two would burst apart.
    """
    place, yaw, size = (leaves[f"agents.{name}"][leaves["agents.present"]] for name in ("position", "yaw", "size"))
    boxes, starts = box_corners(place, yaw, size[:, 0], size[:, 1]), place if len(place) else np.zeros((1, 2))
    rest = np.setdiff1d(np.arange(len(logs.valid)), agents)
    now, path = logs.valid[rest, current:], logs.xyz[rest, current:, :2]
    inside = now & (np.abs(path) <= half).all(axis=2)
    own = np.maximum(logs.size[rest, :2], least)
    absent, outside = ~now.any(axis=1), ~inside.any(axis=1)
    touching = np.zeros(len(rest), bool)
    near = _near(path[:, 0], own, place, size) & (now[:, 0] & ~outside)[:, None]
    for row in np.flatnonzero(near.any(axis=1)).tolist():
        box = box_corners(path[row, 0], logs.yaw[rest[row], current], own[row, 0], own[row, 1])
        touching[row] = overlaps(box, boxes[near[row]]).any()
    kept = np.flatnonzero(~outside & ~touching)
    aside, ahead = (path[kept, :, axis, None] - starts[:, axis] for axis in (0, 1))
    squared = (aside * aside + ahead * ahead).min(axis=2)
    distance = np.sqrt(np.where(inside[kept], squared, np.inf).min(axis=1, initial=np.inf))
    order = rest[kept[np.argsort(distance, kind="stable")]].tolist()
    dropped = {
        "absent_from_start_on": int(absent.sum()),
        "outside_box": int((outside & ~absent).sum()),
        "overlaps_agent": int(touching.sum()),
        "over_capacity": max(len(order) - limit, 0),
    }
    return order[:limit], dropped


def _others(
    raw: RawScene, logs: Logs, agents: list[int], leaves: dict[str, np.ndarray], half: float, first: int, limit: int, least: float
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Columns of `traffic_log`, and who was left out, by reason."""
    chosen, dropped = _choose_others(logs, agents, leaves, raw.current, half, limit, least)
    rows = _recording(chosen, logs, first, len(chosen))
    rows["size"] = np.maximum(logs.size[chosen, :2], least)
    rows["kind"] = np.array([ROAD_USERS.index(raw.tracks[i].kind) for i in chosen], int)
    return {f"traffic_log.{name}": leaf for name, leaf in rows.items()}, dropped
