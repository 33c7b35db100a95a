"""Roadgraph queries per agent: nearest lane, distance and time to collision of road edges, segments within a radius.

Plain JAX. On NVIDIA GPUs the kernels of `road_kernels` compute the same; derivatives, of either mode, are those of plain JAX everywhere.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import (
    SMALLEST,
    cross,
    dot,
    find_smallest,
    heading_vector,
    safe_sqrt,
    squared_distances,
    take_largest,
    take_smallest,
    to_frame,
)
from scenefactory_jax.core.pallas import dispatch
from scenefactory_jax.core.types import Road, Scene, SetObservation, SpatialGrid
from scenefactory_jax.roadgraph import road_kernels, spatial_grid


class RoadQuery(NamedTuple):
    """Result of `query_road`, an entry per agent."""

    lane: Int[Array, " A"]  # row of the lane segment whose midpoint is nearest; 0 in a world without lanes
    edge: Float[Array, " A"]  # distance of the nearest edge from the centres of the agent's circles, m; inf without edges
    edge_ttc: Float[Array, " A"]  # s; inf if no edge is approached


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
    """Queries the lanes and edges of the scene. Results of agents that are not active are undefined."""

    def plain(lanes: Road, edges: Road, circles: Array, radius: Array, velocity: Array, heading: Array, position: Array, _: Array):
        squared = squared_edge_distance(circles, edges, half_width_m=half_width_m)
        return nearest_lane(position, lanes), squared, edge_rate(circles, radius, velocity, heading, edges, range_m=range_m)

    kernel = functools.partial(road_kernels.query_road_blocks, half_width_m=half_width_m, range_m=range_m)
    operands = (scene.lanes, scene.edges, circles, radius, velocity, heading_vector(yaw), position, active)
    lane, squared, rate = dispatch(kernel, plain, *operands) if kernels else plain(*operands)
    approaches = rate > 0
    return RoadQuery(lane, safe_sqrt(squared), jnp.where(approaches, 1.0 / jnp.where(approaches, rate, 1.0), jnp.inf))


def nearest_lane(position: Float[Array, "A 2"], lanes: Road) -> Int[Array, " A"]:
    """Row of the valid segment whose midpoint is nearest; of equal distances the first in storage order."""
    return find_smallest(jnp.where(lanes.valid, squared_distances(position, lanes.midpoint), jnp.inf))


def squared_edge_distance(circles: Float[Array, "A C 2"], edges: Road, *, half_width_m: float) -> Float[Array, " A"]:
    """Smallest squared distance between the circles' centres of each agent and the valid segments, as rectangles."""
    distances = [squared_segment_distance(circles[:, index], edges, half_width_m=half_width_m) for index in range(circles.shape[1])]
    return take_smallest(jnp.where(edges.valid, functools.reduce(jnp.minimum, distances), jnp.inf))


def squared_segment_distance(point: Float[Array, "A 2"], segments: Road, *, half_width_m: float) -> Float[Array, "A P"]:
    """Squared distance of each point from each segment, valid or not, as a rectangle of that half width; 0 inside."""
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
    """Largest 1 / TTC (1/s) with the midpoints of edges ahead and within a range, by closing speed along the line of sight; 0: none.

    One root and one division per circle and segment; the loop over circles is unrolled, so that a segment is read once for all.
    """

    def rate(centre: Float[Array, "A 2"]) -> Float[Array, "A P"]:
        offset = edges.midpoint - centre[:, None]
        squared = dot(offset, offset)
        inverse = jax.lax.rsqrt(jnp.maximum(squared, SMALLEST**2))
        distance, closing = squared * inverse, dot(offset, velocity[:, None]) * inverse
        gap = distance - radius[:, None]
        ahead = edges.valid & (distance <= range_m) & (dot(offset, heading[:, None]) > 0)
        touches = gap <= 0
        inverse_ttc = jnp.where(touches, jnp.inf, closing / jnp.where(touches, 1.0, gap))
        return jnp.where(ahead & (touches | (closing > SMALLEST)), inverse_ttc, 0.0)

    rates = functools.reduce(jnp.maximum, [rate(circles[:, index]) for index in range(circles.shape[1])])
    return jnp.maximum(take_largest(rates), 0.0)


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
    """Segments whose midpoints lie within a radius, the first `count` in storage order: x, y, kind, direction x, y in the agent's frame.

    A grid of at least that radius is used where the scene has one; the result is the same. Agents that are not active get no segments.
    """
    if scene.road_grid is None or scene.road_grid.radius_m < radius_m:
        offset = position[:, None, :] - scene.road.midpoint
        found = find_first_true(active[:, None] & scene.road.valid & (dot(offset, offset) <= radius_m**2), count=count)
        return _segment_features(scene.road, *found, position, yaw, radius_m=radius_m, kind_scale=kind_scale)

    def plain(road: Road, grid: SpatialGrid, first: Array, last: Array, position: Array, yaw: Array):
        row, listed = spatial_grid.list_segments(grid, first, last)
        offset = position[:, None, :] - road.midpoint[row]
        place, mask = find_first_true(listed & (dot(offset, offset) <= radius_m**2), count=count)
        index = jnp.where(mask, jnp.take_along_axis(row, place, axis=1), 0)
        found = _segment_features(road, index, mask, position, yaw, radius_m=radius_m, kind_scale=kind_scale)
        return found.features, found.mask

    def kernel(road: Road, grid: SpatialGrid, first: Array, last: Array, position: Array, yaw: Array):
        return road_kernels.gather_segment_blocks(
            road, grid, first, last, position, heading_vector(-yaw), count=count, radius_m=radius_m, kind_scale=kind_scale
        )

    first, last = spatial_grid.find_cell_bounds(scene.road_grid, position)
    operands = (scene.road, scene.road_grid, first, jnp.where(active, last, first), position, yaw)
    return SetObservation(*(dispatch(kernel, plain, *operands) if kernels else plain(*operands)))


def _segment_features(
    road: Road, index: Int[Array, "A K"], mask: Bool[Array, "A K"], position: Array, yaw: Array, *, radius_m: float, kind_scale: float
) -> SetObservation:
    """Features of segments; zeros where the mask is false."""
    frame = yaw[:, None]
    place = to_frame(road.midpoint[index] - position[:, None, :], frame) / radius_m
    kind = road.kind[index][..., None].astype(jnp.float32) / kind_scale
    features = jnp.concatenate([place, kind, to_frame(road.direction[index], frame)], axis=-1)
    return SetObservation(jnp.where(mask[..., None], features, 0.0), mask)


def find_first_true(flags: Bool[Array, "A P"], *, count: int) -> tuple[Int[Array, "A {count}"], Bool[Array, "A {count}"]]:
    """Columns of the first `count` true entries of each row, in order, and a mask of those that exist.

    The k-th is the first column whose running count reaches k, so a binary search finds it: no sort and no scatter.
    """
    running = jnp.cumsum(flags, axis=1, dtype=jnp.int32)
    ranks = jnp.arange(1, count + 1, dtype=jnp.int32)
    index = jax.vmap(lambda row: jnp.searchsorted(row, ranks, method="scan_unrolled"))(running)
    mask = ranks <= running[:, -1:]
    return jnp.where(mask, index, 0), mask
