"""Still bird's-eye pictures: a scene as it starts, and the ways that cars took through it."""

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from scenefactory_jax.core.trajectory import TrafficBoxes, Trajectory
from scenefactory_jax.core.types import Scene
from scenefactory_jax.visualization.birds_eye import drawing, patch_overlay, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import ASPHALT, GROUND, INK, MARKS, Colour
from scenefactory_jax.visualization.birds_eye.patch_overlay import Area
from scenefactory_jax.visualization.birds_eye.traffic_shapes import MOVING as OTHERS
from scenefactory_jax.visualization.report.plots import STYLE

_INCHES, _SHARE = 6.4, 0.84  # side of the figure, and the axes' share of it
_ROAD = (  # of the legend: label, colour, width
    ("lane", ASPHALT, 6.0), ("bike lane", drawing.BIKE_LANE, 6.0), ("road edge", drawing.EDGE, 1.5), ("yellow line", drawing.YELLOW, 1.5),
    ("crosswalk", drawing.CROSSWALK_LINE, 1.5), ("speed bump", drawing.BUMP, 1.5), ("driveway", drawing.DRIVEWAY_LINE, 1.5),
    ("stop sign", drawing.STOP, 3.0),
)  # fmt: skip


def scene_figure(scene: Scene, *, title: str = "", whole: bool = False) -> Figure:
    """A scene as it starts: road, cars as oriented boxes, goals as circles of the same colour and number, and who else was there.

    Args:
        scene: one packed world with numpy or JAX arrays.
        title: above the picture.
        whole: show the whole road; otherwise the square around starts and goals.
    """
    agents = scene.agents
    present = np.flatnonzero(np.asarray(agents.present))
    start, goal = np.asarray(agents.position, float), np.asarray(agents.goal, float)
    points = np.concatenate([start[present], goal[present]])
    if whole or not len(present):
        points = np.concatenate([points, np.asarray(scene.road.midpoint, float)[np.asarray(scene.road.valid, bool)], np.zeros((1, 2))])
    with matplotlib.rc_context(STYLE):
        figure, axes, scale = _stage(scene, drawing.fit_view(points, margin=12.0, smallest=50.0), title=title)
        recorded, still = traffic_shapes.shapes_at_start(scene)
        _draw_traffic(axes, recorded, 0, still)
        for agent in present.tolist():
            look = {"linewidth": 0.6, "alpha": 0.5, "linestyle": (0, (3, 3))}
            axes.plot(*np.stack([start[agent], goal[agent]]).T, color=_rgb(drawing.colour_of(agent)), **look)
            _draw_goal(axes, goal[agent], agent, scale)
            _draw_car(axes, start[agent], float(agents.yaw[agent]), np.asarray(agents.size[agent]), agent)
        _legend(figure, [], car="start", scene=scene, road=True, beside=bool(recorded.present.any()))
    return figure


def trajectory_figure(trajectory: Trajectory) -> Figure:
    """The ways of an episode's cars from hollow start to filled end, their goals, and where events happened.

    Raises:
        TrajectoryError: arrays that do not belong together.
    """
    trajectory = drawing.sanitize_trajectory(trajectory)
    driven = drawing.is_moving(trajectory)
    with matplotlib.rc_context(STYLE):
        view = drawing.fit_view(drawing.places(trajectory), margin=12.0, smallest=50.0)
        title = f"{trajectory.title} · {trajectory.weather}" if trajectory.weather else trajectory.title
        figure, axes, scale = _stage(trajectory.scene, view, title=title)
        if trajectory.traffic is not None:
            _draw_traffic(axes, trajectory.traffic, 0, traffic_shapes.shapes_at_rest(trajectory.traffic))
        for agent in np.flatnonzero(trajectory.present).tolist():
            steps = np.flatnonzero(driven[:, agent])
            way = trajectory.position[:, agent]
            segments = np.stack([way[steps - 1], way[steps]], axis=1)
            look = {"linewidths": 1.6, "capstyle": "round", "zorder": 3}
            axes.add_collection(LineCollection(list(segments), colors=[_rgb(drawing.colour_of(agent))], **look))
            shown = np.flatnonzero(trajectory.active[:, agent])
            for step, hollow in ((shown[0], True), (steps[-1] if len(steps) else shown[-1], False)) if len(shown) else ():
                place, yaw = way[step], float(trajectory.yaw[step, agent])
                _draw_car(axes, place, yaw, trajectory.size[agent], agent, hollow=hollow)
            last = int(shown[-1]) if len(shown) else 0
            _draw_goal(axes, drawing.goal_at(trajectory, last)[agent], agent, scale)
        seen = [name for name in MARKS if name in trajectory.events and (trajectory.events[name] & trajectory.present).any()]
        for name in seen:
            if name != "goal_reached":
                points = trajectory.position[trajectory.events[name] & trajectory.present]
                look = {"marker": MARKS[name].marker, "markersize": 10, "markeredgecolor": "white", "linestyle": "none", "zorder": 6}
                axes.plot(*points.T, color=_rgb(MARKS[name].colour), **look)
        beside = trajectory.traffic is not None and bool(trajectory.traffic.present[0].any())
        shown = [name for name in seen if name != "goal_reached"]
        _legend(figure, shown, car="end (start: outline)", scene=trajectory.scene, road=False, beside=beside)
    return figure


