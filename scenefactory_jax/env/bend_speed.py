"""The speed with which a car can keep to the bends of its route ahead, as planners compute it from their observation of the route."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import cross, dot
from scenefactory_jax.core.schema import Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env import route_following


def find_bend_speed(
    scene: Scene, state: State, *, look_ahead_m: Positive, chord_m: Positive, lateral_mps2: Positive, braking_mps2: Positive
) -> Float[Array, " A"]:
    """Computes the largest speed from which braking reaches, at every bend ahead, that of a lateral acceleration; m/s.

    The route is read as chords from one behind the car on; a bend begins a chord before the joint of two of them, and has the curvature of
    their angle over a chord. inf on a straight route and for an agent without a route.

    Args:
        look_ahead_m: length of the route that is searched: braking from v takes v^2 / 2b.
        chord_m: shorter ones find sharper bends, and those of scattered points.
    """
    if scene.routes.length.shape[0] == 0:
        return jnp.full(state.active.shape, jnp.inf)
    ahead = chord_m * jnp.arange(-1, math.ceil(look_ahead_m / chord_m) + 1)
    arc = state.route.arc[:, None] + ahead
    points, _ = route_following.find_point(scene, jnp.broadcast_to(state.agents.route[:, None], arc.shape), arc)
    before, after = points[:, 1:-1] - points[:, :-2], points[:, 2:] - points[:, 1:-1]
    curvature = jnp.abs(jnp.arctan2(cross(before, after), dot(before, after))) / chord_m
    whole = (arc[:, :-2] >= 0.0) & (arc[:, 2:] <= scene.routes.length[state.agents.route][:, None])  # chords, no ends of the route
    bends = whole & (curvature > 0.0)
    bend_squared = lateral_mps2 / jnp.where(bends, curvature, 1.0)
    squared = bend_squared + 2.0 * braking_mps2 * jnp.maximum(ahead[1:-1] - chord_m, 0.0)
    slowest = jnp.sqrt(jnp.min(jnp.where(bends, squared, jnp.inf), axis=1))
    return jnp.where(route_following.find_routed(scene, state.agents), slowest, jnp.inf)
