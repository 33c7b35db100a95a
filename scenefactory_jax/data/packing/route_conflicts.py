"""Where routes of the traffic's vehicles meet: the zones in which two vehicles must not be at the same time.

A zone is a stretch of a route whose points are nearer to another route than half the widths of both vehicles and a margin. Vehicles give
way to each other before zones that cross, and follow each other in zones where their routes lead the same way (`env/traffic/right_of_way`).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.types import ROUTE_SPACING_M

NAMES = ("zone_enter", "zone_leave", "zone_match")
ZONES = 2  # of a pair of vehicles that are kept, the first ones
MARGIN_M = 0.4  # between the sides of two vehicles
SAME_WAY_COSINE = 0.6  # between two routes in a zone, on average: they lead the same way
STRIDE = 8  # points of which one is looked at first
GAP_POINTS = 3  # stretches of a route that are not farther apart are one


class Zone(NamedTuple):
    """A zone of two routes: arc lengths on both."""

    enter: tuple[float, float]
    leave: tuple[float, float]
    match: tuple[float, float]  # one place in the zone; inf: the routes cross


class Line(NamedTuple):
    """A route up to its end, sampled every ROUTE_SPACING_M."""

    points: Float[np.ndarray, "N 2"]
    directions: Float[np.ndarray, "N 2"]  # of length 1
    height: Float[np.ndarray, " N"]  # zeros where roads have one level
    low: Float[np.ndarray, "2"]  # corners of the box around the points
    high: Float[np.ndarray, "2"]


def find_zones(leaves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Computes `zone_enter`, `zone_leave` and `zone_match` of a scene's traffic from its columns; with `routes.height`, level by level."""
    has_route, size = leaves["traffic_log.has_route"], leaves["traffic_log.size"]
    lines = {int(row): _read_line(leaves, int(row)) for row in np.flatnonzero(has_route)}
    found = {f"traffic_log.{name}": np.full((len(has_route), len(has_route), ZONES), np.inf) for name in NAMES}
    for first, second in _list_near_pairs(lines, reach_m=float(size[:, 1].max(initial=0.0)) + 2 * MARGIN_M):
        reach = (size[first, 1] + size[second, 1]) / 2 + MARGIN_M
        for place, zone in enumerate(find_pair_zones(lines[first], lines[second], reach)[:ZONES]):
            for name, arcs in zip(NAMES, zone, strict=True):
                found[f"traffic_log.{name}"][first, second, place], found[f"traffic_log.{name}"][second, first, place] = arcs
    return found


def _list_near_pairs(lines: Mapping[int, Line], *, reach_m: float) -> list[tuple[int, int]]:
    """Lists the pairs of vehicles whose routes' boxes come within reach of each other."""
    if len(lines) < 2:
        return []
    names, low, high = list(lines), np.stack([line.low for line in lines.values()]), np.stack([line.high for line in lines.values()])
    near = ((low[:, None] - high[None]) <= reach_m).all(axis=2)
    return [(names[i], names[j]) for i, j in np.argwhere(np.triu(near & near.T, 1)).tolist()]


def make_no_zones(traffic: int) -> dict[str, np.ndarray]:
    """The columns of a scene without routes."""
    return {f"traffic_log.{name}": np.zeros((traffic, traffic, 0)) for name in NAMES}


def find_pair_zones(line: Line, other: Line, reach_m: float) -> list[Zone]:
    """Finds the zones of two routes in the order in which they are reached."""
    if len(line.points) < 2 or len(other.points) < 2:
        return []
    start, stop = _find_part(line, other, reach_m)
    other_start, other_stop = _find_part(other, line, reach_m) if stop else (0, 0)
    if not other_stop:
        return []
    if not _may_meet(line.points[start:stop], other.points[other_start:other_stop], reach_m):
        return []
    rise = line.height[start:stop, None] - other.height[None, other_start:other_stop]
    part, other_part = line.points[start:stop], other.points[other_start:other_stop]
    squared = np.square(part[:, None, 0] - other_part[None, :, 0]) + np.square(part[:, None, 1] - other_part[None, :, 1])
    near = squared + rise * rise < reach_m**2
    zones = []
    for begin, end in _find_runs(np.any(near, axis=1)):
        rows, columns = np.nonzero(near[begin:end])
        for low, high in _find_runs(np.any(near[begin:end], axis=0)):
            inside = (columns >= low) & (columns < high)
            rows_inside, columns_inside = begin + rows[inside], columns[inside]
            nearest = int(np.argmin(squared[rows_inside, columns_inside]))
            places, others = start + rows_inside, other_start + columns_inside
            same_way = float((line.directions[places] * other.directions[others]).sum(axis=1).mean()) > SAME_WAY_COSINE
            match = (float(places[nearest]), float(others[nearest])) if same_way else (np.inf, np.inf)
            enter, leave = (float(places.min()), float(others.min())), (float(places.max()), float(others.max()))
            zones.append(Zone(*((ROUTE_SPACING_M * a, ROUTE_SPACING_M * b) for a, b in (enter, leave, match))))
    return sorted(zones, key=lambda zone: sum(zone.enter))


def _read_line(leaves: Mapping[str, np.ndarray], row: int) -> Line:
    """The points of a vehicle's route up to its end."""
    route = int(leaves["traffic_log.route"][row])
    points = leaves["routes.position"][route, : int(np.ceil(leaves["routes.length"][route] / ROUTE_SPACING_M)) + 1]
    box = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.full(2, np.inf), np.full(2, -np.inf))
    height = leaves["routes.height"][route, : len(points)] if "routes.height" in leaves else np.zeros(len(points))
    if len(points) < 2:  # no direction, no zones
        return Line(points, points, height, *box)
    along = np.gradient(points, axis=0)
    return Line(points, along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9), height, *box)


def _find_part(line: Line, other: Line, reach_m: float) -> tuple[int, int]:
    """First and last index (exclusive) of the points of a line that are within reach of the box around another line; (0, 0): none."""
    inside = (line.points >= other.low - reach_m) & (line.points <= other.high + reach_m)
    rows = np.flatnonzero(inside[:, 0] & inside[:, 1])
    return (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)


def _may_meet(part: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"], reach_m: float) -> bool:
    """Whether two stretches may come within reach: no point is farther than STRIDE points from one that is looked at."""
    few, others = part[::STRIDE], other[::STRIDE]
    squared = np.square(few[:, None, 0] - others[None, :, 0]) + np.square(few[:, None, 1] - others[None, :, 1])
    return bool(squared.min() <= (reach_m + 2 * STRIDE * ROUTE_SPACING_M) ** 2)


def _find_runs(mask: Bool[np.ndarray, " N"]) -> list[tuple[int, int]]:
    """First and last index (exclusive) of the runs of true values; runs less than GAP_POINTS apart are one."""
    rows = np.flatnonzero(mask)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows) > GAP_POINTS)
    return list(zip(rows[np.append(0, cuts + 1)].tolist(), (rows[np.append(cuts, -1)] + 1).tolist(), strict=True))
