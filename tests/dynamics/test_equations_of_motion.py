"""A car's equations of motion in closed form: against the C engine's and MJX's, number by number, at states near and far from rest."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.choosing import slow_except
from support.driving import CAR, DT, SOLVER, compiled_car, place
from support.mjx_problem import columns, problem_of_mjx, random_states
from support.running import quick_compilation
from test_randomization import random_car

from scenefactory_jax.dynamics.articulated import (
    actuators,
    articulated_car,
    closed_form_step,
    constants,
    equations_of_motion,
    mjx_backend,
    tyres,
)
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.vector import dot

COUNT = 60
derive = jax.jit(constants.derive_constants)
SMOOTH = ("base", "across", "wheel", "force_base", "force_wheel")  # whether tyres touch or not


@pytest.fixture
def quick():
    """For formulas that are worked out once: no optimisation of programs that MJX makes large."""
    with quick_compilation():
        yield


@pytest.fixture(scope="module")
def model():
    """Compiled with all that MJX's stages need."""
    return models.build_standalone_model(CAR, SOLVER, physics_dt=DT, visual=False)


@pytest.fixture(scope="module")
def stages(model):
    return mjx_backend.put_model(model)


@pytest.fixture(scope="module")
def crew():
    """As many cars, no two alike."""
    several = [jax.tree.map(np.float32, random_car(seed)) for seed in range(COUNT)]
    return jax.jit(jax.vmap(constants.derive_constants))(jax.tree.map(lambda *leaves: np.stack(leaves), *several))


@pytest.fixture(scope="module")
def cases(model):
    rng = np.random.default_rng(1)
    qpos, qvel = random_states(model, CAR, count=COUNT, seed=0)
    command = actuators.Command(rng.uniform(-0.5, 0.5, COUNT), rng.uniform(-1.0, 1.0, COUNT), rng.uniform(0.0, 3000.0, (COUNT, 4)))
    push = actuators.PlanarForce(rng.normal(0.0, 2000.0, (COUNT, 2)), rng.normal(0.0, 500.0, COUNT))
    tyre = rng.normal(0.0, 3000.0, (COUNT, 2, 4))
    return jax.device_put(jax.tree.map(np.float32, (qpos, qvel, (command, push, tyre))))


def step_input(own, qpos, qvel, inputs):
    """The input of a step of one car, with these tangential forces of the tyres."""
    (command, push, tyre), state = inputs, states.from_mujoco(own.car, qpos, qvel)
    patch, drive = tyres.find_contact_patches(own.car, state), actuators.compute_drive_torque(own.car, command.throttle, state)
    forces = actuators.compute_applied_forces(own.car, state, command.steer, push)
    pulled = tyres.TyreForces((tyre[0], tyre[1]), (tyre[0], tyre[1]), -command.brake_torque)
    forces = jax.tree.map(jnp.add, forces, tyres.compute_generalized_forces(state, patch, pulled, drive))
    return closed_form_step.StepInput(own, state, patch, forces)


def of_closed_form(own, *case):
    """The problem in closed form, and the rows of which tyres count."""
    inputs = step_input(own, *case)
    return closed_form_step.make_contact_problem(inputs, physics_dt=DT), inputs.patch.depth > 0.0


def of_mjx(own, *case, stages):
    inputs = step_input(own, *case)
    forces = inputs.forces
    applied = states.flatten([*forces.force, *forces.torque], [forces.suspension, forces.spin, forces.steer], inputs.state)
    return problem_of_mjx(stages, mjx_backend.fit_model(stages, own), *case[:2], applied)


def together(field):
    """[count, numbers, 4]"""
    return np.stack([np.broadcast_to(np.asarray(leaf).reshape(COUNT, -1), (COUNT, 4)) for leaf in jax.tree.leaves(field)], axis=1)


def broadcast(field):
    """Numbers of the wheels, all four of them."""
    return [jnp.broadcast_to(leaf, (4,)) for leaf in jax.tree.leaves(field)]


