"""What a planner reads of each agent's surroundings: its own motion, its route, stop lines, road users, road edges and lanes."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, to_frame, wrap_angle
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import ROAD_USERS, Motion, Scene, State
from scenefactory_jax.env import route_following, surrogate_safety
from scenefactory_jax.env.observations.near_segments import NearSegments, gather_nearest
from scenefactory_jax.env.observations.state_vectors import friction_ahead
from scenefactory_jax.roadgraph import elevation, nearest_rows, traffic_lights

SPACING_M = 1.0  # between the points of the centre line


class CentreLine(NamedTuple):
    """The agent's route around its place on it, every SPACING_M; it goes on straight beyond both ends."""

    arc: Float[Array, "*n P"]  # from the agent's place, below zero behind it
    point: Float[Array, "*n P 2"]
    direction: Float[Array, "*n P 2"]  # unit
    limit: Float[Array, "*n P"]  # m/s; 0 where none is known
    known: Bool[Array, "*n"]  # the agent has a route
    remaining: Float[Array, "*n"]  # to the goal along the route
    height: Float[Array, "*n P"] | None = None  # of the road; None: the scene has one level


class StopLinesAhead(NamedTuple):
    """Stop lines on the route as they are now."""

    distance: Float[Array, "*n S"]  # from the agent's front along the route; inf for lines behind it
    red: Bool[Array, "*n S"]
    yellow: Bool[Array, "*n S"]
    stop_sign: Bool[Array, "*n S"]  # before which the agent has not stood yet


class NearUsers(NamedTuple):
    """The nearest road users, agents and traffic alike, nearest first."""

    position: Float[Array, "*n K 2"]
    yaw: Float[Array, "*n K"]
    velocity: Float[Array, "*n K 2"]
    size: Float[Array, "*n K 2"]  # length, width
    kind: Int[Array, "*n K"]  # index into ROAD_USERS
    present: Bool[Array, "*n K"]
    height: Float[Array, "*n K"] | None = None  # None: the scene has one level
    climb: Float[Array, "*n K"] | None = None  # m/s


class PlanningView(NamedTuple):
    """The observation group `planning`: SI units, in the frame of the agent (origin at its box's centre, x ahead, y to the left)."""

    velocity: Float[Array, "*n 2"]
    yaw_rate: Float[Array, "*n"]
    steer: Float[Array, "*n"]  # mean angle of the front wheels, rad
    size: Float[Array, "*n 2"]  # length, width
    line: CentreLine
    stops: StopLinesAhead
    users: NearUsers
    edges: NearSegments
    lanes: NearSegments
    mu: Float[Array, "*n"]  # smallest friction coefficient here and ahead on the route; inf where it is not observed
    grade: Float[Array, "*n"] | None = None  # rise over run under the agent along its heading; None: the road is flat


def planning(
    scene: Scene,
    state: State,
    *,
    behind_m: NonNegative,
    ahead_m: Positive,
    users: Count,
    edges: Count,
    lanes: Count,
    range_m: Positive,
    control_dt: float,
    friction_ahead_m: list[NonNegative] | None = None,
    friction: Callable[..., Float[Array, "*shape"]] | None = None,
) -> PlanningView:
    """Observes everything that planners read; networks and adapters take no such group.

    Args:
        behind_m, ahead_m: length of the centre line.
        users: nearest road users that are shown.
        edges, lanes: nearest segments of road edges and of lanes that are shown, of those that reach into `range_m`.
        friction_ahead_m: where the friction coefficient is read, beside the car's place, as in `friction_ahead`; None: nowhere.
        friction: `weather.friction` of the config, bound; the environment supplies it.
    """
    motion = state.motion
    place = (motion.position[:, :2], motion.yaw)
    mu = jnp.full_like(motion.yaw, jnp.inf)
    if friction_ahead_m is not None and friction is not None:
        mu = jnp.min(friction_ahead(scene, state, ahead_m=friction_ahead_m, friction=friction), axis=1)
    velocity = to_frame(motion.velocity[:, :2], motion.yaw)
    line = read_centre_line(scene, state, behind_m=behind_m, ahead_m=ahead_m)
    return PlanningView(
        velocity=velocity,
        yaw_rate=motion.yaw_rate,
        steer=motion.steer,
        size=state.agents.size,
        line=line,
        stops=read_stop_lines(scene, state, state.step.astype(jnp.float32) * control_dt),
        users=find_users(scene, state, count=users),
        edges=keep_level(gather_nearest(scene.edges, *place, count=edges, range_m=range_m), line),
        lanes=keep_level(gather_nearest(scene.lanes, *place, count=lanes, range_m=range_m), line),
        mu=mu,
        grade=elevation.read_grade(scene, motion),
    )


def keep_level(segments: NearSegments, line: CentreLine) -> NearSegments:
    """Drops the segments on another level than the nearest point of the centre line."""
    if segments.height is None or line.height is None:
        return segments
    apart = segments.midpoint[:, :, None] - line.point[:, None]
    nearest = jnp.argmin(dot(apart, apart), axis=2)
    rise = segments.height - jnp.take_along_axis(line.height, nearest, axis=1)
    return segments._replace(present=segments.present & (jnp.abs(rise) < elevation.LEVEL_M))


