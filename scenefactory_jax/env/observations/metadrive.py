"""The observation of MetaDrive's ScenarioEnv (ScenarioNet, arXiv:2306.12241) as one vector in [0, 1]."""

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import cross, dot, heading_vector, safe_norm, to_frame, wrap_angle
from scenefactory_jax.core.ray_casting import cast_to_boxes, cast_to_segments, make_ray_directions
from scenefactory_jax.core.schema import Bounds, Count, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env import route_following, surrogate_safety
from scenefactory_jax.env.observations.column_bounds import FRACTION, bound_observation
from scenefactory_jax.env.observations.near_segments import gather_nearest

NAVIGATION_POINTS, POINT_GAP, NAVIGATION_RANGE_M = 10, 2, 30.0  # points 2 m apart; longer vectors are shortened


@bound_observation(FRACTION)
def metadrive(
    scene: Scene,
    state: State,
    *,
    lidar_rays: Count,
    lidar_edges: bool,
    side_rays: Annotated[int, Bounds(min=0)],
    range_m: Positive,
    edge_segments: Count,
    max_speed_mps: Positive,
    max_steer_rad: Positive,
    max_yaw_rate_radps: Positive,
    max_lateral_m: Positive,
    lane_width_m: Positive,
    as_published: bool,
) -> Float[Array, "A F"]:
    """MetaDrive's vector of ScenarioEnv: 161 numbers with 12 side rays and 120 of the lidar, 151 without side rays.

    Columns: angle to the route, speed, steering angle, last steering, last throttle (less the brake), yaw rate. Distances to the road
    edges, one for each side ray or, without side rays, to the left and right. Offset from the route in lanes. 10 points of the route every
    2 m in the car's frame, offset and angle again. The lidar's rays.
    A ray reads its free length over `range_m`. Rays begin ahead and turn to the left. They end at other cars, at boxes and, with
    `lidar_edges`, at road edges.

    Args:
        edge_segments: of road edges, the nearest ones, that rays can meet; in whole chunks of `nearest_rows`.
        max_lateral_m: offset from the route that reads 0 or 1.
        lane_width_m: twice the offset that reads 0 or 1 in the lane column.
        as_published: MetaDrive's code leaves the last point of the route zero.
    """
    motion, position = state.motion, state.motion.position[:, :2]
    lateral, turned, points = _locate_route(scene, state)
    points = points.at[:, -1].set(0.0) if as_published else points
    speed = safe_norm(motion.velocity[:, :2]) / max_speed_mps
    throttle, steer, brake = state.previous_action.T
    ego = [_centre(turned / jnp.pi), speed, _centre(motion.steer / max_steer_rad), _centre(steer), _centre(throttle - brake)]
    ego += [jnp.abs(motion.yaw_rate) / max_yaw_rate_radps]
    edges = gather_nearest(scene.edges, position, motion.yaw, count=edge_segments, range_m=range_m)[:4]  # of all levels
    side_directions = make_ray_directions(side_rays) if side_rays else jnp.array([[0.0, 1.0], [0.0, -1.0]])
    sides = cast_to_segments(side_directions, *edges, range_m=range_m) / range_m
    lane = [_centre(2 * lateral / lane_width_m)]
    ends = [_centre(lateral / max_lateral_m), _centre(turned / jnp.pi)]
    rays = make_ray_directions(lidar_rays)
    lidar = cast_to_boxes(rays, *_gather_boxes(scene, state), range_m=range_m)
    if lidar_edges:
        lidar = jnp.minimum(lidar, cast_to_segments(rays, *edges, range_m=range_m))
    stack = lambda columns: jnp.stack(columns, axis=1)  # noqa: E731
    navigation = [points.reshape(len(speed), -1), stack(ends)]
    return jnp.clip(jnp.concatenate([stack(ego), sides, stack(lane), *navigation, lidar / range_m], axis=1), 0.0, 1.0)


def _centre(value: Float[Array, " A"]) -> Float[Array, " A"]:
    """Maps [-1, 1] to [0, 1]."""
    return 0.5 * (value + 1.0)


def _locate_route(scene: Scene, state: State) -> tuple[Float[Array, " A"], Float[Array, " A"], Float[Array, "A 10 2"]]:
    """Offset to the left of the route (m), angle between car and route (rad), and the points ahead, mapped to [0, 1]; of a car without
    a route 0, 0 and points at the car."""
    motion, agents, position = state.motion, state.agents, state.motion.position[:, :2]
    cars = len(motion.yaw)
    if scene.routes.length.shape[0] == 0:
        return jnp.zeros(cars), jnp.zeros(cars), jnp.full((cars, NAVIGATION_POINTS, 2), 0.5)
    routed, arc = route_following.find_routed(scene, agents), state.route.arc
    place = route_following.locate(scene, agents.route, arc, position)
    index = jnp.floor(place.arc).astype(jnp.int32)[:, None] + POINT_GAP * jnp.arange(1, NAVIGATION_POINTS + 1)
    points = scene.routes.position[agents.route[:, None], jnp.minimum(index, scene.routes.position.shape[1] - 1)]
    nearest = scene.routes.position[agents.route, jnp.minimum(index[:, 0] - POINT_GAP, scene.routes.position.shape[1] - 1)]
    side = jnp.sign(cross(place.direction, position - nearest))
    facing = heading_vector(motion.yaw)
    turned = jnp.arctan2(cross(place.direction, facing), jnp.where(routed, dot(place.direction, facing), 1.0))
    local = to_frame(points - position[:, None], motion.yaw[:, None])
    distance = safe_norm(local)[..., None]
    local = local * jnp.minimum(1.0, NAVIGATION_RANGE_M / jnp.maximum(distance, 1e-3)) / NAVIGATION_RANGE_M
    zero = jnp.zeros(cars)
    points = jnp.where(routed[:, None, None], 0.5 * (local + 1.0), 0.5)
    return jnp.where(routed, side * place.distance, zero), jnp.where(routed, wrap_angle(turned), zero), points


def _gather_boxes(
    scene: Scene, state: State
) -> tuple[Float[Array, "A B 2"], Float[Array, "A B"], Float[Array, "A B 2"], Bool[Array, "A B"]]:
    """Other active cars and boxes in the frame of each car."""
    motion = state.motion
    users = surrogate_safety.collect_road_users(motion, state.agents.size, state.active, scene.traffic)
    cars, count = len(motion.yaw), len(users.present)
    place = to_frame(users.position - motion.position[:, None, :2], motion.yaw[:, None])
    present = users.present & ~jnp.eye(cars, count, dtype=bool)
    return place, users.yaw - motion.yaw[:, None], jnp.broadcast_to(users.size, place.shape), present
