"""Still bird's-eye figures: one scene or many at their starts, and the trajectories of an episode."""

from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.core.types import Scene
from scenefactory_jax.visualization.birds_eye import control_marks, drawing, patch_overlay, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import ASPHALT, GROUND, INK, MARKS, WHITE, Colour, rgb
from scenefactory_jax.visualization.birds_eye.traffic_shapes import MOVING, Shape
from scenefactory_jax.visualization.report.plots import STYLE

_INCHES, _AXES_FRACTION = 6.4, 0.84  # side of the figure, and the axes' fraction of it
_ROAD = (  # of the legend: label, colour, width
    ("lane", ASPHALT, 6.0), ("bike lane", drawing.BIKE_LANE, 6.0), ("road edge", drawing.EDGE, 1.5), ("yellow line", drawing.YELLOW, 1.5),
    ("crosswalk", drawing.CROSSWALK_LINE, 1.5), ("speed bump", drawing.BUMP, 1.5), ("driveway", drawing.DRIVEWAY_LINE, 1.5),
)  # fmt: skip


@matplotlib.rc_context(STYLE)
def scene_figure(scene: Scene, *, goal_radius_m: float | int, title: str = "", all_road: bool = False, routes: bool = False) -> Figure:
    """Draws a scene at its start: road, lights and stop signs, cars, goals of the same colour and number, logged traffic.

    Args:
        scene: one packed world with numpy or JAX arrays.
        all_road: show the complete road; otherwise the square around starts and goals.
        routes: draw the agents' routes.
    """
    agents = scene.agents
    present = np.flatnonzero(np.asarray(agents.present))
    start, goal = np.asarray(agents.position, float), np.asarray(agents.goal, float)
    points = np.concatenate([start[present], goal[present]])
    if all_road or not len(present):
        points = np.concatenate([points, np.asarray(scene.road.midpoint, float)[np.asarray(scene.road.valid, bool)], np.zeros((1, 2))])
    figure, axes, scale = _make_axes(scene, drawing.fit_view(points, margin=12.0, smallest=50.0), title=title)
    traffic = traffic_shapes.shapes_at_start(scene)
    if routes:
        _draw_routes(axes, scene, scale)
    draw_controls(axes, scene, 0.0, scale)
    draw_traffic(axes, traffic)
    for agent in present.tolist():
        look = {"linewidth": 0.6, "alpha": 0.5, "linestyle": (0, (3, 3))}
        axes.plot(*np.stack([start[agent], goal[agent]]).T, color=rgb(drawing.colour_of(agent)), **look)
        _draw_goal(axes, goal[agent], agent, goal_radius_m, scale)
        draw_car(axes, start[agent], float(agents.yaw[agent]), np.asarray(agents.size[agent]), drawing.colour_of(agent))
    _add_legend(figure, [], car="start", scene=scene, road=True, traffic=bool(traffic))
    return figure


