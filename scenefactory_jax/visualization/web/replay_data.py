"""A recording as the replay's page reads it: for every world a head of plain JSON and packed arrays."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES, RawScene
from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import (
    CROSSWALK,
    DRIVABLE,
    DRIVEWAY,
    EDGES,
    LANE_BIKE,
    ROAD_USERS,
    SPEED_BUMP,
    STOP_SIGN,
    SURFACES,
    Road,
    Scene,
)
from scenefactory_jax.env.rollout import Recording, StepRecord
from scenefactory_jax.visualization.birds_eye import patch_overlay, traffic_shapes
from scenefactory_jax.visualization.web.array_packing import Packer

# how a kind of segment looks (`map.js`); kinds as in `types`
LAYERS: dict[str, tuple[int, ...]] = {
    "driveway": (DRIVEWAY,), "lane": DRIVABLE, "bike": (LANE_BIKE,), "crosswalk": (CROSSWALK,), "bump": (SPEED_BUMP,),
    "white-broken": (6,), "white": (7, 8), "yellow-broken": (9, 10, 13), "yellow": (11, 12), "edge": EDGES,
}  # fmt: skip
STRAIGHT_M = 0.03  # a point of a line that is nearer than this to the straight way between its neighbours is left out
GAP_M = 0.02  # consecutive segments of a polyline that are farther apart than this are two lines
TTC_MOST_S = 20.0  # a longer time to collision is shown as none
# what is kept of every car at every step, and how finely
RESOLUTION: dict[str, float] = {
    "x": 0.01, "y": 0.01, "yaw": 0.002, "speed": 0.01, "steer": 0.001, "throttle": 0.002, "turn": 0.002, "brake": 0.002, "ttc": 0.01,
    "edge_ttc": 0.01, "goal_distance": 0.02, "grip": 0.001, "friction_utilization": 0.002, "slip": 0.005, "contact_force": 20.0,
}  # fmt: skip
TERM_RESOLUTION = 2e-4
WHEELS = ("FL", "FR", "RL", "RR")  # the order of `dynamics.car.WHEELS`


class Light(NamedTuple):
    """A traffic light as logged: from each time on it shows that state."""

    place: tuple[float, float]  # where cars stop for it
    yaw: float  # of the lane there
    shown: list[tuple[float, str]]  # (seconds since the episode began, one of LIGHT_STATES)


class RoadPosts(NamedTuple):
    """What stands on the map and is in no packed scene, in its coordinates."""

    lights: tuple[Light, ...] = ()
    signs: tuple[tuple[float, float], ...] = ()  # stop signs


def find_posts(raw: RawScene, centre: Sequence[float]) -> RoadPosts:
    """Lights and stop signs of a scene as its source holds it.

    Args:
        centre: of the packed scene in the source's coordinates (`PackReport.centre`).
    """
    origin = np.asarray(centre[:2])
    signs = [line.xyz[:, :2].mean(axis=0) - origin for line in raw.roads if line.kind == STOP_SIGN and len(line.xyz)]
    lanes = {line.id: line.xyz[:, :2] for line in raw.roads if len(line.xyz) >= 2}
    lights = []
    for light in raw.lights:
        lane = lanes.get(light.lane)
        place = light.stop[:2] if light.stop is not None else None if lane is None else lane[0]
        if place is None:
            continue
        ahead = np.array([1.0, 0.0]) if lane is None else _direction(lane, place)
        states = np.where(light.valid, light.state, 0)[raw.current :]
        times = raw.times[raw.current :] - raw.times[raw.current]
        begins = np.flatnonzero(np.r_[True, states[1:] != states[:-1]])
        shown = [(float(times[i]), LIGHT_STATES[int(states[i])]) for i in begins]
        x, y = place - origin
        lights.append(Light((float(x), float(y)), float(np.arctan2(ahead[1], ahead[0])), shown))
    return RoadPosts(tuple(lights), tuple((float(x), float(y)) for x, y in signs))


def _direction(line: Float[np.ndarray, "N 2"], place: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    nearest = min(int(np.argmin(np.linalg.norm(line - place, axis=1))), len(line) - 2)
    return line[nearest + 1] - line[nearest]


def world(recording: Recording, index: int, *, name: str, posts: RoadPosts) -> tuple[dict[str, Any], str]:
    """Head and arrays of one world, cut one second after its last car is done.

    Args:
        recording: on the host.
        index: of the world.
    """
    scene, shots = (jax.tree.map(lambda leaf: np.asarray(leaf)[index], part) for part in (recording.scene, recording.shots))
    hz = 1.0 / max(float(np.median(np.diff(shots.time_s))), 1e-6) if len(shots.time_s) > 1 else 1.0
    active = shots.active & scene.agents.present
    live = np.flatnonzero(active.any(axis=1))
    length = min((int(live[-1]) if len(live) else 0) + 1 + round(hz), len(active))
    shots, active = jax.tree.map(lambda leaf: leaf[:length], shots), active[:length]
    packer, sound = Packer(), _sound(shots, active)
    held = _held(sound)
    _add_cars(packer, shots, active, held)
    layers = _add_road(packer, scene.road)
    users = _add_others(packer, scene, shots)
    packer.add("film", shots.film_mm[None], resolution=0.001)
    head = {
        "name": name,
        "steps": length,
        "start": float(shots.time_s[0]),
        "dt": 1.0 / hz,
        "surface": SURFACES[int(scene.weather.surface)],
        "cars": _cars(scene, shots, active, held),
        "events": _events(shots, active, held),
        "terms": list(shots.terms),
        "wheels": list(WHEELS) if shots.wheels is not None else [],
        "layers": layers,
        "patches": [
            {"label": area.label, "colour": list(area.colour), "pieces": [np.round(piece, 2).tolist() for piece in area.pieces]}
            for area in patch_overlay.areas(scene.weather)
        ],
        "traffic": users,
        "lights": [light._asdict() for light in posts.lights],
        "signs": [[round(x, 2), round(y, 2)] for x, y in posts.signs],
        "arrays": packer.directory,
    }
    return head, packer.text()


def _sound(shots: StepRecord, active: Bool[np.ndarray, "T A"]) -> Bool[np.ndarray, "T A"]:
    """Where a car's numbers mean something: in its own steps, as far as they are finite."""
    return active & np.isfinite(shots.position).all(axis=-1) & np.isfinite(shots.yaw)


