"""Standard tests that no fit may use: a car fitted to the training manoeuvres is evaluated on them.

Open loop: steady circles (ISO 4138), step steer (ISO 7401), braking in a turn (ISO 7975), straight and split stops, and three in which the
reference car spins: sine with dwell (FMVSS 126), trail braking, and a swerve on wet road. Closed loop: double lane changes (ISO 3888-1,
3888-2). There a driver steers the reference car, and its commands are the manoeuvre, replayed open loop as all others. The tests start at
speed, with the wheels rolling. Numbers: `conf/sysid/manoeuvres.yaml`.
"""

import math
from collections.abc import Callable
from itertools import product

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid import multibody_model
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, SIDES, Manoeuvre, mirror, open_loop, surface_id
from scenefactory_jax.sysid.multibody_model import ReferenceVehicle, Vehicle
from scenefactory_jax.sysid.reference_recordings import advance


def steady_circle(
    *, start_speed: float, steers: list[float], throttle: float, rising_s: float, steady: list[list[float]], steady_s: float
) -> list[Manoeuvre]:
    """ISO 4138, fixed steer: speed that rises slowly, and constant speeds.

    Args:
        start_speed: of those that rise, m/s, under `throttle`, for each of `steers`.
        steady: [speed, steer, throttle] each, the throttle such that the speed stays about the same.
    """
    rising = [("rising", steer, start_speed, throttle, steer, rising_s) for steer in steers]
    constant = [(speed, steer, speed, level, steer, steady_s) for speed, steer, level in steady]
    return [
        open_loop("steady_circle", [first, second, side], [(seconds, level, sign * steer, 0.0)], speed=speed)
        for (first, second, speed, level, steer, seconds), (side, sign) in product([*rising, *constant], SIDES)
    ]


def iso_step_steer(*, cases: list[list[float]], straight_s: float, steer_s: float) -> list[Manoeuvre]:
    """ISO 7401: straight, then a constant steer. `cases`: [speed, steer, throttle] each."""
    suite = []
    for (speed, steer, throttle), (side, sign) in product(cases, SIDES):
        segments = [(straight_s, throttle, 0.0, 0.0), (steer_s, throttle, sign * steer, 0.0)]
        suite.append(open_loop("iso_step_steer", [speed, steer, side], segments, speed=speed))
    return suite


def brake_in_turn(*, cases: list[list[float]], brakes: list[float], turn_s: float, stop_s: float) -> list[Manoeuvre]:
    """ISO 7975: settle on a circle, then brake at fixed steer. `cases`: [speed, steer, throttle] each, braked with each of `brakes`."""
    suite = []
    for (speed, steer, throttle), brake, (side, sign) in product(cases, brakes, SIDES):
        segments = [(turn_s, throttle, sign * steer, 0.0), (stop_s, 0.0, sign * steer, brake)]
        suite.append(open_loop("brake_in_turn", [speed, steer, brake, side], segments, speed=speed))
    return suite


def sine_with_dwell(
    *, family: str, speed: float, surface: str, amplitudes: list[float], frequency_hz: float, dwell_s: float, straight_s: float,
    after_s: float,
) -> list[Manoeuvre]:  # fmt: skip
    """FMVSS 126: one coasting sine of the steer that stays at its second peak for `dwell_s`."""

    def steer(time: float) -> float:
        phase_s = min(time, 0.75 / frequency_hz) + max(0.0, time - 0.75 / frequency_hz - dwell_s)
        return math.sin(2 * math.pi * frequency_hz * phase_s) if phase_s < 1.0 / frequency_hz else 0.0

    times = np.arange(round((1.0 / frequency_hz + dwell_s + after_s) * RATE_HZ)) / RATE_HZ
    wave, suite = [steer(time) for time in times.tolist()], []
    for amplitude, (side, sign) in product(amplitudes, SIDES):
        segments = [(straight_s, 0.0, 0.0, 0.0), *((1.0 / RATE_HZ, 0.0, sign * amplitude * level, 0.0) for level in wave)]
        suite.append(open_loop(family, [amplitude, side], segments, speed=speed, surface=surface))
    return suite


def trail_braking(
    *, speed: float, steer: float, throttle: float, turns_s: list[float], brake: float, straight_s: float, stop_s: float
) -> list[Manoeuvre]:
    """Brake hard at fixed steer, `turns_s` after the begin of the turn: the rear axle loses its grip."""
    suite = []
    for turn_s, (side, sign) in product(turns_s, SIDES):
        turn = [(turn_s, throttle, sign * steer, 0.0), (stop_s, 0.0, sign * steer, brake)]
        suite.append(open_loop("trail_braking", [turn_s, side], [(straight_s, 0.0, 0.0, 0.0), *turn], speed=speed))
    return suite


