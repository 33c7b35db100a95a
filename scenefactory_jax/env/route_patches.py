"""Patches of the road on the agents' routes: a layout as those of `weather.patch_layouts`, here because it reads routes."""

from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from scenefactory_jax.core.schema import Bounds, Fraction, NonNegative, Positive
from scenefactory_jax.core.types import SURFACES, Patches, Scene, SurfaceName, Weather
from scenefactory_jax.env import route_following


def route_strips(
    key: PRNGKeyArray,
    scene: Scene,
    weather: Weather,
    *,
    begin_m: float,
    end_m: float,
    width_m: Positive,
    points: Annotated[int, Bounds(min=2)],
    surface: SurfaceName,
    film_mm: NonNegative,
    offset_m: float = 0.0,
    chance: Fraction = 1.0,
    instead: list[SurfaceName] | None = None,
) -> Patches:
    """Makes a strip along the route of every agent; its ends are round. An agent without a route has none.

    Args:
        begin_m: where the strip begins on the route's line, from the agent's start; below 0: behind it.
        end_m: where it ends, from the agent's goal.
        points: vertices of the strip's middle line, equidistant along the route.
        offset_m: of the middle line from the route, to the left.
        chance: probability that an episode has them.
        instead: surfaces of which an episode has one, in place of `surface`.
    """
    chance_key, surface_key = jax.random.split(key)
    kinds = jnp.array([SURFACES.index(name) for name in instead or [surface]], jnp.int32)
    agents, count = scene.agents, scene.agents.present.shape[0]
    radius = 0.5 * width_m
    first, last = agents.route_start + begin_m + radius, agents.route_end + end_m - radius
    arc = first[:, None] + (last - first)[:, None] * jnp.linspace(0.0, 1.0, points)
    routed = route_following.find_routed(scene, agents) & (jax.random.uniform(chance_key) < chance)
    vertices = jnp.zeros((count, points, 2), jnp.float32)
    if scene.routes.length.shape[0]:
        on_route, along = route_following.find_point(scene, jnp.broadcast_to(agents.route[:, None], arc.shape), arc)
        vertices = on_route + offset_m * jnp.stack([-along[..., 1], along[..., 0]], axis=-1)
    return Patches(
        vertices=vertices,
        closed=jnp.zeros(count, bool),
        radius=jnp.full(count, radius, jnp.float32),
        surface=jnp.broadcast_to(jax.random.choice(surface_key, kinds), (count,)),
        film_mm=jnp.full(count, film_mm, jnp.float32),
        open_road_film_fraction=jnp.zeros(count, jnp.float32),
        present=routed,
    )
