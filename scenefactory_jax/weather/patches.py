"""Places of the road with a condition of their own: which of them hold a point, and what the road is like there."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cross, dot
from scenefactory_jax.core.types import Patches, Weather


def contains_points(patches: Patches, position: Float[Array, "*shape 2"]) -> Bool[Array, "*shape N"]:
    """Whether points lie in patches: within the radius of a patch's line or, if it is closed, in its interior by the even-odd rule.

    Absent patches hold nothing. Repeated vertices change nothing.
    """
    first, second = patches.vertices, jnp.roll(patches.vertices, -1, axis=-2)
    count = first.shape[-2]
    edge, offset = second - first, position[..., None, None, :] - first
    share = jnp.clip(dot(offset, edge) / jnp.maximum(dot(edge, edge), 1e-12), 0.0, 1.0)
    apart = offset - share[..., None] * edge
    closes = (jnp.arange(count) == count - 1) & (count > 1)  # the edge from the last vertex to the first; open lines have none
    near = (dot(apart, apart) <= patches.radius[:, None] ** 2) & (patches.closed[:, None] | ~closes)
    # edges that a ray from the point towards +x crosses: those with an end on either side of it, and the point on their left
    y, rises = position[..., None, None, 1], second[..., 1] > first[..., 1]
    crossed = ((first[..., 1] > y) != (second[..., 1] > y)) & ((cross(edge, offset) > 0) == rises)
    interior = patches.closed & (jnp.sum(crossed, axis=-1) % 2 == 1)
    return patches.present & (jnp.any(near, axis=-1) | interior)


def condition_at(weather: Weather, position: Float[Array, "*shape 2"]) -> tuple[Float[Array, "*shape"], Int[Array, "*shape"]]:
    """Water film in mm and surface (an index into SURFACES) at points: those of the last patch that holds the point, or the open road's."""
    patches, shape = weather.patches, position.shape[:-1]
    count = patches.present.shape[0]
    if count == 0:
        return jnp.broadcast_to(weather.film_mm, shape), jnp.broadcast_to(weather.surface, shape)
    within = contains_points(patches, position)
    last = count - 1 - jnp.argmax(within[..., ::-1], axis=-1)
    film_mm = (patches.film_mm + patches.open_road_film_fraction * weather.film_mm)[last]
    covered = jnp.any(within, axis=-1)
    return jnp.where(covered, film_mm, weather.film_mm), jnp.where(covered, patches.surface[last], weather.surface)


def join_patches(parts: Sequence[Patches]) -> Patches:
    """All patches of several, the later above the earlier; shorter lines of vertices repeat their last one."""
    parts = [part for part in parts if part.present.shape[0]] or list(parts[:1])
    longest = max(part.vertices.shape[1] for part in parts)

    def padded(part: Patches) -> Patches:
        missing = ((0, 0), (0, longest - part.vertices.shape[1]), (0, 0))
        return Patches(**{**vars(part), "vertices": jnp.pad(part.vertices, missing, mode="edge")})

    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(padded, parts)) if len(parts) > 1 else parts[0]
