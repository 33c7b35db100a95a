"""Manoeuvres of one car as commands over time on a road of one or several surfaces, and recordings of them.

The 139 of training are SceneFactory's suite: same families, grids, durations and numbers of frames, all from rest. Their numbers are in
`conf/sysid/manoeuvres.yaml`, an entry a family; the functions here are those entries' targets. Of a left and a right turn that mirror each
other, the fit uses one (`drop_mirrored`): car and reference car are symmetric.
"""

import types
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.instantiate import ConfigError, instantiate

SURFACES = ("dry", "wet", "gravel")  # index = surface id
RATE_HZ = 60.0  # of commands and recordings
SIDES = (("left", 1.0), ("right", -1.0))
Segment = tuple[float | int, ...]  # s, throttle, steer, brake


class Manoeuvre(NamedTuple):
    """Commands, one row a frame, and the road: strips along x with a surface left and one right of y = 0, the outer strips endless."""

    name: str
    family: str
    speed: float  # at the start, m/s
    controls: Float[np.ndarray, "T 3"]  # throttle, steer, brake
    edges: Float[np.ndarray, " S-1"]  # m along x where one strip ends and the next begins
    left: Int[np.ndarray, " S"]  # surface of each strip for y > 0
    right: Int[np.ndarray, " S"]  # and for y <= 0


class ManoeuvreRecording(NamedTuple):
    """Motion of a car at the end of each frame. It starts at the origin, heading along x; left is positive."""

    manoeuvre: Manoeuvre
    position: Float[np.ndarray, "T 2"]  # of the box's centre, m
    yaw: Float[np.ndarray, " T"]  # unwrapped, rad
    speed: Float[np.ndarray, " T"]  # in the plane, m/s
    yaw_rate: Float[np.ndarray, " T"]  # rad/s
    wheel_spin: Float[np.ndarray, "T 4"]  # in the order of `parameters.WHEELS`, rad/s
    steer: Float[np.ndarray, " T"]  # of the front wheels, rad
    lateral: Float[np.ndarray, " T"]  # acceleration of the centre of mass to the left, m/s^2
    roll: Float[np.ndarray, " T"]  # of the body, right side down is positive, rad


def make_suite(entries: Mapping[str, Mapping[str, Any]], *, builtins: types.ModuleType, where: str, **context: Any) -> list[Manoeuvre]:
    """Makes the manoeuvres of all families in `entries`, a part of `conf/sysid/manoeuvres.yaml`.

    Args:
        builtins: module of the targets.
        where: place in the config, for messages.
        context: values that targets may require beside their numbers (`reference`, for those that need a driver).

    Raises:
        ConfigError: an entry that cannot be built, or two manoeuvres of one name.
    """
    suite: list[Manoeuvre] = []
    for key, entry in entries.items():
        suite += instantiate(entry, builtins=builtins, where=f"{where}.{key}", **context)()
    names = [manoeuvre.name for manoeuvre in suite]
    if repeated := {name for name in names if names.count(name) > 1}:
        raise ConfigError(f"{where}: expected every name once, got {sorted(repeated)[0]!r} more than once")
    return suite


def open_loop(
    family: str, labels: Sequence[float | str], segments: Sequence[Segment], *, speed: float = 0.0, surface: str = SURFACES[0]
) -> Manoeuvre:
    """Makes a manoeuvre on endless ground of one surface.

    Args:
        labels: parts of the name after the family's.
        segments: [s, throttle, steer, brake] each; commands are constant in a segment.
        speed: at the start, m/s.
    """
    name = "_".join([family, *(label if isinstance(label, str) else f"{label:g}" for label in labels)])
    ground = np.array([surface_id(surface)])
    return Manoeuvre(name, family, speed, sample_commands(segments), np.zeros(0), ground, ground)


def sample_commands(segments: Sequence[Segment]) -> Float[np.ndarray, "T 3"]:
    """Samples the commands of segments at `RATE_HZ`."""
    return np.concatenate([np.tile(np.array(levels, np.float64), (round(seconds * RATE_HZ), 1)) for seconds, *levels in segments])


def mirror(manoeuvre: Manoeuvre) -> Manoeuvre:
    """Exchanges left and right."""
    return manoeuvre._replace(controls=manoeuvre.controls * [1.0, -1.0, 1.0], left=manoeuvre.right, right=manoeuvre.left)


def drop_mirrored(suite: Sequence[Manoeuvre]) -> list[Manoeuvre]:
    """Keeps the first of each pair of manoeuvres that mirror each other."""
    kept: dict[tuple[Any, ...], Manoeuvre] = {}
    for manoeuvre in suite:
        if _contents(mirror(manoeuvre)) not in kept:
            kept[_contents(manoeuvre)] = manoeuvre
    return list(kept.values())


