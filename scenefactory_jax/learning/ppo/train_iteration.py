"""Multi-agent PPO (Schulman et al. 2017). All agents of all worlds share one policy; each is a sample.

Read from the top: `train_iteration` collects a rollout, computes advantages (`compute_batch`), passes over the samples in minibatches
(`update_epochs`, `update_minibatch`) and returns the next train state and its metrics. On a mesh it runs on every device, with the device's
own worlds and samples; sums over samples, and with them gradients, are sums over the devices.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int, PRNGKeyArray

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.core.pytree import replace, to_strong_type
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Env, Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import rollout, trainer
from scenefactory_jax.learning.ppo import gae, loss
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.ppo.minibatches import (
    count_kept,
    count_left_out,
    flatten,
    flatten_kept,
    minibatch_size,
    select_largest,
    split_minibatches,
)
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState


@dataclasses.dataclass(frozen=True)
class PPO:
    """The constants of all iterations."""

    env: Env
    policy: Policy
    config: PPOConfig
    axis: str | None = None  # mesh axis of the devices, inside `shard_map`; None: one device
    groups: int = 1  # of this device's worlds, see `PPOConfig.shards`

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam, with the gradient's norm bounded; the learning rate is part of its state."""
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=self.config.learning_rate)
        return optax.chain(optax.clip_by_global_norm(self.config.max_grad_norm), adam)


class Collected(NamedTuple):
    """A rollout: what `rollout.collect_rollout` returns."""

    worlds: rollout.Worlds
    samples: rollout.Sample
    counts: rollout.Counts
    scene_stats: rollout.SceneStats


