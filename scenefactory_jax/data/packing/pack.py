"""RawScene -> Scene: a square of the map, agents and background traffic, in float32 metres around the scene's centre.

The report counts what was kept and what was dropped, by reason.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Unpackable
from scenefactory_jax.core.scene_arrays import Logs, join_points, segment_lengths, stack_tracks, wrap_angles
from scenefactory_jax.core.schema import Bounds, ConfigError, Positive
from scenefactory_jax.core.types import DRIVABLE, POLYGONS, ROAD_USERS, Elevation, Scene
from scenefactory_jax.data.formats.polylines import densify
from scenefactory_jax.data.packing import columns, control_columns, drawn_starts, elevation_grid, route_columns, route_conflicts
from scenefactory_jax.data.packing.control_columns import ControlsConfig
from scenefactory_jax.data.packing.drawn_starts import Conflicts, find_conflicts
from scenefactory_jax.data.packing.elevation_grid import ElevationConfig
from scenefactory_jax.data.packing.leaving import find_leaving
from scenefactory_jax.data.packing.route_columns import RouteConfig, RouteCounts

DEGENERATE_M = 1e-6  # shorter segments have no direction
DROPS: tuple[str, ...] = (
    "not_a_vehicle", "absent_at_start", "start_outside_box", "goal_outside_box", "too_short", "no_conflict", "overlaps", "over_capacity",
)  # fmt: skip
TRAFFIC_DROPS: tuple[str, ...] = ("absent_from_start_on", "outside_box", "overlaps_agent", "over_capacity")
REFUSALS: tuple[str, ...] = ("no_lane_in_box", "no_agent_left", "levels")  # why a scene is not packed
CUTS: tuple[str, ...] = ("outside_box", "gap", "degenerate")


@dataclass(frozen=True)
class PackReport:
    """Counts of one packed scene, and what the tensors do not hold of its source."""

    name: str
    source: str
    centre: tuple[float, float, float]  # of the scene, in the source's coordinates
    centred_on: str  # "sdc", "mean", or "mean: ..." with the reason why not on the SDC
    steps: int  # of the packed log
    current: int  # index in the packed log of the step at which the cars start
    track_ids: tuple[int, ...]  # of the agents, slot by slot
    traffic_ids: tuple[int, ...]  # of the background traffic, row by row
    agents_kept: int
    agents_dropped: dict[str, int]  # reason of DROPS -> count
    traffic_kept: int  # a track is an agent, or counted here or in the next
    traffic_dropped: dict[str, int]  # reason of TRAFFIC_DROPS -> count
    routes: RouteCounts | None  # None: packed without routes
    controls_kept: int  # lights and stop signs
    controls_dropped: dict[str, int]  # reason of CONTROL_DROPS -> count
    signs_inferred: int  # stop signs whose lanes were inferred
    segments_kept: int
    segments_cut: dict[str, int]  # reason of CUTS -> count
    relief_m: float  # height between the lowest and the highest kept road point
    repairs: tuple[str, ...] = ()
    metadata: dict[str, Any] = field(default_factory=dict)
    raw: RawScene | None = None  # the checked scene itself, where it is kept


class Packed(NamedTuple):
    """A scene of its own size, and its report."""

    scene: Scene
    report: PackReport


class BoxSet(NamedTuple):
    """Oriented boxes in the plane."""

    centre: Float[np.ndarray, "N 2"]
    yaw: Float[np.ndarray, " N"]
    size: Float[np.ndarray, "N 2"]  # length and width


def prepare(raw: RawScene, *, check: Callable[..., Any], pack: Callable[..., Any]) -> Packed:
    """Checks, then packs a scene, with functions that are bound to their numbers. The report holds what the check repaired.

    Raises:
        SceneError: a scene that cannot be used, by name.
    """
    checked, repairs = check(raw)
    scene, report = pack(checked)
    return Packed(scene, replace(report, repairs=(*report.repairs, *repairs)))


def pack(
    raw: RawScene,
    *,
    scene_size_m: Positive,
    centre: Literal["sdc", "mean"],
    gap_m: float,
    agents: int,
    min_travel_m: float,
    car_size_m: Annotated[list[float], Bounds(above=0)] | None,
    start_speed: Literal["logged", "zero"],
    log_from: Literal["start", "current"],
    require_agents: bool,
    traffic: Annotated[int, Bounds(min=0)],
    min_traffic_size_m: float,
    outline_m: Positive,
    routes: RouteConfig | None,
    starts: dict[str, Any] | None,
    conflicts: Conflicts | None,
    controls: ControlsConfig,
    elevation: ElevationConfig | None = None,  # runs of before have none
) -> tuple[Scene, PackReport]:
    """Packs a checked scene into numpy leaves of its own size, without padding but absent agent slots.

    The numbers are described in `conf/scenes/base.yaml`.

    Raises:
        Unpackable: no lane segment in the box, or no agent where one is required.
    """
    (origin, centred_on), half = _find_centre(raw, centre), scene_size_m / 2
    road, cut, relief = _segments(raw, origin, half, gap_m, outline_m, elevation)
    logs = stack_tracks(raw.tracks, len(raw.times))
    logs = logs._replace(xyz=logs.xyz - np.array([origin[0], origin[1], 0.0]))
    allowed = np.ones(len(raw.tracks), bool) if conflicts is None else find_conflicts(raw, logs, conflicts)
    slots = agents if starts is None else 0
    chosen, dropped = _choose_agents(raw, logs, half, min_travel_m, slots, car_size_m, allowed)
    if starts is None and require_agents and not chosen:
        raise Unpackable("no_agent_left", f"{raw.source}: tracks: no agent is left of {len(raw.tracks)}: {_list_drops(dropped)}")
    first = raw.current if log_from == "current" else 0
    leaves = columns.with_subsets(road) | _agents(chosen, logs, raw.current, agents, car_size_m, start_speed)
    leaves |= _recording("log", chosen, logs, first, agents) | {"weather.film_mm": np.zeros(()), "weather.surface": np.zeros(())}
    leaves["log.dt"] = np.median(np.diff(raw.times)) if len(raw.times) > 1 else np.ones(())
    beside, others, traffic_dropped = _traffic(raw, logs, chosen, leaves, half, first, traffic, min_traffic_size_m)
    stops = control_columns.pack_controls(raw, origin, half, controls)
    who = {"agents": chosen, "slots": agents, "traffic": others, "size": beside["traffic_log.size"], "road": road}
    added, counts = _routes(raw, logs, origin, half, **who, controls=stops.columns, config=routes)
    leaves |= beside | stops.columns | added
    if starts is not None:
        leaves |= drawn_starts.draw_agents(leaves, starts, row=raw.current - first, slots=agents, car_size_m=car_size_m)
    if require_agents and not leaves["agents.present"].any():
        raise Unpackable("no_agent_left", f"{raw.source}: roads: no room for a start of scenes.pack.starts")
    report = PackReport(
        **_describe_source(raw, origin, centred_on, first, agents=chosen, traffic=others),
        agents_kept=int(leaves["agents.present"].sum()),
        agents_dropped=dropped if starts is None else dict.fromkeys(DROPS, 0),
        traffic_kept=len(beside["traffic_log.kind"]),
        traffic_dropped=traffic_dropped,
        routes=counts,
        controls_kept=len(stops.columns["controls.lane"]),
        controls_dropped=stops.dropped,
        signs_inferred=stops.inferred,
        segments_kept=len(road["road.kind"]),
        segments_cut=cut,
        relief_m=relief,
    )
    heights = None if elevation is None else elevation_grid.fit_elevation(raw, origin, half, elevation)
    return _assemble(leaves, heights), report


def _assemble(leaves: dict[str, np.ndarray], elevation: Elevation | None) -> Scene:
    """The scene of these columns."""
    dtypes = {name: column.dtype for name, column in columns.columns_of(leaves).items()}
    scene = columns.assemble_columns(Scene, {name: np.asarray(leaf, dtypes[name]) for name, leaf in leaves.items()})
    return unchecked(Scene, **vars(scene) | {"elevation": elevation})


def _list_drops(dropped: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count) or "no tracks"


def _describe_source(
    raw: RawScene, origin: Float[np.ndarray, "3"], centred_on: str, first: int, *, agents: list[int], traffic: list[int]
) -> dict[str, Any]:
    """The entries of a report that say where a packed scene comes from."""
    return {
        "name": raw.name,
        "source": raw.source,
        "centre": (float(origin[0]), float(origin[1]), float(origin[2])),
        "centred_on": centred_on,
        "steps": len(raw.times) - first,
        "current": raw.current - first,
        "track_ids": tuple(raw.tracks[i].id for i in agents),
        "traffic_ids": tuple(raw.tracks[i].id for i in traffic),
        "metadata": dict(raw.metadata),
    }


def _routes(
    raw: RawScene, logs: Logs, *place: Any, slots: int, traffic: list[int], size: np.ndarray, road: dict[str, np.ndarray],
    config: RouteConfig | None, **who: Any,
) -> tuple[dict[str, np.ndarray], RouteCounts | None]:  # fmt: skip
    """Columns of the routes and their counts; without a config there are none."""
    if config is None:
        return route_columns.make_no_routes(slots, len(traffic)) | route_conflicts.make_no_zones(len(traffic)), None
    found, counts = route_columns.pack_routes(raw, logs, *place, slots=slots, traffic=traffic, config=config, **who)
    found |= route_columns.find_heights(road | found)
    return found | route_conflicts.find_zones(found | {"traffic_log.size": size}), counts


def _find_centre(raw: RawScene, centre: str) -> tuple[Float[np.ndarray, "3"], str]:
    """The origin of the packed scene, and what it was taken from."""
    reason = ""
    if centre == "sdc":
        if raw.sdc is None:
            reason = ": the source names no sdc"
        elif not raw.tracks[raw.sdc].valid[raw.current]:
            reason = ": the sdc is absent at the current step"
        else:
            return raw.tracks[raw.sdc].xyz[raw.current].copy(), "sdc"
    return np.concatenate([line.xyz for line in raw.roads if len(line.xyz) >= 2]).mean(axis=0), f"mean{reason}"


def _segments(
    raw: RawScene, origin: Float[np.ndarray, "3"], half: float, gap_m: float, outline_m: float, elevation: ElevationConfig | None
) -> tuple[dict[str, np.ndarray], dict[str, int], float]:
    """Columns of `road` in storage order, the count of segments cut by reason, and the heights' range."""
    order = sorted((i for i, line in enumerate(raw.roads) if len(line.xyz) >= 2), key=lambda i: raw.roads[i].kind)  # stable
    xyz, bounds = join_points([_close_outline(raw.roads[i], outline_m) for i in order])
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
    masks = (~inside, inside & gap, inside & degenerate)
    cut = {reason: int((joints & mask).sum()) for reason, mask in zip(CUTS, masks, strict=True)}
    rows = np.flatnonzero(joints & inside & ~degenerate & ~gap)
    line = np.repeat(np.arange(len(order)), np.diff(bounds))[rows]
    arc = np.zeros(len(length))
    for number in np.flatnonzero(np.bincount(line)).tolist():  # sums start anew with each line
        span = slice(bounds[number], bounds[number + 1] - 1)
        np.cumsum(length[span], out=arc[span])
    road = {
        "road.midpoint": np.stack([(x[rows + 1] + x[rows]) / 2, (y[rows + 1] + y[rows]) / 2], axis=1),
        "road.direction": np.stack([along_x[rows] / length[rows], along_y[rows] / length[rows]], axis=1),
        "road.half_length": length[rows] / 2,
        "road.arc": arc[rows] - length[rows] / 2,
        "road.kind": kind[line],
        "road.polyline": np.array(order)[line],
        "road.valid": np.ones(len(rows), bool),
    }
    if elevation is not None and elevation.levels > 1:
        road["road.height"] = (xyz[rows + 1, 2] + xyz[rows, 2]) / 2 - origin[2]
    if not np.isin(kind[line], DRIVABLE).any():
        place = f"{half:g} m of {np.round(origin, 2).tolist()}"
        raise Unpackable("no_lane_in_box", f"{raw.source}: roads: no driving lane within {place}; cut: {cut}")
    return road, cut, float(np.ptp(xyz[rows + 1, 2])) if len(rows) else 0.0


