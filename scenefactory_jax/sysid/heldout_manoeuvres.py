"""Standard tests that no fit may see: what a car fitted to the training manoeuvres is judged by.

Open loop: steady circles (ISO 4138), step steer (ISO 7401), braking in a turn (ISO 7975), sine with dwell (FMVSS 126), straight and split
stops. Closed loop: double lane changes (ISO 3888-1, 3888-2). There a driver steers the teacher and its commands are the manoeuvre: the
replay is open loop, as of all others. The tests start at speed, with the wheels rolling. Numbers: `conf/sysid/manoeuvres.yaml`.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.sysid import manoeuvres, multibody_model
from scenefactory_jax.sysid.manoeuvres import RATE_HZ, SIDES, Manoeuvre, on_one_surface, surface_id
from scenefactory_jax.sysid.reference_recordings import advance


def heldout(entries: Mapping[str, Mapping[str, Any]], *, teacher: multibody_model.ReferenceVehicle) -> list[Manoeuvre]:
    """All of them; `teacher` is who drives the lane changes.

    Raises:
        ConfigError: an entry that cannot be built, or two manoeuvres of one name.
    """
    return manoeuvres.make_suite(entries, builtins=__name__, where="sysid.manoeuvres.heldout", teacher=teacher)


def steady_circle(
    *, start_speed: float, steers: list[float], throttle: float, rising_s: float, steady: list[list[float]], steady_s: float
) -> list[Manoeuvre]:
    """ISO 4138, fixed steer: speed that rises slowly, and constant speeds.

    Args:
        start_speed: of those that rise, m/s, under `throttle`, for each of `steers`.
        steady: [speed, steer, throttle] each, the throttle such that the speed stays about the same.
    """

    def one(name: str, speed: float, levels: tuple[float, float], seconds: float, side: str, sign: float) -> Manoeuvre:
        legs = [(seconds, levels[0], sign * levels[1], 0.0)]
        return on_one_surface(f"steady_circle_{name}_{side}", "steady_circle", legs, speed=speed)

    rising = [one(f"rising_{steer:g}", start_speed, (throttle, steer), rising_s, *side) for steer in steers for side in SIDES]
    constant = [one(f"{speed:g}_{steer:g}", speed, (level, steer), steady_s, *side) for speed, steer, level in steady for side in SIDES]
    return rising + constant


def iso_step_steer(*, cases: list[list[float]], straight_s: float, steer_s: float) -> list[Manoeuvre]:
    """ISO 7401: straight, then a step of the steer, and hold. `cases`: [speed, steer, throttle] each."""
    return [
        on_one_surface(
            f"iso_step_steer_{speed:g}_{steer:g}_{side}", "iso_step_steer",
            [(straight_s, throttle, 0.0, 0.0), (steer_s, throttle, sign * steer, 0.0)], speed=speed,
        )
        for speed, steer, throttle in cases for side, sign in SIDES
    ]  # fmt: skip


def brake_in_turn(*, cases: list[list[float]], brakes: list[float], turn_s: float, stop_s: float) -> list[Manoeuvre]:
    """ISO 7975: settle on a circle, then brake at fixed steer. `cases`: [speed, steer, throttle] each, braked with each of `brakes`."""
    return [
        on_one_surface(
            f"brake_in_turn_{speed:g}_{steer:g}_{brake:g}_{side}", "brake_in_turn",
            [(turn_s, throttle, sign * steer, 0.0), (stop_s, 0.0, sign * steer, brake)], speed=speed,
        )
        for speed, steer, throttle in cases for brake in brakes for side, sign in SIDES
    ]  # fmt: skip


def sine_with_dwell(
    *, speed: float, amplitudes: list[float], frequency_hz: float, dwell_s: float, straight_s: float, after_s: float
) -> list[Manoeuvre]:
    """FMVSS 126: one coasting sine of the steer that waits for `dwell_s` at its second peak."""

    def steer(time: float) -> float:
        turned = min(time, 0.75 / frequency_hz) + max(0.0, time - 0.75 / frequency_hz - dwell_s)
        return math.sin(2 * math.pi * frequency_hz * turned) if turned < 1.0 / frequency_hz else 0.0

    times = np.arange(round((1.0 / frequency_hz + dwell_s + after_s) * RATE_HZ)) / RATE_HZ
    wave = [steer(time) for time in times.tolist()]
    return [
        on_one_surface(
            f"sine_with_dwell_{amplitude:g}_{side}", "sine_with_dwell",
            [(straight_s, 0.0, 0.0, 0.0), *((1.0 / RATE_HZ, 0.0, sign * amplitude * level, 0.0) for level in wave)], speed=speed,
        )
        for amplitude in amplitudes for side, sign in SIDES
    ]  # fmt: skip


def straight_stop(*, speeds: list[float], surfaces: list[str], brakes: list[float], coast_s: float, stop_s: float) -> list[Manoeuvre]:
    """Coast, then brake to rest on one surface."""
    return [
        on_one_surface(
            f"straight_stop_{speed:g}_{surface}_{brake:g}", "straight_stop",
            [(coast_s, 0.0, 0.0, 0.0), (stop_s, 0.0, 0.0, brake)], speed=speed, surface=surface_id(surface),
        )
        for speed in speeds for surface in surfaces for brake in brakes
    ]  # fmt: skip


def split_stop(*, speed: float, surfaces: list[str], brakes: list[float], coast_s: float, stop_s: float) -> list[Manoeuvre]:
    """Brake with one side of the car on a slippery surface, the other on the dry; wheel held straight."""
    found = []
    for surface in surfaces:
        for brake in brakes:
            legs = [(coast_s, 0.0, 0.0, 0.0), (stop_s, 0.0, 0.0, brake)]
            even = on_one_surface(f"split_stop_{surface}_{brake:g}_left", "split_stop", legs, speed=speed)
            split = even._replace(left=np.array([surface_id(surface)]))
            found += [split, manoeuvres.mirror(split)._replace(name=f"split_stop_{surface}_{brake:g}_right")]
    return found


def lane_change(
    *,
    teacher: multibody_model.ReferenceVehicle,
    track: str,
    sections_m: list[float],
    offset_m: float,
    cases: list[list[float]],
    off_throttle: bool,
    straight_m: float,
    preview_s: float,
    preview_least_m: float,
    after_m: float,
) -> list[Manoeuvre]:
    """ISO 3888 double lane change, to the left and back.

    The driver is pure pursuit: it steers, by the wheelbase alone, for the circle that is tangent to the car's heading and goes through a
    point of the track's centre line some time ahead. In the transit sections that line is half a cosine wave.
    The driver does not see the cones.

    Args:
        track: for the names.
        sections_m: lengths: entry lane, transit, side lane, transit, exit lane.
        offset_m: from the entry lane's centre line to the side lane's.
        cases: [speed, throttle] each, the throttle such that the speed stays about the same.
        off_throttle: release the throttle when in the entry lane (ISO 3888-2).
        straight_m: before the entry lane, and `after_m` after the exit lane.
        preview_s: how far ahead the driver looks, at least `preview_least_m`.

    Raises:
        ConfigError: other than five sections.
    """
    if len(sections_m) != 5:
        raise ConfigError(f"lane_change.sections_m: {sections_m}; wanted are five lengths, entry to exit")
    entry, out, lane, back, leave = sections_m
    ends = np.cumsum([straight_m + entry, out, lane, back, leave + after_m])

    def centre(x: float) -> float:
        rise = min(max((x - ends[0]) / out, 0.0), 1.0) - min(max((x - ends[2]) / back, 0.0), 1.0)
        return offset_m * 0.5 * (1.0 - math.cos(math.pi * rise))

    vehicle, found = multibody_model.Vehicle(teacher), []
    for speed, throttle in cases:
        driver = _pursuit(centre, teacher, preview_s=preview_s, preview_least_m=preview_least_m)
        release_m = straight_m if off_throttle else math.inf
        controls = _driven(vehicle, driver, speed=speed, throttle=throttle, release_m=release_m, end_m=float(ends[-1]))
        ground = np.zeros(1, int)
        found.append(Manoeuvre(f"lane_change_{track}_{speed:g}", "lane_change", speed, controls, np.zeros(0), ground, ground))
    return found


def _pursuit(
    centre: Callable[[float], float], teacher: multibody_model.ReferenceVehicle, *, preview_s: float, preview_least_m: float
) -> Callable[[np.ndarray], float]:
    """State -> steer command."""

    def steer(state: np.ndarray) -> float:
        x, y, yaw, forward = (float(state[i]) for i in (multibody_model.X, multibody_model.Y, multibody_model.YAW, multibody_model.FORWARD))
        ahead = max(preview_least_m, preview_s * forward)
        dx, dy = ahead, centre(x + ahead) - y
        aside = dy * math.cos(yaw) - dx * math.sin(yaw)
        angle = math.atan(teacher.car.wheelbase * 2.0 * aside / (dx**2 + dy**2))
        return min(max(angle / teacher.steering_lock, -1.0), 1.0)

    return steer


def _driven(
    vehicle: multibody_model.Vehicle,
    driver: Callable[[np.ndarray], float],
    *,
    speed: float,
    throttle: float,
    release_m: float,
    end_m: float,
) -> np.ndarray:
    """Commands of the driver, frame by frame, until the car is past `end_m` or 20 s are over."""
    state, rows = multibody_model.start(vehicle, speed), []
    vehicle.set_grip([vehicle.teacher.grip[0]] * 4)
    while state[multibody_model.X] < end_m and len(rows) < 20 * RATE_HZ:
        rows.append((throttle if state[multibody_model.X] < release_m else 0.0, driver(state), 0.0))
        state = advance(state, rows[-1], 1, vehicle=vehicle, road=None)[-1]
    return np.array(rows)
