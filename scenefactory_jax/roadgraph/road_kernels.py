"""Triton kernels, through Pallas, of the roadgraph queries; `queries` has the same in plain JAX.

One program computes one agent's result in a loop over blocks of segments. It stops at the last valid segment, and reads none for an agent
that is not active; plain JAX reads every row of the padded tables, once per query.
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

QUERY_BLOCK, GATHER_BLOCK = 128, 128  # segments of a block; the fastest of 20 settings on an H200
WARPS = 4


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

    Agents that are not active get the result of a world without a road.
    """
    agents, count = circles.shape[:2]
    numbers = jnp.concatenate([circles.reshape(agents, -1), radius[:, None], velocity, heading, position], axis=1)
    limits = jnp.where(active[:, None], jnp.stack([pallas.block_of(lanes.valid), pallas.block_of(edges.valid)]), 0)
    tables = (lanes.midpoint, lanes.valid.astype(jnp.int8), edges.midpoint, edges.direction, edges.half_length)
    tables = (*tables, edges.valid.astype(jnp.int8))
    shapes = [jax.ShapeDtypeStruct((agents, 1), kind) for kind in (jnp.int32, jnp.float32, jnp.float32)]
    kernel = functools.partial(_query, circles=count, half_width=half_width_m, range_m=range_m)
    row, squared, rate = (found[:, 0] for found in _call(kernel, "query_road", limits, numbers, tables, shapes, interpret))
    return row, squared, rate


def _query(limits, numbers, lane, lane_valid, edge, along, half, edge_valid, row, squared, rate, *, circles: int, half_width, range_m):
    steps = jnp.arange(QUERY_BLOCK, dtype=jnp.int32)
    centres = [(numbers[2 * c], numbers[2 * c + 1]) for c in range(circles)]
    radius, vx, vy, hx, hy, px, py = (numbers[2 * circles + place] for place in range(7))

    def nearest(block, best):
        at = block * QUERY_BLOCK + steps
        mask = _is_valid(lane_valid, at, limits[0])
        x, y = _pair(lane, at, mask)
        distance = jnp.where(mask, (px - x) * (px - x) + (py - y) * (py - y), jnp.inf)
        closer = distance < best[0]
        return jnp.where(closer, distance, best[0]), jnp.where(closer, at, best[1])

    def edges(block, best):
        squared, rate = best
        at = block * QUERY_BLOCK + steps
        mask = _is_valid(edge_valid, at, limits[1])
        (x, y), (dx, dy) = _pair(edge, at, mask), _pair(along, at, mask)
        length = plgpu.load(half.at[at], mask=mask, other=0.0)
        for cx, cy in centres:
            ox, oy = x - cx, y - cy
            beyond = jnp.maximum(jnp.abs(ox * dx + oy * dy) - length, 0.0)
            across = jnp.maximum(jnp.abs(ox * dy - oy * dx) - half_width, 0.0)
            squared = jnp.minimum(squared, jnp.where(mask, beyond * beyond + across * across, jnp.inf))
            offset = ox * ox + oy * oy
            inverse = jax.lax.rsqrt(jnp.maximum(offset, SMALLEST * SMALLEST))
            distance, closing = offset * inverse, (ox * vx + oy * vy) * inverse
            gap = distance - radius
            touches = gap <= 0.0
            inverse_ttc = jnp.where(touches, jnp.inf, closing / jnp.where(touches, 1.0, gap))
            ahead = mask & (distance <= range_m) & (ox * hx + oy * hy > 0.0) & (touches | (closing > SMALLEST))
            rate = jnp.maximum(rate, jnp.where(ahead, inverse_ttc, 0.0))
        return squared, rate

    infinity, zero = jnp.full(QUERY_BLOCK, jnp.inf, jnp.float32), jnp.zeros(QUERY_BLOCK, jnp.float32)
    first = (infinity, jnp.zeros(QUERY_BLOCK, jnp.int32))
    distance, number = jax.lax.fori_loop(0, pl.cdiv(limits[0], QUERY_BLOCK), nearest, first)
    squares, rates = jax.lax.fori_loop(0, pl.cdiv(limits[1], QUERY_BLOCK), edges, (infinity, zero))
    smallest = jnp.min(distance)
    lowest = jnp.min(jnp.where(distance == smallest, number, jnp.iinfo(jnp.int32).max))  # of lanes at one distance the first
    row[0] = jnp.where(jnp.isinf(smallest), 0, lowest)
    squared[0] = jnp.min(squares)
    rate[0] = jnp.max(rates)


