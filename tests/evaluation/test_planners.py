"""Trackers, and the planners expert, constant and random."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.planning_scenes import state_of, street

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import AgentLog
from scenefactory_jax.dynamics import bicycle_waymax
from scenefactory_jax.env import observations
from scenefactory_jax.env.environment import make_env
from scenefactory_jax.env.observations.log_view import LoggedState, LogView
from scenefactory_jax.evaluation.planners import expert, tracker
from scenefactory_jax.evaluation.planners.tracker import Tracker
from scenefactory_jax.learning.training_loop import make_policy

pytestmark = pytest.mark.usefixtures("quickly")

ROWS, DT = 91, 0.1
BACKENDS = ("articulated", "bicycle", "bicycle_waymax")


def config_of(*overrides):
    return apply_overrides(load_config("train", "experiment=laptop"), list(overrides))


def tracker_of(name):
    config = config_of("policy=constant", f"dynamics={name}")
    return tracker.select_tracker({key: Tracker(**value) for key, value in config["policy"]["trackers"].items()}, config["dynamics"])


@pytest.fixture(scope="module")
def look():
    """The group `planning`."""
    return jax.jit(observations.make(load_config("task", "observations=planning")["observations"], control_dt=DT)["planning"])


# ---- trackers


@pytest.mark.slow  # tests of planners that track follow their routes
def test_the_bicycles_do_what_the_tracker_asks():
    speed, push, bend = (jnp.array(column) for column in ([3.0, 8.0, 15.0], [1.0, -3.0, 2.0], [0.1, -0.03, 0.01]))
    scene = scene_of([[0, 0], [0, 30], [0, 60]], [[50, 0]] * 3, speeds=speed)
    for name, rear in (("bicycle", 1.3), ("bicycle_waymax", 0.0)):
        config = load_config("task", f"dynamics={name}", "timing=waymax")
        env = make_env({**config, "reward": {}, "observations": {}})
        action = tracker.make_action(push, bend, speed, tracker_of(name))
        state = env.init_state(jax.random.key(0), scene)
        after, _ = jax.jit(env.control_step)(scene, state, jnp.maximum(action, jnp.array([0.0, -1.0, 0.0])))
        along = jnp.linalg.norm(after.motion.velocity[:, :2], axis=1)
        np.testing.assert_allclose((along - speed) / DT, push, atol=0.02)
        mean = 0.5 * (speed + along) * jnp.cos(jnp.arctan(rear * bend))  # of the rear axle
        np.testing.assert_allclose(after.motion.yaw_rate, mean * bend, rtol=0.01)


def test_a_car_that_could_go_backwards_is_braked_to_a_stop_only():
    car = tracker_of("bicycle_waymax")
    action = tracker.make_action(jnp.array([-5.0, -5.0, -5.0]), jnp.zeros(3), jnp.array([0.0, 0.3, 9.0]), car)
    np.testing.assert_allclose(action[:, 0], [0.0, -3.0 / 6.0, -5.0 / 6.0], atol=1e-6)


def test_the_engines_power_limits_the_throttle():
    car = tracker_of("articulated")
    action = tracker.make_action(jnp.array([1.0, 1.0]), jnp.zeros(2), jnp.array([5.0, 40.0]), car)
    np.testing.assert_allclose(action[0, 0], (1.0 + car.rolling_mps2 + car.air_drag_radpm * 25) / car.throttle_mps2, rtol=1e-5)
    np.testing.assert_allclose(action[1, 0], (1.0 + car.rolling_mps2 + car.air_drag_radpm * 1600) / (car.power_m2ps3 / 40), rtol=1e-5)


# ---- expert


def log_of(accelerations, curvatures, *, speed=6.0):
    """A log that Waymax's bicycle drives, of two agents."""
    count = accelerations.shape[1]
    zero = jnp.zeros(count)
    start = jnp.stack([zero, 30.0 * jnp.arange(count)], axis=1)
    body = bicycle_waymax.Body(start, zero, jnp.stack([zero + speed, zero], axis=1), *[zero] * 5)

    def step(body, action):
        new = bicycle_waymax.integrate_acceleration(body, *action, dt=DT)
        return new, new

    bodies = jax.lax.scan(step, body, (accelerations, curvatures))[1]
    join = lambda first, rest: jnp.moveaxis(jnp.concatenate([first[None], rest]), 0, 1)  # noqa: E731
    columns = [join(getattr(body, name), getattr(bodies, name)) for name in ("position", "yaw", "velocity")]
    return AgentLog(*columns, valid=jnp.ones((count, ROWS), bool), dt=jnp.float32(DT))


