"""Map features of the Waymo Open Sim Agents Challenge (WOSAC, arXiv:2305.12032): distance to the road edge, red-light violations.

Definitions are those of the challenge's published code (waymo-open-dataset), except that the distance to a lane is the true one there.
Functions are for one rollout of one scene; `jax.vmap` adds rollouts and scenes. The search for the nearest segment is a loop over segments
that keeps the best of each point, so that no array of points times segments exists.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import compute_corners
from scenefactory_jax.core.geometry import cross, dot, safe_norm

HEIGHT_SCALE = 3.0  # by which heights are stretched in the search for the nearest segment
CYCLIC_M = 1.0  # a line whose ends are nearer than this is closed
RED_LIGHTS = (1, 4)  # of LIGHT_STATES: arrow_stop, stop; a flashing light is none
UNROLLED = 16  # segments a turn of the search's loop: fewer and larger kernels


class Lines(NamedTuple):
    """Points of polylines, line after line; padding is at the end."""

    position: Float[Array, "P 3"]
    line: Int[Array, " P"]  # which line a point is of: for lanes their ids, as in `Lights.lane`
    valid: Bool[Array, " P"]


class Lights(NamedTuple):
    """Traffic lights of a scene: a row for each lane that has one. State 0 where there is none, as in padding."""

    lane: Int[Array, " L"]
    state: Int[Array, "T L"]  # index into LIGHT_STATES, at all steps of the objects
    stop: Float[Array, "L 3"]  # where cars stop


class Segments(NamedTuple):
    """Segments of polylines; segment i begins at point i, and is invalid at the last point of a line."""

    start: Float[Array, "P 3"]
    along: Float[Array, "P 3"]  # from its start to its end
    valid: Bool[Array, " P"]
    line: Int[Array, " P"]


class RoadMap(NamedTuple):
    """What map features read. Road edges have the road on their left; lanes are those of surface streets alone."""

    edges: Lines
    lanes: Lines
    lights: Lights


def make_segments(lines: Lines) -> Segments:
    """Joins neighbouring points of lines by segments."""
    following = jax.tree.map(lambda column: jnp.roll(column, -1, axis=0), lines)
    last = jnp.arange(len(lines.valid)) == len(lines.valid) - 1
    valid = lines.valid & following.valid & (lines.line == following.line) & ~last
    along = jnp.where(valid[:, None], following.position - lines.position, 0.0)
    return Segments(lines.position, along, valid, lines.line)


def project_on_segment(point: Float[Array, "*n 3"], start: Float[Array, "*m 3"], along: Float[Array, "*m 3"]) -> Float[Array, "*k"]:
    """Computes where, in the plane, points lie along a segment: 0 at its start, 1 at its end; 0 for a segment of no length."""
    squared = dot(along[..., :2], along[..., :2])
    return dot((point - start)[..., :2], along[..., :2]) / jnp.where(squared > 0, squared, 1.0)


def find_nearest_segments(point: Float[Array, "*n 3"], segments: Segments, *, last: bool = False) -> Int[Array, "*n"]:
    """Finds the valid segments that are nearest to points, heights stretched by HEIGHT_SCALE; of equal ones the first, or the `last`."""
    x, y, z = (point[..., axis] for axis in range(3))  # columns apart: loops over contiguous values

    def compare(best: tuple[Array, Array], row: tuple[Segments, Array, Array]) -> tuple[tuple[Array, Array], None]:
        segment, inverse, index = row
        along = segment.along
        apart_x, apart_y, apart_z = x - segment.start[0], y - segment.start[1], z - segment.start[2]
        part = jnp.clip((apart_x * along[0] + apart_y * along[1]) * inverse, 0.0, 1.0)
        apart_z = HEIGHT_SCALE * (apart_z - part * along[2])
        squared = (apart_x - part * along[0]) ** 2 + (apart_y - part * along[1]) ** 2 + apart_z**2
        squared = jnp.where(segment.valid, squared, jnp.inf)
        nearer = (squared <= best[0]) & segment.valid if last else squared < best[0]
        return (jnp.where(nearer, squared, best[0]), jnp.where(nearer, index, best[1])), None

    count = len(segments.valid)
    first = jnp.full(point.shape[:-1], jnp.inf), jnp.zeros(point.shape[:-1], jnp.int32)
    length = dot(segments.along[:, :2], segments.along[:, :2])
    rows = segments, 1 / jnp.where(length > 0, length, 1.0), jnp.arange(count, dtype=jnp.int32)
    (_, nearest), _ = jax.lax.scan(compare, first, rows, unroll=UNROLLED)
    return nearest


def list_neighbours(segments: Segments) -> tuple[Int[Array, " P"], Int[Array, " P"]]:
    """Lists the segments before and after each one on its line; a segment itself where the line ends and is not closed."""
    rows, valid = jnp.arange(len(segments.valid)), segments.valid
    continues = jnp.roll(valid, 1).at[0].set(False) & valid  # the segment before is of the same line: lines are a point apart
    continued = jnp.roll(continues, -1)
    first = jax.lax.cummax(jnp.where(continues, 0, rows))
    last = jax.lax.cummin(jnp.where(continued, len(rows), rows), reverse=True)
    gap = segments.start[last] + segments.along[last] - segments.start[first]
    closed = safe_norm(gap) < CYCLIC_M
    before = jnp.where(continues, rows - 1, jnp.where(closed, last, rows))
    after = jnp.where(continued, rows + 1, jnp.where(closed, first, rows))
    return before, after


def compute_edge_distance(point: Float[Array, "*n 3"], edges: Lines) -> Float[Array, "*n"]:
    """Computes the planar distance to the nearest road-edge segment, positive on its right: off the road. -inf without edges.

    Beyond an end of the segment its side is that of both segments which meet there: the right if any says so where the line turns left,
    the left if any says so where it turns right.
    """
    if len(edges.valid) == 0:
        return jnp.full(point.shape[:-1], -jnp.inf)
    segments = make_segments(edges)
    before, after = list_neighbours(segments)
    nearest = find_nearest_segments(point, segments)
    start, along = segments.start[nearest], segments.along[nearest]

    def find_side(row: Int[Array, "*n"]) -> Float[Array, "*n"]:
        return jnp.sign(cross((point - segments.start[row])[..., :2], segments.along[row][..., :2]))

    def join(row: Int[Array, "*n"], turn: Float[Array, "*n"]) -> Float[Array, "*n"]:
        other = find_side(row)
        return jnp.where(turn > 0, jnp.maximum(side, other), jnp.minimum(side, other))

    side, row_before, row_after = find_side(nearest), before[nearest], after[nearest]
    turn_before = cross(segments.along[row_before][..., :2], along[..., :2])
    turn_after = cross(along[..., :2], segments.along[row_after][..., :2])
    part = project_on_segment(point, start, along)
    sign = jnp.where(part < 0, join(row_before, turn_before), jnp.where(part < 1, side, join(row_after, turn_after)))
    apart = point - start - jnp.clip(part, 0.0, 1.0)[..., None] * along
    return jnp.where(jnp.any(segments.valid), sign * safe_norm(apart[..., :2]), -jnp.inf)


def compute_road_edge_distances(state: Float[Array, "*n 4"], size: Float[Array, "*n 3"], edges: Lines) -> Float[Array, "*n"]:
    """Computes the largest signed distance of the four bottom corners of boxes to road edges, m; above 0 is off the road.

    Args:
        state: x, y, z of the boxes' centres, and yaw.
        size: length, width, height.
    """
    corners = compute_corners(state[..., :2], state[..., 3], size[..., :2])
    bottom = jnp.broadcast_to((state[..., 2] - 0.5 * size[..., 2])[..., None, None], (*corners.shape[:-1], 1))
    return jnp.max(compute_edge_distance(jnp.concatenate([corners, bottom], axis=-1), edges), axis=-1)


def find_light_violations(position: Float[Array, "E T 3"], lanes: Lines, lights: Lights) -> Bool[Array, "E T"]:
    """Finds the steps at which objects pass a red light: the lane nearest to the centre has one now, and the stop point lay ahead at the
    step before and lies behind now, along the segment of that lane nearest to it. None at the first step.

    An object that stands exactly on the stop point has it neither ahead nor behind.
    """
    if lights.lane.shape[0] == 0 or len(lanes.valid) == 0:
        return jnp.zeros(position.shape[:2], bool)
    segments = make_segments(lanes)

    def find_stop_segment(lane: Int[Array, ""], stop: Float[Array, "3"]) -> Float[Array, "2"]:
        own = segments._replace(valid=segments.valid & (segments.line == lane))
        return own.along[find_nearest_segments(stop, own, last=True), :2]  # a stop point may be the end of one and the start of the next

    along = jax.vmap(find_stop_segment)(lights.lane, lights.stop)
    passed = dot(position[..., None, :2] - lights.stop[:, :2], along)  # [E, T, L]
    crossed = (passed[:, :-1] < 0) & (passed[:, 1:] > 0)
    lane = segments.line[find_nearest_segments(position, segments)]
    red = (lights.state[..., None] == jnp.array(RED_LIGHTS)).any(axis=-1)
    here = red & (lane[..., None] == lights.lane) & jnp.any(segments.valid)
    return jnp.pad(jnp.any(crossed & here[:, 1:], axis=-1), ((0, 0), (1, 0)))
