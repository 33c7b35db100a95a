"""Starts and goals of the suites, in place of those of the log: functions that give the agents of a packed scene.

Every track of the log is background traffic then. The suites draw from the scene's own routes, which depend on its name alone, so that the
same scene always gives the same agents.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.scene_arrays import Logs, wrap_angles
from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, NonNegative, Positive, Range
from scenefactory_jax.core.types import ROAD_USERS, ROUTE_SPACING_M
from scenefactory_jax.roadgraph import route_bends, route_sets

GRAVITY_MPS2 = 9.81
Uses = Annotated[list[float], Bounds(above=0)]  # parts of the friction; one or more


class Starts(NamedTuple):
    """Agents on drawn routes, a row for each."""

    route: Int[np.ndarray, " K"]  # row of `routes`
    start: Float[np.ndarray, " K"]  # arc length on it
    end: Float[np.ndarray, " K"]
    speed: Float[np.ndarray, " K"]
    line: Float[np.ndarray, " K"] | None = None  # arc length of the only line before which the agent must have stood; inf: there is none;
    # None: lights and stop signs are those of the scene
    parked: Float[np.ndarray, " K"] | None = None  # of the rear of a car that is parked behind the line


def route100(
    columns: Mapping[str, np.ndarray],
    *,
    slots: int,
    length_m: Range,
    start_gap_m: NonNegative,
    winding_fraction: Fraction,
    standing_m: NonNegative,
    clearance_m: NonNegative,
    reaction_s: NonNegative,
    braking_mps2: Positive | None,
    car_size_m: list[float],
) -> Starts:
    """Chooses drawn routes of a length, from rest, with a part or more that turns, starts apart from each other and from road users.

    Routes that a standing vehicle blocks are left out: within the gates of the suite no car can pass it. So are starts before which a road
    user that comes along its logged way could not stop: no car could get out of its way from rest.

    Args:
        columns: of the scene: its routes, its traffic, and `row`, the row of its log at the start.
        length_m: shortest route, and where longer ones end.
        start_gap_m: between starts; the outlines of road users are half of it away, or more.
        standing_m: a vehicle that moves less in its log stands.
        clearance_m: between the line of a route and the outline of a standing vehicle: half a car and a margin.
        reaction_s: after which a road user that comes brakes.
        braking_mps2: its deceleration; None: no start is left out for it.
        winding_fraction: smallest part of routes that turn by 45 degrees or are 1.15 times longer than their chord.
    """
    rows = np.flatnonzero(columns["routes.drawn"] & (columns["routes.length"] >= length_m[0]))
    length = np.minimum(columns["routes.length"][rows], length_m[1])
    lines = [columns["routes.position"][row, : int(end / ROUTE_SPACING_M) + 1] for row, end in zip(rows, length, strict=True)]
    come = _list_arrivals(columns, reaction_s, braking_mps2)
    free = [
        place for place, line in enumerate(lines)
        if not _is_blocked(line, columns, standing_m, clearance_m) and not _is_run_into(line, come, car_size_m)
    ]  # fmt: skip
    rows, length, lines = rows[free], length[free], [lines[place] for place in free]
    winding = np.array([route_sets.is_winding(line) for line in lines], bool)
    chosen: list[int] = []
    # winding routes first, and then straight ones as far as the fraction allows
    for place in [*np.flatnonzero(winding).tolist(), *np.flatnonzero(~winding).tolist()]:
        straight = sum(not winding[other] for other in chosen) + (not winding[place])
        enough = straight <= (1 - winding_fraction) * (len(chosen) + 1)
        if len(chosen) < slots and enough and _is_free(lines[place][0], [lines[other][0] for other in chosen], columns, start_gap_m):
            chosen.append(place)
    zero = np.zeros(len(chosen))
    return Starts(rows[chosen], zero, length[chosen], zero)


def grip(
    columns: Mapping[str, np.ndarray],
    *,
    slots: int,
    mu: Positive,
    use: Uses,
    radius_m: Range,
    turn_deg: Positive,
    window_m: Positive,
    approach_m: NonNegative,
    beyond_m: NonNegative,
    way_gap_m: NonNegative,
) -> Starts:
    """Chooses bends of drawn routes that agents enter with a part of the friction: v = sqrt(u mu g R).

    Args:
        columns: as in `route100`.
        mu: friction coefficient of the road, which the weather must have, too.
        use: u, in turns over the agents.
        radius_m: of the bends, at their tightest place, as mean over `window_m`; they turn by `turn_deg` or more.
        approach_m: between start and bend; the goal lies `beyond_m` behind it.
        way_gap_m: between the ways of two agents, so that each drives as if alone.
    """
    ways, speeds = _Ways(columns, way_gap_m), []
    _check_uses(use)
    for row in np.flatnonzero(columns["routes.drawn"]).tolist():
        line, length = _read_line(columns, row), float(columns["routes.length"][row])
        for bend in route_bends.find_bends(line, window_m=window_m, radius_m=radius_m, turn_deg=turn_deg):
            start, end = bend.start - approach_m, bend.end + beyond_m
            if start >= 0.0 and end <= length and len(speeds) < slots and ways.add(row, start, end, beyond=0.0):
                speeds.append(np.sqrt(use[len(speeds) % len(use)] * mu * GRAVITY_MPS2 * bend.radius))
                break
    route, start, end = ways.read()
    nothing = np.full(len(route), np.inf)
    return Starts(route, start, end, np.array(speeds, float), nothing, nothing)


def grip_stops(
    columns: Mapping[str, np.ndarray],
    *,
    slots: int,
    mu: Positive,
    use: Uses,
    distance_m: Positive,
    parked_m: Positive,
    goal_m: NonNegative,
    radius_m: Positive,
    window_m: Positive,
    way_gap_m: NonNegative,
    car_size_m: list[float],
) -> Starts:
    """Chooses straight stretches of drawn routes on which agents have to stop before a parked car with a part of the friction.

    v^2 / (2 mu g) = u x the distance between the car's front and the line of a stop sign. A car is parked behind the line, the goal lies
    between: an agent passes if it stands before the line, drives on to the goal, and touches nothing.

    Args:
        columns, mu, use, window_m, way_gap_m: as in `grip`.
        distance_m: between the front at the start and the line.
        parked_m: between the line and the parked car's rear.
        goal_m: between the line and the goal, which an agent reaches with its centre within `step_metrics.goal_radius_m`.
        radius_m: smallest radius of a straight stretch.
    """
    ways, speeds = _Ways(columns, way_gap_m), []
    _check_uses(use)
    half = 0.5 * car_size_m[0]
    to_line = half + distance_m
    whole = to_line + parked_m + car_size_m[0]
    for row in np.flatnonzero(columns["routes.drawn"]).tolist():
        line = _read_line(columns, row)
        start = route_bends.find_straight(line, window_m=window_m, radius_m=radius_m, length_m=whole)
        if start is not None and len(speeds) < slots and ways.add(row, start, start + to_line + goal_m, beyond=whole - to_line - goal_m):
            speeds.append(np.sqrt(2.0 * use[len(speeds) % len(use)] * mu * GRAVITY_MPS2 * distance_m))
    route, begin, end = ways.read()
    return Starts(route, begin, end, np.array(speeds, float), begin + to_line, begin + to_line + parked_m)


def _check_uses(use: list[float]) -> None:
    """Raises a ConfigError for an empty list."""
    if not use:
        raise ConfigError("scenes.pack.starts.use: expected one number or more, got []")


class _Ways:
    """The ways of the chosen agents, which keep a distance from each other and from road users at their starts."""

    def __init__(self, columns: Mapping[str, np.ndarray], gap_m: float) -> None:
        self.columns, self.gap_m = columns, gap_m
        self.rows: list[tuple[int, float, float]] = []
        self.points: list[Float[np.ndarray, "N 2"]] = []

    def add(self, row: int, start: float, end: float, *, beyond: float) -> bool:
        """Adds a way, and what lies `beyond` its end, if it is free."""
        line = _read_line(self.columns, row)
        way = line[int(start / ROUTE_SPACING_M) : int(np.ceil((end + beyond) / ROUTE_SPACING_M)) + 1]
        near = any((np.hypot(*(way[:, None] - other).transpose(2, 0, 1)) < self.gap_m).any() for other in self.points)
        if near or not _is_free(way[0], [], self.columns, self.gap_m):
            return False
        self.rows.append((row, start, end))
        self.points.append(way)
        return True

    def read(self) -> tuple[Int[np.ndarray, " K"], Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
        """Reads routes, starts and ends."""
        table = np.array(self.rows, float).reshape(-1, 3)
        return table[:, 0].astype(int), table[:, 1], table[:, 2]


def _read_line(columns: Mapping[str, np.ndarray], row: int) -> Float[np.ndarray, "N 2"]:
    """The points of a route without those that repeat its end."""
    return columns["routes.position"][row, : int(columns["routes.length"][row] / ROUTE_SPACING_M) + 1]


def _is_free(start: Float[np.ndarray, "2"], others: list[Float[np.ndarray, "2"]], columns: Mapping[str, np.ndarray], gap_m: float) -> bool:
    """Whether a start is far enough from the chosen ones and from the outlines of road users at the current step."""
    if any(np.hypot(*(start - other)) < gap_m for other in others):
        return False
    present = columns["traffic_log.valid"][:, int(columns["row"])]
    return not bool((_measure_distances(start[None], columns, present) < gap_m / 2).any())


def _is_blocked(line: Float[np.ndarray, "N 2"], columns: Mapping[str, np.ndarray], standing_m: float, clearance_m: float) -> bool:
    """Whether a vehicle that stands for the whole log is in the way of a route."""
    row, valid, position = int(columns["row"]), columns["traffic_log.valid"], columns["traffic_log.position"]
    first = position[np.arange(len(valid)), np.argmax(valid, axis=1)]
    moved = np.where(valid, np.hypot(*(position - first[:, None]).transpose(2, 0, 1)), 0.0).max(axis=1, initial=0.0)
    stands = valid[:, row] & (columns["traffic_log.kind"] == ROAD_USERS.index("vehicle")) & (moved < standing_m)
    return bool((_measure_distances(line, columns, stands) < clearance_m).any())


class _Arrivals(NamedTuple):
    """Logged places of road users before which they cannot stop."""

    place: Float[np.ndarray, "N 2"]
    half_width: Float[np.ndarray, " N"]


def _list_arrivals(columns: Mapping[str, np.ndarray], reaction_s: float, braking_mps2: float | None) -> _Arrivals:
    """Lists the places that the fronts of road users reach before these have braked from their logged speeds at the start."""
    if braking_mps2 is None:
        return _Arrivals(np.zeros((0, 2)), np.zeros(0))
    row, size = int(columns["row"]), columns["traffic_log.size"]
    path, valid = columns["traffic_log.position"][:, row:], columns["traffic_log.valid"][:, row:]
    speed = np.hypot(*columns["traffic_log.velocity"][:, row].T)
    step = np.hypot(*np.diff(path, axis=1, prepend=path[:, :1]).transpose(2, 0, 1))
    room = np.cumsum(step * valid, axis=1) - size[:, :1] / 2
    needed = reaction_s * speed + speed**2 / (2.0 * braking_mps2)
    users, steps = np.nonzero(valid & valid[:, :1] & (speed > 0)[:, None] & (room < needed[:, None]))
    return _Arrivals(path[users, steps], size[users, 1] / 2)


def _is_run_into(line: Float[np.ndarray, "N 2"], come: _Arrivals, car_size_m: list[float]) -> bool:
    """Whether a road user touches a car at the beginning of a line at a place before which it cannot stop."""
    place, yaw = _point_at(line, 0.0)
    return bool((measure_to_box(come.place - place, yaw, np.array(car_size_m)) <= come.half_width).any())


def _measure_distances(points: Float[np.ndarray, "N 2"], columns: Mapping[str, np.ndarray], users: np.ndarray) -> Float[np.ndarray, "N K"]:
    """Distances of points from the outlines of road users at the start; 0 inside."""
    row = int(columns["row"])
    offset = points[:, None] - columns["traffic_log.position"][users, row]
    return measure_to_box(offset, columns["traffic_log.yaw"][users, row], columns["traffic_log.size"][users])


def measure_to_box(
    offset: Float[np.ndarray, "*n 2"], yaw: Float[np.ndarray, "*#n"] | float, size: Float[np.ndarray, "*#n 2"]
) -> Float[np.ndarray, "*n"]:
    """Distances of points at offsets from the centres of boxes to their outlines; 0 inside."""
    along = np.cos(yaw) * offset[..., 0] + np.sin(yaw) * offset[..., 1]
    across = -np.sin(yaw) * offset[..., 0] + np.cos(yaw) * offset[..., 1]
    beyond = np.maximum(np.abs(np.stack([along, across], axis=-1)) - size / 2, 0.0)
    return np.hypot(beyond[..., 0], beyond[..., 1])


def draw_agents(
    columns: Mapping[str, np.ndarray], entry: Mapping[str, Any], *, row: int, slots: int, car_size_m: list[float] | None
) -> dict[str, np.ndarray]:
    """Draws the columns of `agents` by the entry `scenes.pack.starts`; slots without a start are absent.

    Args:
        row: of the log at the start.

    Raises:
        ConfigError: no drawn routes to start on, or no size for the cars.
    """
    if not columns["routes.drawn"].size:
        raise ConfigError("scenes.pack.starts: needs drawn routes; give scenes/pack/routes=route100 or another with `drawn` above 0")
    if car_size_m is None:
        raise ConfigError("scenes.pack.car_size_m: null; drawn agents have no log to take their size from; give [length, width]")
    choose = instantiate(entry, builtins=__name__, where="scenes.pack.starts", slots=slots, car_size_m=car_size_m)
    starts = choose({**columns, "row": np.array(row)})
    added = {} if starts.line is None or starts.parked is None else _add_parked_cars(columns, starts, car_size_m)
    return _make_agents(columns, starts, slots=slots, car_size_m=car_size_m) | added


def _add_parked_cars(columns: Mapping[str, np.ndarray], starts: Starts, car_size_m: list[float]) -> dict[str, np.ndarray]:
    """The columns of traffic with a parked car, and those of controls with a stop sign before it, for the agents that have a line; no other
    controls."""
    assert starts.line is not None and starts.parked is not None
    stopping = np.isfinite(starts.line)
    routes, line_arc, rear_arc = starts.route[stopping], starts.line[stopping], starts.parked[stopping]
    count, steps = len(routes), columns["traffic_log.valid"].shape[1]
    lines = [columns["routes.position"][row] for row in routes]
    parked = [_point_at(line, arc + 0.5 * car_size_m[0]) for line, arc in zip(lines, rear_arc, strict=True)]
    stops = [_point_at(line, arc) for line, arc in zip(lines, line_arc, strict=True)]
    place, yaw = np.array([at for at, _ in parked]).reshape(-1, 2), np.array([turn for _, turn in parked], float)
    direction = np.array([turn for _, turn in stops], float)
    rows = {
        "position": np.repeat(place[:, None], steps, axis=1),
        "yaw": np.repeat(yaw[:, None], steps, axis=1),
        "velocity": np.zeros((count, steps, 2)),
        "valid": np.ones((count, steps), bool),
        "size": np.tile(np.asarray(car_size_m, float), (count, 1)),
        "kind": np.full(count, ROAD_USERS.index("vehicle")),
        "route": np.zeros(count, int),
        "has_route": np.zeros(count, bool),
        "leaves": np.zeros(count, bool),
    }
    added = {f"traffic_log.{name}": np.concatenate([columns[f"traffic_log.{name}"], leaf]) for name, leaf in rows.items()}
    for name in ("zone_enter", "zone_leave", "zone_match"):
        pad = ((0, count), (0, count), (0, 0))
        added[f"traffic_log.{name}"] = np.pad(columns[f"traffic_log.{name}"], pad, constant_values=np.inf)
    stop_arc = np.full((len(columns["routes.length"]), 1), np.inf)
    stop_arc[routes, 0] = line_arc
    stop_control = np.zeros(stop_arc.shape, int)
    stop_control[routes, 0] = np.arange(count)
    return added | {
        "controls.position": np.array([at for at, _ in stops]).reshape(-1, 2),
        "controls.direction": np.stack([np.cos(direction), np.sin(direction)], axis=1),
        "controls.lane": columns["routes.lane"][routes, (line_arc / ROUTE_SPACING_M).astype(int)],
        "controls.stop_sign": np.ones(count, bool),
        "controls.change_s": np.zeros((count, 0)),
        "controls.state": np.zeros((count, 0), int),
        "controls.period_s": np.full(count, np.inf),
        "controls.valid": np.ones(count, bool),
        "routes.stop_arc": stop_arc,
        "routes.stop_control": stop_control,
    }


def _make_agents(columns: Mapping[str, np.ndarray], starts: Starts, *, slots: int, car_size_m: list[float]) -> dict[str, np.ndarray]:
    """The columns of `agents` for these starts."""
    count = len(starts.route)
    rows = {name: np.zeros((slots, 2)) for name in ("position", "goal")}
    rows |= {name: np.zeros(slots) for name in ("yaw", "speed", "route_length", "route_start", "route_end")}
    rows["size"], rows["route"] = np.tile(np.asarray(car_size_m, float), (slots, 1)), np.zeros(slots, int)
    for slot in range(count):
        line = columns["routes.position"][starts.route[slot]]
        rows["position"][slot], rows["yaw"][slot] = _point_at(line, starts.start[slot])
        rows["goal"][slot] = _point_at(line, starts.end[slot])[0]
    rows["speed"][:count], rows["route"][:count] = starts.speed, starts.route
    rows["route_start"][:count], rows["route_end"][:count] = starts.start, starts.end
    rows["route_length"][:count] = starts.end - starts.start
    return {f"agents.{name}": leaf for name, leaf in (rows | {"present": np.arange(slots) < count}).items()}


def _point_at(line: Float[np.ndarray, "N 2"], arc: float) -> tuple[Float[np.ndarray, "2"], float]:
    """Point and yaw at a length along a route."""
    row = min(int(arc / ROUTE_SPACING_M), len(line) - 2)
    along = line[row + 1] - line[row]
    length = max(float(np.hypot(*along)), 1e-9)
    return line[row] + (arc - ROUTE_SPACING_M * row) / length * along, float(wrap_angles(np.arctan2(along[1], along[0])))


@dataclass(frozen=True)
class Conflicts:
    """What a conflict of two recorded ways is: the key `conflicts` of `scenes.pack`."""

    distance_m: Positive
    angle_deg: Positive
    within_s: NonNegative


def find_conflicts(raw: RawScene, logs: Logs, config: Conflicts) -> Bool[np.ndarray, " T"]:
    """Finds the vehicles whose recorded way, from the current step on, crosses another road user's (suite `conflict`).

    Two ways cross where they come within `distance_m` of each other, at an angle of more than `angle_deg` in both directions of travel,
    at times that are at most `within_s` apart.
    """
    now = raw.current
    xy, yaw, valid = logs.xyz[:, now:, :2], logs.yaw[:, now:], logs.valid[:, now:]
    times = raw.times[now:]
    moving = np.array([_travel(path[mask]) > config.distance_m for path, mask in zip(xy, valid, strict=True)], bool)
    crossing = np.zeros(len(xy), bool)
    near_in_time = np.abs(times[:, None] - times) <= config.within_s
    angle = np.deg2rad(config.angle_deg)
    for one in np.flatnonzero(moving & np.array([track.kind == "vehicle" for track in raw.tracks], bool)):
        for other in np.flatnonzero(moving):
            if other == one:
                continue
            apart = np.hypot(*(xy[one][:, None] - xy[other]).transpose(2, 0, 1))
            turn = np.abs(wrap_angles(yaw[one][:, None] - yaw[other]))
            angled = (turn > angle) & (turn < np.pi - angle)
            if (valid[one][:, None] & valid[other] & near_in_time & angled & (apart <= config.distance_m)).any():
                crossing[one] = True
                break
    return crossing


def _travel(path: Float[np.ndarray, "L 2"]) -> float:
    """Largest distance of a path from its start."""
    return float(np.hypot(*(path - path[:1]).T).max(initial=0.0))
