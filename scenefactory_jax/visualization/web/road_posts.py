"""Traffic lights and stop signs of a raw scene, also those that no packed scene holds, in the packed scene's coordinates."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.raw_scene import LIGHT_STATES, RawScene
from scenefactory_jax.core.types import STOP_SIGN
from scenefactory_jax.data.packing.control_columns import read_changes


class Light(NamedTuple):
    """A traffic light."""

    place: tuple[float, float]  # stop point of its lane
    yaw: float  # of the lane there
    shown: list[tuple[float, str]]  # (seconds since the episode began, one of LIGHT_STATES), at each change
    period: float | None = None  # seconds after which the states repeat; None: never


class RoadPosts(NamedTuple):
    """Lights and stop signs of one scene."""

    lights: tuple[Light, ...] = ()
    signs: tuple[tuple[float, float], ...] = ()


def find_posts(raw: RawScene, centre: Sequence[float]) -> RoadPosts:
    """Finds lights and stop signs.

    Args:
        centre: of the packed scene in the source's coordinates (`PackReport.centre`).
    """
    origin = np.asarray(centre[:2])
    signs = [line.xyz[:, :2].mean(axis=0) - origin for line in raw.roads if line.kind == STOP_SIGN and len(line.xyz)]
    lanes = {line.id: line.xyz[:, :2] for line in raw.roads if len(line.xyz) >= 2}
    lights = []
    for light in raw.lights:
        lane = lanes.get(light.lane)
        place = light.stop[:2] if light.stop is not None else None if lane is None else lane[0]
        if place is None:
            continue
        ahead = np.array([1.0, 0.0])
        if lane is not None:
            nearest = min(int(np.argmin(np.linalg.norm(lane - place, axis=1))), len(lane) - 2)
            ahead = lane[nearest + 1] - lane[nearest]
        changes, period = read_changes(light, raw.times, raw.current)
        begun = max((index for index, (time, _) in enumerate(changes) if time <= 0), default=0)
        shown = [(max(time, 0.0), LIGHT_STATES[state]) for time, state in changes[begun:]]
        x, y = place - origin
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        lights.append(Light((float(x), float(y)), yaw, shown, period if np.isfinite(period) else None))
    return RoadPosts(tuple(lights), tuple((float(x), float(y)) for x, y in signs))
