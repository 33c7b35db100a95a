"""The solver made for the car's tree, on single steps: against the C engine's converged accelerations, and its laws."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from support.mjx_problem import newton

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.dynamics.articulated import contact_solver, mjx_backend
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")
COUNT = 48
RATIO = 10.0


@pytest.fixture(scope="module")
def model():
    entry = load_config("task", "dynamics=articulated")["dynamics"]
    car = cars.CarParameters(**entry["car"])
    exact = cars.Solver(**{**entry["solver"], "algorithm": "newton", "iterations": 100, "line_search": 50, "tolerance": 1e-12})
    return models.build_standalone_model(car, exact, physics_dt=1 / 120, visual=False, brake_rows=True), car


@pytest.fixture(scope="module")
def cases(model):
    """Cars a little above, in and below their ride height, sliding and braking in all directions, some in the air."""
    model, car = model
    at, rng = models.find_addresses(model), np.random.default_rng(0)
    qpos = np.tile(models.find_rest_pose(model, car), (COUNT, 1))
    qpos[:, 2] += rng.normal(0, 0.01, COUNT)
    qpos[-4:, 2] += 0.5
    qpos[:, at.suspension_q] += rng.normal(0, 0.02, (COUNT, 4))
    qvel = rng.normal(0, 1, (COUNT, 16)) * np.array([8, 3, 0.3, 0.3, 0.3, 0.6] + [1] * 10)
    qvel[:, at.spin_v] = qvel[:, :1] / car.wheel_radius + rng.normal(0, 10, (COUNT, 4))
    mu, push = rng.uniform(0.02, 1.3, (COUNT, 4)), rng.normal(0, 1, (COUNT, 16)) * np.array([2000, 2000, 500, 300, 300, 500] + [100] * 10)
    brake = rng.uniform(0, 1500, (COUNT, 4)) * (rng.random((COUNT, 1)) < 0.6) + cars.MIN_FRICTION_LOSS
    return [jnp.asarray(column, jnp.float32) for column in (qpos, qvel, push, mu, brake)]


@pytest.fixture(scope="module")
def truth(model, cases):
    """Accelerations, and the tyres' contact forces, of the C engine in double precision."""
    model, data, found, forces = model[0], mujoco.MjData(model[0]), [], []
    at = models.find_addresses(model)
    for qpos, qvel, push, mu, brake in zip(*(np.asarray(column, float) for column in cases), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, push
        model.pair_friction[:, :2], model.dof_frictionloss[at.spin_v] = mu[:, None], brake
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
        force = np.zeros((4, 6))
        for row in range(data.ncon):
            wheel = [model.geom(f"tyre_{name}").id for name in cars.WHEELS].index(max(data.contact[row].geom1, data.contact[row].geom2))
            mujoco.mj_contactForce(model, data, row, force[wheel])
        forces.append(force[:, :3])
    return np.array(found), np.array(forces)


@pytest.fixture(scope="module")
def solved(model, cases):
    """`solve.newton` on the rows that MJX makes, and its problem."""
    stages = mjx_backend.put_model(model[0])
    batched, template, at = stages.model, stages.data, stages.addresses

    def one(qpos, qvel, push, mu, brake):
        fields = {"pair_friction": batched.pair_friction.at[:, :2].set(mu[:, None])}
        own = batched.replace(**fields, dof_frictionloss=batched.dof_frictionloss.at[at.spin_v].set(brake))
        data = template.replace(qpos=qpos, qvel=qvel, qfrc_applied=push)
        for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(own, data)
        rows = data._impl
        return rows.M, data.qfrc_smooth, rows.efc_J, rows.efc_aref, rows.efc_D, mu, brake

    problem = jax.jit(jax.vmap(one))(*cases)
    return problem, functools.partial(newton, stages=stages, friction_ratio=RATIO)


@functools.cache
def _converge(solver):
    return jax.jit(jax.vmap(functools.partial(solver, iterations=20, line_search=10)))


def converged(solved):
    problem, solver = solved
    return _converge(solver)(*problem)


def test_places_are_those_of_the_rows(model, solved):
    """Four brakes first, then three rows a tyre."""
    np.testing.assert_array_equal(mjx_backend.put_model(model[0]).rows, 4 + np.arange(12).reshape(4, 3))
    assert solved[0][2].shape == (COUNT, 16, 16)


def test_converges_to_the_c_engine(solved, truth):
    acceleration, force = converged(solved)
    apart = np.abs(np.asarray(acceleration) - truth[0])
    scale = np.abs(truth[0]).max(0)
    assert np.percentile(apart / scale, 95) < 1e-5 and (apart / scale).max() < 2e-3
    np.testing.assert_allclose(force, truth[1], atol=2e-3 * truth[1].max())
    assert (truth[1][:, :, 0] > 1000).any() and np.abs(force[-4:]).max() < 1e-6  # the last are in the air


def test_forces_stay_within_the_cone_and_never_pull(solved, cases):
    _, force = converged(solved)
    normal, tangent = np.asarray(force[..., 0]), np.linalg.norm(force[..., 1:], axis=-1)
    assert normal.min() > -1.0
    # the regularised cone is a little wider: its apex angle is mu, its rows are springs inside
    assert (tangent <= 1.001 * np.asarray(cases[3]) * normal + 1.0).all()


def test_newtons_equation_holds(solved):
    """M a = smooth forces + J^T f, so what the tyres and brakes do is all that is added."""
    problem, _ = solved
    mass, smooth, jacobian = (np.asarray(x, float) for x in problem[:3])
    acceleration, force = converged(solved)
    left = np.einsum("nij,nj->ni", mass, np.asarray(acceleration, float)) - smooth
    tyres = np.einsum("nri,nr->ni", jacobian[:, 4:], np.asarray(force, float).reshape(COUNT, 12))
    brakes = (left - tyres)[:, [8, 11, 13, 15]]
    assert (np.abs(brakes) <= np.asarray(problem[6]) * 1.001 + 2.0).all()
    others = np.delete(left - tyres, [8, 11, 13, 15], axis=1)
    assert np.abs(others).max() < 2e-3 * np.abs(tyres).max()


def test_more_iterations_are_nearer(solved, truth):
    problem, solver = solved
    one, four = (
        np.asarray(jax.jit(jax.vmap(functools.partial(solver, iterations=iterations, line_search=4)))(*problem)[0]) for iterations in (1, 4)
    )
    assert np.median(np.linalg.norm(one - truth[0], axis=1)) > 50 * np.median(np.linalg.norm(four - truth[0], axis=1))


def test_rounding_does_not_move_what_has_converged(solved, truth):
    """At the minimum slopes are noise, and a search that follows them walks away: 40 steps must be as near as 20."""
    problem, solver = solved
    scale = np.abs(truth[0]).max(0)
    long = jax.jit(jax.vmap(functools.partial(solver, iterations=40, line_search=10)))(*problem)[0]
    assert (np.abs(np.asarray(long) - truth[0]) / scale).max() < 2e-3


def test_gradients_are_finite(solved):
    problem, solver = solved

    def total(smooth):
        rest = (*problem[:1], smooth, *problem[2:])
        return (jax.vmap(functools.partial(solver, iterations=4, line_search=4))(*rest)[0] ** 2).sum()

    assert np.isfinite(jax.jit(jax.grad(total))(problem[1])).all()


def test_inverse_is_one():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    matrix = root @ root.T + 6 * np.eye(6)
    np.testing.assert_allclose(contact_solver.invert_matrix(jnp.asarray(matrix, jnp.float32)) @ matrix, np.eye(6), atol=1e-5)
