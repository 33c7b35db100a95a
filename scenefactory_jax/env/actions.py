"""Actions: functions from an agent's numbers in [-1, 1] to throttle, steer and brake, the choices of `actions.command`.

With `actions.rates` the agent's numbers say how fast the first two of those that a command reads move.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import Positive


@dataclasses.dataclass(frozen=True)
class Rates:
    """The key `rates` of the config group `actions`: what a number of 1 moves in a second."""

    up_per_s: Positive  # throttle less brake, in [-1, 1]
    down_per_s: Positive
    steer_per_s: Positive


def move(action: Float[Array, "A 3"], previous: Float[Array, "A 3"], *, rates: Rates, action_s: float) -> Float[Array, "A 3"]:
    """Moves pedals and steering from where they are, for commands of one pedal: the third number is as it was given.

    Gigaflow's cars (Cusumano-Towner et al. 2025, arXiv:2502.03349) choose their jerk in this way: noise on an action changes the driving
    smoothly, and braking can build up faster than acceleration.

    Args:
        previous: throttle, steer and brake of the last action.
        action_s: between two actions.
    """
    pedal, steer = previous[:, 0] - previous[:, 2], previous[:, 1]
    rate = jnp.where(action[:, 0] > 0.0, rates.up_per_s, rates.down_per_s) * action[:, 0]
    moved = jnp.stack([pedal + rate * action_s, steer + rates.steer_per_s * action_s * action[:, 1]], axis=1)
    return jnp.concatenate([jnp.clip(moved, -1.0, 1.0), action[:, 2:]], axis=1)


def separate_pedals(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer, brake; a pedal below zero is released (the paper's action)."""
    throttle, steer, brake = action.T
    return jnp.stack([jnp.maximum(throttle, 0.0), steer, jnp.maximum(brake, 0.0)], axis=1)


def pedals_with_reverse(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer, brake; a throttle below zero is that of the reverse gear, a brake below zero is released.

    The articulated car engages its reverse gear below `dynamics.car.reverse_speed` (`actuators.compute_drive_torque`). Bicycles have none:
    for them such a throttle is released.
    """
    throttle, steer, brake = action.T
    return jnp.stack([throttle, steer, jnp.maximum(brake, 0.0)], axis=1)


def one_pedal(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer, brake, where a throttle below zero brakes, too; the stronger brake counts.

    With `separate_pedals` a policy must press one pedal while it releases the other, and a brake whose mean is far below zero has no
    gradient: such policies drove into the car ahead without braking. Here exploration noise about a small throttle reaches the brake.
    """
    throttle, steer, brake = action.T
    return jnp.stack([jnp.maximum(throttle, 0.0), steer, jnp.maximum(brake, -throttle)], axis=1)


def acceleration_and_steering(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Acceleration and steering; the third number is not read. Below zero the acceleration brakes.

    The action of Waymax and V-Max has these two numbers (`dynamics=bicycle_waymax`).
    """
    acceleration, steer, _ = action.T
    return jnp.stack([jnp.maximum(acceleration, 0.0), steer, jnp.maximum(-acceleration, 0.0)], axis=1)
