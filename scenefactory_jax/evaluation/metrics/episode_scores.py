"""Scores of an episode from its metrics: V-Max's, V-Max's of nuPlan's kind, nuPlan's own, and V-Max's accuracy.

A factor or term whose metric is not valid is 1. The published codes do so without lights, without a route or a moving expert, and on lanes
without a known speed limit (NEUTRAL); a score that lacks anything else is not valid.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.evaluation.metrics.episode_metrics import Value

# weights of the terms; FACTORS and EVENTS multiply
VMAX_WEIGHTS = {"ttc_within_bound": 5, "progress_ratio": 5, "speed_compliance": 4, "several_lanes_score": 3, "comfort": 2}
VMAX_NUPLAN_WEIGHTS = {name: weight for name, weight in VMAX_WEIGHTS.items() if name != "several_lanes_score"}
NUPLAN_WEIGHTS = {"nuplan_progress": 5, "nuplan_ttc_within_bound": 5, "nuplan_speed_compliance": 4, "nuplan_comfort": 2}
VMAX_FACTORS = ("making_progress", "direction_compliance")
VMAX_EVENTS = ("at_fault_collision", "off_road")
NUPLAN_FACTORS = ("nuplan_no_at_fault_collision", "nuplan_drivable_area", "nuplan_making_progress", "nuplan_direction_compliance")
NEUTRAL = (
    "red_light_run",
    "progress_ratio",
    "making_progress",
    "nuplan_progress",
    "nuplan_making_progress",
    "nuplan_speed_compliance",
)
FAILURES = ("overlap", "off_road", "red_light_run")  # V-Max: an accurate episode has none of them


def compute_scores(metrics: Mapping[str, Value]) -> dict[str, Value]:
    """Computes the scores from the results of `episode_metrics.compute_episode_metrics`."""
    return {
        "accuracy": _combine(metrics, {}, factors=(), events=FAILURES),
        "vmax_score": _combine(metrics, VMAX_WEIGHTS, factors=VMAX_FACTORS, events=(*VMAX_EVENTS, "red_light_run")),
        "vmax_nuplan_score": _combine(metrics, VMAX_NUPLAN_WEIGHTS, factors=VMAX_FACTORS, events=VMAX_EVENTS),
        "nuplan_score": _combine(metrics, NUPLAN_WEIGHTS, factors=NUPLAN_FACTORS, events=()),
    }


def _combine(metrics: Mapping[str, Value], weights: Mapping[str, int], *, factors: tuple[str, ...], events: tuple[str, ...]) -> Value:
    """Multiplies the weighted mean of terms, at most 1 each, by factors and by 1 - event."""
    one = jnp.float32(1.0)
    score = sum((weight * _read(metrics, name) for name, weight in weights.items()), start=jnp.float32(0.0))
    score = score / sum(weights.values()) if weights else one
    for name in factors:
        score = score * _read(metrics, name)
    for name in events:
        score = score * (1.0 - jnp.where(metrics[name].valid, metrics[name].value, 0.0))
    valid = jnp.ones((), bool)
    for name in (*weights, *factors, *events):
        valid = valid & (metrics[name].valid | (name in NEUTRAL))
    return Value(jnp.where(valid, score, 0.0), valid)


def _read(metrics: Mapping[str, Value], name: str) -> Float[Array, ""]:
    """The value of a metric, at most 1 for the progress, which may be larger; 1 if it is not valid."""
    value, valid = metrics[name]
    return jnp.where(valid, jnp.minimum(value, 1.0) if "progress" in name else value, 1.0)
