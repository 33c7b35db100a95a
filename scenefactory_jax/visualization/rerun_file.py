"""Writes a recording as a `.rrd` file for the rerun viewer: map, cars, trails, goals, traffic, events, and series of numbers.

Entities are `world0/car3`, `world0/series/speed/car3`, ...; timelines are `time`, since the episode began, and `step`.
"""

import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.env.rollout import Recording, StepRecord
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.mujoco import world_mjcf
from scenefactory_jax.visualization.recorded_episodes import cut_world
from scenefactory_jax.visualization.road_levels import list_levels, measure_level, measure_road
from scenefactory_jax.visualization.road_lines import LAYERS, STRAIGHT_M, join_segments
from scenefactory_jax.visualization.web import replay_data

TRAIL_S, TRAIL_HZ = 3.0, 10.0
CAR_M, TRAFFIC_M, GREY = 1.5, 1.5, (150, 152, 158)  # heights of boxes, colour of traffic
CIRCLE = np.linspace(0.0, 2 * np.pi, 33)
SERIES = {  # name -> unit
    "speed": "m/s", "throttle": "-1..1", "steer": "-1..1", "brake": "-1..1", "ttc": "s", "edge_ttc": "s", "friction": "coefficient",
    "friction_utilization": "fraction", "contact_force": "N", "goal_distance": "m", "reward": "per step",
}  # fmt: skip
PLOTS = {
    "speed": ("speed",),
    "actions": ("throttle", "steer", "brake"),
    "ttc": ("ttc", "edge_ttc"),
    "friction": ("friction", "friction_utilization"),
    "reward": ("reward",),
}


class RerunError(ValueError):
    """A file that cannot be written; the message names the missing package."""


