"""What both encodings of the Waymo Open Motion Dataset share: how a log's times, objects and angles become those of a RawScene."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import ROAD_USERS, RoadUser
from scenefactory_jax.data.formats import json_documents

OBJECT_TYPES: tuple[RoadUser, ...] = ("other", *ROAD_USERS)  # Track.ObjectType: unset, vehicle, pedestrian, cyclist, other
STATE = ("x", "y", "z", "yaw", "velocity_x", "velocity_y", "length", "width", "height")  # columns of a table of states


def check_times(times: Float[np.ndarray, " L"], where: str) -> None:
    """Refuse a log without steps, and times that are not finite or do not rise.

    Raises:
        SceneError: naming the first such time.
    """
    if not len(times):
        raise SceneError(f"{where}: none; a log needs at least one step")
    json_documents.check_finite(times, where)
    if (falls := np.flatnonzero(np.diff(times) <= 0)).size:
        step = int(falls[0]) + 1
        raise SceneError(f"{where}[{step}]: {times[step]} s does not come after {times[step - 1]} s")


def check_member(value: int, names: Sequence[object], what: str, where: str) -> int:
    """`value`, if it is an index into `names`.

    Raises:
        SceneError: naming `where`, the value and the valid ones.
    """
    if not 0 <= value < len(names):
        raise SceneError(f"{where}: {value} is no {what}; valid: 0 to {len(names) - 1}")
    return value


def make_tracks(
    numbers: Float[np.ndarray, "A L 9"], valid: Bool[np.ndarray, "A L"], *, ids: Sequence[int], kinds: Sequence[int], current: int
) -> tuple[Track, ...]:
    """Tracks of their columns STATE. A size is that at the current step, else at the first valid one; at invalid steps all is zero.

    Args:
        numbers: of all objects, anything at invalid steps.
        valid: where they count.
        ids: of the objects.
        kinds: indices into OBJECT_TYPES.
        current: the step at which a simulation takes over.
    """
    numbers = np.where(valid[..., None], numbers, 0.0)
    yaw = np.where(valid, wrap_angles(numbers[..., 3]), 0.0)
    measured = np.where(valid[:, current], current, np.argmax(valid, axis=1))
    sizes = numbers[np.arange(len(numbers)), measured, 6:9].tolist()
    return tuple(
        Track(
            id=ids[row],
            kind=OBJECT_TYPES[kinds[row]],
            size=(length, width, height),
            xyz=numbers[row, :, 0:3],
            yaw=yaw[row],
            velocity=numbers[row, :, 4:6],
            valid=valid[row],
        )
        for row, (length, width, height) in enumerate(sizes)
    )
