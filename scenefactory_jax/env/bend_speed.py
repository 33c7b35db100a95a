"""The speed with which a car can keep to the bends of its route ahead, as vehicles of the reactive traffic compute theirs."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import ROUTE_SPACING_M, Scene, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.traffic import corridor


def find_bend_speed(
    scene: Scene, state: State, *, look_ahead_m: Positive, chord_m: Count, lateral_mps2: Positive, braking_mps2: Positive
) -> Float[Array, " A"]:
    """Computes the largest speed from which braking reaches, at every bend ahead, that of a lateral acceleration; m/s.

    Hundreds of m/s where the route is straight, inf for an agent without one.

    Args:
        look_ahead_m: length of the route that is searched, read as chords of `chord_m` points from one behind the car on: braking from v
            takes v^2 / 2b. Shorter chords find sharper bends, and those of scattered points.
    """
    if not corridor.has_routes(scene.routes):
        return jnp.full(state.active.shape, jnp.inf)
    arc, points = state.route.arc, int(look_ahead_m // chord_m) + 2
    window = corridor.read_window(scene.routes, state.agents.route, arc - chord_m * ROUTE_SPACING_M, points=points, stride=chord_m)
    bends = {"lateral_mps2": lateral_mps2, "braking_mps2": braking_mps2}
    slowest = corridor.compute_target_speed(window, jnp.full(window.arc.shape, jnp.inf), arc, **bends)
    return jnp.where(route_following.find_routed(scene, state.agents), slowest, jnp.inf)
