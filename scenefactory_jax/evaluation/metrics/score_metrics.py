"""Estimates of scored episodes: name -> label, unit and definition of what `evaluation.scoring` adds to records. NaN: it has no value.

The metrics themselves are defined in `episode_metrics` and `episode_scores`.
"""

from collections.abc import Callable

import numpy as np

from scenefactory_jax.evaluation.metrics.metric import FRACTION, Metric
from scenefactory_jax.evaluation.records import Records

RATE = "rate"  # a mean of Booleans, in per cent

SCORES = {  # in the order of reports: label, unit, definition
    "accuracy": ("Accuracy", RATE, "Episodes without overlap, off-road state and red-light run (V-Max)."),
    "vmax_score": ("V-Max score", "", "V-Max's aggregate of fault, road, progress, direction, lights, TTC, speed, lanes and comfort."),
    "vmax_nuplan_score": ("V-Max's nuPlan score", "", "V-Max's variant of nuPlan's score: no lights, no lanes."),
    "nuplan_score": ("nuPlan score", "", "nuPlan's closed-loop score."),
    "overlap": ("Overlap rate", RATE, "Episodes in which the rectangle of the car overlaps that of a road user."),
    "off_road": ("Off-road rate", RATE, "Episodes in which a corner of the car is beyond a road edge."),
    "red_light_run": ("Red-light runs", RATE, "Episodes in which the car's front comes onto a lane whose light is red."),
    "at_fault_collision": ("At-fault collisions", RATE, "Episodes with an overlap by the car's fault (V-Max)."),
    "progression": ("Progress", FRACTION, "Way along the route over that of the log; above 1 behind the log's end (Waymax)."),
    "progress_ratio": ("Progress ratio", FRACTION, "Largest part of the log's way that the car has reached (V-Max)."),
    "making_progress": ("Making progress", RATE, "Episodes with a progress ratio of 0.2 or more."),
    "ttc_within_bound": ("TTC within bound", RATE, "Episodes whose time to overlap never falls below 0.95 s (V-Max)."),
    "speed_compliance": ("Speed compliance", "", "1 without excess over the estimated speed limits, 0 from a mean of 2.23 m/s on (V-Max)."),
    "several_lanes_score": ("Lane keeping", "", "1, 0.5 or 0 by the time on several lanes (V-Max)."),
    "direction_compliance": ("Direction compliance", "", "1, 0.5 or 0 by the metres among oncoming traffic (V-Max)."),
    "comfort": ("Comfort", RATE, "Episodes within the bounds of comfort (V-Max)."),
    "nuplan_no_at_fault_collision": ("nuPlan: no fault", "", "nuPlan's multiplier of collisions by the car's fault."),
    "nuplan_drivable_area": ("nuPlan: drivable area", RATE, "Episodes in which no corner is more than 0.3 m outside the road."),
    "nuplan_direction_compliance": ("nuPlan: direction", "", "1, 0.5 or 0 by the metres against the lane in any second."),
    "nuplan_making_progress": ("nuPlan: making progress", RATE, "Episodes with a progress of 0.2 or more."),
    "nuplan_progress": ("nuPlan: progress", "", "Way along the route over the recorded driver's, at most 1."),
    "nuplan_ttc_within_bound": ("nuPlan: TTC within bound", RATE, "Episodes whose time to collision stays above 0.95 s."),
    "nuplan_speed_compliance": ("nuPlan: speed", "", "1 without excess over the lanes' limits, 0 from a mean of 2.23 m/s on."),
    "nuplan_comfort": ("nuPlan: comfort", RATE, "Episodes within nuPlan's bounds of comfort."),
    "log_divergence_m": ("Log divergence", "m", "Mean distance from the recorded position (Waymax)."),
    "encroachment_s": ("Post-encroachment time", "s", "Smallest time between two road users on the same place."),
    "delta_v_mps": ("Delta-v", "m/s", "Change of the car's speed in the worst of its first impacts, by the masses of both."),
    "route_success": ("Arrived", RATE, "Agents that complete more than 95 % of their recorded way, never out of road (ScenarioNet)."),
    "out_of_road": ("Out of road", RATE, "Agents 4 m (or as the protocol has it) beside their recorded way before arrival (ScenarioNet)."),
    "crashes": ("Crashes", "", "Road users that the car touches before it arrives or is out of road (ScenarioNet's cost)."),
    "cost": ("Cost", "states", "States beside the recorded way or in contact, each kind for itself (MetaDrive, ScenarioNet)."),
}  # fmt: skip


LIKELIHOODS = {  # of the log under the rollouts of a scene, by feature
    "linear_speed": "speed", "linear_acceleration": "acceleration", "angular_speed": "yaw rate", "angular_acceleration": "yaw acceleration",
    "distance_to_nearest_object": "distance to others", "collision": "collisions", "time_to_collision": "time to collision",
    "distance_to_road_edge": "distance to the road edge", "offroad": "leaving the road", "light_violation": "running red lights",
}  # fmt: skip
WOSAC = {  # of scenes: each has its value in one row
    **{
        str(year): (f"Realism, WOSAC {year}", "", f"Weighted sum of the likelihoods of the log under a scene's rollouts; rules of {year}.")
        for year in (2025, 2024, 2023)
    },
    "of_log": ("Realism of the log itself", "", "The same (2025) of the log under copies of itself, in which objects leave as logged."),
    "kinematic": ("Kinematic realism", "", "Weighted mean of the likelihoods of speeds and accelerations (WOSAC 2025)."),
    "interactive": ("Interactive realism", "", "Weighted mean of those of distance, collisions and time to collision (WOSAC 2025)."),
    "map": ("Map realism", "", "Weighted mean of those of the road edge and of red lights (WOSAC 2025)."),
    **{
        name: (f"Likelihood, {what}", "", f"Likelihood of the log's {what} under a scene's rollouts (WOSAC 2025).")
        for name, what in LIKELIHOODS.items()
    },
    "min_ade_m": ("minADE", "m", "Average displacement error of a scene's best rollout, in space; steps of the history count as 0."),
    "ade_m": ("ADE", "m", "Average displacement error of all rollouts of a scene."),
    "collision_rate": ("Simulated collisions", FRACTION, "Evaluated objects that collide, of all rollouts."),
    "offroad_rate": ("Simulated off-road", FRACTION, "Evaluated objects that leave the road, of all rollouts."),
    "light_violation_rate": ("Simulated red-light runs", FRACTION, "Evaluated vehicles that run a red light, of all rollouts."),
    "driven": ("Evaluated and driven", FRACTION, "Evaluated objects that the policy drives; the others are background traffic."),
    "unsimulated": ("Evaluated, not simulated", FRACTION, "Evaluated objects that the simulation lacks: they follow their log."),
}
SCORES |= {f"wosac_{name}": entry for name, entry in WOSAC.items()}


def _read(name: str) -> Callable[[Records], np.ndarray]:
    return lambda records: np.nan_to_num(np.asarray(records.get(name, np.full(len(records["scene"]), np.nan)), float))


def _is_known(name: str) -> Callable[[Records], np.ndarray]:
    return lambda records: ~np.isnan(np.asarray(records.get(name, np.full(len(records["scene"]), np.nan)), float))


METRICS = {
    name: Metric(label, FRACTION if unit == RATE else unit, definition, _read(name), _is_known(name), rate=unit == RATE, optional=True)
    for name, (label, unit, definition) in SCORES.items()
}
