"""The lanes of a scene as one graph of arrays: what leads where, what lies beside what, and where on which lane a point is."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.core.types import DRIVABLE

Pairs = Int[np.ndarray, "E 2"]  # rows of lanes, from and to


class LaneGraph(NamedTuple):
    """Lanes for cars with at least two different points. Rows are places in `id`; all lengths are in the plane."""

    id: Int[np.ndarray, " N"]
    length: Float[np.ndarray, " N"]
    successor: Pairs
    left: Pairs
    right: Pairs
    first: Int[np.ndarray, " M"]  # row of each lane's first vertex, and the number of vertices: M = N + 1
    xyz: Float[np.ndarray, "V 3"]  # vertices, lane after lane
    arc: Float[np.ndarray, " V"]  # length along the lane up to each vertex


class LaneProjections(NamedTuple):
    """Where points lie on lanes: a row for every point and every lane near it."""

    point: Int[np.ndarray, " K"]
    lane: Int[np.ndarray, " K"]
    arc: Float[np.ndarray, " K"]
    distance: Float[np.ndarray, " K"]
    xyz: Float[np.ndarray, "K 3"]  # the place on the lane
    direction: Float[np.ndarray, "K 2"]


def make(roads: Sequence[Polyline]) -> LaneGraph:
    """The lanes for cars of a map; links to lanes that are not there lead nowhere and are left out."""
    found = []
    for line in roads:
        if line.kind in DRIVABLE:
            new = np.concatenate([[True], np.diff(line.xyz[:, :2], axis=0).any(axis=1)])[: len(line.xyz)]
            if new.sum() > 1:
                found.append((line, line.xyz[new]))
    row = {line.id: number for number, (line, _) in enumerate(found)}
    first = np.cumsum([0, *(len(xyz) for _, xyz in found)])
    xyz = np.concatenate([np.zeros((0, 3)), *(xyz for _, xyz in found)])
    step = np.zeros(len(xyz))
    step[1:] = np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1)
    step[first[:-1]] = 0.0
    total = np.cumsum(step)
    arc = total - np.repeat(total[first[:-1]], np.diff(first))
    return LaneGraph(
        id=np.array([line.id for line, _ in found], int),
        length=arc[first[1:] - 1],
        successor=_pairs(found, row, "exit"),
        left=_pairs(found, row, "left"),
        right=_pairs(found, row, "right"),
        first=first,
        xyz=xyz,
        arc=arc,
    )


def _pairs(found: list[tuple[Polyline, np.ndarray]], row: dict[int, int], relation: str) -> Pairs:
    """Rows of the lanes that stand in a relation."""
    pairs = [(row[line.id], row[other]) for line, _ in found for other in getattr(line, relation) if other in row]
    return np.array(pairs, int).reshape(-1, 2)


def point_at(
    lanes: LaneGraph, lane: Int[np.ndarray, " K"], arc: Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, "K 2"]]:
    """Points and unit directions at lengths along lanes; beyond an end, the end."""
    before = lanes.first[lane]
    arc = np.clip(arc, 0.0, lanes.length[lane])
    # arcs made rising over all lanes, so that one search finds the segment of every point
    shift = np.concatenate([[0.0], np.cumsum(lanes.length + 1.0)])[:-1]
    rising = lanes.arc + np.repeat(shift, np.diff(lanes.first))
    segment = np.searchsorted(rising, arc + shift[lane], side="right") - 1
    segment = np.clip(segment, before, lanes.first[lane + 1] - 2)
    step = lanes.arc[segment + 1] - lanes.arc[segment]
    share = ((arc - lanes.arc[segment]) / step)[:, None]
    along = lanes.xyz[segment + 1] - lanes.xyz[segment]
    return lanes.xyz[segment] + share * along, along[:, :2] / step[:, None]


def project(lanes: LaneGraph, points: Float[np.ndarray, "P 3"], *, within_m: float) -> LaneProjections:
    """The nearest place on every lane that comes within a distance of a point, in the plane."""
    shapes = lane_shapes(lanes)
    spots = _spots(points)
    point, lane = shapely.STRtree(shapes).query(spots, predicate="dwithin", distance=within_m)
    return _place(lanes, points, shapes, spots, point, lane)


def project_on(lanes: LaneGraph, points: Float[np.ndarray, "P 3"], lane: Int[np.ndarray, " P"]) -> LaneProjections:
    """The nearest place on a given lane for each point, however far, in the plane."""
    return _place(lanes, points, lane_shapes(lanes), _spots(points), np.arange(len(points)), lane)


def _place(
    lanes: LaneGraph, points: np.ndarray, shapes: np.ndarray, spots: np.ndarray, point: np.ndarray, lane: np.ndarray
) -> LaneProjections:
    """The nearest places of chosen points on chosen lanes."""
    arc = shapely.line_locate_point(shapes[lane], spots[point])
    xyz, direction = point_at(lanes, lane, arc)
    distance = np.linalg.norm(points[point, :2] - xyz[:, :2], axis=1)
    return LaneProjections(point=point, lane=lane, arc=arc, distance=distance, xyz=xyz, direction=direction)


def _spots(points: Float[np.ndarray, "P 3"]) -> np.ndarray:
    """Points of the plane as shapely's."""
    return np.asarray(shapely.points(points[:, :2]), object)


def lane_shapes(lanes: LaneGraph) -> np.ndarray:
    """The lanes as shapely's lines."""
    owner = np.repeat(np.arange(len(lanes.id)), np.diff(lanes.first))
    return np.asarray(shapely.linestrings(lanes.xyz[:, :2], indices=owner), object)
