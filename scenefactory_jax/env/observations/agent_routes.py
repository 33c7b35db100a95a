"""The route that an agent's observation shows, and others along it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import dot
from scenefactory_jax.core.types import Agents, Boxes, Scene, State
from scenefactory_jax.dynamics.collision import collect_boxes
from scenefactory_jax.env.route_following import find_routed
from scenefactory_jax.env.traffic import corridor


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


def find_along_route(
    scene: Scene, state: State, *, look_ahead_m: float, chord_m: int
) -> tuple[Boxes, corridor.Window, corridor.Projection]:
    """Finds where all boxes, of the active agents and the traffic after them, lie along the route ahead of each agent.

    Args:
        look_ahead_m: length of the route that is searched, read as chords of `chord_m` points.
    """
    cars = collect_boxes(state.motion, state.agents.size, state.active, jnp.inf)
    boxes: Boxes = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), cars, scene.traffic)
    points = max(int(look_ahead_m // chord_m), 1) + 1
    window = corridor.read_window(scene.routes, state.agents.route, state.route.arc, points=points, stride=chord_m)
    return boxes, window, corridor.project_boxes(window, boxes)