@pytest.fixture(scope="module")
def logged():
    """Two agents: one turns both ways and slows down, one stands for a while; the log of the second ends after 5 s."""
    time = np.arange(ROWS - 1)[:, None] * DT
    acceleration = np.concatenate([np.sin(time), np.where(time < 2, -3.0, np.where(time < 4, 0.0, 1.5))], axis=1)
    made = log_of(jnp.asarray(acceleration, jnp.float32), jnp.asarray(0.05 * np.cos(0.8 * time + [0.0, 1.0]), jnp.float32))
    made = replace(made, valid=made.valid.at[1, 51:].set(False))
    scene = scene_of(made.position[:, 0], [[500, 0]] * 2, speeds=[6.0, 6.0], steps=ROWS)
    return replace(scene, log=made)


def drive_expert(scene, *overrides, shift=(0.0, 0.0)):
    """Positions of the cars at 81 actions, the start first."""
    words = ["dynamics=bicycle_waymax", "timing=waymax", "actions=acceleration", "termination=goal_only", "observations=log"]
    env, policy = make_env(load_config("task", *words)), make_policy(config_of("dynamics=bicycle_waymax", "policy=expert", *overrides))
    moved = replace(scene, agents=replace(scene.agents, position=scene.agents.position + jnp.array(shift)))

    def step(state, _):
        action = policy.apply({}, env.observe(moved, state))[0]
        return env.step(moved, state, action)[0], (state.motion.position[:, :2], action)

    run = jax.jit(lambda: jax.lax.scan(step, env.init_state(jax.random.key(0), moved), None, length=80)[1])
    return jax.device_get(run())


@pytest.mark.slow  # test_bicycle_waymax has its actions
def test_waymaxs_expert_reproduces_its_log(logged):
    for feedback in ("false", "true"):
        place, action = drive_expert(logged, f"policy.feedback={feedback}")
        np.testing.assert_allclose(place[:, 0], logged.log.position[0, :80], atol=0.02)
        np.testing.assert_allclose(place[:51, 1], logged.log.position[1, :51], atol=0.02)
        np.testing.assert_allclose(place[60:, 1], np.broadcast_to(place[60, 1], (20, 2)), atol=1e-4)  # its log has ended: it stands
        assert np.abs(action).max() <= 1.0


@pytest.mark.slow
def test_feedback_brings_a_car_back_to_its_log(logged):
    place, _ = drive_expert(logged, shift=(0.5, 0.4))
    away = np.linalg.norm(place[:, 0] - logged.log.position[0, :80], axis=1)
    assert away[0] > 0.6 and away[40:].max() < 0.1


def test_the_log_is_seen_from_the_car(logged):
    group = jax.jit(observations.make(load_config("task", "observations=log")["observations"], control_dt=DT)["log"])
    state = state_of(logged, speed=(6.0, 6.0), step=5, past=1)
    view = group(logged, replace(state, motion=replace(state.motion, yaw=jnp.array([np.pi / 2, 0.0], jnp.float32))))
    apart = logged.log.position[0, 5] - logged.agents.position[0]
    np.testing.assert_allclose(view.now.position[0], [apart[1], -apart[0]], atol=1e-5)
    np.testing.assert_allclose(view.next.velocity[1], logged.log.velocity[1, 6], atol=1e-4)
    assert view.valid.all()
    late = group(logged, replace(state, steps_since_spawn=jnp.array([50, 50])))
    np.testing.assert_array_equal(late.valid, [True, False])


def test_the_feedback_points_to_the_log():
    state = lambda x, y: LoggedState(jnp.array([x, y]), jnp.float32(0.0), jnp.array([5.0, 0.0]))  # noqa: E731
    numbers = {"action_s": 0.1, "response_s": 0.5, "length": jnp.float32(4.0)}
    view = LogView(jnp.array([5.0, 0.0]), state(1.0, 0.5), state(1.5, 0.5), jnp.bool_(True))
    push, bend = expert.follow_log(view, **numbers)
    np.testing.assert_allclose([push, bend], [1.0 / 0.5**2, 0.5 / 4.0**2], rtol=1e-5)
    slow = view._replace(velocity=jnp.array([0.1, 0.0]))
    assert expert.follow_log(slow, **numbers)[1] == 0.0 and expert.follow_log(slow, **numbers)[0] > push


