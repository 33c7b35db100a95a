"""A scene as its source holds it: numpy, ragged, in the source's own coordinates, before anything is chosen or cut.

Every reader and generator ends here, and `checks`, `pack` and the viewers begin here. Coordinates are float64, because logs reach 1e4 m
from their origin; float32 comes after a centre is subtracted. Values at invalid steps are zeros: only `valid` decides.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.types import LIGHT_STATES as LIGHT_STATES
from scenefactory_jax.core.types import LightState as LightState
from scenefactory_jax.core.types import RoadUser

COMPANION = "companion"  # kind of a file that is not a fault: see `Companion`


class SceneError(ValueError):
    """A scene, or a bank of scenes, that cannot be used; the message names the file, the key, the value and what would be valid."""

    kind: str | None = None  # a short name for counting, of what packing refuses


class FormatMismatch(SceneError):
    """The file is not in the format of this reader; the next reader may try."""


class OtherContent(FormatMismatch):
    """The file is of this reader's container (JSON, pickle, parquet, TFRecord, counts that fit), but what it holds is of another format."""


class Companion(SceneError):
    """The file holds no scene of its own but belongs to scenes beside it (a map, an index): neither read nor rejected, but counted."""

    kind = COMPANION


class Unpackable(SceneError):
    """A scene that packing refuses with the numbers given, and may take with others; nothing is wrong with its source."""

    def __init__(self, kind: str, message: str):
        """`kind` is a short name for counting, such as those of `pack.REFUSALS`."""
        super().__init__(kind, message)
        self.kind = kind

    def __str__(self) -> str:
        return self.args[1]


class Reject(NamedTuple):
    """Stands in place of a scene that cannot be read or packed."""

    scene: str | None  # its name, where it is known
    reason: str  # with the place in the file, such as a record's number and offset
    kind: str | None = None  # see `Unpackable` and COMPANION
    source: str | None = None  # file or generator, as in `RawScene`; readers leave it out


@dataclass(frozen=True, eq=False)
class Polyline:
    """One feature of the map: a lane's centre, a painted line, a road edge, the outline of a polygon, or a point (stop sign)."""

    kind: int  # WOMD map element id, see `types`
    xyz: Float[np.ndarray, "N 3"]
    id: int
    entry: tuple[int, ...] = ()  # ids of the lanes that lead into this one
    exit: tuple[int, ...] = ()
    left: tuple[int, ...] = ()  # ids of the lanes beside this one into which a car may change
    right: tuple[int, ...] = ()
    speed_limit: float | None = None  # m/s
    rebuilt: bool = False  # entry, exit, left and right were worked out from geometry: the source has none
    lanes: tuple[int, ...] = ()  # of a stop sign: ids of the lanes that it governs


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


class LightPlan(NamedTuple):
    """The cycle of a light, which goes on before and after the log."""

    start_s: Float[np.ndarray, " K"]  # on the clock of `RawScene.times`, modulo the period: ascending, from 0 on, below `period_s`
    state: Int[np.ndarray, " K"]  # index into LIGHT_STATES; each holds until the next one begins, the last one into the next period
    period_s: float  # after which the states repeat


@dataclass(frozen=True, eq=False)
class Light:
    """The traffic light of one lane over the whole log."""

    lane: int  # id of the lane that it governs
    state: Int[np.ndarray, " L"]  # index into LIGHT_STATES
    valid: Bool[np.ndarray, " L"]  # the steps at which the source says anything
    stop: Float[np.ndarray, "3"] | None = None  # where cars stop for it, if the source says so
    plan: LightPlan | None = None  # None: nothing is known beyond the log


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
    lights: tuple[Light, ...] = ()
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the source's coordinates in a wider frame, where it is known
    metadata: dict[str, Any] = field(default_factory=dict)  # plain JSON values; every reader sets `dataset` and `format`
