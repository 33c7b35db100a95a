"""Figures of adversarial scenes: the ego, the adversary and its log at the time of the contact."""

from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.evaluation.adversary.kinematics import Track
from scenefactory_jax.visualization.birds_eye import drawing, figures, traffic_shapes
from scenefactory_jax.visualization.birds_eye.drawing import Colour, rgb
from scenefactory_jax.visualization.report.plots import STYLE

EGO: Colour = (0, 90, 181)
ADVERSARY: Colour = (208, 28, 40)
LOGGED: Colour = (120, 126, 133)
_INCHES = 4.2


class AttackedWorld(NamedTuple):
    """One adversarial scene: tracks of [T] states, the contact in state `step`."""

    title: str
    scene: Scene
    ego: Track
    adversary: Track
    logged: Track  # of the adversary
    ego_size: np.ndarray
    adversary_size: np.ndarray
    traffic: TrafficBoxes
    step: int


@matplotlib.rc_context(STYLE)
def attack_figure(world: AttackedWorld) -> Figure:
    """Draws the whole way and, beside it, the surroundings of the contact; lines are dashed behind it, cars are as they are then."""
    step, contact = world.step, world.ego.position[world.step]
    driven = np.concatenate([world.ego.position, world.adversary.position])
    windows = drawing.fit_view(driven, margin=9.0, smallest=50.0), (float(contact[0]) - 16.0, float(contact[1]) - 16.0, 32.0)
    figure = Figure(figsize=(2 * _INCHES, _INCHES + 0.7), layout="constrained")
    figure.suptitle(world.title, fontsize=9)
    for axes, window in zip(figure.subplots(1, 2), windows, strict=True):
        figures.draw_controls(axes, world.scene, step / 10.0, figures.draw_road(axes, world.scene, window, inches=_INCHES))
        axes.set(xticks=[], yticks=[])
        figures.draw_traffic(axes, traffic_shapes.shapes(world.traffic, step, traffic_shapes.find_parked(world.traffic)))
        axes.plot(*world.logged.position.T, color=rgb(LOGGED), linewidth=1.2, zorder=3)
        for track, size, colour in ((world.ego, world.ego_size, EGO), (world.adversary, world.adversary_size, ADVERSARY)):
            axes.plot(*track.position[: step + 1].T, color=rgb(colour), linewidth=1.8, zorder=3.2)
            axes.plot(*track.position[step:].T, color=rgb(colour), linewidth=1.0, linestyle=(0, (3, 2)), zorder=3.1)
            figures.draw_car(axes, np.asarray(track.position[0]), float(track.yaw[0]), size, colour, hollow=True)
            figures.draw_car(axes, np.asarray(track.position[step]), float(track.yaw[step]), size, colour)
    names = ((EGO, "ego"), (ADVERSARY, "adversary"), (LOGGED, "the adversary's log"))
    handles = [Line2D([], [], color=rgb(colour), linewidth=1.8, label=label) for colour, label in names]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7.5)
    return figure