def _held(sound: Bool[np.ndarray, "T A"]) -> Int[np.ndarray, "T A"]:
    """The step whose numbers a car shows at each step: its last sound one, or its first."""
    steps = np.arange(len(sound))[:, None]
    first = np.argmax(sound, axis=0)
    return np.maximum(np.maximum.accumulate(np.where(sound, steps, 0), axis=0), first)


def _add_cars(packer: Packer, shots: StepRecord, active: Bool[np.ndarray, "T A"], held: Int[np.ndarray, "T A"]) -> None:
    """Every car's numbers, car by car; steps that are not its own repeat the last that is, which costs nothing."""
    ever, agents = active.any(axis=0), np.arange(active.shape[1])
    columns = {
        "x": shots.position[..., 0], "y": shots.position[..., 1], "yaw": shots.yaw, "speed": shots.speed, "steer": shots.steer,
        "throttle": shots.action[..., 0], "turn": shots.action[..., 1], "brake": shots.action[..., 2], "ttc": _near(np.asarray(shots.ttc)),
        "edge_ttc": _near(np.asarray(shots.edge_ttc)), "goal_distance": shots.goal_distance, "grip": shots.grip,
        "friction_utilization": shots.friction_utilization,
        "slip": shots.slip, "contact_force": shots.contact_force,
    }  # fmt: skip
    finely = {name: (values, RESOLUTION[name]) for name, values in columns.items()}
    finely |= {f"term:{name}": (values, TERM_RESOLUTION) for name, values in shots.terms.items()}
    if shots.wheels is not None:
        finely |= {f"mu:{wheel}": (shots.wheels.mu[..., i], RESOLUTION["grip"]) for i, wheel in enumerate(WHEELS)}
    for name, (values, resolution) in finely.items():
        packer.add(name, np.where(ever, values[held, agents], 0.0).T, resolution=resolution)