def _contents(manoeuvre: Manoeuvre) -> tuple[Any, ...]:
    controls = manoeuvre.controls + 0.0  # no negative zeros
    return manoeuvre.speed, controls.tobytes(), manoeuvre.edges.tobytes(), manoeuvre.left.tobytes(), manoeuvre.right.tobytes()


def straight_accel(
    *, throttles: list[float], idle_s: float, drive_s: float, coast_s: float, stop_s: float, stop_brake: float
) -> list[Manoeuvre]:
    """Throttle, coast, brake; idle at first, as all of training."""
    return [
        open_loop(
            "straight_accel",
            [throttle],
            [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), (coast_s, 0, 0, 0), (stop_s, 0, 0, stop_brake)],
        )
        for throttle in throttles
    ]


def straight_brake(
    *, brakes: list[float], idle_s: float, drive_s: float, throttle: float, coast_s: float, stop_s: float
) -> list[Manoeuvre]:
    """One start, brakes of several strengths."""
    start = [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), (coast_s, 0, 0, 0)]
    return [open_loop("straight_brake", [brake], [*start, (stop_s, 0, 0, brake)]) for brake in brakes]


def ramp_throttle(*, idle_s: float, levels: int, level_s: float, stop_s: float, stop_brake: float) -> list[Manoeuvre]:
    """Throttle from 0 to 1 in steps, and from 1 to 0."""
    rising = np.linspace(0.0, 1.0, levels)
    return [
        open_loop(
            "ramp_throttle",
            [name],
            [(idle_s, 0, 0, 0), *((level_s, throttle, 0, 0) for throttle in ramp), (stop_s, 0, 0, stop_brake)],
        )
        for name, ramp in (("up", rising), ("down", rising[::-1]))
    ]


def step_steer(
    *, throttles: list[float], steers: list[float], idle_s: float, entry_s: float, steer_s: float, exit_s: float, stop_s: float,
    stop_brake: float,
) -> list[Manoeuvre]:  # fmt: skip
    """Gain speed, steer for a while, straighten, stop."""
    suite = []
    for throttle, steer, (side, sign) in product(throttles, steers, SIDES):
        turn = [(entry_s, throttle, 0, 0), (steer_s, throttle, sign * steer, 0), (exit_s, throttle, 0, 0)]
        suite.append(open_loop("step_steer", [throttle, steer, side], [(idle_s, 0, 0, 0), *turn, (stop_s, 0, 0, stop_brake)]))
    return suite


def const_steer(
    *, throttles: list[float], steers: list[float], idle_s: float, drive_s: float, stop_s: float, stop_brake: float
) -> list[Manoeuvre]:
    """Pull away with turned wheels and drive a circle."""
    suite = []
    for throttle, steer, (side, sign) in product(throttles, steers, SIDES):
        segments = [(idle_s, 0, 0, 0), (drive_s, throttle, sign * steer, 0), (stop_s, 0, 0, stop_brake)]
        suite.append(open_loop("const_steer", [throttle, steer, side], segments))
    return suite


def trail_brake(
    *, throttles: list[float], steers: list[float], idle_s: float, drive_s: float, levels: int, level_s: float, brake: float,
    steer_gain: float, coast_s: float, extra_frames: int,
) -> list[Manoeuvre]:  # fmt: skip
    """Brake more and more, and throttle less and less, while steering into a bend.

    Args:
        levels: steps of the fraction f = 0 to 1: throttle x (1 - f), brake x f, steer x min(1, `steer_gain` x f).
        extra_frames: at the end, of the last command: the published programme rounds its length up.
    """
    suite = []
    for throttle, steer, (side, sign) in product(throttles, steers, SIDES):
        fractions = np.linspace(0.0, 1.0, levels)
        blend = [(level_s, throttle * (1 - f), sign * steer * min(1.0, steer_gain * f), brake * f) for f in fractions]
        segments = [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), *blend, (coast_s + extra_frames / RATE_HZ, 0, 0, 0)]
        suite.append(open_loop("trail_brake", [throttle, steer, side], segments))
    return suite