def _stage(scene: Scene, window: tuple[float, float, float], *, title: str) -> tuple[Figure, Axes, float]:
    """A square figure with the road; also its scale in points a metre."""
    left, bottom, side = window
    figure = Figure(figsize=(_INCHES, _INCHES))
    axes = figure.add_axes((0.11, 0.115, _SHARE, _SHARE))
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal", xlabel="x, m", ylabel="y, m", facecolor=_rgb(GROUND))
    axes.grid(False)
    axes.set_title(title)
    scale = _INCHES * _SHARE * 72 / side
    lines = drawing.strokes(scene.road)
    _draw_areas(axes, patch_overlay.areas(scene.weather), zorder=1 + (patch_overlay.draw_areas_below(lines) - 0.5) / 100)
    for order, stroke in enumerate(lines):
        width = max(stroke.width * scale, 0.5 * stroke.thinnest)
        look = {"linewidths": width, "capstyle": "round" if width > 4 else "butt", "zorder": 1 + order / 100}
        axes.add_collection(LineCollection(list(stroke.lines), colors=[_rgb(stroke.colour)], **look))
    return figure, axes, scale


def _draw_areas(axes: Axes, patches: list[Area], *, zorder: float) -> None:
    """Patches with an edge about the union of each one's pieces: all pieces with their edge first, then filled once more without."""
    for rank, area in enumerate(patches):
        for colour, width, above in ((area.edge, 1.0, 0.0), (area.colour, 0.1, 0.5)):
            look = {"facecolors": [_rgb(colour)], "edgecolors": [_rgb(colour)], "linewidths": width}
            axes.add_collection(PolyCollection(area.pieces, **look, zorder=zorder + 0.004 * (rank + above) / len(patches)))


def _draw_car(axes: Axes, position: np.ndarray, yaw: float, size: np.ndarray, agent: int, *, hollow: bool = False) -> None:
    """An oriented box with an arrowhead, as in the videos."""
    colour = drawing.colour_of(agent)
    box, arrow = drawing.car_shape(np.asarray(position), yaw, size)
    fill, edge = ((255, 255, 255), colour) if hollow else (colour, drawing.blend(INK, colour, 0.5))
    axes.add_patch(Polygon(box, facecolor=_rgb(fill), edgecolor=_rgb(edge), linewidth=0.9, zorder=4))
    axes.add_patch(Polygon(arrow, facecolor=_rgb(colour) if hollow else "white", edgecolor="none", alpha=0.9, zorder=5))


def _draw_traffic(axes: Axes, boxes: TrafficBoxes, step: int, still: np.ndarray) -> None:
    """Everybody who is no agent at one step."""
    for shape in traffic_shapes.shapes(boxes, step, still):
        look = {"facecolor": _rgb(shape.fill), "edgecolor": _rgb(shape.outline), "linewidth": 0.6, "zorder": 2.5}
        axes.add_patch(Polygon(shape.points, **look))


def _draw_goal(axes: Axes, place: np.ndarray, agent: int, scale: float) -> None:
    """A circle of the goal's radius with the agent's number, in its colour."""
    x, y = (float(value) for value in place)
    colour = _rgb(drawing.blend(drawing.colour_of(agent), INK, 0.8))
    axes.add_patch(Circle((x, y), drawing.GOAL_RADIUS, fill=False, edgecolor=_rgb(drawing.colour_of(agent)), linewidth=1.3, zorder=3.5))
    size = min(max(drawing.GOAL_RADIUS * scale * 0.9, 4.5), 9.0)
    axes.text(x, y, str(agent), color=colour, fontsize=size, ha="center", va="center_baseline", zorder=3.6, clip_on=True)


def _legend(figure: Figure, events: list[str], *, car: str, scene: Scene, road: bool, beside: bool) -> None:
    """What the shapes mean, below the axes."""
    handles = [
        Line2D([], [], marker=(4, 0, 45), linestyle="none", color=_rgb(drawing.AGENTS[0]), markersize=7, label=f"car at its {car}"),
        Line2D([], [], marker="o", linestyle="none", color=_rgb(drawing.AGENTS[0]), markerfacecolor="none", markersize=8, label="its goal"),
    ]
    if road:
        drawn = {stroke.colour for stroke in drawing.strokes(scene.road)}
        handles += [Line2D([], [], color=_rgb(colour), linewidth=width, label=label) for label, colour, width in _ROAD if colour in drawn]
    for area in {area.label: area for area in patch_overlay.areas(scene.weather)}.values():
        look = {"color": _rgb(area.colour), "markeredgecolor": _rgb(area.edge), "markeredgewidth": 0.6}
        handles.append(Line2D([], [], marker="s", linestyle="none", markersize=8, label=area.label, **look))
    if beside:
        handles.append(Line2D([], [], marker=(4, 0, 45), linestyle="none", color=_rgb(OTHERS), markersize=7, label="traffic"))
    for name in events:
        mark = MARKS[name]
        handles.append(Line2D([], [], marker=mark.marker, linestyle="none", color=_rgb(mark.colour), markersize=8, label=mark.label))
    crowded = len(handles) > 6  # two rows below the axes, in smaller print
    look = {"fontsize": 7.5, "labelspacing": 0.25, "borderpad": 0.0} if crowded else {}
    columns = -(-len(handles) // (2 if crowded else 1))
    figure.legend(handles=handles, loc="lower center", ncols=columns, handletextpad=0.5, columnspacing=1.4, **look)


def _rgb(colour: Colour) -> tuple[float, float, float]:
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue
