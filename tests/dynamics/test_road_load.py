"""Rolling resistance and air drag: laws of motion, on the eight cars of `test_randomization`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.driving import CAR, CHUNK, CONVERGED, LANES, MU, SOLVER, constant, make, random_controls, scene_for
from test_randomization import LONG, drive, started

from experiments.validation import motion_laws
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import actuators, randomization
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.equations_of_motion import total_mass

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

FREE = dataclasses.replace(  # nothing else slows it
    CAR, wheel_damping=0.0, yaw_damping=0.0, rolling_torque=0.0, air_drag=0.0, drive_torque=590.95, drive_power=1e7
)
SPIN = [8, 11, 13, 15]
ON = dict(rolling_torque=40.0, air_drag=1.5)


def crew(name, numbers):
    """The free car with one number changed, eight times."""
    return [dataclasses.replace(FREE, **{name: float(number)}) for number in numbers]


def go(several, action, speed=0.0):
    scene = scene_for(speed=speed)
    return drive(scene, action, body=started(scene, several))[1]


def rolling(body):
    """Radius on which the cars roll, as the trace has it (the tyres are a little pressed), and mass with the wheels' inertia."""
    radius = np.median(body.qvel[..., 0] / np.maximum(body.qvel[..., SPIN].mean(-1), 1e-3), axis=0)
    return radius, total_mass(FREE) + 4 * FREE.wheel_inertia[0] / radius**2


