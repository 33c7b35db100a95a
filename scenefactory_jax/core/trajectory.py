"""States of all agents of one world over time, as numpy arrays: what statistics and pictures of an episode read."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.types import Boxes, Scene


class TrafficBoxes(NamedTuple):
    """Background traffic over the steps of an episode, as oriented boxes."""

    position: Float[np.ndarray, "T O 2"]
    yaw: Float[np.ndarray, "T O"]
    size: Float[np.ndarray, "T O 2"]  # length, width
    present: Bool[np.ndarray, "T O"]
    elevation: Float[np.ndarray, "T O"] | None = None  # of the boxes' centres; None: not known

    @classmethod
    def from_boxes(cls, boxes: Boxes) -> "TrafficBoxes":
        """The columns of `boxes` that are drawn; boxes have a leading time axis."""
        elevation = None if boxes.elevation is None else np.asarray(boxes.elevation)
        return cls(*(np.asarray(getattr(boxes, name)) for name in cls._fields[:-1]), elevation=elevation)

    def clip(self, first: int, last: int) -> "TrafficBoxes":
        """Steps `first` to `last`, without `last`."""
        elevation = None if self.elevation is None else self.elevation[first:last]
        return TrafficBoxes(*(column[first:last] for column in self[:4]), elevation=elevation)


class Trajectory(NamedTuple):
    """One recorded world.

    `scene` holds the episode's own weather, with water films as at its start. `goal` is `[A, 2]`, or `[T, A, 2]` where agents respawn
    with new goals. `events` maps a field of `Events` to the steps at which it is new. `weather` is text: "SMA, 0.5 mm", or
    "AC, 0.0 to 0.4 mm" in rain.
    """

    scene: Scene
    position: Float[np.ndarray, "T A 2"]
    yaw: Float[np.ndarray, "T A"]
    speed: Float[np.ndarray, "T A"]
    active: Bool[np.ndarray, "T A"]
    events: Mapping[str, Bool[np.ndarray, "T A"]]
    size: Float[np.ndarray, "A 2"]
    goal: Float[np.ndarray, "*T A 2"]
    present: Bool[np.ndarray, " A"]
    goal_radius_m: float
    control_hz: float
    title: str
    weather: str
    traffic: TrafficBoxes | None = None  # None: agents only
    start_s: float = 0.0  # time of the first step since the cars start, by which lights are read
    height: Float[np.ndarray, "T A"] | None = None  # of the cars' centres, where roads have several levels

    def clip(self, first: int, last: int) -> "Trajectory":
        """Steps `first` to `last`, without `last`."""
        columns = {name: getattr(self, name)[first:last] for name in ("position", "yaw", "speed", "active")}
        return self._replace(
            **columns,
            goal=self.goal[first:last] if np.ndim(self.goal) == 3 else self.goal,
            events={name: new[first:last] for name, new in self.events.items()},
            traffic=self.traffic and self.traffic.clip(first, last),
            start_s=self.start_s + max(first, 0) / self.control_hz,
            height=None if self.height is None else self.height[first:last],
        )
