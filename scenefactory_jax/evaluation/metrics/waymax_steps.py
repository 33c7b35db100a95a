"""Step metrics of Waymax and V-Max as functions of arrays, for one car at one step: `jax.vmap` adds cars and steps.

Definitions are those of the published code (Waymax, arXiv:2310.08710; V-Max, arXiv:2503.08388) where it differs from the papers, so that
golden values of it can be met. A path is a row of points about a metre apart, each with its arc length and lane.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import compute_corners
from scenefactory_jax.core.geometry import heading_vector, safe_norm
from scenefactory_jax.dynamics.bicycle_waymax import compute_inverse_action
from scenefactory_jax.roadgraph import traffic_lights
from scenefactory_jax.roadgraph.signed_edge_distance import EdgePoints, compute_signed_distance

HEIGHT_SCALE = 2.0  # of the search for the nearest road-edge point
ACCELERATION_LIMIT, CURVATURE_LIMIT, TOLERANCE = 10.4, 0.3, 0.001  # m/s^2, 1/m: kinematically feasible
WAYMAX_OFF_ROUTE = (5.0, 2.0)  # m: from the on-route paths; by which other paths are nearer
HALF_LANE_M = 3.7 / 2  # half the usual width of a lane
OFF_LANE_M = HALF_LANE_M + 0.2  # from a lane's line a point is off that lane
VMAX_OFF_ROUTE = (OFF_LANE_M, OFF_LANE_M / 2 + 0.2)
WRONG_WAY_M = 3.5


class Paths(NamedTuple):
    """Paths of a car."""

    position: Float[Array, "R N 2"]
    valid: Bool[Array, "R N"]
    arc: Float[Array, "R N"]  # arc length, m
    lane: Int[Array, "R N"]
    on_route: Bool[Array, " R"]


def compute_edge_distances(
    position: Float[Array, "d"], yaw: Float[Array, ""], size: Float[Array, "2"], edges: EdgePoints
) -> Float[Array, "4"]:
    """Computes the signed distances of the four corners to the nearest road-edge points; off-road: any of them is above 0."""
    return compute_signed_distance(place_corners(position, yaw, size), edges, height_scale=HEIGHT_SCALE)


def place_corners(position: Float[Array, "d"], yaw: Float[Array, ""], size: Float[Array, "2"]) -> Float[Array, "4 d"]:
    """Computes the corners of a car; with d = 3 all of them have the height of `position`."""
    corners = compute_corners(position[:2], yaw, size)
    return jnp.concatenate([corners, jnp.full((4, 1), position[2])], axis=1) if position.shape[0] == 3 else corners


def measure_path_distances(position: Float[Array, "2"], paths: Paths) -> Float[Array, "R N"]:
    """Computes the distances to all valid points of paths; inf elsewhere."""
    return jnp.where(paths.valid, safe_norm(paths.position - position), jnp.inf)


def compute_progression(position: Float[Array, "2"], first: Float[Array, "2"], last: Float[Array, "2"], paths: Paths) -> Float[Array, ""]:
    """Computes the progression on the on-route path that is nearest to the car: arc length from the log's first position, over that of its
    last one. It moves in steps of a point, and exceeds 1 behind the log's end; 1 if both ends have one nearest point."""
    nearest = jnp.min(jnp.where(paths.on_route[:, None], measure_path_distances(position, paths), jnp.inf), axis=1)
    row = jnp.argmin(nearest)

    def read_arc(point: Float[Array, "2"]) -> Float[Array, ""]:
        distance = jnp.where(paths.valid[row], safe_norm(paths.position[row] - point), jnp.inf)
        return paths.arc[row, jnp.argmin(distance)]

    start, end = read_arc(first), read_arc(last)
    same = start == end
    return jnp.where(same, 1.0, (read_arc(position) - start) / jnp.where(same, 1.0, end - start))


def compute_off_route(position: Float[Array, "2"], paths: Paths, *, limits: tuple[float, float]) -> Float[Array, ""]:
    """Computes the distance to the on-route paths where the car is off its route, else 0.

    Args:
        limits: off route is farther than the first, or farther than from another path by more than the second (m).
    """
    distance = jnp.min(measure_path_distances(position, paths), axis=1)
    on = jnp.min(jnp.where(paths.on_route, distance, jnp.inf))
    off = jnp.min(jnp.where(paths.on_route, jnp.inf, distance))
    return jnp.where((on > limits[0]) | (on - off > limits[1]), on, 0.0)


def compute_wrong_way(position: Float[Array, "2"], paths: Paths) -> Float[Array, ""]:
    """Computes the distance to the nearest path where it exceeds WRONG_WAY_M, else 0."""
    distance = jnp.min(measure_path_distances(position, paths))
    return jnp.where(distance > WRONG_WAY_M, distance, 0.0)


def find_front_lane(position: Float[Array, "2"], yaw: Float[Array, ""], size: Float[Array, "2"], paths: Paths) -> Int[Array, ""]:
    """Finds the lane of the point nearest to the middle of the car's front, on the longest on-route path."""
    row = jnp.argmax(jnp.sum(paths.valid, axis=1) * paths.on_route)
    front = position + 0.5 * size[0] * heading_vector(yaw)
    return paths.lane[row, jnp.argmin(measure_path_distances(front, paths)[row])]


def find_red_light_run(
    lane_before: Int[Array, ""], lane: Int[Array, ""], light_lane: Int[Array, " C"], state: Int[Array, " C"]
) -> Bool[Array, ""]:
    """Finds whether the car's front came onto a lane with a red light in this step (lanes of `find_front_lane`).

    Args:
        light_lane, state: lane and state, an index into LIGHT_STATES, of each light now.
    """
    red = traffic_lights.find_red(state)
    return (lane != lane_before) & jnp.any(red & (light_lane == lane))


def find_infeasible_motion(
    yaw: Float[Array, ""], velocity: Float[Array, "2"], next_yaw: Float[Array, ""], next_velocity: Float[Array, "2"], *, dt: float
) -> Bool[Array, ""]:
    """Finds whether a step needs an acceleration or a curvature that no car has."""
    acceleration, curvature = compute_inverse_action(yaw, velocity, next_yaw, next_velocity, dt=dt)
    return (jnp.abs(acceleration) > ACCELERATION_LIMIT + TOLERANCE) | (jnp.abs(curvature) > CURVATURE_LIMIT + TOLERANCE)
