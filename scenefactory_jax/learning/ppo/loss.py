"""The PPO loss (Schulman et al. 2017) with the details of RSL-RL: clipped value loss, exact KL divergence of diagonal Gaussians.

Every mean is over the samples that carry weight: a slot without an active agent changes nothing.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.learning import gaussian, replay_buffer
from scenefactory_jax.learning.means import partial_mean, weighted_mean
from scenefactory_jax.learning.ppo.config import PPOConfig


@pytree_dataclass
class Batch:
    """Samples in any order, with the outputs of the policy that acted."""

    observation: Observation
    action: Float[Array, "N 3"]
    mean: Float[Array, "N 3"]
    log_std: Float[Array, "N 3"]
    log_probability: Float[Array, " N"]
    value: Float[Array, "N *values"]
    advantage: Float[Array, " N"]
    returns: Float[Array, "N *values"]
    weight: Float[Array, " N"]


def take_minibatch(batch: Batch, index: Int[Array, " size"]) -> Batch:
    """Takes samples of a batch, with their observations as float32."""
    minibatch = jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds", unique_indices=True), batch)
    return replace(minibatch, observation=replay_buffer.expand(minibatch.observation))


def compute_loss(
    parameters: Any, batch: Batch, *, policy: Policy, config: PPOConfig, axis: str | None = None
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes clipped surrogate + value loss - entropy bonus, and metrics; on several devices, each device's summand of them.

    The loss of several values is the sum of theirs.

    Args:
        axis: mesh axis of the devices that share the samples.
    """
    mean, log_std, value = policy.apply(parameters, batch.observation)
    weight, clip_eps, value_clip = batch.weight, config.clip_eps, config.value_clip
    average = functools.partial(partial_mean, weight=weight, total=sharding.sum_over_devices(jnp.sum(weight), axis))
    # the contents of an empty slot must not reach a gradient, not even as 0 x inf
    change = gaussian.log_probability(batch.action, mean, log_std) - batch.log_probability
    change, advantage = (jnp.where(weight > 0.0, x, 0.0) for x in (change, batch.advantage))
    has_weight = weight > 0.0 if value.ndim == 1 else weight[:, None] > 0.0
    old, target = (jnp.where(has_weight, x, 0.0) for x in (batch.value, batch.returns))

    ratio = jnp.exp(change)
    policy_loss = -average(clip_surrogate(ratio, advantage, clip_eps))

    errors = (value - target) ** 2
    if value_clip is not None:
        clipped = old + jnp.clip(value - old, -value_clip, value_clip)
        errors = jnp.maximum(errors, (clipped - target) ** 2)
    value_loss = average(errors if errors.ndim == 1 else jnp.sum(errors, axis=-1))

    entropy = average(jnp.broadcast_to(gaussian.entropy(log_std), weight.shape))
    total = policy_loss + config.vf_coef * value_loss - config.ent_coef * entropy
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "kl": average(gaussian.kl_divergence(batch.mean, batch.log_std, mean, log_std)),
        "clip_fraction": average((jnp.abs(ratio - 1.0) > clip_eps).astype(jnp.float32)),
    }
    return total, jax.lax.stop_gradient(metrics)


def clip_surrogate(ratio: Float[Array, "*batch"], advantage: Float[Array, "*batch"], clip_eps: float) -> Float[Array, "*batch"]:
    """Computes what a probability ratio gains, which has a bound where the ratio has left [1 - clip_eps, 1 + clip_eps]."""
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip_eps, 1.0 + clip_eps) * advantage)


def normalize_advantages(x: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None) -> Float[Array, "*batch"]:
    """Scales to zero mean and unit standard deviation over the samples with weight; zero elsewhere."""
    centred = jnp.where(weight > 0.0, x - weighted_mean(x, weight, axis=axis), 0.0)
    return centred / (jnp.sqrt(weighted_mean(centred**2, weight, axis=axis)) + 1e-8)


def explained_variance(
    value: Float[Array, "*batch"], returns: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None
) -> Float[Array, ""]:
    """Computes 1 - Var[return - value] / Var[return]: 1 is a perfect critic, 0 one no better than a constant."""
    mean, error = functools.partial(weighted_mean, weight=weight, axis=axis), returns - value
    spread, left = mean((returns - mean(returns)) ** 2), mean((error - mean(error)) ** 2)
    return 1.0 - left / jnp.maximum(spread, 1e-8)
