"""Adversarial imitation: a discriminator tells the expert's pairs of observations from the policy's, and PPO learns to deceive it.

Read from the top: `train_iteration` collects a rollout, lets the expert drive every so many iterations (`drive_expert`), moves the
discriminator (`update_discriminator`), puts what it pays in place of the environment's reward, and learns from the rollout as PPO does.
`gail` and `airl` are discriminators. On a mesh all of this runs on every device, as PPO.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.core.pytree import replace, to_strong_type, unchecked
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Env, Observation, Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import gaussian, off_policy, replay_buffer, rollout, trainer
from scenefactory_jax.learning.adversarial.config import AdversarialConfig
from scenefactory_jax.learning.adversarial.discriminator import Discriminator, Pairs, compute_loss
from scenefactory_jax.learning.expert import make_expert
from scenefactory_jax.learning.means import weighted_mean
from scenefactory_jax.learning.networks.squashed import FULL
from scenefactory_jax.learning.off_policy import Learnt
from scenefactory_jax.learning.ppo import train_iteration as ppo_iteration
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.ppo.minibatches import flatten, split_minibatches
from scenefactory_jax.learning.ppo.train_iteration import PPO, Collected
from scenefactory_jax.learning.replay_buffer import Buffer
from scenefactory_jax.learning.rollout import Act, Transition
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState

STORED = ("observation", "action", "next_observation", "follows")  # of a transition of the expert


@dataclasses.dataclass(frozen=True)
class Imitation:
    """The constants of all iterations."""

    name: str  # of the learner: its key in the train state, and the first part of its metrics' names
    ppo: PPO
    discriminator: Discriminator
    expert: Act | None  # None: recorded samples fill the buffer
    config: AdversarialConfig
    numbers: int  # of an action that the environment reads
    expert_steps: int
    devices: int

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam, on a gradient that has the squared parameters' part."""
        return optax.chain(optax.add_decayed_weights(self.config.l2), optax.adam(self.config.learning_rate))