def _near(time: Float[np.ndarray, "T A"]) -> Float[np.ndarray, "T A"]:
    return np.where(time <= TTC_MOST_S, time, np.nan)


def _cars(scene: Scene, shots: StepRecord, active: Bool[np.ndarray, "T A"], held: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """Every present car: its slot, size, the spans of steps in which it drives, and its goals, each with the step from which it counts."""
    found = []
    for car in np.flatnonzero(np.asarray(scene.agents.present) | active.any(axis=0)):
        goal = shots.goal[held[:, car], car]
        begins = np.flatnonzero(np.r_[True, (goal[1:] != goal[:-1]).any(axis=1)])
        size = [round(float(side), 2) for side in scene.agents.size[car]]
        goals = [[int(step), *(round(float(v), 2) for v in goal[step])] for step in begins]
        found.append({"slot": int(car), "size": size, "spans": spans(active[:, car]), "goals": goals})
    return found


def spans(true: Bool[np.ndarray, " T"]) -> list[list[int]]:
    """[first, last] of each run of steps at which something is true."""
    edges = np.diff(np.r_[False, true, False].astype(np.int8))
    return [[int(first), int(end) - 1] for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)]


def _events(shots: StepRecord, active: Bool[np.ndarray, "T A"], held: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """What happened, in order. A car that starts again in the step of its end has left the place: the step before tells it."""
    found = []
    for name, past_events in vars(shots.events).items():
        for step, car in np.argwhere(past_events & active):
            row = held[step, car]
            place, before = shots.position[row, car], shots.position[max(row - 1, 0), car]
            apart = np.linalg.norm(place - before) > 100.0 * max(float(shots.time_s[row] - shots.time_s[max(row - 1, 0)]), 1e-3)
            x, y = before if apart and active[max(row - 1, 0), car] else place
            found.append({"step": int(step), "car": int(car), "name": name, "x": round(float(x), 2), "y": round(float(y), 2)})
    return sorted(found, key=lambda event: (event["step"], event["car"]))


def _add_others(packer: Packer, scene: Scene, shots: StepRecord) -> list[dict[str, Any]]:
    """Everybody else who is ever there: size, kind, spans, and whether it only stands."""
    whole = TrafficBoxes.from_boxes(shots.traffic)
    seen = np.flatnonzero(whole.present.any(axis=0))
    still, held = traffic_shapes.shapes_at_rest(whole), _held(whole.present)
    kinds = np.asarray(scene.traffic_log.kind) if len(scene.traffic_log.kind) == whole.present.shape[1] else None
    take = lambda leaf: np.stack([leaf[held[:, row], row] for row in seen]) if len(seen) else np.zeros((0, len(held)))  # noqa: E731
    for name, leaf in {"other:x": whole.position[..., 0], "other:y": whole.position[..., 1], "other:yaw": whole.yaw}.items():
        packer.add(name, take(leaf), resolution=RESOLUTION[name.removeprefix("other:")])
    found = []
    for row in seen:
        size = [round(float(side), 2) for side in whole.size[held[0, row], row]]
        kind = "vehicle" if kinds is None else ROAD_USERS[int(kinds[row])]
        found.append({"size": size, "kind": kind, "spans": spans(whole.present[:, row]), "parked": bool(still[row])})
    return found


def _add_road(packer: Packer, road: Road) -> dict[str, list[int]]:
    """Lines of every layer one after another as one array of points; returns how many points each line of a layer has."""
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
    """Segments joined where one begins at the other's end, without the points that a straight line does not need."""
    if not len(starts):
        return []
    breaks = (polyline[1:] != polyline[:-1]) | (np.linalg.norm(starts[1:] - ends[:-1], axis=1) > GAP_M)
    pieces = np.split(np.arange(len(starts)), np.flatnonzero(breaks) + 1)
    lines = [shapely.LineString(np.concatenate([starts[piece[:1]], ends[piece]])) for piece in pieces]
    return [shapely.get_coordinates(line) for line in shapely.simplify(np.array(lines), STRAIGHT_M, preserve_topology=False)]
