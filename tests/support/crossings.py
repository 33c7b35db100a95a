"""A crossing made by hand: two streets without kerbs in their middle, an ego that drives east, and road users beside it."""

import numpy as np

from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.core.types import RoadUser

HALF_M, REACH_M, STEPS, CURRENT = 4.0, 120.0, 91, 10  # half the width of the streets, half their length


def crossing(name: str, *others: Track) -> RawScene:
    """The scene; the ego, track 0, reaches the middle 5 s after the start."""
    return RawScene(
        name=name,
        source="hand",
        roads=tuple(list_roads()),
        tracks=(drive(0, (-40.0, 0.0), 0.0, 8.0), *others),
        times=0.1 * np.arange(STEPS),
        current=CURRENT,
        sdc=0,
        metadata={"dataset": "hand", "format": "hand"},
    )


def list_roads():
    """Lanes through the middle, and edges around the four corners with the road to their left."""
    along = np.arange(-REACH_M, REACH_M + 1.0)
    for number, (x, y) in enumerate(((1.0, 0.0), (0.0, 1.0))):
        yield Polyline(kind=2, xyz=np.stack([x * along, y * along, 0.0 * along], axis=1), id=number, speed_limit=12.0)
    out = np.arange(HALF_M, REACH_M + 1.0)
    for number, quarter in enumerate(range(4)):
        arm = np.stack([out, 0.0 * out + HALF_M, 0.0 * out], axis=1)
        corner = np.concatenate([arm[::-1], arm[1:][:, [1, 0, 2]]])  # in along one street, out along the other: its corner to the right
        cos, sin = np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)
        yield Polyline(kind=15, xyz=corner @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]), id=10 + number)


def drive(number, place, yaw, speed, *, kind: RoadUser = "vehicle", valid=None) -> Track:
    """A track at constant speed that is at `place` at the current step."""
    time = 0.1 * (np.arange(STEPS) - CURRENT)
    facing = np.array([np.cos(yaw), np.sin(yaw)])
    xy = np.asarray(place) + speed * time[:, None] * facing
    valid = np.ones(STEPS, bool) if valid is None else np.asarray(valid)
    xyz = np.where(valid[:, None], np.column_stack([xy, np.zeros(STEPS)]), 0.0)
    velocity = np.where(valid[:, None], speed * facing, 0.0)
    return Track(number, kind, (4.6, 1.9, 1.5), xyz, np.where(valid, yaw, 0.0), velocity, valid)


def turn_off(number, *, ahead_m, speed, radius_m, leaves_s) -> Track:
    """A car ahead of the ego that turns left from the current step on, and is not seen any more after some seconds."""
    time = 0.1 * (np.arange(STEPS) - CURRENT)
    angle = np.maximum(speed * time, 0.0) / radius_m
    straight = np.minimum(speed * time, 0.0)
    xy = np.array([-40.0 + ahead_m, 0.0]) + np.stack([straight + radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle))], axis=1)
    valid = time <= leaves_s
    xyz = np.where(valid[:, None], np.column_stack([xy, np.zeros(STEPS)]), 0.0)
    velocity = np.where(valid[:, None], speed * np.stack([np.cos(angle), np.sin(angle)], axis=1), 0.0)
    return Track(number, "vehicle", (4.6, 1.9, 1.5), xyz, np.where(valid, angle, 0.0), velocity, valid)
