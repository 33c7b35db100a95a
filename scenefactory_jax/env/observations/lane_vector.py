"""The nearest lane, its edges and its course ahead as a vector."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import (
    CONTIGUOUS_M,
    cover_with_circles,
    cross,
    cumulative_length,
    dot,
    find_point_at_distance,
    heading_vector,
    to_frame,
)
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.observations.column_bounds import FRACTION, SIGNED, bound_observation, compress_length
from scenefactory_jax.roadgraph import queries


@bound_observation(SIGNED, SIGNED, SIGNED, SIGNED, FRACTION, SIGNED)
def lane(
    scene: Scene,
    state: State,
    *,
    ahead_m: list[float],
    distance_scale_m: Positive,
    offset_scale_m: Positive,
    gap_scale_m: Positive,
    time_scale_s: Positive,
    edge_half_width_m: NonNegative,
    edge_radius_m: NonNegative,
    edge_range_m: Positive,
    circles: dict[str, float],
    kernels: bool,
) -> Float[Array, "A F"]:
    """Course of the nearest lane, further ahead than the road segments show.

    Columns: offset to the lane's left; sine and cosine of the car's heading relative to the lane's direction; clearance to the nearest road
    edge; time to the edge ahead, as T / (T + time); then x, y in the car's frame of the points at `ahead_m` along the lane, in the lane's
    direction for a car that points along it and against it for one that does not; beyond the lane's end its last point is repeated. Lengths
    read l / (scale + |l|). Zeros in a world without lanes.
    """
    motion, position = state.motion, state.motion.position[:, :2]
    centres, radius = cover_with_circles(position, motion.yaw, state.agents.size, **circles)
    edges = {"half_width_m": edge_half_width_m, "range_m": edge_range_m, "kernels": kernels}
    nearest = queries.query_road(scene, centres, radius, motion.velocity[:, :2], motion.yaw, position, state.active, **edges)
    lanes, row = scene.lanes, nearest.lane
    direction, offset = lanes.direction[row], position - lanes.midpoint[row]
    facing = heading_vector(motion.yaw)
    with_lane = dot(facing, direction)
    sign = jnp.where(with_lane >= 0, 1.0, -1.0)
    running = cumulative_length(lanes)
    along, further = dot(offset, direction), sign[:, None] * jnp.array(ahead_m)
    points, _, line, arc = find_point_at_distance(lanes, running, (running[row] - lanes.half_length[row] + along)[:, None] + further)
    unbroken = jnp.abs(arc - (lanes.arc[row] + along)[:, None] - further) < CONTIGUOUS_M
    points = _repeat_last(points, unbroken & (line == lanes.polyline[row][:, None]))
    points = to_frame(points - position[:, None], motion.yaw[:, None])
    edge = compress_length(nearest.edge - edge_radius_m, gap_scale_m)
    columns = [
        jnp.stack([compress_length(cross(direction, offset), offset_scale_m), cross(direction, facing), with_lane], axis=1),
        jnp.stack([edge, time_scale_s / (time_scale_s + nearest.edge_ttc)], axis=1),
        compress_length(points, distance_scale_m).reshape(len(row), -1),
    ]
    return jnp.where(jnp.any(lanes.valid), jnp.concatenate(columns, axis=1), 0.0)


def _repeat_last(points: Float[Array, "A N 2"], on_lane: Bool[Array, "A N"]) -> Float[Array, "A N 2"]:
    """Replaces points beyond the lane's end by the last one before it, or by the first of all."""
    last = jnp.maximum(jnp.sum(jnp.cumprod(on_lane, axis=1), axis=1) - 1, 0)
    return jnp.take_along_axis(points, jnp.minimum(jnp.arange(points.shape[1]), last[:, None])[..., None], axis=1)
