"""Learning: epochs of minibatches over one rollout, with a learning rate that follows the KL divergence."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.agents.ppo.optimizer import adaptive_kl_learning_rate
from jaxtyping import Array, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.learning.ppo.loss import Batch

Loss = Callable[[Any, Batch, Float[Array, " 3"]], tuple[Float[Array, ""], dict[str, Float[Array, ""]]]]


class AdaptiveRate(NamedTuple):
    """The learning rate is divided by 1.5 above twice `desired_kl`, multiplied by 1.5 below half of it, within bounds; None holds it.

    After `halved` iterations the upper bound is a half of `maximum`, after twice that a third, and so on: steps of the size 1 / t, with
    which noisy gradients converge (Robbins and Monro 1951), without asking how long the training will be. None: it stays.
    """

    desired_kl: float | None
    minimum: float
    maximum: float
    halved: float | None = None

    def at(self, iteration: Int[Array, ""]) -> "AdaptiveRate":
        """With the upper bound of that iteration, an array if it falls."""
        if self.halved is None:
            return self
        return self._replace(maximum=jnp.maximum(self.maximum / (1.0 + iteration / self.halved), self.minimum))  # pyright: ignore


def make_optimizer(*, learning_rate: float, max_grad_norm: float) -> optax.GradientTransformation:
    """Adam behind a bound on the gradient's norm over all parameters; its learning rate is part of its state."""
    adam = optax.inject_hyperparams(optax.adam)(learning_rate=learning_rate)
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), adam)


def update_epochs(
    parameters: Any,
    optimiser_state: optax.OptState,
    batch: Batch,
    log_std_old: Float[Array, " 3"],
    key: PRNGKeyArray,
    iteration: Int[Array, ""],
    *,
    loss: Loss,
    optimiser: optax.GradientTransformation,
    rate: AdaptiveRate,
    epochs: int,
    minibatches: int,
    size: int,
    permute_each_epoch: bool,
    groups: int = 1,
    axis: str | None = None,
) -> tuple[Any, optax.OptState, dict[str, Float[Array, ""]]]:
    """Pass `epochs` times over the batch in `minibatches` of `size` samples each.

    Args:
        groups: equal stretches of the batch that are shuffled on their own and give every minibatch an equal part.
        axis: of the devices that share the samples: `batch`, `size` and `groups` are one device's, everything else is the same on all.

    Returns:
        parameters, optimiser state, and what the loss reports as means over the minibatches that moved the parameters; `skipped` counts
        those whose loss or gradient was not finite, `left_out` is the share of samples with weight that no minibatch holds.
    """
    rate = rate.at(iteration)
    step = functools.partial(_minibatch, loss=loss, optimiser=optimiser, rate=rate, batch=batch, log_std_old=log_std_old, axis=axis)
    deal = functools.partial(split_minibatches, weight=batch.weight, minibatches=minibatches, size=size, groups=groups, axis=axis)

    def epoch(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict]:
        return jax.lax.scan(step, carry, deal(key))

    keys = jax.random.split(key, epochs) if permute_each_epoch else jnp.broadcast_to(key, (epochs,))
    (parameters, optimiser_state), facts = jax.lax.scan(epoch, (parameters, optimiser_state), keys)
    moved, broken = facts.pop("moved"), facts.pop("broken")
    means = {name: jnp.sum(jnp.where(moved, fact, 0.0)) / jnp.maximum(jnp.sum(moved), 1) for name, fact in facts.items()}
    held = batch.weight.reshape(groups, -1).sum(axis=1)
    weight, dealt = sharding.sum_over_devices((held.sum(), jnp.minimum(held, minibatches * (size // groups)).sum()), axis)
    counted = {
        "skipped": jnp.sum(broken, dtype=jnp.float32),
        "learning_rate": optimiser_state[-1].hyperparams["learning_rate"],  # pyright: ignore
        "left_out": (weight - dealt) / jnp.maximum(weight, 1.0),
    }
    return parameters, optimiser_state, {**means, **counted}


def split_minibatches(
    key: PRNGKeyArray, weight: Float[Array, " N"], *, minibatches: int, size: int, groups: int = 1, axis: str | None = None
) -> Int[Array, "minibatches size"]:
    """Random, disjoint minibatches that share the samples with weight evenly (to one for each group).

    In each group samples with weight come first in a random order and are dealt out like cards; if `minibatches * size` is smaller than
    the batch, samples without weight are the ones left out, then random others.
    """
    each, part = len(weight) // groups, size // groups

    def deal(key: PRNGKeyArray, weight: Float[Array, " n"]) -> Int[Array, "minibatches part"]:
        order = jnp.argsort(jax.random.uniform(key, weight.shape) + (weight <= 0.0))
        return order[: minibatches * part].reshape(part, minibatches).T

    dealt = jax.vmap(deal)(sharding.world_keys(key, groups, axis), weight.reshape(groups, each)) + each * jnp.arange(groups)[:, None, None]
    return dealt.swapaxes(0, 1).reshape(minibatches, size)


def _minibatch(
    carry: tuple[Any, optax.OptState],
    index: Int[Array, " size"],
    *,
    loss: Loss,
    optimiser: optax.GradientTransformation,
    rate: AdaptiveRate,
    batch: Batch,
    log_std_old: Float[Array, " 3"],
    axis: str | None,
) -> tuple[tuple[Any, optax.OptState], dict[str, Array]]:
    """One gradient step; where it is not finite, or no sample has weight, everything stays as it was."""
    parameters, state = carry
    part = jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds", unique_indices=True), batch)
    (total, facts), gradient = sharding.sum_over_devices(jax.value_and_grad(loss, has_aux=True)(parameters, part, log_std_old), axis)
    norm = optax.global_norm(gradient)
    adapted = jax.tree.map(lambda x: x, state)  # Brax writes into the state's dict
    if rate.desired_kl is not None:
        adapted, _ = adaptive_kl_learning_rate(adapted, facts["kl"], rate.desired_kl, rate.minimum, rate.maximum)  # pyright: ignore
    if rate.halved is not None:
        own = adapted[-1].hyperparams  # pyright: ignore
        own["learning_rate"] = jnp.minimum(own["learning_rate"], rate.maximum)
    updates, adapted = optimiser.update(gradient, adapted, parameters)
    stepped = optax.apply_updates(parameters, updates)

    finite = jnp.isfinite(total) & jnp.isfinite(norm)
    moved = finite & (sharding.sum_over_devices(jnp.sum(part.weight), axis) > 0.0)
    carry = jax.tree.map(lambda new, old: jnp.where(moved, new, old), (stepped, adapted), (parameters, state))
    return carry, {**facts, "gradient_norm": norm, "broken": ~finite, "moved": moved}