@matplotlib.rc_context(STYLE)
def contact_sheet(scenes: Sequence[tuple[str, Scene]], *, columns: int, inches: float | int) -> Figure:
    """Draws many scenes at their starts as small squares, each at its own scale.

    Args:
        scenes: names and packed worlds with numpy arrays.
        columns: maximum per row.
        inches: side of each square.
    """
    across = max(min(columns, len(scenes)), 1)
    down = max(-(-len(scenes) // across), 1)
    figure = Figure(figsize=(across * inches, down * (inches + 0.22)))
    grid = figure.subplots(down, across, squeeze=False)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=1 - 0.2 / figure.get_figheight(), wspace=0.04, hspace=0.22 / inches)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, (name, scene) in zip(grid.flat, scenes, strict=False):
        points = np.asarray(scene.road.midpoint, float)[np.asarray(scene.road.valid, bool)]
        window = drawing.fit_view(points if len(points) else np.zeros((1, 2)), margin=2.0, smallest=50.0)
        draw_controls(axes, scene, 0.0, draw_road(axes, scene, window, inches=inches))
        draw_traffic(axes, traffic_shapes.shapes_at_start(scene), linewidth=0.15)
        agents = scene.agents
        for agent in np.flatnonzero(np.asarray(agents.present)).tolist():
            box, _ = drawing.car_shape(np.asarray(agents.position[agent]), float(agents.yaw[agent]), np.asarray(agents.size[agent]))
            axes.add_patch(Polygon(box, facecolor=rgb(drawing.colour_of(agent)), edgecolor="none", zorder=3))
        axes.set_title(name if len(name) <= 28 else f"...{name[-25:]}", fontsize=6, pad=2)
    return figure


@matplotlib.rc_context(STYLE)
def trajectory_figure(trajectory: Trajectory) -> Figure:
    """Draws the trajectories of an episode's cars from outlined start to filled end, their goals, events, and the lights at the end.

    Raises:
        TrajectoryError: arrays that do not belong together.
    """
    trajectory = drawing.sanitize_trajectory(trajectory)
    driven, traffic = drawing.is_moving(trajectory), trajectory.traffic
    boxes = [] if traffic is None else list(traffic_shapes.shapes(traffic, 0, traffic_shapes.find_parked(traffic)))
    view = drawing.fit_view(drawing.shown_points(trajectory), margin=12.0, smallest=50.0)
    title = f"{trajectory.title} · {trajectory.weather}" if trajectory.weather else trajectory.title
    figure, axes, scale = _make_axes(trajectory.scene, view, title=title)
    draw_controls(axes, trajectory.scene, trajectory.start_s + (len(trajectory.active) - 1) / trajectory.control_hz, scale)
    draw_traffic(axes, boxes)
    for agent in np.flatnonzero(trajectory.present).tolist():
        steps, active = np.flatnonzero(driven[:, agent]), np.flatnonzero(trajectory.active[:, agent])
        track, colour = trajectory.position[:, agent], drawing.colour_of(agent)
        segments = np.stack([track[steps - 1], track[steps]], axis=1)
        look = {"linewidths": 1.6, "capstyle": "round", "zorder": 3}
        axes.add_collection(LineCollection(list(segments), colors=[rgb(colour)], **look))
        for step, hollow in ((active[0], True), (steps[-1] if len(steps) else active[-1], False)) if len(active) else ():
            draw_car(axes, track[step], float(trajectory.yaw[step, agent]), trajectory.size[agent], colour, hollow=hollow)
        goal = drawing.goal_at(trajectory, int(active[-1]) if len(active) else 0)[agent]
        _draw_goal(axes, goal, agent, trajectory.goal_radius_m, scale)
    events = {name: new & trajectory.present for name, new in trajectory.events.items() if name != "goal_reached"}
    events = {name: events[name] for name in MARKS if name in events and events[name].any()}
    for name, new in events.items():
        look = {"marker": MARKS[name].marker, "markersize": 10, "markeredgecolor": "white", "linestyle": "none", "zorder": 6}
        axes.plot(*trajectory.position[new].T, color=rgb(MARKS[name].colour), **look)
    _add_legend(figure, events, car="end (start: outline)", scene=trajectory.scene, road=False, traffic=bool(boxes))
    return figure


def draw_road(axes: Axes, scene: Scene, window: tuple[float, float, float], *, inches: float | int) -> float:
    """Draws road and patches in a window (left, bottom, side), `inches` wide on paper; returns the scale in points per metre."""
    left, bottom, side = window
    scale = inches * 72 / side
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal", facecolor=rgb(GROUND))
    lines = drawing.strokes(scene)
    below = 1 + (patch_overlay.count_strokes_below(lines) - 0.5) / 100
    patches = patch_overlay.areas(scene.weather)
    for rank, area in enumerate(patches):  # all pieces with their edge first, then filled: the edge surrounds their union
        for colour, width, above in ((area.edge, 1.0, 0.0), (area.colour, 0.1, 0.5)):
            look = {"facecolors": [rgb(colour)], "edgecolors": [rgb(colour)], "linewidths": width}
            axes.add_collection(PolyCollection(area.pieces, **look, zorder=below + 0.004 * (rank + above) / len(patches)))
    for order, stroke in enumerate(lines):
        width = max(stroke.width * scale, 0.08 * inches * stroke.thinnest)
        look = {"linewidths": width, "capstyle": "round", "zorder": 1 + order / 100}  # round ends close the gaps between segments
        axes.add_collection(LineCollection(list(stroke.lines), colors=[rgb(stroke.colour)], **look))
    return scale


def draw_car(axes: Axes, position: np.ndarray, yaw: float, size: np.ndarray, colour: Colour, *, hollow: bool = False) -> None:
    """Draws an oriented box with an arrowhead."""
    box, arrow = drawing.car_shape(np.asarray(position), yaw, size)
    fill, edge = (WHITE, colour) if hollow else (colour, drawing.blend(INK, colour, 0.5))
    axes.add_patch(Polygon(box, facecolor=rgb(fill), edgecolor=rgb(edge), linewidth=0.9, zorder=4))
    axes.add_patch(Polygon(arrow, facecolor=rgb(colour) if hollow else "white", edgecolor="none", alpha=0.9, zorder=5))


def draw_controls(axes: Axes, scene: Scene, time_s: float, scale: float) -> None:
    """Draws stop lines in the colours of their lights at a time since the cars start, and stop signs; `scale` in points per metre."""
    marks = control_marks.find_marks(scene, [time_s])
    bars = control_marks.find_bars(marks, 0)
    look = {"linewidths": max(0.7 * scale, 0.8), "capstyle": "butt", "zorder": 2.2}
    axes.add_collection(LineCollection([bar for bar, _ in bars], colors=[rgb(colour) for _, colour in bars], **look))
    for octagon in control_marks.make_octagons(marks):
        edge = {"edgecolor": "white", "linewidth": max(0.15 * scale, 0.2)}
        axes.add_patch(Polygon(octagon, facecolor=rgb(drawing.STOP), zorder=2.3, **edge))


def _draw_routes(axes: Axes, scene: Scene, scale: float) -> None:
    for stroke in control_marks.route_strokes(scene):
        width = max(stroke.width * scale, stroke.thinnest)
        axes.add_collection(LineCollection(list(stroke.lines), colors=[rgb(stroke.colour)], linewidths=width, zorder=2.1))


def draw_traffic(axes: Axes, shapes: Iterable[Shape], *, linewidth: float = 0.6) -> None:
    """Draws background traffic."""
    for shape in shapes:
        axes.add_patch(Polygon(shape.points, facecolor=rgb(shape.fill), edgecolor=rgb(shape.outline), linewidth=linewidth, zorder=2.5))


def _make_axes(scene: Scene, window: tuple[float, float, float], *, title: str) -> tuple[Figure, Axes, float]:
    """A square figure with the road; also its scale in points per metre."""
    figure = Figure(figsize=(_INCHES, _INCHES))
    axes = figure.add_axes((0.11, 0.115, _AXES_FRACTION, _AXES_FRACTION))
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.grid(False)
    axes.set_title(title)
    return figure, axes, draw_road(axes, scene, window, inches=_INCHES * _AXES_FRACTION)


def _draw_goal(axes: Axes, place: np.ndarray, agent: int, radius_m: float | int, scale: float) -> None:
    """A circle of the goal's radius with the agent's number, in its colour."""
    x, y = (float(value) for value in place)
    axes.add_patch(Circle((x, y), radius_m, fill=False, edgecolor=rgb(drawing.colour_of(agent)), linewidth=1.3, zorder=3.5))
    look: dict[str, Any] = {"fontsize": min(max(radius_m * scale * 0.9, 4.5), 9.0), "ha": "center", "va": "center_baseline"}
    axes.text(x, y, str(agent), color=rgb(drawing.blend(drawing.colour_of(agent), INK, 0.8)), zorder=3.6, clip_on=True, **look)


def _add_legend(figure: Figure, events: Iterable[str], *, car: str, scene: Scene, road: bool, traffic: bool) -> None:
    """Meaning of the shapes, below the axes."""

    def point(marker: Any, colour: Colour, label: str, *, markersize: float = 8.0, **look: Any) -> Line2D:
        return Line2D([], [], marker=marker, linestyle="none", color=rgb(colour), label=label, markersize=markersize, **look)

    box, first = (4, 0, 45), drawing.AGENTS[0]
    handles = [point(box, first, f"car at its {car}", markersize=7.0), point("o", first, "its goal", markerfacecolor="none")]
    if road:
        drawn = {stroke.colour for stroke in drawing.strokes(scene)}
        handles += [Line2D([], [], color=rgb(colour), linewidth=width, label=label) for label, colour, width in _ROAD if colour in drawn]
    signs = np.asarray(scene.controls.stop_sign, bool)[np.asarray(scene.controls.valid, bool)]
    if signs.any():
        handles.append(point("8", drawing.STOP, "stop sign"))
    if (~signs).any():
        handles.append(Line2D([], [], color=rgb(control_marks.LIGHTS[0]), linewidth=3.0, label="light"))
    for area in {area.label: area for area in patch_overlay.areas(scene.weather)}.values():
        handles.append(point("s", area.colour, area.label, markeredgecolor=rgb(area.edge), markeredgewidth=0.6))
    if traffic:
        handles.append(point(box, MOVING, "traffic", markersize=7.0))
    handles += [point(MARKS[name].marker, MARKS[name].colour, MARKS[name].label) for name in events]
    rows = 2 if len(handles) > 6 else 1
    look: dict[str, Any] = {"fontsize": 7.5, "labelspacing": 0.25, "borderpad": 0.0} if rows == 2 else {}
    figure.legend(handles=handles, loc="lower center", ncols=-(-len(handles) // rows), handletextpad=0.5, columnspacing=1.4, **look)
