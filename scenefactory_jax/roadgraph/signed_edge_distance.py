"""Signed distance to the nearest point of the road edges (Waymax): positive outside the road, to the right of an edge's direction."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cross, dot, safe_norm
from scenefactory_jax.core.types import Road


class EdgePoints(NamedTuple):
    """Points of road edges, edge after edge; the road lies to the left of their direction."""

    position: Float[Array, "P d"]  # d = 2, or 3 with a height
    direction: Float[Array, "P 2"]
    edge: Int[Array, " P"]  # which edge a point is of
    valid: Bool[Array, " P"]


def list_edge_points(edges: Road) -> EdgePoints:
    """Lists the first points of road-edge segments."""
    return EdgePoints(edges.midpoint - edges.half_length[:, None] * edges.direction, edges.direction, edges.polyline, edges.valid)


def compute_signed_distance(point: Float[Array, "*n d"], edges: EdgePoints, *, height_scale: float = 1.0) -> Float[Array, "*n"]:
    """Computes the planar distance to the nearest edge point, positive outside the road, -inf without edges.

    The side is that of the nearest point and of the point before it on the same edge: outside if both say so.

    Args:
        height_scale: by which heights are stretched in the search for the nearest point (Waymax: 2).
    """
    if edges.valid.shape[0] == 0:
        return jnp.full(point.shape[:-1], -jnp.inf, jnp.float32)
    scale = jnp.array([1.0, 1.0, height_scale][: point.shape[-1]], jnp.float32)
    apart = (point[..., None, :] - edges.position) * scale
    nearest = jnp.argmin(jnp.where(edges.valid, dot(apart, apart), jnp.inf), axis=-1)
    before = jnp.maximum(nearest - 1, 0)
    connected = (edges.edge[before] == edges.edge[nearest]) & edges.valid[before]
    before = jnp.where(connected, before, nearest)
    flat = point[..., :2]
    side, side_before = (cross(flat - edges.position[row, :2], edges.direction[row]) for row in (nearest, before))
    distance = safe_norm(flat - edges.position[nearest, :2])
    return jnp.where(jnp.any(edges.valid), jnp.sign(jnp.minimum(side, side_before)) * distance, -jnp.inf)
