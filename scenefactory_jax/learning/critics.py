"""What actor-critic learners off policy share: the critics' loss."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.networks.squashed import Networks


def compute_critic_loss(
    critics: Any, rows: dict[str, Any], target: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, networks: Networks, total: Array
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes half the mean squared error of both critics; on several devices, each device's summand of it.

    Args:
        total: weight of the samples of all devices.
    """
    values = networks.critic.apply(critics, rows["observation"], rows["action"])
    mean = functools.partial(partial_mean, weight=weight, total=total)
    loss = mean(0.5 * jnp.mean((values - target) ** 2, axis=0))
    return loss, jax.lax.stop_gradient({"critic_loss": loss, "value": mean(values[0]), "target": mean(target)})
