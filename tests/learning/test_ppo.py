"""PPO: advantages, loss and minibatches against plain arithmetic; then five probe environments."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.choosing import slow_except
from support.probes import NUMBERS, PRESENT, SMALL, make_trainer, ppo_config, probe, scenes

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Env, State
from scenefactory_jax.learning import gaussian, rollout
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.ppo import gae, loss, minibatches, train_iteration
from scenefactory_jax.learning.ppo.config import PPOConfig
from scenefactory_jax.learning.ppo.train_iteration import PPO
from scenefactory_jax.learning.trainer import TrainState, count_spawned_steps

pytestmark = pytest.mark.usefixtures("quickly")

T, W, A = 12, 2, 3
WORLDS = 8


def test_advantages_equal_a_plain_loop():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, T, W, A)).astype(np.float32)
    bootstrap = rng.normal(size=(W, A)).astype(np.float32)
    active, done, truncated = (rng.random((T, W, A)) < share for share in (0.8, 0.2, 0.2))
    estimate = jax.jit(functools.partial(gae.compute_gae, gamma=0.9, gae_lambda=0.8))
    advantage, returns = estimate(reward, value, bootstrap, active, done, truncated)

    expected = np.zeros((T, W, A))
    for index in np.ndindex(W, A):
        following, carried = float(bootstrap[index]), 0.0
        for t in reversed(range(T)):
            at = (t, *index)
            if done[at] or not active[at]:
                carried = float(reward[at]) * bool(active[at]) - float(value[at])
            elif truncated[at]:
                carried = 0.0
            else:
                carried = float(reward[at]) + 0.9 * following - float(value[at]) + 0.9 * 0.8 * carried
            following, expected[at] = float(value[at]), carried
    np.testing.assert_allclose(advantage, expected, atol=1e-5)
    np.testing.assert_allclose(returns, expected + np.asarray(value), atol=1e-5)


def test_gaussians_agree_with_their_definitions():
    action, mean, other = np.random.default_rng(1).normal(size=(3, 4, 3)).astype(np.float32)
    log_std, log_std_old = np.float32([-0.5, 0.0, 0.4]), np.float32([-0.2, 0.1, 0.3])
    log_probability, kl_divergence = jax.jit(gaussian.log_probability), jax.jit(gaussian.kl_divergence)
    expected = stats.norm.logpdf(action, mean, np.exp(log_std)).sum(-1)
    np.testing.assert_allclose(log_probability(action, mean, log_std), expected, rtol=1e-5)

    draws = other + np.exp(log_std_old) * np.random.default_rng(2).normal(size=(20_000, 4, 3)).astype(np.float32)
    own = np.asarray(log_probability(draws, np.broadcast_to(other, draws.shape), log_std_old))
    difference = own - np.asarray(log_probability(draws, np.broadcast_to(mean, draws.shape), log_std))
    np.testing.assert_allclose(kl_divergence(other, log_std_old, mean, log_std), difference.mean(0), rtol=0.05)
    np.testing.assert_allclose(jax.jit(gaussian.entropy)(log_std_old), -own.mean(), rtol=0.01)
    assert np.abs(kl_divergence(mean, log_std, mean, log_std)).max() == 0.0


@pytest.fixture(scope="module", params=slow_except([False, True], True))
def batch(request):
    """Policy, parameters and samples; every third one without weight."""
    policy, count = late_fusion.make(**SMALL | {"actor_head_scale": 0.5}, state_dependent_std=request.param), 24

    @jax.jit
    def draw(key):
        keys = jax.random.split(key, 8)
        observation = {"cue": jax.random.normal(keys[0], (count, 1))}
        parameters = policy.init(keys[1], observation)
        mean, log_std, value = policy.apply(parameters, observation)
        action = mean + jnp.exp(log_std) * jax.random.normal(keys[2], mean.shape)
        old = mean + 0.1 * jax.random.normal(keys[3], mean.shape)
        samples = loss.Batch(
            observation=observation,
            action=action,
            mean=old,
            log_std=jnp.broadcast_to(log_std, old.shape),
            log_probability=gaussian.log_probability(action, old, log_std),
            value=value + 0.3 * jax.random.normal(keys[4], value.shape),
            advantage=jax.random.normal(keys[5], value.shape),
            returns=jax.random.normal(keys[6], value.shape),
            weight=(jnp.arange(count) % 3 > 0).astype(jnp.float32),
        )
        return parameters, samples

    return policy, *draw(jax.random.key(3))


def test_loss_equals_its_definition(batch):
    policy, parameters, samples = batch
    config = ppo_config(ent_coef=0.01, vf_coef=0.5)
    total, metrics = jax.jit(functools.partial(loss.compute_loss, policy=policy, config=config))(parameters, samples)
    mean, log_std, estimate = (np.asarray(x, float) for x in jax.jit(policy.apply)(parameters, samples.observation))
    log_std = np.broadcast_to(log_std, mean.shape)
    samples = jax.device_get(samples)
    surrogates, values = [], []
    for i in np.flatnonzero(np.asarray(samples.weight)):
        now = stats.norm.logpdf(samples.action[i], mean[i], np.exp(log_std[i])).sum()
        ratio, gain = np.exp(now - samples.log_probability[i]), float(samples.advantage[i])
        surrogates.append(min(ratio * gain, np.clip(ratio, 0.8, 1.2) * gain))
        old, target = float(samples.value[i]), float(samples.returns[i])
        values.append(max((estimate[i] - target) ** 2, (old + np.clip(estimate[i] - old, -0.2, 0.2) - target) ** 2))
    entropy = 3 * 0.5 * np.log(2 * np.pi * np.e) + log_std[np.asarray(samples.weight) > 0].sum(-1).mean()
    np.testing.assert_allclose(total, -np.mean(surrogates) + 0.5 * np.mean(values) - 0.01 * entropy, rtol=1e-4)
    assert 0.0 < float(metrics["clip_fraction"]) < 1.0


def test_samples_without_weight_change_nothing(batch):
    policy, parameters, samples = batch
    empty, number = np.asarray(samples.weight == 0), lambda *arguments: jax.device_put(np.where(*arguments).astype(np.float32))
    garbage = dataclasses.replace(
        samples,
        observation={"cue": number(empty[:, None], 9.0, samples.observation["cue"])},
        action=number(empty[:, None], 50.0, samples.action),
        advantage=number(empty, np.nan, samples.advantage),
        returns=number(empty, 1e6, samples.returns),
    )
    gradient = jax.jit(jax.grad(lambda p, b: loss.compute_loss(p, b, policy=policy, config=ppo_config(ent_coef=0.01))[0]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), gradient(parameters, garbage), gradient(parameters, samples))
    normalize, mean = jax.jit(loss.normalize_advantages), jax.jit(loss.weighted_mean)
    weight, none = samples.weight, np.zeros(24, np.float32)
    normal = np.asarray(normalize(garbage.advantage, weight))
    np.testing.assert_allclose([mean(normal, weight), mean(normal**2, weight)], [0, 1], atol=1e-5)
    assert float(mean(garbage.returns, none)) == 0.0
    assert not np.asarray(normalize(garbage.returns, none)).any()


def test_empty_slots_and_truncated_samples_have_no_weight():
    rng, none = np.random.default_rng(0), jnp.zeros((T, W, A))
    active, truncated = (jnp.asarray(rng.random((T, W, A)) < share) for share in (0.7, 0.3))
    observation, pair = {"cue": none[..., None]}, jnp.zeros((T, W, A, 3))
    samples = unchecked(  # with the axis of time before that of worlds
        rollout.Sample, observation=observation, action=pair, mean=pair, log_std=pair, log_probability=none, value=none, reward=none,
        active=active, terminated=jnp.zeros((T, W, A), bool), truncated=truncated, position=pair[..., :2],
    )  # fmt: skip
    ppo = PPO(probe(), late_fusion.make(**SMALL), ppo_config())
    batch = jax.jit(lambda samples: train_iteration.compute_batch(ppo, samples, samples.value[0]))(samples)
    np.testing.assert_array_equal(batch.weight, np.ravel(np.asarray(active) & ~np.asarray(truncated)))


def test_minibatches_are_disjoint_and_share_the_active_samples_evenly():
    weight = (np.random.default_rng(4).random(96) < 0.4).astype(np.float32)
    split = lambda size: np.asarray(  # noqa: E731
        jax.jit(functools.partial(minibatches.split_minibatches, minibatches=4, size=size))(jax.random.key(5), weight)
    )
    whole, part = split(24), split(12)
    assert sorted(whole.reshape(-1).tolist()) == list(range(96))
    assert np.ptp(weight[whole].sum(1)) <= 1
    assert len(set(part.reshape(-1).tolist())) == 48 and float(weight[part].sum()) == float(weight.sum())


def test_left_out_samples_are_counted_for_each_group():
    """Of 12 active samples in the first half and 2 in the second, two minibatches of 3 from each half hold 6 and 2."""
    weight = (jnp.arange(24) < 14).astype(jnp.float32)
    assert float(minibatches.count_left_out(weight, weight.sum(), size=12, groups=2, axis=None)) == pytest.approx(6 / 14)
    assert float(minibatches.count_left_out(weight, jnp.float32(28.0), size=12, groups=2, axis=None)) == pytest.approx(20 / 28)


def test_minibatches_hold_the_largest_advantages():
    """Of each of two groups of 24 samples the 8 largest that have weight; of a group with fewer samples all."""
    rng = np.random.default_rng(7)
    advantage, weight = rng.normal(size=48).astype(np.float32), (rng.random(48) < 0.7).astype(np.float32)
    weight[24:] = np.arange(24) < 5
    chosen = np.asarray(minibatches.select_largest(jnp.asarray(weight), jnp.asarray(advantage), count=16, groups=2))
    for part in (slice(0, 24), slice(24, 48)):
        order = np.argsort(-np.where(weight[part] > 0, np.abs(advantage[part]), -1.0))
        assert sorted(np.flatnonzero(chosen[part])) == sorted(order[: min(8, int(weight[part].sum()))])
    split = minibatches.split_minibatches(jax.random.key(0), jnp.asarray(chosen), minibatches=2, size=8, groups=2)
    assert chosen[np.asarray(split)].sum() == 13
    config = ppo_config(advantage_fraction=0.25, horizon=16, minibatches=2)
    assert minibatches.minibatch_size(config, (4, 3), groups=2) == 24


def test_minibatches_that_are_not_finite_are_skipped_and_counted(batch):
    """Two minibatches of 12."""
    policy, parameters, samples = batch
    ppo = PPO(probe(), policy, ppo_config(epochs=1, minibatches=2, desired_kl=0.01, learning_rate=1e-3, permutation="once"))
    train_state = unchecked(TrainState, parameters=parameters, optimizer=ppo.optimizer.init(parameters), iteration=jnp.int32(0))
    learn = jax.jit(lambda samples: train_iteration.update_epochs(ppo, train_state, samples, jax.random.key(6), size=12))
    broken = dataclasses.replace(samples, returns=samples.returns.at[1].set(jnp.nan))  # in one of the two minibatches
    after, state, metrics = learn(broken)
    assert float(metrics["skipped"]) == 1.0 and int(state[-1].count) == 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, metrics)))
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(parameters), strict=True))

    after, _, metrics = learn(dataclasses.replace(samples, weight=jnp.zeros(24)))
    jax.tree.map(np.testing.assert_array_equal, after, parameters)
    assert float(metrics["skipped"]) == 0.0

    after, state, metrics = learn(samples)
    rate = adapted(ppo.config, 1e-3, metrics["kl"], 1e-2)
    assert float(metrics["learning_rate"]) == float(state[-1].hyperparams["learning_rate"]) != pytest.approx(1e-3)
    assert float(rate) == pytest.approx(1.5e-3 if metrics["kl"] < 0.005 else 1e-3 / 1.5 if metrics["kl"] > 0.02 else 1e-3)


def adapted(config, rate, kl, max_rate=1e-2):
    return float(train_iteration.adapt_learning_rate(config, jnp.float32(rate), jnp.float32(kl), jnp.float32(max_rate)))


def test_learning_rate_follows_the_divergence():
    config = ppo_config(learning_rate=1e-3, desired_kl=0.01)
    rates = [adapted(config, 1e-3, kl, 1.2e-3) for kl in (0.0, 0.004, 0.006, 0.019, 0.021)]
    np.testing.assert_allclose(rates, [1e-3, 1.2e-3, 1e-3, 1e-3, 1e-3 / 1.5], rtol=1e-5)
    assert adapted(config, 1e-3, 0.001, 1e-2) == pytest.approx(1.5e-3)
    low = ppo_config(learning_rate=1e-3, learning_rate_min=9e-4, desired_kl=0.01)
    assert adapted(low, 1e-3, 0.1, 1e-2) == pytest.approx(9e-4)
    assert adapted(ppo_config(), 1e-3, 9.0, 1e-4) == pytest.approx(1e-3)  # constant without `desired_kl`


def test_the_largest_learning_rate_falls_as_one_over_time():
    """A half after `learning_rate_half_life` iterations, a third after twice as many; it bounds a rate that nothing adapts, too."""
    config = ppo_config(learning_rate=8e-4, learning_rate_max=8e-4, learning_rate_half_life=10.0)
    rates = [float(train_iteration.max_learning_rate(config, jnp.int32(iteration))) for iteration in (0, 10, 20, 70, 10**6)]
    np.testing.assert_allclose(rates, [8e-4, 4e-4, 8e-4 / 3, 1e-4, 1e-5], rtol=1e-5)
    assert train_iteration.max_learning_rate(ppo_config(), jnp.int32(10)) == NUMBERS["learning_rate_max"]
    assert adapted(config, 8e-4, 0.0, 2e-4) == pytest.approx(2e-4)


def counted(env: Env):
    """The environment, and how often its transition was traced."""
    traces = []

    def control_step(scene, state, action):
        traces.append(1)
        return env.control_step(scene, state, action)

    return env._replace(control_step=control_step), traces


@pytest.fixture(scope="module")
def course():
    """Agents who would live 5 steps in worlds of 4: all run out of time."""
    env, traces = counted(probe(life=5, episode_steps=4))
    return make_trainer(env, episode_steps=4, desired_kl=0.01, stagger_episodes=True), traces


def run(trainer, stage, iterations, seed=0):
    train_state, history = trainer.init(jax.random.key(seed), stage), []
    for _ in range(iterations):
        train_state, metrics = trainer.train_iteration(train_state, stage)
        history.append(jax.device_get(metrics))
    return train_state, history


def unkeyed(state):
    """With the numbers of its key, which NumPy can compare."""
    return unchecked(State, **vars(state) | {"key": jax.random.key_data(state.key)})


def test_one_trace_same_seed_same_numbers_and_scenes_survive_donation(course):
    trainer, traces = course
    stage = scenes(WORLDS)
    first, history = run(trainer, stage, 3)
    second, _ = run(trainer, stage, 3)
    other = jax.tree.map(lambda x: jax.device_put(np.asarray(x) + np.ones_like(x)), stage)
    trainer.train_iteration(second, other)
    assert len(traces) <= 2  # the scan traces its body once, or twice to settle the carry; never again in later iterations
    stage.agents.position.block_until_ready()
    again, _ = run(trainer, stage, 3)
    plain = jax.jit(lambda state: (state.parameters, dataclasses.replace(state.worlds, state=unkeyed(state.worlds.state))))
    jax.tree.map(np.testing.assert_array_equal, plain(first), plain(again))
    assert all(np.isfinite(value) for metrics in history for value in metrics.values())
    assert count_spawned_steps(first) == 3 * 16 * WORLDS * int(PRESENT.sum()) and int(first.iteration) == 3


def test_metrics_count_what_happened(course):
    trainer, _ = course
    _, history = run(trainer, scenes(WORLDS), 2)
    metrics = {name: float(value) for name, value in history[-1].items()}
    assert metrics["steps/spawned"] == 16 * WORLDS * 2 and metrics["active_fraction"] == 1.0
    assert metrics["reward"] == pytest.approx(metrics["reward/paid"]) and -4.0 < metrics["reward"] < 0.0
    assert metrics["count/episodes"] == 16 * WORLDS * 2 / 4 and metrics["episode/steps"] == 4.0  # worlds end before the agents do
    assert metrics["episode/return"] == pytest.approx(4 * metrics["reward"], abs=0.3)
    assert metrics["events/goal_reached"] == 0.0 and metrics["speed"] == 2.0 and metrics["ppo/skipped"] == 0.0


@pytest.mark.parametrize("life, length", slow_except([(5, 100), (100, 6)], (100, 6)))
def test_a_repeated_action_is_one_sample(life, length):
    """Lives of 5 control steps end within the second action; worlds of 6 run out of time with it. What slots pay afterwards is nobody's."""
    env, policy, stage = probe(life=life, episode_steps=length)._replace(action_repeat=3), late_fusion.make(**SMALL), scenes(2, 1)

    @jax.jit
    def start(stage):
        worlds = jax.vmap(env.init_state)(jax.random.split(jax.random.key(0), 2), stage)
        observed = jax.vmap(env.observe)(stage, worlds)
        return policy.init(jax.random.key(1), observed), rollout.Worlds(worlds, observed, rollout.make_empty_episode_stats(worlds))

    parameters, begin = start(stage)
    collect = jax.jit(functools.partial(rollout.collect_rollout, env, policy, horizon=4))
    after, *found = collect(parameters, stage, begin, jax.random.key(2))
    samples, tally, record = jax.device_get(found)
    lived = min(life, length)
    held = samples.active[..., :2]
    assert held.all() and not samples.active[..., 2].any()
    np.testing.assert_array_equal(samples.reward[:, 0, 0], [3, lived - 3, 3, lived - 3])
    assert float(samples.reward[..., 2].sum()) == 0.0
    ends = np.array([False, True, False, True])
    assert (samples.terminated[..., 0] == (ends & (life < length))[:, None]).all() and not samples.terminated[..., 2].any()
    assert (samples.truncated[..., 1] == (ends & (life > length))[:, None]).all()
    assert {name: float(tally[name]) for name in ("spawned", "active", "ended", "length", "return")} == {
        "spawned": 2 * 2 * 12, "active": 2 * 2 * 2 * lived, "ended": 8, "length": 8 * lived, "return": 8 * lived}  # fmt: skip
    assert record.episodes.tolist() == [4, 4] and not np.any(after.episode_stats.steps) and (np.asarray(after.state.step) == 0).all()


