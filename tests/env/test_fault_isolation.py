"""A broken car changes nobody else, and the same seed gives the same bits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of

from experiments.validation import fault_isolation
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.dynamics.articulated import model as models
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.env import environment
from scenefactory_jax.learning.training_loop import make_policy, make_trainer

pytestmark = pytest.mark.usefixtures("quickly")

NUMBERS = dict(seed=3, steps=12, fault_step=5, world=0, agent=1, iterations=2)


def config(*overrides):
    return load_config("task", "observations=small", "termination=goal_only", *overrides)


def worlds():
    """Two worlds of four cars: one behind the other, one beside, one far away and never there in the first."""
    starts = np.array([[0.0, 0.0], [6.0, 0.3], [1.0, 3.5], [-30.0, 0.0]])
    goals, speeds = starts + np.array([40.0, 0.0]), [9.0, 4.0, 5.0, 6.0]
    scenes = [scene_of(starts, goals, speeds=speeds, present=[True, True, True, last]) for last in (False, True)]
    return jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *scenes))


@pytest.fixture(scope="module")
def env():
    return environment.make_env(config())


@pytest.fixture(scope="module")
def report(env):
    return fault_isolation.run(env, None, worlds(), **NUMBERS)


def test_addresses(env):
    model_config = config()["dynamics"]
    car, solver = cars.CarParameters(**model_config["car"]), cars.Solver(**model_config["solver"])
    model = models.build_standalone_model(car, solver, physics_dt=1 / 120, visual=False)
    np.testing.assert_array_equal(models.find_addresses(model).steer_q, fault_isolation.STEERING)


@pytest.mark.slow  # test_dynamics and test_environment have broken cars
@pytest.mark.parametrize("name", fault_isolation.BREAKS)
def test_a_fault_ends_the_car_and_changes_nothing_elsewhere(report, name):
    finding = next(finding for finding in report.faults if finding.name == name)
    assert finding.faults == 1 and finding.ended and not finding.other_faults
    assert finding.beside == () and finding.elsewhere == () and finding.unclean == ()
    assert finding.passed and fault_isolation.verdicts(report)[f"fault in {name}"]


@pytest.mark.slow
def test_the_same_seed_drives_the_same(report):
    assert len(report.driving) > 80 and all(report.driving.values())


@pytest.mark.slow  # tests/learning/test_ppo.py compares one iteration
def test_the_same_seed_learns_the_same():
    """Two PPO iterations at toy size, twice."""
    settings = load_config("train", "experiment=smoke")
    trainer = make_trainer(settings, environment.make_env(settings), make_policy(settings))
    one, again = (fault_isolation.learn(trainer, worlds(), seed, 2) for seed in (5, 5))
    found = fault_isolation.same(one, again)
    assert len(found) > 50 and all(found.values())
    other = fault_isolation.same(one, fault_isolation.learn(trainer, worlds(), 6, 2))
    assert not all(flag for path, flag in other.items() if "parameters" in path)


def test_one_bit_is_a_difference():
    tree = {"a": jnp.array([0.0, 1.0]), "b": jnp.array([jnp.nan]), "key": jax.random.key(1)}
    assert all(fault_isolation.same(tree, dict(tree)).values())
    assert fault_isolation.same(tree, tree | {"a": jnp.array([-0.0, 1.0])}) == {"['a']": False, "['b']": True, "['key']": True}
    assert not fault_isolation.same(tree, tree | {"a": jnp.array([0.0, np.nextafter(np.float32(1), np.float32(2))])})["['a']"]
    assert not fault_isolation.same(tree, tree | {"key": jax.random.key(2)})["['key']"]


class Faults(NamedTuple):
    numerical_error: np.ndarray


class Traces(NamedTuple):
    """As much of a state or of an outcome as a verdict reads, [T, W, A]."""

    active: np.ndarray
    yaw: np.ndarray
    events: Faults


def test_a_fault_that_spreads_is_seen():
    quiet = np.zeros((8, 2, 4), bool)
    broken = quiet.copy()
    broken[3, 0, 1] = True
    away = ~quiet
    away[3:, 0, 1] = False
    yaw = np.zeros((8, 2, 4), np.float32)

    def run(numerical_error=quiet, active=away, yaw=yaw):
        traces = Traces(active, yaw, Faults(numerical_error))
        return traces, traces._replace(active=quiet)

    def judge(hurt):
        found = fault_isolation.judge("qvel", hurt, run(active=~quiet), run(), 3, 0, 1)
        return found._replace(beside=found.beside and found.beside[0], elsewhere=found.elsewhere and found.elsewhere[0])

    def nudged(*where):
        changed = yaw.copy()
        changed[where] = 1e-6
        return run(broken, yaw=changed)

    assert judge(run(broken)).passed
    assert judge(nudged(5, 0, 1)).passed  # the broken car itself may be anything
    assert judge(nudged(5, 0, 2)).beside == "[0].yaw" and not judge(nudged(5, 0, 2)).passed
    assert judge(nudged(5, 1, 2)).elsewhere == "[0].yaw" and not judge(nudged(5, 1, 2)).passed
    foul = yaw.copy()
    foul[5, 0, 1] = np.nan
    assert judge(run(broken, yaw=foul)).unclean == ("[0].yaw", "[1].yaw") and not judge(run(broken, yaw=foul)).passed
    twice = broken.copy()
    twice[6, 0, 1] = True
    assert judge(run(twice)).faults == 2 and not judge(run(twice)).passed
    back = away.copy()
    back[6, 0, 1] = True
    assert not judge(run(broken, active=back)).ended and not judge(run(quiet)).ended
    other = broken.copy()
    other[4, 1, 0] = True
    assert judge(run(other)).other_faults == 1
