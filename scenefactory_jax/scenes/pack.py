"""RawScene -> Scene: which part of the map, which cars and who else, in float32 metres around the scene's centre.

Nothing disappears silently: the report counts what was kept and what was dropped, by reason.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.scenes import columns
from scenefactory_jax.scenes.raw import RawScene, SceneError, Track
from scenefactory_jax.types import DRIVABLE, ROAD_USERS, Scene

DEGENERATE_M = 1e-6  # shorter segments have no direction
DROPS: tuple[str, ...] = (
    "not_a_vehicle", "absent_at_start", "start_outside_box", "goal_outside_box", "too_short", "overlaps", "over_capacity",
)  # fmt: skip
OTHER_DROPS: tuple[str, ...] = ("absent_from_start_on", "outside_box", "overlaps_agent", "over_capacity")
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
    others_kept: int  # everybody who is no agent is counted here or in the next
    others_dropped: dict[str, int]  # reason -> count, every reason of OTHER_DROPS
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
    box_m: float,
    centre: Literal["sdc", "mean"],
    gap_m: float,
    agents: int,
    min_travel_m: float,
    car_size_m: list[float] | None,
    start_speed: Literal["logged", "zero"],
    log_from: Literal["start", "current"],
    require_agents: bool,
    others: int,
    others_least_m: float,
) -> tuple[Scene, PackReport]:
    """The scene as the graph sees it, of its own size: numpy leaves, no padding but absent agent slots.

    Args:
        raw: a checked scene.
        box_m: side of the square around the centre in which segments, starts and goals must lie (bounds included).
        centre: "sdc": the recording car at the current step; "mean": of all points of polylines with two points or more (facts 4.3).
        gap_m: longer steps between two points of a polyline are gaps, not segments (facts 4.4).
        agents: slots. Cars are taken nearest to the centre first.
        min_travel_m: a car whose goal is not farther than that from its start is no agent.
        car_size_m: length and width of every car; null: as logged.
        start_speed: "logged": along the heading, never backwards; "zero".
        log_from: first step of the packed log: the recording's first, or the current one.
        require_agents: refuse a scene in which no agent is left.
        others: most of those who are no agents and in the box at some step from the current one on, nearest to an agent's start first.
        others_least_m: shortest and narrowest that they may be.

    Raises:
        SceneError: no lane segment in the box, or no agent where one is required.
    """
    origin, centred_on = _centre(raw, centre)
    half = box_m / 2
    road, cut, relief = _segments(raw, origin, half, gap_m)
    _require_lane(raw, road, f"{half:g} m of {np.round(origin, 2).tolist()} ({centred_on}); cut: {cut}")
    chosen, dropped = _choose(raw, origin, half, min_travel_m, agents, car_size_m)
    if require_agents and not chosen:
        raise SceneError(f"{raw.source}: tracks: no agent is left of {len(raw.tracks)}: {_reasons(dropped) or 'no tracks'}")
    first = raw.current if log_from == "current" else 0
    tracks = [raw.tracks[i] for i in chosen]
    leaves = columns.with_subsets(road) | _agents(tracks, raw, origin, agents, car_size_m, start_speed)
    leaves |= _log(tracks, raw, origin, agents, first) | {"weather.film_mm": np.zeros(()), "weather.surface": np.zeros(())}
    beside, others_dropped = _others(raw, chosen, leaves, origin, half, first, others, others_least_m)
    leaves |= beside
    report = PackReport(
        name=raw.name,
        source=raw.source,
        centre=(float(origin[0]), float(origin[1]), float(origin[2])),
        centred_on=centred_on,
        steps=len(raw.times) - first,
        current=raw.current - first,
        track_ids=tuple(track.id for track in tracks),
        agents_kept=len(tracks),
        agents_dropped=dropped,
        others_kept=len(beside["others.kind"]),
        others_dropped=others_dropped,
        segments_kept=len(road["road.kind"]),
        segments_cut=cut,
        relief_m=relief,
        metadata=dict(raw.metadata),
    )
    return columns.assemble(Scene, {name: np.asarray(leaf, columns.COLUMNS[name].dtype) for name, leaf in leaves.items()}), report


def _require_lane(raw: RawScene, road: dict[str, np.ndarray], place: str) -> None:
    if not np.isin(road["road.kind"], DRIVABLE).any():
        raise SceneError(f"{raw.source}: roads: no driving lane within {place}")


def _reasons(dropped: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)


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
    raw: RawScene, origin: Float[np.ndarray, "3"], half: float, gap_m: float
) -> tuple[dict[str, np.ndarray], dict[str, int], float]:
    """Columns of `road` in storage order, the count of segments cut by reason, and the heights' range."""
    order = sorted((i for i, line in enumerate(raw.roads) if len(line.xyz) >= 2), key=lambda i: raw.roads[i].kind)  # stable
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("midpoint", "direction", "half_length", "arc", "kind", "polyline")}
    cut, heights = dict.fromkeys(CUTS, 0), [np.zeros(0)]
    for index in order:
        line = raw.roads[index]
        points = line.xyz[:, :2] - origin[:2]
        delta = np.diff(points, axis=0)
        length = np.linalg.norm(delta, axis=1)
        within = np.abs(points).max(axis=1) <= half
        inside = within[1:] & within[:-1]
        degenerate, gap = length <= DEGENERATE_M, length > gap_m
        kept = inside & ~degenerate & ~gap
        for reason, mask in zip(CUTS, (~inside, inside & gap, inside & degenerate), strict=True):
            cut[reason] += int(mask.sum())
        rows["midpoint"].append(((points[1:] + points[:-1]) / 2)[kept])
        rows["direction"].append(delta[kept] / length[kept, None])
        rows["half_length"].append(length[kept] / 2)
        rows["arc"].append((np.cumsum(length) - length / 2)[kept])
        rows["kind"].append(np.full(kept.sum(), line.kind))
        rows["polyline"].append(np.full(kept.sum(), index))
        heights.append(line.xyz[1:][kept, 2])
    road = {f"road.{name}": np.concatenate(parts) for name, parts in rows.items()}
    road = {name: leaf.astype(columns.COLUMNS[name].dtype) for name, leaf in road.items()}
    road["road.valid"] = np.ones(len(road["road.kind"]), bool)
    height = np.concatenate(heights)
    return road, cut, float(np.ptp(height)) if len(height) else 0.0