def _close_outline(line: Polyline, outline_m: float) -> Float[np.ndarray, "N 3"]:
    """The points of a polygon with its side from the last to the first, in segments of at most `outline_m`; of other lines as they are."""
    xyz = line.xyz
    if line.kind not in POLYGONS:
        return xyz
    if len(xyz) > 2 and np.hypot(*(xyz[-1, :2] - xyz[0, :2])) > DEGENERATE_M:
        xyz = np.concatenate([xyz, xyz[:1]])
    return densify(xyz, outline_m)


def _choose_agents(
    raw: RawScene, logs: Logs, half: float, min_travel_m: float, slots: int, car_size_m: list[float] | None, allowed: np.ndarray
) -> tuple[list[int], dict[str, int]]:
    """Indices of the allowed tracks that become agents, nearest to the centre first, and the others counted by reason."""
    if car_size_m is not None and len(car_size_m) != 2:
        raise ConfigError(f"scenes.pack.car_size_m: expected [length, width] or null, got {car_size_m}")
    current = raw.current
    tracks, last = np.arange(len(logs.valid)), logs.valid.shape[1] - 1 - np.argmax(logs.valid[:, ::-1], axis=1)
    start, goal = logs.xyz[:, current, :2], logs.xyz[tracks, last, :2]
    objections = {
        "not_a_vehicle": np.array([track.kind != "vehicle" for track in raw.tracks], bool),
        "absent_at_start": ~logs.valid[:, current],
        "start_outside_box": np.abs(start).max(axis=1) > half,
        "goal_outside_box": np.abs(goal).max(axis=1) > half,
        "too_short": np.hypot(*(goal - start).T) < min_travel_m,
        "no_conflict": ~allowed,
    }
    dropped, candidates = dict.fromkeys(DROPS, 0), np.ones(len(tracks), bool)
    for reason, objection in objections.items():  # the first one counts
        dropped[reason] = int((candidates & objection).sum())
        candidates &= ~objection
    rows = np.flatnonzero(candidates)
    rows = rows[np.argsort(np.hypot(*start[rows].T), kind="stable")]
    size = np.tile(car_size_m, (len(rows), 1)) if car_size_m else logs.size[rows, :2]
    boxes = BoxSet(start[rows], logs.yaw[rows, current], size)
    touching = _find_overlaps(boxes, boxes)
    kept: list[int] = []
    for candidate in range(len(rows)):
        if touching[candidate, kept].any():
            dropped["overlaps"] += 1
        elif len(kept) == slots:
            dropped["over_capacity"] += 1
        else:
            kept.append(candidate)
    return rows[kept].tolist(), dropped


