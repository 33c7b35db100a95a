"""Constant speed, straight on: V-Max's baseline of the action (0, 0). It learns nothing."""

from typing import Any

import jax.numpy as jnp

from scenefactory_jax.core.types import Policy
from scenefactory_jax.evaluation.planners import tracker
from scenefactory_jax.evaluation.planners.route_tracking import make_planner
from scenefactory_jax.evaluation.planners.tracker import Tracker, select_tracker


def make(*, trackers: dict[str, Tracker], dynamics: dict[str, Any] | None = None) -> Policy:
    """No acceleration and no curvature; the engine takes the car's rolling resistance and air drag.

    The policy has no parameters, and its values are zero.

    Args:
        trackers: how cars of every backend are driven.
        dynamics: of the run; supplied.

    Raises:
        ConfigError: dynamics without a tracker; at `apply`, an observation without the group `planning`.
    """
    car = select_tracker(trackers, dynamics)

    def act(observation):
        speed = observation["planning"].velocity[..., 0]
        zero = jnp.zeros_like(speed)
        return tracker.make_action(zero, zero, speed, car)

    return make_planner(act, "planning", planner="constant", option="planning")
