"""Collects samples: a scan over time of policy, environment and restarts, for all worlds at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass, tree_where
from scenefactory_jax.core.types import Env, Observation, Policy, Scene, State, StepResult
from scenefactory_jax.env import environment
from scenefactory_jax.learning import replay_buffer
from scenefactory_jax.learning.gaussian import log_probability
from scenefactory_jax.learning.replay_buffer import Storage
from scenefactory_jax.roadgraph import queries


@pytree_dataclass
class EpisodeStats:
    """Sums over each agent's episode so far."""

    returns: Float[Array, "W A"]  # undiscounted
    steps: Float[Array, "W A"]


@pytree_dataclass
class SceneStats:
    """Counts of each world since its scene was placed there."""

    episodes: Int[Array, " W"]  # of agents, ended by an event or by the time limit
    successes: Int[Array, " W"]  # goals reached


@pytree_dataclass
class Worlds:
    """The worlds of one device between two rollouts."""

    state: State  # with the axis W in front
    observation: Observation
    episode_stats: EpisodeStats


@pytree_dataclass
class Sample:
    """One action of every slot, and its results until the next action."""

    observation: Observation  # of every slot, or with axes G, K of the slots in `kept`
    action: Float[Array, "W A 3"]  # before the environment's clipping
    mean: Float[Array, "W A 3"]
    log_std: Float[Array, "W A 3"]
    log_probability: Float[Array, "W A"]
    value: Float[Array, "W A *values"]
    reward: Float[Array, "W A"]  # sum over the control steps
    active: Bool[Array, "W A"]  # before the action
    terminated: Bool[Array, "W A"]  # by an event
    truncated: Bool[Array, "W A"]  # active when the world reached the time limit
    position: Float[Array, "W A 2"]  # before the action
    kept: Int[Array, "G K"] | None = None  # slots of each group of worlds whose observations there are, W / G * A: none; None: all


@pytree_dataclass
class Outcome:
    """The results of one action of every slot, until the next action."""

    reward: Float[Array, "W A"]  # sum over the control steps
    active: Bool[Array, "W A"]  # before the action
    terminated: Bool[Array, "W A"]  # by an event
    truncated: Bool[Array, "W A"]  # active when the world reached the time limit


@pytree_dataclass
class Transition:
    """One action of every slot, with what was observed before and after it."""

    observation: Observation
    action: Float[Array, "W A 3"]  # that was chosen
    known: Bool[Array, "W A"]  # the action is one to learn from
    next_observation: Observation  # of another episode, where this one ended
    outcome: Outcome


Act = Callable[[Scene, Worlds, PRNGKeyArray], tuple[Float[Array, "W A 3"], Bool[Array, "W A"]]]
"""(scenes, worlds, key) -> actions, and a mask of those that are one to learn from."""

Disturb = Callable[[Worlds, Float[Array, "W A 3"]], Float[Array, "W A 3"]]
"""(worlds, chosen actions) -> actions that are made in their place."""

Counts = dict[str, Array]
"""Sums over worlds, agents and time, from which metrics are computed."""


def collect_rollout(
    env: Env,
    policy: Policy,
    parameters: Any,
    scenes: Scene,
    worlds: Worlds,
    key: PRNGKeyArray,
    *,
    horizon: int,
    storage: Storage = "float32",
    kept: int | None = None,
    groups: int = 1,
    axis: str | None = None,
) -> tuple[Worlds, Sample, Counts, SceneStats]:
    """Acts `horizon` times in `W` worlds; a world that is done restarts with a new key before it is observed.

    An action is held for `env.action_repeat` control steps. Returns the worlds to continue from, samples `[T, W, A]`, the counts of all
    steps, and the counts of each world.

    Args:
        storage: type of the observations in samples, as which the policy sees them.
        kept: observations that samples hold of each action and group, of agents that are active and not truncated; None: all.
        groups: of this device's worlds.
        axis: mesh axis of the devices that share the worlds, see `sharding`.
    """

    def step(worlds: Worlds, key: PRNGKeyArray) -> tuple[Worlds, tuple[Sample, Counts]]:
        action_key, start_key = jax.random.split(key)
        observation, position = worlds.observation, worlds.state.motion.position[..., :2]
        if storage != "float32":
            observation = replay_buffer.compress(observation, storage)
        mean, log_std, value = policy.apply(parameters, replay_buffer.expand(observation))
        action = mean + jnp.exp(log_std) * sample_noise(action_key, mean, axis)
        worlds, outcome, counts = step_worlds(env, scenes, worlds, action, start_key, axis=axis)
        density, slots = log_probability(action, mean, log_std), None
        log_std = jnp.broadcast_to(log_std, mean.shape)
        if kept is not None:
            slots = choose_slots(jax.random.fold_in(key, 2), outcome.active & ~outcome.truncated, groups=groups, count=kept, axis=axis)
            observation = jax.tree.map(lambda leaf: take_slots(leaf, slots), observation)
        return worlds, (Sample(observation, action, mean, log_std, density, value, **vars(outcome), position=position, kept=slots), counts)

    worlds, (samples, counts) = jax.lax.scan(step, worlds, jax.random.split(key, horizon))
    return worlds, samples, jax.tree.map(jnp.sum, counts), count_episodes(counts)


