"""One deterministic episode a world, measured on device: what happened to every agent, and what a viewer needs to draw it.

Events are counted from step metrics, not from the exclusive events of rewards: an agent that touches an edge and another car in one step
has done both. Nothing is counted after an agent's end or the world's.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.pytree import pytree_dataclass, replace
from scenefactory_jax.core.types import Env, Events, Scene, State, StepResult
from scenefactory_jax.env import termination
from scenefactory_jax.evaluation import failure_signals
from scenefactory_jax.evaluation.failure_signals import FailureSignals

Act = Callable[[Any, Any], Array]  # (parameters, observation) -> action


@pytree_dataclass
class EpisodeMetrics:
    """Running record of one episode."""

    past_events: Events
    ended: Bool[Array, " A"]
    steps: Int[Array, " A"]
    goal_distance: Float[Array, " A"]
    drac_max: Float[Array, " A"]
    ttc_min: Float[Array, " A"]
    ttc_sum: Float[Array, " A"]
    ttc_steps: Int[Array, " A"]
    speed_sum: Float[Array, " A"]
    swing_sum: Float[Array, " A"]  # |change of the yaw rate|, rad/s
    grip_sum: Float[Array, " A"]
    grip_use_sum: Float[Array, " A"]
    margin_min: Float[Array, " A"]
    force_max: Float[Array, " A"]
    clues: FailureSignals


@pytree_dataclass
class EpisodeFrame:
    """What one moment looks like from above; where the others are then follows from the scene and the step alone."""

    position: Float[Array, "A 2"]
    yaw: Float[Array, " A"]
    speed: Float[Array, " A"]
    active: Bool[Array, " A"]
    goal: Float[Array, "A 2"]
    events: Events


@pytree_dataclass
class Episode:
    """Everything that a running episode carries."""

    state: State
    observation: Any
    tally: EpisodeMetrics
    over: Bool[Array, ""]


def begin(env: Env, key: PRNGKeyArray, scene: Scene) -> Episode:
    """An episode at its start."""
    state, observation = env.reset(key, scene)
    count = state.active.shape[0]
    zero, none = jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32)
    distance = jnp.linalg.norm(state.agents.goal - state.motion.position[:, :2], axis=1)
    tally = EpisodeMetrics(
        past_events=termination.make_empty_events(count),
        ended=jnp.zeros(count, bool),
        steps=none,
        goal_distance=distance,
        drac_max=zero,
        ttc_min=zero + jnp.inf,
        ttc_sum=zero,
        ttc_steps=none,
        speed_sum=zero,
        swing_sum=zero,
        grip_sum=zero,
        grip_use_sum=zero,
        margin_min=zero + jnp.inf,
        force_max=zero,
        clues=failure_signals.begin(state, distance),
    )
    return Episode(state, observation, tally, ~jnp.any(state.active))


def run_episode_chunk(
    env: Env, act: Act, parameters: Any, scene: Scene, episode: Episode, *, steps: int, ttc_limit_s: float, notes: Mapping[str, float]
) -> tuple[Episode, EpisodeFrame]:
    """Drive on for that many control steps; frames come back with a leading step axis.

    Args:
        ttc_limit_s: TTC above this counts as this in an agent's mean (the published evaluation uses 10 s).
        notes: numbers of `clues.note`.
    """

    def body(episode: Episode, _: None) -> tuple[Episode, EpisodeFrame]:
        before = replace(episode.state, active=episode.state.active & ~episode.over)
        action = act(parameters, episode.observation)
        state, outcome = env.control_step(scene, before, action)
        seen, boxes = episode.tally, env.current_scene(scene, state).traffic
        found = failure_signals.update(seen.clues, seen.past_events, scene.lanes, boxes, before, state, outcome.metrics, **notes)
        tally = _note(seen, before, state, outcome, found, ttc_limit_s=ttc_limit_s)
        place, speed = state.motion.position[:, :2], jnp.linalg.norm(state.motion.velocity[:, :2], axis=1)
        frame = EpisodeFrame(place, state.motion.yaw, speed, before.active, state.agents.goal, outcome.events)
        return Episode(state, env.observe(scene, state), tally, episode.over | outcome.world_done), frame

    return jax.lax.scan(body, episode, None, length=steps)


def _note(
    tally: EpisodeMetrics, before: State, after: State, outcome: StepResult, found: FailureSignals, *, ttc_limit_s: float
) -> EpisodeMetrics:
    metrics = outcome.metrics
    active = before.active & ~metrics.events.numerical_error  # a broken car's metrics are no measurements
    seen = active & jnp.isfinite(metrics.ttc)
    past_events = jax.tree.map(lambda old, new: old | (new & before.active), tally.past_events, metrics.events)
    add = lambda total, value: total + jnp.where(active, value, 0)  # noqa: E731
    return EpisodeMetrics(
        past_events=past_events,
        ended=tally.ended | (outcome.terminated & before.active),
        steps=tally.steps + active.astype(jnp.int32),
        goal_distance=jnp.where(active, metrics.goal_distance, tally.goal_distance),
        drac_max=jnp.maximum(tally.drac_max, jnp.where(active, metrics.drac, 0.0)),
        ttc_min=jnp.minimum(tally.ttc_min, jnp.where(active, metrics.ttc, jnp.inf)),
        ttc_sum=tally.ttc_sum + jnp.where(seen, jnp.minimum(metrics.ttc, ttc_limit_s), 0.0),
        ttc_steps=tally.ttc_steps + seen.astype(jnp.int32),
        speed_sum=add(tally.speed_sum, metrics.speed),
        swing_sum=add(tally.swing_sum, jnp.abs(after.motion.yaw_rate - before.motion.yaw_rate)),
        grip_sum=add(tally.grip_sum, metrics.mu),
        grip_use_sum=add(tally.grip_use_sum, metrics.friction_utilization),
        margin_min=jnp.minimum(tally.margin_min, jnp.where(active, metrics.stopping_margin, jnp.inf)),
        force_max=jnp.maximum(tally.force_max, jnp.where(active, metrics.contact_force, 0.0)),
        clues=found,
    )
