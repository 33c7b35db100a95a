"""Oriented rectangles: corners, overlaps, the shortest way between two."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import dot, heading_vector, rotate

CORNERS = ((1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0))  # front right, front left, rear left, rear right


def compute_corners(position: Float[Array, "*n 2"], yaw: Float[Array, "*n"], size: Float[Array, "*n 2"]) -> Float[Array, "*n 4 2"]:
    """Computes the corners of rectangles: front right, front left, rear left, rear right."""
    local = 0.5 * size[..., None, :] * jnp.array(CORNERS, jnp.float32)
    return position[..., None, :] + rotate(local, yaw[..., None])


def find_overlaps(
    position: Float[Array, "*a 2"],
    yaw: Float[Array, "*b"],
    size: Float[Array, "*c 2"],
    other_position: Float[Array, "*d 2"],
    other_yaw: Float[Array, "*e"],
    other_size: Float[Array, "*f 2"],
) -> Bool[Array, "*k"]:
    """Finds the pairs of rectangles that overlap, by the separating axis theorem; leading axes broadcast.

    Rectangles that only touch do not overlap, nor does one without area (as in Waymax).
    """
    apart = other_position - position
    facing, other_facing = heading_vector(yaw), heading_vector(other_yaw)
    cos = jnp.abs(dot(facing, other_facing))
    sin = jnp.abs(facing[..., 0] * other_facing[..., 1] - facing[..., 1] * other_facing[..., 0])
    (length, width), (other_length, other_width) = _halves(size), _halves(other_size)
    along, across = _project(apart, facing)
    other_along, other_across = _project(apart, other_facing)
    overlap = (along < length + other_length * cos + other_width * sin) & (across < width + other_length * sin + other_width * cos)
    overlap &= (other_along < other_length + length * cos + width * sin) & (other_across < other_width + length * sin + width * cos)
    return overlap & (length > 0) & (width > 0) & (other_length > 0) & (other_width > 0)


def _halves(size: Float[Array, "*n 2"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    return 0.5 * size[..., 0], 0.5 * size[..., 1]


def _project(vector: Float[Array, "*n 2"], facing: Float[Array, "*m 2"]) -> tuple[Float[Array, "*k"], Float[Array, "*k"]]:
    """Lengths of a vector along and across a unit vector."""
    return jnp.abs(dot(vector, facing)), jnp.abs(vector[..., 0] * facing[..., 1] - vector[..., 1] * facing[..., 0])


class Placed(NamedTuple):
    """A rectangle as it lies in the frame of another: its centre, the cosine and sine of its heading, half its length and width."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    cos: Float[Array, "*n"]
    sin: Float[Array, "*n"]
    half_length: Float[Array, "*n"]
    half_width: Float[Array, "*n"]


def find_shortest_way(
    half_length: Float[Array, "*m"], half_width: Float[Array, "*m"], other: Placed
) -> tuple[Float[Array, "*k"], Float[Array, "*k"]]:
    """Finds the shortest vector from a rectangle around the origin to another: one end of it is a corner of either.

    Leading axes broadcast. Of rectangles that overlap it is zero if a corner of one lies in the other.

    Returns:
        Its components along and to the left of the first rectangle, m.
    """
    cos, sin, best = other.cos, other.sin, jnp.inf
    way_x = way_y = jnp.zeros(())
    for front, left in CORNERS:  # by scalar components, which XLA fuses
        length, width = front * other.half_length, left * other.half_width
        from_own = _leave(other.x + length * cos - width * sin, other.y + length * sin + width * cos, half_length, half_width)
        x, y = front * half_length - other.x, left * half_width - other.y
        out_x, out_y = _leave(x * cos + y * sin, y * cos - x * sin, other.half_length, other.half_width)
        for to_x, to_y in (from_own, (out_y * sin - out_x * cos, -out_x * sin - out_y * cos)):
            squared = to_x**2 + to_y**2
            nearer = squared < best
            best, way_x, way_y = jnp.where(nearer, squared, best), jnp.where(nearer, to_x, way_x), jnp.where(nearer, to_y, way_y)
    return way_x, way_y


def _leave(
    x: Float[Array, "*n"], y: Float[Array, "*n"], half_length: Float[Array, "*m"], half_width: Float[Array, "*m"]
) -> tuple[Float[Array, "*k"], Float[Array, "*k"]]:
    """The vector from the nearest point of a rectangle around the origin to a point; zero inside."""
    return x - jnp.clip(x, -half_length, half_length), y - jnp.clip(y, -half_width, half_width)