def collect_transitions(
    env: Env,
    act: Act,
    scenes: Scene,
    worlds: Worlds,
    key: PRNGKeyArray,
    *,
    steps: int,
    disturb: Disturb | None = None,
    axis: str | None = None,
) -> tuple[Worlds, Transition, Counts, SceneStats]:
    """Acts `steps` times in `W` worlds, as `collect_rollout`, and returns transitions `[T, W, A]` in place of samples.

    Transitions have the actions that were chosen, whatever `disturb` made of them.
    """

    def step(worlds: Worlds, key: PRNGKeyArray) -> tuple[Worlds, tuple[Transition, Counts]]:
        action_key, start_key = jax.random.split(key)
        action, known = act(scenes, worlds, action_key)
        made = action if disturb is None else disturb(worlds, action)
        after, outcome, counts = step_worlds(env, scenes, worlds, made, start_key, axis=axis)
        return after, (Transition(worlds.observation, action, known, after.observation, outcome), counts)

    worlds, (transitions, counts) = jax.lax.scan(step, worlds, jax.random.split(key, steps))
    return worlds, transitions, jax.tree.map(jnp.sum, counts), count_episodes(counts)


def step_worlds(
    env: Env, scenes: Scene, worlds: Worlds, action: Float[Array, "W A 3"], key: PRNGKeyArray, *, axis: str | None
) -> tuple[Worlds, Outcome, Counts]:
    """Makes one action of all worlds; a world that is done restarts with a new key before it is observed. Counts are of each world."""
    before = worlds.state
    control = lambda state: jax.vmap(env.control_step)(scenes, state, action)  # noqa: E731
    after, stats, result, counts = environment.repeat_action(
        control, before, worlds.episode_stats, action_repeat=env.action_repeat, note=_count_step
    )
    after = jax.vmap(env.respawn)(scenes, after)
    truncated = environment.find_truncated_agents(result, before.active)
    outcome = Outcome(reward=result.reward, active=before.active, terminated=result.terminated, truncated=truncated)
    fresh = jax.vmap(env.init_state)(sharding.world_keys(key, len(result.world_done), axis), scenes)
    state = tree_where(result.world_done, fresh, after)
    return Worlds(state, jax.vmap(env.observe)(scenes, state), stats), outcome, counts


def choose_slots(
    key: PRNGKeyArray, mask: Bool[Array, "W A"], *, groups: int, count: int, axis: str | None
) -> Int[Array, "{groups} {count}"]:
    """Chooses `count` slots of a mask in each group of worlds, from a random one on in order; a group's number of slots where it has fewer.

    Args:
        axis: mesh axis of the devices that share the groups.
    """

    def choose(key: PRNGKeyArray, mask: Bool[Array, " P"]) -> Int[Array, " K"]:
        first = jax.random.randint(key, (), 0, len(mask))
        index, found = queries.find_first_true(jnp.roll(mask, -first)[None], count=count)
        return jnp.where(found[0], (first + index[0]) % len(mask), len(mask))

    return jax.vmap(choose)(sharding.world_keys(key, groups, axis), mask.reshape(groups, -1))


