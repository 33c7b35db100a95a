"""measure(scene, before, after) -> Facts: everything true of one step, measured once.

Rewards, ends, metrics and reports only read facts, so training and evaluation cannot disagree on what a collision is. Facts that nobody
reads cost nothing: XLA drops them.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cover_with_circles, cross, dot, heading_vector, safe_norm
from scenefactory_jax.core.pytree import is_finite
from scenefactory_jax.core.types import Agents, Events, Motion, Scene, State, StepMetrics
from scenefactory_jax.env import spawning, surrogate_safety
from scenefactory_jax.roadgraph import queries


def compute(
    scene: Scene,
    before: State,
    after: State,
    *,
    circles: dict[str, float],
    goal_radius_m: float,
    collision_force_n: float,
    collision_grace_steps: int,
    edge_radius_m: float,
    edge_half_width_m: float,
    edge_range_m: float,
    upright_min: float,
    height_min_m: float,
    scene_size_m: float,
    max_start_distance_m: float,
    max_start_distance_ratio: float,
    off_lane_lateral_m: float,
    off_lane_distance_m: float,
    idle_speed_mps: float,
    drac_gap_floor_m: float,
    gravity_mps2: float,
    kernels: bool,
) -> StepMetrics:
    """Facts of the step from `before` to `after`, for the agents that were active in it; rows of the others mean nothing.

    Definitions follow the published task (arXiv:2605.08528, section 4): planar goal distance; nearest lane midpoint of the whole world, its
    tangent turned towards the goal; TTC and DRAC with active cars and with boxes; edges touched by the bounding circles.

    Args:
        kernels: Triton kernels for the road where there is an NVIDIA GPU; False: plain JAX everywhere.
    """
    motion, active, cars, broken = after.motion, before.active, len(before.active), _are_broken(after)
    position, velocity = motion.position[:, :2], motion.velocity[:, :2]
    everyone = surrogate_safety.collect_road_users(
        motion, after.agents.size, active & ~broken, scene.traffic
    )  # a faulty car collides with nothing
    centres, radius = cover_with_circles(everyone.position, everyone.yaw, everyone.size, **circles)
    pairs = surrogate_safety.compare_pairs(centres, radius, everyone.velocity, motion.yaw, drac_gap_floor_m=drac_gap_floor_m)
    speed, to_goal = safe_norm(velocity), after.agents.goal - position
    edges = {"half_width_m": edge_half_width_m, "range_m": edge_range_m, "kernels": kernels}
    beside = queries.query_road(scene, centres[:cars], radius[:cars], velocity, motion.yaw, position, active, **edges)
    lane, edge_clearance = _measure_lane(scene, before, beside.lane, motion, to_goal), beside.edge - edge_radius_m
    distance_from_start = safe_norm(position - after.agents.position)
    limits = {
        "upright_min": upright_min,
        "height_min_m": height_min_m,
        "scene_size_m": scene_size_m,
        "max_start_distance_m": max_start_distance_m,
        "max_start_distance_ratio": max_start_distance_ratio,
    }
    events = Events(
        numerical_error=broken,
        goal_reached=safe_norm(to_goal) <= goal_radius_m,
        collision=(motion.contact_force >= collision_force_n) & (after.steps_since_spawn >= collision_grace_steps),
        out_of_bounds=_has_crashed(motion, after.agents, distance_from_start, **limits),
        road_edge_contact=edge_clearance <= 0,
    )
    return StepMetrics(
        speed=speed,
        goal_distance=safe_norm(to_goal),
        **lane,
        ttc=surrogate_safety.minimum_over_pairs(pairs.ttc, everyone.present),
        clearance=surrogate_safety.minimum_over_pairs(pairs.gap, everyone.present),
        stopping_margin=surrogate_safety.minimum_over_pairs(pairs.ahead, everyone.present) - _stopping(speed, motion.mu, gravity_mps2),
        edge_ttc=beside.edge_ttc,
        edge_clearance=edge_clearance,
        drac=jnp.max(jnp.where(everyone.present[None], pairs.drac, 0.0), axis=1),
        distance_from_start=distance_from_start,
        **{name: getattr(motion, name) for name in ("contact_force", "mu", "friction_utilization", "slip")},
        off_lane=lane["has_lane"] & ((lane["lane_offset"] > off_lane_lateral_m) | (lane["lane_distance"] > off_lane_distance_m)),
        idle=speed < idle_speed_mps,
        events=events,
    )


def _are_broken(state: State) -> Bool[Array, " A"]:
    """Agents with a number in their motion, or in where they start and what they must reach, that nothing can be computed with."""
    return ~(is_finite(state.motion) & spawning.find_usable(state.agents))


def _stopping(speed: Float[Array, " A"], grip: Float[Array, " A"], gravity_mps2: float) -> Float[Array, " A"]:
    """The way to a stop with all of the road's friction: v^2 / (2 mu g)."""
    return speed**2 / (2 * gravity_mps2 * jnp.maximum(grip, 1e-3))


def _has_crashed(
    motion: Motion,
    agents: Agents,
    distance_from_start: Float[Array, " A"],
    *,
    upright_min,
    height_min_m,
    scene_size_m,
    max_start_distance_m,
    max_start_distance_ratio,
) -> Bool[Array, " A"]:
    """Tipped over or fallen, outside the scene, or further from the start than any way to the goal asks for."""
    fell = (motion.upright < upright_min) | (motion.position[:, 2] < height_min_m)
    outside = jnp.max(jnp.abs(motion.position[:, :2]), axis=1) > 0.5 * scene_size_m
    return fell | outside | (distance_from_start > jnp.maximum(max_start_distance_m, max_start_distance_ratio * agents.route_length))


def _measure_lane(scene: Scene, before: State, row: Int[Array, " A"], motion: Motion, to_goal: Float[Array, "A 2"]) -> dict[str, Array]:
    """Facts relative to a row of the lanes; zeros in a world without lanes."""
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
