"""CoPO: rewards of others and the slope of the factors' distribution against arithmetic; the probes, a game of neighbours, resumption."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats
from support.coordination import GAME, POLICY, game, make_learner, make_numbers
from support.probes import NUMBERS, SMALL, make_trainer, ppo_config, scenes
from support.resuming import check_resumed_is_unbroken

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import gaussian, off_policy
from scenefactory_jax.learning.copo import coordination, train_iteration
from scenefactory_jax.learning.copo.config import CoPOConfig
from scenefactory_jax.learning.copo.train_iteration import CoPO
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.ppo import loss
from scenefactory_jax.learning.ppo.train_iteration import PPO
from scenefactory_jax.learning.trainer import get_policy_parameters

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS, APPLY = 16, jax.jit(POLICY.apply)


def test_rewards_of_others():
    """Cars at 0, 30, 60 and 65 m, the last one not active, and one far away; two worlds of which the second has no active car."""
    position = jnp.stack([jnp.array([0.0, 30.0, 60.0, 65.0, 500.0]), jnp.zeros(5)], axis=-1)[None].repeat(2, axis=0)
    active = jnp.array([[True, True, True, False, True], [False] * 5])
    reward = jnp.array([[1.0, 2.0, 4.0, 1e6, -3.0]]).repeat(2, axis=0)
    near = coordination.compute_neighbourhood_reward(reward, active, position, radius_m=40.0)
    np.testing.assert_allclose(near, [[2.0, 2.5, 2.0, 3.0, 0.0], [0.0] * 5])
    apart = coordination.compute_neighbourhood_reward(reward, active, position, radius_m=30.0)
    np.testing.assert_allclose(apart[0, :3], [0.0, 0.0, 0.0])  # within, not at, the radius
    np.testing.assert_allclose(coordination.compute_global_reward(reward, active), [[1.0] * 5, [0.0] * 5])


def test_mean_over_the_factors():
    distribution = coordination.make_distribution(0.4, 0.3)
    np.testing.assert_allclose([distribution.mean, distribution.std], [0.4, 0.3], rtol=1e-5)
    density = stats.norm(0.4, 0.3).pdf
    expected = integrate.quad(lambda phi: density(phi) * (np.cos(phi) * 1.5 - np.sin(phi) * 2.0), -5.0, 5.0)[0]
    np.testing.assert_allclose(coordination.expect_coordinated(distribution, jnp.float32(1.5), jnp.float32(-2.0)), expected, rtol=1e-5)


def test_an_agent_keeps_its_factor_until_it_ends():
    ended = jnp.zeros((6, 40, 2), bool).at[2, :, 0].set(True).at[5, :, 1].set(True)
    first = jnp.full((40, 2), 9.0)
    follow = jax.jit(functools.partial(coordination.follow_factors, coordination.make_distribution(0.4, 0.1), axis=None))
    factors, after = jax.device_get(follow(first, ended, jax.random.key(0)))
    assert (factors[:3, :, 0] == 9.0).all() and (factors[:, :, 1] == 9.0).all()
    assert (factors[3:, :, 0] == after[:, 0]).all()
    for drawn in after.T:
        assert (
            len(set(drawn.tolist())) == 40 and drawn.mean() == pytest.approx(0.4, abs=0.06) and drawn.std() == pytest.approx(0.1, abs=0.04)
        )


def test_the_distribution_climbs_the_global_objective_of_the_next_policy():
    """Its slope is that of J(theta + rate grad E[log pi A_phi]), differentiated through the step; samples without weight are not read."""
    weight, rate = np.arange(24) % 3 > 0, 0.05
    used, copo = np.flatnonzero(weight), CoPO(PPO(game(), POLICY, ppo_config(clip_eps=0.2)), make_numbers())

    @jax.jit
    def compute(distribution, key):
        keys = jax.random.split(key, 4)
        observation = {"cue": jax.random.normal(keys[0], (24, 1))}
        before = POLICY.init(keys[1], observation)
        mean, log_std, value = POLICY.apply(before, observation)
        action = mean + jnp.exp(log_std) * jax.random.normal(keys[2], mean.shape)
        density = gaussian.log_probability(action, mean, log_std)
        advantage = jnp.where(weight[:, None], jax.random.normal(keys[3], (24, 3)), jnp.nan)
        spread = jnp.broadcast_to(log_std, mean.shape)
        batch = loss.Batch(observation, action, mean, spread, density, value, advantage[:, 0], value, jnp.asarray(weight, jnp.float32))

        def find_density(parameters):
            mean, log_std, _ = POLICY.apply(parameters, {"cue": observation["cue"][used]})
            return gaussian.log_probability(action[used], mean, log_std)

        def step(distribution):
            individual, neighbourhood, _ = advantage[used].T
            mixed = jax.vmap(functools.partial(coordination.expect_coordinated, distribution))(individual, neighbourhood)
            slope = jax.grad(lambda parameters: jnp.mean(find_density(parameters) * mixed))(before)
            return jax.tree.map(lambda old, slope: old + rate * slope, before, slope)

        def global_objective(distribution):
            ratio = jnp.exp(find_density(step(distribution)) - density[used])
            return jnp.mean(loss.clip_surrogate(ratio, advantage[used, 2], 0.2))

        alignment = train_iteration.compute_alignment(copo, before, step(distribution), batch, advantage, jnp.arange(24))
        found = jax.grad(coordination.expect_coordinated)(distribution, *alignment)
        return jax.grad(global_objective)(distribution), jax.tree.map(lambda slope: rate * slope, found)

    expected, found = compute(coordination.make_distribution(0.3, 0.5), jax.random.key(3))
    np.testing.assert_allclose([found.raw_mean, found.log_std], [expected.raw_mean, expected.log_std], rtol=1e-3)


@pytest.fixture(scope="module")
def learner():
    """On the probes and the game, compiled once."""
    return make_learner(game())


def train_on(learner, task, iterations):
    """The train state, metrics of the last iteration, and (throttle, values) for cues."""
    stage = scenes(WORLDS, task)
    state = learner.init(jax.random.key(0), stage)
    for _ in range(iterations):
        state, metrics = learner.train_iteration(state, stage)

    def look(*cues):
        mean, _, value = APPLY(get_policy_parameters(state), {"cue": np.array(cues, np.float32)[:, None]})
        return mean[:, 0], value

    return state, jax.device_get(metrics), look


@pytest.mark.slow  # of the learner that it shares with PPO
def test_probes_1_to_3_values(learner):
    """Of an agent itself, of its neighbour, whose cue it does not see, and of both; the third slot, which pays poison, is empty."""
    np.testing.assert_allclose(train_on(learner, 1, 25)[2](0.0)[1], [[1.0, 1.0, 1.0]], atol=0.05)
    _, metrics, look = train_on(learner, 2, 25)
    np.testing.assert_allclose(look(-1.0, 1.0)[1], [[-1.0, 0.0, -0.5], [1.0, 0.0, 0.5]], atol=0.15)
    assert metrics["ppo/explained_variance"] > 0.95 > 0.7 > metrics["copo/explained_variance_global"] > 0.3
    gamma = NUMBERS["gamma"]
    np.testing.assert_allclose(train_on(learner, 3, 25)[2](0.0, 1.0)[1], [[gamma] * 3, [1.0] * 3], atol=0.06)


@pytest.mark.ci
def test_probes_4_and_5_actions(learner):
    np.testing.assert_allclose(train_on(learner, 4, 40)[2](0.0)[0], [0.5], atol=0.1)
    _, metrics, look = train_on(learner, 5, 40)
    np.testing.assert_allclose(look(-1.0, 1.0)[0], [-0.5, 0.5], atol=0.1)
    assert all(np.isfinite(value) for value in metrics.values()) and metrics["ppo/skipped"] == 0.0


@pytest.mark.slow
def test_agents_that_gain_from_each_other_become_altruists(learner):
    """An agent's throttle costs it a half and pays its neighbour 1: PPO brakes, at a reward of -0.5 each; altruists have 0.5."""
    state, metrics, look = train_on(learner, GAME, 30)
    assert metrics["copo/lcf_mean"] > np.arctan(0.5) and look(0.0)[0] > 0.7 and metrics["reward"] > 0.4
    assert np.asarray(state.buffer["copo"])[:, :2].mean() == pytest.approx(metrics["copo/lcf_mean"], abs=0.1)

    egoists, stage = make_trainer(game()), scenes(WORLDS, GAME)
    state = egoists.init(jax.random.key(0), stage)
    for _ in range(30):
        state, metrics = egoists.train_iteration(state, stage)
    assert metrics["reward"] < -0.4