@pytest.mark.slow  # the C engine's forces below
def test_the_problem_is_that_of_mjx_for_cars_that_differ(quick, crew, cases, stages):
    """A force is compared with the largest of its kind: MJX's own rounding is up to 1e-5 of that, see the next test."""
    found, pressed = jax.jit(jax.vmap(of_closed_form))(crew, *cases)
    with jax.default_matmul_precision("highest"):
        wanted = jax.jit(jax.vmap(functools.partial(of_mjx, stages=stages)))(crew, *cases)
    pressed = np.asarray(pressed)[:, None]
    assert 0.1 < pressed.mean() < 0.9
    for name in found._fields:
        left, right = together(getattr(found, name)), together(getattr(wanted, name))
        if name == "rows":  # MJX takes J out where a tyre is in the air, here it weighs nothing
            left, right = left * pressed, right * pressed
        tolerance = 3e-5 if "force" in name else 5e-6
        np.testing.assert_allclose(left, right, atol=tolerance * np.abs(right).max(), rtol=1e-5, err_msg=name)
    assert not np.asarray(found.rows.weight)[~pressed[:, 0]].any()


@pytest.mark.parametrize("seed", slow_except(range(3), 0))
def test_inertia_and_forces_are_the_c_engines(cases, seed):
    """In double precision, of cars that were compiled one by one."""
    car = random_car(seed)
    model = models.build_standalone_model(car, SOLVER, physics_dt=DT, visual=False)
    data, full, at = mujoco.MjData(model), np.zeros((16, 16)), columns(mjx_backend.put_model(model))
    own = derive(jax.tree.map(np.float32, car))
    qpos, qvel = cases[:2]

    @jax.jit
    @jax.vmap
    def one(qpos, qvel):
        state = states.from_mujoco(own.car, qpos, qvel)
        base, across, joints = (
            jnp.stack([jnp.stack([jnp.broadcast_to(number, shape) for number in row]) for row in part])
            for part, shape in zip(equations_of_motion.compute_mass_matrix(own.car, state), ((), (4,), (4,)), strict=True)
        )
        away, held = (
            equations_of_motion.compute_bias_force(own.car, state, equations_of_motion.compute_bias_acceleration(state)),
            actuators.compute_suspension_forces(own.car, state),
        )
        smooth = jax.tree.map(lambda a, b: a - b, held, away)
        pushed = states.flatten([*smooth.force, *smooth.torque], [smooth.suspension, smooth.spin, smooth.steer], state)
        rotation = jnp.stack([jnp.stack(row) for row in states.rotation_matrix(qpos[3:7])])
        return base, across, joints, pushed, rotation

    parts = [np.asarray(part, float) for part in one(qpos, qvel)]
    wanted, found, masses = [], [], 0.0
    for i in range(COUNT):
        data.qpos[:], data.qvel[:] = np.asarray(qpos[i], float), np.asarray(qvel[i], float)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        wanted.append(data.qfrc_smooth.copy())
        base, across, joints, pushed, rotation = (part[i] for part in parts)
        found.append(pushed)
        mass = np.zeros((17, 17))
        mass[:6, :6] = base
        for wheel in range(4):
            mass[:6, at[wheel]] = across[..., wheel]
            mass[at[wheel], :6] = across[..., wheel].T
            mass[np.ix_(at[wheel], at[wheel])] = joints[..., wheel]
        turn = np.eye(16)
        turn[:3, :3] = rotation
        masses = max(masses, np.abs(turn @ mass[:16, :16] @ turn.T - full).max() / np.abs(full).max())
    apart = np.abs(np.array(found) - np.array(wanted)).max(0)
    assert masses < 1e-6
    assert (apart < 2e-5 * np.maximum(np.abs(wanted).max(0), 10.0)).all(), apart / np.abs(wanted).max(0)


