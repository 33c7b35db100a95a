"""Distances along rays from a point to rectangles and to line segments."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import heading_vector, to_frame

PARALLEL = 1e-6  # sine of the angle below which a ray and a segment are parallel
SEGMENTS_AT_ONCE = 32


def make_ray_directions(count: int) -> Float[Array, "{count} 2"]:
    """Makes unit vectors all around, the first ahead, counter-clockwise."""
    return heading_vector(2 * jnp.pi * jnp.arange(count) / count)


def cast_to_boxes(
    rays: Float[Array, "N 2"],
    position: Float[Array, "A B 2"],
    yaw: Float[Array, "A B"],
    size: Float[Array, "A B 2"],
    present: Bool[Array, "A B"],
    *,
    range_m: float,
) -> Float[Array, "A N"]:
    """Computes the distance to the first box on each ray from the origin, `range_m` without one; 0 inside a box."""
    direction = to_frame(rays, yaw[..., None])  # [A, B, N, 2]
    origin, half = to_frame(-position, yaw), size / 2
    enter, leave = jnp.zeros(direction.shape[:-1]), jnp.full(direction.shape[:-1], range_m)
    for axis in range(2):
        along, start, reach = direction[..., axis], origin[..., axis, None], half[..., axis, None]
        still = jnp.abs(along) < PARALLEL
        inverse = 1.0 / jnp.where(still, 1.0, along)
        first, second = (-reach - start) * inverse, (reach - start) * inverse
        beside = still & (jnp.abs(start) > reach)
        near = jnp.where(still, jnp.where(beside, jnp.inf, -jnp.inf), jnp.minimum(first, second))
        far = jnp.where(still, jnp.inf, jnp.maximum(first, second))
        enter, leave = jnp.maximum(enter, near), jnp.minimum(leave, far)
    hit = (enter <= leave) & present[..., None]
    return jnp.min(jnp.where(hit, enter, range_m), axis=1, initial=range_m)


def cast_to_segments(
    rays: Float[Array, "N 2"],
    midpoint: Float[Array, "A C 2"],
    direction: Float[Array, "A C 2"],
    half_length: Float[Array, "A C"],
    present: Bool[Array, "A C"],
    *,
    range_m: float,
) -> Float[Array, "A N"]:
    """Computes the distance to the first line segment on each ray from the origin, `range_m` without one.

    Segments are looked at in chunks: one reduction over many of them and many rays compiles for minutes on GPUs.
    """
    chunks = -(-present.shape[1] // SEGMENTS_AT_ONCE)
    padding = chunks * SEGMENTS_AT_ONCE - present.shape[1]

    def split(leaf: Array) -> Array:
        padded = jnp.pad(leaf, ((0, 0), (0, padding)))
        return jnp.moveaxis(padded.reshape(len(leaf), chunks, SEGMENTS_AT_ONCE), 1, 0)

    along_ray, across_ray = (axis[:, None] for axis in rays.T)

    def cast(nearest: Float[Array, "A N"], chunk: tuple[Array, ...]) -> tuple[Float[Array, "A N"], None]:
        x, y, along_x, along_y, half, there = (leaf[:, None] for leaf in chunk)
        sine = along_ray * along_y - across_ray * along_x  # [A, N, C]
        crosses = jnp.abs(sine) >= PARALLEL
        inverse = 1.0 / jnp.where(crosses, sine, jnp.inf)
        distance, place = (x * along_y - y * along_x) * inverse, (x * across_ray - y * along_ray) * inverse
        hit = there & crosses & (distance >= 0) & (jnp.abs(place) <= half)
        return jnp.minimum(nearest, jnp.min(jnp.where(hit, distance, range_m), axis=2)), None

    columns = (midpoint[..., 0], midpoint[..., 1], direction[..., 0], direction[..., 1], half_length, present)
    return jax.lax.scan(cast, jnp.full((len(present), len(rays)), range_m), tuple(map(split, columns)))[0]
