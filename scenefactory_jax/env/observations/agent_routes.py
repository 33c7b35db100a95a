"""The route that an agent's observation shows."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot
from scenefactory_jax.core.types import Agents, Scene
from scenefactory_jax.env.route_following import find_routed


def select_routes(scene: Scene, agents: Agents) -> tuple[Int[Array, " A"], Bool[Array, " A"]]:
    """Selects a row of `scene.routes` for each agent, and a mask of the agents that have one.

    Of the agent's own routes the longest on-route one (V-Max); an agent that drives another route, a drawn one, sees that.
    """
    routes, slots = scene.routes, jnp.arange(agents.present.shape[0])
    if routes.length.shape[0] == 0:
        return jnp.zeros_like(agents.route), jnp.zeros_like(agents.present)
    own = (routes.agent == slots[:, None]) & routes.on_route & (routes.length > 0)
    longest = jnp.argmax(jnp.where(own, routes.length, -1.0), axis=1)
    routed = find_routed(scene, agents)
    elsewhere = routed & (routes.agent[agents.route] != slots)
    use_own = jnp.any(own, axis=1) & ~elsewhere
    return jnp.where(use_own, longest, agents.route).astype(jnp.int32), use_own | routed


def sample_route_ahead(
    scene: Scene, route: Int[Array, " A"], position: Float[Array, "A 2"], *, count: int, gap: int
) -> Float[Array, "A {count} 2"]:
    """Samples points of routes at gap, 2 gap, ... points behind the one that follows the nearest; behind the end the last is repeated."""
    points = scene.routes.position
    if points.shape[0] == 0:
        return jnp.zeros((len(route), count, 2), jnp.float32)
    offset = points[route] - position[:, None]
    nearest = jnp.argmin(dot(offset, offset), axis=1)
    index = nearest[:, None] + 1 + gap * jnp.arange(1, count + 1)
    return points[route[:, None], jnp.minimum(index, points.shape[1] - 1)]
