"""Links between lanes inferred from geometry, where the source has none.

The files of GPUDrive, PufferDrive and SceneFactory keep the lanes of the Waymo Open Motion Dataset (WOMD) but drop their links. In WOMD a
lane begins exactly where its predecessor ends. Neighbours follow WOMD's own lists: lanes of one direction, a lane's width apart over some
length, that do not cross; and lanes that diverge from, or merge into, the same lane.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.schema import NonNegative, Positive, Range
from scenefactory_jax.core.types import DRIVABLE
from scenefactory_jax.roadgraph import lane_graph

Relation = Bool[np.ndarray, "N N"]  # [i, j]: lane i is related to lane j


class Ends(NamedTuple):
    """First or last points of lanes and the unit directions there; zero directions for lanes of a single point."""

    xyz: Float[np.ndarray, "N 3"]
    direction: Float[np.ndarray, "N 2"]


class Samples(NamedTuple):
    """Points at even distances along lanes: lane, position, unit direction, and the length that a point represents."""

    lane: Int[np.ndarray, " S"]
    xyz: Float[np.ndarray, "S 3"]
    direction: Float[np.ndarray, "S 2"]
    span: Float[np.ndarray, " S"]


def infer_lane_links(
    raw: RawScene,
    *,
    max_link_gap_m: NonNegative,
    max_link_turn_deg: float,
    max_height_difference_m: float,
    neighbour_distance_m: Range,
    max_neighbour_turn_deg: float,
    min_overlap_m: float,
    sample_spacing_m: Positive,
) -> RawScene:
    """Returns the scene with entries and exits if no lane has any, and with left and right neighbours if no lane has any.

    Only lanes for cars are linked: WOMD links no bicycle lanes. Lanes with inferred links are marked `rebuilt`. A scene whose source has
    both is returned unchanged. The numbers are described in `conf/lanes/base.yaml`.
    """
    order = [index for index, line in enumerate(raw.roads) if line.kind in DRIVABLE and len(line.xyz)]
    lanes = [raw.roads[index] for index in order]
    has_links = any(line.entry or line.exit for line in raw.roads)
    has_neighbours = any(line.left or line.right for line in raw.roads)
    if not lanes or (has_links and has_neighbours):
        return raw
    starts, stops = _ends(lanes, 0, 1), _ends(lanes, -1, -2)
    link = {"gap_m": max_link_gap_m, "turn_deg": max_link_turn_deg, "height_m": max_height_difference_m}
    relations: dict[str, Relation] = {}
    if not has_links:
        exits = _find_meeting_ends(stops, starts, **link)
        relations |= {"exit": exits, "entry": exits.T}
    if not has_neighbours:
        samples = _sample(lanes, sample_spacing_m)
        left = _find_left_branches(starts, stops, samples, **link)
        left |= _find_left_neighbours(
            samples, len(lanes), neighbour_distance_m, max_neighbour_turn_deg, min_overlap_m, max_height_difference_m
        )
        relations |= {"left": left, "right": left.T}
    ids = np.array([lane.id for lane in lanes])
    roads = list(raw.roads)
    for row, index in enumerate(order):
        links = {name: tuple(ids[related[row]].tolist()) for name, related in relations.items()}
        roads[index] = replace(roads[index], rebuilt=True, **links)
    return replace(raw, roads=tuple(roads))


def _ends(lanes: list[Polyline], end: int, inner: int) -> Ends:
    """The points with index `end` of all lanes, and the directions of travel between them and the points with index `inner`."""
    xyz = np.stack([lane.xyz[end] for lane in lanes])
    step = (np.stack([lane.xyz[inner if len(lane.xyz) > 1 else end] for lane in lanes]) - xyz)[:, :2] * (1.0 if end == 0 else -1.0)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return Ends(xyz, np.divide(step, length, out=np.zeros_like(step), where=length > 0))


def _find_meeting_ends(ends: Ends, others: Ends, *, gap_m: float, turn_deg: float, height_m: float) -> Relation:
    """Pairs of different lanes whose ends lie together and have the same direction.

    WOMD cuts lanes down to a point at the rim of its maps. Such a lane has no direction: it meets lanes with one, but not other points.
    """
    near = KDTree(ends.xyz[:, :2]).sparse_distance_matrix(KDTree(others.xyz[:, :2]), gap_m, output_type="ndarray")
    one, other = near["i"], near["j"]
    level = np.abs(ends.xyz[one, 2] - others.xyz[other, 2]) <= height_m
    aligned = np.sum(ends.direction[one] * others.direction[other], axis=1) >= np.cos(np.deg2rad(turn_deg))
    single = ends.direction[one].any(axis=1) != others.direction[other].any(axis=1)
    related = np.zeros((len(ends.xyz), len(others.xyz)), bool)
    related[one, other] = level & (aligned | single) & (one != other)
    return related


def _sample(lanes: list[Polyline], spacing_m: float) -> Samples:
    """The middles of equal pieces of about that length; none on a lane without length."""
    graph = lane_graph.make(lanes)
    row = {lane.id: number for number, lane in enumerate(lanes)}
    count = np.maximum(1, np.round(graph.length / spacing_m)).astype(int)
    owner = np.repeat(np.arange(len(count)), count)
    piece = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    span = (graph.length / count)[owner]
    xyz, direction = lane_graph.point_at(graph, owner, (piece + 0.5) * span)
    return Samples(np.array([row[lane] for lane in graph.id.tolist()], int)[owner], xyz, direction, span)


def _find_left_branches(starts: Ends, stops: Ends, samples: Samples, **link: float) -> Relation:
    """[i, j]: lane j diverges to the left of lane i where both begin, or merges from its left where both end."""
    lanes = len(starts.xyz)
    count = np.bincount(samples.lane, minlength=lanes)
    first = np.cumsum(count) - count
    long = np.outer(count, count) > 0  # single points do not branch
    left = np.zeros((lanes, lanes), bool)
    for ends, backwards in ((starts, False), (stops, True)):
        one, other = np.nonzero(_find_meeting_ends(ends, ends, **link) & long)
        along = (np.minimum(count[one], count[other]) - 1) // 2  # halfway along the shorter lane they are well apart
        here, there = (samples.xyz[first[lane] + (count[lane] - 1 - along if backwards else along), :2] for lane in (one, other))
        ahead, offset = ends.direction[one], there - here
        left[one, other] |= ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0] > 0
    return left


def _find_left_neighbours(
    samples: Samples, lanes: int, distance_m: tuple[float, float], turn_deg: float, overlap_m: float, height_m: float
) -> Relation:
    """[i, j]: lane j is to the left of lane i in the same direction over the overlap, and they come nowhere closer than the range."""
    low, high = distance_m
    lane, xyz, direction, span = samples
    if not len(lane):
        return np.zeros((lanes, lanes), bool)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    tree = KDTree(xyz[:, :2])
    # a lane at the right distance passes through a small circle a lane's width to the left
    radius = np.hypot((high - low) / 2, span.max() / 2)
    circles = KDTree(xyz[:, :2] + (low + high) / 2 * normal)
    pairs = circles.sparse_distance_matrix(tree, radius, output_type="ndarray")
    one, other = pairs["i"], pairs["j"]
    offset = xyz[other] - xyz[one]
    along, across = (np.sum(offset[:, :2] * axis[one], axis=1) for axis in (direction, normal))
    fits = (np.abs(along) <= span[one] / 2) & (across >= low) & (across <= high) & (np.abs(offset[:, 2]) <= height_m)
    fits &= np.sum(direction[one] * direction[other], axis=1) >= np.cos(np.deg2rad(turn_deg))
    pieces = np.unique(one[fits] * lanes + lane[other[fits]])  # a piece of a lane counts once per neighbour
    overlap = np.bincount(lane[pieces // lanes] * lanes + pieces % lanes, weights=span[pieces // lanes], minlength=lanes**2)
    close = tree.query_pairs(low, output_type="ndarray")
    close = close[np.abs(xyz[close[:, 0], 2] - xyz[close[:, 1], 2]) <= height_m]
    crossing = np.zeros((lanes, lanes), bool)
    crossing[lane[close[:, 0]], lane[close[:, 1]]] = True
    return (overlap.reshape(lanes, lanes) >= overlap_m) & ~(crossing | crossing.T)