def gather_segment_blocks(
    road: Road,
    grid: SpatialGrid,
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
    """Features of the first `count` segments within a radius, out of each agent's list in the grid, and a mask of those that exist.

    Args:
        first, last: bounds of an agent's list in `grid.rows`.
        frame: cosine and sine of the rotation from the world's frame into the agent's.
    """
    limits, numbers = jnp.stack([first, last], axis=1), jnp.concatenate([position, frame], axis=1)
    tables = (grid.rows, road.midpoint, road.direction, road.kind)
    shapes = [jax.ShapeDtypeStruct((len(position), count, 5), jnp.float32), jax.ShapeDtypeStruct((len(position), count), jnp.int8)]
    kernel = functools.partial(_gather, count=count, radius=radius_m, kind_scale=kind_scale)
    features, mask = _call(kernel, "gather_segments", limits, numbers, tables, shapes, interpret)
    return features, mask != 0


def _gather(limits, numbers, rows, midpoint, direction, kind, features, mask, *, count: int, radius: float, kind_scale: float):
    steps = jnp.arange(GATHER_BLOCK, dtype=jnp.int32)
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
        element = plgpu.load(kind.at[row], mask=kept, other=0).astype(jnp.float32)
        place = jnp.where(kept, number - 1, count + steps)  # distinct places out of range for what is not stored
        turned = (cos * ox - sin * oy) / radius, (sin * ox + cos * oy) / radius
        columns = (*turned, element / kind_scale, cos * dx - sin * dy, sin * dx + cos * dy)
        for column, values in enumerate(columns):
            plgpu.store(features.at[place, column], values, mask=kept)
        return start + GATHER_BLOCK, before + jnp.sum(hit.astype(jnp.int32))

    _, hits = jax.lax.while_loop(lambda carry: (carry[0] < end) & (carry[1] < count), block, (begin, jnp.int32(0)))

    def fill(block, _):
        place = block * GATHER_BLOCK + steps
        inside = place < count
        plgpu.store(mask.at[place], (place < hits).astype(jnp.int8), mask=inside)
        for column in range(5):
            plgpu.store(features.at[place, column], jnp.zeros(GATHER_BLOCK, jnp.float32), mask=inside & (place >= hits))
        return _

    jax.lax.fori_loop(0, pl.cdiv(count, GATHER_BLOCK), fill, 0)


def _call(kernel, name: str, limits: Array, numbers: Array, tables: tuple[Array, ...], shapes: list, interpret: bool):
    """Runs a kernel with one program per agent: its own row of limits, numbers and outputs, and all of every table."""
    return pl.pallas_call(
        kernel,
        grid=(len(numbers),),
        in_specs=[pallas.row(limits), pallas.row(numbers), *map(pallas.whole, tables)],
        out_specs=[pallas.row(shape) for shape in shapes],
        out_shape=shapes,
        compiler_params=plgpu.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
        name=name,
    )(limits, numbers, *tables)


def _is_valid(valid, at, limit):
    return plgpu.load(valid.at[at], mask=at < limit, other=0) != 0


def _pair(table, at, mask):
    """Both columns of a table of planar vectors at some rows."""
    return plgpu.load(table.at[at, 0], mask=mask, other=0.0), plgpu.load(table.at[at, 1], mask=mask, other=0.0)
