"""Acting: a scan over time of policy, environment and restarts, for all worlds at once."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass, tree_where
from scenefactory_jax.core.types import Env, Observation, Policy, Scene, State, StepResult
from scenefactory_jax.env import environment
from scenefactory_jax.learning.ppo.loss import log_probability


@pytree_dataclass
class EpisodeStats:
    """What each slot's agent has collected since its own start."""

    returns: Float[Array, "W A"]  # undiscounted
    steps: Float[Array, "W A"]


@pytree_dataclass
class SceneStats:
    """What became of the agents of each world since its scene was placed there."""

    episodes: Int[Array, " W"]  # lives of agents that ended, by an event or by time
    successes: Int[Array, " W"]  # goals reached


@pytree_dataclass
class Sample:
    """One action of every slot and what came of it until the next, as the learner needs it."""

    observation: Observation
    action: Float[Array, "W A 3"]  # before the environment's clipping
    mean: Float[Array, "W A 3"]
    log_probability: Float[Array, "W A"]
    value: Float[Array, "W A"]
    reward: Float[Array, "W A"]  # sum over the control steps
    active: Bool[Array, "W A"]  # on stage before the action
    done: Bool[Array, "W A"]  # ended by an event
    truncated: Bool[Array, "W A"]  # alive when the world's time ran out


Tally = dict[str, Array]
"""Sums over worlds, agents and time: what metrics are made of."""


def collect_rollout(
    env: Env,
    policy: Policy,
    parameters: Any,
    scenes: Scene,
    worlds: State,
    observation: Observation,
    lives: EpisodeStats,
    key: PRNGKeyArray,
    *,
    horizon: int,
    axis: str | None = None,
) -> tuple[State, Observation, EpisodeStats, Sample, Tally, SceneStats]:
    """Act `horizon` times in `W` worlds; a world that is over starts afresh, from a fresh key, before it is observed.

    An action stands for `env.action_repeat` control steps.

    Args:
        axis: of the devices that share the worlds, see `across`.

    Returns:
        worlds and observation to go on from, lives, samples `[T, W, A]`, the tally of all steps, and the record of each world in them.
    """

    def step(
        carry: tuple[State, Observation, EpisodeStats], key: PRNGKeyArray
    ) -> tuple[tuple[State, Observation, EpisodeStats], tuple[Sample, Tally]]:
        worlds, observation, lives = carry
        action_key, start_key = jax.random.split(key)
        mean, log_std, value = policy.apply(parameters, observation)
        noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[1:], mean.dtype))(sharding.world_keys(action_key, len(mean), axis))
        action = mean + jnp.exp(log_std) * noise
        control = lambda worlds: jax.vmap(env.control_step)(scenes, worlds, action)  # noqa: E731
        after, lives, outcome, counts = environment.repeat_action(control, worlds, lives, action_repeat=env.action_repeat, note=_tally)
        sample = Sample(
            observation=observation,
            action=action,
            mean=mean,
            log_probability=log_probability(action, mean, log_std),
            value=value,
            active=worlds.active,
            reward=outcome.reward,
            done=outcome.terminated,
            truncated=environment.find_truncated_agents(outcome, worlds.active),
        )
        fresh = jax.vmap(env.init_state)(sharding.world_keys(start_key, len(outcome.world_done), axis), scenes)
        worlds = tree_where(outcome.world_done, fresh, after)
        return (worlds, jax.vmap(env.observe)(scenes, worlds), lives), (sample, counts)

    (worlds, observation, lives), (samples, counts) = jax.lax.scan(step, (worlds, observation, lives), jax.random.split(key, horizon))
    record = SceneStats(*(jnp.sum(counts[name], axis=0).astype(jnp.int32) for name in ("ended", "events/goal_reached")))
    return worlds, observation, lives, samples, jax.tree.map(jnp.sum, counts), record


def make_empty_scene_stats(worlds: State) -> SceneStats:
    """Nothing recorded yet."""
    count = len(worlds.step)
    return SceneStats(jnp.zeros(count, jnp.int32), jnp.zeros(count, jnp.int32))


def make_empty_episode_stats(worlds: State) -> EpisodeStats:
    """Nothing collected yet."""
    return EpisodeStats(jnp.zeros(worlds.active.shape, jnp.float32), jnp.zeros(worlds.active.shape, jnp.float32))


def _tally(lives: EpisodeStats, worlds: State, outcome: StepResult) -> tuple[EpisodeStats, Tally]:
    """Carry lives on, and sum the control step up for each world: all of them would be one long sum, for which a GPU waits at every step.

    Float32 holds sums of up to 16.7 million agent steps exactly.
    """

    def total(x: Array, where: Array) -> Array:
        return jnp.sum(jnp.where(where, x, 0), axis=1, dtype=jnp.float32)

    active = worlds.active
    ended = active & (outcome.terminated | outcome.truncated[:, None])
    reward = jnp.where(active, outcome.reward, 0.0)
    lives = EpisodeStats(lives.returns + reward, lives.steps + active)
    counts = {
        "spawned": jnp.sum(worlds.agents.present, axis=1, dtype=jnp.int32),
        "active": total(active, active),
        "reward": total(reward, active),
        "speed": total(outcome.metrics.speed, active & ~outcome.metrics.events.numerical_error),  # a broken car's is no measurement
        "ended": total(ended, ended),
        "return": total(lives.returns, ended),
        "length": total(lives.steps, ended),
        **{f"reward/{name}": total(term, active) for name, term in outcome.terms.items()},
        **{f"events/{name}": total(event, active) for name, event in vars(outcome.events).items()},
    }
    gone = ended | outcome.world_done[:, None]
    return EpisodeStats(jnp.where(gone, 0.0, lives.returns), jnp.where(gone, 0.0, lives.steps)), counts
