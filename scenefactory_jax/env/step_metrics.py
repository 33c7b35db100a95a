"""Step metrics: quantities computed once per control step.

Rewards, termination, evaluations and reports only read them, so that training and evaluation cannot disagree on what a collision is. XLA
removes the metrics that nothing reads.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cover_with_circles, cross, dot, heading_vector, safe_norm
from scenefactory_jax.core.pytree import is_finite
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Agents, Events, Motion, Scene, State, StepMetrics
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.env import route_following, spawning, surrogate_safety
from scenefactory_jax.env.route_following import RouteConfig
from scenefactory_jax.roadgraph import elevation, queries


@dataclasses.dataclass(frozen=True)
class Circles:
    """The three circles that stand for a car, see `geometry.cover_with_circles`."""

    radius_fraction: NonNegative
    radius_floor_m: NonNegative
    spacing_limit_m: NonNegative


@dataclasses.dataclass(frozen=True)
class StepMetricsConfig:
    """The config group `step_metrics`."""

    circles: Circles
    goal_radius_m: NonNegative
    collision_force_n: NonNegative
    collision_grace_steps: int  # control steps after a start in which a contact is no collision
    edge_radius_m: NonNegative  # clearance to a road edge is the distance from the circles' centres less this
    edge_half_width_m: NonNegative
    edge_range_m: Positive
    upright_min: float
    height_min_m: float
    scene_size_m: Positive
    max_start_distance_m: Positive
    max_start_distance_ratio: Positive  # times the route's length
    off_lane_lateral_m: Positive
    off_lane_distance_m: Positive
    idle_speed_mps: NonNegative
    drac_gap_floor_m: Positive
    route: RouteConfig
    kernels: bool  # Triton kernels for the road on NVIDIA GPUs; False: plain JAX


def compute(scene: Scene, before: State, after: State, *, config: StepMetricsConfig, control_dt: float) -> StepMetrics:
    """Computes the metrics of the step from `before` to `after`; rows of agents that were not active before mean nothing.

    Definitions follow the paper (arXiv:2605.08528, section 4): planar goal distance; nearest lane midpoint of the whole world, its tangent
    turned towards the goal; TTC and DRAC with active cars and with boxes; contact of the bounding circles with road edges.
    """
    motion, active, cars = after.motion, before.active, len(before.active)
    broken = ~(is_finite(motion) & spawning.find_usable(after.agents))
    position, velocity = motion.position[:, :2], motion.velocity[:, :2]
    users = surrogate_safety.collect_road_users(motion, after.agents.size, active & ~broken, scene.traffic)
    centres, radius = cover_with_circles(users.position, users.yaw, users.size, **vars(config.circles))
    pairs = surrogate_safety.compare_pairs(centres, radius, users.velocity, motion.yaw, drac_gap_floor_m=config.drac_gap_floor_m)
    pairs = surrogate_safety.separate_levels(pairs, scene, motion)
    speed, to_goal = safe_norm(velocity), after.agents.goal - position
    leveled = elevation.select_level(scene, motion)
    kernels = config.kernels and scene.edges.height is None  # they know one level
    edges = {"half_width_m": config.edge_half_width_m, "range_m": config.edge_range_m, "kernels": kernels}
    road = queries.query_road(leveled, centres[:cars], radius[:cars], velocity, motion.yaw, position, active, **edges)
    lane, edge_clearance = _compute_lane_metrics(scene, before, road.lane, motion, to_goal), road.edge - config.edge_radius_m
    beside_lane = {"lane_heading": lane["lane_heading"], "lane_offset": lane["lane_offset"]}
    route = route_following.compute_metrics(scene, before, after, speed=speed, **beside_lane, config=config.route, control_dt=control_dt)
    start_distance = safe_norm(position - after.agents.position)
    events = Events(
        numerical_error=broken,
        goal_reached=(safe_norm(to_goal) <= config.goal_radius_m) & _is_route_driven(after, config.goal_radius_m),
        collision=(motion.contact_force >= config.collision_force_n) & (after.steps_since_spawn >= config.collision_grace_steps),
        out_of_bounds=_is_out_of_bounds(scene, motion, after.agents, start_distance, config),
        road_edge_contact=edge_clearance <= 0,
        red_light=route.red_light,
        stop_sign=route.stop_sign,
        off_route=route.off_route,
    )
    stopping_distance = speed**2 / (2 * GRAVITY * jnp.maximum(motion.mu, 1e-3))
    return StepMetrics(
        speed=speed,
        goal_distance=safe_norm(to_goal),
        **lane,
        ttc=surrogate_safety.minimum_over_pairs(pairs.ttc, users.present),
        clearance=surrogate_safety.minimum_over_pairs(pairs.clearance, users.present),
        stopping_margin=surrogate_safety.minimum_over_pairs(pairs.ahead, users.present) - stopping_distance,
        edge_ttc=road.edge_ttc,
        edge_clearance=edge_clearance,
        drac=jnp.max(jnp.where(users.present[None], pairs.drac, 0.0), axis=1),
        distance_from_start=start_distance,
        **{name: getattr(motion, name) for name in ("contact_force", "mu", "friction_utilization", "slip")},
        off_lane=lane["has_lane"]
        & ((lane["lane_offset"] > config.off_lane_lateral_m) | (lane["lane_distance"] > config.off_lane_distance_m)),
        idle=speed < config.idle_speed_mps,
        **route.values,
        events=events,
    )


def _is_route_driven(after: State, goal_radius_m: float) -> Bool[Array, " A"]:
    """Whether an agent's way along its route is at its goal, which a route that crosses itself passes earlier; true without a route."""
    agents = after.agents
    return (agents.route_end <= agents.route_start) | (after.route.arc >= agents.route_end - 2 * goal_radius_m)