def straight_stop(*, speeds: list[float], surfaces: list[str], brakes: list[float], coast_s: float, stop_s: float) -> list[Manoeuvre]:
    """Coast, then brake to rest on one surface."""
    suite = []
    for speed, surface, brake in product(speeds, surfaces, brakes):
        segments = [(coast_s, 0.0, 0.0, 0.0), (stop_s, 0.0, 0.0, brake)]
        suite.append(open_loop("straight_stop", [speed, surface, brake], segments, speed=speed, surface=surface))
    return suite


def split_stop(*, speed: float, surfaces: list[str], brakes: list[float], coast_s: float, stop_s: float) -> list[Manoeuvre]:
    """Brake with one side of the car on a slippery surface, the other on the dry; zero steer."""
    suite = []
    for surface, brake in product(surfaces, brakes):
        segments = [(coast_s, 0.0, 0.0, 0.0), (stop_s, 0.0, 0.0, brake)]
        split = open_loop("split_stop", [surface, brake, "left"], segments, speed=speed)._replace(left=np.array([surface_id(surface)]))
        suite += [split, mirror(split)._replace(name=f"split_stop_{surface}_{brake:g}_right")]
    return suite


def lane_change(
    *, reference: ReferenceVehicle, track: str, sections_m: list[float], offset_m: float, cases: list[list[float]], off_throttle: bool,
    straight_m: float, preview_s: float, preview_least_m: float, after_m: float,
) -> list[Manoeuvre]:  # fmt: skip
    """ISO 3888 double lane change, to the left and back.

    The driver is pure pursuit: it steers, by the wheelbase alone, for the circle that is tangent to the car's heading and goes through a
    point of the track's centre line ahead. In the transit sections that line is half a cosine wave. The driver does not observe the cones.

    Args:
        reference: the car that is driven.
        track: for the names.
        sections_m: lengths: entry lane, transit, side lane, transit, exit lane.
        offset_m: from the entry lane's centre line to the side lane's.
        cases: [speed, throttle] each, the throttle such that the speed stays about the same.
        off_throttle: release the throttle when in the entry lane (ISO 3888-2).
        straight_m: before the entry lane, and `after_m` after the exit lane.
        preview_s: time to the point that the driver steers for, at least `preview_least_m`.

    Raises:
        ConfigError: other than five sections.
    """
    if len(sections_m) != 5:
        raise ConfigError(f"lane_change.sections_m: expected five lengths, entry to exit, got {sections_m}")
    entry, out, lane, back, leave = sections_m
    ends = np.cumsum([straight_m + entry, out, lane, back, leave + after_m])

    def centre(x: float) -> float:
        rise = min(max((x - ends[0]) / out, 0.0), 1.0) - min(max((x - ends[2]) / back, 0.0), 1.0)
        return offset_m * 0.5 * (1.0 - math.cos(math.pi * rise))

    def steer(state: np.ndarray) -> float:
        x, y, yaw, forward = (float(state[i]) for i in (multibody_model.X, multibody_model.Y, multibody_model.YAW, multibody_model.FORWARD))
        dx = max(preview_least_m, preview_s * forward)
        dy = centre(x + dx) - y
        lateral = dy * math.cos(yaw) - dx * math.sin(yaw)
        angle = math.atan(reference.car.wheelbase * 2.0 * lateral / (dx**2 + dy**2))
        return min(max(angle / reference.steering_lock, -1.0), 1.0)

    vehicle, suite, ground = Vehicle(reference), [], np.zeros(1, int)
    release_m = straight_m if off_throttle else math.inf
    for speed, throttle in cases:
        controls = _drive(vehicle, steer, speed=speed, throttle=throttle, release_m=release_m, end_m=float(ends[-1]))
        suite.append(Manoeuvre(f"lane_change_{track}_{speed:g}", "lane_change", speed, controls, np.zeros(0), ground, ground))
    return suite


def _drive(
    vehicle: Vehicle, steer: Callable[[np.ndarray], float], *, speed: float, throttle: float, release_m: float, end_m: float
) -> np.ndarray:
    """Computes the driver's commands, frame by frame, until the car is past `end_m` or for 20 s."""
    state, commands = multibody_model.start(vehicle, speed), []
    vehicle.set_grip([vehicle.reference.grip[0]] * 4)
    while state[multibody_model.X] < end_m and len(commands) < 20 * RATE_HZ:
        commands.append((throttle if state[multibody_model.X] < release_m else 0.0, steer(state), 0.0))
        state = advance(state, commands[-1], 1, vehicle=vehicle, road=None)[-1]
    return np.array(commands)
