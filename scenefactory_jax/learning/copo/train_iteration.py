"""Coordinated policy optimization (CoPO, Peng et al. 2021): PPO that learns how much agents care for their neighbourhood.

Read from the top: `train_iteration` collects a rollout and computes advantages of three rewards, the agent's own, its neighbourhood's and
that of all (`compute_advantages`). PPO learns from a mix of the first two by each agent's coordination factor. The distribution of factors
then moves to where that step would have gained more for all (`update_distribution`). On a mesh all of this runs on every device, as PPO.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

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
from scenefactory_jax.learning import gaussian, off_policy, rollout, trainer
from scenefactory_jax.learning.copo import coordination
from scenefactory_jax.learning.copo.config import CoPOConfig
from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.off_policy import Learnt
from scenefactory_jax.learning.ppo import gae, loss
from scenefactory_jax.learning.ppo import train_iteration as ppo_iteration
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.ppo.minibatches import flatten_kept, minibatch_size, split_minibatches
from scenefactory_jax.learning.ppo.train_iteration import PPO
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState

NAME = "copo"  # key in the train state, and the first part of metrics' names
INDIVIDUAL, NEIGHBOURHOOD, GLOBAL = range(3)  # of rewards, values and advantages


@dataclasses.dataclass(frozen=True)
class CoPO:
    """The constants of all iterations."""

    ppo: PPO
    config: CoPOConfig

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam, of the distribution."""
        return optax.adam(self.config.learning_rate)


