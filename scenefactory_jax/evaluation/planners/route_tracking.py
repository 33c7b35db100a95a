"""What planners on routes share: they read the observation `route`, steer along it and slow down for bends.

Everything is elementwise over leading axes and concerns the car's own frame.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import cross, dot, safe_norm
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.evaluation.planners import tracker as tracking
from scenefactory_jax.evaluation.planners.tracker import Tracker

HEAD, POINT = 5, 5  # columns of `observations.route` before the first point, and of a point
SHORTEST_M = 0.2  # nearer points have no bend between them
GENTLEST_RADPM = 1e-4  # a bend of 10 km radius is none
SHARPEST_RADPM = 1.0  # above any car's


class RouteAhead(NamedTuple):
    """Points of the route ahead; the first is the car's place on it, and those behind the goal repeat it."""

    arc: Float[Array, "*n P"]  # from the car's place
    point: Float[Array, "*n P 2"]
    direction: Float[Array, "*n P 2"]  # unit
    limit: Float[Array, "*n P"]  # m/s; 0 where none is known; the first point has that of the second
    known: Float[Array, "*n"]  # 1: the agent has a route
    remaining: Float[Array, "*n"]  # along the route to the goal


def require_groups(observation: Mapping[str, Any], *names: str, planner: str, option: str = "drive") -> None:
    """Raises a ConfigError that names the observation groups that a planner needs and does not find; `option` has them."""
    if missing := [name for name in names if name not in observation]:
        has = ", ".join(sorted(observation)) or "none"
        groups = " and ".join(f"`{name}`" for name in missing)
        raise ConfigError(
            f"policy: {planner} needs the observation groups of observations={option}; {groups} missing; the observation has: {has}"
        )


def make_planner(act: Callable[[Observation], Float[Array, "*n 3"]], *groups: str, planner: str, option: str = "drive") -> Policy:
    """Makes a policy of a function: without parameters and noise, its values are zero. The others as of `require_groups`."""

    def apply(parameters, observation):
        require_groups(observation, *groups, planner=planner, option=option)
        action = act(observation)
        return action, jnp.full(3, -jnp.inf), jnp.zeros_like(action[..., 0])

    return Policy(lambda key, observation: {}, apply)


def expand_length(compressed: Float[Array, "*n"], scale: float) -> Float[Array, "*n"]:
    """Inverse of `compress_length`; inf for 1."""
    rest = 1.0 - jnp.abs(compressed)
    return jnp.where(rest > 0, scale * compressed / jnp.maximum(rest, 1e-6), jnp.copysign(jnp.inf, compressed))


def read_route(vector: Float[Array, "*n F"], scales: Mapping[str, Any]) -> RouteAhead:
    """Reads the observation group `route`.

    Args:
        scales: entry of `observations.route`.

    Raises:
        ConfigError: a vector of another length than the entry's.
    """
    ahead = jnp.array(scales["ahead_m"], jnp.float32)
    if vector.shape[-1] != (expected := HEAD + POINT * len(ahead)):
        raise ConfigError(f"policy.observations.route.ahead_m: expected as observations.route, {expected} columns, got {vector.shape[-1]}")
    offset, remaining = expand_length(vector[..., 1], scales["offset_scale_m"]), expand_length(vector[..., 2], scales["remaining_scale_m"])
    remaining = jnp.maximum(remaining, 0.0)
    sine, cosine = vector[..., 3], vector[..., 4]  # of the car relative to the route
    rows = vector[..., HEAD:].reshape(*vector.shape[:-1], len(ahead), POINT)
    here = -offset[..., None] * jnp.stack([sine, cosine], axis=-1)
    join = lambda first, rest: jnp.concatenate([first[..., None, :], rest], axis=-2)  # noqa: E731
    limit = scales["speed_scale_mps"] * rows[..., 4]
    return RouteAhead(
        arc=jnp.concatenate([jnp.zeros_like(remaining)[..., None], jnp.minimum(ahead, remaining[..., None])], axis=-1),
        point=join(here, scales["distance_scale_m"] * rows[..., :2]),
        direction=join(jnp.stack([cosine, -sine], axis=-1), rows[..., 2:4]),
        limit=jnp.concatenate([limit[..., :1], limit], axis=-1),
        known=vector[..., 0],
        remaining=remaining,
    )


