"""Ways over lanes from a pose to a goal: the shortest, and others that take different lanes."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from scenefactory_jax.roadgraph import lane_graph
from scenefactory_jax.roadgraph.lane_graph import LaneGraph, LaneProjections


class Network(NamedTuple):
    """Lanes cut into pieces. A node is the beginning of a piece; its edges lead to the next piece, the next lanes, or a lane beside it."""

    lanes: LaneGraph
    lane: Int[np.ndarray, " N"]
    arc: Float[np.ndarray, " N"]  # of the beginning
    first: Int[np.ndarray, " M"]  # the first node of each lane, and the number of nodes
    edge: Int[np.ndarray, "E 2"]  # sorted, no two between the same nodes
    cost: Float[np.ndarray, " E"]
    change: float  # what a change of lanes costs beyond its length


class Route(NamedTuple):
    """One way over the lanes."""

    lanes: tuple[int, ...]  # ids in the order in which they are driven
    xyz: Float[np.ndarray, "N 3"]  # along the centres of the lanes, from the place of the start to that of the goal
    length: float  # of `xyz` in the plane
    changes: int  # of lanes
    cost: float  # length with what changes of lanes, and places beside a lane, cost


def network(lanes: LaneGraph, *, piece_m: float, change_m: float, change_cost_m: float, change_turn_deg: float, aside_m: float) -> Network:
    """What routes over these lanes are sought on.

    Args:
        piece_m: about the length of the pieces that lanes are cut into; a change of lanes begins and ends where a piece does.
        change_m: driven along the lanes during a change.
        change_cost_m: length that a change costs beyond what is driven.
        change_turn_deg: between the directions of two lanes where one is left for the other.
        aside_m: between their centres there: lanes that part from each other are neighbours, but only near where they part.
    """
    count = np.maximum(1, np.round(lanes.length / piece_m)).astype(int)
    first = np.cumsum([0, *count])
    lane = np.repeat(np.arange(len(count)), count)
    piece = np.arange(first[-1]) - first[lane]
    length = (lanes.length / count)[lane]
    arc = piece * length
    inner = np.flatnonzero(piece + 1 < count[lane])
    last = first[1:] - 1
    along = np.stack([inner, inner + 1], axis=1)
    links = np.stack([last[lanes.successor[:, 0]], first[lanes.successor[:, 1]]], axis=1)
    bare = Network(lanes, lane, arc, first, np.concatenate([along, links]), length[np.concatenate([inner, links[:, 0]])], change_cost_m)
    beside, distance = _changes(bare, change_m, change_turn_deg, aside_m)
    edge, cost = np.concatenate([bare.edge, beside]), np.concatenate([bare.cost, distance + change_cost_m])
    order = np.lexsort((cost, edge[:, 1], edge[:, 0]))  # of several edges between two nodes the cheapest counts
    edge, cost = edge[order], cost[order]
    fresh = np.concatenate([[True], np.diff(edge, axis=0).any(axis=1)])[: len(edge)]
    return bare._replace(edge=edge[fresh], cost=cost[fresh])


def _changes(net: Network, change_m: float, turn_deg: float, aside_m: float) -> tuple[Int[np.ndarray, "E 2"], Float[np.ndarray, " E"]]:
    """Edges from the nodes of a lane to those ahead on the lanes beside it, and the metres along the lanes that they take."""
    pairs = np.concatenate([net.lanes.left, net.lanes.right])
    pairs = pairs[np.lexsort(pairs.T)]
    size = np.diff(net.first)[pairs[:, 0]]
    node = np.repeat(net.first[pairs[:, 0]] - np.cumsum(size) + size, size) + np.arange(size.sum())
    other = np.repeat(pairs[:, 1], size)
    if not len(node):
        return np.zeros((0, 2), int), np.zeros(0)
    xyz, direction = lane_graph.point_at(net.lanes, net.lane[node], net.arc[node])
    place = lane_graph.project_on(net.lanes, xyz, other)
    aligned = np.sum(direction * place.direction, axis=1) >= np.cos(np.deg2rad(turn_deg))
    target = _node_before(net, other, place.arc + change_m)
    metres = net.arc[target] - place.arc  # less than `change_m`, for it ends where a piece begins
    fits = aligned & (place.distance <= aside_m) & (metres >= change_m / 2)
    return np.stack([node[fits], target[fits]], axis=1), metres[fits]


def _node_before(net: Network, lane: Int[np.ndarray, " K"], arc: Float[np.ndarray, " K"]) -> Int[np.ndarray, " K"]:
    """The last node on each lane that does not lie beyond a length along it."""
    count = np.diff(net.first)[lane]
    piece = net.lanes.length[lane] / count
    return net.first[lane] + np.clip(np.floor(arc / piece).astype(int), 0, count - 1)


def find_routes(
    net: Network,
    start: Float[np.ndarray, "3"],
    yaw: float,
    goal: Float[np.ndarray, "3"],
    goal_yaw: float | None,
    *,
    reach_m: float,
    turn_deg: float,
    rise_m: float,
    aside_cost: float,
    count: int,
    detour: float,
    penalty: float,
) -> list[Route]:
    """Ways from a pose to a goal, the cheapest first; none where no lane leads there.

    Alternatives are found by making the lanes of the ways found so far dearer (the penalty method); a way is another one if it takes a lane
    that those do not.

    Args:
        goal_yaw: None where any direction will do.
        reach_m: from a pose to the centre of a lane that it may be on.
        turn_deg: between the direction of a pose and that of such a lane.
        rise_m: between their heights.
        aside_cost: metres that a metre between a pose and the lane's centre costs.
        count: of ways, at most.
        detour: ways whose cost is more than this times the least are left out.
        penalty: share by which the lanes of a way become dearer.
    """
    begins = _match(net.lanes, start, yaw, reach_m, turn_deg, rise_m)
    ends = _match(net.lanes, goal, goal_yaw, reach_m, turn_deg, rise_m)
    if not len(begins.lane) or not len(ends.lane):
        return []
    found: list[Route] = []
    factor = np.ones(len(net.lanes.id))
    for _ in range(2 * count - 1):  # a search may come upon a way that is known
        way = _cheapest(net, begins, ends, factor, aside_cost)
        if way is None:
            break
        begin, end, nodes = way
        route = _route(net, begins, begin, ends, end, nodes, aside_cost)
        known = {frozenset(other.lanes) for other in found}
        if frozenset(route.lanes) not in known and (not found or route.cost <= detour * found[0].cost):
            found.append(route)
        if len(found) == count:
            break
        factor[np.isin(net.lanes.id, route.lanes)] += penalty
    return sorted(found, key=lambda route: route.cost)


def _match(lanes: LaneGraph, point: np.ndarray, yaw: float | None, reach_m: float, turn_deg: float, rise_m: float) -> LaneProjections:
    """Places on lanes that a pose may be on."""
    places = lane_graph.project(lanes, point[None], within_m=reach_m)
    fits = np.abs(places.xyz[:, 2] - point[2]) <= rise_m
    if yaw is not None:
        fits &= places.direction @ np.array([np.cos(yaw), np.sin(yaw)]) >= np.cos(np.deg2rad(turn_deg))
    return LaneProjections(*(column[fits] for column in places))


def _cheapest(
    net: Network, begins: LaneProjections, ends: LaneProjections, factor: Float[np.ndarray, " N"], aside_cost: float
) -> tuple[int, int, list[int]] | None:
    """The best of the starts and goals, and the nodes from the piece of the one to that of the other."""
    begin_node, end_node = (_node_before(net, places.lane, places.arc) for places in (begins, ends))
    size, starts = len(net.lane), len(begin_node)
    dear = net.cost * factor[net.lane[net.edge[:, 0]]]
    # every start is a node of its own, with the edges of its piece less what lies behind it
    number, row = np.nonzero(net.edge[:, 0] == begin_node[:, None])
    driven = (begins.arc - net.arc[begin_node]) * factor[begins.lane]
    edge = np.concatenate([net.edge, np.stack([size + number, net.edge[row, 1]], axis=1)])
    cost = np.concatenate([dear, np.maximum(dear[row] - driven[number], 0.0)])  # rounding may leave less than nothing
    graph = csr_array((cost, edge.T), shape=(size + starts, size + starts))
    distance, before = dijkstra(graph, indices=size + np.arange(starts), return_predecessors=True)
    total = distance[:, end_node] + (ends.arc - net.arc[end_node]) * factor[ends.lane]
    # a goal ahead on the piece of the start is reached without any node
    ahead = (begin_node[:, None] == end_node) & (ends.arc >= begins.arc[:, None])
    total = np.where(ahead, (ends.arc - begins.arc[:, None]) * factor[begins.lane][:, None], total)
    total = total + aside_cost * (begins.distance[:, None] + ends.distance)
    begin, end = (int(index) for index in np.unravel_index(np.argmin(total), total.shape))
    if not np.isfinite(total[begin, end]):
        return None
    nodes = [int(end_node[end])]
    while not ahead[begin, end] and before[begin, nodes[-1]] != size + begin:
        nodes.append(int(before[begin, nodes[-1]]))
    return begin, end, nodes[::-1] if ahead[begin, end] else [int(begin_node[begin]), *nodes[::-1]]


def _route(
    net: Network, begins: LaneProjections, begin: int, ends: LaneProjections, end: int, nodes: list[int], aside_cost: float
) -> Route:
    """The way through these nodes."""
    # stretches driven on one lane: from where it is entered to where it is left
    stretches: list[list[float]] = [[int(begins.lane[begin]), float(begins.arc[begin]), float(net.arc[nodes[0]])]]
    linked = {(int(a), int(b)) for a, b in net.lanes.successor}
    changes = 0
    for before, node in itertools.pairwise(nodes):
        one, other = int(net.lane[before]), int(net.lane[node])
        follows = before == net.first[one + 1] - 1 and node == net.first[other] and (one, other) in linked
        if follows:
            stretches[-1][2] = float(net.lanes.length[one])
            stretches.append([other, 0.0, 0.0])
        elif one != other:
            changes += 1
            stretches[-1][2] = max(float(net.arc[before]), stretches[-1][1])
            stretches.append([other, float(net.arc[node]), float(net.arc[node])])
        else:
            stretches[-1][2] = float(net.arc[node])
    stretches[-1][2] = float(ends.arc[end])
    xyz = np.concatenate([_stretch(net.lanes, int(lane), low, high) for lane, low, high in stretches])
    new = np.concatenate([[True], np.diff(xyz[:, :2], axis=0).any(axis=1)])
    xyz = xyz[new]
    length = float(np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1).sum())
    cost = length + changes * net.change + aside_cost * float(begins.distance[begin] + ends.distance[end])
    return Route(tuple(int(net.lanes.id[int(lane)]) for lane, *_ in stretches), xyz, length, changes, cost)


def _stretch(lanes: LaneGraph, lane: int, low: float, high: float) -> Float[np.ndarray, "N 3"]:
    """The points of a lane between two lengths along it, both ends included."""
    arc = lanes.arc[lanes.first[lane] : lanes.first[lane + 1]]
    inside = arc[(arc > low) & (arc < high)]
    places = np.concatenate([[low], inside, [max(low, high)]])
    return lane_graph.point_at(lanes, np.full(len(places), lane), places)[0]