def take_slots(x: Shaped[Array, "W A *rest"], slots: Int[Array, "G K"]) -> Shaped[Array, "G K *rest"]:
    """Takes slots of each group of worlds; zeros for none."""
    grouped = x.reshape(len(slots), -1, *x.shape[2:])
    return jax.vmap(lambda x, slots: x.at[slots].get(mode="fill", fill_value=0))(grouped, slots)


def sample_noise(key: PRNGKeyArray, like: Float[Array, "rows ..."], axis: str | None) -> Float[Array, "rows ..."]:
    """Samples standard normal numbers; those of a row do not depend on the number of devices."""
    return jax.vmap(lambda key: jax.random.normal(key, like.shape[1:], like.dtype))(sharding.world_keys(key, len(like), axis))


def count_episodes(counts: Counts) -> SceneStats:
    """Sums counts `[T, W]` over time."""
    return SceneStats(*(jnp.sum(counts[name], axis=0).astype(jnp.int32) for name in ("ended", "events/goal_reached")))


def make_empty_scene_stats(state: State) -> SceneStats:
    """Zero counts."""
    return SceneStats(jnp.zeros(len(state.step), jnp.int32), jnp.zeros(len(state.step), jnp.int32))


def make_empty_episode_stats(state: State) -> EpisodeStats:
    """Zero sums."""
    return EpisodeStats(jnp.zeros(state.active.shape, jnp.float32), jnp.zeros(state.active.shape, jnp.float32))


def _count_step(stats: EpisodeStats, before: State, result: StepResult) -> tuple[EpisodeStats, Counts]:
    """Adds a control step to the episodes' sums, and counts it for each world: one sum over all worlds stalls a GPU at every step.

    Float32 holds sums of up to 16.7 million agent steps exactly.
    """

    def total(x: Array, where: Array) -> Array:
        return jnp.sum(jnp.where(where, x, 0), axis=1, dtype=jnp.float32)

    active = before.active
    ended = active & (result.terminated | result.truncated[:, None])
    reward = jnp.where(active, result.reward, 0.0)
    stats = EpisodeStats(stats.returns + reward, stats.steps + active)
    counts = {
        "spawned": jnp.sum(before.agents.present, axis=1, dtype=jnp.int32),
        "active": total(active, active),
        "reward": total(reward, active),
        "speed": total(result.metrics.speed, active & ~result.metrics.events.numerical_error),  # 0 where the state is not finite
        "ended": total(ended, ended),
        "return": total(stats.returns, ended),
        "length": total(stats.steps, ended),
        **{f"reward/{name}": total(term, active) for name, term in result.terms.items()},
        **{f"events/{name}": total(event, active) for name, event in vars(result.events).items()},
    }
    closed = ended | result.world_done[:, None]
    return EpisodeStats(jnp.where(closed, 0.0, stats.returns), jnp.where(closed, 0.0, stats.steps)), counts


def compute_rollout_metrics(counts: Counts) -> dict[str, Float[Array, ""]]:
    """Computes the metrics of a rollout that do not depend on the algorithm.

    `reward` and `reward/...`: mean per step of an active agent. `events/...`: new events per episode of an agent that ended, by event or by
    time limit; `count/...`: their number. `episode/...`: undiscounted return and steps of these episodes. `active_fraction`: active steps
    among the steps of spawned slots; `steps/...`: of this rollout. `speed`: m/s.
    """
    steps, ends = jnp.maximum(counts["active"], 1.0), jnp.maximum(counts["ended"], 1.0)
    spawned = counts["spawned"].astype(jnp.float32)
    metrics = {name: counts[name] / steps for name in counts if name == "reward" or name.startswith("reward/")}
    for name in (name.removeprefix("events/") for name in counts if name.startswith("events/")):
        metrics[f"events/{name}"] = counts[f"events/{name}"] / ends
        metrics[f"count/{name}"] = counts[f"events/{name}"]
    return {
        **metrics,
        "episode/return": counts["return"] / ends,
        "episode/steps": counts["length"] / ends,
        "count/episodes": counts["ended"],
        "active_fraction": counts["active"] / jnp.maximum(spawned, 1.0),
        "steps/spawned": spawned,
        "steps/active": counts["active"],
        "speed": counts["speed"] / steps,
    }
