"""Traffic lights and stop signs in three dimensions, as boxes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.visualization.birds_eye import control_marks
from scenefactory_jax.visualization.birds_eye.control_marks import ControlMarks
from scenefactory_jax.visualization.birds_eye.drawing import STOP, Colour, rgb

GREY = (0.55, 0.56, 0.58, 1.0)
BAR_HALF_M, BAR_M = 0.25, 0.03  # half width and height of a stop line
POST_M, HEAD_M, POST_HALF_M, HEAD_HALF_M = 2.4, 0.9, 0.05, 0.18  # heights of posts and of the heads on them, and their half widths
ASIDE = 0.3  # of a light's post from the stop line's right end, as a fraction of the line


class Box(NamedTuple):
    """An upright box."""

    place: tuple[float, float, float]
    yaw: float
    half: tuple[float, float, float]
    rgba: tuple[float, ...]


def find_boxes(marks: ControlMarks, step: int) -> list[Box]:
    """Lists a line across each governed lane, a post with a head beside it for a light, and one for each stop sign.

    Lines and heads have the colour of the light at the step; those of stop signs are dark red and red.
    """
    boxes = []
    for row, (left, right) in enumerate(marks.bars):
        sign, across = bool(marks.stop_sign[row]), right - left
        colour = control_marks.STOP_LINE if sign else control_marks.LIGHTS[marks.colour[step, row]]
        (x, y), yaw = ((left + right) / 2).tolist(), float(np.arctan2(across[0], -across[1]))
        half = (BAR_HALF_M, float(np.hypot(*across)) / 2, BAR_M / 2)
        boxes.append(Box((x, y, BAR_M / 2), yaw, half, (*rgb(colour), 1.0)))
        if not sign:
            boxes += _make_post(right + ASIDE * across, yaw, colour)
    for place in marks.signs:
        boxes += _make_post(place, 0.0, STOP)
    return boxes


def _make_post(place: Float[np.ndarray, "2"], yaw: float, colour: Colour) -> list[Box]:
    """A grey post and its head."""
    x, y = place.tolist()
    post = Box((x, y, POST_M / 2), yaw, (POST_HALF_M, POST_HALF_M, POST_M / 2), GREY)
    return [post, Box((x, y, POST_M + HEAD_M / 2), yaw, (HEAD_HALF_M, HEAD_HALF_M, HEAD_M / 2), (*rgb(colour), 1.0))]
