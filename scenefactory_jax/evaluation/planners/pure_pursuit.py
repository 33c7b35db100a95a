"""A policy that learns nothing: it holds a speed on the circle that leads through its goal. What it reaches needs no learning."""

import math

import jax.numpy as jnp

from scenefactory_jax.core.instantiate import ConfigError, check_number
from scenefactory_jax.core.types import Policy


def make(
    *,
    wheelbase_m: float,
    steering_limit_rad: float,
    speed_mps: float,
    speed_band_mps: float,
    goal_scale_m: float,
    speed_scale_mps: float,
) -> Policy:
    """Pure pursuit of the goal itself (Coulter 1992, "Implementation of the pure pursuit path tracking algorithm"): no lane, nobody else.

    A circle that starts along the car's axis and leads through a point at distance d and bearing b has the curvature 2 sin(b) / d; a goal
    behind the car takes the wheel as far as it goes. A throttle below zero brakes where the controls are `one_pedal`.

    Args:
        wheelbase_m: of the cars that it drives, with `steering_limit_rad`, the angle of the front wheels at an action of one.
        speed_mps: that it holds.
        speed_band_mps: so far from that speed the pedal is down all the way.
        goal_scale_m: `observations.ego.distance_scale_m`: what the observed goal was divided by.
        speed_scale_mps: `observations.ego.speed_scale_mps`, likewise.

    Returns:
        A policy without parameters that matter: it reads none, so it can be judged in place of any other. Its values are zero.

    Raises:
        ConfigError: a number that is not positive; at `apply`, an observation without `ego`.
    """
    numbers = {"wheelbase_m": wheelbase_m, "speed_mps": speed_mps, "speed_band_mps": speed_band_mps}
    numbers |= {"goal_scale_m": goal_scale_m, "speed_scale_mps": speed_scale_mps}
    for name, value in numbers.items():
        check_number(value, where=f"policy.{name}", above=0.0)
    check_number(steering_limit_rad, where="policy.steering_limit_rad", above=0.0, below=math.pi / 2)

    def init(key, observation):
        return {}

    def apply(parameters, observation):
        if "ego" not in observation:
            has = ", ".join(sorted(observation)) or "none"
            raise ConfigError(f"policy: a seeker needs the group `ego` of the observation; it has: {has}")
        ego = observation["ego"]
        sine, cosine, distance_m = ego[..., 2], ego[..., 3], jnp.maximum(goal_scale_m * ego[..., 4], 1.0)
        bend = jnp.arctan(wheelbase_m * 2.0 * sine / distance_m)
        steer = jnp.where(cosine > 0.0, bend / steering_limit_rad, jnp.copysign(1.0, sine))
        throttle = (speed_mps - speed_scale_mps * ego[..., 5]) / speed_band_mps
        mean = jnp.stack([throttle, steer, -jnp.ones_like(steer)], axis=-1)
        return jnp.clip(mean, -1.0, 1.0), jnp.zeros(3), jnp.zeros_like(steer)

    return Policy(init, apply)
