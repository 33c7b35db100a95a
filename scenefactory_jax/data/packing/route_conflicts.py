"""Where routes of the traffic's vehicles meet: the zones in which two vehicles must not be at the same time.

A zone is a stretch of a route whose points are nearer to another route than half the widths of both vehicles and a margin. Vehicles give
way to each other before zones that cross, and follow each other in zones where their routes lead the same way (`env/traffic/right_of_way`).
"""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.types import ROUTE_SPACING_M

NAMES = ("zone_enter", "zone_leave", "zone_match")
ZONES = 2  # of a pair of vehicles that are kept, the first ones
MARGIN_M = 0.4  # between the sides of two vehicles
SAME_WAY_COSINE = 0.6  # between two routes in a zone, on average: they lead the same way
GAP_POINTS = 3  # stretches of a route that are not farther apart are one


class Zone(NamedTuple):
    """A zone of two routes: arc lengths on both."""

    enter: tuple[float, float]
    leave: tuple[float, float]
    match: tuple[float, float]  # one place in the zone; inf: the routes cross


def find_zones(leaves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Computes `zone_enter`, `zone_leave` and `zone_match` of a scene's traffic from its columns."""
    has_route, size = leaves["traffic_log.has_route"], leaves["traffic_log.size"]
    lines = {int(row): _read_line(leaves, int(row)) for row in np.flatnonzero(has_route)}
    found = {f"traffic_log.{name}": np.full((len(has_route), len(has_route), ZONES), np.inf) for name in NAMES}
    for first, second in itertools.combinations(lines, 2):
        reach = (size[first, 1] + size[second, 1]) / 2 + MARGIN_M
        for place, zone in enumerate(find_pair_zones(lines[first], lines[second], reach)[:ZONES]):
            for name, arcs in zip(NAMES, zone, strict=True):
                found[f"traffic_log.{name}"][first, second, place], found[f"traffic_log.{name}"][second, first, place] = arcs
    return found


def make_no_zones(traffic: int) -> dict[str, np.ndarray]:
    """The columns of a scene without routes."""
    return {f"traffic_log.{name}": np.zeros((traffic, traffic, 0)) for name in NAMES}


def find_pair_zones(line: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"], reach_m: float) -> list[Zone]:
    """Finds the zones of two routes that are sampled every ROUTE_SPACING_M, in the order in which they are reached."""
    if len(line) < 2 or len(other) < 2 or not _may_touch(line, other, reach_m):
        return []
    squared = ((line[:, None] - other[None]) ** 2).sum(axis=2)
    near = squared < reach_m**2
    directions, other_directions = _find_directions(line), _find_directions(other)
    zones = []
    for begin, end in _find_runs(near.any(axis=1)):
        rows, columns = np.nonzero(near[begin:end])
        for low, high in _find_runs(near[begin:end].any(axis=0)):
            inside = (columns >= low) & (columns < high)
            places, others = begin + rows[inside], columns[inside]
            same_way = float((directions[places] * other_directions[others]).sum(axis=1).mean()) > SAME_WAY_COSINE
            nearest = int(np.argmin(squared[places, others]))
            match = (float(places[nearest]), float(others[nearest])) if same_way else (np.inf, np.inf)
            enter, leave = (float(places.min()), float(others.min())), (float(places.max()), float(others.max()))
            zones.append(Zone(*((ROUTE_SPACING_M * a, ROUTE_SPACING_M * b) for a, b in (enter, leave, match))))
    return sorted(zones, key=lambda zone: sum(zone.enter))


def _read_line(leaves: Mapping[str, np.ndarray], row: int) -> Float[np.ndarray, "N 2"]:
    """The points of a vehicle's route up to its end."""
    route = leaves["traffic_log.route"][row]
    points = int(np.ceil(leaves["routes.length"][route] / ROUTE_SPACING_M)) + 1
    return leaves["routes.position"][route, :points]


def _may_touch(line: Float[np.ndarray, "N 2"], other: Float[np.ndarray, "M 2"], reach_m: float) -> bool:
    """Whether the boxes around two lines are within reach."""
    return bool(np.all(line.min(axis=0) - reach_m <= other.max(axis=0)) and np.all(other.min(axis=0) - reach_m <= line.max(axis=0)))


def _find_directions(line: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Unit directions at the points of a line."""
    along = np.gradient(line, axis=0)
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def _find_runs(mask: Bool[np.ndarray, " N"]) -> list[tuple[int, int]]:
    """First and last index (exclusive) of the runs of true values; runs less than GAP_POINTS apart are one."""
    rows = np.flatnonzero(mask)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(rows) > GAP_POINTS)
    return list(zip(rows[np.append(0, cuts + 1)].tolist(), (rows[np.append(cuts, -1)] + 1).tolist(), strict=True))