@pytest.mark.slow  # these share a program; test_dynamics stops with both
def test_rolling_resistance_slows_a_car_evenly_and_then_holds_it():
    torque = np.array([0.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    several = crew("rolling_torque", torque)
    body, motion = go(several, constant(seconds=2), speed=5.0)
    radius, mass = rolling(body)
    np.testing.assert_allclose(radius, 0.35, rtol=0.03)
    slowing = (motion.velocity[14, :, 0] - motion.velocity[-1, :, 0]) / (45 / CHUNK)
    np.testing.assert_allclose(slowing, 4 * torque / (radius * mass), rtol=0.02, atol=1e-3)

    speed = 4 * torque / (0.35 * mass) * 2.0  # two seconds to a halt
    _, motion = go(several, constant(seconds=5), speed=speed)
    way, last = motion.position[..., 0], motion.velocity[-1, :, 0]
    np.testing.assert_allclose(way[-1], speed * 2.0 / 2, rtol=0.05, atol=1e-3)
    assert np.abs(last).max() < 1e-3 and np.abs(way[-1] - way[-1 - 2 * CHUNK]).max() < 1e-3


def test_an_engine_below_the_rolling_resistance_does_not_move_the_car():
    """Two wheels drive, four resist: what the front wheels have left has to move the rear ones."""
    share = np.array([0.0, 0.25, 0.5, 0.5, 0.75, 1.5, 2.0, 3.0])
    action = constant(seconds=3)
    action[..., 0] = share * 2 * 60.0 / FREE.drive_torque
    body, motion = go(crew("rolling_torque", np.full(8, 60.0)), action)
    _, mass = rolling(body)
    held = share < 1.0
    assert np.abs(motion.velocity[-1, held, 0]).max() < 0.05 and motion.position[-1, 1, 0] < 1e-4  # the rear wheels' friction is soft
    free = 4 * 60.0 * (share[~held] - 1.0) / (0.346 * mass[~held])
    np.testing.assert_allclose(motion.velocity[-1, ~held, 0] / 3.0, free, rtol=0.06)


@pytest.mark.slow
def test_air_drag_is_the_square_of_speed():
    """Coasting m v' = -c v^2: v0 / (1 + c v0 t / m). Under the engine m v' = F - c v^2: tanh, up to the square root of F / c."""
    drag = np.array([0.0, 0.4, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0])
    body, motion = go(crew("air_drag", drag), constant(seconds=3), speed=20.0)
    _, mass = rolling(body)
    time = np.arange(1, 3 * CHUNK + 1)[:, None] / CHUNK
    np.testing.assert_allclose(motion.velocity[..., 0], 20.0 / (1 + drag * 20.0 * time / mass), rtol=0.005)

    drag = np.array([100.0, 100.0, 100.0, 100.0, 50.0, 50.0, 100.0, 200.0])
    action = constant(seconds=10)
    action[..., 0] = throttle = np.array([1.0, 0.05, 0.05, 0.2, 0.5, 1.0, 1.0, 1.0])
    body, motion = go(crew("air_drag", drag), action)
    radius, mass = rolling(body)
    force = 2 * throttle * FREE.drive_torque / radius
    top = np.sqrt(force / drag)
    time = np.arange(1, 10 * CHUNK + 1)[:, None] / CHUNK
    grips = MU >= 0.5
    wanted = top * np.tanh(force * time / (mass * top))
    np.testing.assert_allclose(motion.velocity[CHUNK::CHUNK, grips, 0], wanted[CHUNK::CHUNK, grips], rtol=0.03)
    assert motion.velocity[-1, 7, 0] == pytest.approx(top[7], rel=0.01)


def test_gradients_are_finite_at_rest():
    law = dataclasses.replace(FREE, **ON)

    def load(qvel):
        state = states.from_mujoco(law, jnp.zeros(17).at[3].set(1.0), qvel)
        push = actuators.PlanarForce(jnp.zeros(2), jnp.zeros(()))
        pushed = actuators.compute_applied_forces(law, state, jnp.zeros(()), push)
        return sum(jnp.sum(part) for part in jax.tree.leaves(pushed))

    slope = jax.jit(jax.grad(load))
    for speed in (0.0, 3.0, 10.0):
        assert np.isfinite(slope(jnp.zeros(16).at[0].set(speed))).all()


@pytest.mark.slow
def test_each_car_has_its_own_and_drives_as_in_the_c_engine():
    rng = np.random.default_rng(2)
    several = []
    for _ in range(8):
        own = dict(rolling_torque=float(rng.uniform(10, 60)), air_drag=float(rng.uniform(0.3, 2.0)))
        several.append(dataclasses.replace(CAR, **own))
    speed, action = np.linspace(16, 8, 8), 0.3 * random_controls(11, 2, 15)
    body, _ = go(several, action, speed=speed)
    for i in (0, 4, 7):
        case = {"mu": np.full(4, float(MU[i])), "speed": float(speed[i]), "abs_enabled": True, **CONVERGED}
        car = several[i]
        truth = mujoco_c.simulate(car, SOLVER, action[:, i], **case)
        apart = (body.qpos[:, i] - truth.qpos)[:, :2] - [0.0, LANES[i]]
        assert np.linalg.norm(apart, axis=1).max() < 0.01, i
        for name in ON:  # each of them matters, so each would be missed
            other = dataclasses.replace(car, **{name: getattr(CAR, name)})
            without = mujoco_c.simulate(other, SOLVER, action[:, i], **case)
            assert np.linalg.norm((without.qpos - truth.qpos)[:, :2], axis=1).max() > 1e-3, (i, name)


def test_resistance_grows_with_the_footprint():
    larger = randomization.resize_car(dataclasses.replace(CAR, **ON), np.array([8.0, 3.0]), LONG)
    assert larger.rolling_torque == pytest.approx(3 * 40.0) and larger.air_drag == pytest.approx(3 * 1.5)
    assert larger.drive_power == pytest.approx(3 * CAR.drive_power)


def test_brakes_distance_counts_all_that_slows():
    car, v, x, dt = dataclasses.replace(CAR, **ON), 15.0, 0.0, 1e-4
    mass = total_mass(car) + 4 * car.wheel_inertia[0] / car.wheel_radius**2
    while v > 0:
        torque = 2 * (car.brake_torque_front + car.brake_torque_rear) + 4 * (car.wheel_damping * v / car.wheel_radius + car.rolling_torque)
        v, x = v - dt * (torque / car.wheel_radius + car.air_drag * v * v) / mass, x + dt * v
    assert motion_laws.brake_limit_m(car, 15.0) == pytest.approx(x, rel=1e-3)


@pytest.mark.parametrize(("name", "bad"), [("rolling_torque", -1.0), ("air_drag", float("nan")), ("drive_power", -5.0)])
def test_what_cannot_be_is_refused_by_name(name, bad):
    with pytest.raises(ConfigError, match=rf"^dynamics\.car\.{name}: expected a number >= 0, got"):
        make("articulated", car={name: bad})
