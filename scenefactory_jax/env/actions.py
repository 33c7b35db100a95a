"""Actions: functions from an agent's numbers in [-1, 1] to throttle, steer and brake, the choices of `actions.command`."""

import jax.numpy as jnp
from jaxtyping import Array, Float


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
