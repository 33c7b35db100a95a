"""Planar curves as arrays of points: built from curvature, joined, offset, measured."""

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.scene_arrays import wrap_angles

FINE_M = 0.25  # spacing of the points that everything is computed on; what a scene holds is coarser
Points = Float[np.ndarray, "_ 2"]
Curve = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]


def heading(yaw: float | Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 2"]:
    """Unit vector that a yaw points along."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def wrap_angle(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return float(wrap_angles(angle))


def arc_length(points: Points) -> Float[np.ndarray, " N"]:
    """Distance along the polyline from its first point, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def tangents(points: Points) -> Float[np.ndarray, " N"]:
    """Yaw of the curve through the points, unwrapped: the bisector at inner points, the segment's own at the ends."""
    step = np.diff(points, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    return np.concatenate([yaw[:1], (yaw[1:] + yaw[:-1]) / 2, yaw[-1:]])


def curvature(points: Points) -> Float[np.ndarray, " N"]:
    """Signed curvature, 1/m, positive to the left."""
    if len(points) < 3:
        return np.zeros(len(points))
    return np.gradient(tangents(points), arc_length(points))


def integrate(start: Float[np.ndarray, " 2"], yaw: float, bends: Float[np.ndarray, " M"], spacing: float) -> Curve:
    """The curve that leaves `start` along `yaw` with the given curvature on each of M steps of `spacing` metres.

    Returns:
        M + 1 points and the yaw at each.
    """
    yaws = yaw + np.concatenate([[0.0], np.cumsum(bends) * spacing])
    steps = spacing * heading((yaws[1:] + yaws[:-1]) / 2)
    return np.concatenate([start[None], start + np.cumsum(steps, axis=0)]), yaws


def easing_bend(length: float, turn: float, radius: float, easing: float, *, lead: float) -> tuple[Float[np.ndarray, " M"], float]:
    """Curvature along a road that runs straight for `lead`, turns by `turn` and runs straight again: clothoid, arc, clothoid.

    The clothoids are `easing` metres long (less in a turn too small for them) and the arc has the given radius.

    Returns:
        curvature on every step, and the step, so that the steps add up to `length` exactly.
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


def offset(curve: Curve, distance: float) -> Points:
    """The parallel curve `distance` metres to the left (negative: to the right)."""
    points, yaw = curve
    return points + distance * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)


def resample(points: Points, spacing: float) -> Points:
    """Points evenly spaced along the polyline, about `spacing` apart, both ends exact."""
    place = arc_length(points)
    count = max(1, round(place[-1] / spacing))
    at = np.linspace(0.0, place[-1], count + 1)
    found = np.stack([np.interp(at, place, points[:, 0]), np.interp(at, place, points[:, 1])], axis=-1)
    found[0], found[-1] = points[0], points[-1]
    return found


def connect(start: Float[np.ndarray, " 2"], start_yaw: float, end: Float[np.ndarray, " 2"], end_yaw: float) -> Points:
    """A smooth turn from one pose to another: the cubic Bezier curve that is nearest to a circular arc where an arc fits."""
    turn = abs(wrap_angle(end_yaw - start_yaw))
    chord = np.linalg.norm(end - start)
    share = 1 / 3 if turn < 1e-3 else 2 / 3 * np.tan(turn / 4) / np.sin(turn / 2)  # handle / chord of an arc
    controls = np.stack([start, start + share * chord * heading(start_yaw), end - share * chord * heading(end_yaw), end])
    u = np.linspace(0.0, 1.0, max(8, int(2 * chord / FINE_M)))[:, None]
    weights = np.concatenate([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3], axis=1)
    return resample(weights @ controls, FINE_M)


def cut(points: Points, at: float) -> tuple[Points, Points]:
    """The polyline before and after the point nearest to `at` metres along it; both hold that point."""
    middle = int(np.clip(np.searchsorted(arc_length(points), at), 1, len(points) - 2))
    return points[: middle + 1], points[middle:]