def sine_steer(
    *, throttles: list[float], amplitudes: list[float], frequencies: list[float], idle_s: float, steer_s: float, hold_s: float,
    stop_s: float, stop_brake: float,
) -> list[Manoeuvre]:  # fmt: skip
    """Pull away while steering left and right; frequencies in Hz, each command constant for `hold_s`."""
    suite, times = [], np.arange(round(steer_s / hold_s)) * hold_s
    for throttle, amplitude, frequency in product(throttles, amplitudes, frequencies):
        waves = [(hold_s, throttle, amplitude * np.sin(2 * np.pi * frequency * t), 0) for t in times]
        segments = [(idle_s, 0, 0, 0), *waves, (stop_s, 0, 0, stop_brake)]
        suite.append(open_loop("sine_steer", [throttle, amplitude, f"{frequency:g}Hz"], segments))
    return suite


def chirp_steer(
    *, throttles: list[float], amplitude: float, first_hz: float, last_hz: float, idle_s: float, steer_s: float, hold_s: float,
    stop_s: float, stop_brake: float, extra_frames: int,
) -> list[Manoeuvre]:  # fmt: skip
    """Steering of rising frequency: amplitude x sin(2 pi f(t) t), f from `first_hz` to `last_hz`.

    As published: the phase is not the integral of f, so the wave itself ends at 2 x `last_hz` - `first_hz`.
    `extra_frames` as in `trail_brake`.
    """
    times = np.arange(round(steer_s / hold_s)) * hold_s
    frequency = first_hz + (last_hz - first_hz) * times / steer_s
    wave = amplitude * np.sin(2 * np.pi * frequency * times)
    stop = (stop_s + extra_frames / RATE_HZ, 0, 0, stop_brake)
    return [
        open_loop("chirp_steer", [throttle], [(idle_s, 0, 0, 0), *((hold_s, throttle, steer, 0) for steer in wave), stop])
        for throttle in throttles
    ]


def frequency_response(*, cases: list[list[float]], frequencies: list[float], steer_s: float) -> list[Manoeuvre]:
    """ISO 7401, sinusoidal steering of a small amplitude at constant speed.

    Args:
        cases: [speed, steer, throttle] each, the throttle such that the speed stays about the same.
        frequencies: Hz; whole periods fit into the second half of `steer_s`.
    """
    times, suite = np.arange(round(steer_s * RATE_HZ)) / RATE_HZ, []
    for (speed, amplitude, throttle), frequency in product(cases, frequencies):
        segments = [(1.0 / RATE_HZ, throttle, amplitude * np.sin(2 * np.pi * frequency * t), 0) for t in times]
        suite.append(open_loop("frequency_response", [speed, f"{frequency:g}Hz"], segments, speed=speed))
    return suite


def handling_limit(
    *, speeds: list[float], surfaces: list[str], straight_s: float, ramp_s: float, level_s: float, hold_s: float, exit_s: float,
    stop_s: float,
) -> list[Manoeuvre]:  # fmt: skip
    """Steering that grows to full lock at speed, zero steering for `exit_s`, then full brakes.

    The published suite has few speeds above 8 m/s, and does not reach the tyres' friction limit on every surface. Brakes while the car
    still turns would decide by one rear wheel whether it spins; spins are held out.
    """
    suite = []
    for speed, surface, (side, sign) in product(speeds, surfaces, SIDES):
        ramp = [(level_s, 0, sign * steer, 0) for steer in np.linspace(0.0, 1.0, round(ramp_s / level_s))]
        segments = [(straight_s, 0, 0, 0), *ramp, (hold_s, 0, sign, 0), (exit_s, 0, 0, 0), (stop_s, 0, 0, 1.0)]
        suite.append(open_loop("limit", [speed, surface, side], segments, speed=speed, surface=surface))
    return suite


def surface_transition(*, segments: list[list[float]], edges: list[float], surfaces: list[str]) -> list[Manoeuvre]:
    """Drive from one strip of road to the next.

    Args:
        segments: [s, throttle, steer, brake] each.
        edges: where one strip ends and the next begins, m; the published strips of 12 m were an island that cars fell off.
        surfaces: of the strips.

    Raises:
        ConfigError: an unknown surface, or not one strip more than edges.
    """
    if len(surfaces) != len(edges) + 1:
        raise ConfigError(f"surface_transition.edges: expected one fewer than surfaces ({len(surfaces)}), got {len(edges)}")
    strips = np.array([surface_id(name) for name in surfaces])
    controls = sample_commands([tuple(segment) for segment in segments])
    return [Manoeuvre("surface_transition_s", "surface_transition", 0.0, controls, np.array(edges, np.float64), strips, strips)]


def surface_id(name: str) -> int:
    """Finds the index of a surface in SURFACES.

    Raises:
        ConfigError: an unknown one.
    """
    if name not in SURFACES:
        raise ConfigError(f"surface: expected one of {', '.join(SURFACES)}, got {name!r}")
    return SURFACES.index(name)
