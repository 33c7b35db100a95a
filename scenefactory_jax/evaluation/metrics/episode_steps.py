"""Computes the step metrics of an episode: state after state, so that memory does not grow with the episode.

What compares a car with all points of lanes, road edges and paths is reduced to a few numbers a state before the next state begins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import cover_with_circles, safe_norm
from scenefactory_jax.env.planning_metrics import compute_time_to_overlap
from scenefactory_jax.env.step_metrics import StepMetricsConfig
from scenefactory_jax.env.surrogate_safety import compare_pairs, minimum_over_pairs
from scenefactory_jax.evaluation.metrics import nuplan_steps, scenarionet_steps, vmax_steps, waymax_steps
from scenefactory_jax.evaluation.metrics.episode_record import EpisodeRecord, find_inside, find_span
from scenefactory_jax.evaluation.metrics.episode_safety import compute_encroachment

TTC_HORIZON_S = 5.0


class StepMetrics(NamedTuple):
    """Metrics of each state of an episode."""

    touching: Bool[Array, "T O"]
    off_road: Bool[Array, " T"]  # Waymax
    outside_m: Float[Array, " T"]  # nuPlan; -inf without road edges
    front_lane: Int[Array, " T"]
    progression: Float[Array, " T"]
    off_route_m: Float[Array, " T"]  # Waymax; 0 on the route
    vmax_off_route_m: Float[Array, " T"]
    wrong_way_m: Float[Array, " T"]
    at_fault: Int[Array, " T"]  # contacts by the car's fault, V-Max
    ttc_s: Float[Array, " T"]  # V-Max
    lane_row: Int[Array, " T"]  # nearest point of `EpisodeRecord.lanes`
    several_lanes: Bool[Array, " T"]
    oncoming: Bool[Array, " T"]
    nuplan_at_fault: Bool[Array, "T O"]
    nuplan_ttc_s: Float[Array, " T"]
    lane_direction: Float[Array, "T 2"]
    route_arc: Float[Array, " T"]
    circles_ttc_s: Float[Array, " T"]  # inf without an approach
    drac: Float[Array, " T"]  # NaN without circles
    encroachment_s: Float[Array, " T"]
    crossing_s: Float[Array, " T"]
    track_arc: Float[Array, " T"]
    track_distance: Float[Array, " T"]


def measure_steps(
    record: EpisodeRecord, *, dt: float, surrogates: StepMetricsConfig | None = None, as_published: bool | Bool[Array, ""] = False
) -> StepMetrics:
    """Computes the metrics of all states; those of states that are not valid have no meaning.

    Args:
        surrogates: the circles that stand for road users, and the gap of DRAC; None: no measures between circles.
    """
    ego, others = record.ego, record.others
    boxes = others.position.swapaxes(0, 1), others.yaw.T, others.size
    touching = find_overlaps(ego.position[:, None, :2], ego.yaw[:, None], record.size, *boxes)
    first, last = find_span(record)
    counted = find_inside(first, last, len(ego.yaw)) & ego.valid
    touching = touching & others.valid.T & ego.valid[:, None]
    collided = jnp.cumsum(touching & record.counted[:, None], axis=0) > 0
    fresh = collided & ~jnp.concatenate([jnp.zeros_like(collided[:1]), collided[:-1]])

    def at_step(step: Int[Array, ""]) -> dict[str, Array]:
        contacts = find_contacts(record, step, as_published=as_published)
        found = _measure_road(record, step) | _measure_safety(record, step, surrogates)
        encroachment, crossing = compute_encroachment(record, step, counted, dt=dt)
        found |= {"encroachment_s": encroachment, "crossing_s": crossing}
        return found | _judge_contacts(record, step, contacts, found, collided[step], fresh[step])

    return StepMetrics(touching=touching, **jax.lax.map(at_step, jnp.arange(len(ego.yaw))))


def find_contacts(record: EpisodeRecord, step: Int[Array, ""], *, as_published: bool | Bool[Array, ""] = False) -> vmax_steps.Contacts:
    """Finds the contacts of one state; published: the front edge has no length, and no contacts."""
    ego, others = record.ego, record.others
    car = (ego.position[step, :2], ego.yaw[step], record.size)
    edge_m = jnp.where(as_published, 0.0, vmax_steps.FRONT_EDGE_M)
    return vmax_steps.find_contacts(*car, others.position[:, step], others.yaw[:, step], others.size, others.valid[:, step], edge_m=edge_m)


def _measure_road(record: EpisodeRecord, step: Int[Array, ""]) -> dict[str, Array]:
    """Where the car is on lanes, between road edges and along its paths."""
    ego, log, paths = record.ego, record.log, record.paths
    position, yaw = ego.position[step, :2], ego.yaw[step]
    place = vmax_steps.locate_on_lanes(ego.position[step], yaw, record.size, record.lanes)
    logged = log.valid
    ends = log.position[jnp.argmax(logged), :2], log.position[len(logged) - 1 - jnp.argmax(logged[::-1]), :2]
    track_arc, track_distance = scenarionet_steps.project_on_track(position, log.position[:, :2], logged)
    return {
        "off_road": jnp.any(waymax_steps.compute_edge_distances(ego.position[step], yaw, record.size, record.edges) > 0),
        "outside_m": nuplan_steps.measure_outside(ego.position[step], yaw, record.size, record.edges),
        "front_lane": waymax_steps.find_front_lane(position, yaw, record.size, paths),
        "progression": waymax_steps.compute_progression(position, *ends, paths),
        "off_route_m": waymax_steps.compute_off_route(position, paths, limits=waymax_steps.WAYMAX_OFF_ROUTE),
        "vmax_off_route_m": waymax_steps.compute_off_route(position, paths, limits=waymax_steps.VMAX_OFF_ROUTE),
        "wrong_way_m": waymax_steps.compute_wrong_way(position, paths),
        "lane_row": place.nearest,
        "several_lanes": place.several_lanes,
        "oncoming": place.oncoming,
        "lane_direction": nuplan_steps.find_lane_direction(ego.position[step], yaw, record.lanes),
        "route_arc": nuplan_steps.compute_route_arc(position, paths),
        "track_arc": track_arc,
        "track_distance": track_distance,
    }


def _measure_safety(record: EpisodeRecord, step: Int[Array, ""], surrogates: StepMetricsConfig | None) -> dict[str, Array]:
    """Times to collision of V-Max and between circles, and DRAC."""
    ego, others = record.ego, record.others
    valid = others.valid[:, step]
    car = (ego.position[step, :2][None], ego.yaw[step][None], ego.velocity[step][None], record.size[None])
    users = (others.position[:, step], others.yaw[:, step], others.velocity[:, step], others.size)
    ttc = compute_time_to_overlap(*car, *users, valid[None], horizon_s=TTC_HORIZON_S)[0]
    if surrogates is None:
        return {"ttc_s": ttc, "circles_ttc_s": jnp.full((), jnp.inf), "drac": jnp.full((), jnp.nan)}
    position, yaw, velocity, size = (jnp.concatenate(pair) for pair in zip(car, users, strict=True))
    centres, radius = cover_with_circles(position, yaw, size, **vars(surrogates.circles))
    pairs = compare_pairs(centres, radius, velocity, yaw[:1], drac_gap_floor_m=surrogates.drac_gap_floor_m)
    present = jnp.concatenate([jnp.ones(1, bool), valid])
    drac = jnp.max(jnp.where(present, pairs.drac[0], 0.0))
    return {"ttc_s": ttc, "circles_ttc_s": minimum_over_pairs(pairs.ttc, present)[0], "drac": drac}


def _judge_contacts(
    record: EpisodeRecord,
    step: Int[Array, ""],
    contacts: vmax_steps.Contacts,
    road: dict[str, Array],
    collided: Bool[Array, " O"],
    fresh: Bool[Array, " O"],
) -> dict[str, Array]:
    """At-fault contacts of V-Max and nuPlan, and nuPlan's time to collision.

    Args:
        road: results of `_measure_road`.
        collided: road users with which the car has collided; `fresh`: for the first time now.
    """
    ego, others, lanes = record.ego, record.others, record.lanes
    speed, other_speed = safe_norm(ego.velocity[step]), safe_norm(others.velocity[:, step])
    vmax = vmax_steps.find_at_fault(contacts, speed, other_speed, others.kind, road["several_lanes"])
    beside = road["several_lanes"] | road["off_road"]
    fault = fresh & nuplan_steps.find_at_fault(contacts, speed, other_speed, beside)
    row = road["lane_row"]
    all_around = beside | (lanes.in_intersection[row] & lanes.valid[row])
    car = (ego.position[step, :2], ego.yaw[step], ego.velocity[step], record.size)
    users = (others.position[:, step], others.yaw[:, step], others.velocity[:, step], others.size)
    ttc = nuplan_steps.compute_time_to_collision(*car, *users, others.valid[:, step] & ~collided, all_around)
    return {"at_fault": jnp.sum(vmax), "nuplan_at_fault": fault, "nuplan_ttc_s": jnp.where(jnp.any(fault), 0.0, ttc)}