def _traffic(
    raw: RawScene, logs: Logs, agents: list[int], leaves: dict[str, np.ndarray], half: float, first: int, limit: int, min_size_m: float
) -> tuple[dict[str, np.ndarray], list[int], dict[str, int]]:
    """Columns of `traffic_log` and its tracks, nearest to an agent's start (without agents: to the centre) first; the others by reason.

    A box that overlaps an agent's at the start is left out: the contact would throw both apart.
    """
    current = raw.current
    starts = BoxSet(*(leaves[f"agents.{name}"][leaves["agents.present"]] for name in ("position", "yaw", "size")))
    rest = np.setdiff1d(np.arange(len(logs.valid)), agents)
    valid, path = logs.valid[rest, current:], logs.xyz[rest, current:, :2]
    inside = valid & (np.abs(path) <= half).all(axis=2)
    absent, outside = ~valid.any(axis=1), ~inside.any(axis=1)
    boxes = BoxSet(path[:, 0], logs.yaw[rest, current], np.maximum(logs.size[rest, :2], min_size_m))
    touching = valid[:, 0] & ~outside & _find_overlaps(boxes, starts).any(axis=1)
    kept = np.flatnonzero(~outside & ~touching)
    places = starts.centre if len(starts.centre) else np.zeros((1, 2))
    along_x, along_y = (path[kept, :, axis, None] - places[:, axis] for axis in (0, 1))
    squared = (along_x * along_x + along_y * along_y).min(axis=2)
    distance = np.sqrt(np.where(inside[kept], squared, np.inf).min(axis=1, initial=np.inf))
    order = rest[kept[np.argsort(distance, kind="stable")]].tolist()
    chosen = order[:limit]
    dropped = {
        "absent_from_start_on": int(absent.sum()),
        "outside_box": int((outside & ~absent).sum()),
        "overlaps_agent": int(touching.sum()),
        "over_capacity": max(len(order) - limit, 0),
    }
    rows = _recording("traffic_log", chosen, logs, first, len(chosen))
    rows["traffic_log.size"] = np.maximum(logs.size[chosen, :2], min_size_m)
    kinds = np.array([ROAD_USERS.index(track.kind) for track in raw.tracks], int)
    rows["traffic_log.kind"] = kinds[chosen]
    rows["traffic_log.leaves"] = find_leaving(logs, chosen, kinds == ROAD_USERS.index("vehicle"))
    return rows, chosen, dropped