def train_iteration(copo: CoPO, train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
    """Computes one iteration: rollout, advantages, PPO, distribution of factors."""
    ppo, axis, before, learnt = copo.ppo, copo.ppo.axis, train_state.parameters, train_state.learner[NAME]
    rollout_key, factor_key, update_key, learn_key, key = jax.random.split(train_state.key, 5)
    collected = ppo_iteration.collect(ppo, train_state, scenes, rollout_key)
    samples, ended = collected.samples, collected.samples.terminated | collected.samples.truncated
    factors, next_factors = coordination.follow_factors(learnt.parameters, train_state.buffer[NAME], ended, factor_key, axis=axis)

    last_value = ppo.policy.apply(before, collected.worlds.observation)[2]
    advantage, returns = compute_advantages(copo, samples, last_value)
    mixed = coordination.coordinate(advantage[..., INDIVIDUAL], advantage[..., NEIGHBOURHOOD], factors)
    batch = ppo_iteration.make_batch(ppo, samples, mixed, returns)
    train_state, metrics = ppo_iteration.learn_batch(ppo, replace(train_state, key=key), collected, batch, update_key)

    advantage = flatten_kept(advantage, samples.kept, groups=ppo.groups)
    size = minibatch_size(ppo.config, collected.worlds.state.active.shape, groups=ppo.groups)
    learnt, more = update_distribution(copo, learnt, before, train_state.parameters, batch, advantage, learn_key, size=size)
    explained = jax.vmap(functools.partial(loss.explained_variance, axis=axis), in_axes=(-1, -1, None))
    parts = explained(batch.value, batch.returns, batch.weight)
    more |= {"explained_variance_neighbourhood": parts[NEIGHBOURHOOD], "explained_variance_global": parts[GLOBAL]}
    metrics |= {"ppo/explained_variance": parts[INDIVIDUAL]} | {f"{NAME}/{name}": value for name, value in more.items()}
    return to_strong_type(replace(train_state, learner={NAME: learnt}, buffer={NAME: next_factors})), metrics


def compute_advantages(
    copo: CoPO, samples: rollout.Sample, last_value: Float[Array, "W A 3"]
) -> tuple[Float[Array, "T W A 3"], Float[Array, "T W A 3"]]:
    """Computes advantages and returns of the three rewards, each with its own value."""
    config, active = copo.ppo.config, samples.active
    reward = config.reward_scaling * samples.reward
    neighbourhood = coordination.compute_neighbourhood_reward(reward, active, samples.position, radius_m=copo.config.radius_m)
    rewards = jnp.stack([reward, neighbourhood, coordination.compute_global_reward(reward, active)], axis=-1)
    compute = functools.partial(gae.compute_gae, gamma=config.gamma, gae_lambda=config.gae_lambda)
    of_each = jax.vmap(compute, in_axes=(-1, -1, -1, None, None, None), out_axes=-1)
    return of_each(rewards, samples.value, last_value, active, samples.terminated, samples.truncated)


def update_distribution(
    copo: CoPO,
    learnt: Learnt,
    before: Any,
    after: Any,
    batch: loss.Batch,
    advantage: Float[Array, "N 3"],
    key: PRNGKeyArray,
    *,
    size: int,
) -> tuple[Learnt, Metrics]:
    """Moves the distribution of factors up the objective of all agents, `passes` times over the same minibatches.

    A step along the coordinated gradient, theta' = theta + rate grad E[log pi(a|s) A_phi], changes the global objective J by
    rate <grad J(theta'), grad E[log pi(a|s) dA_phi]> where the distribution changes A_phi by dA_phi. A_phi is a sum of two advantages,
    so that the products with their gradients, `alignment`, are all that a minibatch has to say.

    Args:
        before, after: parameters of the policy that acted, and of the one that PPO made of it.
        advantage: of the batch's samples, before normalization.
        size: samples of a minibatch.
    """
    ppo = copo.ppo
    advantage = advantage.at[:, GLOBAL].set(loss.normalize_advantages(advantage[:, GLOBAL], batch.weight, axis=ppo.axis))
    index = split_minibatches(key, batch.weight, minibatches=ppo.config.minibatches, size=size, groups=ppo.groups, axis=ppo.axis)
    alignment = jax.lax.map(functools.partial(compute_alignment, copo, before, after, batch, advantage), index)

    def objective(distribution: coordination.Distribution, alignment: Float[Array, "2"]) -> Float[Array, ""]:
        return -coordination.expect_coordinated(distribution, *alignment)

    def step(learnt: Learnt, alignment: Float[Array, "2"]) -> tuple[Learnt, None]:
        gradient = jax.grad(objective)(learnt.parameters, alignment)
        updates, optimizer = copo.optimizer.update(gradient, learnt.optimizer)
        moved = Learnt(optax.apply_updates(learnt.parameters, updates), (), optimizer)
        return off_policy.select(jnp.all(jnp.isfinite(alignment)), moved, learnt), None

    learnt, _ = jax.lax.scan(step, learnt, jnp.tile(alignment, (copo.config.passes, 1)))
    individual, neighbourhood = jnp.mean(alignment, axis=0)
    return learnt, {
        "lcf_mean": learnt.parameters.mean,
        "lcf_std": learnt.parameters.std,
        "alignment_individual": individual,
        "alignment_neighbourhood": neighbourhood,
    }


def compute_alignment(
    copo: CoPO, before: Any, after: Any, batch: loss.Batch, advantage: Float[Array, "N 3"], index: Int[Array, " size"]
) -> Float[Array, "2"]:
    """Computes the scalar products of the global objective's gradient, at the new policy, with the gradients that the individual and the
    neighbourhood's advantages gave the old one, over one minibatch."""
    ppo = copo.ppo
    batch, advantage = loss.take_minibatch(batch, index), advantage[index]
    has_weight = batch.weight > 0.0
    average = functools.partial(partial_mean, weight=batch.weight, total=sharding.sum_over_devices(jnp.sum(batch.weight), ppo.axis))
    individual, neighbourhood, of_all = jnp.where(has_weight, advantage.T, 0.0)

    def log_probability(parameters: Any) -> Float[Array, " size"]:
        mean, log_std, _ = ppo.policy.apply(parameters, batch.observation)
        return gaussian.log_probability(batch.action, mean, log_std)

    def global_objective(parameters: Any) -> Float[Array, ""]:
        ratio = jnp.exp(jnp.where(has_weight, log_probability(parameters) - batch.log_probability, 0.0))
        return average(loss.clip_surrogate(ratio, of_all, ppo.config.clip_eps))

    def objectives(parameters: Any) -> tuple[Float[Array, ""], Float[Array, ""]]:
        density = jnp.where(has_weight, log_probability(parameters), 0.0)
        return average(density * individual), average(density * neighbourhood)

    pull = jax.vjp(objectives, before)[1]
    one, zero = jnp.float32(1.0), jnp.float32(0.0)
    gradients = jax.grad(global_objective)(after), pull((one, zero))[0], pull((zero, one))[0]
    of_all, *own = sharding.sum_over_devices(gradients, ppo.axis)
    return jnp.stack([optax.tree.vdot(of_all, gradient) for gradient in own])


def init(copo: CoPO, shards: int, starts: int, key: PRNGKeyArray, scenes: Scene) -> TrainState:
    """Computes the train state before the first iteration, with a factor for each slot.

    Raises:
        ConfigError: a policy without three values; a rollout that does not divide into PPO's minibatches.
    """
    train_state = ppo_iteration.init(copo.ppo, shards, starts, key, scenes)
    worlds, config = train_state.worlds, copo.config
    value = jax.eval_shape(copo.ppo.policy.apply, train_state.parameters, worlds.observation)[2]
    if value.shape != (*worlds.state.active.shape, config.values):
        raise ConfigError(f"policy: learner copo needs one with {config.values} values; valid: policy=late_fusion, policy=actor_critic")
    distribution = coordination.make_distribution(config.lcf_mean, config.lcf_std)
    slots = jnp.zeros(worlds.state.active.shape, jnp.float32)
    factors = coordination.sample_factors(distribution, jax.random.fold_in(trainer.split_key(key)[0], 1), slots, axis=None)
    learnt = Learnt(distribution, (), copo.optimizer.init(distribution))  # pyright: ignore[reportArgumentType]
    return trainer.copy_leaves(replace(train_state, learner={NAME: learnt}, buffer={NAME: factors}))


def make_trainer(
    env: Env, policy: Policy, ppo_config: PPOConfig, config: CoPOConfig, *, episode_steps: int, mesh: Mesh | None = None
) -> Trainer:
    """Builds a trainer for one environment and one policy; arguments as of PPO.

    Raises:
        ConfigError: shards that the devices do not divide.
    """
    ppo, shards = ppo_iteration.make_constants(env, policy, ppo_config, mesh)
    copo, starts = CoPO(ppo, config), trainer.count_starts(env, episode_steps, staggered=ppo_config.stagger_episodes)
    iterate = functools.partial(train_iteration, copo)
    return trainer.compile_trainer(functools.partial(init, copo, shards, starts), iterate, env, starts=starts, mesh=mesh)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is CoPO; the numbers of PPO are the group `ppo`."""
    own, ppo = off_policy.read_numbers(config, CoPOConfig), schema.read(config["ppo"], PPOConfig, where="ppo")
    return make_trainer(env, policy, ppo, own, episode_steps=environment.episode_steps(config["timing"]), mesh=mesh)
