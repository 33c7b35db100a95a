"""The routes of a scene as columns: the agents' own and their alternatives, those of moving vehicles of the traffic, and drawn ones."""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.scene_arrays import Logs, segment_lengths
from scenefactory_jax.core.schema import Bounds, Count, Fraction, NonNegative, Positive, Range
from scenefactory_jax.core.types import DRIVABLE, ROUTE_SPACING_M
from scenefactory_jax.roadgraph import lane_graph, route_sets
from scenefactory_jax.roadgraph.route_sets import LaneMap, SampledRoute

FAR_M = 1e4  # larger than any scene
BEHIND_M = 10.0  # a stop place lies at most so far before the lane that its control governs


@dataclass(frozen=True)
class RouteConfig:
    """The key `routes` of `scenes.pack`, described in `conf/scenes/pack/routes/lanes.yaml`."""

    alternatives: Count  # routes of an agent
    length_m: Positive  # at which routes end
    max_distance_m: Positive  # of a track from the lanes of its route
    traffic: bool  # vehicles of the traffic that move have routes
    min_travel_m: NonNegative  # of these
    waiting_m: NonNegative  # from a lane's line: vehicles of the traffic that stand nearer wait there and have routes, too
    drawn: Annotated[int, Bounds(min=0)]
    drawn_length_m: Range
    turn_fraction: Fraction
    attempts: Count
    stop_distance_m: Positive  # of a stop place from the line of a route
    lanes: dict[str, Any]  # the config group `lanes`
    max_goal_distance_m: Positive = math.inf  # of an agent's goal from its route; runs of before there was the key have none


@dataclass(frozen=True)
class RouteCounts:
    """Counts of a scene's routes, for the report."""

    along_lanes: int  # routes of agents and of traffic that follow lanes
    along_log: int  # that are the logged track itself
    drawn: int
    links_rebuilt: bool  # the source has no links between lanes


def make_no_routes(agents: int, traffic: int) -> dict[str, np.ndarray]:
    """The columns of a scene without routes."""
    return _assemble([], [], 0, agents, traffic)


def pack_routes(
    raw: RawScene,
    logs: Logs,
    origin: Float[np.ndarray, "3"],
    half: float,
    *,
    agents: Sequence[int],
    slots: int,
    traffic: Sequence[int],
    controls: Mapping[str, np.ndarray],
    config: RouteConfig,
) -> tuple[dict[str, np.ndarray], RouteCounts]:
    """Packs the routes of a scene.

    Args:
        raw: checked.
        logs: of its tracks, around `origin`.
        half: half the side of the square at which routes end.
        agents, traffic: tracks that became agents and background traffic.
        slots: of agents.
        controls: columns of `controls`, whose stop places the routes pass.
    """
    entry = {"builtins": "scenefactory_jax.roadgraph.lane_topology", "where": "scenes.pack.routes.lanes.topology"}
    linked = instantiate(config.lanes["topology"], **entry)(raw)
    graph = lane_graph.make(linked.roads)
    graph = graph._replace(xyz=graph.xyz - np.array([origin[0], origin[1], 0.0]))
    lanes = route_sets.make_lane_map(graph)
    found: list[SampledRoute] = []
    owner: list[int] = []
    first = np.zeros(len(raw.tracks), int)  # row of the first route of each track
    routed = np.zeros(len(raw.tracks), bool)
    vehicles = [index for index in traffic if config.traffic and raw.tracks[index].kind == "vehicle"]
    for slot, index in [*enumerate(agents), *((-1, index) for index in vehicles)]:
        if slot < 0 and not _is_moving(raw, logs, index, config.min_travel_m):
            options = _find_waiting_routes(lanes, raw, logs, index, config, count=1, half=half)
        else:
            count, goal_m = (config.alternatives, config.max_goal_distance_m) if slot >= 0 else (1, math.inf)
            options = _find_routes(lanes, raw, logs, index, config, count=count, max_end_distance_m=goal_m, half=half)
        first[index], routed[index] = len(found), bool(options)
        found += options
        owner += [slot] * len(options)
    logged = len(found)
    seed = np.random.default_rng(zlib.crc32(raw.name.encode()))
    low, high = config.drawn_length_m
    if config.drawn:
        found += route_sets.draw_routes(
            lanes, seed, count=config.drawn, half_m=half, centre=np.zeros(2), length_m=(low, min(high, config.length_m)),
            turn_fraction=config.turn_fraction, attempts=config.attempts,
        )  # fmt: skip
    owner += [-1] * (len(found) - logged)
    places = {line.id: index for index, line in enumerate(raw.roads) if line.kind in DRIVABLE}
    index_of_lane = np.array([places[number] for number in graph.id.tolist()], int)
    columns = _assemble(found, owner, len(found) - logged, slots, len(traffic))
    columns |= _find_lanes(found, index_of_lane, raw, columns["routes.position"].shape[1])
    columns |= _find_stops(columns, controls, config.stop_distance_m)
    columns |= _place_agents(columns, raw, logs, agents, first, routed, slots)
    columns["traffic_log.route"] = np.where(routed[list(traffic)], first[list(traffic)], 0)
    columns["traffic_log.has_route"] = routed[list(traffic)]
    along = sum(route.along_lanes for route in found[:logged])
    rebuilt = any(line.rebuilt for line in linked.roads)
    return columns, RouteCounts(along, logged - along, len(found) - logged, rebuilt)


