"""Converts a recording to the data of the web page: for every world a head of plain JSON and packed arrays."""

from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import (
    CROSSWALK,
    DRIVABLE,
    DRIVEWAY,
    EDGES,
    LANE_BIKE,
    ROAD_USERS,
    SPEED_BUMP,
    SURFACES,
    Road,
    Scene,
)
from scenefactory_jax.env.rollout import Recording, StepRecord
from scenefactory_jax.visualization.birds_eye import patch_overlay, traffic_shapes
from scenefactory_jax.visualization.recorded_episodes import cut_world
from scenefactory_jax.visualization.web.array_packing import Packer
from scenefactory_jax.visualization.web.road_posts import RoadPosts

# name in `map.js` -> kinds of segments
LAYERS: dict[str, tuple[int, ...]] = {
    "driveway": (DRIVEWAY,), "lane": DRIVABLE, "bike": (LANE_BIKE,), "crosswalk": (CROSSWALK,), "bump": (SPEED_BUMP,),
    "white-broken": (6,), "white": (7, 8), "yellow-broken": (9, 10, 13), "yellow": (11, 12), "edge": EDGES,
}  # fmt: skip
STRAIGHT_M = 0.03  # points of a line nearer than this to the straight line between their neighbours are left out
GAP_M = 0.02  # consecutive segments of a polyline that are farther apart are two lines
MAX_TTC_S = 20.0  # a longer time to collision is shown as missing
# per-agent columns and their resolution
RESOLUTION: dict[str, float] = {
    "x": 0.01, "y": 0.01, "yaw": 0.002, "speed": 0.01, "steer": 0.001, "throttle": 0.002, "turn": 0.002, "brake": 0.002, "ttc": 0.01,
    "edge_ttc": 0.01, "goal_distance": 0.02, "grip": 0.001, "friction_utilization": 0.002, "slip": 0.005, "contact_force": 20.0,
}  # fmt: skip
TERM_RESOLUTION = 2e-4
WHEELS = ("FL", "FR", "RL", "RR")  # the order of `dynamics.car.WHEELS`


def world(recording: Recording, index: int, *, name: str, posts: RoadPosts) -> tuple[dict[str, Any], str]:
    """Head and arrays of one world, until one second after its last active step.

    Args:
        recording: on the host.
        index: of the world.
    """
    scene, shots, active, hz = cut_world(recording, index)
    steps = np.arange(len(active))[:, None]
    last = np.maximum.accumulate(np.where(active, steps, 0), axis=0)
    row = np.maximum(last, np.argmax(active, axis=0))  # the last active step, before the first one the first
    packer = Packer()
    _add_cars(packer, shots, active, row)
    layers = _add_road(packer, scene.road)
    traffic = _add_traffic(packer, scene, shots)
    packer.add("film", shots.film_mm[None], resolution=0.001)
    head = {
        "name": name,
        "steps": len(active),
        "start": float(shots.time_s[0]),
        "dt": 1.0 / hz,
        "surface": SURFACES[int(scene.weather.surface)],
        "cars": _cars(scene, shots, active, row),
        "events": _events(shots, active, row),
        "terms": list(shots.terms),
        "wheels": list(WHEELS) if shots.wheels is not None else [],
        "layers": layers,
        "patches": [
            {"label": area.label, "colour": list(area.colour), "pieces": [np.round(piece, 2).tolist() for piece in area.pieces]}
            for area in patch_overlay.areas(scene.weather)
        ],
        "traffic": traffic,
        "lights": [light._asdict() for light in posts.lights],
        "signs": [[round(x, 2), round(y, 2)] for x, y in posts.signs],
        "arrays": packer.directory,
    }
    return head, packer.text()


def _add_cars(packer: Packer, shots: StepRecord, active: Bool[np.ndarray, "T A"], row: Int[np.ndarray, "T A"]) -> None:
    """Adds the columns of all cars, car by car; inactive steps repeat the last active one, which deflates to nothing."""
    ever, agents = active.any(axis=0), np.arange(active.shape[1])
    columns = {
        "x": shots.position[..., 0], "y": shots.position[..., 1], "yaw": shots.yaw, "speed": shots.speed, "steer": shots.steer,
        "throttle": shots.action[..., 0], "turn": shots.action[..., 1], "brake": shots.action[..., 2], "ttc": _near(np.asarray(shots.ttc)),
        "edge_ttc": _near(np.asarray(shots.edge_ttc)), "goal_distance": shots.goal_distance, "grip": shots.grip,
        "friction_utilization": shots.friction_utilization,
        "slip": shots.slip, "contact_force": shots.contact_force,
    }  # fmt: skip
    resolved = {name: (values, RESOLUTION[name]) for name, values in columns.items()}
    resolved |= {f"term:{name}": (values, TERM_RESOLUTION) for name, values in shots.terms.items()}
    if shots.wheels is not None:
        resolved |= {f"mu:{wheel}": (shots.wheels.mu[..., i], RESOLUTION["grip"]) for i, wheel in enumerate(WHEELS)}
    for name, (values, resolution) in resolved.items():
        packer.add(name, np.where(ever, values[row, agents], 0.0).T, resolution=resolution)