def _is_out_of_bounds(
    scene: Scene, motion: Motion, agents: Agents, start_distance: Float[Array, " A"], config: StepMetricsConfig
) -> Bool[Array, " A"]:
    """Whether a car tipped over or fell, is outside the scene, or is further from its start than any way to its goal requires."""
    fell = (motion.upright < config.upright_min) | (elevation.measure_heights(scene, motion) < config.height_min_m)
    outside = jnp.max(jnp.abs(motion.position[:, :2]), axis=1) > 0.5 * config.scene_size_m
    farthest = jnp.maximum(config.max_start_distance_m, config.max_start_distance_ratio * agents.route_length)
    return fell | outside | (start_distance > farthest)


def _compute_lane_metrics(
    scene: Scene, before: State, row: Int[Array, " A"], motion: Motion, to_goal: Float[Array, "A 2"]
) -> dict[str, Array]:
    """Computes the metrics relative to a row of the lanes; zeros in a world without lanes."""
    any_lane, position = jnp.any(scene.lanes.valid), motion.position[:, :2]
    direction, midpoint = scene.lanes.direction[row], scene.lanes.midpoint[row]
    tangent = jnp.where((dot(to_goal, direction) < 0)[:, None], -direction, direction)
    offset = position - midpoint
    moved = position - before.motion.position[:, :2]
    zero = jnp.zeros(len(row), jnp.float32)
    return {
        "progress": jnp.where(any_lane, dot(moved, tangent), zero),
        "lane_offset": jnp.where(any_lane, jnp.abs(cross(tangent, offset)), zero),
        "lane_distance": jnp.where(any_lane, safe_norm(offset), zero),
        "lane_alignment": jnp.where(any_lane, dot(heading_vector(motion.yaw), tangent), zero),
        "lane_heading": jnp.where(any_lane, dot(heading_vector(motion.yaw), direction), zero),
        "has_lane": jnp.broadcast_to(any_lane, row.shape),
    }
