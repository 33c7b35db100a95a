"""Signed distance to the nearest point of the road edges (Waymax): positive outside the road, to the right of an edge's direction."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cross, dot, find_smallest, safe_norm, squared_distances
from scenefactory_jax.core.types import Road


class EdgePoints(NamedTuple):
    """Points of road edges, edge after edge; the road lies to the left of their direction."""

    position: Float[Array, "P d"]  # d = 2, or 3 with a height
    direction: Float[Array, "P 2"]
    edge: Int[Array, " P"]  # which edge a point is of
    valid: Bool[Array, " P"]


def list_edge_points(edges: Road) -> EdgePoints:
    """Lists the first points of road-edge segments; on roads of several levels, with the heights of the segments."""
    return EdgePoints(list_first_points(edges), edges.direction, edges.polyline, edges.valid)


def list_first_points(road: Road) -> Float[Array, "P d"]:
    """Lists the first points of segments; on roads of several levels, d = 3, with the heights of the segments."""
    first = road.midpoint - road.half_length[:, None] * road.direction
    return append_height(first, road.height)


def append_height(place: Float[Array, "*n 2"], height: Float[Array, "*n"] | None) -> Float[Array, "*n d"]:
    """Appends heights to places in the plane, if there are any."""
    return place if height is None else jnp.concatenate([place, height[..., None]], axis=-1)


def compute_signed_distance(point: Float[Array, "*n d"], edges: EdgePoints, *, height_scale: float = 1.0) -> Float[Array, "*n"]:
    """Computes the planar distance to the nearest edge point, positive outside the road, -inf without edges.

    The side is that of the nearest point and of the point before it on the same edge: outside if both say so.

    Args:
        height_scale: by which heights are stretched in the search for the nearest point (Waymax: 2).
    """
    if edges.valid.shape[0] == 0:
        return jnp.full(point.shape[:-1], -jnp.inf, jnp.float32)
    nearest = _find_nearest(point, edges, height_scale=height_scale)
    before = _find_neighbour(nearest, -1, edges)
    flat = point[..., :2]
    side, side_before = (cross(flat - edges.position[row, :2], edges.direction[row]) for row in (nearest, before))
    distance = safe_norm(flat - edges.position[nearest, :2])
    return jnp.where(jnp.any(edges.valid), jnp.sign(jnp.minimum(side, side_before)) * distance, -jnp.inf)


def compute_line_distance(point: Float[Array, "*n d"], edges: EdgePoints, *, height_scale: float = 1.0) -> Float[Array, "*n"]:
    """Computes the signed distance as `compute_signed_distance`, but to the segments on both sides of the nearest edge point."""
    signed = compute_signed_distance(point, edges, height_scale=height_scale)
    if edges.valid.shape[0] == 0:
        return signed
    nearest = _find_nearest(point, edges, height_scale=height_scale)
    offset = point[..., :2] - edges.position[nearest, :2]
    to_neighbour = [edges.position[_find_neighbour(nearest, side, edges), :2] - edges.position[nearest, :2] for side in (-1, 1)]
    distance = jnp.abs(signed)
    for chord in to_neighbour:
        along = jnp.clip(dot(offset, chord) / jnp.maximum(dot(chord, chord), 1e-9), 0.0, 1.0)
        distance = jnp.minimum(distance, safe_norm(offset - along[..., None] * chord))
    return jnp.where(jnp.any(edges.valid), jnp.sign(signed) * distance, -jnp.inf)


def _find_nearest(point: Float[Array, "*n d"], edges: EdgePoints, *, height_scale: float) -> Int[Array, "*n"]:
    squared = squared_distances(point, edges.position[:, : point.shape[-1]], height_scale=height_scale)
    return find_smallest(jnp.where(edges.valid, squared, jnp.inf))


def _find_neighbour(row: Int[Array, "*n"], step: int, edges: EdgePoints) -> Int[Array, "*n"]:
    """The row before or after, if it is of the same edge; else the row itself."""
    neighbour = jnp.clip(row + step, 0, edges.valid.shape[0] - 1)
    return jnp.where((edges.edge[neighbour] == edges.edge[row]) & edges.valid[neighbour], neighbour, row)
