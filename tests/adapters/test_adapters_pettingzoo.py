"""PettingZoo's own checkers, and what they do not look at: who is an agent, and how it ends."""

import copy
import warnings

import numpy as np
import pytest
from support.adapting import SMOKE, scenes

pytest.importorskip("pettingzoo", reason="the extra [pettingzoo] is not installed")

from pettingzoo.test import parallel_api_test, parallel_seed_test

from scenefactory_jax.adapters.pettingzoo import Drive
from scenefactory_jax.core.instantiate import ConfigError

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]


@pytest.fixture(scope="module")
def env():
    return Drive(None, [SMOKE], scenes(agents=4))


def test_parallel_api_test_passes(env):
    with warnings.catch_warnings():
        warnings.filterwarnings("error", module="pettingzoo")
        # a slot without a car in this scene is a possible agent that never ends
        warnings.filterwarnings("ignore", message="No agents present but not all possible_agents are terminated or truncated")
        parallel_api_test(env, num_cycles=130)


def test_parallel_seed_test_passes(env):
    def twin():
        """Shares what is compiled, but has spaces to sample from that are seeded apart."""
        other = copy.copy(env)
        other.observation_spaces, other.action_spaces = copy.deepcopy((env.observation_spaces, env.action_spaces))
        return other

    parallel_seed_test(twin, num_cycles=20)


def test_agents_are_the_cars_of_the_scene_until_each_has_ended(env):
    sizes = np.asarray(scenes(agents=4).scene.agents.present).sum(1)
    assert env.possible_agents == ["car_0", "car_1", "car_2", "car_3"] and 0 < sizes[2] < 4
    observations, infos = env.reset(seed=0, options={"scene": 2})
    assert len(env.agents) == sizes[2] == len(observations) and all(infos[name] == {"scene": 2} for name in env.agents)
    first, *rest = env.agents
    driving, ended = list(env.agents), {}
    for step in range(60):
        actions = {name: np.array([1.0, 0.6, -1.0] if name == first else [0.0, 0.0, 1.0], np.float32) for name in env.agents}
        actions |= {name: np.ones(3, np.float32) for name in ended}  # counts for nothing
        before = list(env.agents)
        observations, rewards, terminations, truncations, infos = env.step(actions)
        for told in (observations, rewards, terminations, truncations, infos):
            assert list(told) == before
        for name in before:
            assert observations[name] in env.observation_space(name)
            assert rewards[name] == pytest.approx(sum(infos[name]["terms"].values()), abs=1e-4)
            assert terminations[name] == any(infos[name]["events"].values())  # strict: every event ends
            assert truncations[name] == (step == 59) or terminations[name]
            if terminations[name] or truncations[name]:
                ended[name] = (step, terminations[name], bool(observations[name].any()))
        assert env.agents == [name for name in driving if name not in ended]
    assert ended[first][0] < 59 and ended[first][1:] == (True, False)  # off the road, and blind from then on
    assert rest and all(ended[name] == (59, False, True) for name in rest)  # the time was up: a last look
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})
    assert env._advance._cache_size() == env._begin._cache_size() == 1


def test_actions_that_are_missing_or_of_nobody_are_named(env):
    env.reset(seed=0, options={"scene": 0})
    given = {name: np.zeros(3, np.float32) for name in env.agents}
    with pytest.raises(ConfigError, match=r"actions: 'lorry': expected one for each of car_0"):
        env.step(given | {"lorry": np.zeros(3)})
    with pytest.raises(ConfigError, match=r"actions: 'car_0': expected shape \(3,\), .* got \(1,\)"):
        env.step(given | {"car_0": np.zeros(1)})
    unbegun = copy.copy(env)
    unbegun._episode = None
    with pytest.raises(ConfigError, match="step: no episode has begun; call reset first"):
        unbegun.step(given)
    del given["car_1"]
    with pytest.raises(ConfigError, match="actions: 'car_1'"):
        env.step(given)
