"""Routes over lanes from a pose to a goal: the cheapest, and alternatives over other lanes."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from scenefactory_jax.roadgraph import lane_graph
from scenefactory_jax.roadgraph.lane_graph import LaneGraph, LaneProjections


class Network(NamedTuple):
    """Lanes cut into pieces. A node is the start of a piece; its edges lead to the next piece, to successors and to neighbouring lanes."""

    lanes: LaneGraph
    lane: Int[np.ndarray, " N"]
    arc: Float[np.ndarray, " N"]  # of the start of the piece
    first: Int[np.ndarray, " M"]  # the first node of each lane, and the number of nodes
    edge: Int[np.ndarray, "E 2"]  # sorted, at most one between two nodes
    cost: Float[np.ndarray, " E"]
    lane_change_cost: float  # beyond the length of the change


class Route(NamedTuple):
    """A route over lanes."""

    lanes: tuple[int, ...]  # ids in driving order
    xyz: Float[np.ndarray, "N 3"]  # along the centres of the lanes, from the projection of the start to that of the goal
    length: float  # of `xyz` in the plane
    changes: int  # of lanes
    cost: float  # length, lane changes, and distances of start and goal from their lanes


def build_network(
    lanes: LaneGraph,
    *,
    node_spacing_m: float,
    lane_change_m: float,
    lane_change_cost_m: float,
    max_lane_change_turn_deg: float,
    max_lane_distance_m: float,
) -> Network:
    """Builds the network on which routes are searched. The numbers are described in `conf/lanes/base.yaml`."""
    count = np.maximum(1, np.round(lanes.length / node_spacing_m)).astype(int)
    first = np.cumsum([0, *count])
    lane = np.repeat(np.arange(len(count)), count)
    piece = np.arange(first[-1]) - first[lane]
    length = (lanes.length / count)[lane]
    arc = piece * length
    inner = np.flatnonzero(piece + 1 < count[lane])
    last = first[1:] - 1
    along = np.stack([inner, inner + 1], axis=1)
    links = np.stack([last[lanes.successor[:, 0]], first[lanes.successor[:, 1]]], axis=1)
    edge, cost = np.concatenate([along, links]), length[np.concatenate([inner, links[:, 0]])]
    net = Network(lanes, lane, arc, first, edge, cost, lane_change_cost_m)
    changes, distance = _lane_changes(net, lane_change_m, max_lane_change_turn_deg, max_lane_distance_m)
    edge, cost = np.concatenate([edge, changes]), np.concatenate([cost, distance + lane_change_cost_m])
    order = np.lexsort((cost, edge[:, 1], edge[:, 0]))  # of several edges between two nodes the cheapest is kept
    edge, cost = edge[order], cost[order]
    new = np.concatenate([[True], np.diff(edge, axis=0).any(axis=1)])[: len(edge)]
    return net._replace(edge=edge[new], cost=cost[new])


def _lane_changes(
    net: Network, change_m: float, turn_deg: float, distance_m: float
) -> tuple[Int[np.ndarray, "E 2"], Float[np.ndarray, " E"]]:
    """Edges from the nodes of each lane to nodes ahead on its neighbours, and their lengths along the lanes."""
    pairs = np.concatenate([net.lanes.left, net.lanes.right])
    pairs = pairs[np.lexsort(pairs.T)]
    size = np.diff(net.first)[pairs[:, 0]]
    node = np.repeat(net.first[pairs[:, 0]] - np.cumsum(size) + size, size) + np.arange(size.sum())
    other = np.repeat(pairs[:, 1], size)
    if not len(node):
        return np.zeros((0, 2), int), np.zeros(0)
    xyz, direction = lane_graph.point_at(net.lanes, net.lane[node], net.arc[node])
    place = lane_graph.project_onto(net.lanes, xyz, lane_graph.lane_shapes(net.lanes), np.arange(len(xyz)), other)
    aligned = np.sum(direction * place.direction, axis=1) >= np.cos(np.deg2rad(turn_deg))
    target = _node_before(net, other, place.arc + change_m)
    length = net.arc[target] - place.arc  # below `change_m`, because it ends at a node
    fits = aligned & (place.distance <= distance_m) & (length >= change_m / 2)
    return np.stack([node[fits], target[fits]], axis=1), length[fits]


def _node_before(net: Network, lane: Int[np.ndarray, " K"], arc: Float[np.ndarray, " K"]) -> Int[np.ndarray, " K"]:
    """The last node of each lane at or before a length along it."""
    count = np.diff(net.first)[lane]
    spacing = net.lanes.length[lane] / count
    return net.first[lane] + np.clip(np.floor(arc / spacing).astype(int), 0, count - 1)


def find_routes(
    net: Network,
    start: Float[np.ndarray, "3"],
    yaw: float,
    goal: Float[np.ndarray, "3"],
    goal_yaw: float | None,
    *,
    match_radius_m: float,
    max_turn_deg: float,
    max_height_difference_m: float,
    offset_cost: float,
    count: int,
    max_cost_ratio: float,
    reuse_penalty: float,
) -> list[Route]:
    """Finds routes from a pose to a goal, the cheapest first; an empty list where no lane leads there.

    Alternatives come from the penalty method: the lanes of the routes found so far become more expensive. An alternative has a lane that
    no other route has. The numbers are described in `conf/lanes/base.yaml`; without `goal_yaw` the goal may be passed in any direction.
    """
    limits = (match_radius_m, max_turn_deg, max_height_difference_m)
    starts, goals = _match_lanes(net.lanes, start, yaw, *limits), _match_lanes(net.lanes, goal, goal_yaw, *limits)
    if not len(starts.lane) or not len(goals.lane):
        return []
    found: dict[frozenset[int], Route] = {}  # by lanes
    factor = np.ones(len(net.lanes.id))
    for _ in range(2 * count - 1):  # a search may return a route that is known
        route = _find_cheapest_route(net, starts, goals, factor, offset_cost)
        if route is None:
            break
        if not found or route.cost <= max_cost_ratio * next(iter(found.values())).cost:
            found.setdefault(frozenset(route.lanes), route)
        if len(found) == count:
            break
        factor[np.isin(net.lanes.id, route.lanes)] += reuse_penalty
    return sorted(found.values(), key=lambda route: route.cost)


def _match_lanes(
    lanes: LaneGraph, point: np.ndarray, yaw: float | None, radius_m: float, turn_deg: float, height_m: float
) -> LaneProjections:
    """Projections of a pose onto candidate lanes."""
    places = lane_graph.project(lanes, point[None], within_m=radius_m)
    fits = np.abs(places.xyz[:, 2] - point[2]) <= height_m
    if yaw is not None:
        fits &= places.direction @ np.array([np.cos(yaw), np.sin(yaw)]) >= np.cos(np.deg2rad(turn_deg))
    return LaneProjections(*(column[fits] for column in places))


def _find_cheapest_route(
    net: Network, starts: LaneProjections, goals: LaneProjections, factor: Float[np.ndarray, " N"], offset_cost: float
) -> Route | None:
    """The cheapest route from any start to any goal, with the costs of lanes multiplied by `factor`."""
    start_node, goal_node = (_node_before(net, places.lane, places.arc) for places in (starts, goals))
    size, count = len(net.lane), len(start_node)
    edge_cost = net.cost * factor[net.lane[net.edge[:, 0]]]
    # every start is a further node, with the edges of its piece less the length behind it
    number, row = np.nonzero(net.edge[:, 0] == start_node[:, None])
    behind = (starts.arc - net.arc[start_node]) * factor[starts.lane]
    edge = np.concatenate([net.edge, np.stack([size + number, net.edge[row, 1]], axis=1)])
    cost = np.concatenate([edge_cost, np.maximum(edge_cost[row] - behind[number], 0.0)])  # rounding may give less than zero
    graph = csr_array((cost, edge.T), shape=(size + count, size + count))
    distance, before = dijkstra(graph, indices=size + np.arange(count), return_predecessors=True)
    total = distance[:, goal_node] + (goals.arc - net.arc[goal_node]) * factor[goals.lane]
    # a goal ahead on the piece of the start is reached without any node
    ahead = (start_node[:, None] == goal_node) & (goals.arc >= starts.arc[:, None])
    total = np.where(ahead, (goals.arc - starts.arc[:, None]) * factor[starts.lane][:, None], total)
    total = total + offset_cost * (starts.distance[:, None] + goals.distance)
    start, goal = (int(index) for index in np.unravel_index(np.argmin(total), total.shape))
    if not np.isfinite(total[start, goal]):
        return None
    nodes = [int(goal_node[goal])]
    while not ahead[start, goal] and nodes[-1] != size + start:
        nodes.append(int(before[start, nodes[-1]]))
    if not ahead[start, goal]:
        nodes[-1] = int(start_node[start])
    offset = float(starts.distance[start] + goals.distance[goal])
    return _assemble_route(net, nodes[::-1], float(starts.arc[start]), float(goals.arc[goal]), offset_cost * offset)


def _assemble_route(net: Network, nodes: list[int], start: float, goal: float, offset_cost: float) -> Route:
    """The route along nodes, from a length along the lane of the first to one along the lane of the last."""
    stretches: list[tuple[int, float, float]] = []  # lane, and the lengths along it at which the route enters and leaves it
    successors = set(map(tuple, net.lanes.successor.tolist()))
    changes, enter = 0, start
    for node, following in itertools.pairwise(nodes):
        lane, next_lane = int(net.lane[node]), int(net.lane[following])
        if node == net.first[lane + 1] - 1 and following == net.first[next_lane] and (lane, next_lane) in successors:
            stretches.append((lane, enter, float(net.lanes.length[lane])))
            enter = 0.0
        elif lane != next_lane:
            changes += 1
            stretches.append((lane, enter, max(float(net.arc[node]), enter)))
            enter = float(net.arc[following])
    stretches.append((int(net.lane[nodes[-1]]), enter, goal))
    xyz = np.concatenate([_stretch_points(net.lanes, *stretch) for stretch in stretches])
    xyz = xyz[np.concatenate([[True], np.diff(xyz[:, :2], axis=0).any(axis=1)])]
    length = float(np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1).sum())
    cost = length + changes * net.lane_change_cost + offset_cost
    return Route(tuple(int(net.lanes.id[lane]) for lane, *_ in stretches), xyz, length, changes, cost)


def _stretch_points(lanes: LaneGraph, lane: int, low: float, high: float) -> Float[np.ndarray, "N 3"]:
    """The points of a lane between two lengths along it, both included."""
    arc = lanes.arc[lanes.first[lane] : lanes.first[lane + 1]]
    inside = arc[(arc > low) & (arc < high)]
    places = np.concatenate([[low], inside, [max(low, high)]])
    return lane_graph.point_at(lanes, np.full(len(places), lane), places)[0]
