"""Errors of a simulated car against a recording, as in the validation of vehicle models: final position, yaw rate, stopping distance."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.sysid.candidate_simulation import MIN_YAW_RATE, CandidatePath
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, ManoeuvreRecording

STANDING_MPS = 0.1  # below it a car stands


class ManoeuvreErrors(NamedTuple):
    """One row a manoeuvre; NaN where a measure is not defined."""

    end_m: Float[np.ndarray, " M"]  # distance of the two cars at the end
    way_m: Float[np.ndarray, " M"]  # length of the recorded path
    end_share: Float[np.ndarray, " M"]  # `end_m` over `way_m`
    yaw_rate_nrmse: Float[np.ndarray, " M"]  # root mean square of the difference over the largest recorded one
    speed_rmse: Float[np.ndarray, " M"]  # m/s
    stop_share: Float[np.ndarray, " M"]  # stopping distance over the recorded one, less 1
    lateral_peak: Float[np.ndarray, " M"]  # largest recorded lateral acceleration, m/s^2


def compute_errors(path: CandidatePath, recordings: Sequence[ManoeuvreRecording]) -> ManoeuvreErrors:
    """Compares traces [M, T, ...] with the recordings whose commands they have."""
    rows = []
    for index, recorded in enumerate(recordings):
        count = len(recorded.yaw)
        trace = CandidatePath(*(np.asarray(leaf[index], float)[:count] for leaf in path))
        way = np.linalg.norm(np.diff(recorded.position, axis=0, prepend=np.zeros((1, 2))), axis=1).sum()
        end = np.linalg.norm(trace.position[-1] - recorded.position[-1])
        peak = np.abs(recorded.yaw_rate).max()
        nrmse = np.sqrt(np.mean((trace.yaw_rate - recorded.yaw_rate) ** 2)) / peak if peak > MIN_YAW_RATE else np.nan
        controls = recorded.manoeuvre.controls
        stops = stopping_m(controls, recorded.position, recorded.speed), stopping_m(controls, trace.position, trace.pace)
        rows.append((end, way, end / max(way, 1e-9), nrmse, np.sqrt(np.mean((trace.pace - recorded.speed) ** 2)), stops[1] / stops[0] - 1.0,
                     np.abs(recorded.lateral).max()))  # fmt: skip
    return ManoeuvreErrors(*(np.array(column, float) for column in zip(*rows, strict=True)))


def stopping_m(
    controls: Float[np.ndarray, "T 3"], position: Float[Array | np.ndarray, "T 2"], speed: Float[Array | np.ndarray, " T"]
) -> float:  # fmt: skip
    """Computes the distance from the last application of the brakes to standstill, m; NaN if the car is not braked to a halt.

    A car that still moves at the end, slower than 2 m/s, is assumed to stop with the mean deceleration of its last second.
    """
    braked = controls[:, 2] > 0.0
    begins = np.flatnonzero(braked & ~np.concatenate([[False], braked[:-1]]))
    if not len(begins) or not braked[-1]:
        return float("nan")
    begin = int(begins[-1])
    still = np.flatnonzero(speed[begin:] < STANDING_MPS)
    last = begin + int(still[0]) if len(still) else len(speed) - 1
    way = np.linalg.norm(np.diff(position[begin : last + 1], axis=0), axis=1).sum()
    if len(still):
        return float(way)
    slower = speed[max(last - round(RATE_HZ), begin)] - speed[last]
    if speed[last] > 2.0 or slower <= 0.0:
        return float("nan")
    return float(way + speed[last] ** 2 / (2.0 * slower))