def read_centre_line(scene: Scene, state: State, *, behind_m: float, ahead_m: float) -> CentreLine:
    """Reads the routes around the agents; a line straight ahead of an agent without one."""
    agents, motion = state.agents, state.motion
    away = jnp.arange(-round(behind_m / SPACING_M), round(ahead_m / SPACING_M) + 1) * SPACING_M
    away = jnp.broadcast_to(away.astype(jnp.float32), (len(motion.yaw), away.shape[0]))
    known = route_following.find_routed(scene, agents)
    point = jnp.stack([away, jnp.zeros_like(away)], axis=-1)
    direction = jnp.zeros_like(point).at[..., 0].set(1.0)
    limit, remaining, height = jnp.zeros_like(away), jnp.zeros_like(motion.yaw), None
    if scene.edges.height is not None:
        height = jnp.broadcast_to(motion.position[:, 2:], away.shape)
    if scene.routes.length.shape[0]:
        arc, row = state.route.arc[:, None] + away, jnp.broadcast_to(agents.route[:, None], away.shape)
        inside = jnp.clip(arc, 0.0, scene.routes.length[row])
        on_route, along = route_following.find_point(scene, row, inside)
        on_route = on_route + (arc - inside)[..., None] * along
        yaw = motion.yaw[:, None]
        point = jnp.where(known[:, None, None], to_frame(on_route - motion.position[:, None, :2], yaw), point)
        direction = jnp.where(known[:, None, None], to_frame(along, yaw), direction)
        place = jnp.floor(inside / SPACING_M).astype(jnp.int32)
        limit = scene.routes.speed_limit[row, place]
        limit = jnp.where(jnp.isfinite(limit) & known[:, None], limit, 0.0)
        remaining = jnp.where(known, agents.route_end - state.route.arc, 0.0)
        if height is not None and scene.routes.height is not None:
            height = jnp.where(known[:, None], scene.routes.height[row, place], height)
    return CentreLine(away, point, direction, limit, known, remaining, height)


def read_stop_lines(scene: Scene, state: State, time_s: Float[Array, ""]) -> StopLinesAhead:
    """Reads the stop lines ahead of the agents on their routes."""
    lines = route_following.find_stop_lines(scene, state.agents, state.route.arc, time_s)
    ahead = (lines.distance > 0) & jnp.isfinite(lines.distance) & route_following.find_routed(scene, state.agents)[:, None]
    yellow = traffic_lights.find_yellow(lines.state)
    next_line = jnp.cumsum(ahead, axis=1) == 1
    waits = lines.stop_sign & ~(state.route.stood[:, None] & next_line)
    return StopLinesAhead(jnp.where(ahead, lines.distance, jnp.inf), ahead & lines.red, ahead & yellow, ahead & waits)


def find_users(scene: Scene, state: State, *, count: int) -> NearUsers:
    """Finds the nearest other active agents and boxes of the traffic.

    The traffic's kinds are those of the log, whose rows come first in it; boxes beyond them are vehicles, as agents are.
    """
    motion, cars = state.motion, len(state.active)
    users = surrogate_safety.collect_road_users(motion, state.agents.size, state.active, scene.traffic)
    total = len(users.present)
    vehicle, logged = ROAD_USERS.index("vehicle"), scene.traffic_log.kind
    kind = jnp.full(total, vehicle, jnp.int32)
    if total - cars >= logged.shape[0]:
        kind = kind.at[cars : cars + logged.shape[0]].set(logged.astype(jnp.int32))
    apart = users.position - motion.position[:, None, :2]
    others = users.present & ~jnp.eye(cars, total, dtype=bool)
    index, mask = nearest_rows.select_nearest(jnp.where(others, dot(apart, apart), jnp.inf), count=count)
    height, climb = _find_heights(scene, motion, users)
    yaw = motion.yaw[:, None]
    return NearUsers(
        position=to_frame(jnp.take_along_axis(apart, index[..., None], axis=1), yaw),
        yaw=wrap_angle(users.yaw[index] - yaw),
        velocity=to_frame(users.velocity[index], yaw),
        size=users.size[index],
        kind=kind[index],
        present=mask,
        height=None if height is None else height[index],
        climb=None if climb is None else climb[index],
    )


def _find_heights(
    scene: Scene, motion: Motion, users: surrogate_safety.RoadUsers
) -> tuple[Float[Array, " B"] | None, Float[Array, " B"] | None]:
    """Heights of road users and their vertical speeds on the road, m and m/s; None in a scene of one level."""
    height = surrogate_safety.find_heights(scene, motion, scene.traffic)
    if height is None or scene.elevation is None:
        return None, None
    return height, dot(elevation.find_ground(scene.elevation, users.position, height).slope, users.velocity)
