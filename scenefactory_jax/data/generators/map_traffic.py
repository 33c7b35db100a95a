"""Scenes with simulated traffic on a map that has none: the road users of towns, on the lanes of the map.

Each scene is drawn around a place on a lane. Road users are those of `town.traffic`, without pedestrians, because maps have no pavements.
"""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import Light, LightPlan, Polyline, RawScene, Reject, Track
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import DRIVABLE, EDGES, LANE_BIKE, LINES, RED_STATES, YELLOW_STATES
from scenefactory_jax.data.generators.curves import FINE_M, arc_length, resample, tangents, wrap_angle
from scenefactory_jax.data.generators.town import town_scene
from scenefactory_jax.data.generators.town.intersections import TURN_RANK
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Lane, Network, Stop
from scenefactory_jax.data.generators.town.traffic import add_warmup
from scenefactory_jax.data.generators.town.traffic_lights import CLOSED, CLOSING, OPEN, Gates

MAX_REDRAWS = 20  # places that are tried for a scene
STRAIGHT_DEG = 30.0  # less turn of a lane of a junction is none
BEYOND = 2.5  # a scene has the map up to so many times the reach
PIECEWISE = (*LINES, *EDGES)  # kinds of which a scene has pieces
EVERYWHERE = shapely.box(-1e6, -1e6, 1e6, 1e6)  # traffic keeps to lanes: it need not be checked for leaving a surface
PACKAGE = "scenefactory_jax.data.generators.town"
Phases = Sequence[Sequence[Sequence[int]]]  # junction -> groups of lanes (ids) that are green together


def draw(raw: RawScene, phases: Phases, traffic: Mapping[str, Any] | None) -> Iterator[RawScene | Reject]:
    """Draws scenes on a map by the entry `traffic` of its reader; without one, the map alone with lights that show nothing."""
    if traffic is not None:
        yield from instantiate(traffic, builtins=__name__, where="traffic")(raw, phases)
        return
    steps = len(raw.times)
    lanes = {line.id: line for line in raw.roads}
    unknown = [lane for junction in phases for group in junction for lane in group]
    dark = [Light(lane, np.zeros(steps, int), np.zeros(steps, bool), lanes[lane].xyz[0]) for lane in unknown]
    yield replace(raw, lights=(*raw.lights, *dark))


def draw_scenes(
    raw: RawScene,
    phases: Phases,
    *,
    scenes: Count,
    reach_m: Positive,
    lane_width_m: Positive,
    speed_limit_mps: Positive,
    log_steps: Count,
    log_current: int,
    log_dt: Positive,
    warmup_s: NonNegative,
    max_sdc_distance_m: Positive,
    sensor_range_m: Positive,
    traffic: Mapping[str, Any],
    traffic_lights: Mapping[str, Any],
) -> Iterator[RawScene | Reject]:
    """Draws `scenes` scenes on a map, or a reject in place of each for which no place with enough moving cars is found.

    A scene depends on the map's name, its number and the numbers alone, and has the map around its middle.

    Args:
        reach_m: half the side of the square around its middle in which road users start.
        lane_width_m, speed_limit_mps: of lanes, where no limit is known.
        log_steps, log_current, log_dt, warmup_s, max_sdc_distance_m, sensor_range_m, traffic, traffic_lights: see `town_scene.generate`.
    """
    times = log_dt * np.arange(log_steps)
    minima = {"min_travel_m": traffic["travel_m"][0], "min_cars": traffic["cars"][0]}
    log = town_scene.Log(times, log_current, warmup_s, max_sdc_distance_m, sensor_range_m, **minima)
    populate = instantiate(traffic, builtins=f"{PACKAGE}.traffic", where="traffic.traffic")
    draw_gates = instantiate(traffic_lights, builtins=f"{PACKAGE}.traffic_lights", where="traffic.traffic_lights")
    lanes = [line for line in raw.roads if line.kind in DRIVABLE and len(line.xyz) > 1]
    lengths = np.array([arc_length(lane.xyz[:, :2])[-1] for lane in lanes])
    ground = KDTree(np.concatenate([lane.xyz[:, :2] for lane in lanes]))
    heights = np.concatenate([lane.xyz[:, 2] for lane in lanes])
    for number in range(scenes):
        name, scene = f"{raw.name}-{number}", None
        for redraw in range(MAX_REDRAWS):
            rng = np.random.default_rng(np.random.SeedSequence((zlib.crc32(raw.name.encode()), number, redraw)))
            lane = lanes[int(rng.choice(len(lanes), p=lengths / lengths.sum()))]
            middle = lane.xyz[int(rng.integers(len(lane.xyz))), :2]
            part, near = cut_map(raw, phases, middle, BEYOND * reach_m)
            network, stops = _build_network(part, near, middle, BEYOND * reach_m, lane_width_m, speed_limit_mps)
            every = add_warmup(times, warmup_s)
            gates = _follow_plans(draw_gates(rng, network, every), part, len(network.stops) - len(part.lights), every)
            recorded = town_scene.record(rng, populate(rng, network, [], EVERYWHERE, reach_m, every, gates), log)
            if recorded is not None:
                users, sdc = recorded
                tracks = tuple(_place(town_scene.to_track(i, user), middle, ground, heights) for i, user in enumerate(users))
                lights = _make_lights(part, stops, gates, log_steps)
                scene = replace(part, name=name, tracks=tracks, times=times, current=log_current, sdc=sdc, lights=lights)
                break
        fault = f"traffic: {MAX_REDRAWS} places of the map had fewer than {log.min_cars} moving cars; give traffic=null for the map alone"
        yield Reject(name, fault) if scene is None else scene


