"""Engine, brakes, anti-lock controller and reverse gear; stops, and steering under full braking."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.driving import CAR, DT, WEIGHT, G, move, numbers_of, place

from scenefactory_jax.dynamics.articulated import actuators, equations_of_motion
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, CarParameters

pytestmark = pytest.mark.usefixtures("quickly")

FAST, MU = 100 / 3.6, np.array([1.1, 0.5, 0.2])


def state_of(car, *, speed=0.0, spin=0.0):
    qpos, qvel = np.zeros(17, np.float32), np.zeros(16, np.float32)
    qpos[2:4], qvel[0], qvel[[8, 11, 13, 15]] = (0.755, 1.0), speed, spin
    return jax.jit(states.from_mujoco)(jax.tree.map(np.float32, car), qpos, qvel)


def test_commands_are_clipped_and_a_brake_below_zero_is_released():
    command = actuators.compute_command(CAR, jnp.array([[3.0, -3.0, 0.5], [-0.5, 0.2, -1.0]]))
    np.testing.assert_allclose(command.throttle, [1.0, -0.5])
    np.testing.assert_allclose(command.steer, [-CAR.steering_limit, 0.2 * CAR.steering_limit], rtol=1e-6)
    front, rear = 0.5 * CAR.brake_torque_front, 0.5 * CAR.brake_torque_rear
    np.testing.assert_allclose(command.brake_torque, [[front, front, rear, rear], [0.0] * 4])


def test_engine_has_a_torque_a_power_and_a_spin_limit():
    """Of the front wheels: full torque at low speed, half the power each beyond, nothing at the limit."""
    car = dataclasses.replace(CAR, drive_torque=1000.0, drive_power=100e3, spin_limit=200.0)
    torque = lambda spin, throttle=1.0: actuators.compute_drive_torque(car, jnp.float32(throttle), state_of(car, spin=spin))  # noqa: E731
    for spin, wanted in ((0.0, 1000.0), (40.0, 1000.0), (100.0, 500.0), (190.0, 0.5 * 50e3 / 190.0), (200.0, 0.0), (400.0, 0.0)):
        np.testing.assert_allclose(torque(spin), [wanted, wanted, 0.0, 0.0], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(torque(100.0, 0.5), [250.0, 250.0, 0.0, 0.0], rtol=1e-5)


def test_reverse_gear_engages_at_low_speed_only():
    car = dataclasses.replace(CAR, reverse_speed=0.5, reverse_spin_limit=30.0)
    torque = lambda speed, spin: actuators.compute_drive_torque(car, jnp.float32(-0.5), state_of(car, speed=speed, spin=spin))  # noqa: E731
    np.testing.assert_allclose(torque(0.4, 0.0), [-0.5 * car.drive_torque] * 2 + [0.0] * 2, rtol=1e-5)
    np.testing.assert_array_equal(torque(0.6, 2.0), 0.0)
    np.testing.assert_allclose(torque(-10.0, -28.5), [-0.25 * car.drive_torque] * 2 + [0.0] * 2, rtol=1e-5)
    np.testing.assert_array_equal(torque(-11.0, -30.0), 0.0)


@pytest.mark.slow  # test_dynamics drives and stops; torques are above
def test_car_accelerates_drives_backwards_and_does_not_reverse_from_speed():
    """0 to 100 km/h in 10 to 11 s; backwards up to 9 to 10.5 m/s; from 20 m/s a throttle below zero is no brake."""
    carry = place(3, speed=jnp.array([0.0, 0.0, 20.0]))
    throttle = [1.0, -1.0, -1.0]
    near = move(carry, 1200, throttle=throttle)
    then = move(near, 120, throttle=throttle)
    assert near.qvel[0, 0] < FAST < then.qvel[0, 0]
    assert -CAR.reverse_spin_limit * CAR.wheel_radius < then.qvel[1, 0] < -9.0
    rolls = 20.0 - 11.0 * (0.42 * 20.0**2 + 4 * CAR.rolling_torque / CAR.wheel_radius) / (WEIGHT / G)
    assert rolls < then.qvel[2, 0] < 18.5
    assert np.abs(then.qpos[:, 1]).max() < 0.01


# ---- brakes


def stop(*, abs_enabled, steps=2400):
    """Cars that brake fully from 100 km/h on `MU`; distance, and step at which each wheel first turns slower than 0.3 of its speed."""
    carry, locked = place(3, speed=FAST), np.full((3, 4), steps)
    for step in range(0, steps, 6):
        carry = move(carry, 6, brake=1.0, mu=MU, abs_enabled=abs_enabled)
        slow = carry.qvel[:, [8, 11, 13, 15]] * CAR.wheel_radius < 0.3 * carry.qvel[:, :1]
        locked = np.where(slow & (carry.qvel[:, :1] > 5.0), np.minimum(locked, step), locked)
    return carry, locked


@pytest.fixture(scope="module", params=[True, False], ids=["abs", "no abs"])
def stopped(request):
    return request.param, *stop(abs_enabled=request.param)


@pytest.mark.slow
def test_stops_use_the_friction_of_the_road(stopped):
    """100 to 0 km/h at friction 1.1, 0.5, 0.2: at most 1.05 v^2 / (2 mu g), with the anti-lock controller and without."""
    _, carry, _ = stopped
    ratio = carry.qpos[:, 0] / (FAST**2 / (2 * MU * G))
    assert (ratio < 1.05).all() and (ratio > 0.93).all(), ratio
    assert carry.qpos[0, 0] < 40.0 and np.abs(carry.qvel[:, :6]).max() < 1e-3 and np.abs(carry.qpos[:, 1]).max() < 0.05


@pytest.mark.slow
def test_wheels_lock_without_the_controller_only_and_in_front_first(stopped):
    abs_enabled, _, locked = stopped
    if abs_enabled:
        assert (locked == 2400).all()
    else:
        assert (locked < 2400).all() and (locked[:, :2].max(1) < locked[:, 2:].min(1)).all(), locked


@pytest.mark.parametrize(("name", "front_first"), [("articulated", True), ("articulated_paper", False)])
def test_front_axle_uses_more_friction_than_the_rear(name, front_first):
    """UN R13-H, annex 5: friction used by an axle, force over load, at braking rates of 0.15 to 0.8, is larger in front."""
    car = numbers_of(name)[0]
    assert (min(front_over_rear(car)) > 1.0) == front_first


def front_over_rear(car: CarParameters):
    mass = float(equations_of_motion.total_mass(car))
    unsprung = equations_of_motion.compute_unsprung(car).mass
    height = car.wheel_radius - car.wheel_height + car.mass_height
    height = (car.mass * height + float(np.sum(unsprung)) * car.wheel_radius) / mass
    share = car.brake_torque_front / (car.brake_torque_front + car.brake_torque_rear)
    for rate in np.arange(0.15, 0.81, 0.05):
        load = float(np.sum(equations_of_motion.compute_wheel_loads(car) * (AHEAD > 0))) + rate * mass * G * height / car.wheelbase
        yield share / load / ((1.0 - share) / (mass * G - load))


@pytest.mark.slow  # a program more
def test_a_car_steers_under_full_braking_with_the_controller_and_not_without():
    """A lane change of 3.5 m from 20 m/s on friction 0.3, straight after it: steered by the distance to the new lane."""
    ends = {}
    for abs_enabled in (True, False):
        carry = place(3, speed=20.0)
        ends[abs_enabled] = move(carry, 1080, brake=1.0, mu=0.3, gain=0.01, target=3.5, abs_enabled=abs_enabled)
    for end in ends.values():
        assert np.linalg.norm(end.qvel[:, :2], axis=1).max() < 1e-3
    heading = 2 * np.arctan2(ends[True].qpos[0, 6], ends[True].qpos[0, 3])
    assert ends[True].qpos[0, 1] == pytest.approx(3.5, abs=0.2) and abs(heading) < np.radians(1.5)
    assert ends[True].qpos[0, 0] < 1.05 * 20.0**2 / (2 * 0.3 * G)
    assert abs(ends[False].qpos[0, 1]) < 0.1, "locked front wheels do not steer"


def test_others_push_where_they_touch_wherever_the_mass_is():
    """Force and torque of a contact are about the box's centre; both are at the height of the mass. Air acts at the mass itself."""
    car = dataclasses.replace(CAR, mass_forward=0.3, air_drag=2.0)
    turn = 0.7
    qpos = jnp.zeros(17).at[2].set(0.755).at[3].set(np.cos(turn / 2)).at[6].set(np.sin(turn / 2))

    @jax.jit
    def torque(force, speed):
        state = states.from_mujoco(car, qpos, jnp.zeros(16).at[1].set(speed))
        push = actuators.PlanarForce(force, jnp.float32(500.0))
        return jnp.stack([*actuators.compute_applied_forces(car, state, jnp.float32(0.0), push).torque])

    aside = 1000.0 * np.array([np.sin(turn), np.cos(turn)])  # of a push to the north, in the car's axes
    wanted = [-car.mass_height * aside[1], car.mass_height * aside[0], 500.0]
    np.testing.assert_allclose(torque(jnp.array([0.0, 1000.0]), 0.0), wanted, rtol=1e-5)
    drag = -2.0 * 10.0**2 * np.array([np.sin(turn), np.cos(turn)])
    wanted = [-car.mass_height * drag[1], car.mass_height * drag[0], 500.0 + car.mass_forward * drag[1]]
    np.testing.assert_allclose(torque(jnp.zeros(2), 10.0), wanted, rtol=1e-5)


@pytest.mark.slow
def test_anti_lock_controller_leaves_a_gentle_brake_alone():
    """At a sixth of the brakes no wheel comes near the slip that the controller allows: both cars are the same."""
    ends = [move(place(3, speed=15.0), 60, brake=0.15, mu=[1.1, 0.9, 0.7], abs_enabled=on) for on in (True, False)]
    np.testing.assert_allclose(ends[0].qvel, ends[1].qvel, atol=1e-4)
    assert ends[0].qvel[0, 0] < 15.0 - 0.15 * 0.9 * G * 60 * DT
