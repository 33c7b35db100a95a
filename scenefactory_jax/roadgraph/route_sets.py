"""Sets of routes along lanes: those that a track may have meant, as ScenarioMax lists them, and random ones.

ScenarioMax (`converter/path.py`): from the lanes near a track's first position all chains of successors, ordered by their distance from the
track. Here chains end where they are long enough, because all chains of ten lanes are too many at large junctions.
"""

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int

from scenefactory_jax.core.scene_arrays import segment_lengths
from scenefactory_jax.core.types import ROUTE_SPACING_M
from scenefactory_jax.roadgraph import lane_graph
from scenefactory_jax.roadgraph.lane_graph import LaneGraph

ROOT_RADIUS_M = (2.5, 5.0)  # of the lanes at which routes begin: the second if there is none within the first
ROOT_COSINE = 0.5  # between lane and car
MAX_LANES = 10  # of a chain
BOUND_SLACK_M = 1e-6  # far above the rounding of a distance
STRIDE = 4  # vertices of a lane of which one is looked at first
MAX_CHAINS = 400  # from one root: at the largest junctions chains of later branches are left out


class SampledRoute(NamedTuple):
    """A route sampled every ROUTE_SPACING_M."""

    xy: Float[np.ndarray, "N 2"]
    lane: Int[np.ndarray, " N"]  # row of the lane graph; -1: beside lanes
    length: float
    lanes: tuple[int, ...]  # rows, in driving order
    on_route: bool
    along_lanes: bool


class LaneMap(NamedTuple):
    """A lane graph and what searches of routes read from it."""

    graph: LaneGraph
    successors: tuple[tuple[int, ...], ...]
    shapes: np.ndarray  # shapely's lines
    tree: shapely.STRtree
    few: Int[np.ndarray, " K"]  # every STRIDE-th vertex of each lane and its last one, lane after lane
    first_few: Int[np.ndarray, " M"]  # row in `few` of each lane's first one, and the number of rows
    gap_m: Float[np.ndarray, " N"]  # longest way along each lane between two of them


def make_lane_map(graph: LaneGraph) -> LaneMap:
    """Prepares a lane graph for searches."""
    following: list[list[int]] = [[] for _ in graph.id]
    for lane, successor in graph.successor.tolist():
        following[lane].append(successor)
    shapes = lane_graph.lane_shapes(graph)
    owner = np.repeat(np.arange(len(graph.id)), np.diff(graph.first))
    place = np.arange(len(owner)) - graph.first[owner]
    few = np.flatnonzero((place % STRIDE == 0) | (place + 1 == np.diff(graph.first)[owner]))
    gap = np.zeros(len(graph.id))
    np.maximum.at(gap, owner[few[1:]], np.where(owner[few[1:]] == owner[few[:-1]], graph.arc[few[1:]] - graph.arc[few[:-1]], 0.0))
    successors = tuple(tuple(sorted(set(rows))) for rows in following)
    return LaneMap(graph, successors, shapes, shapely.STRtree(shapes), few, np.searchsorted(owner[few], np.arange(len(graph.id) + 1)), gap)


def find_track_routes(
    lanes: LaneMap, track: Float[np.ndarray, "L 2"], yaw: float, *, count: int, max_length_m: float, max_distance_m: float
) -> list[SampledRoute]:
    """Finds the routes that a track may have meant, the nearest to the track first.

    A track that no chain of lanes follows within `max_distance_m` is a route itself, without alternatives. Routes begin at the point
    nearest to the track's first position.

    Args:
        track: valid positions in order; two different ones at least.
        yaw: of the first position.
        count: most routes.
        max_length_m: at which routes end.
    """
    chains = [chain for root in _find_roots(lanes, track[0], yaw) for chain in _list_chains(lanes, root, track[0], max_length_m)]
    kept = _drop_parts(chains)
    if not kept:
        return [sample_track(track, max_length_m)]
    offsets = _measure_offsets(lanes, kept, track)
    order = sorted(range(len(kept)), key=lambda place: float(offsets[place].sum()))[:count]
    if offsets[order[0]].max() > max_distance_m:
        return [sample_track(track, max_length_m)]
    found = [sample_chain(lanes, kept[place], track[0], max_length_m) for place in order]
    end = int(np.argmin(np.linalg.norm(found[0].xy - track[-1], axis=1)))
    beginning = found[0].xy[: end + 1]
    return [
        route._replace(on_route=len(route.xy) > end and bool(np.allclose(route.xy[: end + 1], beginning, atol=1e-3))) for route in found
    ]


