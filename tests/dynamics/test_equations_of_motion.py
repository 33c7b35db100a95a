"""A car's equations of motion in closed form: against the C engine's and MJX's, number by number, at states near and far from rest."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.compiler import BY_DEFAULT
from support.mjx_problem import columns, random_states, taken_apart
from support.running import quick_compilation
from test_randomization import CAR, SOLVER, random_car

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

COUNT, DT = 60, 1 / 120
STEP = {"friction_ratio": SOLVER.friction_ratio, "physics_dt": DT}
SMOOTH = ("base", "across", "wheel", "force_base", "force_wheel", "brake")  # whether tyres touch or not


@pytest.fixture
def quick():
    """For formulas that are worked out once: no optimisation of programs that MJX makes large."""
    with quick_compilation():
        yield


@pytest.fixture(scope="module")
def model():
    """Compiled with all that MJX's stages need."""
    return models.build_standalone_model(CAR, SOLVER, physics_dt=DT, visual=False, brake_rows=True)


@pytest.fixture(scope="module")
def stages(model):
    return mjx_backend.put_model(model)


@pytest.fixture(scope="module")
def crew():
    """As many cars, no two alike."""
    several = [jax.tree.map(jnp.float32, random_car(seed)) for seed in range(COUNT)]
    return jax.vmap(constants.derive_constants)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *several))


@pytest.fixture(scope="module")
def cases(model):
    rng = np.random.default_rng(1)
    qpos, qvel = random_states(model, CAR, count=COUNT, seed=0)
    mu, friction = rng.uniform(0.02, 1.3, (COUNT, 4)), rng.uniform(0.001, 1500.0, (COUNT, 4))
    command = actuators.Command(rng.uniform(-0.5, 0.5, COUNT), rng.uniform(0.0, 600.0, COUNT), 0.0 * mu)
    push = actuators.PlanarForce(rng.normal(0.0, 2000.0, (COUNT, 2)), rng.normal(0.0, 500.0, COUNT))
    return jax.tree.map(jnp.float32, (qpos, qvel, (command, push, mu), friction))


def step_input(own, qpos, qvel, inputs, friction):
    """The input of a step of one car."""
    (command, push, mu), state = inputs, states.from_mujoco(own.car, qpos, qvel)
    drive = actuators.compute_drive_torque(own.car, command.drive_torque, state.spin)
    forces = actuators.compute_applied_forces(own.car, state, command.steer, drive, push)
    tyre = tyres.TyreInput(mu, tyres.compute_slip_damping(own.car, state))
    return closed_form_step.StepInput(own, state, forces, friction, tyre)


def of_closed_form(own, *case):
    """The problem in closed form, and the rows of which tyres count."""
    inputs = step_input(own, *case)
    patch = tyres.find_contact_patches(own.car, inputs.state)
    return closed_form_step.make_contact_problem(inputs, patch, **STEP), patch.depth > 0.0


def of_mjx(own, *case, stages):
    """MJX's model and data, and the reference with what `tyres.turning` adds."""
    qpos, qvel = case[:2]
    inputs = step_input(own, *case)
    state = inputs.state
    own_model, data = mjx_backend.compute_smooth_dynamics(stages, mjx_backend.fit_model(stages, own), inputs, qpos, qvel)
    away = tyres.compute_jdot_qvel(tyres.find_contact_patches(own.car, state), equations_of_motion.compute_bias_acceleration(state))
    turn = jnp.stack([dot(axis, away) for axis in (state.north, -state.east)], axis=-1)
    return own_model, data, data._impl.efc_aref.at[stages.rows[:, 1:]].add(-turn), inputs


def problem_of_mjx(own, *case, stages):
    _, data, reference, inputs = of_mjx(own, *case, stages=stages)
    rows, rotation = data._impl, jnp.stack([jnp.stack(row) for row in states.rotation_matrix(case[0][3:7])])
    arrays = (rows.M, data.qfrc_smooth, rows.efc_J, reference, rows.efc_D, inputs.tyre.mu, inputs.friction_loss)
    return taken_apart(*arrays, stages=stages, friction_ratio=SOLVER.friction_ratio, rotation=rotation)


def together(field):
    """[count, numbers, 4]"""
    return np.stack([np.broadcast_to(np.asarray(leaf).reshape(COUNT, -1), (COUNT, 4)) for leaf in jax.tree.leaves(field)], axis=1)


def broadcast(field):
    """Numbers of the wheels, all four of them."""
    return [jnp.broadcast_to(leaf, (4,)) for leaf in jax.tree.leaves(field)]


