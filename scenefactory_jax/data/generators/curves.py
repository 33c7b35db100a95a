"""Planar curves as arrays of points: built from curvature, joined, resampled, measured."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.scene_arrays import segment_lengths, wrap_angles

FINE_M = 0.25  # spacing of the points of all computed curves; scenes have coarser ones
Points = Float[np.ndarray, "_ 2"]
Curve = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]


def heading(yaw: float | Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 2"]:
    """Computes the unit vector in the direction of a yaw."""
    unit = np.empty((*np.shape(yaw), 2))
    unit[..., 0], unit[..., 1] = np.cos(yaw), np.sin(yaw)
    return unit


def wrap_angle(angle: float) -> float:
    """Wraps an angle to [-pi, pi)."""
    return float(wrap_angles(angle))


def smoothstep(fraction: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Computes the smooth transition from 0 to 1 for fractions, which are limited to [0, 1]."""
    fraction = np.clip(fraction, 0.0, 1.0)
    return fraction * fraction * (3 - 2 * fraction)


def arc_length(points: Points) -> Float[np.ndarray, " N"]:
    """Computes the distance along the polyline from its first point, m."""
    place = np.zeros(len(points))
    np.cumsum(segment_lengths(points[1:] - points[:-1]), out=place[1:])
    return place


def tangents(points: Points) -> Float[np.ndarray, " N"]:
    """Computes the unwrapped yaw of the curve through the points: the bisector at inner points, the segment's yaw at the ends."""
    step = np.diff(points, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    return np.concatenate([yaw[:1], (yaw[1:] + yaw[:-1]) / 2, yaw[-1:]])


def right_normals(points: Points) -> Points:
    """Computes the unit vectors to the right of a polyline at its points."""
    step = np.gradient(points, axis=0)
    return np.stack([step[:, 1], -step[:, 0]], axis=-1) / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)


def curvature(points: Points) -> Float[np.ndarray, " N"]:
    """Computes the signed curvature, 1/m, positive to the left."""
    if len(points) < 3:
        return np.zeros(len(points))
    return np.gradient(tangents(points), arc_length(points))


def integrate(start: Float[np.ndarray, " 2"], yaw: float, bends: Float[np.ndarray, " M"], spacing: float) -> Curve:
    """Computes the curve that leaves `start` along `yaw` with the given curvature on each of M steps of `spacing` metres.

    Returns:
        M + 1 points and the yaw at each.
    """
    yaws = yaw + np.concatenate([[0.0], np.cumsum(bends) * spacing])
    steps = spacing * heading((yaws[1:] + yaws[:-1]) / 2)
    return np.concatenate([start[None], start + np.cumsum(steps, axis=0)]), yaws


def easing_bend(length: float, turn: float, radius: float, easing: float, *, lead: float) -> tuple[Float[np.ndarray, " M"], float]:
    """Computes the curvature of a road with one bend: straight for `lead`, then clothoid, arc, clothoid, then straight.

    The clothoids are `easing` metres long, or shorter for a small turn. The arc has the given radius.

    Returns:
        The curvature of every step, and the length of a step; the steps add up to `length`.
    """
    count = max(2, round(length / FINE_M))
    step = length / count
    place = (np.arange(count) + 0.5) * step - lead
    easing = min(easing, abs(turn) * radius)
    span = abs(turn) * radius + easing  # of both clothoids and the arc
    if span <= 0:
        return np.zeros(count), step
    shape = np.clip(np.minimum(place, span - place) / max(easing, step), 0.0, 1.0)
    total = shape.sum() * step
    return (turn / total * shape if total > 0 else shape), step


def interpolate(at: float | Sequence[float] | np.ndarray, place: Float[np.ndarray, " N"], points: Points) -> Float[np.ndarray, "*m 2"]:
    """Computes points of a polyline at places along it; `place` is the place of each of its points."""
    found = np.empty((*np.shape(at), 2))
    found[..., 0], found[..., 1] = np.interp(at, place, points[:, 0]), np.interp(at, place, points[:, 1])
    return found


def resample(points: Points, spacing: float) -> Points:
    """Computes evenly spaced points of the polyline, about `spacing` apart, with exact ends."""
    place = arc_length(points)
    count = max(1, round(place[-1] / spacing))
    even = interpolate(np.linspace(0.0, place[-1], count + 1), place, points)
    even[0], even[-1] = points[0], points[-1]
    return even


def join(pieces: Sequence[Points]) -> Points:
    """Joins polylines of which each begins at the end of the previous one."""
    return np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])


def cut(points: Points, place: Float[np.ndarray, " N"], begin: float, end: float) -> Points:
    """Cuts the part of a polyline between two places along it."""
    inside = (place > begin + 1e-6) & (place < end - 1e-6)
    ends = interpolate([begin, end], place, points)
    return np.concatenate([ends[:1], points[inside], ends[1:]])


def connect(start: Float[np.ndarray, " 2"], start_yaw: float, end: Float[np.ndarray, " 2"], end_yaw: float) -> Points:
    """Computes a smooth turn between two poses: a cubic Bezier curve, close to a circular arc where an arc fits."""
    turn = abs(wrap_angle(end_yaw - start_yaw))
    chord = np.linalg.norm(end - start)
    handle = chord * (1 / 3 if turn < 1e-3 else 2 / 3 * np.tan(turn / 4) / np.sin(turn / 2))  # of an arc
    controls = np.stack([start, start + handle * heading(start_yaw), end - handle * heading(end_yaw), end])
    u = np.linspace(0.0, 1.0, max(8, int(2 * chord / FINE_M)))[:, None]
    weights = np.concatenate([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3], axis=1)
    return resample(weights @ controls, FINE_M)
