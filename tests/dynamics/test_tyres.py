"""The tyre with state: its stationary curve, relaxation, one circle of friction, load, slopes, and what a parked car does on a grade."""

import dataclasses
import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.driving import CAR, DT, SOLVER, WEIGHT, compiled_car, move, place

from scenefactory_jax.dynamics import mujoco_c, mujoco_car
from scenefactory_jax.dynamics.articulated import actuators, articulated_car, parameters, tyres
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.actuators import Command, PlanarForce

pytestmark = pytest.mark.usefixtures("quickly")

LOAD, COUNT = WEIGHT / 4, 6


@functools.partial(jax.jit, static_argnames=("steps", "car"))
def roll(slip_x, slip_y, rolling, mu, load, *, steps, car=None):
    """Force of a tyre that rolls at `rolling` m/s with a constant slip velocity, after every step."""
    car = jax.tree.map(jnp.float32, CAR if car is None else dataclasses.replace(CAR, **dict(car)))
    limits = tyres.compute_limits(car, mu, load, (slip_x, slip_y), rolling)
    decay = 1.0 / (1.0 + DT * rolling / car.tyre_relaxation_length)

    def step(deflection, _):
        deflection = tyres.advance_deflection(deflection, (slip_x, slip_y), decay, limits, dt=DT)
        return deflection, jnp.stack(tyres.compute_force(deflection, limits)[0])

    zero = jnp.zeros_like(slip_x)
    return jax.lax.scan(step, (zero, zero), None, length=steps)[1]


def magic_formula(slip, mu, load, car=CAR):
    """Force over the normalised slip, with friction that falls beyond the peak, N: written anew."""
    peak = mu * load
    ratio = car.tyre_slip_stiffness * load * slip / peak
    most = car.tyre_shape * np.tan(np.pi / 2 / car.tyre_shape)
    return np.where(ratio < most, np.sin(car.tyre_shape * np.arctan(np.minimum(ratio, most) / car.tyre_shape)), 1.0) * peak, most / ratio


@pytest.mark.parametrize("rolling", [2.0, 20.0])
def test_stationary_force_is_the_magic_formula_of_the_slip(rolling):
    slip, mu = np.linspace(0.005, 0.6, 24), 0.9
    speed = jnp.asarray(slip * rolling, jnp.float32)
    found = roll(0.0 * speed, speed, rolling, mu, LOAD, steps=600)[-1]
    force, inside = magic_formula(slip, mu, LOAD)
    beyond = np.maximum(slip * rolling * (1.0 - inside), 0.0)
    fall = CAR.tyre_sliding_fraction + (1 - CAR.tyre_sliding_fraction) * np.exp(-beyond / CAR.tyre_sliding_speed)
    np.testing.assert_allclose(found[1], -force * fall, rtol=1e-4)
    np.testing.assert_allclose(found[0], 0.0, atol=1e-3)
    assert found[1].min() == pytest.approx(-mu * LOAD, rel=0.01) and (fall.min() < 0.99) == (rolling > 10.0)


@pytest.mark.parametrize("speed", [5.0, 25.0])
def test_force_rises_over_the_relaxation_length(speed):
    """63 % of the stationary force after 0.15 m for small slips, at any speed: 1 - (1 + V dt / L)^-n of implicit steps."""
    force = roll(jnp.float32(0.0), jnp.float32(1e-3 * speed), speed, 1.0, LOAD, steps=300)[:, 1]
    way = speed * DT / CAR.tyre_relaxation_length
    np.testing.assert_allclose(force / force[-1], 1.0 - (1.0 + way) ** -np.arange(1.0, 301.0), atol=2e-3)
    assert force[-1] == pytest.approx(-1e-3 * CAR.tyre_slip_stiffness * LOAD, rel=1e-2)


def test_one_circle_holds_both_directions_and_the_force_opposes_the_slip():
    rng = np.random.default_rng(0)
    x, y = (jnp.asarray(rng.normal(0, 6, 200), jnp.float32) for _ in range(2))
    rolling, mu = jnp.asarray(rng.uniform(0, 30, 200), jnp.float32), jnp.asarray(rng.uniform(0.05, 1.2, 200), jnp.float32)
    force = np.asarray(roll(x, y, rolling, mu, LOAD, steps=200)[-1])
    size, slip = np.linalg.norm(force, axis=0), np.stack([x, y])
    assert (size <= 1.0001 * np.asarray(mu) * LOAD).all() and (size > 0.85 * np.asarray(mu) * LOAD).sum() > 100
    cosine = (force * slip).sum(0) / size / np.linalg.norm(slip, axis=0)
    np.testing.assert_allclose(cosine, -1.0, atol=1e-3)