@pytest.mark.slow
def test_slopes_of_the_problem_are_those_of_mjx(quick, crew, cases, stages):
    """Of a weighted sum of its numbers, with respect to the car's own, its velocities and what it is told. The solver's are its own."""
    few = jax.tree.map(lambda leaf: leaf[:12], (crew, *cases))
    rng = np.random.default_rng(2)
    weigh = {name: jnp.asarray(rng.normal(0, 1, 4), jnp.float32) for name in SMOOTH}

    def by(problem_of):
        def value(own, qpos, qvel, command):
            found = problem_of(own, qpos, qvel, command)
            return sum((weigh[name] * leaf / (1 + i)).sum() for name in SMOOTH for i, leaf in enumerate(broadcast(getattr(found, name))))

        return jax.jit(jax.vmap(jax.grad(value, argnums=(0, 2, 3))))

    found = by(lambda *case: of_closed_form(*case)[0])(*few)
    with jax.default_matmul_precision("highest"):
        wanted = by(functools.partial(of_mjx, stages=stages))(*few)
    for (path, left), right in zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-3, atol=3e-4 * np.abs(right).max(), err_msg=jax.tree_util.keystr(path))


def test_the_car_turns_as_the_c_engine_integrates(model, cases):
    qpos, qvel = cases[:2]
    move = jax.jit(jax.vmap(functools.partial(states.integrate, physics_dt=DT)))
    moved, left = jax.device_get(move(qpos, qvel, np.zeros((COUNT, 16), np.float32)))
    np.testing.assert_array_equal(left, qvel)
    for i in range(COUNT):
        wanted = np.asarray(qpos[i], float)
        mujoco.mj_integratePos(model, wanted, np.asarray(qvel[i], float), DT)
        np.testing.assert_allclose(moved[i], wanted, atol=2e-6)


def test_a_car_at_rest_has_a_slope_of_its_turning():
    def turned(rate):
        return states.integrate(jnp.zeros(17).at[3].set(1.0), jnp.zeros(16).at[3:6].set(rate), jnp.zeros(16), physics_dt=DT)[0][4:7]

    np.testing.assert_allclose(jax.jit(jax.jacobian(turned))(np.zeros(3, np.float32)), DT / 2 * np.eye(3), rtol=1e-6)


def test_joints_stand_where_the_compiled_model_has_them(model, cases):
    """Numbers by joint to MuJoCo's order and axes and back."""
    at, (qpos, qvel) = models.find_addresses(model), cases[:2]
    one = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[0], (qpos, qvel)))
    state = jax.jit(lambda qpos, qvel: states.from_mujoco(CAR, qpos, qvel))(*one)
    for places, number in ((at.suspension_q, state.travel), (at.steer_q, state.steer[:2])):
        np.testing.assert_array_equal(one[0][places], number)
    for places, number in ((at.suspension_v, state.travel_rate), (at.steer_v, state.steer_rate[:2]), (at.spin_v, state.spin)):
        np.testing.assert_array_equal(one[1][places], number)
    there_and_back = jax.jit(lambda qvel, state: states.flatten(*states.unflatten(qvel, state), state))
    np.testing.assert_allclose(there_and_back(one[1], state), one[1], rtol=1e-5, atol=1e-5)


def test_masses_and_weights_are_the_compiled_models(model):
    own, compiled = derive(jax.tree.map(np.float32, CAR)), compiled_car().constants
    np.testing.assert_allclose(own.wheel_weight, compiled.wheel_weight, rtol=1e-4)
    assert equations_of_motion.total_mass(CAR) == pytest.approx(model.body_mass.sum())
    np.testing.assert_allclose(equations_of_motion.compute_loads(CAR).sum(), CAR.mass * 9.81)