def _choose(
    raw: RawScene, origin: Float[np.ndarray, "3"], half: float, min_travel_m: float, slots: int, car_size_m: list[float] | None
) -> tuple[list[int], dict[str, int]]:
    """Indices of the tracks that become agents, nearest to the centre first, and the others counted by reason."""
    dropped, candidates = dict.fromkeys(DROPS, 0), []
    for index, track in enumerate(raw.tracks):
        if reason := _objection(track, raw.current, origin, half, min_travel_m):
            dropped[reason] += 1
        else:
            start = track.xyz[raw.current, :2] - origin[:2]
            candidates.append((float(np.hypot(*start)), index))
    kept: list[int] = []
    boxes = np.zeros((0, 4, 2))
    for _, index in sorted(candidates):
        track = raw.tracks[index]
        length, width = car_size_m or track.size[:2]
        box = corners(track.xyz[raw.current, :2] - origin[:2], track.yaw[raw.current], length, width)
        if overlaps(box, boxes).any():
            dropped["overlaps"] += 1
        elif len(kept) == slots:
            dropped["over_capacity"] += 1
        else:
            kept.append(index)
            boxes = np.concatenate([boxes, box[None]])
    return kept, dropped


def _objection(track: Track, current: int, origin: Float[np.ndarray, "3"], half: float, min_travel_m: float) -> str | None:
    """Why a track is no agent; None if it may be one."""
    if track.kind != "vehicle":
        return "not_a_vehicle"
    if not track.valid[current]:
        return "absent_at_start"
    start, goal = track.xyz[current, :2] - origin[:2], track.xyz[_last(track), :2] - origin[:2]
    if np.abs(start).max() > half:
        return "start_outside_box"
    if np.abs(goal).max() > half:
        return "goal_outside_box"
    return "too_short" if np.hypot(*(goal - start)) <= min_travel_m else None


def _last(track: Track) -> int:
    """The last valid step."""
    return int(np.flatnonzero(track.valid)[-1])


def corners(centre: Float[np.ndarray, "2"], yaw: float, length: float, width: float) -> Float[np.ndarray, "4 2"]:
    """Corners of an oriented box, counter-clockwise."""
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    along, across = forward * length / 2, np.array([-forward[1], forward[0]]) * width / 2
    return centre + np.stack([along - across, along + across, -along + across, -along - across])


def overlaps(box: Float[np.ndarray, "4 2"], others: Float[np.ndarray, "N 4 2"]) -> Bool[np.ndarray, " N"]:
    """Whether a box shares area with each of the others: no side of either separates them (separating axis theorem)."""
    separated = np.zeros(len(others), bool)
    own = np.broadcast_to(box, others.shape)
    for sides in (own, others):
        axes = sides[:, 1:3] - sides[:, 0:2]  # two neighbouring sides: their directions are the normals of all four
        first, second = np.einsum("nad,npd->nap", axes, own), np.einsum("nad,npd->nap", axes, others)
        separated |= ((first.max(2) <= second.min(2)) | (second.max(2) <= first.min(2))).any(axis=1)
    return ~separated