def test_a_killed_and_resumed_run_is_the_unbroken_one(learner, tmp_path):
    stage = scenes(WORLDS, GAME)
    _, leaves = check_resumed_is_unbroken(learner, stage, tmp_path)
    assert {"buffer/copo", "learner/copo/parameters/raw_mean"} <= {*leaves}


def test_the_config_is_valid():
    config = configs.load_config("train", "learner=copo")
    numbers = off_policy.read_numbers(config, CoPOConfig)
    assert (numbers.radius_m, numbers.learning_rate, numbers.passes) == (40.0, 1e-4, 5)
    assert numbers.lcf_mean == 0.0 and numbers.lcf_std == pytest.approx(0.1 * np.pi / 2, abs=1e-3)


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="policy: learner copo needs one with 3 values; valid: policy=late_fusion, policy=actor_critic"):
        alone = late_fusion.make(**SMALL)
        train_iteration.make_trainer(game(), alone, ppo_config(), make_numbers(), episode_steps=9).init(jax.random.key(0), scenes(WORLDS))
    for name, value in {"values": 1, "lcf_mean": 1.6, "lcf_std": 0.0, "radius_m": -1.0, "passes": 0}.items():
        with pytest.raises(ConfigError, match=rf"learner\.{name}: expected .*, got {value}"):
            make_numbers(**{name: value})
