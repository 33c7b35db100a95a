"""Computes all metrics of an episode from its record, as a flat dict: those of Waymax, V-Max, nuPlan and ScenarioNet, and surrogate safety.

A metric that cannot be computed is not valid: red lights without lights, lanes without lanes, progress of an expert that stands. Its value
then has no meaning; scores put the published rule in its place (`episode_scores`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.env import planning_metrics
from scenefactory_jax.env.step_metrics import StepMetricsConfig
from scenefactory_jax.evaluation.metrics import nuplan_steps, scenarionet_steps, vmax_steps, waymax_steps
from scenefactory_jax.evaluation.metrics.episode_record import CYCLIST, OBJECT, PEDESTRIAN, VEHICLE, EpisodeRecord, find_inside, find_span
from scenefactory_jax.evaluation.metrics.episode_safety import compute_impact
from scenefactory_jax.evaluation.metrics.episode_steps import StepMetrics, measure_steps
from scenefactory_jax.roadgraph import traffic_lights


class Value(NamedTuple):
    """A number of an episode, and whether it could be computed."""

    value: Float[Array, ""]
    valid: Bool[Array, ""]


def compute_episode_metrics(
    record: EpisodeRecord,
    *,
    dt: float = 0.1,
    max_lateral_m: float = scenarionet_steps.MAX_LATERAL_M,
    surrogates: StepMetricsConfig | None = None,
    as_published: bool | Bool[Array, ""] = False,
) -> dict[str, Value]:
    """Computes the metrics of an episode. No metric is valid of an episode without counted states.

    Args:
        dt: between states, s; V-Max's comfort and bounds of time are meant for 0.1.
        max_lateral_m: distance from the recorded track at which MetaDrive's car is out of road.
        surrogates: see `measure_steps`.
        as_published: V-Max's at-fault collisions and times on several lanes with the errors of its code.
    """
    steps = measure_steps(record, dt=dt, surrogates=surrogates, as_published=as_published)
    return collect_metrics(record, steps, dt=dt, max_lateral_m=max_lateral_m, as_published=as_published)


def collect_metrics(
    record: EpisodeRecord,
    steps: StepMetrics,
    *,
    dt: float = 0.1,
    max_lateral_m: float = scenarionet_steps.MAX_LATERAL_M,
    as_published: bool | Bool[Array, ""] = False,
) -> dict[str, Value]:
    """Collects the metrics of an episode from those of its steps; see `compute_episode_metrics`."""
    beyond, used = find_uncomfortable(record, dt=dt)
    found = _collect_events(record, steps, as_published=as_published) | _collect_routes(record, steps)
    found |= {"comfort": (~jnp.any(beyond), jnp.any(used))}
    found |= _collect_lanes(record, steps, dt=dt, as_published=as_published) | _collect_nuplan(record, steps, dt=dt)
    found |= _collect_safety(record, steps) | _collect_scenarionet(record, steps, max_lateral_m=max_lateral_m)
    any_counted = jnp.any(record.counted)
    make = lambda value, valid: Value(jnp.where(valid, value, 0.0).astype(jnp.float32), valid & any_counted)  # noqa: E731
    return {name: make(jnp.asarray(value), jnp.asarray(valid)) for name, (value, valid) in found.items()}


Pairs = dict[str, tuple[Array, Array | bool]]  # value and whether it is valid


def _collect_events(record: EpisodeRecord, steps: StepMetrics, *, as_published: bool | Bool[Array, ""]) -> Pairs:
    """Metrics that concern other road users, road edges and lights: Waymax's and V-Max's."""
    counted = record.counted
    largest = lambda values: jnp.max(jnp.where(counted, values, 0))  # noqa: E731
    faults = largest(steps.at_fault)
    red = find_red_light_runs(record, steps)
    ttc = jnp.where(counted, steps.ttc_s, jnp.inf)
    known = jnp.any(jnp.where(counted[:, None], record.lights.state, 0) != 0) & jnp.any(record.paths.valid)
    return {
        "overlap": (largest(jnp.any(steps.touching, axis=1)), True),
        "off_road": (largest(steps.off_road), jnp.any(record.edges.valid)),
        "red_light_run": (largest(red), known),
        "at_fault_collision": (jnp.where(as_published, faults, jnp.minimum(faults, 1)), True),
        "min_ttc_s": (jnp.min(ttc), True),
        "mean_ttc_s": (_average(steps.ttc_s, counted), True),
        "ttc_within_bound": (jnp.min(ttc) >= nuplan_steps.TTC_BOUND_S, True),
        "mean_speed": (_average(safe_norm(record.ego.velocity), counted), True),
    }


def find_red_light_runs(record: EpisodeRecord, steps: StepMetrics) -> Bool[Array, " T"]:
    """Finds the states in which the car's front comes onto a lane with a red light."""
    lights = record.lights
    before = jnp.concatenate([steps.front_lane[:1], steps.front_lane[:-1]])
    red = traffic_lights.find_red(lights.state) & (lights.lane == steps.front_lane[:, None])
    return (steps.front_lane != before) & jnp.any(red, axis=1)


