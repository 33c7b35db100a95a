"""How everybody who is no agent looks in pictures and videos: grey, hollow where it never moves; people are discs, cycles are lenses."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.trajectory import TrafficBoxes
from scenefactory_jax.core.types import Scene
from scenefactory_jax.visualization.birds_eye.drawing import WHITE, Colour, blend

MOVING: Colour = (105, 109, 115)
PARKED: Colour = (214, 216, 219)
OUTLINE: Colour = (84, 88, 94)
STILL_M = 0.5  # who stays within this distance counts as parked
PERSON_M, CYCLE_M = 1.2, 1.05  # shorter than the one is a person; longer, and narrower than the other, a cycle


class Shape(NamedTuple):
    """A filled outline in world coordinates."""

    points: Float[np.ndarray, "n 2"]
    fill: Colour
    outline: Colour


def shapes_at_start(scene: Scene) -> tuple[TrafficBoxes, Bool[np.ndarray, " O"]]:
    """The recorded others of a packed scene at the logged step at which its agents start, as one step; and who never moves in the log."""
    log, present = scene.log, np.asarray(scene.agents.present)
    apart = np.linalg.norm(np.asarray(log.position) - np.asarray(scene.agents.position)[:, None], axis=-1)
    apart = np.where(np.asarray(log.valid), apart, np.inf)[present]
    row = int(np.argmin(apart.sum(axis=0))) if len(apart) else 0
    position, yaw, valid = (
        np.asarray(leaf).swapaxes(0, 1) for leaf in (scene.traffic_log.position, scene.traffic_log.yaw, scene.traffic_log.valid)
    )
    whole = TrafficBoxes(position, yaw, np.broadcast_to(np.asarray(scene.traffic_log.size), position.shape), valid)
    return TrafficBoxes(*(leaf[row : row + 1] for leaf in whole)), shapes_at_rest(whole)


def shapes_at_rest(traffic: TrafficBoxes) -> Bool[np.ndarray, " O"]:
    """Who, as far as it is there, never leaves its place."""
    first = np.argmax(traffic.present, axis=0)
    begin = traffic.position[first, np.arange(traffic.present.shape[1])]
    moved = np.where(traffic.present, np.linalg.norm(traffic.position - begin, axis=-1), 0.0)
    return moved.max(axis=0, initial=0.0) < STILL_M


def shapes(traffic: TrafficBoxes, step: int, still: Bool[np.ndarray, " O"]) -> Iterator[Shape]:
    """What to draw at a step, bottom first; `still` as `parked` tells it."""
    for row in np.flatnonzero(traffic.present[step]):
        size = traffic.size[step, row]
        angle = np.linspace(0.0, 2 * np.pi, 17)[:-1]
        round_ = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 0.5
        if size[0] < PERSON_M:
            local = round_ * max(size[0], 0.7)
        elif size[1] < CYCLE_M:
            local = np.array([[0.5, 0.0], [0.1, 0.5], [-0.1, 0.5], [-0.5, 0.0], [-0.1, -0.5], [0.1, -0.5]]) * size
        else:  # a nose tells front from back
            local = np.array([[0.42, 0.5], [0.5, 0.25], [0.5, -0.25], [0.42, -0.5], [-0.5, -0.5], [-0.5, 0.5]]) * size
        cos, sin = np.cos(traffic.yaw[step, row]), np.sin(traffic.yaw[step, row])
        points = local @ np.array([[cos, sin], [-sin, cos]]) + traffic.position[step, row]
        vehicle_at_rest = still[row] and size[0] >= PERSON_M
        yield Shape(points, blend(PARKED, WHITE, 0.5) if vehicle_at_rest else MOVING, OUTLINE)
