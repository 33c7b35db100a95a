"""Speed along a route: as fast as limits, bends, acceleration and braking allow, with a stop at the end."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import Points, arc_length, curvature, tangents


class Limits(NamedTuple):
    """What a driver allows himself, m/s^2."""

    acceleration: float
    braking: float
    lateral: float


class Route(NamedTuple):
    """A way along connected lanes."""

    points: Points
    place: Float[np.ndarray, " N"]  # arc length, m
    yaw: Float[np.ndarray, " N"]
    bend: Float[np.ndarray, " N"]  # absolute curvature, 1/m


class Drive(NamedTuple):
    """A car's motion along a route, sampled in time."""

    place: Float[np.ndarray, " L"]  # arc length, m
    speed: Float[np.ndarray, " L"]
    position: Float[np.ndarray, "L 2"]
    yaw: Float[np.ndarray, " L"]


def make_route(points: Points) -> Route:
    """A route along a polyline."""
    return Route(points, arc_length(points), tangents(points), np.abs(curvature(points)))


def limit_by_curvature(route: Route, limit: float, limits: Limits) -> Float[np.ndarray, " N"]:
    """Highest squared speed at every point from which all that lies ahead, the stop at the end included, can be met."""
    cap = np.minimum(limit**2, limits.lateral / np.maximum(route.bend, 1e-6))
    cap[-1] = 0.0
    return _braked(cap, route.place, limits.braking)


def drive(
    route: Route,
    squared_cap: Float[np.ndarray, " N"],
    times: Float[np.ndarray, " L"],
    limits: Limits,
    *,
    start_speed: float,
    stop_at: float | None = None,
    wait: float = 0.0,
) -> Drive:
    """The fastest motion under a cap on squared speed and a bound on acceleration.

    On every piece of the route the acceleration is constant, so that time is exact: 2 ds / (v0 + v1).

    Args:
        squared_cap: from `comfortable`; at the start at least `start_speed` squared.
        stop_at: place of a stop on the way, m; the start speed must allow it.
        wait: seconds that the stop lasts.
    """
    cap, place = squared_cap.copy(), route.place
    stop = None if stop_at is None else int(np.searchsorted(place, stop_at))
    if stop is not None:
        cap[stop] = 0.0
        cap = _braked(cap, place, limits.braking)
    cap[0] = min(start_speed**2, cap[0])
    gained = 2 * limits.acceleration * place
    squared = np.minimum(np.minimum.accumulate(cap - gained) + gained, cap)
    speed = np.sqrt(np.maximum(squared, 0.0))
    clock = np.concatenate([[0.0], np.cumsum(2 * np.diff(place) / np.maximum(speed[1:] + speed[:-1], 1e-6))])
    if stop is not None:
        clock[stop + 1 :] += wait
    return _sample(route, clock, squared, times, waiting=(stop, wait) if stop is not None else None)


def _braked(cap: Float[np.ndarray, " N"], place: Float[np.ndarray, " N"], braking: float) -> Float[np.ndarray, " N"]:
    """Squared speed that no bound further on makes too high to brake from."""
    shed = 2 * braking * place
    return np.minimum.accumulate((cap + shed)[::-1])[::-1] - shed


def _sample(
    route: Route,
    clock: Float[np.ndarray, " N"],
    squared: Float[np.ndarray, " N"],
    times: Float[np.ndarray, " L"],
    *,
    waiting: tuple[int, float] | None,
) -> Drive:
    """Read the motion at given times; after the end the car stands."""
    piece = np.clip(np.searchsorted(clock, times, side="right") - 1, 0, len(clock) - 2)
    since = times - clock[piece]
    if waiting is not None:
        since = np.where(piece == waiting[0], np.maximum(since - waiting[1], 0.0), since)
    gap = np.diff(route.place)[piece]
    rate = (squared[piece + 1] - squared[piece]) / (2 * gap)
    start = np.sqrt(np.maximum(squared[piece], 0.0))
    moved = np.clip(start * since + 0.5 * rate * since**2, 0.0, gap)
    speed = np.maximum(start + rate * since, 0.0)
    over = times >= clock[-1]
    place = np.where(over, route.place[-1], route.place[piece] + moved)
    position = np.stack([np.interp(place, route.place, route.points[:, i]) for i in (0, 1)], axis=-1)
    return Drive(place, np.where(over, 0.0, speed), position, np.interp(place, route.place, route.yaw))
