"""Scenes in which another recorded car takes the place of the recording one: more training scenes for a policy of one car."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from scenefactory_jax.core.raw_scene import RawScene


def choose_egos(raw: RawScene, *, count: int | None, min_travel_m: float, keep_recording_car: bool) -> Iterator[RawScene]:
    """Copies of a scene, each with another track as its `sdc`, named NAME-TRACK; the recording car's own scene first, by its own name.

    Args:
        raw: a scene as its reader gives it.
        count: most other cars, the nearest to the recording car at the current step first; None: all.
        min_travel_m: a car that comes less far from its first place in the log is not taken.
        keep_recording_car: False: leave the recording car's own scene out.
    """
    if keep_recording_car:
        yield raw
    for index in find_egos(raw, min_travel_m)[:count]:
        yield replace(raw, name=f"{raw.name}-{raw.tracks[index].id}", sdc=int(index), metadata={**raw.metadata, "ego_of": raw.name})


def find_egos(raw: RawScene, min_travel_m: float) -> Int[np.ndarray, " E"]:
    """Indices of the vehicles beside the recording car that are recorded at every step and move, nearest to it first."""
    found = []
    for index, track in enumerate(raw.tracks):
        if index == raw.sdc or track.kind != "vehicle" or not track.valid.all():
            continue
        if np.hypot(*(track.xyz[:, :2] - track.xyz[0, :2]).T).max() >= min_travel_m:
            found.append(index)
    centre = np.zeros(2) if raw.sdc is None else raw.tracks[raw.sdc].xyz[raw.current, :2]
    away = [np.hypot(*(raw.tracks[index].xyz[raw.current, :2] - centre)) for index in found]
    return np.array(found, int)[np.argsort(away, kind="stable")]
