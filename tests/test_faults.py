"""A broken car changes nobody else, and the same seed gives the same bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import scene_of

import scenefactory_jax
from scenefactory_jax import world
from scenefactory_jax.dynamics import car as cars
from scenefactory_jax.struct import replace
from scenefactory_jax.validation import faults

NUMBERS = dict(seed=3, steps=12, fault_step=5, world=0, agent=1, iterations=2)


def config(*overrides):
    return scenefactory_jax.load("task", "observe=small", "ends=invincible", *overrides)


def worlds():
    """Two worlds of four cars: one behind the other, one beside, one far away and never there in the first."""
    starts = np.array([[0.0, 0.0], [6.0, 0.3], [1.0, 3.5], [-30.0, 0.0]])
    scenes = [
        scene_of(starts, starts + [40.0, 0.0], speeds=[9.0, 4.0, 5.0, 6.0], present=[True, True, True, bool(other)]) for other in (0, 1)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


@pytest.fixture(scope="module")
def env():
    return world.make(config())


@pytest.fixture(scope="module")
def report(env):
    return faults.run(env, None, worlds(), **NUMBERS)


def test_addresses(env):
    model_config = config()["dynamics"]
    car, solver = cars.CarParameters(**model_config["car"]), cars.Solver(**model_config["solver"])
    model = cars.standalone(car, solver, physics_dt=1 / 120, visual=False, brake_rows=True)
    np.testing.assert_array_equal(cars.places(model).steer_q, faults.STEERING)


@pytest.mark.parametrize("name", faults.BREAKS)
def test_a_fault_ends_the_car_and_changes_nothing_elsewhere(report, name):
    finding = next(finding for finding in report.faults if finding.name == name)
    assert finding.faults == 1 and finding.ended and not finding.other_faults
    assert finding.beside == () and finding.elsewhere == ()
    assert finding.passed and faults.verdicts(report)[f"fault in {name}"]


def test_the_same_seed_drives_the_same(report):
    assert len(report.driving) > 80 and all(report.driving.values())