def check() -> None:
    """Raises RerunError if rerun is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise RerunError("writing .rrd needs rerun; `pip install scenefactory_jax[rerun]`, or choose out=NAME.html")


def write(path: Path | str, recording: Recording, *, names: Sequence[str], title: str, goal_radius_m: float | int) -> Path:
    """Writes all worlds of a recording, to be opened by `rerun FILE`.

    Args:
        recording: of one or several worlds, see `env.rollout.record`.
        names: of the worlds.
    """
    check()
    import rerun as rr  # an optional dependency  # pyright: ignore[reportMissingImports]
    import rerun.blueprint as rrb  # pyright: ignore[reportMissingImports]

    path, recording = Path(path), jax.device_get(recording)
    path.parent.mkdir(parents=True, exist_ok=True)
    views = [_views(rrb, f"world{index}", name) for index, name in enumerate(names)]
    stream = rr.RecordingStream(f"scenefactory_jax: {title}")
    stream.save(path, default_blueprint=rrb.Blueprint(rrb.Tabs(*views), collapse_panels=True))
    for index, name in enumerate(names):
        _World(rr, stream, f"world{index}", recording, index).send(name, goal_radius_m)
    stream.disconnect()
    return path


def _views(rrb: Any, root: str, name: str) -> Any:
    """A 3D view beside the plots."""
    hidden = rrb.PlotLegend(visible=False)  # lines have the colours of the cars
    plots = [
        rrb.TimeSeriesView(name=plot, origin=f"/{root}/series", contents=[f"$origin/{member}/**" for member in members], plot_legend=hidden)
        for plot, members in PLOTS.items()
    ]
    world = rrb.Spatial3DView(name="world", origin=f"/{root}", contents=["$origin/**", "- $origin/series/**", "- $origin/events/**"])
    events = rrb.TextLogView(name="events", origin=f"/{root}/events")
    return rrb.Horizontal(rrb.Vertical(world, events, row_shares=[5, 1]), rrb.Vertical(*plots), column_shares=[3, 2], name=name)


class _World:
    """Entities of one world."""

    def __init__(self, rr: Any, stream: Any, root: str, recording: Recording, index: int) -> None:
        self.rr, self.stream, self.root = rr, stream, root
        self.scene, self.shots, self.active, self.hz = cut_world(recording, index)
        self.time = np.asarray(self.shots.time_s, float)

    def send(self, name: str, goal_radius_m: float | int) -> None:
        """Sends all entities."""
        self.log("", self.rr.TextDocument(name))
        self.log("", self.rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._send_map(self.scene)
        columns = series(self.shots)
        for car in np.flatnonzero(self.active.any(axis=0)).tolist():
            steps = np.flatnonzero(self.active[:, car])
            self._send_car(car, steps, np.asarray(self.scene.agents.size)[car], goal_radius_m)
            for name, values in columns.items():
                self._send_series(name, car, steps[np.isfinite(values[steps, car])], values[:, car])
        self._send_events(self.active)
        self._send_traffic()

    def log(self, path: str, component: Any) -> None:
        """Logs a component without time."""
        self.stream.log(f"{self.root}/{path}" if path else self.root, component, static=True, strict=True)

    def send_columns(self, path: str, steps: Int[np.ndarray, " n"], columns: Iterable[Any]) -> None:
        """Logs columns of a component, a row per step."""
        times = [self.rr.TimeColumn("time", duration=self.time[steps]), self.rr.TimeColumn("step", sequence=steps)]
        self.stream.send_columns(f"{self.root}/{path}", indexes=times, columns=columns, strict=True)

    def _send_map(self, scene: Scene) -> None:
        lines: dict[str, list[Float[np.ndarray, "n 3"]]] = {}
        colours = {}
        flat = scene.elevation is None
        joined = ((level, *line) for level in list_levels(scene) for line in join_segments(level.road, STRAIGHT_M if flat else None))
        for level, points, kind in joined:
            layer = next((name for name, kinds in LAYERS.items() if kind in kinds), "other")
            lines.setdefault(layer, []).append(np.c_[points, measure_level(scene, points, level.number)])
            colours[layer] = [round(255 * channel) for channel in world_mjcf.COLOURS.get(kind, world_mjcf.GREY)[:3]]
        for layer, strips in lines.items():
            self.log(f"map/{layer}", self.rr.LineStrips3D(strips, colors=[colours[layer]]))

    def _send_car(self, car: int, steps: Int[np.ndarray, " n"], size: Float[np.ndarray, "2"], goal_radius_m: float | int) -> None:
        rr, shots, colour = self.rr, self.shots, pack_colour(drawing.colour_of(car))
        place, yaw = np.asarray(shots.position[:, car], float), np.asarray(shots.yaw[steps, car], float)
        road = measure_road(self.scene, place, np.zeros(len(place)) if shots.height is None else np.asarray(shots.height[:, car], float))
        boxes = self._boxes(np.c_[place, road][steps], yaw, np.tile(size, (len(steps), 1)), CAR_M, colour)
        self.send_columns(f"car{car}/box", steps, boxes)
        back, stride = round(TRAIL_S * self.hz), max(round(self.hz / TRAIL_HZ), 1)
        driven = [steps[(steps >= step - back) & (steps <= step)][::-1][::stride] for step in steps]
        strips = [np.c_[place[rows], road[rows] + 0.05] for rows in driven]
        self.send_columns(f"car{car}/trail", steps, rr.LineStrips3D.columns(strips=strips, colors=np.full(len(steps), colour)))
        goal = np.asarray(shots.goal[steps, car], float)
        begins = np.flatnonzero(np.r_[True, (goal[1:] != goal[:-1]).any(axis=1)])
        ring = goal_radius_m * np.c_[np.cos(CIRCLE), np.sin(CIRCLE), 0 * CIRCLE]
        heights = measure_road(self.scene, goal, road[steps]) + 0.05
        rings = [ring + np.r_[goal[row], heights[row]] for row in begins]
        self.send_columns(f"car{car}/goal", steps[begins], rr.LineStrips3D.columns(strips=rings, colors=np.full(len(rings), colour)))
        if (gone := _find_ends(steps, len(self.time))).size:
            self.send_columns(f"car{car}", gone, rr.Clear.columns(is_recursive=[True] * len(gone)))

    def _boxes(self, base: np.ndarray, yaw: np.ndarray, size: np.ndarray, height_m: float, colour: np.uint32) -> Any:
        zero = np.zeros(len(yaw))
        return self.rr.Boxes3D.columns(
            half_sizes=np.c_[size / 2, zero + height_m / 2],
            centers=base + np.array([0.0, 0.0, height_m / 2]),
            quaternions=np.c_[zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)],
            colors=np.full(len(yaw), colour),
        )

    def _send_series(self, which: str, car: int, steps: Int[np.ndarray, " n"], values: Float[np.ndarray, " T"]) -> None:
        if not len(steps):
            return
        place = f"series/{which}/car{car}"
        self.log(place, self.rr.SeriesLines(colors=[list(drawing.colour_of(car))], names=[f"{which} of car {car}, {SERIES[which]}"]))
        self.send_columns(place, steps, self.rr.Scalars.columns(scalars=np.asarray(values[steps], float)))

    def _send_events(self, active: Bool[np.ndarray, "T A"]) -> None:
        found = sorted((int(t), int(car), name) for name, new in vars(self.shots.events).items() for t, car in np.argwhere(new & active))
        if found:
            text = [f"car {car}: {drawing.MARKS[name].label}" for _, car, name in found]
            colours = np.array([pack_colour(drawing.MARKS[name].colour) for _, _, name in found])
            self.send_columns("events", np.array([step for step, _, _ in found]), self.rr.TextLog.columns(text=text, color=colours))

    def _send_traffic(self) -> None:
        traffic = TrafficBoxes.from_boxes(self.shots.traffic)
        if not traffic.present.any():
            return
        position, yaw, size = (np.asarray(column, float)[traffic.present] for column in traffic[:3])
        road = measure_road(self.scene, traffic.position, np.asarray(traffic.elevation))[traffic.present]
        columns = self._boxes(np.c_[position, road], yaw, size, TRAFFIC_M, pack_colour(GREY))
        self.send_columns("traffic", np.arange(len(traffic.present)), columns.partition(traffic.present.sum(axis=1)))


def series(shots: StepRecord) -> Mapping[str, Float[np.ndarray, "T A"]]:
    """Values of `SERIES` of every car at every step; missing ones are not finite."""
    columns = replay_data.car_columns(shots)
    columns |= {"steer": columns["turn"], "friction": columns["grip"]}
    columns |= {"reward": np.sum([np.asarray(term, float) for term in shots.terms.values()], axis=0)}
    return {name: columns[name] for name in SERIES}


def pack_colour(colour: drawing.Colour) -> np.uint32:
    """A colour as one RGBA number, which every version of rerun accepts."""
    red, green, blue = colour
    return np.uint32(red << 24 | green << 16 | blue << 8 | 255)


def _find_ends(steps: Int[np.ndarray, " n"], length: int) -> Int[np.ndarray, " m"]:
    """The first steps at which a car is inactive again."""
    after = np.setdiff1d(steps + 1, steps)
    return after[after < length]
