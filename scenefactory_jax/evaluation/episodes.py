"""Metrics and frames of one episode a world, computed on the device as a hook of the rollout.

Events are counted from the step metrics, not from the exclusive events that rewards use: an agent that touches an edge and another car in
one step has both events. Nothing is counted after an agent or its world has ended.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.types import Env, Events, State
from scenefactory_jax.env import surrogate_safety, termination
from scenefactory_jax.env.rollout import ControlStep, Hook
from scenefactory_jax.evaluation import route_signals
from scenefactory_jax.evaluation.failure_signals import FailureSignals, SignalThresholds, begin_signals, update_signals
from scenefactory_jax.evaluation.route_signals import CourseThresholds, RouteSignals

SUMS = ("ttc", "speed", "yaw_rate_change", "mu", "friction_utilization")
LARGEST = ("drac", "contact_force")  # names of step metrics, as `SMALLEST`
SMALLEST = ("ttc", "stopping_margin")


@pytree_dataclass
class EpisodeMetrics:
    """Sums and extremes over the steps of an episode in which an agent was active."""

    past_events: Events
    steps: Int[Array, " A"]
    ttc_steps: Int[Array, " A"]  # with a finite time to collision
    goal_distance: Float[Array, " A"]  # in the last step
    sums: dict[str, Float[Array, " A"]]
    largest: dict[str, Float[Array, " A"]]
    smallest: dict[str, Float[Array, " A"]]
    signals: FailureSignals
    route: RouteSignals


@pytree_dataclass
class TrafficFrame:
    """The background traffic after one control step."""

    position: Float[Array, "O 2"]
    yaw: Float[Array, " O"]
    velocity: Float[Array, "O 2"]
    size: Float[Array, "O 2"]
    present: Bool[Array, " O"]


@pytree_dataclass
class EpisodeFrame:
    """The agents after one control step, for scores and for pictures from above."""

    position: Float[Array, "A 2"]
    yaw: Float[Array, " A"]
    velocity: Float[Array, "A 2"]
    friction_utilization: Float[Array, " A"]
    active: Bool[Array, " A"]
    goal: Float[Array, "A 2"]
    events: Events
    traffic: TrafficFrame
    height: Float[Array, " U"] | None = None  # of the agents, then of the traffic; None: the scene has one level


def make_metrics(state: State) -> EpisodeMetrics:
    """Returns the metrics of an episode that starts at a state."""
    count = state.active.shape[0]
    zero, none = jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32)
    distance = jnp.linalg.norm(state.agents.goal - state.motion.position[:, :2], axis=1)
    return EpisodeMetrics(
        past_events=termination.make_empty_events(count),
        steps=none,
        ttc_steps=none,
        goal_distance=distance,
        sums=dict.fromkeys(SUMS, zero),
        largest=dict.fromkeys(LARGEST, zero),
        smallest=dict.fromkeys(SMALLEST, zero + jnp.inf),
        signals=begin_signals(state, distance),
        route=route_signals.begin_signals(state),
    )


def make_hook(
    env: Env, *, ttc_limit_s: float, thresholds: SignalThresholds, course: CourseThresholds, control_dt: float
) -> Hook:  # fmt: skip
    """Returns the hook of a rollout that updates `EpisodeMetrics` and gives an `EpisodeFrame` a step.

    Args:
        ttc_limit_s: TTC is clamped to it in an agent's mean (the published evaluation: 10 s).
    """

    def hook(metrics: EpisodeMetrics, step: ControlStep) -> tuple[EpisodeMetrics, EpisodeFrame]:
        before, state, result, lanes = step.before, step.after, step.result, step.scene.lanes
        boxes = env.current_scene(step.scene, state).traffic
        signals = update_signals(metrics.signals, metrics.past_events, lanes, boxes, before, state, result.metrics, thresholds)
        numbers = {"course": course, "control_dt": control_dt}
        route = route_signals.update_signals(metrics.route, step.scene, before, state, result.metrics, **numbers)
        traffic = TrafficFrame(boxes.position, boxes.yaw, boxes.velocity, boxes.size, boxes.present)
        frame = EpisodeFrame(
            position=state.motion.position[:, :2],
            yaw=state.motion.yaw,
            velocity=state.motion.velocity[:, :2],
            friction_utilization=result.metrics.friction_utilization,
            active=before.active,
            goal=state.agents.goal,
            events=result.events,
            traffic=traffic,
            height=surrogate_safety.find_heights(step.scene, state.motion, boxes),
        )
        return _update(metrics, step, signals, route, ttc_limit_s=ttc_limit_s), frame

    return hook


def _update(
    metrics: EpisodeMetrics, step: ControlStep, signals: FailureSignals, route: RouteSignals, *, ttc_limit_s: float
) -> EpisodeMetrics:
    before, after, now = step.before, step.after, step.result.metrics
    active = before.active & ~now.events.numerical_error  # metrics of a state that is not finite are not valid
    has_ttc = active & jnp.isfinite(now.ttc)
    values = {
        "ttc": jnp.where(has_ttc, jnp.minimum(now.ttc, ttc_limit_s), 0.0),
        "speed": now.speed,
        "yaw_rate_change": jnp.abs(after.motion.yaw_rate - before.motion.yaw_rate),
        "mu": now.mu,
        "friction_utilization": now.friction_utilization,
    }
    return EpisodeMetrics(
        past_events=jax.tree.map(lambda old, new: old | (new & before.active), metrics.past_events, now.events),
        steps=metrics.steps + active.astype(jnp.int32),
        ttc_steps=metrics.ttc_steps + has_ttc.astype(jnp.int32),
        goal_distance=jnp.where(active, now.goal_distance, metrics.goal_distance),
        sums={name: metrics.sums[name] + jnp.where(active, value, 0) for name, value in values.items()},
        largest={name: jnp.maximum(old, jnp.where(active, getattr(now, name), 0.0)) for name, old in metrics.largest.items()},
        smallest={name: jnp.minimum(old, jnp.where(active, getattr(now, name), jnp.inf)) for name, old in metrics.smallest.items()},
        signals=signals,
        route=route,
    )
