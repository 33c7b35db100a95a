"""The expert: the log's own actions, by inverse kinematics, corrected for what the car has strayed from its log. It learns nothing."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Policy
from scenefactory_jax.dynamics.bicycle_waymax import STANDING_MPS, compute_inverse_action
from scenefactory_jax.env.observations.log_view import LoggedState, LogView
from scenefactory_jax.evaluation.planners import tracker
from scenefactory_jax.evaluation.planners.route_tracking import require_groups
from scenefactory_jax.evaluation.planners.tracker import Tracker, select_tracker


def make(
    *,
    trackers: dict[str, Tracker],
    feedback: bool,
    response_s: Positive,
    length_m: Positive,
    length_s: NonNegative,
    observations: dict[str, Any],
    dynamics: dict[str, Any] | None = None,
) -> Policy:
    """Drives as the log did: its acceleration and curvature from now to the next action, and feedback on position, speed and heading.

    On `dynamics=bicycle_waymax` with `timing=waymax` and without feedback it is Waymax's and V-Max's expert. Where the log is not valid the
    agent brakes. The policy has no parameters, and its values are zero.

    Args:
        trackers: how cars of every backend are driven.
        feedback: false: the log's actions alone.
        response_s: in which an error along the log would vanish (critically damped).
        length_m, length_s: way in which an offset and an angle would vanish, at least, and the way in this time.
        observations: entry of the group that it reads, `log`.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without the group `log`.
    """
    car, action_s = select_tracker(trackers, dynamics), observations["log"]["action_s"]

    def init(key, observation):
        return {}

    def apply(parameters, observation):
        require_groups(observation, "log", planner="expert", option="log")
        view: LogView = observation["log"]
        speed = view.velocity[..., 0]
        ways = (view.now.yaw, view.now.velocity, view.next.yaw, view.next.velocity)
        acceleration, curvature = compute_inverse_action(*ways, dt=action_s)
        if feedback:
            length = length_m + length_s * speed
            push, bend = correct(view.now, safe_norm(view.velocity), speed, response_s=response_s, length=length)
            acceleration, curvature = acceleration + push, curvature + bend
        action = tracker.make_action(acceleration, curvature, speed, car)
        action = jnp.where(view.valid[..., None], action, tracker.make_braking_action(speed, car))
        return action, jnp.zeros(3), jnp.zeros_like(speed)

    return Policy(init, apply)


def correct(
    logged: LoggedState, total_speed: Float[Array, "*n"], speed: Float[Array, "*n"], *, response_s: float, length: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes the acceleration and the curvature that bring a car back to its log: linear feedback with two equal poles, in time along
    the log and in way across it. A car that stands is not turned."""
    along, aside = heading_vector(logged.yaw), jnp.stack([-jnp.sin(logged.yaw), jnp.cos(logged.yaw)], axis=-1)
    slower = safe_norm(logged.velocity) - total_speed
    push = dot(along, logged.position) / response_s**2 + 2.0 * slower / response_s
    bend = dot(aside, logged.position) / length**2 + 2.0 * jnp.sin(logged.yaw) / length
    return push, jnp.where(speed > STANDING_MPS, bend, 0.0)