# ---- constant, random, and refusals


@pytest.mark.parametrize("name", BACKENDS)
def test_constant_neither_accelerates_nor_steers(name, look):
    car, policy = tracker_of(name), make_policy(config_of("policy=constant", f"dynamics={name}"))
    scene = turned_street()
    action = policy.apply({}, {"planning": look(scene, state_of(scene, speed=(5.0, 8.0)))})[0]
    resistance = (car.rolling_mps2 + car.air_drag_radpm * jnp.array([25.0, 64.0])) / car.throttle_mps2
    np.testing.assert_allclose(action, jnp.stack([resistance, jnp.zeros(2), -jnp.ones(2)], axis=1), atol=1e-6)


def test_random_actions_are_uniform_and_new_at_every_step():
    group = observations.make(load_config("task", "observations=noise")["observations"])["noise"]
    scene, policy = street(), make_policy(config_of("policy=random"))
    state = state_of(scene)
    read = jax.jit(jax.vmap(lambda step: group(scene, replace(state, step=step))))
    seen = read(jnp.arange(300))
    assert np.array_equal(seen[7:9], read(jnp.arange(300) + 7)[:2])
    action = np.asarray(policy.apply({}, {"noise": seen})[0])
    assert action.shape == (300, 2, 3)
    np.testing.assert_allclose([action[..., :2].mean(), action[..., :2].std()], [0.0, 1 / np.sqrt(3)], atol=0.05)
    np.testing.assert_array_equal(action[..., 2], np.where(action[..., 0] < 0, -action[..., 0], -1.0))


def turned_street():
    """The first agent is 10 m along its route, 1 m to the left, across it."""
    scene = street(starts=((10.0, 1.0), (14.0, -2.0)), yaws=(np.pi / 2, 0.0))
    return replace(scene, agents=replace(scene.agents, route_start=jnp.array([10.0, 0.0])))


def test_the_view_shows_lines_users_and_edges_in_the_cars_frame(look):
    scene = turned_street()
    view = jax.tree.map(lambda leaf: np.asarray(leaf[0]), look(scene, state_of(scene, speed=(5.0, 8.0), step=1)))
    here = np.flatnonzero(view.line.arc == 0.0)[0]
    np.testing.assert_allclose(view.line.point[here], [-1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(view.line.point[here + 7], [-1.0, -7.0], atol=1e-5)
    np.testing.assert_allclose(view.line.direction[here], [0.0, -1.0], atol=1e-6)
    assert view.line.known and view.line.limit[here] == 10.0 and view.line.remaining == 90.0
    np.testing.assert_allclose(view.stops.distance, [8.0])  # the light at 20 m, less half a car
    assert view.stops.red.all() and not view.stops.stop_sign.any()
    np.testing.assert_allclose(view.users.position[:2], [[-3.0, -4.0], [4.0, -5.0]], atol=1e-5)  # the other agent, then the box
    np.testing.assert_allclose(view.users.velocity[0], [0.0, -8.0], atol=1e-5)
    assert view.users.present.sum() == 2
    near = view.edges.midpoint[view.edges.present]
    np.testing.assert_allclose(np.unique(np.round(near[:, 0], 3)), [-7.0, 5.0])  # both edges, 6 m to either side of the lane


def test_networks_and_planners_refuse_groups_by_name(look):
    scene = turned_street()
    with pytest.raises(ConfigError, match=r"observations\.planning: expected a vector or a set, got a group for planners"):
        make_policy(load_config("train", "experiment=laptop")).init(jax.random.key(0), {"planning": look(scene, state_of(scene))})
    with pytest.raises(ConfigError, match=r"observations\.plan\._target_: 'plan' is not in .*; valid: .*planning"):
        observations.make({"plan": {"_target_": "plan"}})
    for name, needs in (("expert", "log"), ("constant", "planning"), ("random", "noise")):
        with pytest.raises(ConfigError, match=rf"{name} needs the observation groups of observations={needs}; `{needs}` missing"):
            make_policy(config_of(f"policy={name}")).apply({}, {"ego": jnp.zeros(7)})