def train_iteration(imitation: Imitation, train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
    """Computes one iteration: rollout, expert, discriminator, rewards, PPO."""
    ppo, name, config = imitation.ppo, imitation.name, imitation.config
    rollout_key, expert_key, judge_key, update_key, key = jax.random.split(train_state.key, 5)
    collected = ppo_iteration.collect(ppo, train_state, scenes, rollout_key, keep_all=True)
    buffer = train_state.buffer[name]
    if imitation.expert is not None:
        drive = functools.partial(drive_expert, imitation, scenes, expert_key)
        buffer = jax.lax.cond(train_state.iteration % config.expert_every == 0, drive, lambda buffer: buffer, buffer)

    pairs = make_policy_pairs(imitation, train_state.parameters, collected)
    learnt, metrics = update_discriminator(imitation, train_state, pairs, buffer, judge_key)
    reward = compute_reward(imitation, learnt.parameters, pairs)
    metrics["reward"] = weighted_mean(reward, collected.samples.active.astype(jnp.float32), axis=ppo.axis)
    metrics["buffer"] = replay_buffer.count_rows(buffer, axis=ppo.axis).astype(jnp.float32)

    samples = unchecked(rollout.Sample, **vars(collected.samples) | {"reward": reward})  # annotated as those of one action
    train_state, rest = ppo_iteration.learn(ppo, replace(train_state, key=key), collected._replace(samples=samples), update_key)
    train_state = replace(train_state, learner={name: learnt}, buffer={name: buffer})
    return to_strong_type(train_state), rest | {f"{name}/{part}": value for part, value in metrics.items()}


def drive_expert(imitation: Imitation, scenes: Scene, key: PRNGKeyArray, buffer: Buffer) -> Buffer:
    """Lets the expert drive in all worlds from the start of an episode, and stores its transitions.

    Of an episode that may not fit into the buffer a random part is stored, so that its end does not crowd out its start.
    """
    env, axis, steps, expert = imitation.ppo.env, imitation.ppo.axis, imitation.expert_steps, imitation.expert
    assert expert is not None
    start_key, drive_key = jax.random.split(key)
    count = len(jax.tree.leaves(scenes)[0])
    worlds = trainer.start_each_world(env, sharding.world_keys(start_key, count, axis), scenes, starts=1)
    groups, capacity = jax.tree.leaves(buffer.rows)[0].shape[:2]
    part = min(1.0, capacity * groups / (steps * worlds.state.active.size))

    def step(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, None]:
        worlds, buffer = carry
        act_key, store_key = jax.random.split(key)
        worlds, transitions, *_ = rollout.collect_transitions(env, expert, scenes, worlds, act_key, steps=1, axis=axis)
        rows, valid = make_rows(imitation, transitions)
        chance = jax.vmap(lambda key: jax.random.uniform(key, valid.shape[2:]))(sharding.world_keys(store_key, count, axis))
        return (worlds, replay_buffer.insert(buffer, rows, valid & (chance < part)[None])), None

    return jax.lax.scan(step, (worlds, buffer), jax.random.split(drive_key, steps))[0][1]


def make_rows(imitation: Imitation, transitions: Transition) -> tuple[Any, Bool[Array, "T W A"]]:
    """Makes rows of the expert's transitions; its actions are what it did, for their probability under the policy."""
    rows, valid = off_policy.make_transition_rows(transitions, numbers=imitation.numbers, storage=imitation.config.storage)
    return {name: rows[name] for name in STORED}, valid


def make_expert_pairs(imitation: Imitation, parameters: Any, rows: dict[str, Any], weight: Float[Array, " N"]) -> Pairs:
    """Makes pairs of rows of the buffer; `parameters`: of the policy."""
    seen, after = (replay_buffer.expand(rows[name]) for name in ("observation", "next_observation"))
    mean, log_std, _ = imitation.ppo.policy.apply(parameters, seen)
    return Pairs(seen, after, rows["follows"], find_density(imitation, rows["action"], mean, log_std), weight)


def make_policy_pairs(imitation: Imitation, parameters: Any, collected: Collected) -> Pairs:
    """Makes pairs `[T, W, A]` of a rollout, in the type of the expert's, or the rounding would tell them apart."""
    worlds, samples, *_ = collected
    after: Observation = jax.tree.map(lambda seen, last: jnp.concatenate([seen[1:], last[None]]), samples.observation, worlds.observation)
    density = find_density(imitation, samples.action, samples.mean, samples.log_std)
    weight = ppo_iteration.find_weight(samples)
    seen, after = (replay_buffer.compress(group, imitation.config.storage) for group in (samples.observation, after))
    return Pairs(seen, after, ~samples.terminated, density, weight)


def find_density(imitation: Imitation, action: Array, mean: Array, log_std: Array) -> Float[Array, "*batch"]:
    """Computes the log probability of what the environment makes of an action: of the numbers that it reads, clipped."""
    return gaussian.clipped_log_probability(*(x[..., : imitation.numbers] for x in (action, mean, log_std)))


def expand(pairs: Pairs) -> Pairs:
    """Converts the numbers of stored observations back to float32."""
    return replace(pairs, **{name: replay_buffer.expand(getattr(pairs, name)) for name in ("observation", "next_observation")})


def update_discriminator(
    imitation: Imitation, train_state: TrainState, pairs: Pairs, buffer: Buffer, key: PRNGKeyArray
) -> tuple[Learnt, Metrics]:
    """Passes over the policy's pairs `[T, W, A]` in minibatches, each beside as many of the expert that are drawn anew.

    The metrics are means over the updates that changed the discriminator; `skipped`: updates that were not finite.
    """
    config, ppo, learnt = imitation.config, imitation.ppo, train_state.learner[imitation.name]
    pairs = jax.tree.map(functools.partial(flatten, groups=ppo.groups), pairs)
    size = min(config.batch // imitation.devices, len(pairs.weight))
    groups = {"groups": ppo.groups, "axis": ppo.axis}
    split = functools.partial(split_minibatches, weight=pairs.weight, minibatches=len(pairs.weight) // size, size=size, **groups)
    split_key, draw_key = jax.random.split(key)
    index = jax.lax.map(split, jax.random.split(split_key, config.passes)).reshape(-1, size)

    def update(learnt: Learnt, now: tuple[Int[Array, " size"], PRNGKeyArray]) -> tuple[Learnt, Metrics]:
        index, key = now
        policy = expand(jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds", unique_indices=True), pairs))
        rows, weight = replay_buffer.sample(buffer, key, size // ppo.groups, axis=ppo.axis)
        rows, weight = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (rows, weight))
        return update_once(imitation, learnt, make_expert_pairs(imitation, train_state.parameters, rows, weight), policy)

    learnt, metrics = jax.lax.scan(update, learnt, (index, jax.random.split(draw_key, len(index))))
    changed, skipped = metrics.pop("changed"), metrics.pop("skipped")
    metrics = {name: jnp.sum(jnp.where(changed, x, 0.0)) / jnp.maximum(jnp.sum(changed), 1) for name, x in metrics.items()}
    return learnt, metrics | {"skipped": jnp.sum(skipped, dtype=jnp.float32)}


def update_once(imitation: Imitation, learnt: Learnt, expert: Pairs, policy: Pairs) -> tuple[Learnt, Metrics]:
    """Makes one gradient step; nothing changes where it is not finite, or where either side has no pair."""
    axis = imitation.ppo.axis
    totals = sharding.sum_over_devices((jnp.sum(expert.weight), jnp.sum(policy.weight)), axis)
    objective = functools.partial(compute_loss, expert=expert, policy=policy, discriminator=imitation.discriminator, totals=totals)
    parameters, optimizer, metrics = off_policy.descend(objective, imitation.optimizer, learnt.parameters, learnt.optimizer, axis)
    finite = metrics.pop("changed")
    changed = finite & (totals[0] > 0.0) & (totals[1] > 0.0)
    return off_policy.select(changed, Learnt(parameters, (), optimizer), learnt), {**metrics, "changed": changed, "skipped": ~finite}


def compute_reward(imitation: Imitation, parameters: Any, pairs: Pairs) -> Float[Array, "T W A"]:
    """Computes what the discriminator pays, one step after the other, as the rollout was made; zero without an active agent."""
    judge = imitation.discriminator
    reward = jax.lax.map(lambda pairs: judge.reward(judge.score(parameters, expand(pairs))), pairs)
    return jnp.where(pairs.weight > 0.0, reward, 0.0)


def init(imitation: Imitation, shards: int, starts: int, key: PRNGKeyArray, scenes: Scene) -> TrainState:
    """Computes the train state before the first iteration, with an empty buffer.

    Raises:
        ConfigError: a rollout that does not divide into PPO's minibatches; a buffer that is too small for the worlds, or larger than the
            memory.
    """
    train_state = ppo_iteration.init(imitation.ppo, shards, starts, key, scenes)
    worlds, size = train_state.worlds, imitation.config.buffer
    count, agents = worlds.state.active.shape
    if size < count * agents:
        raise ConfigError(f"learner.buffer: expected at least {count * agents}, {count} worlds x {agents} agents, got {size}")
    row = off_policy.describe_row(functools.partial(make_rows, imitation), worlds)
    replay_buffer.check_memory(row, size, devices=imitation.devices, key="learner.buffer")
    observation = jax.tree.map(lambda leaf: leaf[:1], worlds.observation)
    parameters = imitation.discriminator.init(jax.random.fold_in(trainer.split_key(key)[0], 1), observation)
    learnt = Learnt(parameters, (), imitation.optimizer.init(parameters))
    buffer = replay_buffer.make_empty(row, groups=shards, capacity=size // shards)
    return trainer.copy_leaves(replace(train_state, learner={imitation.name: learnt}, buffer={imitation.name: buffer}))


def make_trainer(
    name: str,
    env: Env,
    policy: Policy,
    discriminator: Discriminator,
    ppo_config: PPOConfig,
    config: AdversarialConfig,
    expert: Act | None,
    *,
    numbers: int,
    episode_steps: int,
    mesh: Mesh | None = None,
) -> Trainer:
    """Builds a trainer for one environment, one policy and one expert (None: its samples are recorded); arguments as of PPO.

    Args:
        name: of the learner.
        numbers: of an action that the environment reads.

    Raises:
        ConfigError: shards that the devices do not divide, or that do not divide the batch.
    """
    ppo, shards = ppo_iteration.make_constants(env, policy, ppo_config, mesh)
    if config.batch % shards:
        raise ConfigError(f"learner.batch: expected a multiple of {shards} shards, got {config.batch}")
    starts = trainer.count_starts(env, episode_steps, staggered=ppo_config.stagger_episodes)
    actions, devices = episode_steps // env.action_repeat, shards // ppo.groups
    imitation = Imitation(name, ppo, discriminator, expert, config, numbers, config.expert_steps or actions, devices)
    iterate = functools.partial(train_iteration, imitation)
    begin, recorded = functools.partial(init, imitation, shards, starts), name if expert is None else None
    return trainer.compile_trainer(begin, iterate, env, starts=starts, mesh=mesh, recorded=recorded)


def make(
    name: str,
    build: Callable[[AdversarialConfig, PPOConfig], Discriminator],
    config: Mapping[str, Any],
    env: Env,
    policy: Policy,
    *,
    mesh: Mesh | None,
) -> Trainer:
    """Builds the trainer of a config whose `learner` is one of adversarial imitation; `build` makes its discriminator."""
    own, ppo = off_policy.read_numbers(config, AdversarialConfig), schema.read(config["ppo"], PPOConfig, where="ppo")
    steps, numbers = environment.episode_steps(config["timing"]), config["actions"].get("numbers", FULL)
    more = {"numbers": numbers, "episode_steps": steps, "mesh": mesh}
    return make_trainer(name, env, policy, build(own, ppo), ppo, own, make_expert(config), **more)
