"""What bridges cover in pictures from above."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageChops

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.visualization import road_levels
from scenefactory_jax.visualization.birds_eye import drawing
from scenefactory_jax.visualization.birds_eye.drawing import View
from scenefactory_jax.visualization.birds_eye.road_picture import road_image


class Bridges(NamedTuple):
    """The bridges of a picture, and what is under them."""

    mask: Image.Image | None  # of the pixels that they change; None: there are none
    cars: Bool[np.ndarray, "T A"]
    traffic: Bool[np.ndarray, "T O"]


def find_bridges(trajectory: Trajectory, view: View) -> Bridges:
    """Finds bridges by the picture of the higher levels of the road, and what is under them by heights; without heights nothing is."""
    higher = drawing.strokes(trajectory.scene, first=1)
    change = ImageChops.difference(road_image(higher, view), road_image([], view)) if higher else None
    mask = change and change.convert("L").point(lambda value: 255 if value else 0)
    traffic = trajectory.traffic
    boxes = (np.zeros((len(trajectory.active), 0, 2)), None) if traffic is None else (traffic.position, traffic.elevation)
    cars, others = (road_levels.find_covered(trajectory.scene, *users) for users in ((trajectory.position, trajectory.height), boxes))
    return Bridges(mask, cars, others)
