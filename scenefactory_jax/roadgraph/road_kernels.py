"""Triton kernels, through Pallas, of what cars ask the road: `roadside` has the same in plain JAX.

One program answers for one car and walks over the segments of its world: the lanes and edges there are, not those there is room for, and
none for a car that is not on stage. Plain JAX looks at every slot and at all rows of the padded tables, and at the edges once for each
question; of 350 rows to find in a list it makes a binary search in running numbers of hits.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import pallas
from scenefactory_jax.core.geometry import SMALLEST
from scenefactory_jax.core.types import Road, SpatialGrid

LOOK, GATHER = 128, 128  # segments that a program takes at a time; the fastest of 20 settings on an H200
LOOK_WARPS, GATHER_WARPS = 4, 4


def query_road_blocks(
    lanes: Road,
    edges: Road,
    circles: Float[Array, "A C 2"],
    radius: Float[Array, " A"],
    velocity: Float[Array, "A 2"],
    heading: Float[Array, "A 2"],
    position: Float[Array, "A 2"],
    active: Bool[Array, " A"],
    *,
    half_width_m: float,
    range_m: float,
    interpret: bool = False,
) -> tuple[Int[Array, " A"], Float[Array, " A"], Float[Array, " A"]]:
    """Row of the nearest lane; squared distance of the nearest edge (inf: none); largest 1 / TTC with an edge ahead (0: none).

    For cars that are not active: what a world without a road gives.
    """
    cars, count = circles.shape[:2]
    numbers = jnp.concatenate([circles.reshape(cars, -1), radius[:, None], velocity, heading, position], axis=1)
    limits = jnp.where(active[:, None], jnp.stack([pallas.block_of(lanes.valid), pallas.block_of(edges.valid)]), 0)
    tables = (lanes.midpoint, _flags(lanes), edges.midpoint, edges.direction, edges.half_length, _flags(edges))
    shapes = [jax.ShapeDtypeStruct((cars, 1), kind) for kind in (jnp.int32, jnp.float32, jnp.float32)]
    found = pl.pallas_call(
        functools.partial(_look, circles=count, half_width=half_width_m, range_m=range_m),
        grid=(cars,),
        in_specs=[pallas.row(limits), pallas.row(numbers), *map(pallas.whole, tables)],
        out_specs=[pallas.row(shape) for shape in shapes],
        out_shape=shapes,
        compiler_params=plgpu.CompilerParams(num_warps=LOOK_WARPS, num_stages=1),
        interpret=interpret,
        name="look_at_road",
    )(limits, numbers, *tables)
    row, squared, rate = (value[:, 0] for value in found)
    return row, squared, rate


def _look(limits, numbers, lane, lane_valid, edge, along, half, edge_valid, row, squared, rate, *, circles: int, half_width, range_m):
    steps = jnp.arange(LOOK, dtype=jnp.int32)
    centres = [(numbers[2 * c], numbers[2 * c + 1]) for c in range(circles)]
    radius, vx, vy, hx, hy, px, py = (numbers[2 * circles + place] for place in range(7))

    def nearest(block, best):
        at = block * LOOK + steps
        seen = _seen(lane_valid, at, limits[0])
        x, y = _pair(lane, at, seen)
        distance = jnp.where(seen, (px - x) * (px - x) + (py - y) * (py - y), jnp.inf)
        closer = distance < best[0]
        return jnp.where(closer, distance, best[0]), jnp.where(closer, at, best[1])

    def ahead(block, best):
        gap, soonest = best
        at = block * LOOK + steps
        seen = _seen(edge_valid, at, limits[1])
        (x, y), (dx, dy) = _pair(edge, at, seen), _pair(along, at, seen)
        length = plgpu.load(half.at[at], mask=seen, other=0.0)
        for cx, cy in centres:
            ox, oy = x - cx, y - cy
            beside = jnp.maximum(jnp.abs(ox * dx + oy * dy) - length, 0.0)
            across = jnp.maximum(jnp.abs(ox * dy - oy * dx) - half_width, 0.0)
            gap = jnp.minimum(gap, jnp.where(seen, beside * beside + across * across, jnp.inf))
            away = ox * ox + oy * oy
            inverse = jax.lax.rsqrt(jnp.maximum(away, SMALLEST * SMALLEST))
            distance, closing = away * inverse, (ox * vx + oy * vy) * inverse
            room = distance - radius
            touches = room <= 0.0
            soon = jnp.where(touches, jnp.inf, closing / jnp.where(touches, 1.0, room))
            met = seen & (distance <= range_m) & (ox * hx + oy * hy > 0.0) & (touches | (closing > SMALLEST))
            soonest = jnp.maximum(soonest, jnp.where(met, soon, 0.0))
        return gap, soonest

    far, none = jnp.full(LOOK, jnp.inf, jnp.float32), jnp.zeros(LOOK, jnp.float32)
    apart, number = jax.lax.fori_loop(0, pl.cdiv(limits[0], LOOK), nearest, (far, jnp.zeros(LOOK, jnp.int32)))
    gap, soonest = jax.lax.fori_loop(0, pl.cdiv(limits[1], LOOK), ahead, (far, none))
    least = jnp.min(apart)
    first = jnp.min(jnp.where(apart == least, number, jnp.iinfo(jnp.int32).max))  # of lanes at one distance the first
    row[0] = jnp.where(jnp.isinf(least), 0, first)
    squared[0] = jnp.min(gap)
    rate[0] = jnp.max(soonest)


def gather_segment_blocks(
    road: Road,
    cells: SpatialGrid,
    first: Int[Array, " A"],
    last: Int[Array, " A"],
    position: Float[Array, "A 2"],
    frame: Float[Array, "A 2"],
    *,
    count: int,
    radius_m: float,
    kind_scale: float,
    interpret: bool = False,
) -> tuple[Float[Array, "A count 5"], Bool[Array, "A count"]]:
    """Features of the first `count` segments within a radius, out of each car's part of the cells' lists, and which of them there are.

    Args:
        first, last: where a car's list begins and ends in `cells.rows`.
        frame: cosine and sine of what turns the world into the car's frame.
    """
    cars = len(position)
    limits, numbers = jnp.stack([first, last], axis=1), jnp.concatenate([position, frame], axis=1)
    tables = (cells.rows, road.midpoint, road.direction, road.kind)
    shapes = [jax.ShapeDtypeStruct((cars, count, 5), jnp.float32), jax.ShapeDtypeStruct((cars, count), jnp.int8)]
    features, mask = pl.pallas_call(
        functools.partial(_gather, count=count, radius=radius_m, kind_scale=kind_scale),
        grid=(cars,),
        in_specs=[pallas.row(limits), pallas.row(numbers), *map(pallas.whole, tables)],
        out_specs=[pallas.row(shape) for shape in shapes],
        out_shape=shapes,
        compiler_params=plgpu.CompilerParams(num_warps=GATHER_WARPS, num_stages=1),
        interpret=interpret,
        name="gather_road",
    )(limits, numbers, *tables)
    return features, mask != 0


def _gather(limits, numbers, rows, midpoint, direction, kind, features, mask, *, count: int, radius: float, kind_scale: float):
    steps = jnp.arange(GATHER, dtype=jnp.int32)
    begin, end = limits[0], limits[1]
    px, py, cos, sin = (numbers[place] for place in range(4))

    def block(carry):
        start, before = carry
        at = start + steps
        listed = at < end
        row = plgpu.load(rows.at[at], mask=listed, other=0)
        x, y = _pair(midpoint, row, listed)
        ox, oy = x - px, y - py
        hit = listed & (ox * ox + oy * oy <= radius * radius)
        number = before + jnp.cumsum(hit.astype(jnp.int32))  # of each hit among all so far
        kept = hit & (number <= count)
        dx, dy = _pair(direction, row, kept)
        name = plgpu.load(kind.at[row], mask=kept, other=0).astype(jnp.float32)
        place = jnp.where(kept, number - 1, count + steps)  # a place of their own, out of sight, for what is not stored
        turned = (cos * ox - sin * oy) / radius, (sin * ox + cos * oy) / radius
        columns = (*turned, name / kind_scale, cos * dx - sin * dy, sin * dx + cos * dy)
        for column, values in enumerate(columns):
            plgpu.store(features.at[place, column], values, mask=kept)
        return start + GATHER, before + jnp.sum(hit.astype(jnp.int32))

    _, hits = jax.lax.while_loop(lambda carry: (carry[0] < end) & (carry[1] < count), block, (begin, jnp.int32(0)))

    def fill(block, _):
        place = block * GATHER + steps
        there = place < count
        empty = there & (place >= hits)
        plgpu.store(mask.at[place], (place < hits).astype(jnp.int8), mask=there)
        for column in range(5):
            plgpu.store(features.at[place, column], jnp.zeros(GATHER, jnp.float32), mask=empty)
        return _

    jax.lax.fori_loop(0, pl.cdiv(count, GATHER), fill, 0)


def _flags(road: Road) -> Int[Array, " P"]:
    return road.valid.astype(jnp.int8)


def _seen(valid, at, limit):
    return plgpu.load(valid.at[at], mask=at < limit, other=0) != 0


def _pair(table, at, mask):
    """Both columns of a table of planar vectors at some rows."""
    return plgpu.load(table.at[at, 0], mask=mask, other=0.0), plgpu.load(table.at[at, 1], mask=mask, other=0.0)
