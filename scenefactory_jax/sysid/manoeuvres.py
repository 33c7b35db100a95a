"""Manoeuvres of one car as commands over time on a road of up to a few surfaces, and what a recording of one holds.

The 139 of training are SceneFactory's suite: same families, grids, durations and numbers of frames, all from rest. Their numbers are in
`conf/sysid/manoeuvres.yaml`, an entry a family; the functions here are those entries' targets.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.instantiate import ConfigError, instantiate

SURFACES = ("dry", "wet", "gravel")  # index = surface id
TRAINING = (
    "straight_accel", "straight_brake", "ramp_throttle", "step_steer", "const_steer", "trail_brake", "sine_steer", "chirp_steer",
    "surface_transition",
)  # fmt: skip
LIMIT = ("limit",)
HELDOUT = ("steady_circle", "iso_step_steer", "brake_in_turn", "sine_with_dwell", "straight_stop", "split_stop", "lane_change")
FAMILIES = TRAINING + LIMIT + HELDOUT
RATE_HZ = 60.0  # of commands and records
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
    """What a car did, at the end of each frame. It starts at the origin, heading along x; left is positive."""

    manoeuvre: Manoeuvre
    position: Float[np.ndarray, "T 2"]  # of the box's centre, m
    yaw: Float[np.ndarray, " T"]  # unwrapped, rad
    speed: Float[np.ndarray, " T"]  # in the plane, m/s
    yaw_rate: Float[np.ndarray, " T"]  # rad/s
    wheel_spin: Float[np.ndarray, "T 4"]  # in the order of `car.WHEELS`, rad/s
    steer: Float[np.ndarray, " T"]  # of the front wheels, rad
    lateral: Float[np.ndarray, " T"]  # acceleration of the centre of mass to the left, m/s^2
    roll: Float[np.ndarray, " T"]  # of the body, right side down is positive, rad


def training(entries: Mapping[str, Mapping[str, Any]]) -> list[Manoeuvre]:
    """The 139, from the entries under `training` in `conf/sysid/manoeuvres.yaml`; those under `heldout` are `heldout.heldout`'s.

    Raises:
        ConfigError: an entry that cannot be built, or two manoeuvres of one name.
    """
    return make_suite(entries, builtins=__name__, where="sysid.manoeuvres.training")


def extra(entries: Mapping[str, Mapping[str, Any]]) -> list[Manoeuvre]:
    """Those that are fitted beside the published ones, from the entries under `extra`."""
    return make_suite(entries, builtins=__name__, where="sysid.manoeuvres.extra")


def make_suite(entries: Mapping[str, Mapping[str, Any]], *, builtins: str, where: str, **context: Any) -> list[Manoeuvre]:
    """All manoeuvres of the families in `entries`.

    Args:
        builtins: module of the targets.
        where: place in the config, for messages.
        context: what targets may ask for beside their numbers (`teacher`, for those that a driver steers).

    Raises:
        ConfigError: an entry that cannot be built, or two manoeuvres of one name.
    """
    found: list[Manoeuvre] = []
    for key, entry in entries.items():
        found += instantiate(entry, builtins=builtins, where=f"{where}.{key}", **context)()
    names = [m.name for m in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ConfigError(f"{where}: more than one manoeuvre of the name {sorted(twice)[0]!r}; every name must be its own")
    return found


def commands(segments: Sequence[Segment]) -> Float[np.ndarray, "T 3"]:
    """One row a frame, held over each segment."""
    return np.concatenate([np.tile(np.array(levels, np.float64), (round(seconds * RATE_HZ), 1)) for seconds, *levels in segments])


def on_one_surface(name: str, family: str, segments: Sequence[Segment], *, speed: float = 0.0, surface: int = 0) -> Manoeuvre:
    """A manoeuvre on endless ground of one surface."""
    ground = np.array([surface])
    return Manoeuvre(name, family, speed, commands(segments), np.zeros(0), ground, ground)


def mirror(manoeuvre: Manoeuvre) -> Manoeuvre:
    """Left and right exchanged."""
    return manoeuvre._replace(controls=manoeuvre.controls * [1.0, -1.0, 1.0], left=manoeuvre.right, right=manoeuvre.left)


def straight_accel(
    *, throttles: list[float], idle_s: float, drive_s: float, coast_s: float, stop_s: float, stop_brake: float
) -> list[Manoeuvre]:
    """Throttle, coast, brake; idle at first, as all of training."""

    def one(throttle: float) -> Manoeuvre:
        legs = [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), (coast_s, 0, 0, 0), (stop_s, 0, 0, stop_brake)]
        return on_one_surface(f"straight_accel_{throttle:g}", "straight_accel", legs)

    return [one(throttle) for throttle in throttles]


def straight_brake(
    *, brakes: list[float], idle_s: float, drive_s: float, throttle: float, coast_s: float, stop_s: float
) -> list[Manoeuvre]:
    """One start, brakes of several strengths."""

    def one(brake: float) -> Manoeuvre:
        legs = [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), (coast_s, 0, 0, 0), (stop_s, 0, 0, brake)]
        return on_one_surface(f"straight_brake_{brake:g}", "straight_brake", legs)

    return [one(brake) for brake in brakes]


def ramp_throttle(*, idle_s: float, levels: int, level_s: float, stop_s: float, stop_brake: float) -> list[Manoeuvre]:
    """Throttle from 0 to 1 in steps, and from 1 to 0."""

    def one(name: str, ramp: np.ndarray) -> Manoeuvre:
        legs = [(idle_s, 0, 0, 0), *((level_s, throttle, 0, 0) for throttle in ramp), (stop_s, 0, 0, stop_brake)]
        return on_one_surface(f"ramp_throttle_{name}", "ramp_throttle", legs)

    rising = np.linspace(0.0, 1.0, levels)
    return [one("up", rising), one("down", rising[::-1])]


def step_steer(
    *,
    throttles: list[float],
    steers: list[float],
    idle_s: float,
    entry_s: float,
    steer_s: float,
    exit_s: float,
    stop_s: float,
    stop_brake: float,
) -> list[Manoeuvre]:
    """Gain speed, steer for a while, straighten, stop."""

    def one(throttle: float, steer: float, side: str, sign: float) -> Manoeuvre:
        turn = [(entry_s, throttle, 0, 0), (steer_s, throttle, sign * steer, 0), (exit_s, throttle, 0, 0)]
        legs = [(idle_s, 0, 0, 0), *turn, (stop_s, 0, 0, stop_brake)]
        return on_one_surface(f"step_steer_{throttle:g}_{steer:g}_{side}", "step_steer", legs)

    return [one(throttle, steer, *side) for throttle in throttles for steer in steers for side in SIDES]


def const_steer(
    *, throttles: list[float], steers: list[float], idle_s: float, drive_s: float, stop_s: float, stop_brake: float
) -> list[Manoeuvre]:
    """Pull away with turned wheels and go round."""

    def one(throttle: float, steer: float, side: str, sign: float) -> Manoeuvre:
        legs = [(idle_s, 0, 0, 0), (drive_s, throttle, sign * steer, 0), (stop_s, 0, 0, stop_brake)]
        return on_one_surface(f"const_steer_{throttle:g}_{steer:g}_{side}", "const_steer", legs)

    return [one(throttle, steer, *side) for throttle in throttles for steer in steers for side in SIDES]


def trail_brake(
    *,
    throttles: list[float],
    steers: list[float],
    idle_s: float,
    drive_s: float,
    levels: int,
    level_s: float,
    brake: float,
    steer_gain: float,
    coast_s: float,
    extra_frames: int,
) -> list[Manoeuvre]:
    """Brake more and more, and throttle less and less, while steering into a bend.

    Args:
        levels: steps of the share f = 0 to 1: throttle x (1 - f), brake x f, steer x min(1, `steer_gain` x f).
        extra_frames: at the end, of the last command: the published programme rounds its length up.
    """

    def one(throttle: float, steer: float, side: str, sign: float) -> Manoeuvre:
        share = np.linspace(0.0, 1.0, levels)
        blend = [(level_s, throttle * (1 - f), sign * steer * min(1.0, steer_gain * f), brake * f) for f in share]
        legs = [(idle_s, 0, 0, 0), (drive_s, throttle, 0, 0), *blend, (coast_s + extra_frames / RATE_HZ, 0, 0, 0)]
        return on_one_surface(f"trail_brake_{throttle:g}_{steer:g}_{side}", "trail_brake", legs)

    return [one(throttle, steer, *side) for throttle in throttles for steer in steers for side in SIDES]


def sine_steer(
    *,
    throttles: list[float],
    amplitudes: list[float],
    frequencies: list[float],
    idle_s: float,
    steer_s: float,
    hold_s: float,
    stop_s: float,
    stop_brake: float,
) -> list[Manoeuvre]:
    """Pull away while steering left and right; frequencies in Hz, each command held for `hold_s`."""

    def one(throttle: float, amplitude: float, frequency: float) -> Manoeuvre:
        times = np.arange(round(steer_s / hold_s)) * hold_s
        waves = [(hold_s, throttle, amplitude * np.sin(2 * np.pi * frequency * t), 0) for t in times]
        legs = [(idle_s, 0, 0, 0), *waves, (stop_s, 0, 0, stop_brake)]
        return on_one_surface(f"sine_steer_{throttle:g}_{amplitude:g}_{frequency:g}Hz", "sine_steer", legs)

    return [one(throttle, amplitude, frequency) for throttle in throttles for amplitude in amplitudes for frequency in frequencies]


def chirp_steer(
    *,
    throttles: list[float],
    amplitude: float,
    first_hz: float,
    last_hz: float,
    idle_s: float,
    steer_s: float,
    hold_s: float,
    stop_s: float,
    stop_brake: float,
    extra_frames: int,
) -> list[Manoeuvre]:
    """Steering that quickens: amplitude x sin(2 pi f(t) t), f from `first_hz` to `last_hz`.

    As published: the phase is not the integral of f, so the wave itself ends at 2 x `last_hz` - `first_hz`.
    `extra_frames` as in `trail_brake`.
    """

    def one(throttle: float) -> Manoeuvre:
        times = np.arange(round(steer_s / hold_s)) * hold_s
        frequency = first_hz + (last_hz - first_hz) * times / steer_s
        waves = [(hold_s, throttle, steer, 0) for steer in amplitude * np.sin(2 * np.pi * frequency * times)]
        legs = [(idle_s, 0, 0, 0), *waves, (stop_s + extra_frames / RATE_HZ, 0, 0, stop_brake)]
        return on_one_surface(f"chirp_steer_{throttle:g}", "chirp_steer", legs)

    return [one(throttle) for throttle in throttles]


def handling_limit(
    *, speeds: list[float], surfaces: list[str], straight_s: float, ramp_s: float, level_s: float, hold_s: float, stop_s: float
) -> list[Manoeuvre]:  # fmt: skip
    """Ours: steering that grows to full lock at speed, then full brakes: what the published suite, which hardly passes 8 m/s, says not of
    the tyres' grip on every surface."""

    def one(speed: float, surface: str, side: str, sign: float) -> Manoeuvre:
        ramp = [(level_s, 0, sign * steer, 0) for steer in np.linspace(0.0, 1.0, round(ramp_s / level_s))]
        legs = [(straight_s, 0, 0, 0), *ramp, (hold_s, 0, sign, 0), (stop_s, 0, 0, 1.0)]
        return on_one_surface(f"limit_{speed:g}_{surface}_{side}", "limit", legs, speed=speed, surface=surface_id(surface))

    return [one(speed, surface, *side) for speed in speeds for surface in surfaces for side in SIDES]


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
        raise ConfigError(f"surface_transition: {len(surfaces)} surfaces with {len(edges)} edges; wanted is one edge fewer")
    strips = np.array([surface_id(name) for name in surfaces])
    legs = [(seconds, throttle, steer, brake) for seconds, throttle, steer, brake in segments]
    return [Manoeuvre("surface_transition_s", "surface_transition", 0.0, commands(legs), np.array(edges, np.float64), strips, strips)]


def surface_id(name: str) -> int:
    """Place of a surface among SURFACES.

    Raises:
        ConfigError: an unknown one.
    """
    if name not in SURFACES:
        raise ConfigError(f"surface {name!r} is unknown; valid: {', '.join(SURFACES)}")
    return SURFACES.index(name)
