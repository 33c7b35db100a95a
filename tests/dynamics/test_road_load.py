"""Rolling resistance, air drag, and tyres that yield to slip angle: laws of motion, on the eight cars of `test_randomization`."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_dynamics import CHUNK, LANES, MU, constant, make, random_controls, scene_for
from test_randomization import CAR, SOLVER, drive, started

from experiments.validation import motion_laws
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.dynamics import mujoco_c
from scenefactory_jax.dynamics.articulated import actuators, constants, randomization, tyres
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.equations_of_motion import total_mass

pytestmark = pytest.mark.usefixtures("quickly")

FREE = dataclasses.replace(  # nothing else slows it
    CAR, wheel_damping=0.0, yaw_damping=0.0, rolling_torque=0.0, air_drag=0.0, tyre_slip_damping=5.0, tyre_slip_speed=1e3
)
SPIN = [8, 11, 13, 15]
ON = dict(rolling_torque=40.0, air_drag=1.5, tyre_slip_speed=3.0, tyre_slip_damping=15.0)


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


def cornering(several, speed, lateral):
    """Slip angle of the rear axle over the lateral acceleration, and that, of a steady turn."""
    action = constant(seconds=3)
    action[..., 1] = np.arctan(FREE.wheelbase * lateral / speed**2) / FREE.steering_limit
    _, motion = go(several, action, speed=speed)
    yaw, rate, velocity = (leaf[-45:] for leaf in (motion.yaw, motion.yaw_rate, motion.velocity[..., :2]))
    ahead = (velocity * np.stack([np.cos(yaw), np.sin(yaw)], -1)).sum(-1)
    aside = (velocity * np.stack([-np.sin(yaw), np.cos(yaw)], -1)).sum(-1) - FREE.wheelbase / 2 * rate
    gained = (rate * ahead).mean(0)
    return -np.arctan2(aside, ahead).mean(0) / gained, gained


def test_a_lateral_force_needs_the_same_slip_angle_at_every_speed():
    """And the slip angle is that of `forces.slip_damping`: speed x damping / impedance over the contact's R."""
    law = dataclasses.replace(FREE, tyre_slip_speed=2.5, tyre_slip_damping=20.0)
    grips = np.flatnonzero(MU >= 0.5)  # lanes 0, 4, 5, 6, 7
    speed, lateral = np.full(8, 10.0), np.full(8, 1.0)
    several = [FREE] * 8
    for lane, pace, one in zip(grips, (5.0, 15.0, 10.0, 5.0, 15.0), (law, law, law, FREE, FREE), strict=True):
        speed[lane], several[lane] = pace, one
    slip, gained = cornering(several, speed, lateral)
    np.testing.assert_allclose(gained[grips], 1.0, rtol=0.1)
    slow, fast, middle, old_slow, old_fast = slip[grips]
    assert slow == pytest.approx(fast, rel=0.1) and middle == pytest.approx(fast, rel=0.1)
    assert old_slow > 2.5 * old_fast  # slip velocity: three times the angle at a third of the speed
    weight = constants.derive_constants(jax.tree.map(jnp.float32, law)).wheel_weight[2]
    d = law.tyre_impedance
    yields = float(weight) * (1 - d) / d / SOLVER.friction_ratio
    assert fast == pytest.approx(total_mass(law) / 4 * yields / (20.0 * 2.5 / d), rel=0.05)


