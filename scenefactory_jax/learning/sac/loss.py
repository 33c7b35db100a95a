"""The losses of SAC (Haarnoja et al. 2018, arXiv:1812.05905): the critics' target, the actor and the weight of the entropy.

Every mean is over the samples of all devices; a loss is a device's summand of it, and `total` the weight of all samples.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Observation
from scenefactory_jax.learning import gaussian
from scenefactory_jax.learning.critics import compute_critic_loss
from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.networks.squashed import Networks


def sample_action(
    mean: Float[Array, "*batch D"], std: Float[Array, "*batch D"], noise: Float[Array, "*batch D"]
) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch"]]:
    """Computes the actions of standard normal noise, and the logarithms of their densities."""
    raw = mean + std * noise
    return jnp.tanh(raw), gaussian.squashed_log_probability(raw, mean, std)


def compute_target(
    reward: Float[Array, "*batch"],
    follows: Float[Array, "*batch"],
    next_values: Float[Array, "2 *batch"],
    next_log_probability: Float[Array, "*batch"],
    *,
    alpha: Float[Array, ""],
    gamma: float,
) -> Float[Array, "*batch"]:
    """Computes the critics' target, r + gamma (min Q' - alpha log pi); nothing follows a termination.

    Args:
        next_values: of the target critics, for an action of the present policy in the next observation.
        follows: 0 where an event ended the agent, else 1.
    """
    return reward + gamma * follows * (jnp.min(next_values, axis=0) - alpha * next_log_probability)


def compute_actor_loss(
    parameters: Any,
    critics: Any,
    observation: Observation,
    noise: Float[Array, "*batch D"],
    weight: Float[Array, "*batch"],
    *,
    alpha: Float[Array, ""],
    raw_penalty: float,
    networks: Networks,
    total: Array,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the mean of alpha log pi - min Q, of actions of the noise, and of the penalty on means before the tanh."""
    mean, std = networks.distribution(parameters, observation)
    action, log_probability = sample_action(mean, std, noise)
    value = jnp.min(networks.critic.apply(critics, observation, action), axis=0)
    average = functools.partial(partial_mean, weight=weight, total=total)
    loss = average(alpha * log_probability - value + raw_penalty * jnp.sum(mean**2, axis=-1))
    return loss, jax.lax.stop_gradient({"actor_loss": loss, "entropy": -average(log_probability)})


def compute_losses(
    trees: tuple[Any, Any],
    rows: dict[str, Any],
    target: Float[Array, "*batch"],
    noise: Float[Array, "*batch D"],
    weight: Float[Array, "*batch"],
    *,
    alpha: Float[Array, ""],
    raw_penalty: float,
    networks: Networks,
    total: Array,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the sum of the losses of actor and critics, each of which moves its own network.

    The features of the observation are computed once for both, and in one pass: with small batches it is the number of passes that takes
    the time of a GPU.

    Args:
        trees: parameters of the actor, and of the critics.
        target: of the critics.
        noise: of the actor's actions.
    """
    parameters, critics = trees
    observation = rows["observation"]
    features = networks.encode(parameters, critics, observation)
    frozen = networks.read(jnp.concatenate([features[:1], jax.lax.stop_gradient(features[1:])]))
    critic_loss, metrics = compute_critic_loss(critics, rows, target, weight, networks=networks.read(features), total=total)
    numbers: dict[str, Any] = {"alpha": alpha, "raw_penalty": raw_penalty, "networks": frozen, "total": total}
    actor_loss, found = compute_actor_loss(parameters, jax.lax.stop_gradient(critics), observation, noise, weight, **numbers)
    return critic_loss + actor_loss, metrics | found


def compute_alpha_loss(log_alpha: Float[Array, ""], entropy: Float[Array, ""], *, target: float | Float[Array, ""]) -> Float[Array, ""]:
    """Computes alpha (entropy - target), which falls with alpha where the entropy is above its target."""
    return jnp.exp(log_alpha) * (entropy - target)
