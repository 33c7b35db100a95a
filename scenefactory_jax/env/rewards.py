"""Reward terms: functions of a `RewardInput` that give a number for each agent; `sum_terms` adds them up.

A term is a config entry `{_target_: progress, weight: 2.0, limit_m: 2.0}`: `weight` multiplies the term, the other keys are its parameters.
A term from another module has a dotted target: `{_target_: my_terms.jerk, weight: -0.1}`.

A weight may be a range, [low, high]: each agent draws its own at every start and keeps it until the next (`State.reward_weights`), as in
Gigaflow (arXiv:2502.03349); the observation group `reward_weights` shows it. `held: 3.0` beside the range gives all agents that weight.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Count, Fraction, NonNegative, Positive, Weight, read_value
from scenefactory_jax.core.types import RewardInput
from scenefactory_jax.env import route_following
from scenefactory_jax.env.bend_speed import find_bend_speed
from scenefactory_jax.env.leaders import find_leaders
from scenefactory_jax.env.termination import EventName
from scenefactory_jax.roadgraph import traffic_lights

Term = Callable[[RewardInput], Float[Array, " A"]]


class WeightRange(NamedTuple):
    """Weights of a term that agents draw, uniformly, or one of them that all agents have."""

    low: float
    high: float
    held: float | None


Weights = Mapping[str, tuple[float | WeightRange, Term]]  # name -> (weight, term)


def event(step: RewardInput, *, name: EventName) -> Float[Array, " A"]:
    """1 in the step in which the named event is new."""
    return getattr(step.events, name).astype(jnp.float32)


def moving_collision(step: RewardInput, *, standing_mps: NonNegative) -> Float[Array, " A"]:
    """1 in the step in which a collision is new, for a car that was faster than `standing_mps`: one that stands and is hit pays nothing."""
    moved = safe_norm(step.before.motion.velocity[:, :2]) > standing_mps
    return (step.events.collision & moved).astype(jnp.float32)


def progress(step: RewardInput, *, limit_m: NonNegative) -> Float[Array, " A"]:
    """Metres along the nearest lane towards the goal, clamped to a plausible distance of a step (arXiv:2605.08528, Table 7)."""
    return jnp.clip(step.metrics.progress, -limit_m, limit_m)


def route_progress(step: RewardInput, *, limit_m: NonNegative) -> Float[Array, " A"]:
    """Metres along the agent's route, clamped to a plausible distance of a step; 0 without a route."""
    return jnp.clip(step.metrics.route_progress, -limit_m, limit_m)


def route_distance(step: RewardInput, *, limit_m: Positive) -> Float[Array, " A"]:
    """Distance from the agent's route as a fraction of a limit, clamped to 1; 0 without a route."""
    return jnp.clip(step.metrics.route_distance / limit_m, 0.0, 1.0)


def overspeed(step: RewardInput, *, limit_mps: Positive) -> Float[Array, " A"]:
    """Speed above the route's speed limit as a fraction of a limit, clamped to 1; 0 where no speed limit is known."""
    return jnp.clip(step.metrics.overspeed / limit_mps, 0.0, 1.0)


def bend_speed(
    step: RewardInput,
    *,
    limit_mps: Positive,
    look_ahead_m: Positive,
    chord_m: Count,
    lateral_mps2: Positive,
    braking_mps2: Positive,
) -> Float[Array, " A"]:
    """Speed above that with which the car can keep to the bends of its route ahead, as a fraction of a limit, clamped to 1.

    Args:
        limit_mps: the others as of `find_bend_speed`. Of recorded drivers' moving steps 1.6 % are above 4 m/s^2 and braking of 3 m/s^2.
    """
    numbers = {"look_ahead_m": look_ahead_m, "chord_m": chord_m, "lateral_mps2": lateral_mps2, "braking_mps2": braking_mps2}
    slowest = find_bend_speed(step.scene, step.after, **numbers)
    return jnp.clip((safe_norm(step.after.motion.velocity[:, :2]) - slowest) / limit_mps, 0.0, 1.0)