def find_heights(leaves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Heights of routes' points on roads of several levels: of the nearest segment of their lane, beside lanes of the nearest of any."""
    if "road.height" not in leaves:
        return {}
    place, line, lane = leaves["road.midpoint"], leaves["road.polyline"], leaves["routes.lane"]
    points = leaves["routes.position"].reshape(-1, 2)
    beside = (lane < 0).ravel()
    own = KDTree(np.column_stack([place, FAR_M * line])).query(np.column_stack([points, FAR_M * lane.ravel()]))[1]
    nearest = np.where(beside, KDTree(place).query(points)[1], own)
    return {"routes.height": leaves["road.height"][nearest].reshape(lane.shape)}


def _is_moving(raw: RawScene, logs: Logs, index: int, min_travel_m: float) -> bool:
    """Whether a track is a vehicle that gets farther than that from its first position, from the current step on."""
    path = logs.xyz[index, raw.current :][logs.valid[index, raw.current :], :2]
    return bool(len(path) > 1 and np.linalg.norm(path - path[0], axis=1).max() > min_travel_m)


def _find_routes(
    lanes: LaneMap, raw: RawScene, logs: Logs, index: int, config: RouteConfig, *, count: int, max_end_distance_m: float, half: float
) -> list[SampledRoute]:
    """The routes of a track within the square; those of a track that does not move lead on from where it waits."""
    valid = logs.valid[index]
    track, yaw = logs.xyz[index, valid, :2], float(logs.yaw[index, valid][0])
    if len(track) < 2 or np.linalg.norm(track - track[0], axis=1).max() < ROUTE_SPACING_M:
        return _find_waiting_routes(lanes, raw, logs, index, config, count=count, half=half)
    numbers = {"max_length_m": config.length_m, "max_distance_m": config.max_distance_m, "max_end_distance_m": max_end_distance_m}
    return _cut(route_sets.find_track_routes(lanes, track, yaw, count=count, **numbers), half)


def _find_waiting_routes(
    lanes: LaneMap, raw: RawScene, logs: Logs, index: int, config: RouteConfig, *, count: int, half: float
) -> list[SampledRoute]:
    """Routes of a vehicle that stands on a lane: it waits, at a light or in a queue, and has somewhere to go; none for a parked one."""
    if not logs.valid[index, raw.current]:
        return []
    place, yaw = logs.xyz[index, raw.current, :2], float(logs.yaw[index, raw.current])
    ahead = place + ROUTE_SPACING_M * np.array([np.cos(yaw), np.sin(yaw)])
    numbers = {"max_length_m": config.length_m, "max_distance_m": config.waiting_m}
    options = route_sets.find_track_routes(lanes, np.stack([place, ahead]), yaw, count=count, **numbers)
    return _cut([route for route in options if route.along_lanes], half)


def _cut(routes: Sequence[SampledRoute], half: float) -> list[SampledRoute]:
    """The parts of routes within the square."""
    cut = [route_sets.cut_to_square(route, np.zeros(2), half) for route in routes]
    return [route for route in cut if route is not None]


def _assemble(found: Sequence[SampledRoute], owner: Sequence[int], drawn: int, slots: int, traffic: int) -> dict[str, np.ndarray]:
    """The columns that depend on the routes alone, the last of which are drawn, and zeros in those of agents and traffic."""
    points = max((len(route.xy) for route in found), default=0)
    position = np.zeros((len(found), points, 2))
    for row, route in enumerate(found):
        position[row, : len(route.xy)] = route.xy
        position[row, len(route.xy) :] = route.xy[-1]
    return {
        "routes.position": position,
        "routes.length": np.array([route.length for route in found], float),
        "routes.speed_limit": np.full((len(found), points), np.inf),
        "routes.lane": np.full((len(found), points), -1),
        "routes.along_lanes": np.array([route.along_lanes for route in found], bool),
        "routes.agent": np.array(owner, int),
        "routes.drawn": np.arange(len(found)) >= len(found) - drawn,
        "routes.on_route": np.array([route.on_route for route in found], bool),
        "routes.stop_arc": np.zeros((len(found), 0)),
        "routes.stop_control": np.zeros((len(found), 0), int),
        "agents.route": np.zeros(slots, int),
        "agents.route_start": np.zeros(slots),
        "agents.route_end": np.zeros(slots),
        "traffic_log.route": np.zeros(traffic, int),
        "traffic_log.has_route": np.zeros(traffic, bool),
    }


def _find_lanes(found: Sequence[SampledRoute], index_of_lane: Int[np.ndarray, " N"], raw: RawScene, points: int) -> dict[str, np.ndarray]:
    """Lane and speed limit at every point; behind a route's end those of the end."""
    lane, limit = np.full((len(found), points), -1), np.full((len(found), points), np.inf)
    known = np.array([np.inf if (line := raw.roads[index].speed_limit) is None else line for index in index_of_lane], float)
    for row, route in enumerate(found):
        rows = np.append(route.lane, np.full(points - len(route.lane), route.lane[-1]))
        on = rows >= 0
        lane[row, on], limit[row, on] = index_of_lane[rows[on]], known[rows[on]]
    return {"routes.lane": lane, "routes.speed_limit": limit}


def _find_stops(columns: Mapping[str, np.ndarray], controls: Mapping[str, np.ndarray], distance_m: float) -> dict[str, np.ndarray]:
    """The stop places that each route passes, in order: on a lane that their control governs, or just before it."""
    position, lane = columns["routes.position"], columns["routes.lane"]
    stops: list[list[tuple[float, int]]] = []
    behind = round(BEHIND_M / ROUTE_SPACING_M)
    for row in range(len(position)):
        passed: list[tuple[float, int]] = []
        line, lanes = _make_line(position[row]), set(lane[row].tolist())
        for control, governed in enumerate(controls["controls.lane"].tolist()):
            if governed not in lanes:
                continue
            on_lane = np.flatnonzero(lane[row] == governed)
            first = max(int(on_lane[0]) - behind, 0)
            arc, offset = _project(line.take(first, int(on_lane[-1]) + 2), controls["controls.position"][control])
            arc += ROUTE_SPACING_M * first
            if offset <= distance_m and 0.0 < arc < columns["routes.length"][row]:
                passed.append((arc, control))
        stops.append(sorted(passed))
    most = max(map(len, stops), default=0)
    arcs, rows = np.full((len(stops), most), np.inf), np.zeros((len(stops), most), int)
    for row, passed in enumerate(stops):
        for place, (arc, control) in enumerate(passed):
            arcs[row, place], rows[row, place] = arc, control
    return {"routes.stop_arc": arcs, "routes.stop_control": rows}


class _Line(NamedTuple):
    """Segments of a line, onto which points are projected."""

    start: Float[np.ndarray, "S 2"]
    along: Float[np.ndarray, "S 2"]
    length: Float[np.ndarray, " S"]

    def take(self, low: int, high: int) -> "_Line":
        """The segments between two points of the line, by their numbers; `high`: exclusive."""
        part = slice(low, max(high - 1, low))
        return _Line(self.start[part], self.along[part], self.length[part])


def _make_line(points: Float[np.ndarray, "N 2"]) -> _Line:
    along = points[1:] - points[:-1]
    return _Line(points[:-1], along, np.maximum(segment_lengths(along), 1e-9))


def _project(line: _Line, point: Float[np.ndarray, "2"]) -> tuple[float, float]:
    """Arc length of the nearest place on a line, and the distance to it; (0, inf) on a line of one point."""
    if not len(line.length):
        return 0.0, np.inf
    fraction, distance = _measure(line, point)
    best = int(distance.argmin())
    return float(line.length[:best].sum() + fraction[best] * line.length[best]), float(distance[best])


def _measure(line: _Line, points: Float[np.ndarray, "*L 2"]) -> tuple[Float[np.ndarray, "*L S"], Float[np.ndarray, "*L S"]]:
    """Where on each segment of a line the place nearest to each point is, from 0 to 1, and its distance."""
    points = points[..., None, :]
    ahead = points - line.start
    inner = ahead[..., 0] * line.along[:, 0] + ahead[..., 1] * line.along[:, 1]
    fraction = np.minimum(np.maximum(inner / line.length**2, 0.0), 1.0)
    return fraction, segment_lengths(line.start + fraction[..., None] * line.along - points)


def _place_agents(
    columns: Mapping[str, np.ndarray], raw: RawScene, logs: Logs, agents: Sequence[int], first: np.ndarray, routed: np.ndarray, slots: int
) -> dict[str, np.ndarray]:
    """Route, start and end of each agent: its places on the route at the current step and at the end of its log.

    Routes that do not lead on are none (`types.Agents`): the way of a car that stands is one spacing long.
    """
    route, start, end = np.zeros(slots, int), np.zeros(slots), np.zeros(slots)
    for slot, index in enumerate(agents):
        if not routed[index]:
            continue
        route[slot] = first[index]
        line = _make_line(columns["routes.position"][route[slot]])
        path = logs.xyz[index, raw.current :][logs.valid[index, raw.current :], :2]
        start[slot] = _project(line, path[0])[0]
        end[slot] = _follow(line, path, start[slot]) if _is_moving(raw, logs, index, ROUTE_SPACING_M) else start[slot] + ROUTE_SPACING_M
    return {"agents.route": route, "agents.route_start": start, "agents.route_end": end}


def _follow(line: _Line, path: Float[np.ndarray, "L 2"], arc: float) -> float:
    """Arc length at the end of a path that follows a line from `arc` on, also where the line crosses itself."""
    for fraction, distance in zip(*_measure(line, path), strict=True):
        low = max(int(arc / ROUTE_SPACING_M) - 8, 0)
        if low < len(line.length):
            best = low + int(distance[low : low + 33].argmin())
            arc = ROUTE_SPACING_M * low + float(line.length[low:best].sum() + fraction[best] * line.length[best])
    return arc