def test_load_sensitivity_lowers_stiffness_and_peak():
    """At twice the nominal load: 1 - e and 1 - q of what the load alone would give; at the nominal load nothing changes."""
    slip, load = jnp.array([1e-3, 10.0], jnp.float32), jnp.array([[LOAD], [2 * LOAD]], jnp.float32)
    less = (("tyre_peak_fall", 0.1), ("tyre_sliding_fraction", 1.0), ("tyre_stiffness_fall", 0.2))
    plain, sensitive = (
        roll(jnp.zeros((2, 2)), jnp.broadcast_to(slip, (2, 2)), 1.0, 1.0, load, steps=200, car=car)[-1, 1]
        for car in ((("tyre_sliding_fraction", 1.0),), less)
    )
    np.testing.assert_allclose(sensitive / plain, [[1.0, 1.0], [0.8, 0.9]], rtol=2e-3)
    np.testing.assert_allclose(plain[1] / plain[0], 2.0, rtol=1e-3)


def test_slope_of_the_force_is_what_the_wheel_needs():
    """The second output of `compute_force`: -dF_x/dx, never negative."""
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.normal(0, 0.01, 300), jnp.float32).at[:3].set([0.0, 1e-6, 0.05]) for _ in range(2))
    limits = tyres.Limits(jnp.float32(7e5), jnp.float32(4e3), jnp.float32(0.95), jnp.float32(1.35))
    slope = jax.jit(jax.vmap(jax.grad(lambda x, y: -tyres.compute_force((x, y), limits)[0][0])))(x, y)
    found = tyres.compute_force((x, y), limits)[1]
    np.testing.assert_allclose(found[3:], slope[3:], rtol=5e-3, atol=7e2)
    assert (found >= 0.0).all() and found[0] == pytest.approx(0.95 * 7e5)


# ---- the tyres under the car


@pytest.mark.slow  # test_dynamics has cars that stand, test_grades grades
def test_a_parked_car_on_a_grade_stands():
    """60 s under the force of a 10 % grade: along, aside, along on ice, aside on ice, between, and none. In 59 of them less than 1 mm."""
    weight = 0.0995 * WEIGHT
    push = weight * np.array([[1, 0], [0, 1], [1, 0], [0, 1], [0.7, 0.7], [0, 0]])
    mu = [1.0, 1.0, 0.15, 0.15, 0.5, 1.0]
    settled = move(place(COUNT), 120, brake=1.0, push=push, mu=mu)
    after = move(settled, 59 * 120, brake=1.0, push=push, mu=mu)
    moved = np.linalg.norm(after.qpos[:, :2] - settled.qpos[:, :2], axis=1)
    assert moved.max() < 1e-3, moved
    assert np.linalg.norm(settled.qpos[:, :2], axis=1).max() < 0.02 and np.abs(after.qvel).max() < 1e-3
    np.testing.assert_allclose(after.tyres.tangent.sum(1)[:2], weight, rtol=0.02)  # the tyres carry the car


@pytest.mark.slow
def test_a_steeper_grade_than_the_friction_holds_slides():
    after = move(place(COUNT), 240, brake=1.0, push=[0.2 * WEIGHT, 0.0], mu=[0.1, 0.15, 0.3, 0.5, 0.7, 1.0])
    assert (after.qvel[:2, 0] > 0.5).all() and np.abs(after.qvel[2:, 0]).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 0.3, 12.0])
def test_stable_at_any_friction_and_speed(speed):
    """10 s sideways, straight and braked, from no speed to 12 m/s: all ends at rest, without shaking."""
    mu = [1e-3, 0.05, 0.2, 0.5, 0.9, 1.3]
    carry = place(COUNT, speed=speed, aside=0.5 * speed)
    after = move(carry, 1200, brake=[1.0, 0.5, 1.0, 0.5, 1.0, 0.3], mu=mu)
    end = move(after, 1, brake=1.0, mu=mu)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(end))
    assert np.abs(end.qvel[2:]).max() < 1e-3 and np.abs(end.qacc_warmstart[2:]).max() < 0.1
    assert (np.linalg.norm(end.qvel[:, :2], axis=1) <= 1.12 * speed + 1e-3).all()