def _find_overlaps(boxes: BoxSet, others: BoxSet) -> Bool[np.ndarray, "N M"]:
    """Whether each box shares area with each of the others; only boxes whose circumscribed circles touch are tested."""
    reach = segment_lengths(boxes.size)[:, None] / 2 + segment_lengths(others.size) / 2
    touching = segment_lengths(boxes.centre[:, None] - others.centre) <= reach + DEGENERATE_M
    first, second = np.nonzero(touching)
    corners, other_corners = (box_corners(box.centre, box.yaw, box.size[:, 0], box.size[:, 1]) for box in (boxes, others))
    touching[first, second] = overlaps(corners[first], other_corners[second])
    return touching


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
    boxes = np.broadcast_to(box, others.shape)
    for sides in (boxes, others):
        axes = sides[:, 1:3] - sides[:, 0:2]  # two neighbouring sides: their directions are the normals of all four
        first, second = np.einsum("nad,npd->nap", axes, boxes), np.einsum("nad,npd->nap", axes, others)
        separated |= ((first.max(2) <= second.min(2)) | (second.max(2) <= first.min(2))).any(axis=1)
    return ~separated


def _agents(
    chosen: list[int], logs: Logs, current: int, slots: int, car_size_m: list[float] | None, start_speed: str
) -> dict[str, np.ndarray]:
    """Columns of `agents`. Absent slots hold zeros, and a positive size, because sizes are divisors."""
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


def _recording(part: str, chosen: list[int], logs: Logs, first: int, slots: int) -> dict[str, np.ndarray]:
    """Columns of `log` or `traffic_log`: tracks from a step on, with zeros at invalid steps and in slots behind the last."""
    valid = logs.valid[chosen, first:]
    rows = {
        "position": np.where(valid[..., None], logs.xyz[chosen, first:, :2], 0.0),
        "velocity": np.where(valid[..., None], logs.velocity[chosen, first:], 0.0),
        "yaw": np.where(valid, wrap_angles(logs.yaw[chosen, first:]), 0.0),
        "valid": valid,
    }
    return {
        f"{part}.{name}": np.concatenate([leaf, np.zeros((slots - len(chosen), *leaf.shape[1:]), leaf.dtype)])
        for name, leaf in rows.items()
    }