def _collect_routes(record: EpisodeRecord, steps: StepMetrics) -> Pairs:
    """Metrics that compare the car with its paths and with the log."""
    counted, log, ego = record.counted, record.log, record.ego
    first, last = find_span(record)
    rows = jnp.arange(len(counted))
    routes = jnp.any(record.paths.valid & record.paths.on_route[:, None])
    paths = jnp.any(record.paths.valid)
    largest = lambda values: jnp.max(jnp.where(counted, values, 0.0))  # noqa: E731
    here = log.valid & (rows >= first)
    furthest = vmax_steps.compute_furthest(ego.position[:, :2], log.position[:, :2], here)
    ratio = jnp.max(jnp.where(find_inside(first, last, len(rows)), furthest, 0.0))
    moves = scenarionet_steps.measure_track(log.position[:, :2], here) >= vmax_steps.STANDING_LOG_M
    apart = safe_norm(ego.position[:, :2] - log.position[:, :2])
    before = jnp.maximum(rows - 1, 0)
    infeasible = jax.vmap(lambda row, past: waymax_steps.find_infeasible_motion(
        ego.yaw[past], ego.velocity[past], ego.yaw[row], ego.velocity[row], dt=0.1))(rows, before)  # fmt: skip
    return {
        "progression": (steps.progression[last], routes),
        "off_route_m": (_average(steps.off_route_m, counted), routes),
        "vmax_off_route_m": (_average(steps.vmax_off_route_m, counted), routes),
        "wrong_way_m": (_average(steps.wrong_way_m, counted), paths),
        "log_divergence_m": (_average(apart, counted & log.valid), jnp.any(counted & log.valid)),
        "kinematic_infeasibility": (largest(infeasible), True),
        "progress_ratio": (ratio, moves),
        "making_progress": (ratio >= vmax_steps.MAKING_PROGRESS, moves),
    }


def find_uncomfortable(record: EpisodeRecord, *, dt: float) -> tuple[Bool[Array, " T"], Bool[Array, " T"]]:
    """Finds the counted states at which a second ends that is beyond V-Max's bounds of comfort, and those whose second is all valid."""
    rows = planning_metrics.COMFORT_ROWS
    end = jnp.arange(rows - 1, len(record.counted)) if len(record.counted) >= rows else jnp.zeros(0, jnp.int32)
    window = end[:, None] + jnp.arange(-rows + 1, 1)
    comfortable = planning_metrics.is_comfortable(
        planning_metrics.compute_comfort_parts(record.ego.velocity[window], record.ego.yaw[window], dt=dt)
    )
    used = record.counted[end] & jnp.all(record.ego.valid[window], axis=1)
    spread = lambda mask: jnp.zeros_like(record.counted).at[end].set(mask)  # noqa: E731
    return spread(~comfortable & used), spread(used)


def compute_overspeed(record: EpisodeRecord, steps: StepMetrics) -> Float[Array, " T"]:
    """Computes the excess over the speed limits that V-Max estimates, m/s."""
    top = jnp.max(jnp.where(record.log.valid, safe_norm(record.log.velocity), 0.0))
    limit = vmax_steps.estimate_speed_limit(record.lanes.kind[steps.lane_row], top)
    return jnp.maximum(safe_norm(record.ego.velocity) - limit, 0.0)


