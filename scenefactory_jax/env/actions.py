"""What an action means: functions from an agent's numbers in [-1, 1] to throttle, steer and brake."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def separate_pedals(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer, brake as they are; dynamics take a pedal below zero as released (the paper's action)."""
    return action


def one_pedal(action: Float[Array, "A 3"]) -> Float[Array, "A 3"]:
    """Throttle, steer, brake, where a throttle below zero brakes, too; of the two brakes the stronger one counts.

    A policy that explores with noise about its mean meets the brakes as soon as it lifts its foot. With `pedals` it has to press one
    while it releases the other, and a brake whose mean lies well below zero has no slope: trained policies were seen to run into the car
    ahead without touching it.
    """
    throttle, steer, brake = action.T
    return jnp.stack([jnp.maximum(throttle, 0.0), steer, jnp.maximum(brake, -throttle)], axis=1)
