"""Where agents are on their routes, and which stop lines they pass: computed once per control step.

A car's place on its route is the nearest point within a window around its last place, so that a route that crosses itself is followed in
order. An agent without a route reads zeros.
"""

import dataclasses
from typing import Annotated, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot, heading_vector, safe_norm
from scenefactory_jax.core.schema import Bounds, NonNegative, Positive
from scenefactory_jax.core.types import ROUTE_SPACING_M, Agents, Motion, RouteState, Scene, State
from scenefactory_jax.roadgraph import traffic_lights

WINDOW = (8, 24)  # points behind and ahead of the last place that are searched: 720 m/s at 30 steps a second


@dataclasses.dataclass(frozen=True)
class RouteConfig:
    """The key `route` of the config group `step_metrics`."""

    off_route_m: Positive  # farther from its route a car is off it
    stand_speed_mps: NonNegative  # slower before a stop sign, a car stands
    stand_distance_m: Positive  # between the car's front and the sign's line
    wrong_way_cosine: Annotated[float, Bounds(min=-1, max=1)]  # between car and lane or route; below it the car drives the wrong way
    on_lane_m: Positive  # a car this near to a lane's line is on that lane


class RoutePlace(NamedTuple):
    """Nearest points of routes."""

    arc: Float[Array, " K"]
    distance: Float[Array, " K"]  # from the route's line
    direction: Float[Array, "K 2"]  # of the route there


def find_routed(scene: Scene, agents: Agents) -> Bool[Array, " A"]:
    """Mask of the agents that have a route."""
    if scene.routes.length.shape[0] == 0:
        return jnp.zeros_like(agents.present)
    return agents.present & (agents.route_end > agents.route_start)


def start_routes(agents: Agents) -> RouteState:
    """Returns the state of agents at their starts."""
    return RouteState(arc=agents.route_start, farthest=agents.route_start, stood=jnp.zeros_like(agents.present))


def locate(scene: Scene, route: Int[Array, " K"], last_arc: Float[Array, " K"], position: Float[Array, "K 2"]) -> RoutePlace:
    """Finds the nearest points of routes within WINDOW around the last places."""
    points = scene.routes.position.shape[1]
    first = jnp.clip(jnp.floor(last_arc / ROUTE_SPACING_M).astype(jnp.int32) - WINDOW[0], 0, max(points - 1 - sum(WINDOW), 0))
    row = jnp.minimum(first[:, None] + jnp.arange(sum(WINDOW) + 1), points - 1)  # [K, W]
    line = scene.routes.position.reshape(-1, 2)[route[:, None] * points + row]
    start, along = line[:, :-1], line[:, 1:] - line[:, :-1]
    squared = jnp.maximum(dot(along, along), 1e-9)  # the points behind a route's end are one
    fraction = jnp.clip(dot(position[:, None] - start, along) / squared, 0.0, 1.0)
    distance = safe_norm(position[:, None] - start - fraction[..., None] * along)
    best = jnp.argmin(distance, axis=1)[:, None]
    pick = lambda table: jnp.take_along_axis(table, best, axis=1)[:, 0]  # noqa: E731
    chosen = jnp.take_along_axis(along, best[..., None], axis=1)[:, 0]
    arc = ROUTE_SPACING_M * pick(row[:, :-1]) + pick(fraction) * safe_norm(chosen)
    length = scene.routes.length[route]
    direction = chosen / jnp.maximum(safe_norm(chosen), 1e-3)[:, None]
    return RoutePlace(jnp.minimum(arc, length), pick(distance), direction)


def find_point(scene: Scene, route: Int[Array, "*k"], arc: Float[Array, "*k"]) -> tuple[Float[Array, "*k 2"], Float[Array, "*k 2"]]:
    """Finds points and unit directions at lengths along routes; beyond an end, the end."""
    points = scene.routes.position.shape[1]
    length = scene.routes.length[route]
    arc = jnp.clip(arc, 0.0, length)
    # the last piece of a route is shorter than the others: a point within it is found from its own two ends
    last = jnp.ceil(length / ROUTE_SPACING_M).astype(jnp.int32) - 1
    row = jnp.clip(jnp.floor(arc / ROUTE_SPACING_M).astype(jnp.int32), 0, jnp.clip(last, 0, points - 2))
    start, end = scene.routes.position[route, row], scene.routes.position[route, row + 1]
    along = end - start
    size = jnp.maximum(safe_norm(along), 1e-3)
    direction = along / size[..., None]
    return start + (arc - ROUTE_SPACING_M * row)[..., None] * direction, direction


def project(scene: Scene, route: Int[Array, " K"], position: Float[Array, "K 2"]) -> RoutePlace:
    """Finds the nearest points of whole routes; zeros in a world without routes."""
    if scene.routes.length.shape[0] == 0:
        zero = jnp.zeros(route.shape, jnp.float32)
        return RoutePlace(zero, zero, jnp.zeros((*route.shape, 2), jnp.float32))
    nearest = jnp.argmin(safe_norm(scene.routes.position[route] - position[:, None]), axis=1)
    return locate(scene, route, ROUTE_SPACING_M * nearest, position)


class StopLines(NamedTuple):
    """Stop lines of the agents' routes at one time."""

    distance: Float[Array, "A S"]  # from the car's front along the route; negative behind it; inf where there is none
    control: Int[Array, "A S"]  # row of `Scene.controls`
    stop_sign: Bool[Array, "A S"]
    red: Bool[Array, "A S"]
    state: Int[Array, "A S"]  # of the light, as an index into LIGHT_STATES; 0 for stop signs


