"""One picture of many scenes: roads and cars of each in a small square, to see at a glance what a bank holds."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from scenefactory_jax.core.types import Scene
from scenefactory_jax.visualization.birds_eye import drawing, traffic_shapes
from scenefactory_jax.visualization.report.plots import STYLE


def contact_sheet(scenes: Sequence[tuple[str, Scene]], *, columns: int, inches: float) -> Figure:
    """Scenes as they start, row after row, each at its own scale.

    Args:
        scenes: names and packed worlds with numpy arrays.
        columns: most in a row.
        inches: side of each square.
    """
    across = max(min(columns, len(scenes)), 1)
    down = max(-(-len(scenes) // across), 1)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(across * inches, down * (inches + 0.22)))
        grid = figure.subplots(down, across, squeeze=False)
        figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=1 - 0.2 / figure.get_figheight(), wspace=0.04, hspace=0.22 / inches)
        for axes in grid.flat:
            axes.set_axis_off()
        for axes, (name, scene) in zip(grid.flat, scenes, strict=False):
            _draw(axes, scene, inches)
            axes.set_title(name if len(name) <= 28 else f"...{name[-25:]}", fontsize=6, pad=2)
    return figure


def _draw(axes, scene: Scene, inches: float) -> None:
    """One scene's road and cars."""
    points = np.asarray(scene.road.midpoint, float)[np.asarray(scene.road.valid, bool)]
    left, bottom, side = drawing.fit_view(points if len(points) else np.zeros((1, 2)), margin=2.0, smallest=50.0)
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal")
    for order, stroke in enumerate(drawing.strokes(scene.road)):
        width = max(stroke.width * inches * 72 / side, 0.25 * stroke.thinnest)
        axes.add_collection(LineCollection(list(stroke.lines), colors=[_rgb(stroke.colour)], linewidths=width, zorder=1 + order / 100))
    recorded, still = traffic_shapes.shapes_at_start(scene)
    shapes = list(traffic_shapes.shapes(recorded, 0, still))
    axes.add_collection(PolyCollection([shape.points for shape in shapes], facecolors=[_rgb(shape.fill) for shape in shapes], zorder=2.5))
    agents = scene.agents
    present = np.flatnonzero(np.asarray(agents.present)).tolist()
    boxes = [drawing.car_shape(np.asarray(agents.position[i]), float(agents.yaw[i]), np.asarray(agents.size[i]))[0] for i in present]
    axes.add_collection(PolyCollection(boxes, facecolors=[_rgb(drawing.colour_of(i)) for i in present], zorder=3))


def _rgb(colour: drawing.Colour) -> tuple[float, float, float]:
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue
