"""How well agents follow their routes, computed on the device during an episode: gates, wrong way, red lights, completion, metres driven.

A clean completion (suite `route100`): the car passes gates every 20 m along its route, 2.5 m to either side, and the last one, at the goal,
within 30 degrees of the route's direction, in 10 s and a second for every 4 m of the route; it has no other event, and drives the wrong way
for one second at most. Time does not count while the car stands and the next stop line on its route, up to 50 m ahead, has a red light.
An approach to a red light begins when that line comes within 50 m or turns red there. A red light that a car runs counts as avoidable if at
some step of its last approach the light was yellow or red and the car farther away than v^2 / 2b: recorded cars may start at a red line at
speed.
"""

from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.schema import Bounds, NonNegative, Positive
from scenefactory_jax.core.types import Scene, State, StepMetrics
from scenefactory_jax.env.observations.planning import read_stop_lines
from scenefactory_jax.env.traffic import idm_law
from scenefactory_jax.evaluation.records import EVENTS, Records


@dataclass(frozen=True)
class CourseThresholds:
    """What a clean completion is: the group `failures.course`."""

    gate_spacing_m: Positive
    gate_half_width_m: Positive
    goal_cosine: Annotated[float, Bounds(min=-1, max=1)]  # smallest between car and route at the goal
    start_s: NonNegative  # time limit: this and the route's length over the speed
    speed_mps: Positive
    queue_m: NonNegative  # before a red light, in which the time limit does not run for a car that stands
    stand_mps: NonNegative  # a slower car stands
    stop_braking_mps2: Positive  # a red light is avoidable for a car that could have stopped with it
    wrong_way_s: NonNegative


@pytree_dataclass
class RouteSignals:
    """Of the episode so far; zeros for agents without a route."""

    missed_gates: Int[Array, " A"]
    wrong_way_steps: Int[Array, " A"]
    red_steps: Int[Array, " A"]  # waiting for a red light
    red_ahead: Bool[Array, " A"]  # the next stop line, near ahead, has a red light
    red_approaches: Int[Array, " A"]  # how often that began
    could_stop: Bool[Array, " A"]  # the next stop line's light is yellow or red, and there was room to stop since it is
    ran_avoidable: Bool[Array, " A"]  # a red light that could have been stopped at
    completion: Float[Array, " A"]  # part of the route, 0 to 1
    goal_alignment: Float[Array, " A"]  # cosine between car and route in the last step
    driven: Float[Array, " A"]  # m
    overspeed: Float[Array, " A"]  # largest, m/s


def begin_signals(state: State) -> RouteSignals:
    """Returns the signals at the start of an episode."""
    zero, none, no = (jnp.zeros(state.active.shape, dtype) for dtype in (jnp.float32, jnp.int32, bool))
    return RouteSignals(none, none, none, no, none, no, no, zero, zero, zero, zero)


def update_signals(
    signals: RouteSignals, scene: Scene, before: State, after: State, metrics: StepMetrics, *, course: CourseThresholds, control_dt: float
) -> RouteSignals:
    """Computes the signals after one more step, for the agents that are active in `before`."""
    active = before.active & ~metrics.events.numerical_error
    routed = active & metrics.has_route
    start = after.agents.route_start
    gate = lambda arc: jnp.floor((arc - start) / course.gate_spacing_m)  # noqa: E731
    passes = gate(after.route.farthest) > gate(before.route.farthest)
    at_goal = metrics.events.goal_reached
    lines = read_stop_lines(scene, after, after.step.astype(jnp.float32) * control_dt)
    nearest = jnp.min(lines.distance, axis=1, keepdims=True, initial=course.queue_m)
    is_next = lines.distance <= nearest
    red = jnp.any(lines.red & is_next, axis=1)
    closed = (lines.red | lines.yellow) & is_next
    room = closed & idm_law.can_stop(metrics.speed[:, None], lines.distance, course.stop_braking_mps2)
    runs = routed & metrics.events.red_light
    begins = routed & red & ~signals.red_ahead
    missed = routed & (passes | at_goal) & (metrics.route_distance > course.gate_half_width_m)
    return RouteSignals(
        missed_gates=signals.missed_gates + missed.astype(jnp.int32),
        wrong_way_steps=signals.wrong_way_steps + (active & metrics.wrong_way).astype(jnp.int32),
        red_steps=signals.red_steps + (routed & red & (metrics.speed < course.stand_mps)).astype(jnp.int32),
        red_ahead=red,
        red_approaches=signals.red_approaches + begins.astype(jnp.int32),
        could_stop=jnp.any(room, axis=1) | (jnp.any(closed, axis=1) & signals.could_stop & ~runs),
        ran_avoidable=signals.ran_avoidable | (runs & signals.could_stop),
        completion=jnp.where(routed, metrics.route_completion, signals.completion),
        goal_alignment=jnp.where(routed, metrics.route_alignment, signals.goal_alignment),
        driven=signals.driven + jnp.where(active, metrics.speed * control_dt, 0.0),
        overspeed=jnp.maximum(signals.overspeed, jnp.where(routed, metrics.overspeed, 0.0)),
    )


def make_columns(signals: RouteSignals, records: Records, *, course: CourseThresholds, control_hz: float) -> dict[str, np.ndarray]:
    """Computes the columns of records: the signals, and whether each agent has cleanly completed its route.

    Args:
        signals: numpy rows, as those of `records`, which has `has_route`.
    """
    wrong_way_s = np.asarray(signals.wrong_way_steps) / control_hz
    red_s = np.asarray(signals.red_steps) / control_hz
    limit_s = course.start_s + records["route_m"] / course.speed_mps + red_s
    others = np.any([records[name] for name in EVENTS if name != "goal_reached"], axis=0)
    arrived = records["goal_reached"] & (records["time_s"] <= limit_s) & (signals.goal_alignment >= course.goal_cosine)
    clean = arrived & (np.asarray(signals.missed_gates) == 0) & ~others & (wrong_way_s <= course.wrong_way_s)
    return {
        # an agent that reached its goal has driven its route; the goal's radius is what is left of it
        "route_completion": np.where(records["goal_reached"] & records["has_route"], 1.0, signals.completion),
        "missed_gates": np.asarray(signals.missed_gates),
        "against_s": wrong_way_s,
        "red_light_wait_s": red_s,
        "red_light_approaches": np.asarray(signals.red_approaches),
        "red_light_avoidable": np.asarray(signals.ran_avoidable),
        "driven_m": np.asarray(signals.driven),
        "max_overspeed_mps": np.asarray(signals.overspeed),
        "clean_completion": clean & records["has_route"],
    }