def test_worlds_start_at_whole_actions():
    env = probe(life=5, episode_steps=12)._replace(action_repeat=3)
    trainer = make_trainer(env, episode_steps=12, stagger_episodes=True)
    steps = np.asarray(trainer.init(jax.random.key(0), scenes(64)).worlds.state.step)
    assert set(steps.tolist()) == {0, 3, 6, 9}


def test_restart_keeps_parameters(course):
    trainer, _ = course
    stage = scenes(WORLDS)
    train_state, _ = run(trainer, stage, 1)
    learnt = jax.tree.map(np.asarray, train_state.parameters)
    train_state = trainer.restart(train_state, stage)
    jax.tree.map(np.testing.assert_array_equal, learnt, train_state.parameters)
    assert (
        len(set(train_state.worlds.state.step.tolist())) > 1 and not train_state.worlds.episode_stats.steps.any()
    )  # at random phases of 4 steps


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match=r"16 x 8 worlds x 3 agents = 384 samples .* 7 minibatches"):
        make_trainer(probe(), minibatches=7).init(jax.random.key(0), scenes(WORLDS))
    with pytest.raises(ConfigError, match=r"ppo\.learning_rate: expected a number in .* = \[1e-05, 0.01\], got 1\.0"):
        ppo_config(learning_rate=1.0)
    wrong = {"gamma": 1.5, "desired_kl": -0.01, "value_clip": 0.0, "ent_coef": float("nan"), "vf_coef": -1.0, "max_grad_norm": 0.0}
    wrong |= {"sample_fraction": 1.1, "advantage_fraction": 0.0}
    for name, value in {**wrong, "horizon": 0, "epochs": 1.5, "permutation": "never"}.items():
        with pytest.raises(ConfigError, match=rf"ppo\.{name}: expected .*, got {value!r}"):
            ppo_config(**{name: value})


