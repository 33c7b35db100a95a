"""The nearest segments of road edges or lanes in the frame of each car."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import safe_norm, to_frame
from scenefactory_jax.core.types import Road
from scenefactory_jax.roadgraph import nearest_rows


class NearSegments(NamedTuple):
    """Segments of road edges or lanes in the frame of each car."""

    midpoint: Float[Array, "*n E 2"]
    direction: Float[Array, "*n E 2"]  # unit
    half_length: Float[Array, "*n E"]
    present: Bool[Array, "*n E"]
    height: Float[Array, "*n E"] | None = None  # None: the scene has one level


def gather_nearest(road: Road, position: Float[Array, "A 2"], yaw: Float[Array, " A"], *, count: int, range_m: float) -> NearSegments:
    """Gathers about the `count` nearest segments that reach into a range, in whole chunks of `nearest_rows`."""
    rows = road.valid.shape[0]
    if rows == 0:
        zero = jnp.zeros((len(yaw), 0, 2))
        return NearSegments(zero, zero, zero[..., 0], zero[..., 0] > 0)
    chunks = nearest_rows.make_chunks(road.midpoint, road.half_length, road.polyline, road.valid)
    near = safe_norm(chunks.centre - position[:, None, None]) <= chunks.radius + range_m
    index, mask = nearest_rows.gather_chunks(chunks, position, near, count=-(-count // nearest_rows.CHUNK), rows=rows)
    turn = lambda vectors: to_frame(vectors, yaw[:, None])  # noqa: E731
    middle = turn(road.midpoint[index] - position[:, None])
    height = None if road.height is None else road.height[index]
    return NearSegments(middle, turn(road.direction[index]), road.half_length[index], mask & road.valid[index], height)
