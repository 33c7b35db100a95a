"""Finds the states of an episode in which its metrics fail, for pages that show the episode in time.

Only metrics that are judged in time have such states: not progress, which is judged at the end.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Bool

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.evaluation.metrics import episode_metrics, nuplan_steps, vmax_steps
from scenefactory_jax.evaluation.metrics.episode_metrics import Value
from scenefactory_jax.evaluation.metrics.episode_record import EpisodeRecord
from scenefactory_jax.evaluation.metrics.episode_steps import StepMetrics

EVENTS = {  # metric whose value above 0 is a failure -> what happens
    "overlap": "contact",
    "at_fault_collision": "at-fault collision",
    "off_road": "off the road",
    "red_light_run": "red light run",
}
COMPLIANCE = {  # metric whose value below 1 is a failure -> what happens
    "ttc_within_bound": "TTC below 0.95 s",
    "speed_compliance": "over the estimated limit",
    "several_lanes_score": "on several lanes",
    "direction_compliance": "among oncoming traffic",
    "comfort": "discomfort",
    "nuplan_no_at_fault_collision": "nuPlan: at-fault collision",
    "nuplan_drivable_area": "nuPlan: off the drivable area",
    "nuplan_direction_compliance": "nuPlan: against the direction",
    "nuplan_ttc_within_bound": "nuPlan: TTC within 0.95 s",
    "nuplan_speed_compliance": "nuPlan: over the limit",
    "nuplan_comfort": "nuPlan: discomfort",
}
LABELS = EVENTS | COMPLIANCE


def find_failures(record: EpisodeRecord, steps: StepMetrics, metrics: Mapping[str, Value], *, dt: float) -> dict[str, Bool[Array, " T"]]:
    """Finds the counted states in which each metric of LABELS fails; none of a metric that is met in the end or has no value.

    A second that is uncomfortable or leads against the lanes is marked at its end. Seconds on several lanes and metres among oncoming
    traffic are marked all, where together they exceed the bound.

    Args:
        metrics: of the same record.
    """
    speed, counted = safe_norm(record.ego.velocity), record.counted
    against = nuplan_steps.measure_wrong_direction(record.ego.position[:, :2], steps.lane_direction, counted, dt=dt)
    states = {
        "overlap": jnp.any(steps.touching, axis=1),
        "at_fault_collision": steps.at_fault > 0,
        "off_road": steps.off_road,
        "red_light_run": episode_metrics.find_red_light_runs(record, steps),
        "ttc_within_bound": steps.ttc_s < nuplan_steps.TTC_BOUND_S,
        "speed_compliance": episode_metrics.compute_overspeed(record, steps) > 0,
        "several_lanes_score": steps.several_lanes & (speed > 0),
        "direction_compliance": steps.oncoming & (speed > 0),
        "comfort": episode_metrics.find_uncomfortable(record, dt=dt)[0],
        "nuplan_no_at_fault_collision": jnp.any(steps.nuplan_at_fault, axis=1),
        "nuplan_drivable_area": steps.outside_m > nuplan_steps.OUTSIDE_M,
        "nuplan_direction_compliance": against > vmax_steps.ONCOMING_M[0],
        "nuplan_ttc_within_bound": steps.nuplan_ttc_s <= nuplan_steps.TTC_BOUND_S,
        "nuplan_speed_compliance": episode_metrics.compute_limit_excess(record, steps)[0] > 0,
        "nuplan_comfort": episode_metrics.find_nuplan_discomfort(record, dt=dt),
    }
    failed = lambda name: metrics[name].valid & ((metrics[name].value > 0) if name in EVENTS else (metrics[name].value < 1))  # noqa: E731
    return {name: states[name] & counted & failed(name) for name in LABELS}
