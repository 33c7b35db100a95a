"""Which lane leads into which, and which lies beside which, worked out from geometry where the source does not say.

GPUDrive's, PufferDrive's and SceneFactory's files keep the lanes of the Waymo Open Motion Dataset but drop how they hang together. There a
lane begins exactly where the one before it ends, so a link is a matter of ends that meet. Neighbours follow WOMD's own lists: lanes of one
direction a lane's width apart over some length that never cross, and lanes that part from, or end in, the same lane.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.instantiate import check_number, check_range
from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.types import DRIVABLE
from scenefactory_jax.roadgraph import lane_graph


class Ends(NamedTuple):
    """Where lanes begin, or where they end, and the unit directions in which they run there; zeros where a lane is a single point."""

    xyz: Float[np.ndarray, "N 3"]
    direction: Float[np.ndarray, "N 2"]


class Stations(NamedTuple):
    """Points at even distances along lanes, the lane of each, its unit direction there and how much of the lane it stands for."""

    lane: Int[np.ndarray, " S"]
    xyz: Float[np.ndarray, "S 3"]
    direction: Float[np.ndarray, "S 2"]
    span: Float[np.ndarray, " S"]


def infer_lane_links(
    raw: RawScene,
    *,
    link_gap_m: float,
    link_turn_deg: float,
    rise_m: float,
    beside_m: list[float],
    beside_turn_deg: float,
    overlap_m: float,
    station_m: float,
) -> RawScene:
    """The scene with entries and exits if no lane of it has any, and with lanes to the left and right if none has any.

    Only lanes for cars are linked; bicycle lanes stay as they are, for WOMD links none of them. Lanes of which something was worked out are
    marked `rebuilt`. A scene whose source knows both comes back unchanged.

    Args:
        link_gap_m: an exit begins no farther than this from the end of a lane, in the plane.
        link_turn_deg: ... and turns off by no more than this.
        rise_m: ends and neighbours farther apart in height lie on different levels.
        beside_m: least and most distance between the centres of two lanes that lie beside each other; closer than the least, they cross.
        beside_turn_deg: their directions differ by no more than this.
        overlap_m: ... over at least this length.
        station_m: how finely lanes are compared.

    Raises:
        ConfigError: `beside_m` is no range, or `station_m` not above 0.
    """
    check_range(beside_m, where="lanes.topology.beside_m")
    check_number(station_m, where="lanes.topology.station_m", above=0)
    order = [index for index, line in enumerate(raw.roads) if line.kind in DRIVABLE and len(line.xyz)]
    lanes = [raw.roads[index] for index in order]
    linked = any(line.entry or line.exit for line in raw.roads)
    beside = any(line.left or line.right for line in raw.roads)
    if not lanes or (linked and beside):
        return raw
    starts, stops = _ends(lanes)
    found = {}
    if not linked:
        follows = _meet(stops, starts, link_gap_m, link_turn_deg, rise_m)
        found |= {"exit": _by_lane(lanes, follows), "entry": _by_lane(lanes, follows.T)}
    if not beside:
        stations = _stations(lanes, station_m)
        left = _part(starts, stops, stations, link_gap_m, link_turn_deg, rise_m)
        left |= _lie_left(stations, len(lanes), beside_m, beside_turn_deg, overlap_m, rise_m)
        found |= {"left": _by_lane(lanes, left), "right": _by_lane(lanes, left.T)}
    roads = list(raw.roads)
    for number, index in enumerate(order):
        roads[index] = replace(roads[index], rebuilt=True, **{name: ids[number] for name, ids in found.items()})
    return replace(raw, roads=tuple(roads))


def _by_lane(lanes: list[Polyline], related: Bool[np.ndarray, "N N"]) -> list[tuple[int, ...]]:
    """Ids of the lanes that each lane is related to."""
    ids = np.array([lane.id for lane in lanes])
    return [tuple(ids[row].tolist()) for row in related]


def _ends(lanes: list[Polyline]) -> tuple[Ends, Ends]:
    """Where lanes begin, and where they end."""
    points = [lane.xyz for lane in lanes]
    start, second = np.stack([xyz[0] for xyz in points]), np.stack([xyz[min(1, len(xyz) - 1)] for xyz in points])
    stop, before = np.stack([xyz[-1] for xyz in points]), np.stack([xyz[max(len(xyz) - 2, 0)] for xyz in points])
    return Ends(start, _unit(second - start)), Ends(stop, _unit(stop - before))


def _unit(vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Direction in the plane; zero where there is none."""
    length = np.linalg.norm(vector[:, :2], axis=1, keepdims=True)
    return np.divide(vector[:, :2], length, out=np.zeros_like(vector[:, :2]), where=length > 0)


