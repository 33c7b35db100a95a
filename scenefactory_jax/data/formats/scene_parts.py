"""Parts of a raw scene in the form that all readers share: tracks, lights, and ids that are texts in the source."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import Light, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import ROAD_USERS, RoadUser
from scenefactory_jax.data.formats.values import AXES, check_finite

INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")  # a text that converts to an integer of 64 bits and back
KINDS: dict[str, RoadUser] = {kind: kind for kind in ROAD_USERS}


def road_user(name: str) -> RoadUser:
    """The kind of road user of that name, in any case; `other` for unknown names."""
    return KINDS.get(name.lower(), "other")


def make_track(
    where: str,
    *,
    id: int,
    kind: RoadUser,
    size: Sequence[float],
    position: Float[np.ndarray, "L 3"],
    heading: Float[np.ndarray, " L"],
    velocity: Float[np.ndarray, "L 2"],
    valid: Bool[np.ndarray, " L"],
    max_heading: float = np.inf,
) -> Track:
    """A track with zeros at invalid steps, where a source may have any value, and a yaw in [-pi, pi).

    Raises:
        SceneError: motion at a valid step that is not finite, or a heading beyond `max_heading` (rad).
    """
    for name, table in (("position", position), ("velocity", velocity), ("heading", heading)):
        check_finite(table, f"{where}.{name}", rows=valid, keys=AXES)
    turns = np.where(valid, np.abs(heading), 0.0)
    if turns.max(initial=0.0) > max_heading:
        step = int(np.argmax(turns))
        raise SceneError(f"{where}.heading[{step}]: expected an angle in radians, got {heading[step]}")
    length, width, height = map(float, size)
    xyz, velocity = (np.where(valid[:, None], table, 0.0) for table in (position, velocity))
    yaw = np.where(valid, wrap_angles(heading), 0.0)
    return Track(id=id, kind=kind, size=(length, width, height), xyz=xyz, yaw=yaw, velocity=velocity, valid=valid)


def make_light(lane: int, codes: Int[np.ndarray, " L"], stop: Float[np.ndarray, "3"] | None) -> Light:
    """The light of a lane from an index into LIGHT_STATES for each step; -1: no state at that step."""
    return Light(lane=lane, state=np.maximum(codes, 0), valid=codes >= 0, stop=stop)


def to_xyz(table: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N 3"]:
    """Points with height 0 where they have none."""
    return np.pad(table, ((0, 0), (0, 3 - table.shape[1])))


def assign_ids(keys: Iterable[Any]) -> dict[str, int]:
    """Keys -> ids: an integer keeps its value; other texts are numbered after the largest, in the order of the keys."""
    texts = list(dict.fromkeys(map(str, keys)))
    ids = {text: int(text) for text in texts if INTEGER.fullmatch(text)}
    start = max(ids.values(), default=-1) + 1
    return ids | {text: start + place for place, text in enumerate(text for text in texts if text not in ids)}


def look_up_id(key: Any, ids: Mapping[str, int]) -> int | None:
    """The id of a key; an integer that is not among them keeps its value, as in a map cut out of a larger one."""
    text = str(key)
    return ids[text] if text in ids else int(text) if INTEGER.fullmatch(text) else None


def list_tokens(ids: Mapping[str, int]) -> dict[str, int]:
    """The keys that are not integers, with their ids."""
    return {text: number for text, number in ids.items() if text != str(number)}