@pytest.mark.parametrize("name", ["paper", "demo", "steady", "short", "smoke"])
def test_configs_are_valid(name):
    assert schema.read(configs.load_config("train", f"ppo={name}")["ppo"], PPOConfig, where="ppo").horizon > 0


@pytest.fixture(scope="module")
def probes():
    """One compiled trainer for all probes: task -> (action mean and value for cues, metrics of every iteration)."""
    policy = late_fusion.make(**SMALL)
    trainer = make_trainer(probe(), sample_fraction=0.75)  # two of three slots are spawned
    apply = jax.jit(policy.apply)

    def train_on(task, iterations):
        train_state, history = run(trainer, scenes(2 * WORLDS, task), iterations)

        def look(*cues):
            mean, _, value = apply(train_state.parameters, {"cue": jnp.array(cues, jnp.float32)[:, None]})
            return mean[:, 0], value

        return look, history

    return train_on


def test_probe_1_value(probes):
    look, _ = probes(1, 25)
    np.testing.assert_allclose(look(0.0)[1], [1.0], atol=0.05)


def test_probe_2_value_of_the_observation(probes):
    look, history = probes(2, 25)
    np.testing.assert_allclose(look(-1.0, 1.0)[1], [-1.0, 1.0], atol=0.05)
    assert float(history[-1]["ppo/explained_variance"]) > 0.95