def _meet(one: Ends, other: Ends, gap_m: float, turn_deg: float, rise_m: float) -> Bool[np.ndarray, "N N"]:
    """Whether an end of one lane lies on an end of another lane that runs the same way.

    A lane of a single point has no direction: it meets lanes that have one, for WOMD cuts lanes down to a point at the rim of its maps, but
    not other single points.
    """
    near = KDTree(one.xyz[:, :2]).sparse_distance_matrix(KDTree(other.xyz[:, :2]), gap_m, output_type="ndarray")
    here, there = near["i"], near["j"]
    level = np.abs(one.xyz[here, 2] - other.xyz[there, 2]) <= rise_m
    aligned = np.sum(one.direction[here] * other.direction[there], axis=1) >= np.cos(np.deg2rad(turn_deg))
    single = one.direction[here].any(axis=1) != other.direction[there].any(axis=1)
    found = np.zeros((len(one.xyz), len(other.xyz)), bool)
    found[here, there] = level & (aligned | single) & (here != there)
    return found


def _stations(lanes: list[Polyline], spacing_m: float) -> Stations:
    """The middles of equal pieces of about that length; none on a lane without length."""
    graph = lane_graph.make(lanes)
    row = {lane.id: number for number, lane in enumerate(lanes)}
    count = np.maximum(1, np.round(graph.length / spacing_m)).astype(int)
    owner = np.repeat(np.arange(len(count)), count)
    piece = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    span = (graph.length / count)[owner]
    xyz, direction = lane_graph.point_at(graph, owner, (piece + 0.5) * span)
    return Stations(np.array([row[lane] for lane in graph.id.tolist()], int)[owner], xyz, direction, span)


def _part(starts: Ends, stops: Ends, stations: Stations, gap_m: float, turn_deg: float, rise_m: float) -> Bool[np.ndarray, "N N"]:
    """[i, j]: lane j parts to the left from lane i where both begin, or comes in from its left where both end."""
    lanes = len(starts.xyz)
    count = np.bincount(stations.lane, minlength=lanes)
    first = np.cumsum(count) - count
    long = np.outer(count, count) > 0  # single points part from nothing
    left = np.zeros((lanes, lanes), bool)
    for ends, back in ((starts, False), (stops, True)):
        one, other = np.nonzero(_meet(ends, ends, gap_m, turn_deg, rise_m) & long)
        along = (np.minimum(count[one], count[other]) - 1) // 2  # halfway along the shorter they are well apart
        here, there = (stations.xyz[first[lane] + (count[lane] - 1 - along if back else along), :2] for lane in (one, other))
        ahead, offset = ends.direction[one], there - here
        left[one, other] |= ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0] > 0
    return left


def _lie_left(
    stations: Stations, lanes: int, beside_m: list[float], turn_deg: float, overlap_m: float, rise_m: float
) -> Bool[np.ndarray, "N N"]:
    """[i, j]: lane j runs to the left of lane i, the same way, for long enough, and they come nowhere closer."""
    least, most = beside_m
    lane, xyz, direction, span = stations
    if not len(lane):
        return np.zeros((lanes, lanes), bool)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    tree = KDTree(xyz[:, :2])
    # a lane at the right distance passes through a small circle a lane's width to the left
    radius = np.hypot((most - least) / 2, span.max() / 2)
    circles = KDTree(xyz[:, :2] + (least + most) / 2 * normal)
    pairs = circles.sparse_distance_matrix(tree, radius, output_type="ndarray")
    one, other = pairs["i"], pairs["j"]
    offset = xyz[other] - xyz[one]
    along, across = (np.sum(offset[:, :2] * axis[one], axis=1) for axis in (direction, normal))
    fits = (np.abs(along) <= span[one] / 2) & (across >= least) & (across <= most) & (np.abs(offset[:, 2]) <= rise_m)
    fits &= np.sum(direction[one] * direction[other], axis=1) >= np.cos(np.deg2rad(turn_deg))
    pieces = np.unique(one[fits] * lanes + lane[other[fits]])  # a piece of a lane counts once for a neighbour
    overlap = np.bincount(lane[pieces // lanes] * lanes + pieces % lanes, weights=span[pieces // lanes], minlength=lanes**2)
    close = tree.query_pairs(least, output_type="ndarray")
    close = close[np.abs(xyz[close[:, 0], 2] - xyz[close[:, 1], 2]) <= rise_m]
    touch = np.zeros((lanes, lanes), bool)
    touch[lane[close[:, 0]], lane[close[:, 1]]] = True
    return (overlap.reshape(lanes, lanes) >= overlap_m) & ~(touch | touch.T)
