"""Pure pursuit: a rule-based policy that holds a speed on the circle through its goal. A baseline for learnt policies."""

from typing import Any

import jax.numpy as jnp

from scenefactory_jax.core.schema import ConfigError, Positive
from scenefactory_jax.core.types import Policy
from scenefactory_jax.evaluation.planners.route_tracking import make_planner
from scenefactory_jax.evaluation.planners.tracker import Tracker, compute_steer, select_tracker


def make(
    *,
    trackers: dict[str, Tracker],
    speed_mps: Positive,
    speed_band_mps: Positive,
    goal_scale_m: Positive,
    speed_scale_mps: Positive,
    dynamics: dict[str, Any] | None = None,
) -> Policy:
    """Pure pursuit of the goal (Coulter 1992, "Implementation of the pure pursuit path tracking algorithm"), without lanes and other cars.

    A circle that starts along the car's axis and leads through a point at distance d and bearing b has the curvature 2 sin(b) / d. For a
    goal behind the car the steering is at its limit. A throttle below zero brakes where the actions are `one_pedal`. The policy has no
    parameters, and its values are zero.

    Args:
        trackers: how cars of every backend are steered.
        speed_mps: to hold.
        speed_band_mps: difference to that speed at which the throttle is at its limit.
        goal_scale_m, speed_scale_mps: `observations.ego.distance_scale_m` and `observations.ego.speed_scale_mps`.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without `ego`.
    """

    tracker = select_tracker(trackers, dynamics)

    def act(observation):
        if "ego" not in observation:
            has = ", ".join(sorted(observation)) or "none"
            raise ConfigError(f"policy: pure pursuit needs the observation group `ego`; the observation has: {has}")
        ego = observation["ego"]
        sine, cosine, distance_m = ego[..., 2], ego[..., 3], jnp.maximum(goal_scale_m * ego[..., 4], 1.0)
        steer = jnp.where(cosine > 0.0, compute_steer(2.0 * sine / distance_m, tracker), jnp.copysign(1.0, sine))
        throttle = (speed_mps - speed_scale_mps * ego[..., 5]) / speed_band_mps
        return jnp.clip(jnp.stack([throttle, steer, -jnp.ones_like(steer)], axis=-1), -1.0, 1.0)

    return make_planner(act, planner="pure_pursuit")
