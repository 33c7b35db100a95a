"""Past states of road users: which control steps they are of, what a start has, and that an environment keeps them for who reads them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.planning_scenes import state_of, street

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.env import environment, history
from scenefactory_jax.env.history import HistorySpec

pytestmark = pytest.mark.usefixtures("quickly")
BICYCLE = ("dynamics=bicycle_waymax", "actions=acceleration", "step_metrics.kernels=false")


def start(spec):
    return jax.jit(lambda scene, motion: history.start_history(spec, scene, motion, scene.agents, jnp.int32(0), control_dt=1 / 30))


def test_a_row_is_kept_of_every_tenth_of_a_second():
    """At 30 Hz a car at x = step: at step 7 the rows are of the steps 6, 3 and 0."""
    scene, spec = street(boxes=0), HistorySpec(rows=3, stride=3, start_row=0)
    state = state_of(scene)
    kept = start(spec)(scene, state.motion)
    record = jax.jit(functools.partial(history.record, spec))
    assert not kept.valid.any()
    for step in range(7):
        motion = replace(state.motion, position=jnp.full((2, 3), float(step)))
        kept = record(kept, motion, state.active, scene.traffic, jnp.int32(step), jnp.full((2, 3), 0.1 * step))
    np.testing.assert_allclose(kept.action[:, 0, 2], [0.6, 0.3, 0.0])
    np.testing.assert_array_equal(kept.position[:, 0, 0], [6.0, 3.0, 0.0])
    assert kept.valid.all()
    again = history.restart(kept, jnp.array([True, False]))
    assert not again.valid[:, 0].any() and again.valid[:, 1].all()


def test_a_start_has_the_past_of_its_log():
    """The log begins 0.3 s before the start: three of four rows. A car that starts elsewhere has none."""
    scene = scene_of([[3.0, 0.0], [0.0, 9.0]], [[50.0, 0.0]] * 2, steps=8)
    track = jnp.stack([jnp.arange(8.0), jnp.zeros(8)], axis=-1)
    scene = replace(scene, log=replace(scene.log, position=jnp.stack([track, track]), yaw=jnp.ones((2, 8))))
    state = state_of(street(boxes=0))
    motion = replace(state.motion, position=jnp.pad(scene.agents.position, ((0, 0), (0, 1))))
    spec = HistorySpec(rows=4, stride=3, start_row=3)
    kept = start(spec)(scene, motion)
    np.testing.assert_array_equal(kept.valid, [[True, False], [True, False], [True, False], [False, False]])
    np.testing.assert_array_equal(kept.position[:, 0, 0], [2.0, 1.0, 0.0, 3.0])
    np.testing.assert_array_equal(kept.yaw[:, 0], [1.0, 1.0, 1.0, 0.0])


@pytest.mark.slow  # the next but one reads what is kept
def test_an_environment_keeps_what_is_read():
    """A car that accelerates: its ego block holds the places of the last five steps. No row is kept where nothing reads one."""
    scene = scene_of([[0.0, 0.0]], [[50.0, 0.0]], speeds=[5.0])
    env = environment.make_env(load_config("task", *BICYCLE, "timing=waymax", "observations=vmax_road"))
    state, observation = jax.jit(env.reset)(jax.random.key(0), scene)
    assert observation["vmax"].shape == (1, 1655)
    step, places = jax.jit(env.step), [0.0]
    for _ in range(4):
        state, result = step(scene, state, jnp.array([[0.5, 0.0, 0.0]]))
        places.append(float(state.motion.position[0, 0]))
    speed = 5.0 + 3.0 * 0.1 * np.arange(5)
    np.testing.assert_allclose(np.diff(places), speed[:4] * 0.1 + 0.5 * 3.0 * 0.01, atol=1e-5)
    ego = np.asarray(result.observation["vmax"])[0, :40].reshape(5, 8)
    np.testing.assert_allclose(ego[:, 0] * 70, np.array(places) - places[-1], atol=1e-4)
    np.testing.assert_allclose(ego[:, 2] * 30, speed, atol=1e-4)
    assert (ego[:, 7] == 1).all()
    parts = environment.make_parts(load_config("task", *BICYCLE, "timing=waymax"))
    assert parts.history is None


def test_control_steps_must_meet_the_tenths_of_a_second():
    with pytest.raises(ConfigError, match=r"timing.control_hz: expected a multiple of 10"):
        environment.make_parts(load_config("task", *BICYCLE, "observations=vmax_road", "timing.control_hz=25"))


def test_a_car_reads_its_own_last_second():
    """A car that brakes and turns: rows of velocity, its change, the turn and the action that led there; zeros before the start."""
    config = load_config("train", "dynamics=bicycle", "observations=drive_blind", "spawning=logged")
    groups = config["observations"]
    assert groups["weather"] is None and groups["friction_ahead"] is None  # what would tell the friction
    env = environment.make_env({**config, "observations": {"motion": groups["motion"]}})
    scene, action, driven = scene_of([[0.0, 0.0]], [[50.0, 0.0]], speeds=[8.0]), jnp.array([[-1.0, 0.5, 0.6]]), []
    state, observation = jax.jit(env.reset)(jax.random.key(0), scene)
    assert observation["motion"].shape == (1, 93) and not observation["motion"].any()
    step = jax.jit(env.step)
    for _ in range(3):
        driven.append(state)
        state, result = step(scene, state, action)
    last, rows = np.split(np.asarray(result.observation["motion"])[0], [3])
    rows = rows.reshape(10, 9)
    np.testing.assert_allclose(last, state.previous_action[0])
    np.testing.assert_array_equal(rows[:, -1], [1.0] * 3 + [0.0] * 7)
    assert not rows[3:].any() and not rows[2, 5:8].any() and (rows[:2, 7] > 0).all()  # no action led to the start
    speeds, yaws = (np.array([float(get(one)) for one in [*driven, state]]) for get in (read_speed, lambda one: one.motion.yaw[0]))
    np.testing.assert_allclose(rows[:3, 0], speeds[2::-1] * np.cos(read_slip(driven))[::-1] / 10.0, rtol=1e-4)
    np.testing.assert_allclose(rows[:3, 4], np.diff(yaws)[::-1] / 0.1, rtol=1e-3, atol=1e-5)
    assert (rows[:3, 2] < -0.5).all()  # brakes of 60 % slow it by more than 2.5 m/s^2


def read_speed(state):
    return jnp.hypot(*state.motion.velocity[0, :2])


def read_slip(states):
    """The angle between the heading and the velocity."""
    return np.array([float(jnp.arctan2(one.motion.velocity[0, 1], one.motion.velocity[0, 0]) - one.motion.yaw[0]) for one in states])
