"""The PPO loss (Schulman et al. 2017) with the details of RSL-RL: clipped value loss, exact KL of diagonal Gaussians.

Every mean is over the samples that carry weight: a slot without an active agent moves nothing.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.types import Observation, Policy


@pytree_dataclass
class Batch:
    """Samples to learn from, in any order; what the policy said about them when it acted."""

    observation: Observation
    action: Float[Array, "N 3"]
    mean: Float[Array, "N 3"]
    log_probability: Float[Array, " N"]
    value: Float[Array, " N"]
    advantage: Float[Array, " N"]
    returns: Float[Array, " N"]
    weight: Float[Array, " N"]


def compute_loss(
    parameters: Any,
    batch: Batch,
    log_std_old: Float[Array, " 3"],
    *,
    policy: Policy,
    clip: float,
    value_clip: float | None,
    entropy: float,
    value: float,
    axis: str | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Clipped surrogate + value loss - entropy bonus, and what is worth watching; of several devices, each one's share of them.

    Args:
        log_std_old: of the policy that acted.
        clip: epsilon of the probability ratio.
        value_clip: largest distance from the value at acting time that a gradient may ask for; None does not bound it. The published code
            takes `clip`, which lets the critic move 0.15 an iteration where returns are tens.
        entropy: weight of the entropy bonus.
        value: weight of the value loss.
        axis: of the devices that share the samples: their shares are still to be added up.
    """
    mean, log_std, estimate = policy.apply(parameters, batch.observation)
    weight = batch.weight
    whole = sharding.sum_over_devices(jnp.sum(weight), axis)
    weighted = functools.partial(active_fraction, weight=weight, whole=whole)
    # what an empty slot holds must not reach a gradient, not even as 0 x inf
    change = log_probability(batch.action, mean, log_std) - batch.log_probability
    change, advantage, old, target = (jnp.where(weight > 0.0, x, 0.0) for x in (change, batch.advantage, batch.value, batch.returns))

    ratio = jnp.exp(change)
    policy_loss = -weighted(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage))

    errors = (estimate - target) ** 2
    if value_clip is not None:
        near = old + jnp.clip(estimate - old, -value_clip, value_clip)
        errors = jnp.maximum(errors, (near - target) ** 2)
    value_loss = weighted(errors)

    bonus = weighted(jnp.broadcast_to(gaussian_entropy(log_std), weight.shape))
    loss = policy_loss + value * value_loss - entropy * bonus
    facts = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": bonus,
        "kl": weighted(kl_divergence(batch.mean, log_std_old, mean, log_std)),
        "clip_fraction": weighted((jnp.abs(ratio - 1.0) > clip).astype(jnp.float32)),
    }
    return loss, jax.lax.stop_gradient(facts)


def log_probability(
    action: Float[Array, "*batch D"], mean: Float[Array, "*batch D"], log_std: Float[Array, " D"]
) -> Float[Array, "*batch"]:
    """Log density of an action, before any clipping, under a diagonal Gaussian."""
    z = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(z**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)


def gaussian_entropy(log_std: Float[Array, " D"]) -> Float[Array, ""]:
    """Differential entropy of a diagonal Gaussian, nats."""
    return jnp.sum(log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))


def kl_divergence(
    mean_old: Float[Array, "*batch D"], log_std_old: Float[Array, " D"], mean: Float[Array, "*batch D"], log_std: Float[Array, " D"]
) -> Float[Array, "*batch"]:
    """KL(old || new) of diagonal Gaussians, nats."""
    variance_ratio = jnp.exp(2.0 * (log_std_old - log_std))
    shift = (mean_old - mean) * jnp.exp(-log_std)
    return 0.5 * jnp.sum(variance_ratio + shift**2 - 1.0 - 2.0 * (log_std_old - log_std), axis=-1)


def active_fraction(x: Float[Array, "*batch"], *, weight: Float[Array, "*batch"], whole: Float[Array, ""]) -> Float[Array, ""]:
    """Part of these samples in a weighted mean over samples of the weight `whole`. A value without weight may be anything, even NaN."""
    return jnp.sum(jnp.where(weight > 0.0, x * weight, 0.0)) / jnp.maximum(whole, 1e-8)


def weighted_mean(x: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None) -> Float[Array, ""]:
    """Mean over what carries weight, on all devices; zero if nothing does."""
    return sharding.sum_over_devices(active_fraction(x, weight=weight, whole=sharding.sum_over_devices(jnp.sum(weight), axis)), axis)


def normalize_advantages(x: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None) -> Float[Array, "*batch"]:
    """To zero mean and unit standard deviation over what carries weight; zero elsewhere."""
    centred = jnp.where(weight > 0.0, x - weighted_mean(x, weight, axis=axis), 0.0)
    return centred / (jnp.sqrt(weighted_mean(centred**2, weight, axis=axis)) + 1e-8)


def explained_variance(
    value: Float[Array, "*batch"], returns: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None
) -> Float[Array, ""]:
    """1 - Var[return - value] / Var[return]: 1 is a perfect critic, 0 one no better than a constant."""
    mean, error = functools.partial(weighted_mean, weight=weight, axis=axis), returns - value
    spread, left = mean((returns - mean(returns)) ** 2), mean((error - mean(error)) ** 2)
    return 1.0 - left / jnp.maximum(spread, 1e-8)