def slopes_of(advance):
    """Slopes of the sum of squares of `advance`: at rest, sliding, driven, in the air and locked."""
    carry = place(COUNT, speed=jnp.array([0.0, 10.0, 10.0, 0.0, 20.0, 0.0]), aside=jnp.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    carry = carry._replace(qpos=carry.qpos.at[3, 2].add(1.0))
    brake = jnp.array([0.0, 0.0, 3000.0, 0.0, 0.0, 3000.0])[:, None] * jnp.ones(4)
    command = Command(jnp.linspace(-0.2, 0.2, COUNT), jnp.array([0.0, 0.0, 0.0, 0.5, 1.0, 0.0]), brake)

    def total(carry, command, mu):
        return sum((leaf**2).sum() for leaf in jax.tree.leaves(jax.vmap(advance)(carry, command, mu)))

    return jax.jit(jax.grad(total, argnums=(0, 1, 2)))(carry, command, jnp.full((COUNT, 4), 0.7))


@pytest.mark.slow
def test_slopes_of_the_forces_are_finite():
    compiled = compiled_car()

    def forces(carry, command, mu):
        car, state = compiled.constants.car, states.from_mujoco(compiled.constants.car, carry.qpos, carry.qvel)
        patch, drive = tyres.find_contact_patches(car, state), actuators.compute_drive_torque(car, command.throttle, state)
        brake = command.brake_torque + car.rolling_torque
        return tyres.compute_tyre_forces(car, state, patch, carry.tyres, mu, drive, brake, abs_enabled=True, physics_dt=DT)

    carry, command, mu = slopes_of(forces)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((carry, command, mu)))
    assert np.abs(command.throttle[4]) > 0.0 and np.abs(mu[1]).min() > 0.0


@pytest.mark.slow
def test_slopes_of_a_step_are_finite():
    compiled, push = compiled_car(), PlanarForce(jnp.zeros(2), jnp.float32(0.0))
    step = functools.partial(articulated_car.physics_step, compiled, compiled.constants, {})
    slopes = slopes_of(lambda carry, command, mu: step(carry, command, push, mu))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_forces_are_those_of_the_script_for_stock_mujoco():
    """The laws are written twice; the script reads all their numbers from the model."""
    numbers = mujoco_c.make_one(CAR, SOLVER, abs_enabled=True, physics_dt=DT, iterations=1, line_search=1).cars.car
    used = set(re.findall(r"\bcar\.(\w+)", Path(mujoco_car.__file__).read_text()))
    assert used <= set(vars(numbers)) and tuple(wheel[1:] for wheel in mujoco_car.WHEELS) == parameters.WHEELS
    assert numbers.newton_steps == tyres.NEWTON_STEPS and numbers.nominal_load == pytest.approx(WEIGHT / 4)


def tread_length(load):
    """Relaxation length at which the term of the tyres in `check_stability` is `load`, m."""
    height = CAR.wheel_radius - CAR.wheel_height + CAR.mass_height
    mass = 1.0 / (parameters.GRAVITY / WEIGHT + height**2 / CAR.inertia[0])
    return 3.0 * CAR.tyre_slip_stiffness * WEIGHT * DT**2 / mass / load


def test_tyres_that_cannot_be_integrated_are_refused():
    check = lambda load: parameters.check_stability(  # noqa: E731
        dataclasses.replace(CAR, tyre_relaxation_length=tread_length(load)), physics_dt=DT, where="dynamics.car"
    )
    check(3.95)
    with pytest.raises(parameters.ConfigError, match=r"^dynamics\.car: the tyres' slip stiffness over relaxation length .* got 4\.10 at"):
        check(4.1)


@pytest.mark.slow
@pytest.mark.parametrize(("load", "stable"), [(2.5, True), (8.0, False)])
def test_the_bound_of_the_tyres_springs_is_where_cars_begin_to_shake(load, stable, monkeypatch):
    """A standing car that is pushed aside for a moment."""
    monkeypatch.setattr(articulated_car, "check_stability", lambda *_, **__: None)
    car = (("tyre_relaxation_length", tread_length(load)), ("tyre_sliding_fraction", 1.0))
    carry = place(COUNT)
    pushed = move(carry, 30, brake=1.0, push=[0.0, 0.1 * WEIGHT], car=car)
    after = move(pushed, 240, brake=1.0, car=car)
    assert (np.abs(after.qvel).max() < 1e-3) == stable