def stop_line_speed(step: RewardInput, *, braking_mps2: Positive, limit_mps: Positive, control_dt: float) -> Float[Array, " A"]:
    """Speed above that from which braking ends at the next line that demands a stop, as a fraction of a limit, clamped to 1.

    A line on the agent's route demands a stop while its light is red, and where a stop sign is before which the car has not stood. The
    allowed speed is sqrt(2 b d) at a distance d of the front. 0 without such a line ahead.
    """
    state, time_s = step.after, step.after.step.astype(jnp.float32) * control_dt
    lines = route_following.find_stop_lines(step.scene, state.agents, state.route.arc, time_s)
    speed = safe_norm(state.motion.velocity[:, :2])
    demands = lines.red | (lines.stop_sign & ~state.route.stood[:, None])
    room = jnp.min(jnp.where(demands & (lines.distance > 0), lines.distance, jnp.inf), axis=1, initial=jnp.inf)
    excess = speed - jnp.sqrt(2.0 * braking_mps2 * room)
    return jnp.where(route_following.find_routed(step.scene, state.agents), jnp.clip(excess / limit_mps, 0.0, 1.0), 0.0)


def late_yellow(step: RewardInput, *, braking_mps2: Positive, control_dt: float) -> Float[Array, " A"]:
    """1 in the step in which the car's front passes a stop line late at yellow, where it could have stopped.

    Late: the light has been yellow for longer than v / 2b. A car that came up at its speed v was then farther away than v^2 / 2b when the
    light changed. Cars that only fear the red light go faster at yellow, and some come too late.
    """
    state, time_s = step.after, step.after.step.astype(jnp.float32) * control_dt
    if not step.scene.controls.valid.shape[0]:
        return jnp.zeros(len(state.active))
    lines = route_following.find_stop_lines(step.scene, state.agents, state.route.arc, time_s)
    passed = (lines.distance <= 0) & (lines.distance + (state.route.arc - step.before.route.arc)[:, None] > 0)
    age = traffic_lights.read_light_ages(step.scene.controls, time_s)[lines.control]
    late = age > safe_norm(state.motion.velocity[:, :2])[:, None] / (2.0 * braking_mps2)
    late_passes = jnp.any(passed & traffic_lights.find_yellow(lines.state) & late, axis=1)
    return (late_passes & route_following.find_routed(step.scene, state.agents)).astype(jnp.float32)


def leader_speed(
    step: RewardInput,
    *,
    braking_mps2: Positive,
    limit_mps: Positive,
    look_ahead_m: Positive,
    chord_m: Count,
    margin_m: NonNegative,
    foresight_s: NonNegative,
) -> Float[Array, " A"]:
    """Speed above that from which braking ends at the leader with the leader's speed, as a fraction of a limit, clamped to 1.

    The allowed speed is sqrt(u^2 + 2 b d) at a gap d to a leader of the speed u, Gipps' of a driver without reaction time. Unlike the TTC
    it lets a car come up to another, or wait before it, for nothing. The leader is that of the observation group `leader`.
    """
    strip = {"look_ahead_m": look_ahead_m, "chord_m": chord_m, "margin_m": margin_m, "foresight_s": foresight_s}
    leader = find_leaders(step.scene, step.after, **strip)
    allowed = jnp.sqrt(leader.speed**2 + 2.0 * braking_mps2 * jnp.maximum(leader.gap, 0.0))
    return jnp.clip((safe_norm(step.after.motion.velocity[:, :2]) - allowed) / limit_mps, 0.0, 1.0)


def slow_progress(step: RewardInput, *, limit_mps: Positive, queue_m: NonNegative, control_dt: float) -> Float[Array, " A"]:
    """By how much progress along the route is slower than `limit_mps`, as a fraction of it: 1 at rest, 2 at most for a car that backs.

    0 without a route, and while a stop line with a red light is at most `queue_m` ahead. Where a collision costs what hundreds of metres
    pay, a car that might touch another stands for ever. A price of standing alone would let cars rock back and forth for nothing.
    """
    state, time_s = step.after, step.after.step.astype(jnp.float32) * control_dt
    lines = route_following.find_stop_lines(step.scene, state.agents, state.route.arc, time_s)
    waits = jnp.any(lines.red & (lines.distance > 0) & (lines.distance <= queue_m), axis=1)
    slow = jnp.clip(1.0 - step.metrics.route_progress / (limit_mps * control_dt), 0.0, 2.0)
    return jnp.where(waits | ~route_following.find_routed(step.scene, state.agents), 0.0, slow)