def test_below_the_slip_speed_nothing_changes():
    speed = jnp.array([0.0, 1.0, 2.5, 5.0, 25.0])
    qvel = jnp.zeros((5, 16)).at[:, 1].set(speed)
    law = dataclasses.replace(FREE, tyre_slip_speed=2.5, tyre_slip_damping=20.0)

    def damping(of, velocity):
        return tyres.compute_slip_damping(of, states.from_mujoco(of, jnp.zeros(17).at[3].set(1.0), velocity))

    found = jax.vmap(functools.partial(damping, law))(qvel)
    np.testing.assert_allclose(found, [20.0, 20.0, 20.0, 10.0, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(jax.vmap(functools.partial(damping, FREE))(qvel), np.float32(FREE.tyre_slip_damping))


def test_gradients_are_finite_at_rest():
    law = dataclasses.replace(FREE, **ON)

    def load(qvel):
        state = states.from_mujoco(law, jnp.zeros(17).at[3].set(1.0), qvel)
        push = actuators.PlanarForce(jnp.zeros(2), jnp.zeros(()))
        pushed = actuators.compute_applied_forces(law, state, jnp.zeros(()), jnp.zeros(4), push)
        return sum(jnp.sum(part) for part in jax.tree.leaves(pushed)) + tyres.compute_slip_damping(law, state)

    slope = jax.jit(jax.grad(load))
    for speed in (0.0, 3.0, 10.0):
        assert np.isfinite(slope(jnp.zeros(16).at[0].set(speed))).all()


def test_each_car_has_its_own_and_drives_as_in_the_c_engine():
    rng = np.random.default_rng(2)
    several = []
    for _ in range(8):
        rolls, drags, yields = rng.uniform(10, 60), rng.uniform(0.3, 2.0), rng.uniform(1.0, 4.0)
        own = dict(rolling_torque=rolls, air_drag=drags, tyre_slip_speed=yields, tyre_slip_damping=rng.uniform(4, 20))
        several.append(dataclasses.replace(CAR, **{name: float(number) for name, number in own.items()}))
    speed, action = np.linspace(16, 4, 8), random_controls(11, 3, 15)
    body, _ = go(several, action, speed=speed)
    newton = dataclasses.replace(SOLVER, algorithm="newton")
    converged = {"physics_dt": 1 / 120, "substeps": 4, "iterations": 100, "line_search": 50}
    for i, car in enumerate(several):
        case = {"mu": np.full(4, float(MU[i])), "speed": float(speed[i]), **converged}
        truth = mujoco_c.simulate(car, newton, action[:, i], **case)
        apart = (body.qpos[:, i] - truth.qpos)[:, :2] - [0.0, LANES[i]]
        assert np.linalg.norm(apart, axis=1).max() < 0.01, i
        for name in ON:  # each of them matters, so each would be missed
            other = dataclasses.replace(car, **{name: getattr(CAR, name)})
            without = mujoco_c.simulate(other, newton, action[:, i], **case)
            if MU[i] >= 0.5:
                assert np.linalg.norm((without.qpos - truth.qpos)[:, :2], axis=1).max() > 1e-3, (i, name)


def test_resistance_grows_with_the_footprint():
    larger = randomization.resize_car(dataclasses.replace(CAR, **ON), np.array([8.0, 3.0]))
    assert larger.rolling_torque == pytest.approx(3 * 40.0) and larger.air_drag == pytest.approx(3 * 1.5)
    assert larger.tyre_slip_speed == 3.0


def test_brakes_distance_counts_all_that_slows():
    car, v, x, dt = dataclasses.replace(CAR, **ON), 15.0, 0.0, 1e-4
    mass = total_mass(car) + 4 * car.wheel_inertia[0] / car.wheel_radius**2
    while v > 0:
        torque = 2 * (car.brake_torque_front + car.brake_torque_rear) + 4 * (car.wheel_damping * v / car.wheel_radius + car.rolling_torque)
        v, x = v - dt * (torque / car.wheel_radius + car.air_drag * v * v) / mass, x + dt * v
    assert motion_laws.brake_limit_m(car, 15.0) == pytest.approx(x, rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"brakes": "latched", "car": {"rolling_torque": 10.0}}, "dynamics.car.rolling_torque: expected 0 with latched brakes, got 10"),
        ({"car": {"tyre_slip_speed": 0.0}}, "dynamics.car.tyre_slip_speed: expected a number > 0, got 0"),
    ],
)
def test_what_cannot_be_is_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        make("articulated", **changes)
