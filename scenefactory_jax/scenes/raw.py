"""A scene as its source holds it: numpy, ragged, in the source's own coordinates, before anything is chosen or cut.

Every reader and generator ends here, and `checks`, `pack` and the viewers begin here. Coordinates are float64, because logs reach 1e4 m
from their origin; float32 comes after a centre is subtracted. Values at invalid steps are zeros: only `valid` decides.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.types import RoadUser


class SceneError(ValueError):
    """A scene, or a bank of scenes, that cannot be used; the message names the file, the key, the value and what would be valid."""


class OtherFormat(SceneError):
    """The file is not in the format of this reader; the next reader may try."""


@dataclass(frozen=True, eq=False)
class Polyline:
    """One feature of the map: a lane's centre, a painted line, a road edge, the outline of a polygon, or a point (stop sign)."""

    kind: int  # WOMD map element id, see `types`
    xyz: Float[np.ndarray, "N 3"]
    id: int
    entry: tuple[int, ...] = ()  # ids of the lanes that lead into this one
    exit: tuple[int, ...] = ()
    speed_limit: float | None = None  # m/s


@dataclass(frozen=True, eq=False)
class Track:
    """One object over the whole log."""

    id: int
    kind: RoadUser
    size: tuple[float, float, float]  # length, width, height
    xyz: Float[np.ndarray, "L 3"]  # centre of the box
    yaw: Float[np.ndarray, " L"]
    velocity: Float[np.ndarray, "L 2"]  # world frame
    valid: Bool[np.ndarray, " L"]


@dataclass(frozen=True, eq=False)
class RawScene:
    """One recording or one generated world."""

    name: str
    source: str  # file it came from, or the generator's name
    roads: tuple[Polyline, ...]
    tracks: tuple[Track, ...]
    times: Float[np.ndarray, " L"]  # s
    current: int  # the step at which a simulation takes over from the log
    sdc: int | None = None  # index into `tracks` of the car that recorded the log
    lights: dict[str, Any] = field(default_factory=dict)  # traffic light states as the source gives them
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the source's coordinates in a wider frame, where it is known
    metadata: dict[str, Any] = field(default_factory=dict)
