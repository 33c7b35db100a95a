"""The lanes of a scene as a graph of arrays: successors, neighbours, geometry, and projections of points onto lanes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.core.scene_arrays import join_lines
from scenefactory_jax.core.types import DRIVABLE

LanePairs = Int[np.ndarray, "E 2"]  # rows of lanes, from and to


class LaneGraph(NamedTuple):
    """Lanes for cars with at least two different points. Rows are places in `id`; all lengths are in the plane."""

    id: Int[np.ndarray, " N"]
    length: Float[np.ndarray, " N"]
    successor: LanePairs
    left: LanePairs
    right: LanePairs
    first: Int[np.ndarray, " M"]  # row of each lane's first vertex, and the number of vertices: M = N + 1
    xyz: Float[np.ndarray, "V 3"]  # vertices, lane after lane
    arc: Float[np.ndarray, " V"]  # length along the lane up to each vertex
    shift: Float[np.ndarray, " N"]  # with which lengths increase over all lanes, so that one search finds all segments
    increasing: Float[np.ndarray, " V"]  # `arc` with it


class LaneProjections(NamedTuple):
    """Nearest places on lanes: a row for each pair of a point and a lane."""

    point: Int[np.ndarray, " K"]
    lane: Int[np.ndarray, " K"]
    arc: Float[np.ndarray, " K"]
    distance: Float[np.ndarray, " K"]
    xyz: Float[np.ndarray, "K 3"]  # the place on the lane
    direction: Float[np.ndarray, "K 2"]


def make(roads: Sequence[Polyline]) -> LaneGraph:
    """Builds the graph of the lanes for cars of a map. Links to lanes that are not on the map are left out."""
    joined = join_lines(lines := [line for line in roads if line.kind in DRIVABLE])
    new = np.ones(len(joined.xyz), bool)  # vertices that differ from the one before
    new[1:] = (joined.xyz[1:, :2] != joined.xyz[:-1, :2]).any(axis=1)
    new[joined.bounds[:-1][np.diff(joined.bounds) > 0]] = True
    counts = np.diff(np.concatenate([[0], np.cumsum(new)])[joined.bounds])
    lanes = [line for line, count in zip(lines, counts.tolist(), strict=True) if count > 1]
    row = {line.id: number for number, line in enumerate(lanes)}
    first = np.concatenate([[0], np.cumsum(counts[counts > 1])])
    xyz = joined.xyz[new & np.repeat(counts > 1, np.diff(joined.bounds))]
    step = np.zeros(len(xyz))
    step[1:] = np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1)
    step[first[:-1]] = 0.0
    total = np.cumsum(step)
    arc = total - np.repeat(total[first[:-1]], np.diff(first))

    def links(relation: str) -> LanePairs:
        pairs = [(row[line.id], row[other]) for line in lanes for other in getattr(line, relation) if other in row]
        return np.array(pairs, int).reshape(-1, 2)

    ids, length = np.array([line.id for line in lanes], int), arc[first[1:] - 1]
    shift = np.concatenate([[0.0], np.cumsum(length + 1.0)])[:-1]
    increasing = arc + np.repeat(shift, np.diff(first))
    return LaneGraph(ids, length, links("exit"), links("left"), links("right"), first, xyz, arc, shift, increasing)


def point_at(
    lanes: LaneGraph, lane: Int[np.ndarray, " K"], arc: Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 2"]]:
    """Points and unit directions at lengths along lanes; lengths beyond an end give the end."""
    arc = np.clip(arc, 0.0, lanes.length[lane])
    segment = np.searchsorted(lanes.increasing, arc + lanes.shift[lane], side="right") - 1
    segment = np.clip(segment, lanes.first[lane], lanes.first[lane + 1] - 2)
    step = lanes.arc[segment + 1] - lanes.arc[segment]
    fraction = ((arc - lanes.arc[segment]) / step)[:, None]
    along = lanes.xyz[segment + 1] - lanes.xyz[segment]
    return lanes.xyz[segment] + fraction * along, along[:, :2] / step[:, None]


def project(lanes: LaneGraph, points: Float[np.ndarray, "P 3"], *, within_m: float) -> LaneProjections:
    """Projects points, in the plane, onto every lane within a distance."""
    shapes = lane_shapes(lanes)
    point, lane = shapely.STRtree(shapes).query(shapely.points(points[:, :2]), predicate="dwithin", distance=within_m)
    return project_onto(lanes, points, shapes, point, lane)


def project_onto(
    lanes: LaneGraph, points: Float[np.ndarray, "P 3"], shapes: np.ndarray, point: Int[np.ndarray, " K"], lane: Int[np.ndarray, " K"]
) -> LaneProjections:
    """Projects chosen points, in the plane, onto chosen lanes; `shapes` are the `lane_shapes` of all lanes."""
    arc = shapely.line_locate_point(shapes[lane], shapely.points(points[point, :2]))
    xyz, direction = point_at(lanes, lane, arc)
    distance = np.linalg.norm(points[point, :2] - xyz[:, :2], axis=1)
    return LaneProjections(point=point, lane=lane, arc=arc, distance=distance, xyz=xyz, direction=direction)


def lane_shapes(lanes: LaneGraph) -> np.ndarray:
    """The lanes as shapely's lines."""
    owner = np.repeat(np.arange(len(lanes.id)), np.diff(lanes.first))
    return np.asarray(shapely.linestrings(lanes.xyz[:, :2], indices=owner), object)
