"""Rules on the paths of vehicles: goals that no route reaches, and road edges that logged paths cross."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import shapely

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.core.types import DRIVEWAY, EDGES
from scenefactory_jax.data.curation.quality_gate import Finding
from scenefactory_jax.roadgraph import lane_graph, routes


class Crossing(NamedTuple):
    """A place at which a vehicle's logged path crosses a road edge."""

    track: Track
    edge: Polyline
    xyz: tuple[float, float, float]
    step: int
    driveway_m: float  # to the nearest driveway


def unreachable(
    raw: RawScene, *, min_travel_m: float, topology: Mapping[str, Any], network: Mapping[str, Any], search: Mapping[str, Any]
) -> list[Finding]:
    """Vehicles whose last logged position no route over lanes reaches from their current position.

    Args:
        min_travel_m: vehicles that travel less are ignored: most are parked.
        topology, network, search: entries of `lanes` in the config.
    """
    movers = [(track, last) for track, last in _movers(raw, min_travel_m) if track.valid[raw.current]]
    if not movers:
        return []
    linked = instantiate(topology, builtins="scenefactory_jax.roadgraph.lane_topology", where="quality.rules.unreachable.topology")(raw)
    net = instantiate(network, builtins=routes, where="quality.rules.unreachable.network")(lane_graph.make(linked.roads))
    find = instantiate({**search, "count": 1}, builtins=routes, where="quality.rules.unreachable.search")
    found = []
    for track, last in movers:
        start, goal = track.xyz[raw.current], track.xyz[last]
        if find(net, start, float(track.yaw[raw.current]), goal, float(track.yaw[last])):
            continue
        distance = float(np.linalg.norm(goal[:2] - start[:2]))
        message = f"vehicle {track.id}: no route over lanes to its goal {distance:.0f} m away"
        found.append(Finding(message, distance, min_travel_m, goal, last, (track.id,)))
    return found


def crossed_edges(raw: RawScene, *, min_travel_m: float, rise_m: float, driveway_m: float) -> list[Finding]:
    """Vehicles whose logged centre crosses a road edge away from any driveway.

    Args:
        min_travel_m: vehicles that travel less are ignored.
        rise_m: an edge at another height belongs to another level.
        driveway_m: crossings nearer to a driveway are findings of `edges_across_driveways`.
    """
    found = {}
    for crossing in _crossings(raw, min_travel_m, rise_m):
        if crossing.driveway_m > driveway_m:
            track, edge = crossing.track.id, crossing.edge.id
            message = f"vehicle {track} crosses road edge {edge} at step {crossing.step}"
            found.setdefault(track, Finding(message, 1.0, 0.0, crossing.xyz, crossing.step, (track,), (edge,)))
    return list(found.values())


def edges_across_driveways(raw: RawScene, *, min_travel_m: float, rise_m: float, driveway_m: float) -> list[Finding]:
    """Road edges across a driveway that logged vehicles use: wrong labels.

    Args:
        min_travel_m, rise_m: see `crossed_edges`.
        driveway_m: from the crossing to the driveway.
    """
    by_edge: dict[int, list[Crossing]] = {}
    for crossing in _crossings(raw, min_travel_m, rise_m):
        if crossing.driveway_m <= driveway_m:
            by_edge.setdefault(crossing.edge.id, []).append(crossing)
    found = []
    for edge, crossings in by_edge.items():
        ids = tuple(dict.fromkeys(crossing.track.id for crossing in crossings))
        message = f"road edge {edge} runs across a driveway that {len(ids)} vehicle{'s' if len(ids) > 1 else ''} used"
        found.append(Finding(message, float(len(ids)), 0.0, crossings[0].xyz, crossings[0].step, ids, (edge,)))
    return found


def _movers(raw: RawScene, min_travel_m: float) -> Iterator[tuple[Track, int]]:
    """Vehicles whose last position is far enough from their first one at or after the current step, and their last steps."""
    for track in raw.tracks:
        steps = np.flatnonzero(track.valid[raw.current :]) + raw.current
        if track.kind == "vehicle" and len(steps) > 1:
            way = track.xyz[steps[-1], :2] - track.xyz[steps[0], :2]
            if np.hypot(way[0], way[1]) > min_travel_m:
                yield track, int(steps[-1])


def _crossings(raw: RawScene, min_travel_m: float, rise_m: float) -> Iterator[Crossing]:
    """Crossings of vehicles' paths and road edges of the same level, track by track."""
    tracks = [track for track, _ in _movers(raw, min_travel_m)]
    edges = [line for line in raw.roads if line.kind in EDGES and len(line.xyz) > 1]
    if not tracks or not edges:
        return
    paths = np.array([shapely.LineString(track.xyz[track.valid, :2]) for track in tracks], dtype=object)
    shapes = np.array([shapely.LineString(edge.xyz[:, :2]) for edge in edges], dtype=object)
    driveways = [shapely.make_valid(shapely.Polygon(line.xyz[:, :2])) for line in raw.roads if line.kind == DRIVEWAY and len(line.xyz) > 2]
    area = shapely.union_all(driveways)
    for one, other in zip(*shapely.STRtree(shapes).query(paths, predicate="intersects"), strict=True):
        for place in shapely.get_coordinates(shapely.intersection(paths[one], shapes[other])):
            track, edge = tracks[one], edges[other]
            steps = np.flatnonzero(track.valid)
            step = int(steps[np.argmin(np.linalg.norm(track.xyz[steps, :2] - place, axis=1))])
            height = edge.xyz[np.argmin(np.linalg.norm(edge.xyz[:, :2] - place, axis=1)), 2]
            if abs(track.xyz[step, 2] - track.size[2] / 2 - height) <= rise_m:
                away = shapely.distance(area, shapely.Point(place)) if driveways else np.inf
                yield Crossing(track, edge, (float(place[0]), float(place[1]), float(height)), step, float(away))
