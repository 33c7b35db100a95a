"""A recording as a `.rrd` file for the rerun viewer: map, cars, trails, goals, others, events, and numbers over time.

Every world is a branch of the file's tree, `world0`, `world1`, ...; in it every car is a branch `car3`, every number a line
`series/speed/car3`. Timelines are `time`, since the episode began, and `step`.
"""

import importlib.util
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.types import Scene
from scenefactory_jax.env.rollout import Recording, StepRecord
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.mujoco import world_mjcf
from scenefactory_jax.visualization.web import replay_data

TRAIL_S, TRAIL_HZ = 3.0, 10.0
CAR_M, OTHER_M, OTHER = 1.5, 1.5, (150, 152, 158)  # heights of boxes, and a colour
ROUND = np.linspace(0.0, 2 * np.pi, 33)
# name -> (what it is, how to read it of the shots); lines of one name share a plot
SERIES = {
    "speed": "m/s", "throttle": "-1..1", "steer": "-1..1", "brake": "-1..1", "ttc": "s", "edge_ttc": "s", "friction": "coefficient",
    "friction_utilization": "share", "contact_force": "N", "goal_distance": "m", "reward": "per step",
}  # fmt: skip
PLOTS = {
    "speed": ("speed",),
    "actions": ("throttle", "steer", "brake"),
    "ttc": ("ttc", "edge_ttc"),
    "friction": ("friction", "friction_utilization"),
}
PLOTS |= {"reward": ("reward",)}


class RerunError(ValueError):
    """A file that cannot be written; the message names what is missing."""


def check() -> None:
    """Refuse before anybody drives.

    Raises:
        RerunError: rerun is not installed.
    """
    if importlib.util.find_spec("rerun") is None:
        raise RerunError("writing .rrd needs rerun; `pip install scenefactory_jax[rerun]`, or choose out=NAME.html")