def _agents(
    tracks: list[Track], raw: RawScene, origin: Float[np.ndarray, "3"], slots: int, car_size_m: list[float] | None, start_speed: str
) -> dict[str, np.ndarray]:
    """Columns of `agents`. Absent slots hold zeros, and a size so that nobody divides by zero."""
    rows = {name: np.zeros((slots, 2)) for name in ("position", "goal")} | {name: np.zeros(slots) for name in ("yaw", "speed", "route")}
    sizes = np.array([car_size_m or track.size[:2] for track in tracks], float).reshape(-1, 2)
    absent = car_size_m or (sizes.mean(axis=0) if len(sizes) else np.ones(2))
    size = np.concatenate([sizes, np.tile(absent, (slots - len(tracks), 1))])
    for slot, track in enumerate(tracks):
        path = track.xyz[raw.current :][track.valid[raw.current :], :2] - origin[:2]
        yaw = track.yaw[raw.current]
        along = float(track.velocity[raw.current] @ np.array([np.cos(yaw), np.sin(yaw)]))
        rows["position"][slot], rows["goal"][slot], rows["yaw"][slot] = path[0], path[-1], _wrap(yaw)
        rows["speed"][slot] = max(along, 0.0) if start_speed == "logged" else 0.0
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        rows["route"][slot] = max(length, np.linalg.norm(path[-1] - path[0]))
    present = np.arange(slots) < len(tracks)
    return {f"agents.{name}": leaf for name, leaf in (rows | {"size": size, "present": present}).items()}


def _log(tracks: list[Track], raw: RawScene, origin: Float[np.ndarray, "3"], slots: int, first: int) -> dict[str, np.ndarray]:
    """Columns of `log`: zeros where the recording has nothing."""
    step = np.median(np.diff(raw.times)) if len(raw.times) > 1 else 1.0
    rows = _recording(tracks, raw, origin, slots, first)
    return {f"log.{name}": leaf for name, leaf in rows.items()} | {"log.dt": np.asarray(step)}


def _recording(
    tracks: list[Track], raw: RawScene, origin: Float[np.ndarray, "3"], slots: int, first: int
) -> dict[str, np.ndarray]:
    """What tracks did from a step on, in so many slots: zeros where the recording has nothing."""
    steps = len(raw.times) - first
    rows = {name: np.zeros((slots, steps, 2)) for name in ("position", "velocity")}
    rows |= {"yaw": np.zeros((slots, steps)), "valid": np.zeros((slots, steps), bool)}
    for slot, track in enumerate(tracks):
        valid = track.valid[first:]
        rows["valid"][slot] = valid
        rows["position"][slot][valid] = track.xyz[first:][valid, :2] - origin[:2]
        rows["yaw"][slot][valid] = _wrap(track.yaw[first:][valid])
        rows["velocity"][slot][valid] = track.velocity[first:][valid]
    return rows


def _choose_others(
    raw: RawScene, agents: list[int], leaves: dict[str, np.ndarray], origin: Float[np.ndarray, "3"], half: float, limit: int, least: float
) -> tuple[list[int], dict[str, int]]:
    """Indices of the tracks that become others, nearest to an agent's start (without agents: to the centre) first, and the rest by reason.

    Whose box overlaps an agent's at the start is left out: the two would burst apart.
    """
    rows = [leaves[f"agents.{name}"][leaves["agents.present"]] for name in ("position", "yaw", "size")]
    boxes = np.array([corners(place, float(yaw), *size) for place, yaw, size in zip(*rows, strict=True)]).reshape(-1, 4, 2)
    starts = rows[0] if len(rows[0]) else np.zeros((1, 2))
    dropped, candidates = dict.fromkeys(OTHER_DROPS, 0), []
    for index in sorted(set(range(len(raw.tracks))) - set(agents)):
        track = raw.tracks[index]
        now = track.valid[raw.current :]
        path = track.xyz[raw.current :, :2] - origin[:2]
        inside = now & (np.abs(path).max(axis=1) <= half)
        length, width = np.maximum(track.size[:2], least)
        if not now.any():
            dropped["absent_from_start_on"] += 1
        elif not inside.any():
            dropped["outside_box"] += 1
        elif now[0] and overlaps(corners(path[0], track.yaw[raw.current], length, width), boxes).any():
            dropped["overlaps_agent"] += 1
        else:
            near = np.linalg.norm(path[inside][:, None] - starts, axis=2).min()
            candidates.append((float(near), index))
    kept = [index for _, index in sorted(candidates)]
    dropped["over_capacity"] = max(len(kept) - limit, 0)
    return kept[:limit], dropped


def _others(
    raw: RawScene,
    agents: list[int],
    leaves: dict[str, np.ndarray],
    origin: Float[np.ndarray, "3"],
    half: float,
    first: int,
    limit: int,
    least: float,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Columns of `others`, and who was left out, by reason."""
    chosen, dropped = _choose_others(raw, agents, leaves, origin, half, limit, least)
    tracks = [raw.tracks[i] for i in chosen]
    rows = _recording(tracks, raw, origin, len(tracks), first)
    rows["size"] = np.maximum(np.array([track.size[:2] for track in tracks], float).reshape(-1, 2), least)
    rows["kind"] = np.array([ROAD_USERS.index(track.kind) for track in tracks], int)
    return {f"others.{name}": leaf for name, leaf in rows.items()}, dropped


def _wrap(angle: Any) -> Any:
    """The same angle in [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi
