"""What learners from a replay buffer share: rounds of acting, storing and updating, and the train state around them.

An iteration is `horizon / unroll` rounds. In each round all worlds act `unroll` times, the valid rows of their transitions go into the
buffer, and `unroll * updates_per_step` updates follow, each on rows drawn anew. An algorithm is a `Learner`, a few functions of what it
`Learnt`. On a mesh all of this runs on every device, with the device's own worlds and rows; gradients are sums over the devices.

The action in which the time limit cuts an episode short is not stored: what follows it is not observed, since worlds restart before they
are observed. It is so neither taken for a termination nor for a step into the next episode; every other transition bootstraps.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.core.pytree import replace, to_strong_type
from scenefactory_jax.core.schema import ConfigError, Count, Fraction, Positive
from scenefactory_jax.core.types import Env, Observation, Policy, Scene
from scenefactory_jax.learning import replay_buffer, rollout, trainer
from scenefactory_jax.learning.replay_buffer import Buffer, Storage
from scenefactory_jax.learning.rollout import Act, Counts, Disturb, Outcome, SceneStats, Transition, Worlds
from scenefactory_jax.learning.trainer import Metrics, Trainer, TrainState

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class OffPolicyConfig:
    """Numbers of the rounds, see above."""

    horizon: Count  # actions of an iteration
    unroll: Count  # actions of all worlds between updates
    updates_per_step: Positive  # updates for each action of all worlds
    batch: Count  # samples of an update, of all devices
    buffer: Count  # transitions that are kept, of all devices
    storage: Storage  # type of the stored observations
    learning_starts: Count  # transitions in the buffer before the first update
    shards: int | None  # groups of worlds with a part of the buffer and of each batch; None: one a device
    max_grad_norm: Positive | None  # of each network's gradient; None: not bounded
    stagger_episodes: bool  # worlds start at random times of their episodes
    parameter_ema_decay: Fraction | None  # of the running mean of the actor's parameters, which is evaluated; None: the last ones are

    def __post_init__(self) -> None:
        if self.horizon % self.unroll:
            raise ConfigError(f"horizon: expected a multiple of unroll {self.unroll}, got {self.horizon}")
        updates = self.unroll * self.updates_per_step
        if updates < 1 or updates % 1:
            raise ConfigError(f"updates_per_step: expected a whole number of updates in {self.unroll} steps, got {self.updates_per_step}")
        if self.learning_starts > self.buffer:
            raise ConfigError(f"learning_starts: expected at most the {self.buffer} transitions of the buffer, got {self.learning_starts}")

    @property
    def updates(self) -> int:
        """Updates of a round."""
        return round(self.unroll * self.updates_per_step)


class Learnt(NamedTuple):
    """What updates change. The train state has the parameters once, and the other fields by the names of its learners."""

    parameters: Any
    learner: Any
    optimizer: Any


class Learner(NamedTuple):
    """An algorithm as functions."""

    init: Callable[[PRNGKeyArray, Any, Observation], Learnt]  # (key, parameters of the policy, observation of all worlds)
    act: Callable[[Learnt], Act] | None  # None: worlds stand still, and recorded samples fill the buffer
    make_rows: Callable[[Transition], tuple[Any, Bool[Array, "T W A"]]]  # what is stored of transitions, and which of it
    update: Callable[[Learnt, Any, Float[Array, "G B"], PRNGKeyArray], tuple[Learnt, Metrics]]  # (learnt, rows, weight, key); the metrics
    # have `changed`, whether the update was finite
    disturb: Disturb | None = None  # what becomes of the actions before they are made


class Rounds(NamedTuple):
    """The constants of all iterations of one learner."""

    name: str  # of the learner: its key in the train state, and the first part of its metrics' names
    env: Env
    learner: Learner
    config: OffPolicyConfig
    axis: str | None  # mesh axis of the devices, inside `shard_map`; None: one device
    shards: int  # groups of worlds of all devices
    devices: int
    key: str = "buffer"  # of the config, with the buffer's size


class Progress(NamedTuple):
    """What rounds return besides the state that they change."""

    sums: Metrics  # of the updates that were finite, and their number `changed`; `skipped`: of the others
    counts: Counts
    scene_stats: SceneStats


def run_rounds(
    rounds: Rounds, learnt: Learnt, buffer: Buffer, worlds: Worlds, scenes: Scene, key: PRNGKeyArray
) -> tuple[Learnt, Buffer, Worlds, Progress]:
    """Runs the rounds of an iteration."""
    config = rounds.config

    def run(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, Progress]:
        learnt, buffer, worlds = carry
        act_key, update_key = jax.random.split(key)
        worlds, buffer, counts, scene_stats = collect(rounds, learnt, buffer, worlds, scenes, act_key)
        learnt, sums = make_updates(rounds, learnt, buffer, update_key)
        return (learnt, buffer, worlds), Progress(sums, counts, scene_stats)

    carry, progress = jax.lax.scan(run, (learnt, buffer, worlds), jax.random.split(key, config.horizon // config.unroll))
    return *carry, jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), progress)


def collect(
    rounds: Rounds, learnt: Learnt, buffer: Buffer, worlds: Worlds, scenes: Scene, key: PRNGKeyArray
) -> tuple[Worlds, Buffer, Counts, SceneStats]:
    """Acts in all worlds and stores the samples; without an actor nothing moves."""
    learner = rounds.learner
    if learner.act is None:
        zero = jnp.int32(0)
        return worlds, buffer, {"spawned": zero, "stored": zero, "lost": zero}, rollout.make_empty_scene_stats(worlds.state)
    worlds, transitions, counts, scene_stats = rollout.collect_transitions(
        rounds.env, learner.act(learnt), scenes, worlds, key, steps=rounds.config.unroll, disturb=learner.disturb, axis=rounds.axis
    )
    rows, valid = learner.make_rows(transitions)
    counts["stored"], counts["lost"] = jnp.sum(valid), jnp.sum(transitions.known & transitions.outcome.active & ~valid)
    return worlds, replay_buffer.insert(buffer, rows, valid), counts, scene_stats


def make_updates(rounds: Rounds, learnt: Learnt, buffer: Buffer, key: PRNGKeyArray) -> tuple[Learnt, Metrics]:
    """Makes the updates of a round, once there is enough to learn from; also the sums of their metrics."""
    config, axis = rounds.config, rounds.axis

    def update(learnt: Learnt, key: PRNGKeyArray) -> tuple[Learnt, Metrics]:
        draw_key, key = jax.random.split(key)
        rows, weight = replay_buffer.sample(buffer, draw_key, config.batch // rounds.shards, axis=axis)
        learnt, metrics = rounds.learner.update(learnt, rows, weight, key)
        changed = metrics.pop("changed")
        return to_strong_type(learnt), {name: jnp.where(changed, x, 0.0) for name, x in metrics.items()} | {
            "changed": changed.astype(jnp.float32),
            "skipped": (~changed).astype(jnp.float32),
        }

    @jax.jit  # traced once for both branches
    def run(learnt: Learnt) -> tuple[Learnt, Metrics]:
        learnt, metrics = jax.lax.scan(update, learnt, jax.random.split(key, config.updates))
        return learnt, jax.tree.map(jnp.sum, metrics)

    def skip(learnt: Learnt) -> tuple[Learnt, Metrics]:
        return learnt, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(run, learnt)[1])

    return jax.lax.cond(replay_buffer.count_rows(buffer, axis=axis) >= config.learning_starts, run, skip, learnt)


def descend(
    objective: Callable[[Any], tuple[Array, Metrics]], adam: optax.GradientTransformation, parameters: Any, state: Any, axis: str | None
) -> tuple[Any, Any, Metrics]:
    """Makes one gradient step; the caller keeps what was before where it is not finite (`changed` of the metrics).

    Args:
        objective: of the parameters, with metrics; on several devices each device's summand of both.
    """
    [(moved, adapted)], metrics, [norm] = descend_each(lambda trees: objective(*trees), [adam], (parameters,), (state,), axis)
    return moved, adapted, {**metrics, "gradient_norm": norm}


def descend_each(
    objective: Callable[[Any], tuple[Array, Metrics]],
    adams: Sequence[optax.GradientTransformation],
    trees: tuple[Any, ...],
    states: tuple[Any, ...],
    axis: str | None,
) -> tuple[list[tuple[Any, Any]], Metrics, list[Array]]:
    """Makes one gradient step of several networks by one objective, see `descend`.

    Returns:
        Parameters and state of each; the metrics, with `changed`; the norm of each gradient.
    """
    result = jax.value_and_grad(objective, has_aux=True)(trees)
    (total, metrics), gradients = sharding.sum_over_devices(result, axis)
    norms, moved = [optax.global_norm(gradient) for gradient in gradients], []
    for adam, gradient, state, tree in zip(adams, gradients, states, trees, strict=True):
        updates, adapted = adam.update(gradient, state, tree)
        moved.append((optax.apply_updates(tree, updates), adapted))
    changed = jnp.isfinite(total) & jnp.all(jnp.isfinite(jnp.stack(norms)))
    return moved, {**metrics, "changed": changed}, norms


def select(condition: Bool[Array, ""], chosen: Any, other: Any) -> Any:
    """Selects one of two pytrees."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), chosen, other)


def move_towards(target: Any, parameters: Any, tau: float) -> Any:
    """Moves target networks by the part `tau` of the way to the parameters (Polyak averaging)."""
    return jax.tree.map(lambda old, new: (1.0 - tau) * old + tau * new, target, parameters)


def make_optimizer(learning_rate: float, max_grad_norm: float | None) -> optax.GradientTransformation:
    """Makes Adam, with the gradient's norm bounded."""
    adam = optax.adam(learning_rate)
    return adam if max_grad_norm is None else optax.chain(optax.clip_by_global_norm(max_grad_norm), adam)


def make_transition_rows(transitions: Transition, *, numbers: int, storage: Storage) -> tuple[Any, Bool[Array, "T W A"]]:
    """Makes the rows of algorithms with critics; `follows`: the agent goes on, with `next_observation`.

    Args:
        numbers: of an action.
    """
    outcome = transitions.outcome
    valid = outcome.active & ~outcome.truncated & transitions.known
    valid = replay_buffer.find_finite_rows((transitions.observation, transitions.next_observation, outcome.reward), valid)
    rows = {
        "observation": replay_buffer.compress(transitions.observation, storage),
        "action": transitions.action[..., :numbers],
        "reward": outcome.reward,
        "next_observation": replay_buffer.compress(transitions.next_observation, storage),
        "follows": ~outcome.terminated,
    }
    return rows, valid


def train_iteration(rounds: Rounds, train_state: TrainState, scenes: Scene) -> tuple[TrainState, Metrics]:
    """Computes one iteration: its rounds, the next train state and its metrics."""
    name, axis = rounds.name, rounds.axis
    run_key, key = jax.random.split(train_state.key)
    learnt = Learnt(train_state.parameters, train_state.learner[name], train_state.optimizer[name])
    buffer, worlds = train_state.buffer[name], train_state.worlds
    learnt, buffer, worlds, progress = run_rounds(rounds, learnt, buffer, worlds, scenes, run_key)
    counts = sharding.sum_over_devices(progress.counts, axis)
    scene_stats = sharding.gather_over_devices(progress.scene_stats, axis)
    train_state = replace(
        train_state,
        parameters=learnt.parameters,
        ema_parameters=trainer.advance_ema(train_state, learnt.parameters, rounds.config.parameter_ema_decay),
        learner=train_state.learner | {name: learnt.learner},
        optimizer=train_state.optimizer | {name: learnt.optimizer},
        buffer=train_state.buffer | {name: buffer},
        worlds=worlds,
        scene_stats=jax.tree.map(jnp.add, train_state.scene_stats, scene_stats),
        key=key,
        iteration=train_state.iteration + 1,
        steps=trainer.add_steps(train_state.steps, counts["spawned"]),
    )
    updates = progress.sums["changed"] + progress.sums["skipped"]
    steps = {"steps/updates": updates, "steps/samples": updates * rounds.config.batch}
    metrics = {f"{name}/{part}": value for part, value in compute_metrics(rounds, progress.sums, counts, buffer).items()}
    steps |= {"steps/spawned": jnp.float32(0.0)} if rounds.learner.act is None else rollout.compute_rollout_metrics(counts)
    return to_strong_type(train_state), steps | metrics


def compute_metrics(rounds: Rounds, sums: Metrics, counts: Counts, buffer: Buffer) -> Metrics:
    """Computes means of the updates' metrics over those that were finite; `skipped`: number of the others; `lost`: part of the samples
    that was not stored, because the time limit cut it short or a number was not finite; `buffer`: rows that are stored."""
    changed, skipped, rest = sums["changed"], sums["skipped"], sums.keys() - {"changed", "skipped"}
    return {
        **{name: sums[name] / jnp.maximum(changed, 1.0) for name in sorted(rest)},
        "skipped": skipped,
        "lost": counts["lost"] / jnp.maximum(counts["lost"] + counts["stored"], 1),
        "buffer": replay_buffer.count_rows(buffer, axis=rounds.axis).astype(jnp.float32),
    }


