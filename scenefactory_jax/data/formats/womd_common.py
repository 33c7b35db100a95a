"""Times and tracks of both encodings of the Waymo Open Motion Dataset."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import SceneError, Track
from scenefactory_jax.core.types import ROAD_USERS, RoadUser
from scenefactory_jax.data.formats import values
from scenefactory_jax.data.formats.scene_parts import make_track

OBJECT_TYPES: tuple[RoadUser, ...] = ("other", *ROAD_USERS)  # Track.ObjectType: unset, vehicle, pedestrian, cyclist, other
STATE = ("x", "y", "z", "yaw", "velocity_x", "velocity_y", "length", "width", "height")  # columns of a table of states


def check_times(times: Float[np.ndarray, " L"], where: str) -> None:
    """Refuses a log without steps, and times that are not finite or do not increase, naming the first such time."""
    if not len(times):
        raise SceneError(f"{where}: expected at least one step, got none")
    values.check_finite(times, where)
    if (falls := np.flatnonzero(np.diff(times) <= 0)).size:
        step = int(falls[0]) + 1
        raise SceneError(f"{where}[{step}]: expected a time after {times[step - 1]} s, got {times[step]} s")


def make_tracks(
    numbers: Float[np.ndarray, "A L 9"],
    valid: Bool[np.ndarray, "A L"],
    *,
    ids: Sequence[int],
    kinds: Sequence[int],
    current: int,
    where: str,
) -> tuple[Track, ...]:
    """Makes tracks of their columns STATE, with any values at invalid steps, and their kinds, indices into OBJECT_TYPES.

    The size is that of the current step or, where it is invalid, of the first valid step.
    """
    tracks = []
    for number, kind, table, mask in zip(ids, kinds, numbers, valid, strict=True):
        step = current if mask[current] else np.argmax(mask)
        size = table[step, 6:9].tolist() if mask[step] else (0.0, 0.0, 0.0)
        motion = {"position": table[:, 0:3], "heading": table[:, 3], "velocity": table[:, 4:6]}
        tracks.append(make_track(f"{where}track {number}", id=number, kind=OBJECT_TYPES[kind], size=size, valid=mask, **motion))
    return tuple(tracks)