def _find_roots(lanes: LaneMap, place: Float[np.ndarray, "2"], yaw: float) -> list[int]:
    """Rows of the lanes at which routes from a pose may begin, the best first: 0.7 cos + 0.3 / (1 + distance)."""
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    point = np.array([[*place, 0.0]])
    for radius in ROOT_RADIUS_M:
        row = lanes.tree.query(shapely.points(point[:, :2]), predicate="dwithin", distance=radius)[1]
        near = lane_graph.project_onto(lanes.graph, point, lanes.shapes, np.zeros(len(row), int), row)
        cosine = near.direction @ heading
        fits = cosine > ROOT_COSINE
        if fits.any():
            score = 0.7 * cosine[fits] + 0.3 / (1.0 + near.distance[fits])
            return near.lane[fits][np.argsort(-score, kind="stable")].tolist()
    return []


def _list_chains(lanes: LaneMap, root: int, place: Float[np.ndarray, "2"], max_length_m: float) -> Iterator[tuple[int, ...]]:
    """Lists chains of successors from a lane until they are long enough; a lane that repeats ends a chain."""
    behind = float(shapely.line_locate_point(lanes.shapes[root], shapely.Point(place)))
    pending: deque[tuple[tuple[int, ...], float]] = deque([((root,), float(lanes.graph.length[root]) - behind)])
    listed = 0
    while pending and listed < MAX_CHAINS:
        chain, length = pending.popleft()  # breadth first, so that a limit leaves out late branches only
        further = [lane for lane in lanes.successors[chain[-1]] if lane not in chain]
        if length >= max_length_m or len(chain) == MAX_LANES or not further:
            listed += 1
            yield chain
        else:
            pending.extend(((*chain, lane), length + float(lanes.graph.length[lane])) for lane in further)


