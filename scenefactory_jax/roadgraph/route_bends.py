"""Bends and straight stretches of routes that are sampled every ROUTE_SPACING_M."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.types import ROUTE_SPACING_M


class Bend(NamedTuple):
    """A stretch of a route that turns to one side."""

    start: float  # arc length, m
    end: float
    radius: float  # of its tightest place, m


def compute_curvature(line: Float[np.ndarray, "N 2"], window_m: float) -> Float[np.ndarray, " N"]:
    """Computes the mean curvature over a window around every point, positive to the left; the window ends with the line.

    A mean over some metres, as the points of lanes scatter by decimetres.
    """
    step = np.diff(line, axis=0)
    if len(step) < 2:
        return np.zeros(len(line))
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))  # of the pieces, whose middles lie half a spacing off the points
    half = max(round(window_m / 2 / ROUTE_SPACING_M), 1)
    points = np.arange(len(line))
    first, last = np.clip(points - half, 0, len(step) - 1), np.clip(points + half - 1, 0, len(step) - 1)
    return (heading[last] - heading[first]) / (np.maximum(last - first, 1) * ROUTE_SPACING_M)


def find_bends(line: Float[np.ndarray, "N 2"], *, window_m: float, radius_m: tuple[float, float], turn_deg: float) -> list[Bend]:
    """Finds the bends of a route, in order: stretches with a radius below the second of `radius_m` that turn to one side by `turn_deg` or
    more, and whose tightest place has a radius within `radius_m`."""
    curvature = compute_curvature(line, window_m)
    side = np.where(np.abs(curvature) >= 1.0 / radius_m[1], np.sign(curvature), 0.0)
    edges = np.flatnonzero(np.diff(side)) + 1
    bends = []
    for first, beyond in zip([0, *edges.tolist()], [*edges.tolist(), len(side)], strict=True):
        within = curvature[first:beyond]
        if not len(within) or side[first] == 0.0:
            continue
        turn, radius = np.abs(within).sum() * ROUTE_SPACING_M, 1.0 / np.abs(within).max()
        if turn >= np.deg2rad(turn_deg) and radius >= radius_m[0]:
            bends.append(Bend(ROUTE_SPACING_M * first, ROUTE_SPACING_M * (beyond - 1), float(radius)))
    return bends


def find_straight(line: Float[np.ndarray, "N 2"], *, window_m: float, radius_m: float, length_m: float) -> float | None:
    """Finds the arc length at which the first stretch of `length_m` without a radius below `radius_m` begins; None: there is none."""
    straight = np.abs(compute_curvature(line, window_m)) <= 1.0 / radius_m
    points = int(np.ceil(length_m / ROUTE_SPACING_M)) + 1
    whole = np.convolve(straight, np.ones(points), mode="valid") >= points if len(straight) >= points else np.zeros(0, bool)
    return ROUTE_SPACING_M * float(np.argmax(whole)) if whole.any() else None
