"""The losses of behaviour cloning: how far the policy's actions are from the expert's."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Observation
from scenefactory_jax.learning import gaussian
from scenefactory_jax.learning.bc.config import Loss
from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.networks.squashed import Networks


def compute_loss(
    parameters: Any,
    observation: Observation,
    action: Float[Array, "*batch D"],
    noise: Float[Array, "*batch D"],
    weight: Float[Array, "*batch"],
    *,
    kind: Loss,
    networks: Networks,
    total: Array,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the mean loss; on several devices, each device's summand of it.

    squared_error: of the policy's deterministic action, mean over the numbers of an action. sampled_squared_error: of an action that is
    sampled by `noise`. log_likelihood: minus the log density of the expert's action.

    Args:
        action: of the expert.
        noise: standard normal numbers.
        total: weight of the samples of all devices.
    """
    mean, std = networks.distribution(parameters, observation)
    errors = jnp.mean((jnp.tanh(mean) - action) ** 2, axis=-1)
    losses = errors
    if kind == "sampled_squared_error":
        losses = jnp.mean((jnp.tanh(mean + std * noise) - action) ** 2, axis=-1)
    elif kind == "log_likelihood":
        losses = -gaussian.squashed_log_probability(gaussian.unsquash(action), mean, std)
    loss, error = (partial_mean(x, weight=weight, total=total) for x in (losses, errors))
    return loss, jax.lax.stop_gradient({"loss": loss, "squared_error": error})
