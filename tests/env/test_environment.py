"""Facts, ends, rewards, observations, spawns and the environment, on a stand-in body that moves as it is told."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.gliding import CIRCLES, build_env, drive, jitted
from support.hand_scenes import road_of, scene_of

import scenefactory_jax
from scenefactory_jax.core import geometry
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import make_empty_boxes
from scenefactory_jax.core.types import RewardInput
from scenefactory_jax.env import (
    action_settings,
    actions,
    environment,
    observations,
    rewards,
    rollout,
    spawning,
    step_metrics,
    surrogate_safety,
    traffic,
)
from scenefactory_jax.env.observations.column_bounds import compress_length
from scenefactory_jax.evaluation import episodes
from scenefactory_jax.evaluation.failure_signals import SignalThresholds
from scenefactory_jax.evaluation.route_signals import CourseThresholds
from scenefactory_jax.learning import expert, training_loop
from scenefactory_jax.roadgraph import queries

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def config():
    return scenefactory_jax.load_config("task")


# ---- geometry and conflicts ----


def test_angles_wrap_and_frames_invert():
    angle, vector = np.float32([0.0, 4.0, -4.0, 100.0]), np.float32([[1.0, 2.0]] * 4)
    wrapped = np.asarray(jitted(geometry.wrap_angle)(angle))
    assert np.all(np.abs(wrapped) <= np.float32(np.pi))
    np.testing.assert_allclose(np.cos(wrapped), np.cos(angle), atol=1e-5)
    there_and_back = jax.jit(lambda vector, angle: geometry.to_frame(geometry.rotate(vector, angle), angle))
    np.testing.assert_allclose(there_and_back(vector, angle), vector, atol=1e-5)


def test_norm_has_a_gradient_at_rest():
    assert np.isfinite(jax.jit(jax.grad(lambda v: geometry.safe_norm(v).sum()))(np.zeros((2, 2), np.float32))).all()


def test_car_circles_are_the_published_ones():
    cover = jax.jit(functools.partial(geometry.cover_with_circles, **CIRCLES))
    centres, radius = cover(*map(np.float32, ([[0.0, 0.0]], [0.0], [[4.0, 2.0]])))
    centres = np.asarray(centres)
    np.testing.assert_allclose(radius, [1.1], rtol=1e-6)
    np.testing.assert_allclose(centres[0, :, 0], [1.12, 0, -1.12], atol=1e-6)


def brute_force_ttc(centres, radius, velocity, yaw, dt=0.002, until=12.0):
    count = len(radius)
    found = np.full((count, count), np.inf)
    for i in range(count):
        forward = np.array([np.cos(yaw[i]), np.sin(yaw[i])])
        for j in range(count):
            if i == j:
                continue
            pairs = [(a, b) for a in range(3) for b in range(3) if (centres[j, b] - centres[i, a]) @ forward > 0]
            for t in np.arange(0, until, dt):
                apart = [np.linalg.norm(centres[j, b] - centres[i, a] + (velocity[j] - velocity[i]) * t) for a, b in pairs]
                if apart and min(apart) <= radius[i] + radius[j]:
                    found[i, j] = t
                    break
    return found


@jax.jit  # a conflict is seventy operations, each of which would be compiled by itself
def compare_cars(position, yaw, velocity):
    """Circles of cars of 4 x 2 m, their radius, and the surrogates of every pair."""
    position, yaw, velocity = (jnp.asarray(table, jnp.float32) for table in (position, yaw, velocity))
    circles = geometry.cover_with_circles(position, yaw, jnp.tile(jnp.array([4.0, 2.0]), (len(yaw), 1)), **CIRCLES)
    return *circles, surrogate_safety.compare_pairs(*circles, velocity, yaw, drac_gap_floor_m=1.0)


def test_ttc_equals_a_simulated_one():
    rng = np.random.default_rng(0)
    position, yaw = rng.uniform(-12, 12, (5, 2)), rng.uniform(-3, 3, 5)
    velocity = rng.uniform(2, 8, (5, 1)) * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    centres, radius, (ttc, drac, *_) = compare_cars(position, yaw, velocity)
    ttc = np.where(np.asarray(ttc) < 12, np.asarray(ttc), np.inf)
    expected = brute_force_ttc(np.asarray(centres, float), np.asarray(radius, float), velocity, yaw, dt=0.01)
    assert np.isfinite(expected).sum() >= 2, "the draw has no conflict to compare"
    np.testing.assert_allclose(ttc, expected, atol=0.02)
    assert np.all(np.diag(drac) == 0) and np.all(np.asarray(drac) >= 0)


def test_head_on_ttc_and_drac_by_hand():
    places, yaw, velocity = np.array([[0.0, 0], [20.0, 0]]), np.array([0.0, np.pi]), np.array([[5.0, 0], [-5.0, 0]])
    ttc, drac, away, ahead = compare_cars(places, yaw, velocity)[2]
    gap = 20 - 2 * 1.12 - 2 * 1.1
    for distances in (away, ahead):
        np.testing.assert_allclose(distances, [[np.inf, gap], [gap, np.inf]], rtol=1e-5)
    np.testing.assert_allclose(ttc[0, 1], gap / 10, rtol=1e-5)
    np.testing.assert_allclose(drac[0, 1], 100 / (2 * gap), rtol=1e-5)


def test_parting_cars_never_meet():
    places, velocity = np.array([[0.0, 0], [20.0, 0]]), np.array([[5.0, 0], [6.0, 0]])
    assert np.isinf(compare_cars(places, np.zeros(2), velocity)[2].ttc).all()


def test_the_way_ahead_ends_where_circles_touch_and_is_free_beside_them():
    """Followers 10 m behind, 1.5 m to the side; the third car is 2.3 m beside the first, just out of its way."""
    place = np.array([[0.0, 0], [10.0, 1.5], [10.0, -2.3]])
    ahead = compare_cars(place, np.zeros(3), np.zeros((3, 2)))[2].ahead
    free = 10 - 2 * 1.12 - np.sqrt(2.2**2 - 1.5**2)
    np.testing.assert_allclose(ahead, [[np.inf, free, np.inf], [np.inf] * 3, [np.inf] * 3], rtol=1e-5)


def test_first_hits_keeps_storage_order():
    rng = np.random.default_rng(1)
    hits = rng.random((7, 90)) < 0.2
    index, mask = jax.jit(functools.partial(queries.find_first_true, count=12))(hits)
    index, mask = np.asarray(index), np.asarray(mask)
    for row in range(7):
        expected = np.flatnonzero(hits[row])[:12]
        assert list(index[row][mask[row]]) == list(expected)


# ---- the environment ----


@pytest.fixture(scope="module")
def env(config):
    return build_env(config)


@pytest.fixture(scope="module")
def two_cars():
    return scene_of([[0, 0], [30, 0.5]], [[20, 0], [60, 0.5]], speeds=[6.0, 0.0])


def test_reset_is_pure_and_shapes_are_the_published_ones(env, two_cars, config):
    state, observation = env.reset(jax.random.key(0), two_cars)
    again, _ = env.reset(jax.random.key(0), two_cars)
    data = lambda leaf: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf  # noqa: E731
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(data(a), data(b))
    assert observation["ego"].shape == (2, 7) and observation["weather"].shape == (2, 4)
    assert observation["road"].features.shape == (2, 40, 5) and observation["neighbours"].features.shape == (2, 24, 7)
    np.testing.assert_allclose(observation["ego"][0], [0.2, 0, 0, 1, 0.2, 0.6, 0], atol=1e-6)
    np.testing.assert_allclose(observation["neighbours"].features[0, 0, :4], [0.3, 0.005, 0.04, 0.02], atol=1e-6)
    assert config["observations"]["road"]["count"] == 350


def test_road_observation_is_a_scan_of_the_storage(env, two_cars):
    _, observation = env.reset(jax.random.key(0), two_cars)
    rows = jax.tree.map(np.asarray, observation["road"])
    points = np.asarray(two_cars.road.midpoint)
    near = [i for i in range(len(points)) if np.hypot(*(points[i] - [0, 0])) <= 10][:40]
    np.testing.assert_allclose(rows.features[0, : len(near), :2] * 10, points[near], atol=1e-5)
    assert rows.mask[0].sum() == len(near)


def test_encounters_by_hand_and_from_any_frame(env):
    """Head on, 1 m beside each other: centres are closest in 2 s, circles of the fronts meet before; a third car is far behind."""
    numbers = scenefactory_jax.load_config("task", "observations=encounters")["observations"]["neighbours"] | {"body_gap_scale_m": 0.5}
    del numbers["_target_"]

    def observed(turn, shift):
        place = jitted(geometry.rotate)(jnp.array([[0.0, 0], [20, 1], [-180, 0]]), jnp.float32(turn)) + np.float32(shift)
        yaw = np.array([0, np.pi, 0]) + turn
        scene = scene_of(place, place + 50.0, yaws=yaw, speeds=[5.0, 5.0, 0.0])
        state, _ = env.reset(jax.random.key(0), scene)
        state = replace(state, motion=replace(state.motion, yaw_rate=jnp.array([0.1, 0.3, 0.0])))
        return jax.tree.map(np.asarray, jax.jit(functools.partial(observations.closest_approach, **numbers))(scene, state))

    rows = observed(0.0, [0.0, 0.0])
    squash = lambda length, scale: length / (scale + abs(length))  # noqa: E731
    meet = (20 - 2 * 1.12 - np.sqrt(2.2**2 - 1)) / 10
    gap = np.hypot(20 - 2.24, 1.0) - 2.2
    expected = [squash(20, 20), squash(1, 20), -1.0, 0.0, 0.0, -1.0, 0.3, 0.8, 0.4, squash(gap, 2), 2 / 5, squash(1, 2), 5 / (5 + meet)]
    bodies = [squash(20 - 4, 0.5), 1.0, 0.0, 1.0]  # of 4 x 2 m, side by side by half: straight ahead, at 10 m/s
    np.testing.assert_allclose(rows.features[0, 0], [*expected, *bodies], atol=1e-4)
    np.testing.assert_allclose(rows.features[0, 1, :4], [-0.9, 0, -0.5, 0], atol=1e-4)
    assert rows.features.shape == (3, 16, 17) and rows.mask.sum(axis=1).tolist() == [2, 2, 2] and not rows.features[0, 2:].any()
    moved = observed(0.9, [7.0, -3.0])
    np.testing.assert_allclose(moved.features, rows.features, atol=1e-3)


def test_one_pedal_brakes_below_zero():
    asked = np.float32([[0.6, -0.2, -1.0], [-0.3, 0.1, -1.0], [-0.3, 0.0, 0.7], [0.5, 1.0, 0.4], [-1.0, 0.0, 0.0]])
    wanted = [[0.6, -0.2, -0.6], [0.0, 0.1, 0.3], [0.0, 0.0, 0.7], [0.5, 1.0, 0.4], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(jitted(actions.one_pedal)(asked), wanted, rtol=1e-6)


def test_pedals_below_zero_are_released_or_reverse():
    asked = np.float32([[0.6, -0.2, -1.0], [-0.3, 0.1, 0.7]])
    np.testing.assert_array_equal(jitted(actions.separate_pedals)(asked), np.float32([[0.6, -0.2, 0.0], [0.0, 0.1, 0.7]]))
    np.testing.assert_array_equal(jitted(actions.pedals_with_reverse)(asked), np.float32([[0.6, -0.2, 0.0], [-0.3, 0.1, 0.7]]))


def test_controls_are_what_dynamics_and_rewards_are_given(config):
    """Off the throttle a bicycle rolls on; with one pedal it brakes."""
    own = scenefactory_jax.load_config("task", "dynamics=bicycle", "spawning=logged", "observations.road=null")
    scene = scene_of([[0.0, 0.0]], [[90.0, 0.0]], speeds=[10.0])

    def speed_after(entry):
        env = environment.make_env({**own, "actions": {"command": entry, "action_repeat": 1}})
        state, _ = jax.jit(env.reset)(jax.random.key(0), scene)
        state, _ = jitted(env.step)(scene, state, jnp.array([[-0.5, 0.0, -1.0]]))
        return np.linalg.norm(state.motion.velocity[0]), np.asarray(state.previous_action)[0]

    rolled, braked = speed_after({"_target_": "separate_pedals"}), speed_after({"_target_": "one_pedal"})
    assert rolled[0] == pytest.approx(10.0, abs=0.01) and braked[0] < 9.95
    np.testing.assert_allclose(braked[1], [0, 0, 0.5])


def test_an_action_stands_until_the_next_is_read(config):
    """Every third is read, the first one first; who begins anew in between waits with free pedals."""
    env = build_env(config, hold=3)
    scene = scene_of([[0.0, 0.0]], [[90.0, 0.0]])
    state, _ = env.reset(jax.random.key(0), scene)
    step, taken = jitted(env.control_step), []
    for throttle in range(7):
        state, _ = step(scene, state, jnp.array([[0.1 * throttle, 0.0, 0.0]]))
        taken.append(np.asarray(state.previous_action)[0, 0])
    np.testing.assert_allclose(taken, [0, 0, 0, 0.3, 0.3, 0.3, 0.6], atol=1e-6)
    for every, message in (
        (7, "actions.action_repeat: expected a divisor of the 1500 control steps of an episode, got 7"),
        (0, "actions.action_repeat: expected an integer >= 1, got 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            environment.make_env({**config, "actions": {**config["actions"], "action_repeat": every}})


@pytest.mark.slow
def test_a_step_is_an_action_with_all_its_control_steps(config):
    """The first car passes its goal in the second of three control steps: it has part in two of them."""
    env = build_env(config, hold=3)
    scene = scene_of([[0.0, 0.0], [0.0, 9.0]], [[3.4, 0.0], [90.0, 9.0]], speeds=[10.0, 10.0])
    state, _ = env.reset(jax.random.key(0), scene)
    action = jnp.array([[0.5, 0.0, 0.0]] * 2)
    after, outcome = jitted(env.step)(scene, state, action)
    control, paid, progress, reached = jitted(env.control_step), np.zeros(2), np.zeros(2), []
    for _ in range(3):
        driving = np.asarray(state.active)
        state, single = control(scene, state, action)
        paid += np.where(driving, single.reward, 0.0)
        progress = np.where(driving, single.metrics.progress, progress)
        reached.append(bool(single.events.goal_reached[0]))
    assert reached == [False, True, False]
    np.testing.assert_allclose(outcome.reward, paid, rtol=1e-6)
    np.testing.assert_allclose(sum(outcome.terms.values()), paid, rtol=1e-5)
    assert outcome.events.goal_reached.tolist() == outcome.terminated.tolist() == [True, False] and not outcome.world_done
    jax.tree.map(np.testing.assert_array_equal, after.motion, state.motion)
    assert int(after.step) == 3 and single.metrics.progress[0] != progress[0]
    np.testing.assert_allclose(outcome.metrics.progress, progress, rtol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, outcome.observation, env.observe(scene, state))


@pytest.mark.slow
def test_a_car_that_ends_within_an_action_starts_again_at_its_end(config):
    """The action takes the car to its goal in the first of two control steps, 10.5 / 30 m on; it stays there in the second."""
    env = build_env(config, hold=2, respawn=10.0)
    scene = scene_of([[0.0, 0.0]], [[3.345, 0.0]], speeds=[10.0])
    state, _ = env.reset(jax.random.key(0), scene)
    after, outcome = jitted(env.step)(scene, state, jnp.array([[0.5, 0.0, 0.0]]))
    assert outcome.terminated.tolist() == outcome.events.goal_reached.tolist() == after.active.tolist() == [True]
    assert after.steps_since_spawn.tolist() == [0] and not after.motion.position[0, :2].any()
    assert float(outcome.terms["goal"][0]) == 45.0 and float(outcome.terms["progress"][0]) == pytest.approx(2 * 10.5 / 30, abs=1e-5)
    assert not after.previous_action.any() and float(after.motion.velocity[0, 0]) == 10.0


def test_a_car_knows_how_it_turns(env):
    scene = scene_of([[0.0, 0], [0, 9]], [[50.0, 0]] * 2)
    state, _ = env.reset(jax.random.key(0), scene)
    state = replace(state, motion=replace(state.motion, yaw_rate=jnp.array([0.4, -1.0]), steer=jnp.array([-0.1, 0.2])))
    observed = jax.jit(functools.partial(observations.yaw_rate_and_steer, turn_scale_radps=2.0, steer_scale_rad=0.5))(scene, state)
    np.testing.assert_allclose(observed, [[0.2, -0.2], [-0.5, 0.4]], rtol=1e-6)


def test_the_lane_ahead_by_hand(env):
    """With the lane and 1 m left of it, against it, and 12 m before its end at x = 60, where the places stay."""
    numbers = scenefactory_jax.load_config("task", "observations=lane_preview")["observations"]["lane"]
    del numbers["_target_"]
    yaws = [0.1, np.pi, 0.0]
    scene = scene_of([[0.2, 1.0], [0.0, -2.0], [48.0, 0.0]], [[9, 9]] * 3, yaws=yaws, speeds=[0.0, 0, 5])
    state, _ = env.reset(jax.random.key(0), scene)
    observed = np.asarray(jax.jit(functools.partial(observations.lane, **numbers))(scene, state))
    squash = lambda length, scale: length / (scale + np.abs(length))  # noqa: E731
    assert observed.shape == (3, 15)
    np.testing.assert_allclose(observed[0, :3], [squash(1.0, 2), np.sin(0.1), np.cos(0.1)], atol=1e-4)
    np.testing.assert_allclose(observed[1, :3], [squash(-2.0, 2), 0, -1], atol=1e-4)
    gap = 6 - 0.05 - 2.0 - 1.1
    np.testing.assert_allclose(observed[1, 3:5], [squash(gap, 2), 0], atol=1e-3)
    ahead = np.array([5.0, 10, 20, 30, 45])
    places = np.stack([ahead, np.full(5, -1.0)], 1) @ np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    np.testing.assert_allclose(observed[0, 5:].reshape(5, 2), squash(places, 20), atol=1e-4)
    np.testing.assert_allclose(observed[1, 5:].reshape(5, 2), squash(np.stack([ahead, np.full(5, -2.0)], 1), 20), atol=1e-4)
    np.testing.assert_allclose(observed[2, 5:].reshape(5, 2)[:, 0], squash(np.array([5.0, 10, 10, 10, 10]), 20), atol=1e-4)


@pytest.mark.slow
def test_without_road_edges_every_observation_is_finite():
    """The nearest edge is then infinitely far, and as far as it can read."""
    numbers = scenefactory_jax.load_config("task", "observations=lane_preview", "dynamics=bicycle")
    scene = scene_of([[0.0, 1.0], [9.0, 0.0]], [[50.0, 0]] * 2)
    scene = replace(scene, edges=replace(scene.edges, valid=jnp.zeros_like(scene.edges.valid)))
    _, observed = jax.jit(environment.make_env(numbers).reset)(jax.random.key(0), scene)
    assert set(observed) > {"lane", "neighbours"} and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(observed))
    np.testing.assert_allclose(observed["lane"][:, 3:5], [[1.0, 0.0]] * 2)
    slope = jax.jit(jax.grad(lambda length: compress_length(length, 2.0).sum()))(np.float32([np.inf, 1.0]))
    np.testing.assert_allclose(slope, [0.0, 2 / 9], rtol=1e-6)


def test_an_episode_may_begin_at_a_later_moment(config):
    """Starts are drawn beside the others as they are then, and it has rained until then."""
    one = jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape[1:]), leaf.dtype), make_empty_boxes())
    moving = lambda scene, step: replace(one, position=jnp.array([[1.0, 0.0]]) * step)  # noqa: E731
    beside = lambda key, scene: replace(scene.agents, goal=jnp.broadcast_to(scene.traffic.position[:1], scene.agents.goal.shape))  # noqa: E731
    env, scene = build_env(config, draw=beside, beside=traffic.log_playback.make_stateless(moving)), scene_of([[0.0, 0.0]], [[90.0, 0.0]])
    late = env.init_state(jax.random.key(0), scene, 60)
    assert int(late.step) == 60 and float(late.weather.rain.now_s) == pytest.approx(2.0) and float(late.agents.goal[0, 0]) == 60.0
    assert float(env.init_state(jax.random.key(0), scene).agents.goal[0, 0]) == 0.0


def test_goal_ends_a_car_once_and_pays_once(env, two_cars):
    state, history = drive(env, two_cars, jnp.zeros((2, 3)), 110)
    goals = np.array([h.terms["goal"][0] for h in history])
    assert goals.sum() == 45.0 and np.count_nonzero(goals) == 1
    when = int(np.argmax(goals))
    assert history[when].terminated[0] and abs(when / 30 - 17 / 6) < 0.05  # 20 m - 3 m at 6 m/s
    assert state.active.tolist() == [False, True]
    assert all(h.reward[0] == 0 for h in history[when + 1 :]), "a finished car earns nothing"
    assert not history[-1].observation["neighbours"].mask[1].any(), "a finished car is not seen"
    assert not any(leaf[0].any() for leaf in jax.tree.leaves(history[-1].observation)), "and sees nothing"
    assert all(np.abs(h.reward - sum(h.terms.values())).max() < 1e-5 for h in history)


def test_progress_sums_to_the_way_driven(env, two_cars):
    _, history = drive(env, two_cars, jnp.zeros((2, 3)), 60)
    np.testing.assert_allclose(sum(float(h.metrics.progress[0]) for h in history), 60 * 6 / 30, rtol=1e-4)


def test_collision_needs_force_and_grace(env, two_cars):
    action = jnp.array([[0.0, 0, 0], [0.0, 0, 1.0]])
    _, history = drive(env, two_cars, action, 30)
    collision = [bool(h.events.collision[1]) for h in history]
    assert collision.index(True) == 23, "the first 23 control steps are masked"
    assert sum(collision) == 1


@pytest.mark.slow  # test_rewards and test_planning_rewards have terms by hand
def test_terms_beyond_the_published_ones_by_hand(env):
    """Two cars side by side, one of them against its lane, 1.4 m and 0.85 m from the edges at +-6 m; the third is alone."""
    goals = [[50, 3.5], [50, -4.0], [90, 0], [90, 0]]
    scene = scene_of([[0, 3.5], [0, -4.0], [60, 0], [66, 0]], goals, yaws=[np.pi, 0.0, 0.0, 0.0], speeds=[0.0, 0, 3, 3])
    state, (outcome,) = drive(env, scene, jnp.zeros((4, 3)), 1)
    metrics, events = jax.device_put((outcome.metrics, outcome.events))
    step = RewardInput(scene=scene, before=state, action=jnp.zeros((4, 3)), after=state, metrics=metrics, events=events)
    paid = lambda term, step, **limits: jax.jit(functools.partial(term, **limits))(step)  # noqa: E731
    beside, behind = 7.5 - 2.2, 6.0 - 2.24 - 2.2
    np.testing.assert_allclose(metrics.clearance, [beside, beside, behind, behind], rtol=1e-4)
    np.testing.assert_allclose(metrics.lane_heading, [-1, 1, 1, 1], atol=1e-5)
    stop = np.asarray(metrics.speed[2]) ** 2 / (2 * 9.81 * np.asarray(metrics.mu[2]))
    np.testing.assert_allclose(metrics.stopping_margin, [np.inf, np.inf, behind - stop, np.inf], rtol=1e-4)
    edge = np.asarray(metrics.edge_clearance)
    np.testing.assert_allclose(edge[:2], [6 - 0.05 - 3.5 - 1.1, 6 - 0.05 - 4.0 - 1.1], atol=0.02)
    np.testing.assert_allclose(paid(rewards.low_clearance, step, limit_m=2.0), [0, 0, 1 - behind / 2, 1 - behind / 2], atol=1e-4)
    np.testing.assert_allclose(paid(rewards.edge_clearance, step, limit_m=1.0), np.clip(1 - edge, 0, 1), atol=1e-5)
    np.testing.assert_allclose(paid(rewards.wrong_way, step), [1, 0, 0, 0], atol=1e-5)
    late = replace(step, metrics=replace(metrics, stopping_margin=jnp.array([jnp.inf, 2.0, -1.0, -9.0])))
    np.testing.assert_allclose(paid(rewards.stopping, late, limit_m=4.0), [0, 0, 0.25, 1], atol=1e-6)
    before = replace(state, previous_action=jnp.tile(jnp.array([0.5, -0.4, 0.0]), (4, 1)))
    turned = replace(step, before=before, action=jnp.array([[0.5, -0.4, 0.0], [-0.5, -0.4, 0.5], [0.5, 0.6, 0.0], [-0.5, 0.6, 0.5]]))
    np.testing.assert_allclose(paid(rewards.steer_rate, turned), [0, 0, 1, 1], atol=1e-6)
    np.testing.assert_allclose(paid(rewards.action_rate, turned), [0, 1.25, 1, 2.25], atol=1e-6)


def test_nan_becomes_a_fault_and_stays_alone(env, two_cars):
    action = jnp.array([[1.0, 0, 0], [0.0, 0, 0]])
    state, history = drive(env, two_cars, action, 2)
    assert history[0].events.numerical_error[0] and not history[0].events.numerical_error[1]
    for leaf in jax.tree.leaves((state.motion, state.body, history[0].reward, history[0].observation, history[1].observation)):
        assert np.isfinite(leaf).all()
    assert state.active.tolist() == [False, True]


def test_what_a_broken_car_last_read_is_no_measurement(env, two_cars):
    """It breaks in the first step: nothing is known of it but its start. Nor is a speed a number whose square is none."""
    failures = scenefactory_jax.load_config("evaluate", "run=town")["failures"]
    limits = {"thresholds": SignalThresholds(**failures["signals"]), "course": CourseThresholds(**failures["course"])}
    broken = lambda parameters, observation, key: jnp.array([[1.0, 0, 0], [0.0, 0, 0]])  # noqa: E731
    state = env.init_state(jax.random.key(0), two_cars)
    start = jax.jit(lambda state: rollout.start_rollout(state, episodes.make_metrics(state)))(state)
    hook = episodes.make_hook(env, ttc_limit_s=10.0, control_dt=1 / 30, **limits)
    roll = jax.jit(lambda start: rollout.rollout(env, broken, None, two_cars, start, jax.random.key(0), steps=2, hook=hook)[0])
    end = roll(start)
    metrics = end.carry
    assert metrics.past_events.numerical_error.tolist() == [True, False] and metrics.steps.tolist() == [0, 2]
    assert float(metrics.goal_distance[0]) == float(start.carry.goal_distance[0]) and not metrics.sums["speed"].any()
    motion = replace(state.motion, velocity=jnp.array([[1e20, 0, 0], [1.0, 0, 0]]))
    assert jitted(step_metrics.is_finite)(motion).tolist() == [False, True]


@pytest.mark.slow
def test_edges_are_touched_by_circles(env):
    scene = scene_of([[0, 4.6]], [[50, 0]], yaws=[np.pi / 2], speeds=[3.0])
    _, history = drive(env, scene, jnp.zeros((1, 3)), 3)
    # front circle: 4.6 + 1.12 + 1.10 reaches the edge at 6 - 0.05 already in the first step
    assert history[0].events.road_edge_contact[0]
    assert history[0].metrics.edge_clearance[0] < 0


def test_leaving_the_box_is_a_crash(env):
    scene = scene_of([[95, 0]], [[0, 50]], speeds=[6.0], half_width=60)
    _, history = drive(env, scene, jnp.zeros((1, 3)), 30)
    out_of_bounds = [bool(h.events.out_of_bounds[0]) for h in history]
    assert out_of_bounds.index(True) == 25, "x > 100 m after 26 steps of 0.2 m"


@pytest.mark.slow
def test_invincible_cars_drive_on(config):
    env = build_env(config, ending=["numerical_error", "goal_reached"])
    scene = scene_of([[0, 5.4]], [[50, 5.4]], speeds=[5.0])
    state, history = drive(env, scene, jnp.zeros((1, 3)), 20)
    assert sum(bool(h.events.road_edge_contact[0]) for h in history) == 1, "noted once"
    assert state.active[0]


def test_time_out_and_over(config):
    env = build_env(config, steps=5)
    scene = scene_of([[0, 0]], [[50, 0]])
    _, history = drive(env, scene, jnp.zeros((1, 3)), 5)
    assert [bool(h.truncated) for h in history] == [False] * 4 + [True]
    assert bool(history[-1].world_done)


def test_absent_agents_change_nothing(env):
    alone = scene_of([[0, 0], [30, 0.5]], [[20, 0], [60, 0.5]], speeds=[6, 0], present=[True, False])
    moved = scene_of([[0, 0], [3, 0.5]], [[20, 0], [60, 0.5]], speeds=[6, 9], present=[True, False])
    _, a = drive(env, alone, jnp.zeros((2, 3)), 3)
    _, b = drive(env, moved, jnp.zeros((2, 3)), 3)
    for x, y in zip(jax.tree.leaves(a[-1].observation), jax.tree.leaves(b[-1].observation), strict=True):
        np.testing.assert_array_equal(x[0], y[0])
        assert not np.any(np.asarray(x[1])), "an absent car sees nothing"
    np.testing.assert_array_equal(a[-1].reward, b[-1].reward)


def test_se2_equivariance(env, two_cars):
    """Turning and moving the whole world changes no reward and no observation."""

    @jax.jit
    def move(scene, angle, shift):
        turn = lambda p: geometry.rotate(p, angle) + shift  # noqa: E731
        road = lambda r: replace(r, midpoint=turn(r.midpoint), direction=geometry.rotate(r.direction, angle))  # noqa: E731
        cars = scene.agents
        agents = replace(cars, position=turn(cars.position), goal=turn(cars.goal), yaw=cars.yaw + angle)
        return replace(scene, road=road(scene.road), lanes=road(scene.lanes), edges=road(scene.edges), agents=agents)

    moved = move(two_cars, 0.7, np.float32([11.0, -5.0]))
    _, a = drive(env, two_cars, jnp.zeros((2, 3)), 2)
    _, b = drive(env, moved, jnp.zeros((2, 3)), 2)
    np.testing.assert_allclose(a[-1].reward, b[-1].reward, atol=2e-4)
    np.testing.assert_allclose(a[-1].observation["ego"], b[-1].observation["ego"], atol=1e-4)
    np.testing.assert_allclose(a[-1].observation["neighbours"].features, b[-1].observation["neighbours"].features, atol=1e-4)


def test_a_fresh_state_shares_nothing(env, two_cars):
    """Neither with itself nor with its scene: a step may be given it to keep (`donate_argnums`)."""

    def buffers(tree):
        plain = [leaf for leaf in jax.tree.leaves(tree) if leaf.size and not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)]
        return [leaf.unsafe_buffer_pointer() for leaf in plain]

    scene = jax.tree.map(jnp.asarray, two_cars)
    state, _ = env.reset(jax.random.key(0), scene)
    own = buffers(state)
    assert len(set(own)) == len(own) and not set(own) & set(buffers(scene))


@pytest.mark.slow  # the digests step worlds under vmap
def test_steps_trace_once_under_vmap(env, two_cars):
    scenes = jax.tree.map(lambda x: np.stack([x, x]), two_cars)
    traces = []

    @jax.jit
    def step(scenes, states, action):
        traces.append(1)
        return jax.vmap(env.step)(scenes, states, action)

    states, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2), scenes)
    for _ in range(3):
        states, _ = step(scenes, states, jnp.zeros((2, 2, 3)))
    assert len(traces) == 1


# ---- spawns ----


def test_random_pairs_keep_their_promises():
    x = np.arange(-60, 60.1, 0.5)
    lines = [(2, np.stack([x, 0 * x + y], -1)) for y in (-4.0, 0.0, 4.0)]
    slots = 8
    scene = scene_of(np.zeros((slots, 2)), np.ones((slots, 2)))
    scene = replace(scene, lanes=road_of(lines, capacity=900))
    numbers = scenefactory_jax.load_config("task", "spawning=random_pairs")["spawning"]["sampler"] | {"travel_max_m": 50.0}
    del numbers["_target_"]
    draw = jax.jit(jax.vmap(lambda key: spawning.random_pairs(key, scene, **numbers)))
    agents = jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(3), 20)))
    assert agents.present.mean() > 0.9
    for world_index in range(20):
        rows = np.flatnonzero(agents.present[world_index])
        start, goal = np.asarray(agents.position[world_index])[rows], np.asarray(agents.goal[world_index])[rows]
        travel = np.linalg.norm(goal - start, axis=1)
        np.testing.assert_allclose(travel, agents.route_length[world_index][rows], atol=0.05)
        assert travel.min() >= 9.9 and travel.max() <= 50.1
        assert np.abs(start[:, 0]).max() <= 58.1 and np.abs(goal[:, 0]).max() <= 58.1
        assert np.all(np.isin(np.round(start[:, 1], 3), [-4, 0, 4])) and np.allclose(start[:, 1], goal[:, 1], atol=1e-3)
        apart = np.linalg.norm(start[:, None] - start[None], axis=-1) + 1e3 * np.eye(len(rows))
        assert apart.min() >= 8.0
        assert np.all(goal[:, 0] > start[:, 0]), "along the lane's own direction"


def test_cars_underway_start_on_their_recorded_ways():
    """Three cars drive 40 m, 40 m beside them and 6 m; the fourth is absent. Rows in between are not valid now and then."""
    scene = scene_of([[0, 0], [0, 4], [0, 8], [0, 12]], [[40, 0], [40, 4], [6, 8], [9, 12]], present=[True, True, True, False], steps=81)
    share = np.linspace(0, 1, 81)[None, :, None]
    start, goal = np.asarray(scene.agents.position)[:, None], np.asarray(scene.agents.goal)[:, None]
    position = start + share * (goal - start)
    valid = np.ones((4, 81), bool)
    valid[0, 30:34] = valid[2, :6] = False
    position[0, 30:34] = position[2, :6] = 1e4  # the last car is first seen when it has driven 0.45 m
    speed = np.broadcast_to((goal - start) / 8.0, position.shape)
    tracks = {"position": jnp.asarray(position, jnp.float32), "velocity": jnp.asarray(speed, jnp.float32)}
    log = replace(scene.log, **tracks, valid=jnp.asarray(valid))
    numbers = scenefactory_jax.load_config("task", "spawning=along_log", "spawning.sampler.start_gap_m=4.0")["spawning"]["sampler"]
    del numbers["_target_"]
    draw = jax.jit(jax.vmap(lambda key: spawning.along_log(key, replace(scene, log=log), **numbers)))
    agents = jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(4), 200)))
    assert agents.present[:, :3].mean() > 0.95 and not agents.present[:, 3].any()
    for car, whole in ((0, 40.0), (1, 40.0), (2, 6.0)):
        here = agents.present[:, car]
        x, goal_x, route = agents.position[here, car, 0], agents.goal[here, car, 0], agents.route_length[here, car]
        np.testing.assert_allclose(agents.position[here, car, 1], 4.0 * car, atol=1e-4)
        np.testing.assert_allclose(goal_x - x, route, atol=2.6 if car == 0 else 1e-3)  # the gap in the recording is not counted
        assert x.min() >= -1e-4 and np.allclose(goal_x, whole) and route.min() >= min(10.0, 5.55 if car == 2 else whole) - 1e-3
    assert np.ptp(agents.position[:, 0, 0]) > 20 and np.ptp(agents.position[:, 2, 0]) < 1e-3
    apart = np.linalg.norm(agents.position[:, :, None] - agents.position[:, None], axis=-1) + 1e3 * np.eye(4)
    assert np.where(agents.present[:, :, None] & agents.present[:, None], apart, 1e3).min() >= 4.0 - 1e-4
    resting = ~agents.speed.any(axis=1)
    assert abs(resting.mean() - 0.5) < 0.12
    np.testing.assert_allclose(agents.speed[~resting & agents.present[:, 0], 0], 5.0, rtol=1e-4)


@pytest.mark.slow
def test_a_mixture_draws_each_part_as_often_as_its_share():
    x = np.arange(-60, 60.1, 0.5)
    scene = scene_of(np.zeros((4, 2)), np.ones((4, 2)), speeds=4 * [3.0])
    scene = replace(scene, lanes=road_of([(2, np.stack([x, 0 * x], -1))], capacity=300))
    entry = scenefactory_jax.load_config("task", "spawning=mixed", "spawning.sampler.parts.random.weight=1.5")["spawning"]["sampler"]
    draw = jax.jit(jax.vmap(lambda key: spawning.make(entry)(key, scene)))
    agents = jax.tree.map(np.asarray, draw(jax.random.split(jax.random.key(0), 400)))
    recorded = (agents.position == scene.agents.position).all(axis=(1, 2))
    assert abs(recorded.mean() - 0.25) < 0.07 and not agents.speed.any()
    np.testing.assert_array_equal(agents.goal[recorded], np.broadcast_to(scene.agents.goal, (recorded.sum(), 4, 2)))
    assert (agents.route_length[~recorded] >= 9.9 * agents.present[~recorded]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": None}, "spawning.sampler.parts: expected entries of the group `spawning` by name, got None"),
        ({"parts": {"a": {"sampler": {"_target_": "logged"}}}}, "spawning.sampler.parts.a.weight: missing"),
        ({"parts": {"a": {"weight": 0.0, "sampler": {"_target_": "logged"}}}}, "parts.a.weight: expected a number > 0, got 0.0"),
        ({"parts": {"a": {"weight": 1, "sampler": {"_target_": "nobody"}}}}, "parts.a.sampler._target_: 'nobody' is not in"),
        (
            {"parts": {"a": {"weight": 1, "sampler": {"_target_": "logged"}, "respawn_clearance_m": 5.0}}},
            "a.respawn_clearance_m: expected null, got 5.0",
        ),
        ({"parts": {"a": {"weight": 1, "sampler": {"_target_": "logged"}, "weigt": 3}}}, "spawning.sampler.parts.a.weigt: unknown key"),
        ({"parts": {"a": None}}, "spawning.sampler.parts: expected entries .*, got {'a': None}"),
        ({"weights": [1.0]}, "spawning.sampler.weights: unknown key; valid: _target_, parts"),
    ],
)
def test_mistakes_in_a_mixture_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        spawning.make({"_target_": "mixed", **change})


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("spawning.sampler.candidates=0", "spawning.sampler.candidates: expected an integer >= 1, got 0"),
        ("spawning.sampler.travel_min_m=-50", "spawning.sampler.travel_min_m.*: expected .* >= 0, got "),
        ("spawning.sampler.travel_max_m=5", r"spawning.sampler.travel_min_m, travel_max_m: expected \[min, max\], got \[10.0, 5\]"),
        ("spawning.sampler.car_size_m=[4.0]", r"spawning.sampler.car_size_m: expected \[length, width\], got \[4.0\]"),
        ("spawning.respawn_clearance_m=-1", "spawning.respawn_clearance_m: expected a number >= 0 or null, got -1"),
        ("+spawning.respawn_clear=4", "spawning.respawn_clear: unknown key; valid: respawn_clearance_m, sampler"),
        ("~actions.action_repeat", "actions.action_repeat: missing; actions needs action_repeat, command"),
        ("timing.episode_s=inf", "timing.episode_s: expected a number > 0, got inf"),
        ("timing.episode_s=0.001", "timing.episode_s: expected a control step, 0.0333333 s, or more, got 0.001"),
        ("termination.ending=null", "termination.ending: expected a list, .*, got None"),
        ("termination.ending=[numerical_error,goal_reached,colided]", "termination.ending: expected .*collision.*, got .*colided"),
        ("termination.ending=[goal_reached]", "termination.ending: expected numerical_error"),
        ("step_metrics.circles.radius_fraction=a", "step_metrics.circles.radius_fraction: expected a number >= 0, got 'a'"),
        ("reward.progress.limit_m=-1", "reward.progress.limit_m: expected a number >= 0, got -1"),
    ],
)
def test_numbers_that_cannot_work_are_refused_by_name(override, message):
    with pytest.raises(ConfigError, match=message):
        environment.make_env(scenefactory_jax.load_config("task", "spawning=random_pairs", "dynamics=bicycle", override))


@pytest.mark.slow
def test_rates_move_pedals_and_steering(config):
    """0.1 s each: the pedal moves by 2/s up and 4/s down from throttle less brake, and not beyond its end; the steering by 1.5/s."""
    rates = action_settings.Rates(up_per_s=2.0, down_per_s=4.0, steer_per_s=1.5)
    env = build_env(config, hold=3, move=functools.partial(action_settings.move, rates=rates, action_s=0.1))
    scene = scene_of([[0, 0], [40, 0]], [[60, 0], [60, 0]], speeds=[1.0, 0.0])
    state, _ = env.reset(jax.random.key(0), scene)
    applied = []
    for pedal, steer in ((1.0, 1.0), (1.0, -0.5), (-1.0, 0.0), (-0.5, 3.0)):
        state, _ = jitted(env.step)(scene, state, jnp.tile(jnp.array([pedal, steer, 0.7]), (2, 1)))
        applied.append(np.asarray(state.previous_action[0]))
    # pedals_with_reverse keeps the sign of the throttle, and the third number is its brake
    np.testing.assert_allclose(applied, [[0.2, 0.15, 0.7], [-0.3, 0.075, 0.7], [-1.0, 0.075, 0.7], [-1.0, 0.225, 0.7]], atol=1e-6)
    still = jnp.zeros(2)
    move = functools.partial(action_settings.move, rates=dataclasses.replace(rates, most_throttle=0.25), action_s=0.1)
    found = move(jnp.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), jnp.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.9]]), still)
    np.testing.assert_allclose(found[:, 0], [0.25, -1.0], err_msg="full brakes, but not full throttle")
    move = functools.partial(action_settings.move, rates=dataclasses.replace(rates, exponent=2.0), action_s=0.1)
    found = move(jnp.array([[0.5, -1.0, 0.3], [-0.5, 0.2, 0.3]]), jnp.zeros((2, 3)), still)
    np.testing.assert_allclose(found, [[0.05, -0.15, 0.3], [-0.1, 0.006, 0.3]], atol=1e-6)


@pytest.mark.parametrize(
    ("pedal", "speed", "last", "expected"),  # last and expected: throttle, brake
    [
        (-0.5, 0.4, (0.1, 0.0), (-0.1, 0.0)),  # falls through 0 while the car stands
        (-0.5, 0.6, (0.1, 0.0), (0.0, 0.1)),  # while it rolls
        (-0.5, 0.0, (0.0, 0.3), (0.0, 0.5)),  # a car that its brakes have stopped stands
        (0.5, 0.0, (0.0, 0.3), (0.0, 0.2)),
        (0.5, 0.0, (0.0, 0.1), (0.0, 0.0)),  # released
        (-0.5, 0.0, (0.0, 1e-7), (-0.2, 0.0)),  # falls again; steps up to 0 are rounded
        (-0.5, -3.0, (-0.2, 0.0), (-0.4, 0.0)),  # backwards
        (-0.5, -3.0, (-0.4, 0.0), (-0.5, 0.0)),  # at most
        (0.5, -3.0, (-0.2, 0.0), (-0.1, 0.0)),
        (1.0, -3.0, (-0.1, 0.0), (0.1, 0.0)),  # forward again
        (-0.5, 5.0, (-0.1, 0.0), (-0.3, 0.0)),  # a car that was pushed: the engine idles (`compute_drive_torque`)
        (0.5, 5.0, (0.3, 0.0), (0.4, 0.0)),
    ],
)
def test_a_pedal_that_falls_while_the_car_stands_drives_backwards(pedal, speed, last, expected):
    rates = action_settings.Rates(up_per_s=2.0, down_per_s=4.0, steer_per_s=1.5, reverse_below_mps=0.5, most_reverse=0.5)
    found = action_settings.move(
        jnp.array([[pedal, 0.0, 0.7]]), jnp.array([[last[0], 0.0, last[1]]]), jnp.array([speed]), rates=rates, action_s=0.1
    )
    np.testing.assert_allclose(found[0, ::2], expected, atol=1e-6)


def test_planners_and_imitation_refuse_rates():
    load = functools.partial(scenefactory_jax.load_config, "train", "actions=rates_10hz")
    with pytest.raises(ConfigError, match=r"actions\.rates: expected null for a planner, .*valid: actions=one_pedal_10hz"):
        training_loop.make_policy(load("policy=pure_pursuit"))
    with pytest.raises(ConfigError, match=r"actions\.rates: expected null for a learner that imitates"):
        expert.make_expert(load("learner=bc"))


@pytest.mark.slow  # the next one respawns
def test_respawn_samples_from_logged_agents(config):
    def draw(key, scene):  # each episode's starts lie 1 m beside those of the scene that the sampler sees
        return replace(scene.agents, position=scene.agents.position + jnp.float32([0.0, 1.0]))

    scene = scene_of([[0, 0], [40, 0]], [[6, 1], [60, 1]], speeds=[6.0, 0.0])
    env = build_env(config, respawn=10.0, draw=draw)
    state, history = drive(env, scene, jnp.zeros((2, 3)), 40)
    assert sum(bool(h.events.goal_reached[0]) for h in history) >= 2
    np.testing.assert_allclose(state.agents.position[0], [0.0, 1.0], atol=1e-6, err_msg="not 1 m farther with each start")


def test_respawn_starts_finished_cars_again(config):
    env = build_env(config, respawn=10.0)
    scene = scene_of([[0, 0], [40, 0]], [[6, 0], [60, 0]], speeds=[6.0, 0.0])
    state, history = drive(env, scene, jnp.zeros((2, 3)), 40)
    assert sum(bool(h.events.goal_reached[0]) for h in history) >= 2, "the car reaches its goal, starts again and reaches it again"
    assert state.active.all() and not any(bool(h.world_done) for h in history)
