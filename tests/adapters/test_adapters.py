"""What all adapters stand on: one vector an agent, episodes drawn from a pool, configs that fit, and the functional API of the docs."""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.adapting import ALONE, SMOKE, scenes
from support.choosing import slow_except

from scenefactory_jax.adapters import bounds, episodes, flatten_observation, layout
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.types import SetObservation
from scenefactory_jax.env import environment, observations

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]


def test_a_flat_observation_holds_every_group_where_its_layout_says():
    features, mask = np.arange(1, 13, dtype=np.float32).reshape(2, 3, 2), np.array([[True, False, True], [False, False, False]])
    groups = {"zone": np.ones((2, 4), np.float32), "ego": np.full((2, 1), 5.0, np.float32)}
    observation = jax.device_put(groups) | {"road": SetObservation(*jax.device_put((features, mask)))}
    vector, columns = np.asarray(jax.jit(flatten_observation)(observation)), layout(observation)
    assert vector.shape == (2, 1 + 6 + 3 + 4) and list(columns) == ["ego", "road", "road.mask", "zone"]
    np.testing.assert_array_equal(vector[:, columns["road"]], [[1, 2, 0, 0, 5, 6], [0] * 6])  # what is masked reads zeros
    np.testing.assert_array_equal(vector[:, columns["road.mask"]], [[1, 0, 1], [0, 0, 0]])
    np.testing.assert_array_equal(vector[:, columns["ego"]], [[5], [5]])
    many = jax.device_put(jax.tree.map(lambda leaf: np.stack([leaf] * 7), observation))
    np.testing.assert_array_equal(jax.jit(flatten_observation)(many), np.stack([vector] * 7))


@pytest.mark.parametrize("observe", slow_except(["paper", "lane_preview"], "paper"))  # together all groups of the package
def test_bounds_hold_for_what_cars_see_before_anything_is_clipped(observe):
    settings = hydra_config.load_config(
        "train", SMOKE, f"observations={observe}", "dynamics=bicycle", "termination=goal_only", "scenes.pack.agents=4"
    )
    env, given = environment.make_env(settings), scenes(agents=4).scene

    def step(given, carry, key):
        states, action = carry
        drawn = jax.random.uniform(key, action.shape, minval=-1.0)
        drawn = jnp.where(jax.random.bernoulli(key, 0.1), drawn, action)  # for a third of a second at a time
        states, outcome = jax.vmap(env.step)(given, states, drawn)
        return (states, drawn), flatten_observation(outcome.observation)

    def drive(given, key):
        states, observed = jax.vmap(env.reset)(jax.random.split(key, 4), given)
        full = jnp.tile(jnp.array([1.0, 0.05, -1.0]), (4, 4, 1))
        return flatten_observation(observed), jax.lax.scan(functools.partial(step, given), (states, full), jax.random.split(key, 120))[1]

    first, observed = jax.jit(drive)(given, jax.random.key(0))
    observation = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 4), given)[1]
    low, high = bounds.flat_bounds(environment.make_parts(settings).groups, observation)
    assert np.isfinite(low).all() and np.isfinite(high).all() and low.shape == observed.shape[-1:]
    observed = np.concatenate([np.asarray(first)[None], np.asarray(observed)])
    outside = (observed < low - 1e-5) | (observed > high + 1e-5)
    assert not outside.any(), [(name, at, observed[..., at].min(), observed[..., at].max()) for name, at in layout(observation).items()]
    assert np.ptp(observed, axis=(0, 1, 2))[layout(observation)["ego"]].min() > 0.2  # the cars went somewhere


def test_columns_without_a_bound_are_clipped_and_the_others_are_what_they_were():
    @observations.bound_observation(observations.FRACTION, observations.ANY)
    def mine(scene, state, *, scale: float):
        return scale * jnp.array([[0.25, 30.0, -4.0]])

    unbound = lambda scene, state: SetObservation(jnp.array([[[-20.0, 20.0], [0.0, 1.0]]]), jnp.array([[True, True]]))  # noqa: E731
    groups = {"mine": functools.partial(mine, scale=2.0), "yours": unbound}
    observed = {name: bounds.clip(group)(None, None) for name, group in groups.items()}
    limit = bounds.LIMIT
    np.testing.assert_array_equal(flatten_observation(observed), [[0.5, limit, -8.0, -limit, limit, 0.0, 1.0, 1.0, 1.0]])
    low, high = bounds.flat_bounds(groups, observed)
    np.testing.assert_array_equal(low, [0, -limit, -limit, *[-limit] * 4, 0, 0])
    np.testing.assert_array_equal(high, [1, limit, limit, *[limit] * 4, 1, 1])


@pytest.mark.slow
def test_episodes_are_drawn_from_all_scenes_and_from_their_key_alone():
    pool = episodes.make_pool(None, ALONE, scenes(), alone=True)
    begin = jax.jit(jax.vmap(lambda key: episodes.begin_episode(pool.env, pool.scenes, key)))
    keys = jax.random.split(jax.random.key(0), 64)
    episode, observed = begin(keys)
    assert set(np.asarray(episode.scene)) == {0, 1, 2, 3} and pool.steps == 60 and len(pool.names) == 4
    again, same = begin(keys)
    for one, other in zip(jax.tree.leaves((episode.state.motion, observed)), jax.tree.leaves((again.state.motion, same)), strict=True):
        np.testing.assert_array_equal(one, other)
    start = np.asarray(pool.scenes.agents.position)[episode.scene]
    np.testing.assert_allclose(np.asarray(episode.state.motion.position)[..., :2], start, atol=1e-5)
    following = begin(episode.key)[0]
    assert (np.asarray(following.scene) != np.asarray(episode.scene)).any()


