"""Sets of routes along lanes: those that a track may have meant, as ScenarioMax lists them, and random ones.

ScenarioMax (`converter/path.py`): from the lanes near a track's first position all chains of successors, ordered by their distance from the
track. Here chains end where they are long enough, because all chains of ten lanes are too many at large junctions.
"""

import bisect
import itertools
import math
from collections import deque
from collections.abc import Iterator, Sequence
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
REACH_SLACK_M = 10.0  # of a chain beyond the way of a track, for places beside its lanes
BOUND_SLACK_M = 1e-6  # far above the rounding of a distance
STRIDE = 4  # vertices of a lane of which one is looked at first
MIN_STEP_M = 1e-3  # between vertices of a route
DRAWS = 64  # of routes that are looked at together
MAX_CHAINS = 400  # from one root: at the largest junctions chains of later branches are left out
END_M = 3  # of a track, whose direction is the one at its end
JOIN_M = 15.0  # of a lane, along which the way that continues a track comes to its line


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
    lanes: LaneMap,
    track: Float[np.ndarray, "L 2"],
    yaw: float,
    *,
    count: int,
    max_length_m: float,
    max_distance_m: float,
    max_end_distance_m: float = math.inf,
) -> list[SampledRoute]:
    """Finds the routes that a track may have meant, the nearest to the track first.

    A track that no chain of lanes follows within `max_distance_m`, and at its end within `max_end_distance_m`, is a route itself, without
    alternatives, and goes on along lanes (`continue_track`). Routes begin at the point nearest to the track's first position.

    Args:
        track: valid positions in order; two different ones at least.
        yaw: of the first position.
        count: most routes.
        max_length_m: at which routes end.
    """
    roots = _find_roots(lanes, track[0], yaw)
    behind = {root: float(shapely.line_locate_point(lanes.shapes[root], shapely.Point(track[0]))) for root in roots}
    kept = _drop_parts([chain for root in roots for chain in _list_chains(lanes, root, behind[root], max_length_m)])
    if not kept:
        return [continue_track(lanes, track, max_length_m)]
    reach = REACH_SLACK_M + float(segment_lengths(track[1:] - track[:-1]).sum())
    offsets = _measure_offsets(lanes, [_cut_chain(lanes, chain, behind[chain[0]] + reach) for chain in kept], track)
    order = sorted(range(len(kept)), key=lambda place: float(offsets[place].sum()))[:count]
    nearest = offsets[order[0]]
    if nearest.max() > max_distance_m or nearest[-1] > max_end_distance_m:
        return [continue_track(lanes, track, max_length_m)]
    chosen = [kept[place] for place in order]
    along = [behind[chain[0]] for chain in chosen]
    found = sample_chains(lanes, chosen, *_locate(lanes.graph, [chain[0] for chain in chosen], along), max_length_m)
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


def _list_chains(lanes: LaneMap, root: int, behind: float, max_length_m: float) -> Iterator[tuple[int, ...]]:
    """Lists chains of successors from a length along a lane until they are long enough; a lane that repeats ends a chain."""
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


def _cut_chain(lanes: LaneMap, chain: tuple[int, ...], length_m: float) -> tuple[int, ...]:
    """The lanes of a chain that begin within a length: what a track can have driven, and not what comes back to it on a loop."""
    begins = itertools.accumulate((float(lanes.graph.length[lane]) for lane in chain[:-1]), initial=0.0)
    return tuple(lane for lane, begin in zip(chain, begins, strict=True) if begin <= length_m)


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


