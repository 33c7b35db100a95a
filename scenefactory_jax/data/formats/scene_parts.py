"""Parts of a raw scene in the form that all readers share: tracks, lights, and ids that are texts in the source."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import Light, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import ROAD_USERS, RoadUser
from scenefactory_jax.data.formats.values import AXES, check_finite

INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")  # a text that converts to an integer of 64 bits and back
WOMD_TYPES: tuple[RoadUser, ...] = ("other", *ROAD_USERS)  # Track.ObjectType: unset, vehicle, pedestrian, cyclist, other
STATE = ("x", "y", "z", "yaw", "velocity_x", "velocity_y", "length", "width", "height")  # columns of a table of states
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 1609.344 / 3600, "mps": 1.0, "kmh": 1 / 3.6, "kph": 1 / 3.6}  # in m/s
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


def cut_tracks(tracks: Iterable[Track], part: slice) -> list[Track]:
    """The tracks that are present at some of the steps, at these steps."""
    at = lambda track: {name: getattr(track, name)[part] for name in ("xyz", "yaw", "velocity", "valid")}  # noqa: E731
    return [replace(track, **at(track)) for track in tracks if track.valid[part].any()]


def choose_recording_car(tracks: Sequence[Track]) -> int | None:
    """The vehicle that drives farthest, of those present at all steps, for logs that have no recording car; None if there is none."""
    travel = [np.linalg.norm(t.velocity, axis=1).sum() if t.kind == "vehicle" and t.valid.all() else -1.0 for t in tracks]
    return int(np.argmax(travel)) if max(travel, default=-1.0) >= 0 else None


def check_times(times: Float[np.ndarray, " L"], where: str) -> None:
    """Refuses a log without steps, and times that are not finite or do not increase, naming the first such time."""
    if not len(times):
        raise SceneError(f"{where}: expected at least one step, got none")
    check_finite(times, where)
    if (falls := np.flatnonzero(np.diff(times) <= 0)).size:
        step = int(falls[0]) + 1
        raise SceneError(f"{where}[{step}]: expected a time after {times[step - 1]} s, got {times[step]} s")


def make_womd_tracks(
    numbers: Float[np.ndarray, "A L 9"],
    valid: Bool[np.ndarray, "A L"],
    *,
    ids: Sequence[int],
    kinds: Sequence[int],
    current: int,
    where: str,
) -> tuple[Track, ...]:
    """The tracks of WOMD: columns STATE, with any values at invalid steps, and kinds, indices into WOMD_TYPES.

    The size is that of the current step or, where it is invalid, of the first valid step.
    """
    tracks = []
    for number, kind, table, mask in zip(ids, kinds, numbers, valid, strict=True):
        step = current if mask[current] else np.argmax(mask)
        size = table[step, 6:9].tolist() if mask[step] else (0.0, 0.0, 0.0)
        motion = {"position": table[:, 0:3], "heading": table[:, 3], "velocity": table[:, 4:6]}
        tracks.append(make_track(f"{where}track {number}", id=number, kind=WOMD_TYPES[kind], size=size, valid=mask, **motion))
    return tuple(tracks)


def make_light(lane: int, codes: Int[np.ndarray, " L"], stop: Float[np.ndarray, "3"] | None) -> Light:
    """The light of a lane from an index into LIGHT_STATES for each step; -1: no state at that step."""
    return Light(lane=lane, state=np.maximum(codes, 0), valid=codes >= 0, stop=stop)


def to_xyz(table: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N 3"]:
    """Points with height 0 where they have none."""
    if table.shape[1] == 3:
        return table
    return np.concatenate([table, np.zeros((len(table), 3 - table.shape[1]))], axis=1)


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
