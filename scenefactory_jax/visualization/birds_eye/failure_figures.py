"""Pictures of failures: the worst of a kind side by side, each whole (way, goal) and near (the moment at which it failed)."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation.failures import FLAGS, KINDS, Failure
from scenefactory_jax.visualization.birds_eye import drawing, patch_overlay, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import INK, QUIET, Colour, View
from scenefactory_jax.visualization.birds_eye.video import road_image
from scenefactory_jax.visualization.report.plots import STYLE

FAILED: Colour = (208, 28, 40)
PARTNER: Colour = (0, 90, 181)
CAR: Colour = (150, 156, 163)
GOAL: Colour = (0, 138, 82)
_NEAR_M, _PIXELS, _INCHES = 32.0, 560, 3.1


class Case(NamedTuple):
    """A failure, the world in which it happened, and the number of whom the car hit first (boxes are counted on from the last agent)."""

    failure: Failure
    trajectory: Trajectory
    hit: int | None


def failures_figure(cases: Sequence[Case], *, before_s: float) -> Figure:
    """A column a failure: above its whole way and goal, below what was around it at the moment of the failure.

    Args:
        cases: failures of one kind.
        before_s: seconds of the others' ways before the moment.

    Raises:
        TrajectoryError: arrays that do not belong together.
    """
    kind = KINDS[cases[0].failure.kind]
    with matplotlib.rc_context(STYLE):
        rows = 1 if len(cases) > 2 else 2 if len(cases) > 1 else 3  # of the legend
        head = 0.14 * max(_title(case.failure).count("\n") + 1 for case in cases) + 0.22
        height = 2 * _INCHES + head + 0.08 + 0.18 * rows
        figure = Figure(figsize=(_INCHES * len(cases), height))
        figure.text(0.01 / len(cases), 1 - 0.04 / height, kind.label, fontsize=9, fontweight="bold", va="top")
        for column, case in enumerate(cases):
            case = case._replace(trajectory=drawing.sanitize_trajectory(case.trajectory))
            for row, window in enumerate((_whole(case), _near(case))):
                width, tall = 1 / len(cases), _INCHES / height
                place = ((column + 0.01) * width, 1 - head / height - (row + 0.99) * tall, 0.98 * width, 0.98 * tall)
                axes = figure.add_axes(place)
                _draw(axes, case, window, before_s=before_s, whole=row == 0)
                if row == 0:
                    axes.set_title(_title(case.failure), fontsize=7.5, fontweight="normal", loc="left", pad=3)
        handles = [
            Line2D([], [], color=_rgb(FAILED), linewidth=2.2, label="its way (dashed: afterwards)"),
            Line2D([], [], color=_rgb(INK), marker="s", markerfacecolor="none", linestyle="none", markersize=8, label="where: seen below"),
            Line2D([], [], color=_rgb(GOAL), marker="o", markerfacecolor="none", linestyle="none", markersize=8, label="its goal"),
            Line2D([], [], color=_rgb(CAR), linewidth=1.2, label="other cars"),
        ]
        if any(case.hit is not None for case in cases):
            handles.insert(2, Line2D([], [], color=_rgb(PARTNER), linewidth=1.6, label="whom it met"))
        figure.legend(handles=handles, loc="lower center", ncols=-(-len(handles) // rows), fontsize=7.5, handletextpad=0.5, borderpad=0.0)
    return figure


def _title(failure: Failure) -> str:
    """Who, where, when, how bad, and what else is true: a line for what is known of every failure, and one more for the rest."""
    kind, name = KINDS[failure.kind], failure.scene
    name = name if len(name) <= 42 else f"…{name[-41:]}"
    also = ", ".join(FLAGS[flag] for flag in failure.flags)
    line = f"{failure.moment_s:.1f} s · {kind.measure} {failure.severity:.1f} {kind.unit}"
    return f"{name} · car {failure.agent}\n{line}" + (f"\nalso {also}" if also else "")


def _whole(case: Case) -> tuple[float, float, float]:
    """The square that shows the car's way, its goal and the place."""
    agent, trajectory = case.failure.agent, case.trajectory
    way = trajectory.position[trajectory.active[:, agent], agent]
    points = np.concatenate([way, drawing.goal_at(trajectory, _step(case))[[agent]], [case.failure.place]])
    return drawing.fit_view(points, margin=9.0, smallest=50.0)


def _near(case: Case) -> tuple[float, float, float]:
    x, y = case.failure.place
    return x - _NEAR_M / 2, y - _NEAR_M / 2, _NEAR_M


def _step(case: Case) -> int:
    """The frame of the moment: the first frame is what one step led to."""
    return int(np.clip(round(case.failure.moment_s * case.trajectory.control_hz) - 1, 0, len(case.trajectory.active) - 1))