def test_the_problem_is_that_of_mjx_for_cars_that_differ(quick, crew, cases, stages):
    """A force is compared with the largest of its kind: MJX's own rounding is up to 1e-5 of that, see the next test."""
    found, pressed = jax.jit(jax.vmap(of_closed_form))(crew, *cases)
    with jax.default_matmul_precision("highest"):
        wanted = jax.jit(jax.vmap(functools.partial(problem_of_mjx, stages=stages)))(crew, *cases)
    pressed = np.asarray(pressed)[:, None]
    assert 0.1 < pressed.mean() < 0.9
    for name in found._fields:
        left, right = together(getattr(found, name)), together(getattr(wanted, name))
        if name == "tyre":  # MJX takes J out where a tyre is in the air, here it weighs nothing
            left, right = left * pressed, right * pressed
        tolerance = 3e-5 if "force" in name else 5e-6
        np.testing.assert_allclose(left, right, atol=tolerance * np.abs(right).max(), rtol=1e-5, err_msg=name)
    assert not together(found.tyre.weight)[np.broadcast_to(~pressed, (COUNT, 3, 4))].any()


@pytest.mark.parametrize("seed", range(3))
def test_inertia_and_forces_are_the_c_engines(cases, seed):
    """In double precision, of cars that were compiled one by one."""
    car = random_car(seed)
    model = models.build_standalone_model(car, SOLVER, physics_dt=DT, visual=False, brake_rows=True)
    data, full, at = mujoco.MjData(model), np.zeros((16, 16)), columns(mjx_backend.put_model(model))
    own = constants.derive_constants(jax.tree.map(jnp.float32, car))
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
        def value(own, qpos, qvel, command, friction):
            found = problem_of(own, qpos, qvel, command, friction)
            return sum((weigh[name] * leaf / (1 + i)).sum() for name in SMOOTH for i, leaf in enumerate(broadcast(getattr(found, name))))

        return jax.jit(jax.vmap(jax.grad(value, argnums=(0, 2, 3))))

    found = by(lambda *case: of_closed_form(*case)[0])(*few)
    with jax.default_matmul_precision("highest"):
        wanted = by(functools.partial(problem_of_mjx, stages=stages))(*few)
    for (path, left), right in zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-3, atol=3e-4 * np.abs(right).max(), err_msg=jax.tree_util.keystr(path))


def test_the_car_turns_as_the_c_engine_integrates(model, cases):
    qpos, qvel = cases[:2]
    moved, left = jax.vmap(functools.partial(states.integrate, physics_dt=DT))(qpos, qvel, jnp.zeros((COUNT, 16)))
    np.testing.assert_array_equal(left, qvel)
    for i in range(COUNT):
        wanted = np.asarray(qpos[i], float)
        mujoco.mj_integratePos(model, wanted, np.asarray(qvel[i], float), DT)
        np.testing.assert_allclose(moved[i], wanted, atol=2e-6)


def test_a_car_at_rest_has_a_slope_of_its_turning():
    def turned(rate):
        return states.integrate(jnp.zeros(17).at[3].set(1.0), jnp.zeros(16).at[3:6].set(rate), jnp.zeros(16), physics_dt=DT)[0][4:7]

    np.testing.assert_allclose(jax.jacobian(turned)(jnp.zeros(3)), DT / 2 * np.eye(3), rtol=1e-6)


def test_joints_stand_where_the_compiled_model_has_them(model, cases):
    """Numbers by joint to MuJoCo's order and axes and back."""
    at, (qpos, qvel) = models.find_addresses(model), cases[:2]
    one = jax.tree.map(lambda leaf: leaf[0], (qpos, qvel))
    state = states.from_mujoco(CAR, *one)
    for places, number in ((at.suspension_q, state.travel), (at.steer_q, state.steer[:2])):
        np.testing.assert_array_equal(one[0][places], number)
    for places, number in ((at.suspension_v, state.travel_rate), (at.steer_v, state.steer_rate[:2]), (at.spin_v, state.spin)):
        np.testing.assert_array_equal(one[1][places], number)
    np.testing.assert_allclose(states.flatten(*states.unflatten(one[1], state), state), one[1], rtol=1e-5, atol=1e-5)


def test_masses_and_weights_are_the_compiled_models(model):
    own, compiled = constants.derive_constants(jax.tree.map(jnp.float32, CAR)), articulated_car.compile_car(
        CAR, SOLVER, brakes="friction", physics_dt=DT, control_dt=4 * DT
    ).constants  # fmt: skip
    np.testing.assert_allclose(own.spin_weight, compiled.spin_weight, rtol=1e-4)
    np.testing.assert_allclose(own.wheel_weight, compiled.wheel_weight, rtol=1e-4)
    assert equations_of_motion.total_mass(CAR) == pytest.approx(model.body_mass.sum())
    np.testing.assert_allclose(equations_of_motion.compute_loads(CAR).sum(), CAR.mass * 9.81)


