"""Stable-Baselines3: its checker, its DummyVecEnv over single environments as the oracle, and its PPO."""

import warnings

import numpy as np
import pytest
from support.adapting import ALONE, actions, scenes

pytest.importorskip("stable_baselines3", reason="the extra [sb3] is not installed")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from scenefactory_jax.adapters import gymnasium
from scenefactory_jax.adapters.sb3 import Drive
from scenefactory_jax.core.instantiate import ConfigError

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS, STEPS = 3, 70  # an episode takes 60
NAME = f"scenefactory_jax.adapters.gymnasium:{gymnasium.ID}"


def many(**options):
    return Drive(WORLDS, None, ALONE, scenes(), **options)


def test_it_is_stable_baselines_own_over_single_environments():
    envs, oracle = many(), DummyVecEnv([lambda: gymnasium.Drive(None, ALONE, scenes())] * WORLDS)
    assert envs.observation_space == oracle.observation_space and envs.action_space == oracle.action_space
    for one in (envs, oracle):
        one.seed(7)
        one.set_options([{"scene": 2}, {}, {}])
    np.testing.assert_allclose(envs.reset(), oracle.reset(), atol=1e-5)
    assert envs.reset_infos == oracle.reset_infos and envs.reset_infos[0] == {"scene": 2}
    ended = np.zeros(WORLDS, int)
    for action in actions(STEPS, WORLDS):
        (observed, reward, done, infos), (expected, paid, over, told) = envs.step(action), oracle.step(action)
        np.testing.assert_allclose(observed, expected, atol=1e-4)
        np.testing.assert_allclose(reward, paid, atol=1e-4)
        np.testing.assert_array_equal(done, over)
        for ours, theirs in zip(infos, told, strict=True):
            np.testing.assert_allclose(ours.pop("terminal_observation", 0.0), theirs.pop("terminal_observation", 0.0), atol=1e-4)
            assert ours.pop("terms") == pytest.approx(theirs.pop("terms"), abs=1e-4)
            assert ours == theirs  # scene, events, and whether the time was up
        ended += done
        observed[...] = 0.0  # a caller's own
    assert (ended >= 1).all() and envs.reset_infos == oracle.reset_infos
    np.testing.assert_allclose(envs.reset(), oracle.reset(), atol=1e-5)  # the next episodes of the seeds before


def test_its_ppo_learns_on_it_and_judges():
    envs = VecMonitor(many(render_mode="rgb_array"))
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu").learn(2 * 64 * WORLDS)
    assert len(model.ep_info_buffer) >= WORLDS and all(0 < episode["l"] <= 60 for episode in model.ep_info_buffer)
    rewards, lengths = evaluate_policy(model, envs, n_eval_episodes=4, return_episode_rewards=True)
    assert np.isfinite(rewards).all() and all(0 < length <= 60 for length in lengths)
    assert envs.render().shape == (800, 800, 3)  # 2 x 2 pictures, one of them black


def test_make_vec_env_makes_single_ones_that_render():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.Drive(None, ALONE, scenes(), render_mode="rgb_array"))
    envs = make_vec_env(NAME, n_envs=1, seed=3, env_kwargs={"overrides": ALONE, "scenes": scenes()})
    envs.reset()
    observed, reward, _, _ = envs.step(np.zeros((1, 3), np.float32))
    assert envs.observation_space.contains(observed[0]) and np.isfinite(reward).all()
    assert envs.render_mode == "rgb_array" and envs.render().shape == (400, 400, 3)


def test_what_the_worlds_do_not_have_of_their_own_is_refused_in_a_line():
    envs = many()
    assert envs.get_attr("names") == [envs.names] * WORLDS and not envs.has_attr("action_masks")
    assert envs.env_is_wrapped(VecMonitor, [0]) == [False]
    with pytest.raises(ConfigError, match=r"set_attr\('weather'\): the worlds are one program"):
        envs.set_attr("weather", "ice")
    with pytest.raises(ConfigError, match=r"env_method\('reset'\): the worlds are one program"):
        envs.env_method("reset")
    with pytest.raises(ConfigError, match="render_mode: 'human'; valid: None, rgb_array"):
        many(render_mode="human")
    envs.set_options({"scene": 4})
    with pytest.raises(ConfigError, match=r"options\['scene'\]: \[4, 4, 4\]; valid: 0 to 3"):
        envs.reset()
