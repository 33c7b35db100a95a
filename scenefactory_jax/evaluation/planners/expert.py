"""The expert: the log's own actions, by inverse kinematics, with feedback on how far the car is from its log. It learns nothing."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm, wrap_angle
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Policy
from scenefactory_jax.dynamics.bicycle_waymax import STANDING_MPS, compute_inverse_action
from scenefactory_jax.env.observations.log_view import LogView
from scenefactory_jax.evaluation.planners import tracker
from scenefactory_jax.evaluation.planners.route_tracking import make_planner
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

    Without feedback, and with `dynamics=bicycle_waymax` and `timing=waymax`, it is Waymax's and V-Max's expert: the action that leads from
    the agent's speed and heading to those of the log at the next action, whatever its position. An agent outside of its log brakes. The
    policy has no parameters, and its values are zero.

    Args:
        trackers: how cars of every backend are driven.
        feedback: false: Waymax's action.
        response_s: in which an error along the log would vanish (critically damped).
        length_m, length_s: way in which an offset and an angle would vanish, at least, and the way in this time.
        observations: entry of the group that it reads, `log`.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without the group `log`.
    """
    car, action_s = select_tracker(trackers, dynamics), observations["log"]["action_s"]

    def act(observation):
        view: LogView = observation["log"]
        speed = view.velocity[..., 0]
        if feedback:
            acceleration, curvature = follow_log(view, action_s=action_s, response_s=response_s, length=length_m + length_s * speed)
        else:
            heading = jnp.zeros_like(speed)
            acceleration, curvature = compute_inverse_action(heading, view.velocity, view.next.yaw, view.next.velocity, dt=action_s)
        action = tracker.make_action(acceleration, curvature, speed, car, grade=view.grade)
        return jnp.where(view.valid[..., None], action, tracker.make_braking_action(speed, car))

    return make_planner(act, "log", planner="expert", option="log")


def follow_log(
    view: LogView, *, action_s: float, response_s: float, length: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes acceleration and curvature of the log, plus those that bring a car back to it: linear feedback with two equal poles, in
    time along the log and in way across it. Headings are directions of velocities where these have one. A car that stands is not turned.
    """
    logged, own = view.now, safe_norm(view.velocity)
    heading = find_course(logged.velocity, logged.yaw)
    acceleration, curvature = compute_inverse_action(heading, logged.velocity, view.next.yaw, view.next.velocity, dt=action_s)
    along, aside = heading_vector(heading), heading_vector(heading + 0.5 * jnp.pi)
    push = dot(along, logged.position) / response_s**2 + 2.0 * (safe_norm(logged.velocity) - own) / response_s
    turned = wrap_angle(heading - find_course(view.velocity, jnp.zeros_like(own)))
    bend = dot(aside, logged.position) / length**2 + 2.0 * jnp.sin(turned) / length
    return acceleration + push, curvature + jnp.where(own > STANDING_MPS, bend, 0.0)


def find_course(velocity: Float[Array, "*n 2"], yaw: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Finds the direction of velocities above STANDING_MPS, else the yaw."""
    moves = safe_norm(velocity) > STANDING_MPS
    return jnp.where(moves, jnp.arctan2(velocity[..., 1], jnp.where(moves, velocity[..., 0], 1.0)), yaw)