def cut_map(raw: RawScene, phases: Phases, middle: Float[np.ndarray, " 2"], half: float) -> tuple[RawScene, Phases]:
    """The map in the square of half side `half` around `middle`: lanes, crosswalks and signs whole, of lines and edges the pieces there."""
    roads, cut = [], []
    for line in raw.roads:
        near = np.abs(line.xyz[:, :2] - middle).max(axis=1) <= half
        if near.all() or (near.any() and line.kind not in PIECEWISE):
            roads.append(line)
        elif near.any():
            bounds = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(int))).reshape(-1, 2)
            cut += [replace(line, xyz=line.xyz[start:stop]) for start, stop in bounds.tolist() if stop - start > 1]
    first = max((line.id for line in raw.roads), default=-1) + 1
    roads += [replace(piece, id=first + place) for place, piece in enumerate(cut)]
    kept = {line.id for line in roads}
    metadata = raw.metadata | {"intersection_lanes": [lane for lane in raw.metadata.get("intersection_lanes", ()) if lane in kept]}
    lights = tuple(light for light in raw.lights if light.lane in kept)
    near_phases = [[[lane for lane in group if lane in kept] for group in groups] for groups in phases]
    return replace(raw, roads=tuple(roads), lights=lights, metadata=metadata), near_phases


def _build_network(
    raw: RawScene, phases: Phases, middle: Float[np.ndarray, " 2"], half: float, width: float, limit: float
) -> tuple[Network, dict[int, int]]:
    """The lanes in the square of half side `half` around `middle`, and the stop of each lane with a light: first drawn, then known ones."""
    network, stops = Network(), {}
    for junction, groups in enumerate(phases):
        network.phases[junction] = [frozenset([arm]) for arm in range(max(len(groups), 2))]  # one group alone is red at times, too
        for arm, group in enumerate(groups):
            stops |= dict.fromkeys(group, len(network.stops))
            network.stops.append(Stop("signal", arm, np.zeros(2), junction))
    for light in raw.lights:
        stops[light.lane] = len(network.stops)
        network.stops.append(Stop("signal", 0, np.zeros(2), -1))
    crossing = set(raw.metadata.get("intersection_lanes", ()))
    kept = {}
    for line in raw.roads:
        part = _cut(line, middle, half) if line.kind in (*DRIVABLE, LANE_BIKE) else None
        if part is not None:
            points, begins, ends = part
            rank = _rank_turn(points) if line.id in crossing else ON_ROAD
            number = network.add_lane(
                Lane(points, width, line.speed_limit or limit, rank, line.kind, stops.get(line.id) if begins else None)
            )
            kept[line.id] = number, begins, ends, line
    for number, _, ends, line in kept.values():
        for follower in line.exit if ends else ():
            if follower in kept and kept[follower][1]:
                network.link(number, kept[follower][0])
        for side in ("left", "right"):
            getattr(network, side)[number] += [kept[other][0] for other in getattr(line, side) if other in kept]
    return network, stops


def _cut(line: Polyline, middle: Float[np.ndarray, " 2"], half: float) -> tuple[Float[np.ndarray, "N 2"], bool, bool] | None:
    """The longest part of a lane in a square, and whether it has the lane's begin and its end; None if there is none."""
    points = line.xyz[:, :2] - middle
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], np.abs(points).max(axis=1) <= half, [False]]).astype(int)))
    if not len(bounds):
        return None
    start, stop = max(bounds.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0])
    if stop - start < 2 or arc_length(points[start:stop])[-1] < FINE_M:
        return None
    return resample(points[start:stop], FINE_M), start == 0, stop == len(points)


def _rank_turn(points: Float[np.ndarray, "N 2"]) -> int:
    """The right of way of a lane of a junction."""
    yaw = tangents(points)
    turn = float(np.rad2deg(wrap_angle(float(yaw[-1] - yaw[0]))))
    return TURN_RANK["straight" if abs(turn) < STRAIGHT_DEG else "left" if turn > 0 else "right"]


def _follow_plans(gates: Gates, raw: RawScene, first: int, times: Float[np.ndarray, " L"]) -> Gates:
    """The gates with the lights whose cycles the map knows, from stop `first` on."""
    for stop, light in enumerate(raw.lights, start=first):
        if light.plan is not None:
            codes = read_plan(light.plan, times)
            closed = np.where(np.isin(codes, RED_STATES), CLOSED, np.where(np.isin(codes, YELLOW_STATES), CLOSING, OPEN))
            gates.light[stop], gates.state[stop], gates.plans[stop] = codes, closed, light.plan
    return gates


def read_plan(plan: LightPlan, times: Float[np.ndarray, " L"]) -> Int[np.ndarray, " L"]:
    """The states of a plan at times."""
    return np.asarray(plan.state)[np.searchsorted(plan.start_s, np.mod(times, plan.period_s), side="right") - 1]


def _make_lights(raw: RawScene, stops: Mapping[int, int], gates: Gates, steps: int) -> tuple[Light, ...]:
    """The lights of all lanes that have one."""
    known, lanes = {light.lane: light for light in raw.lights}, {line.id: line for line in raw.roads}
    lights = []
    for lane, stop in stops.items():
        point = known[lane].stop if lane in known else lanes[lane].xyz[0]
        codes = gates.light[stop, -steps:]
        lights.append(Light(lane, np.maximum(codes, 0), codes >= 0, point, gates.plans.get(stop)))
    return tuple(lights)


def _place(track: Track, middle: Float[np.ndarray, " 2"], ground: KDTree, heights: Float[np.ndarray, " N"]) -> Track:
    """A track in the map's coordinates, on the ground."""
    xyz = track.xyz.copy()
    xyz[:, :2] += middle
    xyz[:, 2] += heights[ground.query(xyz[:, :2])[1]]
    return replace(track, xyz=np.where(track.valid[:, None], xyz, 0.0))
