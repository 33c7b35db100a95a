"""Responses of a car to its commands: frequency response and rise time of the yaw rate (ISO 7401), and the yaw angle at the end."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.sysid.candidate_simulation import CandidatePath
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, Manoeuvre, ManoeuvreRecording

SINE_FAMILY, STEP_FAMILY = "frequency_response", "iso_step_steer"
SETTLED_S = 1.0  # at the end of a step steer, whose mean yaw rate is the steady one


class Responses(NamedTuple):
    """One row a manoeuvre; NaN where a measure is not defined."""

    speed: Float[np.ndarray, " M"]  # at the start, m/s
    end_yaw_deg: Float[np.ndarray, " M"]  # heading at the end of what is compared, full turns included
    rise_s: Float[np.ndarray, " M"]  # of step steers: from 10 to 90 % of the steady yaw rate
    frequency_hz: Float[np.ndarray, " M"]  # of the sines
    gain: Float[np.ndarray, " M"]  # yaw rate over the angle of the front wheels, 1/s
    phase_deg: Float[np.ndarray, " M"]


def measure_recordings(recordings: Sequence[ManoeuvreRecording]) -> Responses:
    """Measures the responses of the reference car."""
    return _tabulate([_measure(r.manoeuvre, r.yaw, r.yaw_rate, r.steer) for r in recordings])


def measure_paths(path: CandidatePath, recordings: Sequence[ManoeuvreRecording]) -> Responses:
    """Measures the responses of traces [M, T, ...] with the commands of recordings."""
    rows = []
    for index, recording in enumerate(recordings):
        yaw, yaw_rate, steer = (np.asarray(leaf[index], float)[: len(recording.yaw)] for leaf in (path.yaw, path.yaw_rate, path.steer))
        rows.append(_measure(recording.manoeuvre, yaw, yaw_rate, steer.mean(-1)))
    return _tabulate(rows)


def _tabulate(rows: Sequence[tuple[float, ...]]) -> Responses:
    return Responses(*(np.array(column, float) for column in zip(*rows, strict=True)))


def _measure(
    manoeuvre: Manoeuvre, yaw: Float[np.ndarray, " T"], yaw_rate: Float[np.ndarray, " T"], steer: Float[np.ndarray, " T"]
) -> tuple[float, ...]:
    command, rise_s, frequency_hz, response = manoeuvre.controls[:, 1], float("nan"), float("nan"), complex("nan")
    if manoeuvre.family == STEP_FAMILY:
        rise_s = compute_rise_time(yaw_rate[max(int(np.argmax(command != 0.0)) - 1, 0) :])
    if manoeuvre.family == SINE_FAMILY:
        frequency_hz = find_frequency(command)
        response = fit_sine(yaw_rate, frequency_hz) / fit_sine(steer, frequency_hz)
    end_yaw_deg = float(np.degrees(np.unwrap(yaw)[-1]))
    return manoeuvre.speed, end_yaw_deg, rise_s, frequency_hz, abs(response), float(np.degrees(np.angle(response)))


def compute_rise_time(yaw_rate: Float[np.ndarray, " T"]) -> float:
    """Computes the time from 10 to 90 % of the steady yaw rate, s, interpolated between frames; NaN without a crossing."""
    relative = yaw_rate / yaw_rate[-round(SETTLED_S * RATE_HZ) :].mean()

    def cross(level: float) -> float:
        after = int(np.argmax(relative >= level))
        if after == 0:
            return float("nan")
        return after - 1 + (level - relative[after - 1]) / (relative[after] - relative[after - 1])

    return (cross(0.9) - cross(0.1)) / RATE_HZ


def find_frequency(wave: Float[np.ndarray, " T"]) -> float:
    """Finds the frequency of a sine of whole periods, Hz."""
    return float(np.argmax(np.abs(np.fft.rfft(wave - wave.mean()))) * RATE_HZ / len(wave))


def fit_sine(signal: Float[np.ndarray, " T"], frequency_hz: float) -> complex:
    """Fits a sine, a constant and a slope to the second half of a signal by least squares; returns the sine's complex amplitude."""
    time_s = np.arange(len(signal) // 2, len(signal)) / RATE_HZ
    angle = 2 * np.pi * frequency_hz * time_s
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(time_s), time_s], axis=-1)
    in_phase, ahead, _, _ = np.linalg.lstsq(basis, signal[len(signal) // 2 :], rcond=None)[0]
    return complex(in_phase, ahead)
