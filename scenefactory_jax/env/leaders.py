"""Others along the routes of agents, and the nearest of them on each: its leader."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Boxes, Scene, State
from scenefactory_jax.dynamics.collision import collect_boxes
from scenefactory_jax.env import route_following
from scenefactory_jax.env.traffic import corridor


class Leader(NamedTuple):
    """The nearest box ahead on the route of each agent."""

    gap: Float[Array, " A"]  # m along the route between the agent's front and the box; infinite without one
    speed: Float[Array, " A"]  # of the box along the route, not below 0; m/s


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


def find_leaders(scene: Scene, state: State, *, look_ahead_m: float, chord_m: int, margin_m: float, foresight_s: float) -> Leader:
    """Finds the nearest box in the strip of each agent's width along its own route, of other active agents and of the traffic.

    Boxes that cross the strip within `foresight_s` at their present velocity count, too. An agent without a route has no leader.

    Args:
        look_ahead_m: length of the route that is searched, read as chords of `chord_m` points.
        margin_m: by which the strip is wider than the agent, on both sides.
    """
    count = len(state.active)
    if not corridor.has_routes(scene.routes):
        return Leader(jnp.full(count, jnp.inf, jnp.float32), jnp.zeros(count, jnp.float32))
    boxes, _, places = find_along_route(scene, state, look_ahead_m=look_ahead_m, chord_m=chord_m)
    strip = {"arc": state.route.arc, "size": state.agents.size, "margin_m": margin_m, "foresight_s": jnp.full(len(boxes.mass), foresight_s)}
    found = corridor.find_obstacles(places, boxes, **strip, shift=jnp.zeros_like(places.offset))
    itself = jnp.arange(len(boxes.mass)) == jnp.arange(count)[:, None]
    gap = jnp.where(itself | ~route_following.find_routed(scene, state.agents)[:, None], jnp.inf, found.gap)
    nearest = jnp.argmin(gap, axis=1)[:, None]
    return Leader(*(jnp.take_along_axis(table, nearest, axis=1)[:, 0] for table in (gap, found.speed)))
