"""Motion of adversaries: actions that follow logged tracks, and the states that follow from actions, through Waymax's bicycle."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm
from scenefactory_jax.dynamics.bicycle_waymax import Body, compute_inverse_action, integrate_acceleration
from scenefactory_jax.evaluation.adversary.settings import Limits

SLOW_MPS = 1.0  # slower, limits of power and of lateral acceleration are those of this speed


class Track(NamedTuple):
    """States of cars at the steps of the log, the first one at the start."""

    position: Float[Array, "*n T 2"]
    yaw: Float[Array, "*n T"]
    velocity: Float[Array, "*n T 2"]


def start_bodies(position: Float[Array, "K 2"], yaw: Float[Array, " K"], velocity: Float[Array, "K 2"]) -> Body:
    """Makes bodies that drive along their headings, never backwards."""
    speed, zero = jnp.maximum(dot(velocity, heading_vector(yaw)), 0.0), jnp.zeros_like(yaw)
    return Body(position, yaw, speed[:, None] * heading_vector(yaw), zero, zero, zero, zero, zero)


def limit_action(
    body: Body, action: Float[Array, "K 2"], top_speed: Float[Array, " K"], limits: Limits, *, dt: float
) -> Float[Array, "K 2"]:
    """Limits accelerations (m/s^2) and curvatures (1/m) to what the cars can do at their speeds; braking ends at rest."""
    speed = safe_norm(body.velocity)
    strongest = jnp.minimum(limits.acceleration_mps2, limits.power_m2ps3 / jnp.maximum(speed, SLOW_MPS))
    weakest = jnp.maximum(-limits.braking_mps2, -speed / dt)
    push = jnp.maximum(jnp.minimum(action[:, 0], jnp.minimum(strongest, (top_speed - speed) / dt)), weakest)
    sharpest = find_sharpest(speed, limits)
    return jnp.stack([push, jnp.clip(action[:, 1], -sharpest, sharpest)], axis=-1)


def find_sharpest(speed: Float[Array, "*n"], limits: Limits) -> Float[Array, "*n"]:
    """Finds the largest curvature at a speed: that of the steering, or of the lateral acceleration."""
    return jnp.minimum(limits.curvature_radpm, limits.lateral_mps2 / jnp.maximum(speed, SLOW_MPS) ** 2)


def simulate(start: Body, actions: Float[Array, "K T 2"], top_speed: Float[Array, " K"], limits: Limits, *, dt: float) -> Track:
    """Simulates actions within the limits; differentiable in the actions. The track has one state more than there are actions."""

    def step(body: Body, action: Float[Array, "K 2"]) -> tuple[Body, Body]:
        push, bend = limit_action(body, action, top_speed, limits, dt=dt).T
        after = integrate_acceleration(body, push, bend, dt=dt)
        return after, after

    _, after = jax.lax.scan(step, start, jnp.swapaxes(actions, 0, 1))
    return _join(start, after)


def reconstruct_actions(
    start: Body,
    logged: Track,
    valid: Bool[Array, "K T"],
    top_speed: Float[Array, " K"],
    limits: Limits,
    *,
    feedback_radps: float,
    dt: float,
) -> tuple[Float[Array, "K M 2"], Track]:
    """Computes actions within the limits that follow logged tracks, and the states that they lead to, one step after the other.

    Each action is the inverse of the bicycle from the state that was reached, not from the logged one, to the logged velocity and a part
    of the missing way, so that errors do not add up. Where the log is not valid the cars coast.

    Args:
        logged: states of the log from the start on, M + 1 of them.
        feedback_radps: speed towards the logged position per metre of distance from it.
    """

    def step(body: Body, row: tuple[Array, ...]) -> tuple[Body, tuple[Array, Body]]:
        position, yaw, velocity, known = row
        missing = position - body.position - 0.5 * dt * (body.velocity + velocity)
        push, bend = compute_inverse_action(body.yaw, body.velocity, yaw, velocity + feedback_radps * missing, dt=dt)
        action = jnp.where(known[:, None], jnp.stack([push, bend], axis=-1), 0.0)
        action = limit_action(body, action, top_speed, limits, dt=dt)
        after = integrate_acceleration(body, action[:, 0], action[:, 1], dt=dt)
        return after, (action, after)

    rows = jax.tree.map(lambda leaf: jnp.swapaxes(leaf[:, 1:], 0, 1), (*logged, valid))
    _, (actions, after) = jax.lax.scan(step, start, rows)
    return jnp.swapaxes(actions, 0, 1), _join(start, after)


def _join(start: Body, after: Body) -> Track:
    """The start and the states after it, with the axis of time behind that of cars."""
    names = ("position", "yaw", "velocity")
    return Track(*(jnp.concatenate([getattr(start, n)[:, None], jnp.swapaxes(getattr(after, n), 0, 1)], axis=1) for n in names))
