"""Patches: regions of the road with their own surface and water film."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cross, dot
from scenefactory_jax.core.types import Patches, Weather


def contains_points(patches: Patches, position: Float[Array, "*shape 2"]) -> Bool[Array, "*shape N"]:
    """Computes whether points lie in patches: within the radius of a patch's line or, if it is closed, in its interior (even-odd rule).

    Absent patches contain no point. Repeated vertices change nothing.
    """
    first, second = patches.vertices, jnp.roll(patches.vertices, -1, axis=-2)
    count = first.shape[-2]
    edge, offset = second - first, position[..., None, None, :] - first
    fraction = jnp.clip(dot(offset, edge) / jnp.maximum(dot(edge, edge), 1e-12), 0.0, 1.0)
    distance = offset - fraction[..., None] * edge
    closes = (jnp.arange(count) == count - 1) & (count > 1)  # the edge from the last vertex to the first; open lines have none
    near = (dot(distance, distance) <= patches.radius[:, None] ** 2) & (patches.closed[:, None] | ~closes)
    # edges that a ray from the point along +x crosses: their ends lie on both sides of it, and the point on their left
    y, rises = position[..., None, None, 1], second[..., 1] > first[..., 1]
    crossed = ((first[..., 1] > y) != (second[..., 1] > y)) & ((cross(edge, offset) > 0) == rises)
    interior = patches.closed & (jnp.sum(crossed, axis=-1) % 2 == 1)
    return patches.present & (jnp.any(near, axis=-1) | interior)


def read_condition(weather: Weather, position: Float[Array, "*shape 2"]) -> tuple[Float[Array, "*shape"], Int[Array, "*shape"]]:
    """Reads water film, mm, and surface (index into SURFACES) at points: of the last patch that contains them, else of the road."""
    patches, shape = weather.patches, position.shape[:-1]
    count = patches.present.shape[0]
    if count == 0:
        return jnp.broadcast_to(weather.film_mm, shape), jnp.broadcast_to(weather.surface, shape)
    inside = contains_points(patches, position)
    last = count - 1 - jnp.argmax(inside[..., ::-1], axis=-1)
    film_mm = (patches.film_mm + patches.open_road_film_fraction * weather.film_mm)[last]
    covered = jnp.any(inside, axis=-1)
    return jnp.where(covered, film_mm, weather.film_mm), jnp.where(covered, patches.surface[last], weather.surface)


def join_patches(parts: Sequence[Patches]) -> Patches:
    """Joins patches, later above earlier; shorter lines repeat their last vertex."""
    parts = [part for part in parts if part.present.shape[0]] or list(parts[:1])
    longest = max(part.vertices.shape[1] for part in parts)

    def pad(part: Patches) -> Patches:
        missing = ((0, 0), (0, longest - part.vertices.shape[1]), (0, 0))
        return Patches(**{**vars(part), "vertices": jnp.pad(part.vertices, missing, mode="edge")})

    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(pad, parts)) if len(parts) > 1 else parts[0]