def test_probe_3_value_of_a_later_reward(probes):
    look, _ = probes(3, 25)
    np.testing.assert_allclose(look(0.0, 1.0)[1], [NUMBERS["gamma"], 1.0], atol=0.05)


def test_probe_4_action(probes):
    look, _ = probes(4, 40)
    np.testing.assert_allclose(look(0.0)[0], [0.5], atol=0.1)


def test_probe_5_action_that_depends_on_the_observation(probes):
    look, history = probes(5, 40)
    np.testing.assert_allclose(look(-1.0, 1.0)[0], [-0.5, 0.5], atol=0.1)
    assert float(history[-1]["reward"]) > float(history[0]["reward"]) + 0.1
    assert float(history[-1]["ppo/left_out"]) == 0.0


@pytest.mark.parametrize("kept, groups", slow_except([(5, 1), (3, 2), (1, 2)], (3, 2)))
def test_a_rollout_keeps_active_agents_first(course, kept, groups):
    """Rows with weight are rows of the whole rollout, all or as many as there is room for; what finds no room is counted."""
    policy, env, stage = late_fusion.make(**SMALL), probe(life=5, episode_steps=4), scenes(WORLDS)
    train_state = course[0].init(jax.random.key(0), stage)
    collect = functools.partial(rollout.collect_rollout, env, policy, train_state.parameters, stage, train_state.worlds, horizon=3)
    part = {"kept": kept * WORLDS // groups, "groups": groups}
    ppo = PPO(env, policy, ppo_config(normalize_advantages=False), groups=groups)

    @jax.jit
    def both(key):
        made = [collect(key)[1], collect(key, **part)[1]]
        batches = [train_iteration.make_batch(ppo, samples, samples.reward, samples.value) for samples in made]
        total = train_iteration.find_weight(made[1]).sum()
        left_out = minibatches.count_left_out(batches[1].weight, total, size=len(batches[1].weight), groups=groups, axis=None)
        return *batches, left_out

    whole, fewer, left_out = jax.device_get(both(jax.random.key(1)))
    number = np.minimum(whole.weight.reshape(3 * groups, -1).sum(1), part["kept"]).sum()
    assert fewer.weight.sum() == number > 0 and len(fewer.weight) == 3 * groups * part["kept"]
    assert left_out == pytest.approx(1 - number / whole.weight.sum()) and (left_out > 0) == (kept == 1)

    def list_rows(batch):
        weighted = [leaf[batch.weight > 0].reshape(int(batch.weight.sum()), -1) for leaf in jax.tree.leaves(batch)]
        return {tuple(row) for row in np.concatenate(weighted, axis=1)}

    assert len(list_rows(whole)) == whole.weight.sum() and len(list_rows(fewer)) == number and list_rows(fewer) <= list_rows(whole)


def test_rewards_are_scaled_for_the_learner(course):
    """With values in proportion, advantages and returns are."""
    policy, env, stage = late_fusion.make(**SMALL), probe(life=5, episode_steps=4), scenes(WORLDS)
    train_state = course[0].init(jax.random.key(0), stage)
    plain, scaled = (
        PPO(env, policy, ppo_config(horizon=2, normalize_advantages=False, **given)) for given in ({}, {"reward_scaling": 0.25})
    )

    @jax.jit
    def compute(key):
        samples = train_iteration.collect(plain, train_state, stage, key).samples
        samples = unchecked(rollout.Sample, **vars(samples) | {"value": jnp.zeros_like(samples.value)})
        last = jnp.ones(samples.value.shape[1:])
        return train_iteration.compute_batch(plain, samples, 4.0 * last), train_iteration.compute_batch(scaled, samples, last)

    one, other = compute(jax.random.key(1))
    assert jnp.any(one.returns != 0.0)
    for name in ("advantage", "returns"):
        np.testing.assert_allclose(getattr(other, name), 0.25 * getattr(one, name), rtol=1e-6)


@pytest.mark.slow
def test_a_rollout_in_float16_holds_what_the_policy_saw(course):
    """Half the memory; a minibatch has it as float32 again."""
    policy, env, stage = late_fusion.make(**SMALL), probe(life=5, episode_steps=4), scenes(WORLDS)
    train_state = course[0].init(jax.random.key(0), stage)
    collect = functools.partial(rollout.collect_rollout, env, policy, horizon=2, storage="float16")
    _, samples, _, _ = jax.jit(collect)(train_state.parameters, stage, train_state.worlds, jax.random.key(1))
    assert samples.observation["cue"].dtype == jnp.float16
    ppo = PPO(env, policy, ppo_config())
    batch = train_iteration.make_batch(ppo, samples, samples.reward, samples.value)
    taken = loss.take_minibatch(batch, jnp.arange(len(batch.weight)))
    assert taken.observation["cue"].dtype == jnp.float32
    np.testing.assert_allclose(policy.apply(train_state.parameters, taken.observation)[0], taken.mean, atol=1e-6)
