"""The agent's route ahead as a vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import cross, dot, heading_vector, safe_norm, to_frame
from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import ROUTE_SPACING_M, Scene, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.bend_speed import find_bend_speed
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation, compress_length

POINT = (ANY, ANY, SIGNED, SIGNED, LENGTH)  # bounds of the columns of a point
HEAD = 5  # columns before the first point


@bound_observation(FRACTION, SIGNED, SIGNED, SIGNED, SIGNED, ANY)
def route(
    scene: Scene,
    state: State,
    *,
    ahead_m: list[float],
    distance_scale_m: Positive,
    offset_scale_m: Positive,
    remaining_scale_m: Positive,
    speed_scale_mps: Positive,
    goal_ends: bool = True,
) -> Float[Array, "A F"]:
    """Points ahead on the agent's own route, in their order: what the network's vector encoder reads without sorting rows of a set.

    Columns: 1 for an agent with a route; offset to the route's left and distance to the goal along the route, as l / (scale + |l|); sine
    and cosine of the car's heading relative to the route; then for each of `ahead_m`, measured from the car's place on the route: x, y in
    the car's frame over `distance_scale_m`, cosine and sine of the route's direction relative to the car, and the speed limit over
    `speed_scale_mps`, 0 where none is known. Behind the goal the goal is repeated. Zeros for an agent without a route.

    Args:
        goal_ends: given by the environment. False: episodes go on behind the goal, and the end of the route takes its place.
    """
    agents, motion = state.agents, state.motion
    if scene.routes.length.shape[0] == 0:
        return jnp.zeros((len(state.active), HEAD + len(POINT) * len(ahead_m)), jnp.float32)
    arc = state.route.arc[:, None] + jnp.array([0.0, *ahead_m])
    end = agents.route_end if goal_ends else scene.routes.length[agents.route]
    arc = jnp.minimum(arc, end[:, None])
    row = jnp.broadcast_to(agents.route[:, None], arc.shape)
    points, direction = route_following.find_point(scene, row, arc)
    facing = heading_vector(motion.yaw)
    here, along = motion.position[:, :2] - points[:, 0], direction[:, 0]
    offset, remaining = cross(along, here), end - state.route.arc
    head = [
        jnp.ones_like(offset),
        compress_length(offset, offset_scale_m),
        compress_length(remaining, remaining_scale_m),
        cross(along, facing),
        dot(along, facing),
    ]
    place = jnp.clip(jnp.ceil(arc[:, 1:] / ROUTE_SPACING_M).astype(jnp.int32), 0, scene.routes.speed_limit.shape[1] - 1)
    limit = scene.routes.speed_limit[row[:, 1:], place]
    limit = jnp.where(jnp.isfinite(limit), limit, 0.0) / speed_scale_mps
    yaw = motion.yaw[:, None]
    ahead = to_frame(points[:, 1:] - motion.position[:, None, :2], yaw) / distance_scale_m
    columns = jnp.concatenate([ahead, to_frame(direction[:, 1:], yaw), limit[..., None]], axis=-1)
    features = jnp.concatenate([jnp.stack(head, axis=1), columns.reshape(len(offset), -1)], axis=1)
    return jnp.where(route_following.find_routed(scene, agents)[:, None], features, 0.0)


@bound_observation(FRACTION, SIGNED)
def bend_speed(
    scene: Scene,
    state: State,
    *,
    speed_scale_mps: Positive,
    look_ahead_m: Positive,
    chord_m: Count,
    lateral_mps2: Positive,
    braking_mps2: Positive,
) -> Float[Array, "A 2"]:
    """The speed v with which the car can keep to the bends of its route ahead (`find_bend_speed`, which has the other arguments).

    Columns: v / (scale + v), 1 without a route; by how much the car is faster than v, over `speed_scale_mps`, clamped to 1.
    """
    numbers = {"look_ahead_m": look_ahead_m, "chord_m": chord_m, "lateral_mps2": lateral_mps2, "braking_mps2": braking_mps2}
    slowest = find_bend_speed(scene, state, **numbers)
    excess = (safe_norm(state.motion.velocity[:, :2]) - slowest) / speed_scale_mps
    return jnp.stack([compress_length(slowest, speed_scale_mps), jnp.clip(excess, -1.0, 1.0)], axis=1)
