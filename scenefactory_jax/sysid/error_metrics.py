"""How well a car drives what the teacher drove, in the terms of those who validate vehicle models: final position, yaw rate, stopping."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.sysid.candidate_simulation import CandidatePath
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, ManoeuvreRecording

STILL = 0.1  # m/s: below it a car stands
TURNING = 0.02  # rad/s: a teacher that never turns faster has no yaw rate to compare


class ManoeuvreErrors(NamedTuple):
    """One row a manoeuvre; NaN where a measure makes no sense."""

    end_m: Float[np.ndarray, " M"]  # distance of the two cars at the end
    way_m: Float[np.ndarray, " M"]  # length of the teacher's path
    end_share: Float[np.ndarray, " M"]  # of the one over the other
    yaw_rate_nrmse: Float[np.ndarray, " M"]  # root mean square of the difference over the teacher's largest yaw rate
    speed_rmse: Float[np.ndarray, " M"]  # m/s
    stop_share: Float[np.ndarray, " M"]  # way from the last touch of the brakes to standstill over the teacher's, less 1
    lateral_peak: Float[np.ndarray, " M"]  # largest lateral acceleration of the teacher, m/s^2


def compute_errors(path: CandidatePath, recordings: Sequence[ManoeuvreRecording]) -> ManoeuvreErrors:
    """Compare traces [M, T, ...] with the recordings that they replay."""
    rows = []
    for index, teacher in enumerate(recordings):
        count = len(teacher.yaw)
        own = CandidatePath(*(np.asarray(leaf[index], float)[:count] for leaf in path))
        way = np.linalg.norm(np.diff(teacher.position, axis=0, prepend=np.zeros((1, 2))), axis=1).sum()
        end = np.linalg.norm(own.position[-1] - teacher.position[-1])
        peak = np.abs(teacher.yaw_rate).max()
        nrmse = np.sqrt(np.mean((own.yaw_rate - teacher.yaw_rate) ** 2)) / peak if peak > TURNING else np.nan
        controls = teacher.manoeuvre.controls
        stops = stopping_m(controls, teacher.position, teacher.speed), stopping_m(controls, own.position, own.pace)
        rows.append((end, way, end / max(way, 1e-9), nrmse, np.sqrt(np.mean((own.pace - teacher.speed) ** 2)), stops[1] / stops[0] - 1.0,
                     np.abs(teacher.lateral).max()))  # fmt: skip
    return ManoeuvreErrors(*(np.array(column, float) for column in zip(*rows, strict=True)))


def stopping_m(
    controls: Float[np.ndarray, "T 3"], position: Float[Array | np.ndarray, "T 2"], speed: Float[Array | np.ndarray, " T"]
) -> float:  # fmt: skip
    """Way from where the brakes are put on for the last time to standstill, m; NaN if the car is not braked to a halt.

    A car that still moves at the end but slower than 2 m/s is taken to stop with the mean deceleration of its last second.
    """
    braked = controls[:, 2] > 0.0
    begins = np.flatnonzero(braked & ~np.concatenate([[False], braked[:-1]]))
    if not len(begins) or not braked[-1]:
        return float("nan")
    begin = int(begins[-1])
    still = np.flatnonzero(speed[begin:] < STILL)
    last = begin + int(still[0]) if len(still) else len(speed) - 1
    way = np.linalg.norm(np.diff(position[begin : last + 1], axis=0), axis=1).sum()
    if len(still):
        return float(way)
    slower = speed[max(last - round(RATE_HZ), begin)] - speed[last]
    if speed[last] > 2.0 or slower <= 0.0:
        return float("nan")
    return float(way + speed[last] ** 2 / (2.0 * slower))