@pytest.fixture(scope="module")
def moves(cases):
    """`physics_step` of the reference car with both solvers, converged."""
    command, push, mu = cases[2]
    command = command._replace(brake_torque=cases[3])
    both = []
    for algorithm in ("closed_form", "newton"):
        solver = dataclasses.replace(SOLVER, algorithm=algorithm, iterations=20, line_search=12, tolerance=0.0)
        plant = articulated_car.compile_car(CAR, solver, brakes="friction", physics_dt=DT, control_dt=4 * DT)
        with jax.default_matmul_precision("highest"):
            move = jax.jit(jax.vmap(functools.partial(articulated_car.physics_step, plant, plant.constants, {})))
            both.append(lambda now, move=move: move(now, command, push, mu))
    return both, plant


def at(qpos, qvel):
    return articulated_car.CarCarry(qpos, qvel, jnp.zeros((COUNT, 16)), jnp.ones((COUNT, 4)))


def test_a_step_is_that_of_mjxs_newton(quick, moves, cases):
    """Cars on the road and far from it; a few in ten do not converge in either."""
    (arrow_move, mjx_move), _ = moves
    (one, tyres_one), (other, tyres_other) = (move(at(*cases[:2])) for move in (arrow_move, mjx_move))
    for left, right, near in ((one.qpos, other.qpos, 1e-5), (one.qvel, other.qvel, 2e-3)):
        apart = np.abs(np.asarray(left) - np.asarray(right)).max(1)
        assert np.median(apart) < near and np.percentile(apart, 85) < 10 * near, np.sort(apart)
    for left, right in zip(jax.tree.leaves(tyres_one), jax.tree.leaves(tyres_other), strict=True):
        assert np.median(np.abs(np.asarray(left) - np.asarray(right))) <= 1e-4 * np.abs(right).max()


def test_a_tyre_in_the_air_carries_nothing_however_its_wheel_turns(quick, moves, cases):
    both, plant = moves
    still = np.tile(plant.rest_pose, (COUNT, 1)).astype(np.float32)
    still[:, 2] += 2.0
    for move in both:
        _, after = move(at(jnp.asarray(still), cases[1]))
        assert max(np.abs(part).max() for part in (after.normal, after.tangent, after.slip)) < 1e-3


@pytest.mark.slow  # an experiment; test_contact_solver has the solver by itself
def test_the_solver_converges_where_it_is_compiled_with_its_problem():
    """XLA may work a number out anew in every loop that needs it, rounded differently each time; the solver must stand that.

    Cars that slide, brake and bounce, settled for a few steps: the shipped number of iterations against many more, one program each.
    """
    count, rng = 240, np.random.default_rng(7)
    plants = [
        articulated_car.compile_car(CAR, dataclasses.replace(SOLVER, **more), brakes="friction", physics_dt=DT, control_dt=4 * DT)
        for more in ({}, {"iterations": 20, "line_search": 10})
    ]
    steps = [jax.vmap(functools.partial(articulated_car.physics_step, plant, plant.constants, {})) for plant in plants]
    shipped, patient = jax.jit(steps[0], compiler_options=BY_DEFAULT), jax.jit(steps[1])
    draw = lambda low, high, *shape: jnp.asarray(rng.uniform(low, high, (count, *shape)), jnp.float32)  # noqa: E731
    qpos = jnp.tile(jnp.asarray(plants[0].rest_pose, jnp.float32), (count, 1))
    speed = draw(0.0, 25.0)
    qvel = draw(-0.5, 0.5, 16).at[:, 0].add(speed).at[:, plants[0].addresses.spin_v].add(speed[:, None] / CAR.wheel_radius)
    mu = jnp.broadcast_to(draw(0.05, 1.2, 1), (count, 4))
    drive, brake = CAR.drive_torque * draw(0.0, 1.0), CAR.brake_torque_front * jnp.maximum(draw(-1.0, 1.0, 1), 0.0) * jnp.ones(4)
    command = actuators.Command(CAR.steering_limit * draw(-1.0, 1.0), drive, brake)
    push = actuators.PlanarForce(jnp.zeros((count, 2)), jnp.zeros(count))
    now = articulated_car.CarCarry(qpos, qvel, jnp.zeros((count, 16)), jnp.ones((count, 4)))
    for _ in range(24):
        now, _ = patient(now, command, push, mu)
    found, wanted = (step(now, command, push, mu)[0].qacc_warmstart for step in (shipped, patient))
    apart = np.abs(np.asarray(found - wanted))[:, :6].max(1)
    assert np.median(apart) < 1e-5 and np.percentile(apart, 95) < 1e-3, np.sort(apart)[-24:]  # m/s^2, rad/s^2
