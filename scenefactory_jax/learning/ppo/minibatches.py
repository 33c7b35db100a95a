"""Divides the samples of a rollout into minibatches."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.rollout import take_slots


def minibatch_size(config: PPOConfig, shape: tuple[int, ...], *, groups: int = 1) -> int:
    """Computes the number of samples in a minibatch.

    Args:
        shape: worlds, slots.
        groups: of worlds, each of which gives every minibatch an equal part.

    Raises:
        ConfigError: a rollout that does not divide into the minibatches, where all of it is used; or an empty minibatch.
    """
    worlds, agents = shape
    samples = config.horizon * worlds * agents
    if worlds % groups:
        raise ConfigError(f"worlds: expected a multiple of {groups} shards, got {worlds}")
    used = int(config.horizon * count_kept(config, shape, groups=groups) * config.advantage_fraction)
    size = used // config.minibatches * groups
    if size < 1 or (config.sample_fraction == config.advantage_fraction == 1.0 and samples % (config.minibatches * groups)):
        product = f"horizon {config.horizon} x {worlds} worlds x {agents} agents = {samples} samples"
        parts = f"{config.minibatches} minibatches" + (f" of {groups} shards" if groups > 1 else "")
        fractions = f"sample_fraction {config.sample_fraction}, advantage_fraction {config.advantage_fraction}"
        raise ConfigError(f"ppo.minibatches: {product} ({fractions}) do not divide into {parts}")
    return size


def count_kept(config: PPOConfig, shape: tuple[int, ...], *, groups: int) -> int:
    """Computes how many samples of an action each group of worlds keeps; arguments as of `minibatch_size`."""
    worlds, agents = shape
    return int(worlds // groups * agents * config.sample_fraction)


def flatten(x: Array, *, groups: int) -> Array:
    """Flattens [T, W, A, ...] to [T * W * A, ...], one group of worlds after the other."""
    time, worlds, *rest = x.shape
    return x.reshape(time, groups, worlds // groups, *rest).swapaxes(0, 1).reshape(-1, *rest[1:])


def flatten_kept(x: Array, kept: Int[Array, "T G K"] | None, *, groups: int) -> Array:
    """Flattens [T, W, A, ...] to [T * G * K, ...], the slots that a rollout kept, or all; one group of worlds after the other."""
    return flatten(x if kept is None else jax.vmap(take_slots)(x, kept), groups=groups)


def select_largest(weight: Float[Array, " N"], advantage: Float[Array, " N"], *, count: int, groups: int) -> Float[Array, " N"]:
    """Takes the weight of all samples but those with the `count` largest absolute advantages of all groups, an equal part of each."""
    size = jnp.where(weight > 0.0, jnp.abs(advantage), -1.0).reshape(groups, -1)
    least = jnp.sort(size, axis=1)[:, -(count // groups), None]
    return jnp.where(size >= least, weight.reshape(groups, -1), 0.0).reshape(-1)


def split_minibatches(
    key: PRNGKeyArray, weight: Float[Array, " N"], *, minibatches: int, size: int, groups: int = 1, axis: str | None = None
) -> Int[Array, "minibatches size"]:
    """Samples random, disjoint minibatches that share the samples with weight evenly (to one sample for each group).

    In each group samples with weight come first, in a random order, and go to the minibatches in turn. If `minibatches * size` is smaller
    than the batch, samples without weight are left out first, then random others.

    Args:
        groups, axis: of this device, see `PPO`.
    """
    length, part = len(weight) // groups, size // groups

    def split_group(key: PRNGKeyArray, weight: Float[Array, " n"]) -> Int[Array, "minibatches part"]:
        order = jnp.argsort(jax.random.uniform(key, weight.shape) + (weight <= 0.0))
        return order[: minibatches * part].reshape(part, minibatches).T

    index = jax.vmap(split_group)(sharding.world_keys(key, groups, axis), weight.reshape(groups, length))
    index = index + length * jnp.arange(groups)[:, None, None]
    return index.swapaxes(0, 1).reshape(minibatches, size)


def count_left_out(weight: Float[Array, " N"], total: Float[Array, ""], *, size: int, groups: int, axis: str | None) -> Float[Array, ""]:
    """Computes the fraction of the samples with weight that minibatches with `size` samples in all leave out.

    Args:
        total: weight of all samples of this device, also of those that the rollout did not keep.
    """
    active = weight.reshape(groups, -1).sum(axis=1)
    total, used = sharding.sum_over_devices((total, jnp.minimum(active, size // groups).sum()), axis)
    return (total - used) / jnp.maximum(total, 1.0)