def _near(time: Float[np.ndarray, "T A"]) -> Float[np.ndarray, "T A"]:
    return np.where(time <= MAX_TTC_S, time, np.nan)


def _cars(scene: Scene, shots: StepRecord, active: Bool[np.ndarray, "T A"], row: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """Slot, size, spans of active steps, and goals with their first step, of every present car."""
    found = []
    for car in np.flatnonzero(np.asarray(scene.agents.present) | active.any(axis=0)):
        goal = shots.goal[row[:, car], car]
        begins = np.flatnonzero(np.r_[True, (goal[1:] != goal[:-1]).any(axis=1)])
        size = [round(float(side), 2) for side in scene.agents.size[car]]
        goals = [[int(step), *(round(float(v), 2) for v in goal[step])] for step in begins]
        found.append({"slot": int(car), "size": size, "spans": spans(active[:, car]), "goals": goals})
    return found


def spans(true: Bool[np.ndarray, " T"]) -> list[list[int]]:
    """[first, last] of each run of true steps."""
    edges = np.diff(np.r_[False, true, False].astype(np.int8))
    return [[int(first), int(end) - 1] for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)]


def _events(shots: StepRecord, active: Bool[np.ndarray, "T A"], row: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """Events in order. A car that respawns in the step of an event has jumped; its place is that of the step before."""
    found = []
    for name, new in vars(shots.events).items():
        for step, car in np.argwhere(new & active):
            now, before = row[step, car], max(row[step, car] - 1, 0)
            place, earlier = shots.position[now, car], shots.position[before, car]
            jumped = np.linalg.norm(place - earlier) > 100.0 * max(float(shots.time_s[now] - shots.time_s[before]), 1e-3)
            x, y = earlier if jumped and active[before, car] else place
            found.append({"step": int(step), "car": int(car), "name": name, "x": round(float(x), 2), "y": round(float(y), 2)})
    return sorted(found, key=lambda event: (event["step"], event["car"]))


def _add_traffic(packer: Packer, scene: Scene, shots: StepRecord) -> list[dict[str, Any]]:
    """Adds the poses of background traffic; returns size, kind, spans and whether it is parked, of each that is ever present."""
    traffic = TrafficBoxes.from_boxes(shots.traffic)
    rows = np.flatnonzero(traffic.present.any(axis=0))
    present, steps = traffic.present[:, rows], np.arange(len(traffic.present))[:, None]
    last = np.maximum(np.maximum.accumulate(np.where(present, steps, 0), axis=0), np.argmax(present, axis=0))
    for name, column in {"x": traffic.position[..., 0], "y": traffic.position[..., 1], "yaw": traffic.yaw}.items():
        packer.add(f"traffic:{name}", column[last, rows].T, resolution=RESOLUTION[name])
    kinds, parked = np.asarray(scene.traffic_log.kind), traffic_shapes.find_parked(traffic)
    logged = len(kinds) == traffic.present.shape[1]
    return [
        {
            "size": [round(float(side), 2) for side in traffic.size[last[0, index], row]],
            "kind": ROAD_USERS[int(kinds[row])] if logged else "vehicle",
            "spans": spans(traffic.present[:, row]),
            "parked": bool(parked[row]),
        }
        for index, row in enumerate(rows)
    ]


def _add_road(packer: Packer, road: Road) -> dict[str, list[int]]:
    """Adds the points of all lines, layer by layer, as one array; returns the number of points of each line."""
    valid = np.asarray(road.valid, bool)
    kind, polyline = np.asarray(road.kind)[valid], np.asarray(road.polyline)[valid]
    middle, reach = np.asarray(road.midpoint, float)[valid], (road.half_length[:, None] * road.direction)[valid].astype(float)
    starts, ends = middle - reach, middle + reach
    counts, points = {}, [np.zeros((0, 2))]
    for name, kinds in LAYERS.items():
        rows = np.flatnonzero(np.isin(kind, kinds))
        lines = _lines(starts[rows], ends[rows], polyline[rows])
        counts[name] = [len(line) for line in lines]
        points += lines
    packer.add("road", np.concatenate(points).T, resolution=0.01)
    return counts


def _lines(
    starts: Float[np.ndarray, "N 2"], ends: Float[np.ndarray, "N 2"], polyline: Int[np.ndarray, " N"]
) -> list[Float[np.ndarray, "n 2"]]:
    """Joins segments into lines and leaves out points on straight pieces."""
    if not len(starts):
        return []
    breaks = (polyline[1:] != polyline[:-1]) | (np.linalg.norm(starts[1:] - ends[:-1], axis=1) > GAP_M)
    pieces = np.split(np.arange(len(starts)), np.flatnonzero(breaks) + 1)
    lines = [shapely.LineString(np.concatenate([starts[piece[:1]], ends[piece]])) for piece in pieces]
    return [shapely.get_coordinates(line) for line in shapely.simplify(np.array(lines), STRAIGHT_M, preserve_topology=False)]
