"""The solver of the tyres' normal forces on single steps: against the C engine's converged accelerations, and its laws."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.driving import CAR, DT, SOLVER

from scenefactory_jax.dynamics.articulated import closed_form_step, constants, contact_solver, tyres
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.equations_of_motion import Forces
from scenefactory_jax.dynamics.articulated.vector import Vector

pytestmark = pytest.mark.usefixtures("quickly")
COUNT = 64


@pytest.fixture(scope="module")
def model():
    exact = dataclasses.replace(SOLVER, algorithm="newton", iterations=100, line_search=50, tolerance=1e-12)
    return models.build_standalone_model(CAR, exact, physics_dt=DT, visual=False)


@pytest.fixture(scope="module")
def cases(model):
    """Cars above, in and below their ride height, some in the air, pushed in all directions; wheels that lift and land."""
    at, rng = models.find_addresses(model), np.random.default_rng(0)
    qpos = np.tile(models.find_rest_pose(model, CAR), (COUNT, 1))
    qpos[:, 2] += rng.normal(0, 0.015, COUNT)
    lean = rng.normal(0, 0.02, (COUNT, 3))
    qpos[:, 3:7] = np.concatenate([np.ones((COUNT, 1)), lean], 1) / np.sqrt(1 + (lean**2).sum(1, keepdims=True))
    qpos[-4:, 2] += 0.5
    qpos[:, at.suspension_q] += rng.normal(0, 0.03, (COUNT, 4))
    qvel = rng.normal(0, 1, (COUNT, 16)) * np.array([8, 3, 0.5, 0.5, 0.5, 0.6] + [1] * 10)
    qvel[:, at.spin_v] = qvel[:, :1] / CAR.wheel_radius + rng.normal(0, 10, (COUNT, 4))
    push = rng.normal(0, 1, (COUNT, 16)) * np.array([2000, 2000, 5000, 300, 300, 500] + [100] * 10)
    return [jnp.asarray(column, jnp.float32) for column in (qpos, qvel, push)]


@pytest.fixture(scope="module")
def truth(model, cases):
    """Accelerations, and the tyres' normal forces, of the C engine in double precision."""
    data, found, forces = mujoco.MjData(model), [], np.zeros((COUNT, 4))
    tyre = models.find_addresses(model).tyre
    for i, (qpos, qvel, push) in enumerate(zip(*(np.asarray(column, float) for column in cases), strict=True)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, push
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
        for geoms, address in zip(data.contact.geom, data.contact.efc_address, strict=True):
            forces[i, np.isin(tyre, geoms)] = data.efc_force[address]
    return np.array(found), forces


def problem_of(qpos, qvel, push):
    own = constants.derive_constants(jax.tree.map(jnp.float32, CAR))
    state = states.from_mujoco(own.car, qpos, qvel)
    base, wheel = states.unflatten(push, state)
    forces = Forces(Vector(*base[:3]), Vector(*base[3:]), *wheel)
    inputs = closed_form_step.StepInput(own, state, tyres.find_contact_patches(own.car, state), forces)
    return closed_form_step.make_contact_problem(inputs, physics_dt=DT), state


@functools.partial(jax.jit, static_argnames="iterations")
def solve(cases, *, iterations):
    """Accelerations [16] in MuJoCo's order and normal forces, from rest."""

    def one(*case):
        problem, state = problem_of(*case)
        rest = contact_solver.Acceleration([jnp.zeros(())] * contact_solver.BASE, [jnp.zeros(4)] * contact_solver.WHEEL)
        found, force = contact_solver.solve_contacts(problem, rest, iterations=iterations)
        return states.flatten(found.base, found.wheel, state), force

    return jax.vmap(one)(*cases)


@pytest.mark.slow  # test_dynamics has the C engine
def test_converges_to_the_c_engine(cases, truth):
    acceleration, force = solve(cases, iterations=4)
    apart, scale = np.abs(np.asarray(acceleration) - truth[0]), np.abs(truth[0]).max(0)
    assert (apart / scale).max() < 1e-3
    np.testing.assert_allclose(force, truth[1], atol=1e-3 * truth[1].max())
    pressed = truth[1][:-4] > 1.0
    assert 0.2 < pressed.mean() < 0.98 and np.abs(force[-4:]).max() < 1e-6  # the last are in the air


@pytest.mark.slow
def test_two_steps_are_enough_for_most(cases, truth):
    """The cost is quadratic while no tyre lifts or lands. So two steps are the minimum but for the few cars whose set of tyres changes."""
    exact = np.abs(truth[0]).max(0)
    off = [(np.abs(np.asarray(solve(cases, iterations=n)[0]) - truth[0]) / exact).max(1) for n in (2, 4)]
    assert 0.8 < np.mean(off[0] < 1e-3) <= np.mean(off[1] < 1e-3) == 1.0


@pytest.mark.slow
def test_forces_never_pull_and_do_what_newton_says(cases):
    """M a = smooth forces + J^T f, in the chassis' rows."""
    acceleration, force = solve(cases, iterations=4)
    assert np.asarray(force).min() >= 0.0

    def residual(*case):
        *case, acceleration, force = case
        problem, state = problem_of(*case)
        base, wheel = states.unflatten(acceleration, state)
        rows = [
            sum(m * a for m, a in zip(problem.base[i], base, strict=True))
            + sum((m * a).sum() for m, a in zip(problem.across[i], wheel, strict=True))
            - problem.force_base[i]
            - (problem.rows.jacobian[i] * force).sum()
            for i in range(contact_solver.BASE)
        ]
        return jnp.stack(rows)

    left = np.asarray(jax.jit(jax.vmap(residual))(*cases, acceleration, force))
    assert np.abs(left).max() < 1e-3 * np.asarray(force).max()


@pytest.mark.slow
def test_gradients_are_finite(cases):
    def total(push):
        return (solve((*cases[:2], push), iterations=1)[0] ** 2).sum()

    assert np.isfinite(jax.jit(jax.grad(total))(cases[2])).all()


def test_inverse_is_one():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    matrix = root @ root.T + 6 * np.eye(6)
    np.testing.assert_allclose(contact_solver.invert_matrix(jnp.asarray(matrix, jnp.float32)) @ matrix, np.eye(6), atol=1e-5)