def test_a_step_of_an_episode_is_the_environments_own():
    settings = hydra_config.load_config("train", SMOKE, "~observations.road", "~observations.neighbours")  # less to compile
    pool = episodes.make_pool(settings, (), scenes(agents=4), alone=False)
    episode, observed = jax.jit(lambda key: episodes.begin_episode(pool.env, pool.scenes, key, 2))(jax.random.key(3))
    action = jnp.full((4, 3), 0.5)
    following, moment = jax.jit(lambda begun: episodes.step_world(pool.env, pool.scenes, begun, action))(episode)
    observation = jax.jit(lambda following: episodes.observe(pool.env, pool.scenes, following))(following)
    env, scene = environment.make_env(settings), jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[2], scenes(agents=4).scene))
    after, outcome = jax.jit(env.step)(scene, episode.state, action)
    assert observed.shape == (4, pool.columns)
    np.testing.assert_allclose(observation, jax.jit(flatten_observation)(outcome.observation), atol=1e-5)
    moment, outcome = jax.device_get((moment, outcome))
    driving = np.asarray(episode.state.active)
    assert 0 < driving.sum() < 4  # scene 2 leaves slots empty
    np.testing.assert_allclose(moment.reward, np.where(driving, outcome.reward, 0), atol=1e-5)
    np.testing.assert_array_equal(moment.reward[~driving], 0)
    np.testing.assert_allclose(sum(moment.terms.values()), moment.reward, atol=1e-4)
    np.testing.assert_array_equal(moment.active, after.active)


@pytest.mark.slow  # test_environment has actions of several steps
def test_a_step_is_all_control_steps_of_an_action():
    settings = hydra_config.load_config("train", SMOKE, "~observations.road", "~observations.neighbours")  # less to compile
    repeating = episodes.make_pool(settings, ["actions.action_repeat=3"], scenes(agents=4), alone=False)
    assert (repeating.steps, repeating.step_hz) == (20, 10.0)
    episode = jax.jit(functools.partial(episodes.start_episodes, repeating.env))(repeating.scenes, jax.random.key(3), 1)
    action = jnp.array([[1.0, 0.1, 0.0]] * repeating.agents)
    after, moment = jax.jit(functools.partial(episodes.step_world, repeating.env))(repeating.scenes, episode, action)
    scene, state = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[1], repeating.scenes)), episode.state
    step, paid = jax.jit(repeating.env.control_step), 0.0
    for _ in range(3):
        driving = np.asarray(state.active)
        state, outcome = step(scene, state, action)
        paid += np.where(driving, outcome.reward, 0.0)
    np.testing.assert_allclose(moment.reward, paid, atol=1e-4)
    np.testing.assert_allclose(after.state.motion.position, state.motion.position, atol=1e-4)
    assert int(after.state.step) == 3 and (np.asarray(paid)[np.asarray(driving)] > 0).any()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("scenes.pack.agents=4", r"scenes\.pack\.agents: 4; this environment drives one car: set scenes\.pack\.agents=1"),
        ("spawning.respawn_clearance_m=5.0", r"spawning\.respawn_clearance_m: expected null, .* got 5\.0"),
        ("dynamics=hover", "Could not find 'dynamics/hover'"),
        ("timing.control_hz=0", r"timing\.control_hz: expected a number > 0, got 0"),
    ],
)
def test_a_config_that_does_not_fit_says_what_to_set(override, message):
    with pytest.raises(ConfigError, match=message):
        episodes.make_pool(None, [*ALONE, override], None, alone=True)
    with pytest.raises(ConfigError, match=message):  # and one from Python
        episodes.make_pool(hydra_config.load_config("train", *ALONE, override), (), None, alone=True)


def test_scenes_and_options_that_do_not_fit_say_so():
    with pytest.raises(ConfigError, match=r"the scenes given: 4 slots a scene; .* set scenes\.pack\.agents=1"):
        episodes.make_pool(None, [SMOKE], scenes(agents=4), alone=True)
    with pytest.raises(ConfigError, match=r"options\['scene'\]: 4; valid: 0 to 3"):
        episodes.choose_scene({"scene": 4}, 4)
    assert episodes.choose_scene(None, 4) == episodes.ANY and episodes.choose_scene({"scene": 3, "other": 1}, 4) == 3
    assert episodes.choose_scene({"scene": [3, -1]}, 4, 2).tolist() == [3, -1] and episodes.choose_scene({"scene": 1}, 4, 2).tolist() == [
        1,
        1,
    ]
    changed = episodes.make_pool(hydra_config.load_config("train", *ALONE), ["timing.episode_s=1"], scenes(), alone=True)
    assert changed.steps == 30


@pytest.mark.parametrize(
    ("name", "package"), [("gymnasium", "gymnasium"), ("pettingzoo", "pettingzoo"), ("jaxmarl", "jaxmarl"), ("sb3", "stable_baselines3")]
)
def test_a_missing_extra_is_named(name, package, monkeypatch):
    for loaded in [module for module in sys.modules if module.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, package, None)  # what `import` takes for not installed
    monkeypatch.delitem(sys.modules, f"scenefactory_jax.adapters.{name}", raising=False)
    with pytest.raises(ImportError, match=rf"pip install 'scenefactory_jax\[{name}\]'"):
        __import__(f"scenefactory_jax.adapters.{name}")
