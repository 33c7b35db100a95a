"""Step metrics of V-Max (arXiv:2503.08388) that rewards need, too: time to overlap, comfort, distance to routes."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import savitzky_golay
from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.types import Scene

PREDICTION_STEP_S = 0.1
AXLE = 0.4  # of the length: from the centre back to the rear axle
AHEAD_COSINE = 0.8660254  # 30 degrees
COMFORT_ROWS = 10  # states of the window, 0.1 s apart
LATERAL, LONGITUDINAL, JERK, YAW_ACCELERATION, YAW_RATE = 2.0, (-4.05, 2.4), 8.3, 2.2, 0.95  # bounds of V-Max's comfort, SI units


def find_ahead(
    position: Float[Array, "*a 2"], yaw: Float[Array, "*b"], length: Float[Array, "*c"], other_position: Float[Array, "*d 2"]
) -> Bool[Array, "*k"]:
    """Finds the others whose centres bear less than 30 degrees from the heading, seen from the rear axle; leading axes broadcast."""
    along, distance = _measure_bearings(position, yaw, length, other_position)
    return along > AHEAD_COSINE * distance


def find_behind(
    position: Float[Array, "*a 2"], yaw: Float[Array, "*b"], length: Float[Array, "*c"], other_position: Float[Array, "*d 2"]
) -> Bool[Array, "*k"]:
    """Finds the others whose centres bear more than 150 degrees from the heading, seen from the rear axle; leading axes broadcast."""
    along, distance = _measure_bearings(position, yaw, length, other_position)
    return along < -AHEAD_COSINE * distance


def _measure_bearings(
    position: Float[Array, "*a 2"], yaw: Float[Array, "*b"], length: Float[Array, "*c"], other_position: Float[Array, "*d 2"]
) -> tuple[Float[Array, "*k"], Float[Array, "*k"]]:
    """Distances of others from the rear axle, along the heading and in all."""
    facing = heading_vector(yaw)
    bearing = other_position - (position - (AXLE * length)[..., None] * facing)
    return dot(bearing, facing), safe_norm(bearing)


def compute_time_to_overlap(
    position: Float[Array, "A 2"],
    yaw: Float[Array, " A"],
    velocity: Float[Array, "A 2"],
    size: Float[Array, "A 2"],
    other_position: Float[Array, "B 2"],
    other_yaw: Float[Array, " B"],
    other_velocity: Float[Array, "B 2"],
    other_size: Float[Array, "B 2"],
    present: Bool[Array, "A B"],
    *,
    horizon_s: float,
    everywhere: bool = False,
) -> Float[Array, " A"]:
    """Computes the time to collision of V-Max: the first multiple of PREDICTION_STEP_S at which the rectangles of a car and of one ahead of
    it overlap, at constant velocities and headings; 0 in an overlap, `horizon_s` without one before it.

    Args:
        everywhere: all that are present count, not only those ahead.
    """
    if not everywhere:
        present = present & find_ahead(position[:, None], yaw[:, None], size[:, None, 0], other_position)
    apart, closing = other_position - position[:, None], other_velocity - velocity[:, None]
    time = PREDICTION_STEP_S * jnp.arange(round(horizon_s / PREDICTION_STEP_S), dtype=jnp.float32)[:, None, None]
    place = apart + time[..., None] * closing  # [T, A, B, 2], in one loop with the minimum over it
    overlap = find_overlaps(jnp.zeros(2), yaw[:, None], size[:, None], place, other_yaw, other_size)
    return jnp.min(jnp.where(overlap & present, time, horizon_s), axis=(0, 2), initial=horizon_s)


class ComfortParts(NamedTuple):
    """Extremes over a window of states."""

    lateral: Float[Array, "*a"]  # of the size of the lateral acceleration, m/s^2
    lowest: Float[Array, "*a"]  # longitudinal acceleration
    highest: Float[Array, "*a"]
    jerk: Float[Array, "*a"]  # of the size of the longitudinal jerk, m/s^3
    yaw_rate: Float[Array, "*a"]
    yaw_acceleration: Float[Array, "*a"]


def compute_comfort_parts(velocity: Float[Array, "*a K 2"], yaw: Float[Array, "*a K"], *, dt: float) -> ComfortParts:
    """Computes the comfort parts of a window of states, the oldest first, by Savitzky-Golay filters of width 5.

    Derivatives are those of the velocity in the frame of each state, and of the yaw. The published values towards the ends of the window
    repeat the first and last of those inside and change no extreme.
    """
    slope = functools.partial(savitzky_golay.filter_inside, width=5, order=2, derivative=1, dt=dt)
    bend = functools.partial(savitzky_golay.filter_inside, width=5, order=3, derivative=2, dt=dt)
    turn = wrap_angle(jnp.diff(yaw, axis=-1))
    unwrapped = jnp.concatenate([jnp.zeros_like(yaw[..., :1]), jnp.cumsum(turn, axis=-1)], axis=-1)
    local = to_frame(velocity, yaw)
    along, across = local[..., 0], local[..., 1]
    acceleration = slope(along)
    largest = lambda values: jnp.max(jnp.abs(values), axis=-1)  # noqa: E731
    return ComfortParts(
        lateral=largest(slope(across)),
        lowest=jnp.min(acceleration, axis=-1),
        highest=jnp.max(acceleration, axis=-1),
        jerk=largest(bend(along)),
        yaw_rate=largest(slope(unwrapped)),
        yaw_acceleration=largest(bend(unwrapped)),
    )


def find_violations(parts: ComfortParts) -> Bool[Array, "*a 6"]:
    """Which bounds are left: lateral acceleration, brakes, longitudinal acceleration, jerk, yaw acceleration, yaw rate."""
    low, high = LONGITUDINAL
    left = [parts.lateral > LATERAL, parts.lowest < low, parts.highest > high, parts.jerk > JERK]
    return jnp.stack([*left, parts.yaw_acceleration > YAW_ACCELERATION, parts.yaw_rate > YAW_RATE], axis=-1)


def is_comfortable(parts: ComfortParts) -> Bool[Array, "*a"]:
    """Whether all parts are within their bounds."""
    return ~jnp.any(find_violations(parts), axis=-1)


def compute_comfort(parts: ComfortParts) -> Float[Array, "*a"]:
    """Computes V-Max's continuous comfort in (0, 1]: five values exp(-excess over the bound), averaged with the weights exp(-value)."""
    fall = lambda excess: jnp.exp(-jnp.maximum(excess, 0.0))  # noqa: E731
    low, high = LONGITUDINAL
    values = jnp.stack(
        [
            fall(parts.lateral - LATERAL),
            fall(parts.highest - high) * fall(low - parts.lowest),
            fall(parts.jerk - JERK),
            fall(parts.yaw_acceleration - YAW_ACCELERATION),
            fall(parts.yaw_rate - YAW_RATE),
        ]
    )
    weights = jnp.exp(-values)
    return jnp.sum(weights * values, axis=0) / jnp.sum(weights, axis=0)


def measure_route_distances(scene: Scene, position: Float[Array, "A 2"]) -> tuple[Float[Array, " A"], Float[Array, " A"]]:
    """Computes the distances of agents to the nearest points of their on-route and of their other routes; inf without such a route."""
    routes, cars = scene.routes, len(position)
    if routes.length.shape[0] == 0:
        return jnp.full(cars, jnp.inf), jnp.full(cars, jnp.inf)
    offset = routes.position - position[jnp.maximum(routes.agent, 0)][:, None]  # each route is compared with its own agent only
    squared = jnp.min(dot(offset, offset), axis=1)
    own = (routes.agent == jnp.arange(cars)[:, None]) & (routes.length > 0)
    on, off = (jnp.min(jnp.where(own & kind, squared, jnp.inf), axis=1) for kind in (routes.on_route, ~routes.on_route))
    return jnp.sqrt(on), jnp.sqrt(off)