def test_forces_of_the_tyres_act_where_they_touch(model, cases):
    """Against the C engine's `mj_applyFT` at the contact, in double precision."""
    data, at = mujoco.MjData(model), models.find_addresses(model)
    own = derive(jax.tree.map(np.float32, CAR))
    force = np.asarray(cases[2][2], float)

    @jax.jit
    @jax.vmap
    def found(qpos, qvel, tyre):
        state = states.from_mujoco(own.car, qpos, qvel)
        patch = tyres.find_contact_patches(own.car, state)
        forces = tyres.compute_generalized_forces(state, patch, tyres.TyreForces(tuple(tyre), tuple(tyre), jnp.zeros(4)), jnp.zeros(4))
        generalised = states.flatten([*forces.force, *forces.torque], [forces.suspension, forces.spin, forces.steer], state)
        to_world = lambda vector: jnp.stack([dot(axis, vector) for axis in (state.east, state.north, state.up)], axis=-1)  # noqa: E731
        return generalised, *(to_world(vector) for vector in (patch.arm, patch.forward, patch.left))

    generalised, arm, forward, left = (np.asarray(part, float) for part in found(cases[0], cases[1], cases[2][2]))
    np.testing.assert_allclose(forward[..., 2], 0.0, atol=1e-5)  # in the plane of the road
    np.testing.assert_allclose(left[..., 2], 0.0, atol=1e-5)
    for i in range(COUNT):
        data.qpos[:], data.qvel[:] = np.asarray(cases[0][i], float), np.asarray(cases[1][i], float)
        mujoco.mj_fwdPosition(model, data)
        wanted = np.zeros(16)
        for wheel, body in enumerate(at.wheel):
            pull = forward[i, wheel] * force[i, 0, wheel] + left[i, wheel] * force[i, 1, wheel]
            mujoco.mj_applyFT(model, data, pull, np.zeros(3), data.xpos[body] + arm[i, wheel], body, wanted)
        np.testing.assert_allclose(generalised[i], wanted, atol=2e-5 * np.abs(wanted).max())


@pytest.fixture(scope="module")
def moves(cases):
    """`physics_step` of the reference car with both solvers, converged."""
    command, push, _ = cases[2]
    both = {}
    for algorithm in ("closed_form", "newton"):
        solver = dataclasses.replace(SOLVER, algorithm=algorithm, iterations=8, line_search=8, tolerance=0.0)
        compiled = articulated_car.compile_car(CAR, solver, abs_enabled=True, physics_dt=DT, control_dt=DT)
        with jax.default_matmul_precision("highest"):
            move = jax.jit(jax.vmap(functools.partial(articulated_car.physics_step, compiled, compiled.constants, {})))
            both[algorithm] = lambda now, move=move: move(now, command, push, jnp.full((COUNT, 4), 0.8))
    return both


def at(qpos, qvel):
    return place(COUNT)._replace(qpos=qpos, qvel=qvel)


@pytest.mark.slow  # test_c_engine_comparison drives a few cars with both
def test_a_step_is_that_of_mjxs_newton(quick, moves, cases):
    """Cars on the road and far from it."""
    one, other = (moves[name](at(*cases[:2])) for name in ("closed_form", "newton"))
    for name, near in (("qpos", 1e-5), ("qvel", 2e-3)):
        apart = np.abs(np.asarray(getattr(one, name)) - np.asarray(getattr(other, name))).max(1)
        assert np.median(apart) < near and np.percentile(apart, 95) < 10 * near, np.sort(apart)
    for left, right in zip(jax.tree.leaves(one.tyres), jax.tree.leaves(other.tyres), strict=True):
        assert np.median(np.abs(np.asarray(left) - np.asarray(right))) <= 1e-4 * max(np.abs(right).max(), 1e-3)


@pytest.mark.slow
def test_a_tyre_in_the_air_carries_nothing_however_its_wheel_turns(quick, cases):
    compiled, (command, push, _) = compiled_car(), cases[2]
    still = np.tile(compiled.rest_pose, (COUNT, 1)).astype(np.float32)
    still[:, 2] += 2.0
    move = jax.jit(jax.vmap(functools.partial(articulated_car.physics_step, compiled, compiled.constants, {})))
    after = move(at(jax.device_put(still), cases[1]), command, push, jax.device_put(np.full((COUNT, 4), 0.8, np.float32))).tyres
    assert max(np.abs(part).max() for part in (after.normal, after.tangent, after.slip, after.forward, after.left)) < 1e-3
