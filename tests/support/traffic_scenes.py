"""Logged road users made by hand, for scenes with background traffic."""

import numpy as np

from scenefactory_jax.core import track_interpolation
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import ROAD_USERS, TrafficLog
from support.hand_scenes import column_of

KINDS = {name: index for index, name in enumerate(ROAD_USERS)}


def track(start, velocity=(0.0, 0.0), *, kind="vehicle", valid=None, size=(4.5, 1.9), turn=0.0, steps=21):
    """One other that moves evenly; hidden rows hold zeros, as packing leaves them."""
    t = 0.1 * np.arange(steps)
    valid = np.ones(steps, bool) if valid is None else np.asarray(valid, bool)
    hide = lambda x: np.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)  # noqa: E731
    place = np.asarray(start, float) + t[:, None] * np.asarray(velocity, float)
    yaw = np.arctan2(velocity[1], velocity[0]) + turn * t
    return hide(place), hide(yaw), hide(np.tile(np.asarray(velocity, float), (steps, 1))), valid, np.asarray(size, float), KINDS[kind]


def tracks_of(*rows) -> TrafficLog:
    position, yaw, velocity, valid, size, kind = (np.stack([row[i] for row in rows]) for i in range(6))
    none = np.zeros(len(rows))
    return TrafficLog(
        *map(column_of, (position, yaw, velocity)), column_of(valid, bool), column_of(size), column_of(kind, np.int32),
        column_of(none, np.int32), column_of(none, bool), column_of(none, bool), **track_interpolation.make_no_zones(len(rows)),
    )  # fmt: skip


def with_tracks(scene, *rows):
    return replace(scene, traffic_log=tracks_of(*rows))