def train_iteration(ppo: PPO, train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
    """Computes one iteration: rollout, advantages, epochs of minibatches, metrics."""
    rollout_key, update_key, key = jax.random.split(train_state.key, 3)
    collected = collect(ppo, train_state, scenes, rollout_key)
    return learn(ppo, replace(train_state, key=key), collected, update_key)


def collect(ppo: PPO, train_state: TrainState, scenes: Scene, key: PRNGKeyArray, *, keep_all: bool = False) -> Collected:
    """Acts in all worlds; of the observations a `sample_fraction` is kept, or all."""
    numbers = {"horizon": ppo.config.horizon, "storage": ppo.config.storage, "groups": ppo.groups, "axis": ppo.axis}
    if ppo.config.sample_fraction < 1.0 and not keep_all:
        numbers["kept"] = count_kept(ppo.config, train_state.worlds.state.active.shape, groups=ppo.groups)
    parts = rollout.collect_rollout(ppo.env, ppo.policy, train_state.parameters, scenes, train_state.worlds, key, **numbers)
    return Collected(*parts)


def learn(ppo: PPO, train_state: TrainState, collected: Collected, key: PRNGKeyArray) -> tuple[TrainState, Metrics]:
    """Learns from a rollout: advantages, epochs of minibatches, metrics."""
    last_value = ppo.policy.apply(train_state.parameters, collected.worlds.observation)[2]
    batch = compute_batch(ppo, collected.samples, last_value)
    train_state, metrics = learn_batch(ppo, train_state, collected, batch, key)
    explained = loss.explained_variance(batch.value, batch.returns, batch.weight, axis=ppo.axis)
    return train_state, metrics | {"ppo/explained_variance": explained}


def learn_batch(
    ppo: PPO, train_state: TrainState, collected: Collected, batch: loss.Batch, key: PRNGKeyArray
) -> tuple[TrainState, Metrics]:
    """Learns from a rollout whose advantages are known: epochs of minibatches, metrics.

    The metric `left_out`: fraction of the samples with weight that no minibatch holds.
    """
    config, axis = ppo.config, ppo.axis
    worlds, _, counts, scene_stats = collected
    size = minibatch_size(config, worlds.state.active.shape, groups=ppo.groups)
    parameters, optimizer, metrics = update_epochs(ppo, train_state, batch, key, size=size)
    total = jnp.sum(find_weight(collected.samples))
    metrics["left_out"] = count_left_out(batch.weight, total, size=size * config.minibatches, groups=ppo.groups, axis=axis)
    counts = sharding.sum_over_devices(counts, axis)
    train_state = replace(
        train_state,
        parameters=parameters,
        ema_parameters=trainer.advance_ema(train_state, parameters, config.parameter_ema_decay),
        optimizer=optimizer,
        worlds=worlds,
        scene_stats=jax.tree.map(jnp.add, train_state.scene_stats, sharding.gather_over_devices(scene_stats, axis)),
        iteration=train_state.iteration + 1,
        steps=trainer.add_steps(train_state.steps, counts["spawned"]),
    )
    metrics = {f"ppo/{name}": value for name, value in metrics.items()}
    return to_strong_type(train_state), rollout.compute_rollout_metrics(counts) | metrics


def compute_batch(ppo: PPO, samples: rollout.Sample, last_value: Float[Array, "W A"]) -> loss.Batch:
    """Computes advantages and returns of samples [T, W, A], as one flat batch, see `make_batch`."""
    advantage, returns = gae.compute_gae(
        ppo.config.reward_scaling * samples.reward,
        samples.value,
        last_value,
        samples.active,
        samples.terminated,
        samples.truncated,
        gamma=ppo.config.gamma,
        gae_lambda=ppo.config.gae_lambda,
    )
    return make_batch(ppo, samples, advantage, returns)


def make_batch(ppo: PPO, samples: rollout.Sample, advantage: Float[Array, "T W A"], returns: Float[Array, "T W A *values"]) -> loss.Batch:
    """Makes a flat batch of the samples [T, W, A] that were kept, with their advantages; groups of worlds follow one another."""
    acted = samples.action, samples.mean, samples.log_std, samples.log_probability, samples.value
    columns = *acted, advantage, returns, find_weight(samples)
    observation = jax.tree.map(functools.partial(flatten, groups=ppo.groups), samples.observation)
    kept = functools.partial(flatten_kept, kept=samples.kept, groups=ppo.groups)
    batch = loss.Batch(observation, *jax.tree.map(kept, columns))
    if not ppo.config.normalize_advantages:
        return batch
    return replace(batch, advantage=loss.normalize_advantages(batch.advantage, batch.weight, axis=ppo.axis))


def find_weight(samples: rollout.Sample) -> Float[Array, "T W A"]:
    """Samples of inactive agents and of agents that the time limit stopped carry no weight, all others the weight 1."""
    return (samples.active & ~samples.truncated).astype(jnp.float32)


def update_epochs(
    ppo: PPO, train_state: TrainState, batch: loss.Batch, key: PRNGKeyArray, *, size: int
) -> tuple[Any, optax.OptState, Metrics]:
    """Passes over the batch `epochs` times, in minibatches of `size` samples.

    The metrics are means of the loss's metrics over the minibatches that changed the parameters; `skipped`: minibatches whose loss or
    gradient was not finite.
    """
    config = ppo.config
    update = functools.partial(update_minibatch, ppo, batch, max_learning_rate(config, train_state.iteration))
    groups = {"groups": ppo.groups, "axis": ppo.axis}
    weight = batch.weight
    if config.advantage_fraction < 1.0:
        weight = select_largest(weight, batch.advantage, count=size * config.minibatches, groups=ppo.groups)
    split = functools.partial(split_minibatches, weight=weight, size=size, minibatches=config.minibatches, **groups)

    def epoch(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, dict[str, Array]]:
        return jax.lax.scan(update, carry, split(key))

    each = config.permutation == "each_epoch"
    keys = jax.random.split(key, config.epochs) if each else jnp.broadcast_to(key, (config.epochs,))
    (parameters, optimizer), metrics = jax.lax.scan(epoch, (train_state.parameters, train_state.optimizer), keys)
    changed, skipped = metrics.pop("changed"), metrics.pop("skipped")
    metrics = {name: jnp.sum(jnp.where(changed, x, 0.0)) / jnp.maximum(jnp.sum(changed), 1) for name, x in metrics.items()}
    metrics |= {
        "skipped": jnp.sum(skipped, dtype=jnp.float32),
        "learning_rate": _hyperparams(optimizer)["learning_rate"],
    }
    return parameters, optimizer, metrics


def update_minibatch(
    ppo: PPO,
    batch: loss.Batch,
    max_rate: float | Float[Array, ""],
    carry: tuple[Any, optax.OptState],
    index: Int[Array, " size"],
) -> tuple[tuple[Any, optax.OptState], dict[str, Array]]:
    """Makes one gradient step; nothing changes where it is not finite, or where no sample has weight."""
    parameters, optimizer = carry
    minibatch = loss.take_minibatch(batch, index)
    objective = functools.partial(loss.compute_loss, policy=ppo.policy, config=ppo.config, axis=ppo.axis)
    result = jax.value_and_grad(objective, has_aux=True)(parameters, minibatch)
    (total, metrics), gradient = sharding.sum_over_devices(result, ppo.axis)
    norm = optax.global_norm(gradient)
    adapted = jax.tree.map(lambda x: x, optimizer)  # a new dict of hyperparameters
    rate = _hyperparams(adapted)["learning_rate"]
    _hyperparams(adapted)["learning_rate"] = adapt_learning_rate(ppo.config, rate, metrics["kl"], max_rate)
    updates, adapted = ppo.optimizer.update(gradient, adapted, parameters)
    updated = optax.apply_updates(parameters, updates)

    finite = jnp.isfinite(total) & jnp.isfinite(norm)
    changed = finite & (sharding.sum_over_devices(jnp.sum(minibatch.weight), ppo.axis) > 0.0)
    carry = jax.tree.map(lambda new, old: jnp.where(changed, new, old), (updated, adapted), (parameters, optimizer))
    return carry, {**metrics, "gradient_norm": norm, "skipped": ~finite, "changed": changed}


def max_learning_rate(config: PPOConfig, iteration: Int[Array, ""]) -> float | Float[Array, ""]:
    """Computes the upper bound of the learning rate; with a half-life it falls as 1 / t, with which noisy gradients converge (Robbins and
    Monro 1951)."""
    if config.learning_rate_half_life is None:
        return config.learning_rate_max
    return jnp.maximum(config.learning_rate_max / (1.0 + iteration / config.learning_rate_half_life), config.learning_rate_min)


def adapt_learning_rate(
    config: PPOConfig, rate: Float[Array, ""], kl: Float[Array, ""], max_rate: float | Float[Array, ""]
) -> Float[Array, ""]:
    """Computes the next learning rate, as RSL-RL: divided by 1.5 above twice `desired_kl`, times 1.5 below half of it, in bounds."""
    if config.desired_kl is not None:
        rate = jnp.where(kl > config.desired_kl * 2.0, jnp.maximum(config.learning_rate_min, rate / 1.5), rate)
        rate = jnp.where((kl < config.desired_kl / 2.0) & (kl > 0.0), jnp.minimum(max_rate, rate * 1.5), rate)
    return rate if config.learning_rate_half_life is None else jnp.minimum(rate, max_rate)


def _hyperparams(optimizer: optax.OptState) -> dict[str, Any]:
    return optimizer[-1].hyperparams  # pyright: ignore


def make_trainer(env: Env, policy: Policy, config: PPOConfig, *, episode_steps: int, mesh: Mesh | None = None) -> Trainer:
    """Builds a trainer for one environment and one policy.

    Args:
        episode_steps: control steps of an episode.
        mesh: of devices with the axis `sharding.AXIS`, that share the worlds; None: one device. With the same `shards` any number of
            devices learns the same, up to rounding.
    """
    ppo, shards = make_constants(env, policy, config, mesh)
    starts = trainer.count_starts(env, episode_steps, staggered=config.stagger_episodes)
    iterate = functools.partial(train_iteration, ppo)
    return trainer.compile_trainer(functools.partial(init, ppo, shards, starts), iterate, env, starts=starts, mesh=mesh)


def make_constants(env: Env, policy: Policy, config: PPOConfig, mesh: Mesh | None) -> tuple[PPO, int]:
    """Joins the constants of all iterations; also the groups of worlds of all devices.

    Raises:
        ConfigError: shards that the devices do not divide.
    """
    axis, devices = (None, 1) if mesh is None else (sharding.AXIS, mesh.size)
    shards = devices if config.shards is None else config.shards
    if shards < 1 or shards % devices:
        raise ConfigError(f"ppo.shards: expected a multiple of {devices} devices, got {shards}")
    return PPO(env, policy, config, axis, shards // devices), shards


def init(ppo: PPO, shards: int, starts: int, key: PRNGKeyArray, scenes: Scene) -> TrainState:
    """Computes the train state before the first iteration; `shards`: of all devices, `starts`: see `trainer.start_worlds`.

    Raises:
        ConfigError: a rollout that does not divide into the minibatches.
    """
    ema = ppo.config.parameter_ema_decay is not None
    train_state = trainer.init_train_state(key, scenes, ppo.env, ppo.policy, ppo.optimizer, starts=starts, ema=ema)
    minibatch_size(ppo.config, train_state.worlds.state.active.shape, groups=shards)
    return train_state


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is PPO; its numbers are the group `ppo`."""
    schema.check_names(config["learner"], ["_target_"], where="learner", required=[])
    numbers = schema.read(config["ppo"], PPOConfig, where="ppo")
    return make_trainer(env, policy, numbers, episode_steps=environment.episode_steps(config["timing"]), mesh=mesh)
