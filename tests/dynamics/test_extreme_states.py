"""States that no driver would choose stay bounded, at small size; the whole episode is a slow test. Gradients through the step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.driving import KEY, make
from support.hand_scenes import scene_of

from experiments.validation import extreme_states, robustness_report
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.dynamics.articulated import parameters as cars

pytestmark = pytest.mark.usefixtures("quickly")

BOUNDS = dict(speed_max=80.0, rise_max_m=10.0, sink_max_m=0.5, acceleration_max=2000.0, gain_max=0.02)
SIZES = dict(wall_m=60.0, hold_s=0.2, physics_hz=120.0, control_hz=30.0)


def entry():
    return load_config("task")["dynamics"]


@pytest.fixture(scope="module")
def rows():
    return {row.name: row for row in extreme_states.run(entry(), extreme_states.CASES, seconds=4.0, heap=6, **SIZES, **BOUNDS)}


@pytest.mark.slow  # test_dynamics drives at random to the end of an episode
def test_every_extreme_stays_bounded(rows):
    assert len(rows) == len(extreme_states.CASES) + 1
    assert [row for row in rows.values() if not row.passed] == []


@pytest.mark.slow
def test_extremes_are_extreme(rows):
    """Each case does what its name says, or it would prove nothing."""

    def row(part):
        return next(row for name, row in rows.items() if part in name)

    assert row("friction 1e-3").speed < 2e-3 and row("friction 1e-3").end[0] == pytest.approx(0.0, abs=1e-3)
    assert row("1.5 m onto the wheels").lowest < 0.755 - 0.14  # the bump stops are hit
    assert row("on its roof").height < 0.8 and row("on its roof").end[2] < 0.55
    assert row("high centre of mass").height > 1.2  # rolled over
    assert row("on its side").end[2] == pytest.approx(1.0, abs=0.05)
    assert row("10 km").end[0] > 10010.0
    assert row("backwards at 100").end[0] < -1.0
    assert row("full lock at 40 m/s, friction 1e-3").end_speed > 38.0
    assert 20.0 < row("throttle and brake").end[0] < 30.0  # the brakes are stronger than the engine
    assert row("into a wall").acceleration > 300.0 and row("into a wall").end[0] < 58.0
    assert row("heap").speed > 0.3 and np.hypot(*row("heap").end[:2]) > 1.0  # they part, slowly


@pytest.mark.slow
def test_a_whole_episode_of_every_extreme_stays_bounded():
    rows = extreme_states.run(entry(), extreme_states.CASES, seconds=50.0, heap=16, **SIZES, **BOUNDS)
    assert [row for row in rows if not row.passed] == []
    held = next(row for row in rows if "standing" in row.name)
    assert np.hypot(*held.end[:2]) < 1e-3


def test_energy_is_that_of_a_moving_car():
    car = cars.CarParameters(**entry()["car"])
    qpos, qvel = np.zeros((1, 17)), np.zeros((1, 16))
    qpos[0, 2], qvel[0, 0], qvel[0, [8, 11, 13, 15]] = 0.5, 10.0, 10.0 / 0.35
    wheels = 2 * car.wheel_inertia[0] * (10.0 / 0.35) ** 2
    assert extreme_states.energy(car, qpos, qvel)[0] == pytest.approx(1980.03 * (50.0 + 9.81 * 0.5) + wheels, rel=1e-5)


@functools.cache
def journey():
    """(actions [T, 3]) -> where a car that drives at 8 m/s ends, and its gradient: 10 control steps."""
    dynamics, on = make("articulated"), jnp.array([True])
    scene = scene_of(np.zeros((1, 2)), np.ones((1, 2)), speeds=[8.0])

    def drive(body, actions):
        return jax.lax.scan(lambda body, action: (dynamics.advance(scene, body, action[None], on), None), body, actions)[0]

    begin = jax.jit(drive)(dynamics.init(KEY, scene), jnp.tile(jnp.array([0.3, 0.1, 0.0]), (10, 1)))

    def end(actions):
        return drive(begin, actions).qpos[0, :2] @ jnp.array([1.0, 0.7])

    return jax.jit(end), jax.jit(jax.grad(end))


@pytest.mark.slow
@pytest.mark.parametrize("action", [[0.4, 0.2, -0.3], [-0.2, 0.15, 0.5]])
def test_gradients_agree_with_finite_differences(action):
    """Of a gripping car, driving and braking: reverse mode, through MJX and the solver."""
    end, gradient = journey()
    actions = jnp.tile(jnp.array(action), (10, 1))
    exact = np.asarray(gradient(actions))
    assert np.isfinite(exact).all()
    for step in (0, 4, 8):
        for control in range(3):
            # 0.05 would reach across a kink of the first step's steering, where slopes differ: 0.0736 instead of 0.0861
            numeric = (end(actions.at[step, control].add(0.01)) - end(actions.at[step, control].add(-0.01))) / 0.02
            assert exact[step, control] == pytest.approx(float(numeric), rel=0.05, abs=1e-4), (step, control)


def test_a_car_that_blew_up_is_reported_as_such(tmp_path):
    """As it comes back from JSON, which has no NaN."""
    still = {"name": "standing", "finite": True, "speed": 0.0, "height": 0.755, "lowest": 0.755, "acceleration": 0.0, "spin": 0.0,
             "gain": 0.0, "end": [0.0, 0.0, 0.755], "end_speed": 0.0, "passed": True}  # fmt: skip
    gone = dict.fromkeys(still) | {"name": "on its roof", "finite": False, "gain": 0.0, "passed": False}
    grid = robustness_report.extremes({"seconds": 50.0, "rows": [still, gone]}, tmp_path)[-1]
    assert "| on its roof |" + 7 * " not finite |" + " **no** |" in grid and "| standing | 0.0 | 0.76 |" in grid