def find_stop_lines(scene: Scene, agents: Agents, arc: Float[Array, " A"], time_s: Float[Array, ""]) -> StopLines:
    """Finds the stop lines of each agent's route and the states of their lights; no lines in a world without routes."""
    if scene.routes.length.shape[0] == 0:
        none = jnp.zeros((len(arc), 0), bool)
        return StopLines(none.astype(jnp.float32), none.astype(jnp.int32), none, none, none.astype(jnp.int32))
    control = scene.routes.stop_control[agents.route]
    front = arc + 0.5 * agents.size[:, 0]
    distance = scene.routes.stop_arc[agents.route] - front[:, None]
    if scene.controls.valid.shape[0] == 0:
        none = jnp.zeros(control.shape, bool)
        return StopLines(jnp.full_like(distance, jnp.inf), control, none, none, jnp.zeros_like(control))
    states = traffic_lights.read_light_states(scene.controls, time_s)
    return StopLines(distance, control, scene.controls.stop_sign[control], traffic_lights.find_red(states)[control], states[control])


def advance(scene: Scene, before: State, motion: Motion, *, speed: Float[Array, " A"], config: RouteConfig) -> RouteState:
    """Computes the state of the routes after a control step; inactive agents keep theirs."""
    agents, old = before.agents, before.route
    if scene.routes.length.shape[0] == 0:
        return old
    follows = find_routed(scene, agents) & before.active
    place = locate(scene, agents.route, old.arc, motion.position[:, :2])
    arc = jnp.where(follows, place.arc, old.arc)
    lines = find_stop_lines(scene, agents, arc, jnp.float32(0.0))
    passed = jnp.any((scene.routes.stop_arc[agents.route] > old.arc[:, None] + 0.5 * agents.size[:, :1]) & (lines.distance <= 0), axis=1)
    near = jnp.any(lines.stop_sign & (lines.distance > 0) & (lines.distance <= config.stand_distance_m), axis=1)
    stood = (old.stood & ~passed) | (near & (speed <= config.stand_speed_mps))
    return RouteState(arc=arc, farthest=jnp.maximum(old.farthest, arc), stood=jnp.where(follows, stood, old.stood))


class RouteMetrics(NamedTuple):
    """The part of `StepMetrics` that concerns routes, and its events."""

    values: dict[str, Array]
    red_light: Bool[Array, " A"]
    stop_sign: Bool[Array, " A"]
    off_route: Bool[Array, " A"]


def compute_metrics(
    scene: Scene,
    before: State,
    after: State,
    *,
    speed: Float[Array, " A"],
    lane_heading: Float[Array, " A"],
    lane_offset: Float[Array, " A"],
    config: RouteConfig,
    control_dt: float,
) -> RouteMetrics:
    """Computes place, progress and offences of a control step along the routes; zeros and false for agents without a route.

    A car drives the wrong way against its route, or, where it does not follow it, against the nearest lane.
    A car offends at a stop line if its front passes the line in this step, on its route, with a red light at the end of the step, or at a
    stop sign without having stood within `stand_distance_m` before the line.
    """
    agents, motion = after.agents, after.motion
    zero, none = jnp.zeros_like(speed), jnp.zeros(speed.shape, bool)
    moving = speed > config.stand_speed_mps
    against_lane = moving & (lane_heading < config.wrong_way_cosine) & (lane_offset < config.on_lane_m)
    names = ("route_arc", "route_progress", "route_remaining", "route_completion", "route_distance", "route_alignment", "overspeed")
    if scene.routes.length.shape[0] == 0:
        return RouteMetrics({name: zero for name in names} | {"has_route": none, "wrong_way": against_lane}, none, none, none)
    routed = find_routed(scene, agents)
    arc, old_arc = after.route.arc, before.route.arc
    place = locate(scene, agents.route, arc, motion.position[:, :2])
    span = jnp.maximum(agents.route_end - agents.route_start, ROUTE_SPACING_M)
    alignment = dot(heading_vector(motion.yaw), place.direction)
    point = jnp.clip(jnp.floor(arc / ROUTE_SPACING_M).astype(jnp.int32), 0, scene.routes.position.shape[1] - 1)
    limit = scene.routes.speed_limit[agents.route, point]
    values = {
        "route_arc": arc,
        "route_progress": arc - old_arc,
        "route_remaining": agents.route_end - arc,
        "route_completion": jnp.clip((after.route.farthest - agents.route_start) / span, 0.0, 1.0),
        "route_distance": place.distance,
        "route_alignment": alignment,
        "overspeed": jnp.maximum(speed - limit, 0.0),
    }
    values = {name: jnp.where(routed, value, 0.0) for name, value in values.items()}
    values["has_route"] = routed
    against_route = routed & (alignment < config.wrong_way_cosine)
    follows = routed & ~against_route & (place.distance <= config.on_lane_m)  # in a junction other ways lie across a car's own
    values["wrong_way"] = (moving & against_route) | (against_lane & ~follows)
    lines = find_stop_lines(scene, agents, arc, after.step.astype(jnp.float32) * control_dt)
    line_arc = scene.routes.stop_arc[agents.route]
    on_route = routed & (place.distance <= config.off_route_m)
    passed = (line_arc > old_arc[:, None] + 0.5 * agents.size[:, :1]) & (lines.distance <= 0) & on_route[:, None]
    return RouteMetrics(
        values,
        red_light=jnp.any(passed & lines.red, axis=1),
        stop_sign=jnp.any(passed & lines.stop_sign, axis=1) & ~before.route.stood,
        off_route=routed & (place.distance > config.off_route_m),
    )
