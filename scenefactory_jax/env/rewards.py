"""Reward terms: functions of one Step that give a number for each agent; `weigh` sums them.

A term is a config entry `{_target_: progress, weight: 2.0, limit_m: 2.0}`: `weight` multiplies the term, the other keys are its numbers.
One's own term is the same with a dotted target: `{_target_: my_terms.jerk, weight: -0.1}`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.instantiate import ConfigError, check_type, instantiate
from scenefactory_jax.core.types import RewardInput
from scenefactory_jax.env.termination import EVENTS

Term = Callable[[RewardInput], Float[Array, " A"]]


def event(step: RewardInput, *, name: str) -> Float[Array, " A"]:
    """1 in the step in which the named event is new."""
    if name not in EVENTS:
        raise ConfigError(f"reward: unknown event {name!r}; valid: {', '.join(EVENTS)}")
    return getattr(step.events, name).astype(jnp.float32)


def progress(step: RewardInput, *, limit_m: float) -> Float[Array, " A"]:
    """Metres along the nearest lane towards the goal, clamped to one step's plausible way (arXiv:2605.08528, Table 7, route progress)."""
    return jnp.clip(step.metrics.progress, -limit_m, limit_m)


def lane_keeping(step: RewardInput, *, sigma_m: float, heading_fraction: float) -> Float[Array, " A"]:
    """exp(-(offset/sigma)^2) [(1 - share) + share max(0, cos heading error)] (arXiv:2605.08528, Table 7); 0 where there is no lane."""
    near = jnp.exp(-((step.metrics.lane_offset / sigma_m) ** 2))
    aligned = (1 - heading_fraction) + heading_fraction * jnp.maximum(step.metrics.lane_alignment, 0.0)
    return jnp.where(step.metrics.has_lane, near * aligned, 0.0)


def off_lane(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car is off its lane (arXiv:2605.08528, Table 7, off-road)."""
    return step.metrics.off_lane.astype(jnp.float32)


def idle(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car stands or creeps."""
    return step.metrics.idle.astype(jnp.float32)


def ttc(step: RewardInput, *, alpha_s: float, limit: float, floor_s: float) -> Float[Array, " A"]:
    """Closeness to a collision with another car: min(alpha / TTC, limit), and the limit below the floor (arXiv:2605.08528, Table 7)."""
    return _urgency(step.metrics.ttc, alpha_s=alpha_s, limit=limit, floor_s=floor_s)


def edge_ttc(step: RewardInput, *, alpha_s: float, limit: float, floor_s: float) -> Float[Array, " A"]:
    """The same for the road edge ahead."""
    return _urgency(step.metrics.edge_ttc, alpha_s=alpha_s, limit=limit, floor_s=floor_s)


def low_clearance(step: RewardInput, *, limit_m: float) -> Float[Array, " A"]:
    """Closeness to the nearest other car: 1 where the bounding circles touch, 0 from `limit_m` between them on.

    TTC says little of a car that follows another at its own speed a hand's breadth behind it.
    """
    return _closeness(step.metrics.clearance, limit_m)


def edge_clearance(step: RewardInput, *, limit_m: float) -> Float[Array, " A"]:
    """The same for the nearest road edge, in any direction."""
    return _closeness(step.metrics.edge_clearance, limit_m)


def stopping(step: RewardInput, *, limit_m: float) -> Float[Array, " A"]:
    """How much longer than the free way straight ahead the way to stop is, on the road's friction: 0 for a car that could stop before
    whoever is ahead, 1 for one that could not by `limit_m` or more.

    It grows with every metre per second too many and with every bit of friction too few long before TTC does.
    """
    return jnp.clip(-step.metrics.stopping_margin / limit_m, 0.0, 1.0)


def wrong_way(step: RewardInput) -> Float[Array, " A"]:
    """How far the car points against the direction of its nearest lane: 1 against the traffic, 0 across it, with it, and without lanes."""
    return jnp.maximum(-step.metrics.lane_heading, 0.0)


def speed(step: RewardInput, *, limit_mps: float) -> Float[Array, " A"]:
    """Speed as a share of a limit, clamped to 1: the optional bonus of the published code, off by default."""
    return jnp.clip(step.metrics.speed / limit_mps, 0.0, 1.0)


def action_rate(step: RewardInput) -> Float[Array, " A"]:
    """Squared change of the action since the last step."""
    return jnp.sum((step.action - step.before.previous_action) ** 2, axis=-1)


def steer_rate(step: RewardInput) -> Float[Array, " A"]:
    """Squared change of the steering since the last step: a price on weaving that leaves the pedals alone.

    A dear price on every change (`action_rate`) was seen to keep cars from learning to brake.
    """
    return (step.action[:, 1] - step.before.previous_action[:, 1]) ** 2


def _closeness(gap: Float[Array, " A"], limit_m: float) -> Float[Array, " A"]:
    return jnp.clip(1.0 - gap / limit_m, 0.0, 1.0)


def _urgency(time: Float[Array, " A"], *, alpha_s: float, limit: float, floor_s: float) -> Float[Array, " A"]:
    """With the paper's own formula, min(alpha / max(t, floor), limit), the limit is out of reach; the published code steps to it below
    the floor, and so do we."""
    return jnp.where(time < floor_s, limit, jnp.minimum(alpha_s / jnp.maximum(time, floor_s), limit))


def make(entries: Mapping[str, Mapping[str, Any] | None], *, where: str = "reward", **context: Any) -> dict[str, tuple[float, Term]]:
    """Config entries -> name -> (weight, term with its numbers bound). An entry of null is left out, so that an override can drop a term.

    Raises:
        ConfigError: an entry without weight or with keys that its target does not take.
    """
    terms = {}
    for name, entry in entries.items():
        if entry is None:
            continue
        if not isinstance(entry, Mapping) or "weight" not in entry:
            raise ConfigError(f"{where}.{name}.weight: missing; a reward term is {{_target_: ..., weight: ..., its numbers}}")
        check_type(entry["weight"], float, where=f"{where}.{name}.weight")
        numbers = {key: value for key, value in entry.items() if key != "weight"}
        terms[name] = (float(entry["weight"]), instantiate(numbers, builtins=__name__, where=f"{where}.{name}", **context))
    return terms


def sum_terms(step: RewardInput, terms: Mapping[str, tuple[float, Term]]) -> tuple[Float[Array, " A"], dict[str, Float[Array, " A"]]]:
    """The weighted sum and its parts; zero for agents that were not active in the step."""
    active = step.before.active
    parts = {name: jnp.where(active, weight * term(step), 0.0).astype(jnp.float32) for name, (weight, term) in terms.items()}
    total = sum(parts.values(), start=jnp.zeros(active.shape, jnp.float32))
    return total, parts