def _collect_lanes(record: EpisodeRecord, steps: StepMetrics, *, dt: float, as_published: bool | Bool[Array, ""]) -> Pairs:
    """V-Max's metrics of lanes: speed limits that it estimates, several lanes, oncoming traffic."""
    counted, lanes = record.counted, record.lanes
    has_lanes = jnp.any(lanes.valid)
    speed = safe_norm(record.ego.velocity)
    over, metres = compute_overspeed(record, steps), speed * dt
    total = lambda values, used: jnp.sum(jnp.where(counted & used, values, 0.0))  # noqa: E731
    seconds = dt * total(jnp.ones_like(speed), steps.several_lanes & (speed > 0))
    oncoming = total(metres, steps.oncoming)
    logged = has_lanes & jnp.any(record.log.valid)
    return {
        "max_overspeed_mps": (jnp.max(jnp.where(counted, over, 0.0)), logged),
        "speed_compliance": (vmax_steps.score_speed(over, counted, steps=jnp.sum(counted) - 1), logged),
        "several_lanes_m": (total(metres, steps.several_lanes), has_lanes),
        "several_lanes_s": (seconds, has_lanes),
        "several_lanes_score": (vmax_steps.score_several_lanes(seconds, as_published=as_published), has_lanes),
        "oncoming_m": (oncoming, has_lanes),
        "direction_compliance": (vmax_steps.score_direction(oncoming), has_lanes),
    }


def compute_limit_excess(record: EpisodeRecord, steps: StepMetrics) -> tuple[Float[Array, " T"], Bool[Array, " T"]]:
    """Computes the excess over the lanes' speed limits, m/s, and the counted states on lanes with a known one."""
    lanes, row = record.lanes, steps.lane_row
    limited = record.counted & lanes.has_limit[row] & lanes.valid[row]
    return jnp.where(limited, jnp.maximum(safe_norm(record.ego.velocity) - lanes.speed_limit[row], 0.0), 0.0), limited


def find_nuplan_discomfort(record: EpisodeRecord, *, dt: float) -> Bool[Array, " T"]:
    """Finds the states of the episode, its start included, that are beyond nuPlan's bounds of comfort."""
    first, last = find_span(record)
    comfort = nuplan_steps.compute_comfort(record.ego.velocity, record.ego.yaw, first, last, dt=dt)
    return find_inside(first, last, len(record.counted)) & ~nuplan_steps.is_comfortable(comfort)


def _collect_nuplan(record: EpisodeRecord, steps: StepMetrics, *, dt: float) -> Pairs:
    """nuPlan's own metrics; the names of those that V-Max has, too, begin with `nuplan_`."""
    counted, has_lanes = record.counted, jnp.any(record.lanes.valid)
    first, last = find_span(record)
    faults = jnp.any(steps.nuplan_at_fault & counted[:, None], axis=0)
    touched = jnp.any(steps.touching & counted[:, None])
    wrong = jnp.max(nuplan_steps.measure_wrong_direction(record.ego.position[:, :2], steps.lane_direction, counted, dt=dt))
    logged = record.log.valid & (jnp.arange(len(counted)) >= first)
    expert = [record.log.position[row, :2] for row in (jnp.argmax(logged), len(counted) - 1 - jnp.argmax(logged[::-1]))]
    start, end = (nuplan_steps.compute_route_arc(place, record.paths) for place in expert)
    progress = nuplan_steps.score_progress(steps.route_arc[last] - steps.route_arc[first], end - start)
    has_route = jnp.any(record.paths.valid & record.paths.on_route[:, None]) & jnp.any(logged)
    ttc = jnp.min(jnp.where(counted, steps.nuplan_ttc_s, jnp.inf))
    over, limited = compute_limit_excess(record, steps)
    judged = has_lanes | ~touched  # contacts at the sides are judged by lanes
    return {
        "nuplan_no_at_fault_collision": (nuplan_steps.score_collisions(faults, record.others.kind), judged),
        "nuplan_drivable_area": (jnp.all((steps.outside_m <= nuplan_steps.OUTSIDE_M) | ~counted), jnp.any(record.edges.valid)),
        "nuplan_wrong_direction_m": (wrong, has_lanes),
        "nuplan_direction_compliance": (vmax_steps.score_direction(wrong), has_lanes),
        "nuplan_progress": (progress, has_route),
        "nuplan_making_progress": (progress >= vmax_steps.MAKING_PROGRESS, has_route),
        "nuplan_min_ttc_s": (ttc, True),
        "nuplan_ttc_within_bound": (ttc > nuplan_steps.TTC_BOUND_S, True),
        "nuplan_speed_compliance": (vmax_steps.score_speed(over, counted, steps=last - first), jnp.any(limited)),
        "nuplan_comfort": (~jnp.any(find_nuplan_discomfort(record, dt=dt)), last - first + 1 >= nuplan_steps.JERK_WIDTH),
    }


