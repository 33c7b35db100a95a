"""Uniform actions: V-Max's random baseline. It learns nothing."""

import jax.numpy as jnp

from scenefactory_jax.core.types import Policy
from scenefactory_jax.evaluation.planners.route_tracking import make_planner


def make() -> Policy:
    """Takes acceleration and steering uniformly from [-1, 1] (`observations.noise`), new ones at every action.

    A throttle below zero and the brake say the same. The policy has no parameters, and its values are zero.

    Raises:
        ConfigError: at `apply`, an observation without the group `noise`.
    """

    def act(observation):
        throttle, steer = observation["noise"][..., 0], observation["noise"][..., 1]
        return jnp.stack([throttle, steer, jnp.where(throttle < 0, -throttle, -1.0)], axis=-1)

    return make_planner(act, "noise", planner="random", option="noise")
