"""The shortest way from one rectangle to another, by scalar components, which XLA fuses."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # front, left


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
    for front, left in CORNERS:
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
