"""Reward terms of V-Max (arXiv:2503.08388): indicators of the state after a step. `env.rewards` has those of the paper."""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.boxes import compute_corners, find_overlaps
from scenefactory_jax.core.schema import Bounds, NonNegative, Positive
from scenefactory_jax.core.types import ROUTE_SPACING_M, RewardInput
from scenefactory_jax.env import planning_metrics, surrogate_safety
from scenefactory_jax.env.history import SPACING_S, need_history
from scenefactory_jax.roadgraph.signed_edge_distance import append_height, compute_signed_distance, list_edge_points


def find_contacts(step: RewardInput) -> Bool[Array, "A B"]:
    """Pairs of cars and road users, agents first, whose rectangles overlap after the step."""
    motion, size, active = step.after.motion, step.after.agents.size, step.before.active
    users = surrogate_safety.collect_road_users(motion, size, active, step.scene.traffic)
    cars = len(active)
    own = (users.position[:cars, None], users.yaw[:cars, None], users.size[:cars, None])
    overlaps = find_overlaps(*own, users.position, users.yaw, users.size)
    apart = surrogate_safety.find_other_levels(step.scene, step.after.motion)
    present = users.present if apart is None else users.present & ~apart
    return overlaps & present & ~jnp.eye(cars, len(users.present), dtype=bool)


def overlap(step: RewardInput) -> Float[Array, " A"]:
    """1 while the car's rectangle overlaps another car's or a traffic box."""
    return jnp.any(find_contacts(step), axis=1).astype(jnp.float32)


def off_road(step: RewardInput) -> Float[Array, " A"]:
    """1 while a corner of the car is outside of the nearest road edge's point (Waymax)."""
    corners = compute_corners(step.after.motion.position[:, :2], step.after.motion.yaw, step.after.agents.size)
    if step.scene.edges.height is not None:
        height = jnp.broadcast_to(step.after.motion.position[:, None, 2], corners.shape[:2])
        corners = append_height(corners, height)
    distance = compute_signed_distance(corners, list_edge_points(step.scene.edges))
    return jnp.any(distance > 0, axis=1).astype(jnp.float32)


def red_light(step: RewardInput) -> Float[Array, " A"]:
    """1 in every step in which the car's front passes a stop line with a red light on its route.

    V-Max looks for a change to a lane with a red light; a stop line is where such a lane begins.
    """
    return step.metrics.events.red_light.astype(jnp.float32)


def off_route(step: RewardInput, *, distance_m: Positive, margin_m: NonNegative) -> Float[Array, " A"]:
    """1 while the car is farther than `distance_m` from its on-route routes, or farther than from its others by more than `margin_m`.

    Agents without an on-route route of their own, as with drawn routes, are measured at the route they drive; without any: 0.
    """
    on, off = planning_metrics.measure_route_distances(step.scene, step.after.motion.position[:, :2])
    own, driven = jnp.isfinite(on), step.metrics.route_distance
    beside = own & ((on > distance_m) | (jnp.where(jnp.isfinite(off), on - off, -jnp.inf) > margin_m))
    return (beside | (~own & step.metrics.has_route & (driven > distance_m))).astype(jnp.float32)


def progressed(step: RewardInput) -> Float[Array, " A"]:
    """1 in a step in which the point of the route that is nearest to the car is farther along it than before.

    The points are ROUTE_SPACING_M apart, so that a slow car progresses in some steps only, as in V-Max.
    """
    now, before = step.metrics.route_arc, step.metrics.route_arc - step.metrics.route_progress
    further = jnp.round(now / ROUTE_SPACING_M) > jnp.round(before / ROUTE_SPACING_M)
    return (step.metrics.has_route & further).astype(jnp.float32)


def overspeed(step: RewardInput, *, tolerance_mps: NonNegative) -> Float[Array, " A"]:
    """1 while the car is faster than its route's speed limit by more than a tolerance."""
    return (step.metrics.overspeed > tolerance_mps).astype(jnp.float32)


def ttc_below(step: RewardInput, *, limit_s: Positive) -> Float[Array, " A"]:
    """1 while the car overlaps with one ahead within a time, at constant velocities (`planning_metrics.compute_time_to_overlap`)."""
    motion, size, active = step.after.motion, step.after.agents.size, step.before.active
    users = surrogate_safety.collect_road_users(motion, size, active, step.scene.traffic)
    present = users.present & ~jnp.eye(len(active), len(users.present), dtype=bool)
    own = (motion.position[:, :2], motion.yaw, motion.velocity[:, :2], size)
    others = (users.position, users.yaw, users.velocity, users.size)
    time = planning_metrics.compute_time_to_overlap(*own, *others, present, horizon_s=limit_s)
    return (time < limit_s).astype(jnp.float32)


def _measure_last_second(step: RewardInput) -> planning_metrics.ComfortParts:
    """The comfort parts of the agents' last second; where it is not valid, after a start without a log, its oldest valid state repeats."""
    cars, motion, past = len(step.before.active), step.after.motion, step.after.history
    rows = planning_metrics.COMFORT_ROWS - 1
    velocity = jnp.concatenate([motion.velocity[None, :, :2], past.velocity[:rows, :cars]]).swapaxes(0, 1)
    yaw = jnp.concatenate([motion.yaw[None], past.yaw[:rows, :cars]]).T
    valid = jnp.concatenate([jnp.ones((1, cars), bool), past.valid[:rows, :cars]]).T
    age = jnp.minimum(jnp.arange(rows + 1), jnp.sum(jnp.cumprod(valid, axis=1), axis=1)[:, None] - 1)
    velocity = jnp.take_along_axis(velocity, age[..., None], axis=1)[:, ::-1]
    yaw = jnp.take_along_axis(yaw, age, axis=1)[:, ::-1]
    return planning_metrics.compute_comfort_parts(velocity, yaw, dt=SPACING_S)


@need_history(planning_metrics.COMFORT_ROWS - 1)
def comfort(step: RewardInput, *, start_row: Annotated[int, Bounds(min=0)]) -> Float[Array, " A"]:
    """V-Max's continuous comfort over the last second, in (0, 1].

    Args:
        start_row: row of the log at which episodes begin; the rows before it are the past of a start.
    """
    return planning_metrics.compute_comfort(_measure_last_second(step))


@need_history(planning_metrics.COMFORT_ROWS - 1)
def discomfort(step: RewardInput, *, start_row: Annotated[int, Bounds(min=0)]) -> Float[Array, " A"]:
    """1 less `comfort`: with a negative weight a price, where comfort's own value would pay for each step of a longer drive."""
    return 1.0 - comfort(step, start_row=start_row)


@need_history(planning_metrics.COMFORT_ROWS - 1)
def comfort_violations(step: RewardInput, *, start_row: Annotated[int, Bounds(min=0)]) -> Float[Array, " A"]:
    """How many of V-Max's six bounds of comfort the last second leaves.

    `comfort` hardly changes between twice and four times the bound of the jerk, which brakes reach: a price on it teaches little there.
    """
    return jnp.sum(planning_metrics.find_violations(_measure_last_second(step)), axis=-1, dtype=jnp.float32)