def init_train_state(parts: Sequence[Rounds], key: PRNGKeyArray, scenes: Scene, *, policy: Policy, starts: int) -> TrainState:
    """Computes the train state before the first iteration of one learner or several, with empty buffers.

    Raises:
        ConfigError: worlds that the shards do not divide; a buffer that is too small for a round, or larger than the memory.
    """
    env, ema = parts[0].env, parts[0].config.parameter_ema_decay is not None
    train_state = trainer.init_train_state(key, scenes, env, policy, optax.identity(), starts=starts, ema=ema)
    worlds, needed, buffers, learnt = train_state.worlds, 0, {}, {}
    count, agents = worlds.state.active.shape
    for index, rounds in enumerate(parts, start=1):
        config, shards = rounds.config, rounds.shards
        if count % shards:
            raise ConfigError(f"worlds: expected a multiple of {shards} shards, got {count}")
        if config.buffer < config.unroll * count * agents:
            product = f"unroll {config.unroll} x {count} worlds x {agents} agents"
            raise ConfigError(f"learner.{rounds.key}: expected at least {config.unroll * count * agents}, {product}, got {config.buffer}")
        row = describe_row(rounds.learner.make_rows, worlds)
        needed += replay_buffer.check_memory(row, config.buffer, devices=rounds.devices, taken=needed, key=f"learner.{rounds.key}")
        buffers[rounds.name] = replay_buffer.make_empty(row, groups=shards, capacity=config.buffer // shards)
        learner_key = jax.random.fold_in(trainer.split_key(key)[0], index)
        learnt[rounds.name] = rounds.learner.init(learner_key, train_state.parameters, worlds.observation)
    learner, optimizer = ({name: getattr(one, field) for name, one in learnt.items()} for field in ("learner", "optimizer"))
    return trainer.copy_leaves(replace(train_state, learner=learner, optimizer=optimizer, buffer=buffers))


def describe_row(make_rows: Callable[[Transition], tuple[Any, Array]], worlds: Worlds) -> Any:
    """Shapes and types of a row."""

    def make(worlds: Worlds) -> Any:
        none, zero = jnp.zeros(worlds.state.active.shape, bool), jnp.zeros(worlds.state.active.shape)
        action = jnp.zeros((*zero.shape, 3))
        transition = Transition(worlds.observation, action, none, worlds.observation, Outcome(zero, none, none, none))
        return make_rows(jax.tree.map(lambda leaf: leaf[None], transition))[0]

    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[3:], leaf.dtype), jax.eval_shape(make, worlds))


def read_numbers(config: Mapping[str, Any], schema_of: type[T]) -> T:
    """Reads the numbers of a config's `learner` entry.

    Raises:
        ConfigError: a key that does not fit.
    """
    return schema.read({key: value for key, value in config["learner"].items() if key != "_target_"}, schema_of, where="learner")


def make_rounds(name: str, env: Env, learner: Learner, config: OffPolicyConfig, mesh: Mesh | None, *, key: str = "buffer") -> Rounds:
    """Joins the constants of all iterations.

    Raises:
        ConfigError: shards that the devices do not divide, or that do not divide the batch.
    """
    devices = 1 if mesh is None else mesh.size
    shards = devices if config.shards is None else config.shards
    if shards < 1 or shards % devices:
        raise ConfigError(f"learner.shards: expected a multiple of {devices} devices, got {shards}")
    if config.batch % shards:
        raise ConfigError(f"learner.batch: expected a multiple of {shards} shards, got {config.batch}")
    return Rounds(name, env, learner, config, get_axis(mesh), shards, devices, key)


def get_axis(mesh: Mesh | None) -> str | None:
    """Returns the mesh's axis; None for one device."""
    return None if mesh is None else sharding.AXIS


def make_trainer(rounds: Rounds, policy: Policy, *, episode_steps: int, mesh: Mesh | None) -> Trainer:
    """Builds the trainer of a single learner; `episode_steps` and `mesh` as of PPO."""
    starts = trainer.count_starts(rounds.env, episode_steps, staggered=rounds.config.stagger_episodes)
    init = functools.partial(init_train_state, [rounds], policy=policy, starts=starts)
    iterate, recorded = functools.partial(train_iteration, rounds), rounds.name if rounds.learner.act is None else None
    return trainer.compile_trainer(init, iterate, rounds.env, starts=starts, mesh=mesh, recorded=recorded)
