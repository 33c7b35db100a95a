"""Figures of failures: the worst of a kind side by side, each with its complete trajectory and with the surroundings of the failure."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation.failures import FAILURE_TYPES, FLAGS, Failure
from scenefactory_jax.visualization.birds_eye import drawing, figures, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import INK, QUIET, Colour, rgb
from scenefactory_jax.visualization.report.plots import STYLE

FAILED: Colour = (208, 28, 40)
PARTNER: Colour = (0, 90, 181)
CAR: Colour = (150, 156, 163)
GOAL: Colour = (0, 138, 82)
_DETAIL_M, _INCHES = 32.0, 3.1


class Case(NamedTuple):
    """A failure, its world, and the index of the road user that the car hit first (traffic is counted on from the last agent)."""

    failure: Failure
    trajectory: Trajectory
    hit: int | None


@matplotlib.rc_context(STYLE)
def failures_figure(cases: Sequence[Case], *, before_s: float | int) -> Figure:
    """Draws a column per failure: above the complete trajectory and the goal, below the surroundings at the time of the failure.

    Args:
        cases: failures of one type.
        before_s: seconds of the other cars' trajectories before the failure.
    """
    figure = Figure(figsize=(_INCHES * len(cases), 2 * _INCHES + 1.0), layout="constrained")
    figure.suptitle(FAILURE_TYPES[cases[0].failure.kind].label, fontsize=9, fontweight="bold", x=0.01, ha="left")
    for case, (above, below) in zip(cases, figure.subplots(2, len(cases), squeeze=False).T, strict=True):
        case = case._replace(trajectory=drawing.sanitize_trajectory(case.trajectory))
        _draw(above, case, _find_overview_window(case), before_s=before_s, overview=True)
        _draw(below, case, _find_detail_window(case), before_s=before_s, overview=False)
        above.set_title(_title(case.failure), fontsize=7.5, fontweight="normal", loc="left", pad=3)
    hollow = {"markerfacecolor": "none", "linestyle": "none", "markersize": 8}
    handles = [
        Line2D([], [], color=rgb(FAILED), linewidth=2.2, label="its trajectory (dashed: afterwards)"),
        Line2D([], [], color=rgb(INK), marker="s", label="area below", **hollow),
        Line2D([], [], color=rgb(GOAL), marker="o", label="its goal", **hollow),
        Line2D([], [], color=rgb(CAR), linewidth=1.2, label="other cars"),
    ]
    if any(case.hit is not None for case in cases):
        handles.insert(2, Line2D([], [], color=rgb(PARTNER), linewidth=1.6, label="collision partner"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(2 * len(cases), len(handles)), fontsize=7.5, handletextpad=0.5)
    return figure


def _title(failure: Failure) -> str:
    """Scene, car, time and severity; the other flags in a third line."""
    kind, name = FAILURE_TYPES[failure.kind], failure.scene
    name = name if len(name) <= 42 else f"…{name[-41:]}"
    flags = ", ".join(FLAGS[flag] for flag in failure.flags)
    line = f"{failure.moment_s:.1f} s · {kind.measure} {failure.severity:.1f} {kind.unit}"
    return f"{name} · car {failure.agent}\n{line}" + (f"\nalso {flags}" if flags else "")


def _find_overview_window(case: Case) -> tuple[float, float, float]:
    """The square that shows the car's trajectory, its goal and the place of the failure."""
    agent, trajectory = case.failure.agent, case.trajectory
    track = trajectory.position[trajectory.active[:, agent], agent]
    points = np.concatenate([track, drawing.goal_at(trajectory, _find_step(case))[[agent]], [case.failure.position]])
    return drawing.fit_view(points, margin=9.0, smallest=50.0)


def _find_detail_window(case: Case) -> tuple[float, float, float]:
    x, y = case.failure.position
    return x - _DETAIL_M / 2, y - _DETAIL_M / 2, _DETAIL_M


def _find_step(case: Case) -> int:
    """The frame of the failure; the first frame is the state after one step."""
    return int(np.clip(round(case.failure.moment_s * case.trajectory.control_hz) - 1, 0, len(case.trajectory.active) - 1))


def _draw(axes: Axes, case: Case, window: tuple[float, float, float], *, before_s: float | int, overview: bool) -> None:
    trajectory, step, agent = case.trajectory, _find_step(case), case.failure.agent
    scale = figures.draw_road(axes, trajectory.scene, window, inches=_INCHES)
    figures.draw_controls(axes, trajectory.scene, trajectory.start_s + step / trajectory.control_hz, scale)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=rgb(QUIET), linewidth=0.6)
    _draw_traffic(axes, case, step)
    driven, since = drawing.is_moving(trajectory), max(step - round(before_s * trajectory.control_hz), 0)
    for other in np.flatnonzero(trajectory.present & trajectory.active[step]).tolist():
        if other != agent:
            colour, width = (PARTNER, 1.6) if other == case.hit else (CAR, 1.0)
            _draw_track(axes, trajectory, driven, other, since, step, colour, linewidth=width)
            figures.draw_car(axes, trajectory.position[step, other], float(trajectory.yaw[step, other]), trajectory.size[other], colour)
    _draw_track(axes, trajectory, driven, agent, step, len(driven) - 1, FAILED, linewidth=1.1, linestyle=(0, (3, 2)))
    _draw_track(axes, trajectory, driven, agent, 0, step, FAILED, linewidth=2.2 if overview else 1.6)
    figures.draw_car(axes, trajectory.position[step, agent], float(trajectory.yaw[step, agent]), trajectory.size[agent], FAILED)
    x, y = (float(value) for value in drawing.goal_at(trajectory, step)[agent])
    axes.add_patch(Circle((x, y), trajectory.goal_radius_m, fill=False, edgecolor=rgb(GOAL), linewidth=1.8, zorder=6))
    if overview:
        left, bottom, side = _find_detail_window(case)
        look = {"fill": False, "edgecolor": rgb(INK), "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 7}
        axes.add_patch(Rectangle((left, bottom), side, side, **look))


def _draw_traffic(axes: Axes, case: Case, step: int) -> None:
    """Background traffic; the outline of the collision partner in its colour."""
    boxes = case.trajectory.traffic
    if boxes is None:
        return
    figures.draw_traffic(axes, traffic_shapes.shapes(boxes, step, traffic_shapes.find_parked(boxes)))
    partner = -1 if case.hit is None else case.hit - len(case.trajectory.present)
    if 0 <= partner < boxes.present.shape[1]:
        box, _ = drawing.car_shape(boxes.position[step, partner], float(boxes.yaw[step, partner]), boxes.size[step, partner])
        axes.add_patch(Polygon(box, fill=False, edgecolor=rgb(PARTNER), linewidth=1.6, zorder=5))


def _draw_track(axes: Axes, trajectory: Trajectory, driven: np.ndarray, agent: int, first: int, last: int, colour: Colour, **look) -> None:
    """A car's trajectory between two steps, with a gap at each respawn."""
    steps = np.flatnonzero(driven[first + 1 : last + 1, agent]) + first + 1
    for run in np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1) if len(steps) else ():
        axes.plot(*trajectory.position[np.r_[run[0] - 1, run], agent].T, color=rgb(colour), zorder=3, **look)
