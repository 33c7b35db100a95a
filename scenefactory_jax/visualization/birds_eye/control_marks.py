"""Traffic lights, stop signs and agents' routes for pictures: stop lines with the colours of their lights over time, and route lines."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.types import ROUTE_SPACING_M, Scene
from scenefactory_jax.roadgraph import traffic_lights
from scenefactory_jax.visualization.birds_eye.drawing import INK, STOP, Colour, Stroke, blend, colour_of

LIGHTS: tuple[Colour, ...] = ((220, 36, 51), (240, 162, 2), (22, 163, 74), (154, 161, 169))  # of `traffic_lights.COLOURS`
BAR_M = 1.5  # half the length of a stop line
SIGN_M, SIGN_ASIDE_M = 0.9, 2.4  # radius of a stop sign, and its distance to the right of the middle of its lane
APPROACH_M = 6.0  # nearer signs, side by side in one direction, stand as one
ROUTE_M = 0.35  # width of a route's line


class ControlMarks(NamedTuple):
    """The traffic controls of a world."""

    bars: Float[np.ndarray, "C 2 2"]  # ends of the stop lines, left and right
    signs: Float[np.ndarray, "D 2"]  # places of the stop signs, beside the outermost lane of each approach
    stop_sign: Bool[np.ndarray, " C"]
    colour: Int[np.ndarray, "T C"]  # index into LIGHTS at every time


def find_marks(scene: Scene, times_s: Sequence[float] | Float[np.ndarray, " T"]) -> ControlMarks:
    """Finds the marks of a packed world, at times since the cars start."""
    controls = scene.controls
    valid = np.asarray(controls.valid, bool)
    place, direction = np.asarray(controls.position, float)[valid], np.asarray(controls.direction, float)[valid]
    right = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    sign = np.asarray(controls.stop_sign, bool)[valid]
    states = np.zeros((len(times_s), len(valid)), int)
    if valid.any():
        states = np.asarray(_read_states(controls, np.asarray(times_s, np.float32)))
    posts = (place + SIGN_ASIDE_M * right)[sign][_find_outer(place[sign], direction[sign])]
    return ControlMarks(
        bars=np.stack([place - BAR_M * right, place + BAR_M * right], axis=1),
        signs=np.unique(np.round(posts, 1), axis=0).reshape(-1, 2),
        stop_sign=sign,
        colour=np.array(traffic_lights.COLOUR_OF)[states[:, valid]],
    )


def _find_outer(place: Float[np.ndarray, "D 2"], direction: Float[np.ndarray, "D 2"]) -> Bool[np.ndarray, " D"]:
    """Mask of the stop places with no other one beside them, to the right in the same direction."""
    apart = place[None] - place[:, None]
    ahead, right = np.sum(apart * direction[:, None], axis=2), apart[..., 0] * direction[:, None, 1] - apart[..., 1] * direction[:, None, 0]
    beside = (np.abs(ahead) < APPROACH_M) & (right > 1.0) & (right < APPROACH_M) & (direction @ direction.T > 0.9)
    return ~beside.any(axis=1)


_read_states = jax.jit(jax.vmap(traffic_lights.read_light_states, in_axes=(None, 0)))


def find_bars(marks: ControlMarks, step: int) -> list[tuple[Float[np.ndarray, "2 2"], Colour]]:
    """Stop lines with their colours at a step, those of stop signs first, green ones before red ones, which stay on top."""
    order = np.lexsort((-marks.colour[step], ~marks.stop_sign))
    return [(marks.bars[row], STOP_LINE if marks.stop_sign[row] else LIGHTS[marks.colour[step, row]]) for row in order]


STOP_LINE = blend(STOP, INK, 0.55)


def make_octagons(marks: ControlMarks) -> list[Float[np.ndarray, "8 2"]]:
    """Outlines of the stop signs."""
    angles = np.pi / 8 + np.arange(8) * np.pi / 4
    return [place + SIGN_M * np.stack([np.cos(angles), np.sin(angles)], axis=1) for place in marks.signs]


def route_strokes(scene: Scene) -> list[Stroke]:
    """The routes of the agents between start and goal, each in its agent's colour."""
    agents, strokes = scene.agents, []
    if not len(scene.routes.length):
        return []
    for agent in np.flatnonzero(np.asarray(agents.present) & (np.asarray(agents.route_end) > np.asarray(agents.route_start))).tolist():
        first, last = (float(np.asarray(end)[agent]) / ROUTE_SPACING_M for end in (agents.route_start, agents.route_end))
        line = np.asarray(scene.routes.position, float)[int(agents.route[agent])][int(np.floor(first)) : int(np.ceil(last)) + 1]
        strokes.append(Stroke(np.stack([line[:-1], line[1:]], axis=1), blend(colour_of(agent), (255, 255, 255), 0.6), ROUTE_M, 1.2))
    return strokes