def against_traffic(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car drives against its lane or its route (`step_metrics.route`)."""
    return step.metrics.wrong_way.astype(jnp.float32)


def lane_keeping(step: RewardInput, *, sigma_m: Positive, heading_fraction: Fraction) -> Float[Array, " A"]:
    """exp(-(offset/sigma)^2) [(1 - f) + f max(0, cos heading error)] (arXiv:2605.08528, Table 7); 0 without a lane."""
    near = jnp.exp(-((step.metrics.lane_offset / sigma_m) ** 2))
    aligned = (1 - heading_fraction) + heading_fraction * jnp.maximum(step.metrics.lane_alignment, 0.0)
    return jnp.where(step.metrics.has_lane, near * aligned, 0.0)


def off_lane(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car is off its lane (arXiv:2605.08528, Table 7, off-road)."""
    return step.metrics.off_lane.astype(jnp.float32)


def idle(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car is slower than `step_metrics.idle_speed_mps`."""
    return step.metrics.idle.astype(jnp.float32)


def ttc(step: RewardInput, *, alpha_s: NonNegative, limit: NonNegative, floor_s: Positive) -> Float[Array, " A"]:
    """min(alpha / TTC, limit), and the limit below the floor, for the TTC with other cars (arXiv:2605.08528, Table 7)."""
    return _inverse_ttc(step.metrics.ttc, alpha_s=alpha_s, limit=limit, floor_s=floor_s)


def edge_ttc(step: RewardInput, *, alpha_s: NonNegative, limit: NonNegative, floor_s: Positive) -> Float[Array, " A"]:
    """The same for the TTC with the road edge ahead."""
    return _inverse_ttc(step.metrics.edge_ttc, alpha_s=alpha_s, limit=limit, floor_s=floor_s)


def low_clearance(step: RewardInput, *, limit_m: Positive) -> Float[Array, " A"]:
    """1 where the bounding circles touch the nearest other car's, falling to 0 at a clearance of `limit_m`.

    TTC is infinite for a car that follows another closely at the same speed.
    """
    return jnp.clip(1.0 - step.metrics.clearance / limit_m, 0.0, 1.0)


def edge_clearance(step: RewardInput, *, limit_m: Positive) -> Float[Array, " A"]:
    """The same for the nearest road edge, in any direction."""
    return jnp.clip(1.0 - step.metrics.edge_clearance / limit_m, 0.0, 1.0)


def stopping(step: RewardInput, *, limit_m: Positive) -> Float[Array, " A"]:
    """Excess of the stopping distance on the road's friction over the free distance straight ahead: 0 for a car that can stop in time, 1
    for an excess of `limit_m` or more. It rises with speed and with falling friction earlier than TTC does."""
    return jnp.clip(-step.metrics.stopping_margin / limit_m, 0.0, 1.0)


def wrong_way(step: RewardInput) -> Float[Array, " A"]:
    """Minus the cosine between the car and its nearest lane's direction, at least 0; 0 without lanes."""
    return jnp.maximum(-step.metrics.lane_heading, 0.0)


def speed(step: RewardInput, *, limit_mps: Positive) -> Float[Array, " A"]:
    """Speed as a fraction of a limit, clamped to 1: the optional bonus of the published code, off by default."""
    return jnp.clip(step.metrics.speed / limit_mps, 0.0, 1.0)


def action_rate(step: RewardInput) -> Float[Array, " A"]:
    """Squared change of the action since the last step."""
    return jnp.sum((step.action - step.before.previous_action) ** 2, axis=-1)


def steer_rate(step: RewardInput) -> Float[Array, " A"]:
    """Squared change of the steering since the last step. Unlike `action_rate` it does not keep cars from learning to brake."""
    return (step.action[:, 1] - step.before.previous_action[:, 1]) ** 2


def _inverse_ttc(time: Float[Array, " A"], *, alpha_s: float, limit: float, floor_s: float) -> Float[Array, " A"]:
    """The paper's formula, min(alpha / max(t, floor), limit), never reaches the limit; the published code steps to it below the floor."""
    return jnp.where(time < floor_s, limit, jnp.minimum(alpha_s / jnp.maximum(time, floor_s), limit))


def make(
    entries: Mapping[str, Mapping[str, Any] | None], *, where: str = "reward", **context: Any
) -> dict[str, tuple[float | WeightRange, Term]]:
    """Binds config entries: name -> (weight, term). An entry of null is left out, so that an override can drop a term.

    Raises:
        ConfigError: an entry without weight or with keys that its target does not take.
    """
    terms = {}
    for name, entry in entries.items():
        if entry is None:
            continue
        if not isinstance(entry, Mapping) or "weight" not in entry:
            raise ConfigError(f"{where}.{name}.weight: missing; a reward term is {{_target_: ..., weight: ..., its parameters}}")
        weight = _read_weight(entry, where=f"{where}.{name}")
        own = ("weight", "held") if isinstance(weight, WeightRange) or entry.get("held") is None else ("weight",)
        numbers = {key: value for key, value in entry.items() if key not in own}
        terms[name] = (weight, instantiate(numbers, builtins=__name__, where=f"{where}.{name}", **context))
    return terms


def _read_weight(entry: Mapping[str, Any], *, where: str) -> float | WeightRange:
    weight = read_value(entry["weight"], Weight, where=f"{where}.weight")
    if not isinstance(weight, tuple):
        return float(weight)
    held = read_value(entry.get("held"), float | None, where=f"{where}.held")
    if held is not None and not weight[0] <= held <= weight[1]:
        raise ConfigError(f"{where}.held: expected a number of the range {where}.weight={list(weight)}, or null, got {held:g}")
    return WeightRange(weight[0], weight[1], held)


def read_ranges(entries: Mapping[str, Mapping[str, Any] | None], *, where: str = "reward") -> dict[str, WeightRange]:
    """Reads the ranges of the config entries whose weight is one, by name."""
    given = {name: entry for name, entry in entries.items() if isinstance(entry, Mapping) and "weight" in entry}
    weights = {name: _read_weight(entry, where=f"{where}.{name}") for name, entry in given.items()}
    return {name: weight for name, weight in weights.items() if isinstance(weight, WeightRange)}


def hold_weights(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Holds the weights of ranges for an evaluation: where `held` gives none, in the middle."""
    held = {name: (span.low + span.high) / 2 if span.held is None else span.held for name, span in read_ranges(entries).items()}
    return {**entries, **{name: {**entries[name], "held": weight} for name, weight in held.items()}}


def draw_weights(key: PRNGKeyArray, terms: Weights, agents: int) -> Any:
    """Draws the weights of all agents at their start, name -> Float[Array, "A"]; () where no term has a range."""
    ranges = {name: weight for name, (weight, _) in terms.items() if isinstance(weight, WeightRange)}
    if not ranges:
        return ()
    keys = jax.random.split(key, len(ranges))
    return {name: _draw(one, span, agents) for one, (name, span) in zip(keys, sorted(ranges.items()), strict=True)}


def _draw(key: PRNGKeyArray, span: WeightRange, agents: int) -> Float[Array, " A"]:
    if span.held is not None:
        return jnp.full(agents, span.held, jnp.float32)
    return jax.random.uniform(key, (agents,), jnp.float32, span.low, span.high)


def sum_terms(step: RewardInput, terms: Weights) -> tuple[Float[Array, " A"], dict[str, Float[Array, " A"]]]:
    """Computes the sum of the weighted terms, and each of them; zero for agents that were not active before the step."""
    active = step.before.active
    weights = {name: step.before.reward_weights[name] if isinstance(weight, WeightRange) else weight for name, (weight, _) in terms.items()}
    parts = {name: jnp.where(active, weights[name] * term(step), 0.0).astype(jnp.float32) for name, (_, term) in terms.items()}
    total = sum(parts.values(), start=jnp.zeros(active.shape, jnp.float32))
    return total, parts