def write(path: Path | str, recording: Recording, *, names: Sequence[str], title: str, goal_radius_m: float) -> Path:
    """Write all worlds of a recording, to be opened by `rerun FILE`.

    Args:
        recording: of one or several worlds, see `recording.record`.
        names: of the worlds.

    Raises:
        RerunError: rerun is not installed.
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
        scene, shots = (jax.tree.map(lambda leaf, i=index: np.asarray(leaf)[i], part) for part in (recording.scene, recording.shots))
        _World(rr, stream, f"world{index}", shots).send(scene, name, goal_radius_m)
    stream.disconnect()
    return path


def _views(rrb: Any, root: str, name: str) -> Any:
    """The world in three dimensions beside its plots."""
    unseen = rrb.PlotLegend(visible=False)  # it would cover the lines, which have their cars' colours
    plots = [
        rrb.TimeSeriesView(name=plot, origin=f"/{root}/series", contents=[f"$origin/{one}/**" for one in members], plot_legend=unseen)
        for plot, members in PLOTS.items()
    ]
    world = rrb.Spatial3DView(name="world", origin=f"/{root}", contents=["$origin/**", "- $origin/series/**", "- $origin/events/**"])
    events = rrb.TextLogView(name="events", origin=f"/{root}/events")
    return rrb.Horizontal(rrb.Vertical(world, events, row_shares=[5, 1]), rrb.Vertical(*plots), column_shares=[3, 2], name=name)


class _World:
    """The branch of one world, and the stream that it goes to."""

    def __init__(self, rr: Any, stream: Any, root: str, shots: StepRecord) -> None:
        self.rr, self.stream, self.root, self.shots = rr, stream, root, shots
        self.time = np.asarray(shots.time_s, float)
        self.hz = 1.0 / max(float(np.median(np.diff(self.time))), 1e-6) if len(self.time) > 1 else 1.0

    def send(self, scene: Scene, name: str, goal_radius_m: float) -> None:
        """Everything."""
        rr, shots = self.rr, self.shots
        self.log("", rr.TextDocument(name))
        self.log("", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._send_map(scene)
        active = np.asarray(shots.active & scene.agents.present) & np.isfinite(shots.position).all(axis=-1) & np.isfinite(shots.yaw)
        numbers = series(shots)
        for car in np.flatnonzero(active.any(axis=0)):
            steps = np.flatnonzero(active[:, car])
            self._send_car(int(car), steps, np.asarray(scene.agents.size)[car], goal_radius_m)
            for which, values in numbers.items():
                self._send_series(which, int(car), steps[np.isfinite(values[steps, car])], values[:, car])
        self._send_events(active)
        self._send_others()

    def log(self, place: str, what: Any) -> None:
        """Something that holds at all times."""
        self.stream.log(f"{self.root}/{place}" if place else self.root, what, static=True, strict=True)

    def columns(self, place: str, steps: Int[np.ndarray, " n"], columns: Iterable[Any]) -> None:
        """Something that changes, a row for each of some steps."""
        times = [self.rr.TimeColumn("time", duration=self.time[steps]), self.rr.TimeColumn("step", sequence=steps)]
        self.stream.send_columns(f"{self.root}/{place}", indexes=times, columns=columns, strict=True)

    def _send_map(self, scene: Scene) -> None:
        lines: dict[str, list[Float[np.ndarray, "n 3"]]] = {}
        colours = {}
        for points, kind in world_mjcf.join_segments(scene.road, replay_data.STRAIGHT_M):
            layer = next((name for name, kinds in replay_data.LAYERS.items() if kind in kinds), "other")
            lines.setdefault(layer, []).append(np.c_[points, np.zeros(len(points))])
            colours[layer] = [round(255 * channel) for channel in world_mjcf.COLOURS.get(kind, world_mjcf.OTHER)[:3]]
        for layer, strips in lines.items():
            self.log(f"map/{layer}", self.rr.LineStrips3D(strips, colors=[colours[layer]]))

    def _send_car(self, car: int, steps: Int[np.ndarray, " n"], size: Float[np.ndarray, "2"], goal_radius_m: float) -> None:
        rr, shots, colour = self.rr, self.shots, pack_polylines(drawing.colour_of(car))
        place, yaw = np.asarray(shots.position[:, car], float), np.asarray(shots.yaw[steps, car], float)
        zero = np.zeros(len(steps))
        centres = np.c_[place[steps], zero + CAR_M / 2]
        turns = np.c_[zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)]
        half = np.tile([size[0] / 2, size[1] / 2, CAR_M / 2], (len(steps), 1))
        boxes = rr.Boxes3D.columns(half_sizes=half, centers=centres, quaternions=turns, colors=np.full(len(steps), colour))
        self.columns(f"car{car}/box", steps, boxes)
        back, stride = round(TRAIL_S * self.hz), max(round(self.hz / TRAIL_HZ), 1)
        driven = [steps[(steps >= step - back) & (steps <= step)][::-1][::stride] for step in steps]
        strips = [np.c_[place[rows], np.full(len(rows), 0.05)] for rows in driven]
        self.columns(f"car{car}/trail", steps, rr.LineStrips3D.columns(strips=strips, colors=np.full(len(steps), colour)))
        goal = np.asarray(shots.goal[steps, car], float)
        begins = np.flatnonzero(np.r_[True, (goal[1:] != goal[:-1]).any(axis=1)])
        ring = goal_radius_m * np.c_[np.cos(ROUND), np.sin(ROUND), 0 * ROUND]
        rings = [ring + np.r_[goal[row], 0.05] for row in begins]
        self.columns(f"car{car}/goal", steps[begins], rr.LineStrips3D.columns(strips=rings, colors=np.full(len(rings), colour)))
        if (gone := _gone(steps, len(self.time))).size:
            self.columns(f"car{car}", gone, rr.Clear.columns(is_recursive=[True] * len(gone)))

    def _send_series(self, which: str, car: int, steps: Int[np.ndarray, " n"], values: Float[np.ndarray, " T"]) -> None:
        if not len(steps):
            return
        place = f"series/{which}/car{car}"
        self.log(place, self.rr.SeriesLines(colors=[list(drawing.colour_of(car))], names=[f"{which} of car {car}, {SERIES[which]}"]))
        self.columns(place, steps, self.rr.Scalars.columns(scalars=np.asarray(values[steps], float)))

    def _send_events(self, active: Bool[np.ndarray, "T A"]) -> None:
        found = sorted((int(t), int(car), name) for name, new in vars(self.shots.events).items() for t, car in np.argwhere(new & active))
        if found:
            text = [f"car {car}: {drawing.MARKS[name].label}" for _, car, name in found]
            colours = np.array([pack_polylines(drawing.MARKS[name].colour) for _, _, name in found])
            self.columns("events", np.array([step for step, _, _ in found]), self.rr.TextLog.columns(text=text, color=colours))

    def _send_others(self) -> None:
        others, present = self.shots.traffic, np.asarray(self.shots.traffic.present)
        if not present.any():
            return
        steps, rows = np.nonzero(present)
        yaw, size = np.asarray(others.yaw, float)[steps, rows], np.asarray(others.size, float)[steps, rows]
        zero = np.zeros(len(rows))
        columns = self.rr.Boxes3D.columns(
            half_sizes=np.c_[size / 2, zero + OTHER_M / 2],
            centers=np.c_[np.asarray(others.position, float)[steps, rows], zero + OTHER_M / 2],
            quaternions=np.c_[zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)],
            colors=np.full(len(rows), pack_polylines(OTHER)),
        )
        self.columns("traffic", np.arange(len(present)), columns.partition(present.sum(axis=1)))


def series(shots: StepRecord) -> Mapping[str, Float[np.ndarray, "T A"]]:
    """Every number of `SERIES`, of every car at every step; not finite: not there."""
    action = np.asarray(shots.action, float)
    read = {"throttle": action[..., 0], "steer": action[..., 1], "brake": action[..., 2], "friction": shots.grip}
    read |= {"reward": sum(np.asarray(term, float) for term in shots.terms.values())}
    near = {name: np.where(getattr(shots, name) <= replay_data.TTC_MOST_S, getattr(shots, name), np.nan) for name in ("ttc", "edge_ttc")}
    read |= near
    return {name: np.asarray(read[name] if name in read else getattr(shots, name), float) for name in SERIES}


def pack_polylines(colour: drawing.Colour) -> np.uint32:
    """A colour as one number, which every version of rerun takes for one colour."""
    red, green, blue = colour
    return np.uint32(red << 24 | green << 16 | blue << 8 | 255)


def _gone(steps: Int[np.ndarray, " n"], length: int) -> Int[np.ndarray, " m"]:
    """The first steps at which a car is no longer there."""
    after = np.setdiff1d(steps + 1, steps)
    return after[after < length]