def _collect_safety(record: EpisodeRecord, steps: StepMetrics) -> Pairs:
    """Surrogate safety: of each measure the worst state."""
    counted, use = record.counted, record.friction_utilization
    smallest = lambda values: jnp.min(jnp.where(counted, values, jnp.inf))  # noqa: E731
    ttc, encroachment, crossing = smallest(steps.circles_ttc_s), smallest(steps.encroachment_s), smallest(steps.crossing_s)
    touching = steps.touching & counted[:, None]
    impact, hit = compute_impact(record, touching), jnp.any(touching)
    use = jnp.zeros(len(counted)) if use is None else use
    given = record.friction_utilization is not None
    return {
        "min_circles_ttc_s": (ttc, jnp.isfinite(ttc)),
        "max_drac": (jnp.max(jnp.where(counted, steps.drac, 0.0)), ~jnp.any(jnp.isnan(steps.drac))),
        "encroachment_s": (encroachment, jnp.isfinite(encroachment)),
        "crossing_encroachment_s": (crossing, jnp.isfinite(crossing)),
        "impact_mps": (impact.speed, hit),
        "delta_v_equal_masses_mps": (impact.delta_v, hit),
        "delta_v_mps": (impact.weighted_delta_v, hit & (record.mass is not None) & (record.other_mass is not None)),
        "mean_friction_utilization": (_average(use, counted), given),
        "max_friction_utilization": (jnp.max(jnp.where(counted, use, 0.0)), given),
    }


def _collect_scenarionet(record: EpisodeRecord, steps: StepMetrics, *, max_lateral_m: float) -> Pairs:
    """MetaDrive's: completion of the recorded track where its episode ends (by arrival, out of road or by time), and contacts until then.
    Cost: all counted states out of road or in contact, each kind for itself."""
    counted, kind = record.counted, record.others.kind
    length = scenarionet_steps.measure_track(record.log.position[:, :2], record.log.valid)
    has_track = length >= scenarionet_steps.SHORT_TRACK_M
    completion = steps.track_arc / jnp.maximum(length, 1e-6)
    outside = (steps.track_distance > max_lateral_m) & counted & has_track
    ends = (outside | (completion > scenarionet_steps.SUCCESS_COMPLETION)) & counted
    last = jnp.where(jnp.any(ends), jnp.argmax(ends), find_span(record)[1])
    inside = counted & (jnp.arange(len(counted)) <= last)
    contact = lambda *kinds: jnp.any(steps.touching & jnp.isin(kind, jnp.array(kinds)), axis=1) & counted  # noqa: E731
    cost = sum(jnp.sum(flags) for flags in (outside, contact(VEHICLE), contact(PEDESTRIAN, CYCLIST), contact(OBJECT)))
    return {
        "route_completion": (completion[last], has_track),
        "route_success": ((completion[last] > scenarionet_steps.SUCCESS_COMPLETION) & ~outside[last], has_track),
        "out_of_road": (outside[last], has_track),
        "crashes": (jnp.sum(jnp.any(steps.touching & inside[:, None], axis=0)), True),
        "cost": (jnp.asarray(cost), True),
    }


def _average(values: Float[Array, " T"], used: Bool[Array, " T"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(used, values, 0.0)) / jnp.maximum(jnp.sum(used), 1)