def _drop_parts(chains: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """The chains whose lanes are no subset of another's."""
    kept: dict[int, tuple[int, ...]] = {}
    for chain in chains:  # of chains with the same lanes the first, whose root is the better one
        kept.setdefault(sum(1 << lane for lane in chain), chain)  # a set as the bits of an integer
    return [chain for bits, chain in kept.items() if not any(bits & other == bits and bits != other for other in kept)]


def _measure_offsets(lanes: LaneMap, chains: list[tuple[int, ...]], track: Float[np.ndarray, "L 2"]) -> list[Float[np.ndarray, " L"]]:
    """Distances of a track's points from each chain.

    Distances from few vertices bound those from the lanes, and tell which lanes may be the nearest of a chain; only these are measured.
    """
    rows = np.array(sorted({lane for chain in chains for lane in chain}))
    counts = lanes.first_few[rows + 1] - lanes.first_few[rows]
    starts = np.cumsum(counts) - counts
    few = lanes.graph.xyz[lanes.few[np.repeat(lanes.first_few[rows] - starts, counts) + np.arange(counts.sum())]]
    squared = np.square(few[:, 0, None] - track[:, 0]) + np.square(few[:, 1, None] - track[:, 1])
    most = np.sqrt(np.minimum.reduceat(squared, starts, axis=0))
    least = most - lanes.gap_m[rows, None] / 2 - BOUND_SLACK_M
    row = {lane: place for place, lane in enumerate(rows.tolist())}
    members = [[row[lane] for lane in chain] for chain in chains]
    nearest = np.full(most.shape, -np.inf)
    for member in members:
        nearest[member] = np.maximum(nearest[member], most[member].min(axis=0))
    lane, point = np.nonzero(least <= nearest)
    distance = np.full(most.shape, np.inf)
    distance[lane, point] = shapely.distance(lanes.shapes[rows[lane]], np.asarray(shapely.points(track))[point])
    return [distance[member].min(axis=0) for member in members]


def sample_chain(lanes: LaneMap, chain: tuple[int, ...], start: Float[np.ndarray, "2"], max_length_m: float) -> SampledRoute:
    """Samples a chain of lanes from the point of its first lane that is nearest to `start`."""
    behind = float(shapely.line_locate_point(lanes.shapes[chain[0]], shapely.Point(start)))
    return sample_lanes(lanes, chain, behind, max_length_m)


def sample_lanes(lanes: LaneMap, chain: tuple[int, ...], behind: float, max_length_m: float) -> SampledRoute:
    """Samples a chain of lanes from a length along its first lane."""
    graph = lanes.graph
    pieces, owners = [], []
    for place, lane in enumerate(chain):
        line, arc = _take_lane(graph, lane)
        if place == 0:
            line = np.concatenate([_point_on(line, arc, behind)[None], line[arc > behind]])
        pieces.append(line)
        owners.append(np.full(len(line), lane))
    xy, length, nearest = resample(np.concatenate(pieces), max_length_m)
    return SampledRoute(xy, np.concatenate(owners)[nearest], length, chain, on_route=False, along_lanes=True)


def _take_lane(graph: LaneGraph, lane: int) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """The vertices of one lane, and the length along it up to each."""
    rows = slice(graph.first[lane], graph.first[lane + 1])
    return graph.xyz[rows, :2], graph.arc[rows]


def _point_on(line: Float[np.ndarray, "V 2"], arc: Float[np.ndarray, " V"], at: float) -> Float[np.ndarray, "2"]:
    """The point at a length along one lane, as `lane_graph.point_at` computes it for many."""
    at = min(max(at, 0.0), arc[-1])
    segment = min(int(np.searchsorted(arc, at, side="right")) - 1, len(arc) - 2)
    return line[segment] + (at - arc[segment]) / (arc[segment + 1] - arc[segment]) * (line[segment + 1] - line[segment])


def sample_track(track: Float[np.ndarray, "L 2"], max_length_m: float) -> SampledRoute:
    """Samples a track as a route of its own, beside lanes."""
    xy, length, _ = resample(track, max_length_m)
    return SampledRoute(xy, np.full(len(xy), -1), length, (), on_route=True, along_lanes=False)


def resample(line: Float[np.ndarray, "V 2"], max_length_m: float) -> tuple[Float[np.ndarray, "N 2"], float, Int[np.ndarray, " N"]]:
    """Points every ROUTE_SPACING_M along a line and its end, the length, and the vertex at or after each point."""
    step = segment_lengths(line[1:] - line[:-1])
    used = np.concatenate([[0], 1 + np.flatnonzero(step > 1e-3)])
    if len(used) < len(line):
        line = line[used]
        step = segment_lengths(line[1:] - line[:-1])
    arc = np.zeros(len(line))
    np.cumsum(step, out=arc[1:])
    length = min(float(arc[-1]), max_length_m)
    places = np.append(np.arange(0.0, length, ROUTE_SPACING_M), length)
    if len(places) > 1 and places[-1] - places[-2] < 1e-3:
        places = np.delete(places, -2)
    xy = np.empty((len(places), 2))
    for axis in (0, 1):
        xy[:, axis] = np.interp(places, arc, line[:, axis])
    return xy, length, used[np.minimum(np.searchsorted(arc, places), len(arc) - 1)]


def draw_routes(
    lanes: LaneMap,
    rng: np.random.Generator,
    *,
    count: int,
    half_m: float,
    centre: Float[np.ndarray, "2"],
    length_m: tuple[float, float],
    turn_fraction: float,
    attempts: int,
) -> list[SampledRoute]:
    """Draws random routes within a square: starts in proportion to the lanes' lengths, a random successor at every branch.

    Args:
        count: most routes; fewer where `attempts` draws give fewer.
        half_m, centre: of the square; a route ends where it leaves it.
        length_m: shortest and longest route.
        turn_fraction: part of the routes that turn (`is_winding`), as far as enough are found.
    """
    graph = lanes.graph
    winding, straight = list[SampledRoute](), list[SampledRoute]()
    if not len(graph.id):
        return []
    chance = np.cumsum(graph.length / graph.length.sum())
    chance /= chance[-1]
    most_winding = round(count * turn_fraction)
    for _ in range(attempts):  # the draws are those of `rng.choice`, which checks its arguments each time
        lane = int(np.searchsorted(chance, rng.random(), side="right"))
        behind = float(rng.uniform(0.0, graph.length[lane]))
        chain, length = [lane], float(graph.length[lane]) - behind
        while length < length_m[1] and (further := [row for row in lanes.successors[chain[-1]] if row not in chain]):
            chain.append(further[int(rng.integers(0, len(further)))])
            length += float(graph.length[chain[-1]])
        if np.abs(_point_on(*_take_lane(graph, lane), behind) - centre).max() > half_m:
            continue  # it begins outside
        route = cut_to_square(sample_lanes(lanes, tuple(chain), behind, length_m[1]), centre, half_m)
        if route is not None and route.length >= length_m[0]:
            (winding if is_winding(route.xy) else straight).append(route)
        if len(winding) >= most_winding and len(winding) + len(straight) >= count and len(straight) >= count - most_winding:
            break
    chosen = winding[: max(most_winding, count - len(straight))]
    return [*chosen, *straight[: count - len(chosen)]]


def cut_to_square(route: SampledRoute, centre: Float[np.ndarray, "2"], half_m: float) -> SampledRoute | None:
    """The route until it leaves a square; None if it begins outside, or is shorter than one step."""
    away = np.abs(route.xy - centre)
    outside = np.flatnonzero(np.maximum(away[:, 0], away[:, 1]) > half_m)
    if not len(outside):
        return route if len(route.xy) > 1 else None
    end = int(outside[0])
    if end < 2:
        return None
    return route._replace(xy=route.xy[:end], lane=route.lane[:end], length=ROUTE_SPACING_M * (end - 1))


def is_winding(xy: Float[np.ndarray, "N 2"], *, turn_deg: float = 45.0, detour: float = 1.15) -> bool:
    """Whether a route turns by 45 degrees or more, or is 1.15 times longer than its chord (the suite `route100`'s definition)."""
    step = np.diff(xy, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    length, chord = segment_lengths(step).sum(), np.linalg.norm(xy[-1] - xy[0])
    return bool(np.ptp(heading) >= np.deg2rad(turn_deg) or length >= detour * chord)
