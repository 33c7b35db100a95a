"""GAIL and AIRL: losses and rewards against arithmetic by hand, two distributions told apart, the probe that steers, resumption."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.adversarial import GAMMA, POLICY, make_discriminator, make_learner, make_numbers
from support.choosing import slow_except
from support.probes import STEERS, expert, ppo_config, probe, scenes
from support.resuming import check_resumed_is_unbroken

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Policy
from scenefactory_jax.learning import off_policy, replay_buffer, trainer
from scenefactory_jax.learning.adversarial import airl, gail, train_iteration
from scenefactory_jax.learning.adversarial.config import AdversarialConfig
from scenefactory_jax.learning.adversarial.discriminator import Discriminator, Pairs, compute_loss
from scenefactory_jax.learning.gaussian import clipped_log_probability
from scenefactory_jax.learning.trainer import get_policy_parameters

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS, ITERATIONS = 8, 40


def make_pairs(seen, after=None, follows=True, density=0.0):
    seen = jnp.asarray(seen, jnp.float32)
    full = lambda x, kind: jnp.broadcast_to(jnp.asarray(x, kind), seen.shape)  # noqa: E731
    after = seen if after is None else jnp.asarray(after, jnp.float32)
    return Pairs({"cue": seen[:, None]}, {"cue": after[:, None]}, full(follows, bool), full(density, jnp.float32), jnp.ones(seen.shape))


def test_loss_equals_its_definition():
    """A score of c x, whose third pair has no weight, of which it may be anything."""
    judge = Discriminator(lambda *_: None, lambda c, pairs: c * pairs.observation["cue"][:, 0], jax.nn.softplus)
    weight = jnp.array([1.0, 1.0, 0.0])
    real, made = (replace(make_pairs(x), weight=weight) for x in ([1.0, -0.5, jnp.nan], [-2.0, 0.3, jnp.inf]))
    loss, metrics = compute_loss(jnp.float32(2.0), real, made, discriminator=judge, totals=(jnp.float32(2.0), jnp.float32(2.0)))
    of_expert, of_policy = (1 / (1 + np.exp(-2.0 * np.array(x))) for x in ([1.0, -0.5], [-2.0, 0.3]))
    np.testing.assert_allclose(loss, -np.log(of_expert).mean() - np.log(1 - of_policy).mean(), rtol=1e-5)
    assert float(metrics["expert_accuracy"]) == float(metrics["policy_accuracy"]) == 0.5


def test_rewards_equal_their_definitions():
    """-log(1 - D) of GAIL and log D - log(1 - D) of AIRL, whose D is exp f / (exp f + pi); after an end there is no next observation."""
    pairs = make_pairs([0.5, -1.0, 0.5], [1.0, 2.0, 1.0], [True, True, False], [-0.3, 0.8, -0.3])
    other = make_pairs([0.5, -1.0, 0.5], [1.0, 2.0, 9.0], [True, True, False], [-0.3, 0.8, -0.3])
    for name in ("gail", "airl"):
        judge = make_discriminator(name)
        parameters, find_score = jax.jit(judge.init)(jax.random.key(0), {"cue": jnp.ones((1, 3, 1))}), jax.jit(judge.score)
        score = np.asarray(find_score(parameters, pairs))
        probability = 1 / (1 + np.exp(-np.asarray(score, float)))
        np.testing.assert_array_equal(score, find_score(parameters, other))
        assert score[0] != score[2]
        if name == "gail":
            np.testing.assert_allclose(judge.reward(score), -np.log(1 - probability), rtol=1e-5)
            continue
        network = airl.make_value(POLICY.encoder, hidden=[16], activation="tanh")
        reward, shaping = (functools.partial(jax.jit(network.apply), parameters[part]) for part in ("reward", "shaping"))
        now, then, base = map(np.asarray, (reward(pairs.observation), shaping(pairs.next_observation), shaping(pairs.observation)))
        f = now + GAMMA * then * np.array([1, 1, 0]) - base
        density = np.exp(np.array([-0.3, 0.8, -0.3]))
        np.testing.assert_allclose(probability, np.exp(f) / (np.exp(f) + density), rtol=1e-5)
        np.testing.assert_allclose(judge.reward(score), np.log(probability) - np.log(1 - probability), rtol=1e-4)


@pytest.mark.parametrize("name", slow_except(["gail", "airl"], "gail"))
def test_it_tells_two_distributions_apart(name):
    """States around 1 are the expert's, around -1 the policy's; D in between is the ratio of their densities, here sigmoid(2 x / 0.5^2)."""
    learner = make_learner_constants(name)
    judge = learner.discriminator
    parameters = jax.jit(judge.init)(jax.random.key(0), {"cue": jnp.ones((1, 3, 1))})
    learnt = off_policy.Learnt(parameters, (), learner.optimizer.init(parameters))

    @jax.jit
    def run(learnt, key):
        def step(learnt, key):
            real, made = (sign + 0.5 * jax.random.normal(key, (128,)) for sign, key in zip((1, -1), jax.random.split(key), strict=True))
            return train_iteration.update_once(learner, learnt, make_pairs(real), make_pairs(made))

        return jax.lax.scan(step, learnt, jax.random.split(key, 400))

    learnt, metrics = run(learnt, jax.random.key(1))
    assert metrics["expert_accuracy"][-50:].mean() > 0.95 and metrics["policy_accuracy"][-50:].mean() > 0.95
    middle = np.array([-0.3, 0.0, 0.3])
    np.testing.assert_allclose(jax.jit(judge.score)(learnt.parameters, make_pairs(middle)), 8 * middle, atol=0.8)


def make_learner_constants(name):
    constants = train_iteration.ppo_iteration.make_constants(probe(), POLICY, ppo_config(gamma=GAMMA), None)[0]
    return train_iteration.Imitation(name, constants, make_discriminator(name), expert, make_numbers(), 2, 16, 1)


def test_probability_is_of_what_the_environment_makes_of_an_action():
    """The third number is not read; those beyond -1 and 1 are clipped; and all that can be made has the probability 1."""
    action, mean, log_std = jnp.array([[0.2, -0.4, 0.9], [-1.3, 1.0, 0.0]]), jnp.array([0.3, 0.1, 0.0]), jnp.array([-0.5, 0.2, -9.0])
    found = train_iteration.find_density(make_learner_constants("airl"), action, jnp.broadcast_to(mean, action.shape), log_std)
    one, other = (stats.norm(mean[index], np.exp(log_std[index])) for index in (0, 1))
    expected = [one.logpdf(0.2) + other.logpdf(-0.4), one.logcdf(-1.0) + other.logsf(1.0)]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    inside = np.linspace(-0.99999, 0.99999, 2001, dtype=np.float32)
    of_all = np.exp(clipped_log_probability(jnp.array([*inside, -1.0, 1.0])[:, None], jnp.full((2003, 1), 0.3), jnp.zeros(1)))
    assert np.trapezoid(of_all[:-2], inside) + of_all[-2:].sum() == pytest.approx(1.0, abs=1e-4)


@pytest.fixture(scope="module")
def course():
    """Learner -> its trainer on the probes, compiled once."""
    return functools.lru_cache(make_learner)


@pytest.mark.ci
@pytest.mark.parametrize("name", slow_except(["gail", "airl"], "gail"))
def test_the_policy_does_as_the_expert_from_what_is_observed(course, name):
    """The environment pays for something else; no action of the expert is shown to the policy."""
    learner, stage = course(name), scenes(WORLDS, 1)
    state = learner.init(jax.random.key(0), stage)
    for _ in range(ITERATIONS):
        state, metrics = learner.train_iteration(state, stage)
    action = jax.jit(POLICY.apply)(get_policy_parameters(state), {"cue": jnp.array([[-1.0, 0.0], [1.0, 0.0]])})[0]
    np.testing.assert_allclose(action[:, 0], [-0.5, 0.5], atol=0.2)
    assert all(np.isfinite(float(value)) for value in metrics.values()) and metrics[f"{name}/skipped"] == 0.0
    assert float(metrics["reward"]) == 1.0 != float(metrics[f"{name}/reward"])


@pytest.mark.parametrize("name", slow_except(["gail", "airl"], "gail"))
def test_a_killed_and_resumed_run_is_the_unbroken_one(course, name, tmp_path):
    learner, stage = course(name), scenes(WORLDS, 1)
    check_resumed_is_unbroken(learner, stage, tmp_path)


def test_only_pairs_of_the_expert_that_are_known_are_stored(course):
    """16 steps of 8 worlds with 2 agents, of whom the second is not known where its cue is -1; empty slots are not stored."""
    learner, stage = course("gail"), scenes(WORLDS, 1)
    state, metrics = learner.train_iteration(learner.init(jax.random.key(0), stage), stage)
    kept, filled = state.buffer["gail"].rows, int(metrics["gail/buffer"])
    assert 16 * WORLDS < filled < 2 * 16 * WORLDS
    cue, action = (np.asarray(leaf)[0, :filled] for leaf in (kept["observation"]["cue"][..., 0], kept["action"]))
    np.testing.assert_allclose(action, np.stack([0.5 * cue, np.full_like(cue, STEERS)], axis=-1))
    follows = np.asarray(kept["follows"])[0, :filled]
    np.testing.assert_allclose(np.asarray(kept["next_observation"]["cue"])[0, :filled][follows, 1], 0.5 * cue[follows])
    assert 0.6 < follows.mean() < 0.72  # two of three steps


@pytest.mark.slow
def test_an_episode_that_does_not_fit_is_thinned():
    learner, stage = make_learner_constants("gail"), scenes(WORLDS, 1)
    worlds = trainer.start_worlds(probe(), jax.random.key(0), stage)
    row = off_policy.describe_row(functools.partial(train_iteration.make_rows, learner), worlds)
    empty = replay_buffer.make_empty(row, groups=1, capacity=96)
    buffer = jax.jit(functools.partial(train_iteration.drive_expert, learner))(stage, jax.random.key(0), empty)
    assert 30 < int(buffer.filled[0]) < 70  # a quarter of 16 x 24 slots, of which half are known agents: 48


@pytest.mark.parametrize("name", ["gail", "airl"])
def test_configs_are_valid(name):
    config = configs.load_config("train", f"learner={name}")
    numbers = off_policy.read_numbers(config, AdversarialConfig)
    assert (numbers.learning_rate, numbers.passes) == {"gail": (5e-5, 1), "airl": (3e-4, 5)}[name]
    assert (numbers.l2, numbers.batch) == (1e-5, 1024)


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="policy: learner gail needs one with an encoder; valid: policy=late_fusion, policy=actor_critic"):
        gail.make_discriminator(Policy(POLICY.init, POLICY.apply), make_numbers())
    with pytest.raises(ConfigError, match=r"learner\.buffer: expected at least 24, 8 worlds x 3 agents, got 20"):
        make_learner("gail", buffer=20).init(jax.random.key(0), scenes(WORLDS))
    with pytest.raises(ConfigError, match=r"learner\.passes: expected"):
        make_numbers(passes=0)