def sample_chains(
    lanes: LaneMap,
    chains: Sequence[tuple[int, ...]],
    starts: Float[np.ndarray, "K 2"],
    vertices: Int[np.ndarray, " K"],
    max_length_m: float,
) -> list[SampledRoute]:
    """Samples chains of lanes from `starts`, places on their first lanes, on; `vertices`: the first one behind each (`_locate`)."""
    graph = lanes.graph
    rows, heads = np.array([lane for chain in chains for lane in chain], int), np.cumsum([0, *map(len, chains)])[:-1]
    first, counts = graph.first[rows], np.diff(graph.first)[rows]
    counts[heads] -= vertices - first[heads]
    first[heads] = vertices
    first[heads], counts[heads] = first[heads] - 1, counts[heads] + 1  # a row for the start
    bounds = np.cumsum(counts)
    begins = bounds - counts
    xy = graph.xyz[np.repeat(first - begins, counts) + np.arange(bounds[-1]), :2]
    xy[begins[heads]] = starts
    used = np.ones(len(xy), bool)
    used[1:] = segment_lengths(xy[1:] - xy[:-1]) > MIN_STEP_M
    used[begins[heads]] = True
    xy, owner = xy[used], np.repeat(rows, counts)[used]
    step = segment_lengths(xy[1:] - xy[:-1])
    parts = np.append(np.cumsum(used)[begins[heads]] - 1, len(xy)).tolist()
    found = []
    for chain, begin, end in zip(chains, parts[:-1], parts[1:], strict=True):
        points, length, nearest = _place_points(xy[begin:end], step[begin : end - 1], max_length_m)
        found.append(SampledRoute(points, owner[begin + nearest], length, chain, on_route=False, along_lanes=True))
    return found


def _locate(
    graph: LaneGraph, lane: Sequence[int], along: Sequence[float] | Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, "K 2"], Int[np.ndarray, " K"]]:
    """Places at lengths along lanes, and the first vertex behind each; `lane_graph.point_at` rounds otherwise."""
    first, end, at = graph.first[lane], graph.first[np.asarray(lane) + 1], np.clip(along, 0.0, graph.length[lane])
    spans = zip(first.tolist(), end.tolist(), at.tolist(), strict=True)
    behind = np.array([low + graph.arc[low:high].searchsorted(place, side="right") for low, high, place in spans], int)
    segment = np.minimum(behind, end - 1) - 1
    fraction = (at - graph.arc[segment]) / (graph.arc[segment + 1] - graph.arc[segment])
    begin = graph.xyz[segment, :2]
    return begin + fraction[:, None] * (graph.xyz[segment + 1, :2] - begin), behind


def continue_track(lanes: LaneMap, track: Float[np.ndarray, "L 2"], max_length_m: float) -> SampledRoute:
    """A track as a route of its own that goes on along the lane on which the track ends, and from there as straight on as lanes lead.

    It moves over to the lane's line within JOIN_M. A track that ends on no lane, or against it, ends there.
    """
    route = sample_track(track, max_length_m)
    ahead = route.xy[-1] - route.xy[max(len(route.xy) - 1 - END_M, 0)]
    roots = _find_roots(lanes, track[-1], float(np.arctan2(ahead[1], ahead[0])))
    left_m = max_length_m - route.length
    if not roots or left_m < ROUTE_SPACING_M:
        return route
    behind = float(shapely.line_locate_point(lanes.shapes[roots[0]], shapely.Point(track[-1])))
    chain = min(_list_chains(lanes, roots[0], behind, left_m), key=lambda rows: sum(_measure_turn(lanes.graph, row) for row in rows))
    (tail,) = sample_chains(lanes, [chain], *_locate(lanes.graph, [chain[0]], [behind]), left_m)
    if tail.length < ROUTE_SPACING_M:
        return route
    share = np.maximum(1.0 - ROUTE_SPACING_M * np.arange(len(tail.xy)) / JOIN_M, 0.0)
    line = np.concatenate([route.xy[:-1], tail.xy + share[:, None] * (track[-1] - tail.xy[0])])
    lane = np.concatenate([route.lane[:-1], tail.lane])
    xy, length, nearest = _place_points(line, segment_lengths(line[1:] - line[:-1]), max_length_m)
    return SampledRoute(xy, lane[nearest], length, chain, on_route=True, along_lanes=False)


def _measure_turn(graph: LaneGraph, lane: int) -> float:
    """The angle in radians between the first and the last segment of a lane."""
    points = graph.xyz[graph.first[lane] : graph.first[lane + 1], :2]
    (first, last) = points[1] - points[0], points[-1] - points[-2]
    return abs(math.atan2(first[0] * last[1] - first[1] * last[0], first @ last))


def sample_track(track: Float[np.ndarray, "L 2"], max_length_m: float) -> SampledRoute:
    """Samples a track as a route of its own, beside lanes."""
    xy, length = _resample(track, max_length_m)
    return SampledRoute(xy, np.full(len(xy), -1), length, (), on_route=True, along_lanes=False)


