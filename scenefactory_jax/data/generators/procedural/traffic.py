"""Cars on a layout: where they start, which way they take, and how they drove it without touching one another."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import arc_length, heading
from scenefactory_jax.data.generators.procedural.road_layout import Lane, check_positive, check_range, entries
from scenefactory_jax.data.generators.speed_profile import Drive, Limits, Route, drive, limit_by_curvature, make_route
from scenefactory_jax.data.packing.pack import box_corners, overlaps

WAITS_S = (0.0, 1.5, 3.0)  # how long a car that gives way stands still, tried in turn
EASED = 0.7  # share of the limit at which a car that would touch another tries again
CROSSING_M = 1.5  # routes that come this close are in conflict
SIDE_GAP_M = 0.8  # between the sides of cars that start side by side
CIRCLE_GAP_M = 0.2  # between the circles that stand for two cars, at any time


class Car(NamedTuple):
    """A car that found its place."""

    lanes: tuple[int, ...]
    route: Route
    drive: Drive


class TrafficNumbers(NamedTuple):
    """The numbers of `populate` that its parts share."""

    travel: list[float]
    start_gap: float
    goal_gap: float
    end_margin: float
    size: tuple[float, float]
    history_s: float
    limits: Limits
    inside_share: float
    conflict_share: float
    standing_share: float


def populate(
    rng: np.random.Generator,
    lanes: list[Lane],
    times: Float[np.ndarray, " L"],
    current: int,
    *,
    cars: list[int],
    travel_m: list[float],
    start_gap_m: float,
    goal_gap_m: float,
    end_margin_m: float,
    car_size_m: list[float],
    acceleration_mps2: float,
    braking_mps2: float,
    lateral_mps2: float,
    inside_share: float,
    conflict_share: float,
    standing_share: float,
    attempts: int,
) -> list[Car]:
    """Cars one after the other, each on a random way that it can drive without touching those before it.

    Who would touch another drives slower, or stops and waits before the place; who still would is drawn again.

    Args:
        times: of the log, s.
        current: step of the log at which cars start; what lies before is their history.
        cars: fewest and most.
        travel_m: shortest and longest way between start and goal.
        start_gap_m: along the lane between starts.
        goal_gap_m: between goals.
        end_margin_m: between starts or goals and an open road end.
        car_size_m: length, width, height.
        inside_share: how likely a car starts beyond the roads that lead into the scene, against on them, per metre of lane.
        conflict_share: how often a car must take a way that crosses or follows another's.
        standing_share: how often a log begins with the car at rest.
        attempts: how many cars are drawn at most.

    Returns:
        the cars; fewer than the fewest where the attempts ran out.

    Raises:
        ConfigError: a number that makes no sense, by name.
    """
    numbers = TrafficNumbers(
        travel_m, start_gap_m, goal_gap_m, end_margin_m, (car_size_m[0], car_size_m[1]), float(times[current] - times[0]),
        Limits(acceleration_mps2, braking_mps2, lateral_mps2), inside_share, conflict_share, standing_share,
    )  # fmt: skip
    _check(cars, car_size_m, numbers)
    wanted = int(rng.integers(cars[0], cars[1] + 1))
    before = entries(lanes)
    placed: list[Car] = []
    for _ in range(attempts):
        if len(placed) == wanted:
            break
        car = _try_car(rng, lanes, before, times, current, placed, numbers)
        if car is not None:
            placed.append(car)
    return placed


def _check(cars: list[int], car_size: list[float], numbers: TrafficNumbers) -> None:
    """Refuse numbers that make no sense, by name."""
    check_range(cars, "traffic.cars", low=1.0)
    check_range(numbers.travel, "traffic.travel_m", low=1.0)
    if len(car_size) != 3 or min(car_size) <= 0:
        raise ConfigError(f"traffic.car_size_m: {list(car_size)!r} must be a length, a width and a height above 0")
    gaps = {"start_gap_m": numbers.start_gap, "goal_gap_m": numbers.goal_gap, "end_margin_m": numbers.end_margin}
    limits = {f"{name}_mps2": value for name, value in numbers.limits._asdict().items()}
    for name, value in (gaps | limits).items():
        check_positive(value, f"traffic.{name}")
    for name in ("inside_share", "conflict_share", "standing_share"):
        if not 0 <= (value := getattr(numbers, name)) <= 1:
            raise ConfigError(f"traffic.{name}: {value!r} must lie between 0 and 1")


def _try_car(
    rng: np.random.Generator,
    lanes: list[Lane],
    before: list[tuple[int, ...]],
    times: Float[np.ndarray, " L"],
    current: int,
    placed: list[Car],
    numbers: TrafficNumbers,
) -> Car | None:
    """A random car, if it fits in with those already placed."""
    ids, route = _draw_route(rng, lanes, before, numbers)
    must_conflict = bool(placed) and rng.random() < numbers.conflict_share
    standing, share, eager = rng.random() < numbers.standing_share, rng.random(), rng.uniform(0.8, 1.0)
    if route is None:
        return None
    limit = eager * lanes[ids[0]].limit
    cap = limit_by_curvature(route, limit, numbers.limits)
    start_speed = 0.0 if standing else share * float(np.sqrt(cap[0]))
    first = drive(route, cap, times, numbers.limits, start_speed=start_speed)
    if not _fits(first, current, placed, numbers) or (must_conflict and not any(_cross(route, first, car) for car in placed)):
        return None
    for attempt in _variants(route, first, cap, times, placed, start_speed, limit, numbers):
        if _touches(attempt, placed, numbers.size) is None and _fits(attempt, current, placed, numbers):
            return Car(ids, route, attempt)
    return None


def _draw_route(
    rng: np.random.Generator, lanes: list[Lane], before: list[tuple[int, ...]], numbers: TrafficNumbers
) -> tuple[tuple[int, ...], Route | None]:
    """A random way along connected lanes, long enough for the history and a travel in the range; None where the road ends too early."""
    lengths = np.array([arc_length(lane.points)[-1] for lane in lanes])
    weights = lengths * np.where([bool(b) for b in before], numbers.inside_share, 1.0)
    own = int(rng.choice(len(lanes), p=weights / weights.sum()))
    begin = float(rng.uniform(0.0, lengths[own]))
    history = rng.random() * lanes[own].limit * numbers.history_s  # what a car drives before its start
    length = float(rng.uniform(numbers.travel[0], numbers.travel[1])) + history
    ids = [own]
    while lengths[ids].sum() - begin < length and lanes[ids[-1]].exits:
        ids.append(int(rng.choice(lanes[ids[-1]].exits)))
    end = begin + length
    if not lanes[ids[-1]].exits:
        end = min(end, lengths[ids].sum() - numbers.end_margin)
    if (not before[own] and begin < numbers.end_margin) or end - begin < numbers.travel[0]:
        return (), None
    points = np.concatenate([lanes[ids[0]].points, *(lanes[i].points[1:] for i in ids[1:])])
    place = arc_length(points)
    inside = (place > begin + 0.05) & (place < end - 0.05)
    ends = np.stack([np.interp([begin, end], place, points[:, i]) for i in (0, 1)], axis=-1)
    return tuple(ids), make_route(np.concatenate([ends[:1], points[inside], ends[1:]]))


def _variants(
    route: Route,
    first: Drive,
    cap: Float[np.ndarray, " N"],
    times: Float[np.ndarray, " L"],
    placed: list[Car],
    start_speed: float,
    limit: float,
    numbers: TrafficNumbers,
) -> Iterator[Drive]:
    """The motion as drawn; then, if it touches somebody, slower ones and ones that give way."""
    yield first
    step = _touches(first, placed, numbers.size)
    if step is None:
        return
    slow = limit_by_curvature(route, EASED * limit, numbers.limits)
    if start_speed**2 <= slow[0]:
        yield drive(route, slow, times, numbers.limits, start_speed=start_speed)
    stop_at = first.place[step] - numbers.size[0]
    if stop_at > start_speed**2 / (2 * numbers.limits.braking) + 0.5:
        for wait in WAITS_S:
            yield drive(route, cap, times, numbers.limits, start_speed=start_speed, stop_at=float(stop_at), wait=wait)


def _fits(own: Drive, current: int, placed: list[Car], numbers: TrafficNumbers) -> bool:
    """Whether the travel lies in the range and start and goal keep their distances."""
    travel = own.place[-1] - own.place[current]
    if not numbers.travel[0] <= travel <= numbers.travel[1]:
        return False
    if not placed:
        return True
    goals = np.stack([car.drive.position[-1] for car in placed])
    if np.min(np.linalg.norm(own.position[-1] - goals, axis=1)) < numbers.goal_gap:
        return False
    room = numbers.start_gap, numbers.size[1] + SIDE_GAP_M  # each car's own half of the gap to the next
    rooms = [box_corners(drive.position[current], float(drive.yaw[current]), *room) for drive in (own, *(car.drive for car in placed))]
    return not overlaps(rooms[0], np.stack(rooms[1:])).any()


def _cross(route: Route, own: Drive, other: Car) -> bool:
    """Whether two ways come within CROSSING_M of each other anywhere."""
    mine = route.points[route.place <= own.place[-1]][::4]
    theirs = other.route.points[other.route.place <= other.drive.place[-1]][::4]
    return bool(np.min(np.linalg.norm(mine[:, None] - theirs[None], axis=-1)) < CROSSING_M)


def _touches(own: Drive, placed: list[Car], size: tuple[float, float]) -> int | None:
    """First step at which the circles that stand for the car come near those of another; None if never."""
    if not placed:
        return None
    radius, mine = _circles(own, size)
    theirs = np.stack([_circles(car.drive, size)[1] for car in placed])
    apart = np.linalg.norm(mine[None, :, :, None] - theirs[:, :, None, :], axis=-1).min(axis=(0, 2, 3))
    steps = np.flatnonzero(apart < 2 * radius + CIRCLE_GAP_M)
    return int(steps[0]) if len(steps) else None


def _circles(own: Drive, size: tuple[float, float]) -> tuple[float, Float[np.ndarray, "L 3 2"]]:
    """Three circles along the axis that cover the box, the smallest that do: one on the middle of each third."""
    along = size[0] / 3 * np.array([1.0, 0.0, -1.0])
    return float(np.hypot(size[0] / 6, size[1] / 2)), own.position[:, None] + along[:, None] * heading(own.yaw)[:, None]
