"""What cars ask the road: the nearest lane, how far its edges are and how soon they are reached, which segments lie around.

Plain JAX here; on NVIDIA GPUs the same as kernels (`road_kernel`), which look at no more than there is. Derivatives, of either mode, are
those of plain JAX everywhere.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import SMALLEST, cross, dot, heading_vector, safe_sqrt, to_frame
from scenefactory_jax.core.pallas import on_gpu
from scenefactory_jax.core.types import Road, Scene, SetObservation
from scenefactory_jax.roadgraph import road_kernels, spatial_grid


class RoadQuery(NamedTuple):
    """What `look` finds."""

    lane: Int[Array, " A"]  # row of the lane segment whose midpoint is nearest; 0 in a world without lanes
    edge: Float[Array, " A"]  # distance of the nearest edge from the car's circles' centres, m; inf without any
    edge_ttc: Float[Array, " A"]  # s; inf if no edge is met


def query_road(
    scene: Scene,
    circles: Float[Array, "A C 2"],
    radius: Float[Array, " A"],
    velocity: Float[Array, "A 2"],
    yaw: Float[Array, " A"],
    position: Float[Array, "A 2"],
    active: Bool[Array, " A"],
    *,
    half_width_m: float,
    range_m: float,
    kernels: bool,
) -> RoadQuery:
    """Lanes and edges of the whole world as each car meets them; what is said of cars that are not active means nothing."""

    def plain(lanes: Road, edges: Road, circles: Array, radius: Array, velocity: Array, ahead: Array, position: Array, _: Array):
        squared = squared_edge_distance(circles, edges, half_width_m=half_width_m)
        return nearest_lane(position, lanes), squared, edge_rate(circles, radius, velocity, ahead, edges, range_m=range_m)

    quick = functools.partial(road_kernels.query_road_blocks, half_width_m=half_width_m, range_m=range_m)
    given = (scene.lanes, scene.edges, circles, radius, velocity, heading_vector(yaw), position, active)
    lane, squared, rate = _answer(quick, plain, *given) if kernels else plain(*given)
    meets = rate > 0
    return RoadQuery(lane, safe_sqrt(squared), jnp.where(meets, 1.0 / jnp.where(meets, rate, 1.0), jnp.inf))


def nearest_lane(position: Float[Array, "A 2"], lanes: Road) -> Int[Array, " A"]:
    """Row of the valid segment whose midpoint is nearest. Ties go to the first in storage order."""
    offset = position[:, None, :] - lanes.midpoint
    return jnp.argmin(jnp.where(lanes.valid, dot(offset, offset), jnp.inf), axis=1).astype(jnp.int32)


def squared_edge_distance(circles: Float[Array, "A C 2"], edges: Road, *, half_width_m: float) -> Float[Array, " A"]:
    """Squared distance from the nearest of each car's circles' centres to the rectangles that valid segments with a half width are."""
    each = [squared_segment_distance(circles[:, number], edges, half_width_m=half_width_m) for number in range(circles.shape[1])]
    nearest = functools.reduce(jnp.minimum, each)
    return jnp.min(jnp.where(edges.valid, nearest, jnp.inf), axis=1, initial=jnp.inf)


def squared_segment_distance(point: Float[Array, "A 2"], segments: Road, *, half_width_m: float) -> Float[Array, "A P"]:
    """Squared distance of each point from the rectangle that each segment with a half width is, valid or not; 0 inside."""
    offset = point[:, None] - segments.midpoint
    along = jnp.maximum(jnp.abs(dot(offset, segments.direction)) - segments.half_length, 0.0)
    across = jnp.maximum(jnp.abs(cross(offset, segments.direction)) - half_width_m, 0.0)
    return along * along + across * across


def edge_rate(
    circles: Float[Array, "A C 2"],
    radius: Float[Array, " A"],
    velocity: Float[Array, "A 2"],
    heading: Float[Array, "A 2"],
    edges: Road,
    *,
    range_m: float,
) -> Float[Array, " A"]:
    """Largest 1 / TTC (1/s) with the midpoints of edges ahead and within a range, by closing speed along the line of sight; 0 for none.

    There are many of them: one root and one division each, and the circles are written out, so that a segment is read once for all.
    """
    ahead, moves = heading[:, None], velocity[:, None]

    def rate(circle: Float[Array, "A 2"]) -> Float[Array, "A P"]:
        apart = edges.midpoint - circle[:, None]
        squared = dot(apart, apart)
        inverse = jax.lax.rsqrt(jnp.maximum(squared, SMALLEST**2))
        distance, closing = squared * inverse, dot(apart, moves) * inverse
        gap = distance - radius[:, None]
        seen = edges.valid & (distance <= range_m) & (dot(apart, ahead) > 0)
        touches = gap <= 0
        soon = jnp.where(touches, jnp.inf, closing / jnp.where(touches, 1.0, gap))
        return jnp.where(seen & (touches | (closing > SMALLEST)), soon, 0.0)

    rates = functools.reduce(jnp.maximum, [rate(circles[:, number]) for number in range(circles.shape[1])])
    return jnp.max(rates, axis=1, initial=0.0)


def gather_segments(
    scene: Scene,
    position: Float[Array, "A 2"],
    yaw: Float[Array, " A"],
    active: Bool[Array, " A"],
    *,
    count: int,
    radius_m: float,
    kind_scale: float,
    kernels: bool,
) -> SetObservation:
    """Segments whose midpoints lie within a radius, the first `count` in storage order: x, y, kind, direction x, y in the car's frame.

    A scene with cells of at least that radius is looked up there, with the same result. Cars that are not active see nothing.
    """
    if scene.road_grid is None or scene.road_grid.radius_m < radius_m:
        offset = position[:, None, :] - scene.road.midpoint
        found = first_edge_hits(active[:, None] & scene.road.valid & (dot(offset, offset) <= radius_m**2), count=count)
        return _rows(scene.road, *found, position, yaw, radius_m=radius_m, kind_scale=kind_scale)

    def plain(road: Road, grid: spatial_grid.SpatialGrid, first: Array, last: Array, position: Array, yaw: Array):
        row, listed = spatial_grid.list_segments(grid, first, last)
        offset = position[:, None, :] - road.midpoint[row]
        place, mask = first_edge_hits(listed & (dot(offset, offset) <= radius_m**2), count=count)
        index = jnp.where(mask, jnp.take_along_axis(row, place, axis=1), 0)
        found = _rows(road, index, mask, position, yaw, radius_m=radius_m, kind_scale=kind_scale)
        return found.features, found.mask

    def quick(road: Road, grid: spatial_grid.SpatialGrid, first: Array, last: Array, position: Array, yaw: Array):
        return road_kernels.gather_segment_blocks(
            road, grid, first, last, position, heading_vector(-yaw), count=count, radius_m=radius_m, kind_scale=kind_scale
        )

    first, last = spatial_grid.find_cell_bounds(scene.road_grid, position)
    given = (scene.road, scene.road_grid, first, jnp.where(active, last, first), position, yaw)
    return SetObservation(*(_answer(quick, plain, *given) if kernels else plain(*given)))


def _rows(
    road: Road, index: Int[Array, "A K"], mask: Bool[Array, "A K"], position: Array, yaw: Array, *, radius_m: float, kind_scale: float
) -> SetObservation:
    """Features of segments; zeros where there is none."""
    frame = yaw[:, None]
    place = to_frame(road.midpoint[index] - position[:, None, :], frame) / radius_m
    kind = road.kind[index][..., None].astype(jnp.float32) / kind_scale
    features = jnp.concatenate([place, kind, to_frame(road.direction[index], frame)], axis=-1)
    return SetObservation(jnp.where(mask[..., None], features, 0.0), mask)


def first_edge_hits(hits: Bool[Array, "A P"], *, count: int) -> tuple[Int[Array, "A {count}"], Bool[Array, "A {count}"]]:
    """Columns of the first `count` true entries of each row, in order, and which of them exist.

    The k-th hit is the first column whose running number of hits reaches k, so a binary search finds it: no sort and no scatter.
    """
    running = jnp.cumsum(hits, axis=1, dtype=jnp.int32)
    wanted = jnp.arange(1, count + 1, dtype=jnp.int32)
    index = jax.vmap(lambda row: jnp.searchsorted(row, wanted, method="scan_unrolled"))(running)
    mask = wanted <= running[:, -1:]
    return jnp.where(mask, index, 0), mask


def _answer(quick: Callable, plain: Callable, *arguments: Any) -> Any:
    """The kernel on NVIDIA GPUs and plain JAX elsewhere, with the derivative of plain JAX."""

    @jax.custom_jvp
    def answer(*arguments: Any) -> Any:
        return on_gpu(quick, plain, *arguments)

    @answer.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple:
        return jax.jvp(plain, primals, tangents)

    return answer(*arguments)
