"""Drivers who break rules: too fast, beside the middle of the lane, over red lights, and turning on red."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.schema import Fraction, NonNegative, Range
from scenefactory_jax.data.generators.town.driver_model import SimulatedUser
from scenefactory_jax.data.generators.town.lane_paths import STEP_M

TURN_M = 25.0  # behind a stop line, in which a car turns
RIGHT_RAD = -np.deg2rad(50.0)  # a right turn turns at least so much


@dataclass(frozen=True)
class ImperfectDrivers:
    """Fractions of the cars, each drawn by itself, and what they do."""

    speeding: Fraction
    speeding_factor: Range  # of the speed of others on the same road
    drifting: Fraction
    drift_m: NonNegative  # largest distance from the path, to either side and back
    drift_length_m: Range  # of one such way
    red_running: Fraction  # drive over red lights as if they were green
    turning_on_red: Fraction  # turn right at a red light after a stop, as at a stop sign


class Faults(NamedTuple):
    """What each road user does wrong."""

    users: list[SimulatedUser]  # with the speeds that they want to drive
    runs: Bool[np.ndarray, " N"]
    turns: Bool[np.ndarray, "N S"]  # at the gates of its path
    drift_m: Float[np.ndarray, " N"]
    drift_length_m: Float[np.ndarray, " N"]


def draw_faults(rng: np.random.Generator, users: Sequence[SimulatedUser], numbers: ImperfectDrivers) -> Faults:
    """Draws what the cars do wrong; others do nothing."""
    cars = np.array([user.kind == "vehicle" for user in users])
    speeding, drifting, runs, turns = (
        cars & (rng.random(len(users)) < fraction)
        for fraction in (numbers.speeding, numbers.drifting, numbers.red_running, numbers.turning_on_red)
    )
    factor = np.where(speeding, rng.uniform(*numbers.speeding_factor, len(users)), 1.0)
    faster = [
        user._replace(path=user.path._replace(speed=user.path.speed * ratio)) if ratio != 1.0 else user
        for user, ratio in zip(users, factor.tolist(), strict=True)
    ]
    slots = max([1, *(len(user.path.gates) for user in users)])
    right = np.zeros((len(users), slots), bool)
    for row, user in enumerate(users):
        yaw = user.path.yaw
        for slot, (place, _) in enumerate(user.path.gates):
            before, after = (min(int(at / STEP_M), len(yaw) - 1) for at in (place, place + TURN_M))
            right[row, slot] = yaw[after] - yaw[before] < RIGHT_RAD
    drift = np.where(drifting, numbers.drift_m, 0.0)
    return Faults(faster, runs, turns[:, None] & right, drift, rng.uniform(*numbers.drift_length_m, len(users)))


def drift(
    position: Float[np.ndarray, "L 2"], yaw: Float[np.ndarray, " L"], place: Float[np.ndarray, " L"], amount: float, length: float
) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, " L"]]:
    """Positions and yaws on a wave around a path, at places along it."""
    wave = 2 * np.pi * place / length
    aside = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    return position + amount * np.sin(wave)[:, None] * aside, yaw + np.arctan(amount * 2 * np.pi / length * np.cos(wave))
