"""Converts a recording to the data of the web page: for every world a head of plain JSON and packed arrays."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import ROAD_USERS, SURFACES, Road, Scene
from scenefactory_jax.env.rollout import Recording, StepRecord
from scenefactory_jax.visualization.birds_eye import patch_overlay, traffic_shapes
from scenefactory_jax.visualization.recorded_episodes import cut_world, find_shown_steps
from scenefactory_jax.visualization.road_levels import find_covered, list_levels
from scenefactory_jax.visualization.road_lines import LAYERS, join_segments
from scenefactory_jax.visualization.web.array_packing import Packer
from scenefactory_jax.visualization.web.road_posts import RoadPosts

MAX_TTC_S = 20.0  # a longer time to collision is shown as missing
# per-agent columns and their resolution
RESOLUTION: dict[str, float] = {
    "x": 0.01, "y": 0.01, "yaw": 0.002, "speed": 0.01, "steer": 0.001, "throttle": 0.002, "turn": 0.002, "brake": 0.002, "ttc": 0.01,
    "edge_ttc": 0.01, "goal_distance": 0.02, "grip": 0.001, "friction_utilization": 0.002, "slip": 0.005, "contact_force": 20.0,
}  # fmt: skip
TERM_RESOLUTION = 2e-4
WHEELS = ("FL", "FR", "RL", "RR")  # the order of `dynamics.car.WHEELS`


def world(
    recording: Recording, index: int, *, name: str, posts: RoadPosts, failures: Mapping[int, Mapping[str, Any]]
) -> tuple[dict[str, Any], str]:
    """Head and arrays of one world, until one second after its last active step.

    Args:
        recording: on the host.
        index: of the world.
        failures: car -> metric -> [first, last] step of each failure; None: the metric is absent.
    """
    scene, shots, active, hz = cut_world(recording, index)
    packer, shown = Packer(), find_shown_steps(active)
    _add_cars(packer, shots, active, shown)
    _, *higher = list_levels(scene)
    layers, traffic = _add_road(packer, "road", [scene.road]), _add_traffic(packer, scene, shots)
    bridges = _add_road(packer, "bridges", [level.road for level in higher]) if higher else {}
    packer.add("film", shots.film_mm[None], resolution=0.001)
    head = {
        "name": name,
        "steps": len(active),
        "start": float(shots.time_s[0]),
        "dt": 1.0 / hz,
        "surface": SURFACES[int(scene.weather.surface)],
        "cars": _cars(scene, shots, active, shown),
        "events": _events(shots, active, shown),
        "terms": list(shots.terms),
        "wheels": list(WHEELS) if shots.wheels is not None else [],
        "layers": layers,
        "bridges": bridges,
        "patches": [
            {"label": area.label, "colour": list(area.colour), "pieces": [_rounded(piece) for piece in area.pieces]}
            for area in patch_overlay.areas(scene.weather)
        ],
        "traffic": traffic,
        "lights": [light._asdict() for light in posts.lights],
        "signs": [_rounded(place) for place in posts.signs],
        "metrics": {str(car): dict(metrics) for car, metrics in failures.items()},
        "arrays": packer.directory,
    }
    return head, packer.text()


def _rounded(values: Any) -> Any:
    """Lengths to the centimetre, as lists."""
    return np.round(np.asarray(values, float), 2).tolist()


def car_columns(shots: StepRecord) -> dict[str, Float[np.ndarray, "T A"]]:
    """Columns of `RESOLUTION` that are recorded; a time to collision longer than MAX_TTC_S is missing (NaN)."""
    columns = {name: getattr(shots, name, None) for name in RESOLUTION} | {"x": shots.position[..., 0], "y": shots.position[..., 1]}
    if shots.action is not None:
        columns |= {name: shots.action[..., i] for i, name in enumerate(("throttle", "turn", "brake"))}
    columns = {name: np.asarray(values, float) for name, values in columns.items() if values is not None}
    return columns | {name: np.where(columns[name] <= MAX_TTC_S, columns[name], np.nan) for name in ("ttc", "edge_ttc") if name in columns}


def _add_cars(packer: Packer, shots: StepRecord, active: Bool[np.ndarray, "T A"], shown: Int[np.ndarray, "T A"]) -> None:
    """Adds the columns of all cars, car by car; inactive steps repeat the last active one, which deflates to nothing."""
    columns = {name: (values, RESOLUTION[name]) for name, values in car_columns(shots).items()}
    columns |= {f"term:{name}": (values, TERM_RESOLUTION) for name, values in shots.terms.items()}
    if shots.wheels is not None:
        columns |= {f"mu:{wheel}": (shots.wheels.mu[..., i], RESOLUTION["grip"]) for i, wheel in enumerate(WHEELS)}
    for name, (values, resolution) in columns.items():
        packer.add(name, np.where(active.any(axis=0), np.take_along_axis(values, shown, axis=0), 0.0).T, resolution=resolution)


def _cars(scene: Scene, shots: StepRecord, active: Bool[np.ndarray, "T A"], shown: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """Slot, size, spans of active steps and of those under a bridge, and goals with their first step, of every present car."""
    height = None if shots.height is None else np.asarray(shots.height)
    cars, covered = [], find_covered(scene, np.asarray(shots.position), height)
    for car in np.flatnonzero(np.asarray(scene.agents.present) | active.any(axis=0)).tolist():
        goal = shots.goal[shown[:, car], car]
        begins = np.flatnonzero(np.r_[True, (goal[1:] != goal[:-1]).any(axis=1)]).tolist()
        goals = [[step, *_rounded(goal[step])] for step in begins]
        times = {"spans": spans(active[:, car]), "covered": spans(covered[:, car])}
        cars.append({"slot": car, "size": _rounded(scene.agents.size[car]), **times, "goals": goals})
    return cars


def spans(true: Bool[np.ndarray, " T"]) -> list[list[int]]:
    """[first, last] of each run of true steps."""
    edges = np.flatnonzero(np.diff(np.r_[False, true, False]))
    return [[int(first), int(end) - 1] for first, end in edges.reshape(-1, 2)]


def _events(shots: StepRecord, active: Bool[np.ndarray, "T A"], shown: Int[np.ndarray, "T A"]) -> list[dict[str, Any]]:
    """Events in order. A car that respawns in the step of an event has jumped; its place is that of the step before."""
    events = []
    for name, new in vars(shots.events).items():
        for step, car in np.argwhere(new & active):
            now, before = shown[step, car], max(shown[step, car] - 1, 0)
            place, earlier = shots.position[now, car], shots.position[before, car]
            jumped = np.linalg.norm(place - earlier) > 100.0 * max(float(shots.time_s[now] - shots.time_s[before]), 1e-3)
            x, y = _rounded(earlier if jumped and active[before, car] else place)
            events.append({"step": int(step), "car": int(car), "name": name, "x": x, "y": y})
    return sorted(events, key=lambda event: (event["step"], event["car"]))


def _add_traffic(packer: Packer, scene: Scene, shots: StepRecord) -> list[dict[str, Any]]:
    """Adds the poses of background traffic; returns size, kind, spans and whether it is parked, of each that is ever present."""
    traffic = TrafficBoxes.from_boxes(shots.traffic)
    rows, shown = np.flatnonzero(traffic.present.any(axis=0)), find_shown_steps(traffic.present)
    for name, column in {"x": traffic.position[..., 0], "y": traffic.position[..., 1], "yaw": traffic.yaw}.items():
        packer.add(f"traffic:{name}", np.take_along_axis(column, shown, axis=0)[:, rows].T, resolution=RESOLUTION[name])
    kinds, parked = np.asarray(scene.traffic_log.kind), traffic_shapes.find_parked(traffic)
    logged, covered = len(kinds) == traffic.present.shape[1], find_covered(scene, traffic.position, traffic.elevation)
    return [
        {
            "size": _rounded(traffic.size[shown[0, row], row]),
            "kind": ROAD_USERS[int(kinds[row])] if logged else "vehicle",
            "spans": spans(traffic.present[:, row]),
            "covered": spans(covered[:, row]),
            "parked": bool(parked[row]),
        }
        for row in rows
    ]


def _add_road(packer: Packer, name: str, roads: list[Road]) -> dict[str, list[int]]:
    """Adds the points of all lines, layer by layer, as one array; returns the number of points of each line."""
    lines = [line for road in roads for line in join_segments(road)]
    layers = {layer: [points for points, kind in lines if kind in kinds] for layer, kinds in LAYERS.items()}
    packer.add(name, np.concatenate([np.zeros((0, 2)), *itertools.chain(*layers.values())]).T, resolution=0.01)
    return {layer: [len(points) for points in rows] for layer, rows in layers.items()}