def _draw(axes: Axes, case: Case, window: tuple[float, float, float], *, before_s: float, whole: bool) -> None:
    """One picture."""
    trajectory, step, agent = case.trajectory, _step(case), case.failure.agent
    left, bottom, side = window
    road = road_image(drawing.strokes(trajectory.scene.road), View(*window, _PIXELS), patches=patch_overlay.areas(trajectory.scene.weather))
    axes.imshow(np.asarray(road), extent=(left, left + side, bottom, bottom + side), interpolation="antialiased", zorder=0)
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=_rgb(QUIET), linewidth=0.6)
    cars = len(trajectory.present)
    if trajectory.traffic is not None:
        _draw_others(axes, case, step, partner=None if case.hit is None else case.hit - cars)
    driven, since = drawing.is_moving(trajectory), max(step - round(before_s * trajectory.control_hz), 0)
    for other in np.flatnonzero(trajectory.present & (trajectory.active[: step + 1].any(axis=0))):
        met = case.hit == other
        if other == agent or not trajectory.active[step, other]:
            continue
        colour = PARTNER if met else CAR
        _draw_way(axes, trajectory, driven, int(other), since, step, colour, width=1.6 if met else 1.0, dashed=False)
        _draw_car(axes, trajectory, int(other), step, colour)
    _draw_way(axes, trajectory, driven, agent, step, len(driven) - 1, FAILED, width=1.1, dashed=True)
    _draw_way(axes, trajectory, driven, agent, 0, step, FAILED, width=2.2 if whole else 1.6, dashed=False)
    _draw_car(axes, trajectory, agent, step, FAILED)
    goal = drawing.goal_at(trajectory, step)[agent]
    axes.add_patch(Circle((float(goal[0]), float(goal[1])), drawing.GOAL_RADIUS, fill=False, edgecolor=_rgb(GOAL), linewidth=1.8, zorder=6))
    if whole:
        left, bottom, side = _near(case)
        look = {"fill": False, "edgecolor": _rgb(INK), "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 7}
        axes.add_patch(Rectangle((left, bottom), side, side, **look))


def _draw_others(axes: Axes, case: Case, step: int, *, partner: int | None) -> None:
    """Everybody who is no agent; whom the car hit in the partner's colour."""
    boxes = case.trajectory.traffic
    assert boxes is not None
    still = traffic_shapes.shapes_at_rest(boxes)
    for shape in traffic_shapes.shapes(boxes, step, still):
        look = {"facecolor": _rgb(shape.fill), "edgecolor": _rgb(shape.outline), "linewidth": 0.6, "zorder": 2.5}
        axes.add_patch(Polygon(shape.points, **look))
    if partner is not None and 0 <= partner < boxes.present.shape[1]:
        box, _ = drawing.car_shape(boxes.position[step, partner], float(boxes.yaw[step, partner]), boxes.size[step, partner])
        axes.add_patch(Polygon(box, fill=False, edgecolor=_rgb(PARTNER), linewidth=1.6, zorder=5))


def _draw_way(
    axes: Axes, trajectory: Trajectory, driven: np.ndarray, agent: int, first: int, last: int, colour: Colour, *, width: float, dashed: bool
) -> None:
    """A car's way between two steps."""
    steps = np.flatnonzero(driven[:, agent])
    steps = steps[(steps > first) & (steps <= last)]
    if not len(steps):
        return
    way = trajectory.position[:, agent]
    if dashed:  # one line, or the dashes would start anew at every step
        axes.plot(*way[np.r_[steps[0] - 1, steps]].T, color=_rgb(colour), linewidth=width, linestyle=(0, (3, 2)), zorder=3)
        return
    segments = np.stack([way[steps - 1], way[steps]], axis=1)
    axes.add_collection(LineCollection(list(segments), colors=[_rgb(colour)], linewidths=width, capstyle="round", zorder=3))


def _draw_car(axes: Axes, trajectory: Trajectory, agent: int, step: int, colour: Colour) -> None:
    """An oriented box with an arrowhead."""
    box, arrow = drawing.car_shape(trajectory.position[step, agent], float(trajectory.yaw[step, agent]), trajectory.size[agent])
    axes.add_patch(Polygon(box, facecolor=_rgb(colour), edgecolor=_rgb(drawing.blend(INK, colour, 0.5)), linewidth=0.8, zorder=4))
    axes.add_patch(Polygon(arrow, facecolor="white", edgecolor="none", alpha=0.9, zorder=5))


def _rgb(colour: Colour) -> tuple[float, float, float]:
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue
