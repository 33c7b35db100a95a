"""The losses of TD3 (Fujimoto et al. 2018, arXiv:1802.09477): the critics' target with a smoothed action, and the actor."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Observation
from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.networks.squashed import Networks


def choose_action(networks: Networks, parameters: Any, observation: Observation) -> Float[Array, "*batch D"]:
    """Computes the deterministic action."""
    return jnp.tanh(networks.distribution(parameters, observation)[0])


def smooth_action(
    action: Float[Array, "*batch D"], noise: Float[Array, "*batch D"], *, std: float, clip: float
) -> Float[Array, "*batch D"]:
    """Adds bounded noise to a target action, which stays in [-1, 1].

    Args:
        noise: standard normal numbers.
    """
    return jnp.clip(action + jnp.clip(std * noise, -clip, clip), -1.0, 1.0)


def compute_target(
    reward: Float[Array, "*batch"], follows: Float[Array, "*batch"], next_values: Float[Array, "2 *batch"], *, gamma: float
) -> Float[Array, "*batch"]:
    """Computes the critics' target, r + gamma min Q'; nothing follows a termination.

    Args:
        next_values: of the target critics, for the smoothed action of the target actor in the next observation.
        follows: 0 where an event ended the agent, else 1.
    """
    return reward + gamma * follows * jnp.min(next_values, axis=0)


def compute_actor_loss(
    parameters: Any,
    critics: Any,
    observation: Observation,
    weight: Float[Array, "*batch"],
    *,
    raw_penalty: float,
    networks: Networks,
    total: Array,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the mean of -Q of the first critic and of the penalty on numbers before the tanh; on several devices, a device's summand."""
    raw = networks.distribution(parameters, observation)[0]
    value = networks.critic.apply(critics, observation, jnp.tanh(raw))[0]
    loss = partial_mean(raw_penalty * jnp.sum(raw**2, axis=-1) - value, weight=weight, total=total)
    return loss, jax.lax.stop_gradient({"actor_loss": loss})