def _resample(line: Float[np.ndarray, "V 2"], max_length_m: float) -> tuple[Float[np.ndarray, "N 2"], float]:
    """Points every ROUTE_SPACING_M along a line and its end, and the length."""
    line = line[np.append(True, segment_lengths(line[1:] - line[:-1]) > MIN_STEP_M)]
    return _place_points(line, segment_lengths(line[1:] - line[:-1]), max_length_m)[:2]


def _place_points(
    line: Float[np.ndarray, "V 2"], step: Float[np.ndarray, " S"], max_length_m: float
) -> tuple[Float[np.ndarray, "N 2"], float, Int[np.ndarray, " N"]]:
    """Points every ROUTE_SPACING_M along a line of segments of these lengths and its end, the length, and the vertex at or after each."""
    arc = np.zeros(len(line))
    np.cumsum(step, out=arc[1:])
    length = min(float(arc[-1]), max_length_m)
    count = math.ceil(length / ROUTE_SPACING_M)
    if count and length - ROUTE_SPACING_M * (count - 1) < MIN_STEP_M:
        count -= 1
    places = ROUTE_SPACING_M * np.arange(count + 1.0)
    places[-1] = length
    xy = np.stack([np.interp(places, arc, line[:, axis]) for axis in (0, 1)], axis=1)
    return xy, length, np.minimum(arc.searchsorted(places), len(arc) - 1)


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
    chance, lengths = (chance / chance[-1]).tolist(), graph.length.tolist()
    most_winding = round(count * turn_fraction)
    for first in range(0, attempts, DRAWS):
        drawn = [_draw_chain(lanes, rng, chance, lengths, length_m[1]) for _ in range(min(DRAWS, attempts - first))]
        starts, vertices = _locate(graph, [chain[0] for chain, _ in drawn], [behind for _, behind in drawn])
        inside = np.flatnonzero(np.abs(starts - centre).max(axis=1) <= half_m)
        chains = [drawn[place][0] for place in inside.tolist()]
        for route in sample_chains(lanes, chains, starts[inside], vertices[inside], length_m[1]) if chains else ():
            cut = cut_to_square(route, centre, half_m)
            if cut is not None and cut.length >= length_m[0]:
                (winding if is_winding(cut.xy) else straight).append(cut)
        if len(winding) >= most_winding and len(winding) + len(straight) >= count and len(straight) >= count - most_winding:
            break
    chosen = winding[: max(most_winding, count - len(straight))]
    return [*chosen, *straight[: count - len(chosen)]]


def _draw_chain(
    lanes: LaneMap, rng: np.random.Generator, chance: list[float], lengths: list[float], max_length_m: float
) -> tuple[tuple[int, ...], float]:
    """Draws a chain of lanes and a length along the first one; the draws are those of `rng.choice` and `rng.uniform`, in less time."""
    lane = bisect.bisect_right(chance, rng.random())
    behind = lengths[lane] * rng.random()
    chain, length = [lane], lengths[lane] - behind
    while length < max_length_m and (further := [row for row in lanes.successors[chain[-1]] if row not in chain]):
        chain.append(further[int(rng.integers(0, len(further))) if len(further) > 1 else 0])
        length += lengths[chain[-1]]
    return tuple(chain), behind


def cut_to_square(route: SampledRoute, centre: Float[np.ndarray, "2"], half_m: float) -> SampledRoute | None:
    """The route until it leaves a square; None if it begins outside, or is shorter than one step."""
    away = np.abs(route.xy - centre)
    outside = np.maximum(away[:, 0], away[:, 1]) > half_m
    end = int(outside.argmax()) if outside.any() else len(outside)
    if end < 2:
        return None
    if end == len(outside):
        return route
    return route._replace(xy=route.xy[:end], lane=route.lane[:end], length=ROUTE_SPACING_M * (end - 1))


def is_winding(xy: Float[np.ndarray, "N 2"], *, turn_deg: float = 45.0, detour: float = 1.15) -> bool:
    """Whether a route turns by 45 degrees or more, or is 1.15 times longer than its chord (the suite `route100`'s definition)."""
    step = xy[1:] - xy[:-1]
    heading = np.arctan2(step[:, 1], step[:, 0])
    if np.abs(heading[1:] - heading[:-1]).max(initial=0.0) >= np.pi:
        heading = np.unwrap(heading)
    turned = heading.max() - heading.min() >= np.deg2rad(turn_deg)
    return bool(turned or segment_lengths(step).sum() >= detour * np.linalg.norm(xy[-1] - xy[0]))