def find_point(route: RouteAhead, arc: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Finds the point at a distance along the route: cubic between two points with their directions, straight on behind the goal."""
    inside = jnp.minimum(arc, jnp.minimum(route.remaining, route.arc[..., -1]))
    row = jnp.clip(jnp.sum(route.arc <= inside[..., None], axis=-1) - 1, 0, route.arc.shape[-1] - 2)
    pick = lambda table, at: jnp.take_along_axis(table, at.reshape(*at.shape, *[1] * (table.ndim - at.ndim)), axis=at.ndim)  # noqa: E731
    squeeze = lambda table, at: jnp.squeeze(pick(table, at), axis=at.ndim)  # noqa: E731
    low, high = squeeze(route.arc, row), squeeze(route.arc, row + 1)
    start, end = squeeze(route.point, row), squeeze(route.point, row + 1)
    first, second = squeeze(route.direction, row), squeeze(route.direction, row + 1)
    length = safe_norm(end - start)[..., None]
    t = jnp.clip((inside - low) / jnp.maximum(high - low, 1e-3), 0.0, 1.0)[..., None]
    bent = (1 - t) ** 2 * ((1 + 2 * t) * start + t * length * first) + t**2 * ((3 - 2 * t) * end - (1 - t) * length * second)
    return bent + jnp.maximum(arc - inside, 0.0)[..., None] * second


def compute_curvature(route: RouteAhead, speed: Float[Array, "*n"], tracker: Tracker) -> Float[Array, "*n"]:
    """Computes the curvature of pure pursuit (Coulter 1992): the circle along the rear axle's direction through a point ahead.

    The point is `look_ahead_m` and the way of `look_ahead_s` ahead along the route. SHARPEST_RADPM for a point behind the car.
    """
    target = find_point(route, tracker.look_ahead_m + tracker.look_ahead_s * speed)
    x, y = target[..., 0] + tracker.rear_m, target[..., 1]
    return jnp.where(x > 0.0, 2.0 * y / jnp.maximum(x**2 + y**2, 1.0), jnp.copysign(SHARPEST_RADPM, y))


def compute_target_speed(
    route: RouteAhead, limit: Float[Array, "*n P"], tracker: Tracker, limit_mps2: Float[Array, "*n"] | None = None
) -> Float[Array, "*n"]:
    """Computes the largest speed with which the car can keep to the limits and to `lateral_mps2` in the bends ahead, braking with
    `braking_mps2` before them; `limit_mps2` limits both."""
    most = jnp.full_like(route.remaining, jnp.inf) if limit_mps2 is None else limit_mps2
    lateral, braking = (jnp.minimum(value, most)[..., None] for value in (tracker.lateral_mps2, tracker.braking_mps2))
    along = route.arc[..., 1:] - route.arc[..., :-1]
    turn = jnp.arctan2(
        cross(route.direction[..., :-1, :], route.direction[..., 1:, :]), dot(route.direction[..., :-1, :], route.direction[..., 1:, :])
    )
    curvature = jnp.where(along > SHORTEST_M, jnp.abs(turn) / jnp.maximum(along, SHORTEST_M), 0.0)
    bend = jnp.sqrt(lateral / jnp.maximum(curvature, GENTLEST_RADPM))
    slowest = jnp.minimum(limit, jnp.concatenate([bend, bend[..., -1:]], axis=-1))  # a bend begins at the first of its two points
    return jnp.min(jnp.sqrt(slowest**2 + 2.0 * braking * route.arc), axis=-1)


def read_grade(observation: Mapping[str, Any], scales: Mapping[str, Any]) -> Float[Array, "*n"] | None:
    """Reads the grade under the car from the group `grade_ahead`; None where it is not observed."""
    ahead = observation.get("grade_ahead")
    return None if ahead is None else scales["grade_ahead"]["grade_scale"] * ahead[..., 0]


def make_action(
    acceleration: Float[Array, "*n"],
    route: RouteAhead,
    speed: Float[Array, "*n"],
    tracker: Tracker,
    *,
    grade: Float[Array, "*n"] | None = None,
) -> Float[Array, "*n 3"]:
    """Makes the action that follows the route with an acceleration; an agent without a route brakes."""
    follow = tracking.make_action(acceleration, compute_curvature(route, speed, tracker), speed, tracker, grade=grade)
    return jnp.where(route.known[..., None] > 0, follow, tracking.make_braking_action(speed, tracker))
