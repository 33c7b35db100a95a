"""What the car's laws say by themselves: tyres that turn, brakes that hold an engine."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_randomization import CAR, SOLVER

from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import actuators, constants, equations_of_motion, tyres
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.vector import dot as vector_dot


@pytest.fixture(scope="module")
def rig():
    newton = dataclasses.replace(SOLVER, algorithm="newton")
    return mujoco_c.make_one(CAR, newton, physics_dt=1 / 120, iterations=100, line_search=50)


def slips(rig, qpos, qvel):
    """Slip velocity of each tyre over the ground in the world's axes, from the C engine's Jacobian; hub to contact; the engine's state."""
    rig.data.qpos[:], rig.data.qvel[:] = qpos, qvel
    mujoco.mj_step1(rig.model, rig.data)
    rows = rig.data.efc_J.reshape(-1, rig.model.nv) @ rig.data.qvel
    slip, arm = np.full((4, 3), np.nan), np.full((4, 3), np.nan)
    for contact in rig.data.contact:
        wheel = rig.tyre_of[contact.geom[1]]
        slip[wheel] = contact.frame.reshape(3, 3).T @ rows[contact.efc_address : contact.efc_address + 3]
        arm[wheel] = contact.pos - rig.data.xpos[rig.model.geom_bodyid[contact.geom[1]]]
    return slip, arm


def turning(qpos, qvel, arm):
    """`tyres.turning`, in the world's axes, as the C engine has the arms; the tyres' own arms are those."""
    own = constants.derive_constants(jax.tree.map(jnp.float32, CAR))
    state = states.from_mujoco(own.car, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
    patch = tyres.find_contact_patches(own.car, state)
    world = lambda vector: np.stack([vector_dot(axis, vector) for axis in (state.east, state.north, state.up)], axis=-1)  # noqa: E731
    np.testing.assert_allclose(world(patch.arm), arm, atol=1e-6)
    return world(tyres.compute_jdot_qvel(patch, equations_of_motion.compute_bias_acceleration(state)))


@pytest.mark.parametrize("seed", range(4))
def test_turning_is_what_jacobian_times_acceleration_leaves_out(rig, seed):
    """Against the difference of the slips a moment before and after, of a car that nothing accelerates."""
    rng, at = np.random.default_rng(seed), models.find_addresses(rig.model)
    qpos, qvel = models.find_rest_pose(rig.model, CAR), np.zeros(16)
    qpos[3:7] = [np.cos(0.4), 0.0, 0.0, np.sin(0.4)]
    qpos[at.steer_q], qvel[at.steer_v] = rng.uniform(-0.3, 0.3, 2), rng.uniform(-1.0, 1.0, 2)
    qvel[:2], qvel[5], qvel[at.spin_v] = rng.uniform(-15.0, 15.0, 2), rng.uniform(-1.0, 1.0), rng.uniform(-50.0, 50.0, 4)
    _, arm = slips(rig, qpos, qvel)
    found = turning(qpos, qvel, arm)
    ends = []
    for time in (-1e-4, 1e-4):
        moved = qpos.copy()
        mujoco.mj_integratePos(rig.model, moved, qvel, time)
        ends.append(slips(rig, moved, qvel)[0])
    wanted = (ends[1] - ends[0]) / 2e-4
    np.testing.assert_allclose(found[:, :2], wanted[:, :2], rtol=1e-3, atol=1e-2)
    assert np.abs(wanted[:, :2]).max() > 1.0


def test_a_car_that_rolls_through_a_bend_slips_at_a_constant_rate(rig):
    """Centripetal acceleration of the hubs and the turn of their axles cancel: seen with the car, nothing about it changes."""
    at, qpos, qvel = models.find_addresses(rig.model), models.find_rest_pose(rig.model, CAR), np.zeros(16)
    rate, radius = 0.5, CAR.wheel_radius
    qvel[1], qvel[5] = 0.0, rate
    qvel[0] = 10.0
    _, arm = slips(rig, qpos, qvel)
    forward = qvel[0] - rate * cars.LEFT * CAR.track / 2
    qvel[at.spin_v] = forward / -arm[:, 2]
    found = turning(qpos, qvel, arm)
    centripetal = np.array([0.0, rate * qvel[0], 0.0])  # J qacc of a chassis on its circle
    np.testing.assert_allclose(found[:, 1] + centripetal[1], 0.0, atol=1e-3)
    assert radius == pytest.approx(-arm[0, 2], abs=0.01)


def test_what_the_brakes_take_of_the_engine_is_taken_off():
    car, brake = dataclasses.replace(CAR, rolling_torque=0.0), np.array([400.0, 700.0, 300.0, 0.0])
    command = actuators.Command(jnp.float32(0.0), jnp.float32(600.0), jnp.asarray(brake))
    for spin in (20.0, 0.0):
        torque, loss = actuators.compute_wheel_torques(car, command, jnp.full(4, spin))
        np.testing.assert_allclose(torque, [200.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(loss, [cars.MIN_FRICTION_LOSS, 100.0, 300.0, cars.MIN_FRICTION_LOSS], rtol=1e-6)
    torque, loss = actuators.compute_wheel_torques(car, command, jnp.full(4, -20.0))
    np.testing.assert_array_equal(torque, [600.0, 600.0, 0.0, 0.0])
    np.testing.assert_allclose(loss[:3], brake[:3])


def test_the_engine_ends_at_the_spin_limit():
    car = dataclasses.replace(CAR, spin_limit=100.0)
    spins = jnp.array([[-50.0, 0.0, 0.0, 0.0], [89.0, 95.0, 0.0, 0.0], [100.0, 400.0, 0.0, 0.0]])
    torque = jax.vmap(lambda spin: actuators.compute_drive_torque(car, jnp.float32(600.0), spin))(spins)
    np.testing.assert_allclose(torque, [[600.0, 600.0, 0.0, 0.0], [600.0, 300.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], rtol=1e-5)


def test_others_push_where_they_touch_wherever_the_mass_is():
    """Force and torque of a contact are about the box's centre; both are at the height of the mass. Air acts at the mass itself."""
    car = dataclasses.replace(CAR, mass_forward=0.3, air_drag=2.0)
    turn, zero = 0.7, jnp.zeros(4)
    qpos = jnp.zeros(17).at[2].set(0.755).at[3].set(np.cos(turn / 2)).at[6].set(np.sin(turn / 2))

    def torque(force, speed):
        state = states.from_mujoco(car, qpos, jnp.zeros(16).at[1].set(speed))
        push = actuators.PlanarForce(jnp.array(force), jnp.float32(500.0))
        return np.array([*actuators.compute_applied_forces(car, state, jnp.float32(0.0), zero, push).torque])

    aside = 1000.0 * np.array([np.sin(turn), np.cos(turn)])  # of a push to the north, in the car's axes
    np.testing.assert_allclose(torque([0.0, 1000.0], 0.0), [-car.mass_height * aside[1], car.mass_height * aside[0], 500.0], rtol=1e-5)
    drag = -2.0 * 10.0**2 * np.array([np.sin(turn), np.cos(turn)])
    wanted = [-car.mass_height * drag[1], car.mass_height * drag[0], 500.0 + car.mass_forward * drag[1]]
    np.testing.assert_allclose(torque([0.0, 0.0], 10.0), wanted, rtol=1e-5)
