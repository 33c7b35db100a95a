"""Outlines and colours of background traffic: grey, pale where parked; people are discs, cycles are hexagons."""

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
PARKED_M = 0.5  # a road user that stays within this distance is parked
PERSON_M, CYCLE_M = 1.2, 1.05  # lengths below the first are people's; of longer road users, widths below the second are cycles'

CYCLE = np.array([[0.5, 0.0], [0.1, 0.5], [-0.1, 0.5], [-0.5, 0.0], [-0.1, -0.5], [0.1, -0.5]])
VEHICLE = np.array([[0.42, 0.5], [0.5, 0.25], [0.5, -0.25], [0.42, -0.5], [-0.5, -0.5], [-0.5, 0.5]])  # its front is narrower
DISC = 0.5 * np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)], axis=-1)


class Shape(NamedTuple):
    """A filled outline in world coordinates."""

    points: Float[np.ndarray, "n 2"]
    fill: Colour
    outline: Colour


def shapes_at_start(scene: Scene) -> list[Shape]:
    """Logged traffic of a packed scene at the logged step at which its agents start."""
    log, present = scene.log, np.asarray(scene.agents.present)
    apart = np.linalg.norm(np.asarray(log.position) - np.asarray(scene.agents.position)[:, None], axis=-1)
    apart = np.where(np.asarray(log.valid), apart, np.inf)[present]
    step = int(np.argmin(apart.sum(axis=0))) if len(apart) else 0
    columns = (scene.traffic_log.position, scene.traffic_log.yaw, scene.traffic_log.valid)
    position, yaw, valid = (np.asarray(leaf).swapaxes(0, 1) for leaf in columns)
    traffic = TrafficBoxes(position, yaw, np.broadcast_to(np.asarray(scene.traffic_log.size), position.shape), valid)
    return list(shapes(traffic, step, find_parked(traffic)))


def find_parked(traffic: TrafficBoxes) -> Bool[np.ndarray, " O"]:
    """Road users that do not move while present."""
    first = np.argmax(traffic.present, axis=0)
    begin = traffic.position[first, np.arange(traffic.present.shape[1])]
    moved = np.where(traffic.present, np.linalg.norm(traffic.position - begin, axis=-1), 0.0)
    return moved.max(axis=0, initial=0.0) < PARKED_M


def is_person(size: Float[np.ndarray, "2"]) -> bool:
    """Whether a road user of this length and width (m) is drawn as a person."""
    return bool(size[0] < PERSON_M)


def is_cycle(size: Float[np.ndarray, "2"]) -> bool:
    """Whether a road user of this length and width (m) is drawn as a cycle."""
    return not is_person(size) and bool(size[1] < CYCLE_M)


def shapes(traffic: TrafficBoxes, step: int, parked: Bool[np.ndarray, " O"]) -> Iterator[Shape]:
    """Outlines at a step, bottom first.

    Args:
        parked: see `find_parked`.
    """
    for row in np.flatnonzero(traffic.present[step]):
        size = traffic.size[step, row]
        person = is_person(size)
        local = DISC * max(size[0], 0.7) if person else (CYCLE if is_cycle(size) else VEHICLE) * size
        cos, sin = np.cos(traffic.yaw[step, row]), np.sin(traffic.yaw[step, row])
        points = local @ np.array([[cos, sin], [-sin, cos]]) + traffic.position[step, row]
        yield Shape(points, blend(PARKED, WHITE, 0.5) if parked[row] and not person else MOVING, OUTLINE)
