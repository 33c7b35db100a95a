"""Observation vectors of the car's own state and road condition."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm, to_frame
from scenefactory_jax.core.schema import ConfigError, NonNegative, Positive
from scenefactory_jax.core.types import SURFACES, Scene, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation
from scenefactory_jax.roadgraph.elevation import find_ground
from scenefactory_jax.weather.patches import read_condition


@bound_observation(ANY, ANY, SIGNED, SIGNED, LENGTH, ANY, ANY)
def ego(
    scene: Scene, state: State, *, distance_scale_m: Positive, speed_scale_mps: Positive, goal_ends: bool = True
) -> Float[Array, "A 7"]:
    """Goal x, y in the car's frame; sine and cosine of its bearing; its distance; the car's velocity x, y (paper, section 4).

    Args:
        goal_ends: as of `route`; the goal of an agent without a route stays.
    """
    motion, goal = state.motion, state.agents.goal
    if not goal_ends and scene.routes.length.shape[0]:
        end, _ = route_following.find_point(scene, state.agents.route, scene.routes.length[state.agents.route])
        goal = jnp.where(route_following.find_routed(scene, state.agents)[:, None], end, goal)
    goal = to_frame(goal - motion.position[:, :2], motion.yaw)
    distance = safe_norm(goal)
    bearing = goal / jnp.maximum(distance, 1e-6)[:, None]
    velocity = to_frame(motion.velocity[:, :2], motion.yaw)
    parts = [goal / distance_scale_m, bearing[:, 1:], bearing[:, :1], distance[:, None] / distance_scale_m, velocity / speed_scale_mps]
    return jnp.concatenate(parts, axis=1)


@bound_observation(SIGNED)
def previous_action(scene: Scene, state: State) -> Float[Array, "A 3"]:
    """Throttle, steer and brake of the last action, from which `actions.rates` move."""
    return state.previous_action


@bound_observation(LENGTH)
def own_size(scene: Scene, state: State, *, length_scale_m: Positive, width_scale_m: Positive) -> Float[Array, "A 2"]:
    """Length and width of the car's outline, over their scales: where cars differ (`scenes.pack.car_size_m=null`), so do gaps they fit."""
    return state.agents.size / jnp.array([length_scale_m, width_scale_m])


@bound_observation(LENGTH, FRACTION)
def weather(scene: Scene, state: State, *, film_scale_mm: Positive, surfaces: list[str]) -> Float[Array, "A F"]:
    """Water film and one-hot surface at each car, [film, AC, SMA, OGFC] in Eq. 2 of the paper.

    Args:
        film_scale_mm: the film that reads 1.
        surfaces: columns of the one-hot; another surface reads zeros.

    Raises:
        ConfigError: an unknown surface, by name.
    """
    if unknown := [name for name in surfaces if name not in SURFACES]:
        raise ConfigError(f"observations.weather.surfaces: expected names of {', '.join(SURFACES)}, got {unknown[0]!r}")
    film_mm, surface = read_condition(state.weather, state.motion.position[:, :2])
    columns = jnp.array([SURFACES.index(name) for name in surfaces], jnp.int32)
    one_hot = (surface[:, None] == columns).astype(jnp.float32)
    return jnp.concatenate([film_mm[:, None] / film_scale_mm, one_hot], axis=1)


@bound_observation(LENGTH)
def friction_ahead(
    scene: Scene, state: State, *, ahead_m: list[NonNegative], friction: Callable[..., Float[Array, "*shape"]]
) -> Float[Array, "A F"]:
    """Friction coefficient at each car and ahead of it: what sensors of the road's condition, or messages of cars ahead, would tell.

    Columns: mu under the car's centre, then at each of `ahead_m` along the agent's own route, measured from its place on it; behind the
    route's end the end is repeated. Straight ahead of the car for an agent without a route.

    Args:
        friction: `weather.friction` of the config, bound; the environment supplies it.
    """
    points, _ = _find_points_ahead(scene, state, ahead_m)
    speed = jnp.broadcast_to(safe_norm(state.motion.velocity[:, :2])[:, None], points.shape[:2])
    return friction(state.weather, points, speed)


def grade_ahead(scene: Scene, state: State, *, ahead_m: list[NonNegative], grade_scale: Positive) -> Float[Array, "A F"]:
    """Rise over run of the road along the agent's way: under the car's centre, then at each of `ahead_m`, as in `friction_ahead`.

    The last column is the bank: the rise to the left of the car. All are zero on a flat road.

    Args:
        grade_scale: the grade that reads 1.
    """
    points, direction = _find_points_ahead(scene, state, ahead_m)
    if scene.elevation is None:
        return jnp.zeros((len(points), points.shape[1] + 1), jnp.float32)
    yaw = state.motion.yaw
    slope = find_ground(scene.elevation, points, jnp.broadcast_to(state.motion.position[:, 2:], points.shape[:2])).slope
    heading = heading_vector(yaw)[:, None]
    if direction is not None:
        direction = jnp.where(route_following.find_routed(scene, state.agents)[:, None, None], direction, heading)
    ahead = dot(slope[:, 1:], heading if direction is None else direction)
    here = [dot(slope[:, 0], heading_vector(yaw + turn))[:, None] for turn in (0.0, 0.5 * jnp.pi)]
    return jnp.concatenate([here[0], ahead, here[1]], axis=1) / grade_scale


def _find_points_ahead(
    scene: Scene, state: State, ahead_m: list[NonNegative]
) -> tuple[Float[Array, "A M 2"], Float[Array, "A N 2"] | None]:
    """Computes the places under each car and ahead of it, and the directions of its route there; None without routes."""
    agents, motion, direction = state.agents, state.motion, None
    here, ahead = motion.position[:, None, :2], jnp.array(ahead_m, jnp.float32)
    points = here + ahead[:, None] * heading_vector(motion.yaw)[:, None]
    if scene.routes.length.shape[0]:
        row = jnp.broadcast_to(agents.route[:, None], points.shape[:2])
        along, direction = route_following.find_point(scene, row, state.route.arc[:, None] + ahead)
        points = jnp.where(route_following.find_routed(scene, agents)[:, None, None], along, points)
    return jnp.concatenate([here, points], axis=1), direction


def yaw_rate_and_steer(scene: Scene, state: State, *, turn_scale_radps: Positive, steer_scale_rad: Positive) -> Float[Array, "A 2"]:
    """Yaw rate, and the mean angle of the front wheels."""
    return jnp.stack([state.motion.yaw_rate / turn_scale_radps, state.motion.steer / steer_scale_rad], axis=1)
