"""Learners off policy: losses against arithmetic by hand, then for each learner its probes, resumption and the samples that it takes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support.choosing import slow_except
from support.probes import LEARNERS, SMALL, STEERS, make_learner, probe, scenes
from support.resuming import check_resumed_is_unbroken

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import checkpoint, critics, gaussian, off_policy, rollout, trainer
from scenefactory_jax.learning.bc import loss as bc_loss
from scenefactory_jax.learning.bc.config import BCConfig
from scenefactory_jax.learning.bc_sac.config import BCSACConfig
from scenefactory_jax.learning.expert import set_action_time
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.networks.heads import Network
from scenefactory_jax.learning.networks.squashed import Networks
from scenefactory_jax.learning.ppo import train_iteration as ppo
from scenefactory_jax.learning.sac import loss as sac_loss
from scenefactory_jax.learning.sac import train_iteration as sac
from scenefactory_jax.learning.sac.config import SACConfig
from scenefactory_jax.learning.td3 import loss as td3_loss
from scenefactory_jax.learning.td3 import train_iteration as td3
from scenefactory_jax.learning.td3.config import TD3Config
from scenefactory_jax.learning.trainer import get_policy_parameters

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS = 8
KINDS = {"sac": SACConfig, "td3": TD3Config, "bc": BCConfig, "bc_sac": BCSACConfig}

# A policy and two critics of one number: mean p x, deviation 0.5; values c0 (x + a), c1 (x - a)
LINEAR = Networks(
    "tanh_gaussian",
    1,
    lambda p, seen: (p * seen["x"], jnp.full_like(seen["x"], 0.5)),
    Network(
        *[lambda c, seen, action: jnp.stack([c[0] * (seen["x"] + action)[..., 0], c[1] * (seen["x"] - action)[..., 0]])] * 2,
        read=lambda *_: None,
    ),
    encode=lambda *_: None,
    read=lambda *_: None,
)
SEEN, MADE, NOISE = (jnp.array(x)[:, None] for x in ([1.0, -2.0, 0.5], [0.2, -0.4, 0.9], [0.3, -1.0, 2.0]))
C, P, WEIGHT = jnp.array([1.5, -0.5]), jnp.float32(0.7), jnp.array([1.0, 1.0, 0.0])
SUMS = {"networks": LINEAR, "total": jnp.float32(2.0), "weight": WEIGHT}


def test_density_of_a_squashed_action():
    """It is a density: its integral over the actions is 1; and it is that of scipy's Gaussian over the slope of tanh."""
    action = np.linspace(-1, 1, 4001)[1:-1].astype(np.float32)[:, None]
    mean, std = np.full_like(action, 0.4), np.full_like(action, 0.6)
    find = jax.jit(gaussian.squashed_log_probability)
    found = np.asarray(find(np.arctanh(action), mean, std))
    assert np.trapezoid(np.exp(found), action[:, 0]) == pytest.approx(1.0, abs=1e-3)
    expected = stats.norm.logpdf(np.arctanh(action.astype(float)), 0.4, 0.6)[:, 0] - np.log(1 - action[:, 0].astype(float) ** 2)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    far = find(jnp.full((1, 1), 40.0), jnp.zeros((1, 1)), jnp.ones((1, 1)))
    assert float(far[0]) == pytest.approx(-800 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 40), rel=1e-5)  # where 1 - tanh^2 is 0
    np.testing.assert_allclose(jnp.tanh(gaussian.unsquash(jnp.array([-1.0, 0.5, 1.0]))), [-0.999, 0.5, 0.999], atol=1e-6)


def test_losses_of_sac_equal_their_definitions():
    raw = P * SEEN + 0.5 * NOISE
    action, density = np.tanh(raw)[:, 0], stats.norm.logpdf(raw, P * SEEN, 0.5)[:, 0] - np.log(1 - np.tanh(raw[:, 0]) ** 2)
    values = np.stack([1.5 * (SEEN[:, 0] + action), -0.5 * (SEEN[:, 0] - action)])
    total, metrics = sac_loss.compute_actor_loss(P, C, {"x": SEEN}, NOISE, alpha=jnp.float32(0.2), raw_penalty=0.1, **SUMS)
    expected = np.mean((0.2 * density - values.min(0) + 0.1 * (P * SEEN[:, 0]) ** 2)[:2])  # the third sample has no weight
    np.testing.assert_allclose([total, metrics["entropy"]], [expected, -density[:2].mean()], rtol=1e-5)

    target = sac_loss.compute_target(
        jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 0.0, 1.0]), *map(jnp.array, (values, density)), alpha=jnp.float32(0.2), gamma=0.9
    )
    aim = [1.0 + 0.9 * (values[:, 0].min() - 0.2 * density[0]), 2.0, 3.0 + 0.9 * (values[:, 2].min() - 0.2 * density[2])]
    np.testing.assert_allclose(target, aim, rtol=1e-5)
    found = critics.compute_critic_loss(C, {"observation": {"x": SEEN}, "action": MADE}, jnp.array(aim), **SUMS)[0]
    made = np.stack([1.5 * (SEEN + MADE), -0.5 * (SEEN - MADE)])[..., 0]
    np.testing.assert_allclose(found, 0.5 * np.mean((made - np.array(aim))[:, :2] ** 2), rtol=1e-5)

    slope = jax.grad(sac_loss.compute_alpha_loss)
    slopes = [float(slope(jnp.log(0.2), jnp.float32(entropy), target=-2.0)) for entropy in (1.0, -3.0)]
    np.testing.assert_allclose(slopes, [0.2 * 3.0, -0.2], rtol=1e-5)  # with more entropy than its target alpha falls


def test_losses_of_td3_equal_their_definitions():
    smooth = td3_loss.smooth_action(jnp.array([0.0, 0.0, 0.95, -0.95]), jnp.array([1.0, 9.0, 9.0, -1.0]), std=0.2, clip=0.5)
    np.testing.assert_allclose(smooth, [0.2, 0.5, 1.0, -1.0], atol=1e-6)
    values = jnp.array([[1.0, 5.0], [2.0, 4.0]])
    target = td3_loss.compute_target(jnp.array([0.5, 0.5]), jnp.array([1.0, 0.0]), values, gamma=0.9)
    np.testing.assert_allclose(target, [0.5 + 0.9 * 1.0, 0.5])
    total, _ = td3_loss.compute_actor_loss(P, C, {"x": SEEN}, raw_penalty=0.1, **SUMS)
    np.testing.assert_allclose(total, np.mean((0.1 * (P * SEEN) ** 2 - 1.5 * (SEEN + np.tanh(P * SEEN)))[:2]), rtol=1e-6)
    slope = jax.grad(lambda p, penalty: td3_loss.compute_actor_loss(p, C, {"x": SEEN}, raw_penalty=penalty, **SUMS)[0])
    saturated = jnp.float32(100.0)  # tanh has no slope there: only the penalty leads the actor back
    assert float(slope(saturated, 0.0)) == 0.0 and float(slope(saturated, 1e-3)) > 0.0


def test_losses_of_cloning_equal_their_definitions():
    find = lambda kind: float(bc_loss.compute_loss(P, {"x": SEEN}, MADE, NOISE, kind=kind, **SUMS)[0])  # noqa: E731
    mean = P * SEEN
    assert find("squared_error") == pytest.approx(np.mean((np.tanh(mean) - MADE)[:2] ** 2))
    assert find("sampled_squared_error") == pytest.approx(np.mean((np.tanh(mean + 0.5 * NOISE) - MADE)[:2] ** 2))
    density = stats.norm.logpdf(np.arctanh(MADE), mean, 0.5) - np.log(1 - MADE**2)
    assert find("log_likelihood") == pytest.approx(-density[:2].mean(), rel=1e-5)


@pytest.fixture(scope="module")
def course():
    """Learner -> its policy, its trainer on the probes, and (state, two cues) -> (action, values of both critics); compiled once."""

    @functools.cache
    def make(name):
        policy, learner = make_learner(name, probe())

        @jax.jit
        def look(parameters, critics, cues):
            action = policy.apply(parameters, {"cue": cues})[0]
            found = [policy.networks.critic.apply(one, {"cue": cues}, action[:, :2]) for one in critics]
            return action, found[0] if found else None

        return policy, learner, lambda state, cues: look(
            get_policy_parameters(state), [one.critics for one in state.learner.values() if one], cues
        )

    return make


def train_on(course, name, task, iterations):
    """The train state, metrics of the last iteration, and (action, values of both critics) for cues."""
    _, learner, ask = course(name)
    stage, metrics = scenes(WORLDS, task), {}
    state = learner.init(jax.random.key(0), stage)
    for _ in range(iterations):
        state, metrics = learner.train_iteration(state, stage)

    return state, jax.device_get(metrics), lambda *cues: jax.device_get(ask(state, np.array(cues, np.float32)[:, None]))


@pytest.mark.slow  # probes 4 and 5 need values, too
@pytest.mark.parametrize("name", ["sac", "td3"])
def test_probes_1_to_3_values(course, name):
    np.testing.assert_allclose(train_on(course, name, 1, 30)[2](0.0, 0.0)[1], np.ones((2, 2)), atol=0.05)
    np.testing.assert_allclose(train_on(course, name, 2, 40)[2](-1.0, 1.0)[1], [[-1.0, 1.0]] * 2, atol=0.05)
    np.testing.assert_allclose(train_on(course, name, 3, 40)[2](0.0, 1.0)[1], [[0.9, 1.0]] * 2, atol=0.06)  # alpha pays for entropy


@pytest.mark.ci
@pytest.mark.parametrize("name", slow_except(["sac", "td3"], "sac"))
def test_probe_4_action(course, name):
    np.testing.assert_allclose(train_on(course, name, 4, 40)[2](0.0, 0.0)[0][:, 0], [0.5, 0.5], atol=0.12)


@pytest.mark.parametrize("name", slow_except(LEARNERS, "sac"))
def test_probe_5_action_that_depends_on_the_observation(course, name):
    """Learners that imitate steer, too, as the expert does; what it does where that is not known they do not learn."""
    _, metrics, look = train_on(course, name, 5, 40)
    action = look(-1.0, 1.0)[0]
    np.testing.assert_allclose(action[:, 0], [-0.5, 0.5], atol=0.1)
    if name.startswith("bc"):
        np.testing.assert_allclose(action[:, 1], STEERS, atol=0.1)
    assert not action[:, 2].any()  # actions of two numbers
    assert metrics["steps/updates"] == 32.0 and metrics["steps/samples"] == 32.0 * 64
    assert all(np.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize("name", slow_except(LEARNERS, "sac"))
def test_a_killed_and_resumed_run_is_the_unbroken_one(course, name, tmp_path):
    learner, stage = course(name)[1], scenes(WORLDS)
    unbroken, _ = check_resumed_is_unbroken(learner, stage, tmp_path)
    parameters = checkpoint.restore_parameters(tmp_path / "0")
    jax.tree.map(np.testing.assert_array_equal, parameters, get_policy_parameters(unbroken))


@pytest.mark.slow  # of bc_sac, which no other fast test compiles
def test_the_running_mean_of_an_actor_is_evaluated(course):
    learner, stage = course("bc_sac")[1], scenes(WORLDS)
    state = learner.init(jax.random.key(0), stage)
    mean = jax.device_get(state.parameters)
    for weight in (0.0, 0.5, 0.5):
        state, _ = learner.train_iteration(state, stage)
        mean = jax.tree.map(lambda old, new, weight=weight: weight * old + (1 - weight) * new, mean, jax.device_get(state.parameters))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), get_policy_parameters(state), mean)
    assert any((leaf != last).any() for leaf, last in zip(jax.tree.leaves(mean), jax.tree.leaves(state.parameters), strict=True))


@pytest.mark.parametrize("life, length", [(3, 5), (3, 2)])
def test_samples_of_empty_slots_and_of_the_time_limit_are_not_stored(life, length):
    """Worlds end with their agents after 3 steps, or by the time limit after 2, in which each agent's second sample is cut."""
    env, stage = probe(life=life, episode_steps=length), scenes(2)

    @jax.jit
    def collect(stage):
        worlds = trainer.start_worlds(env, jax.random.key(0), stage)
        act = lambda scenes, worlds, key: (jnp.ones((2, 3, 3)), jnp.arange(6).reshape(2, 3) != 0)  # noqa: E731
        transitions = rollout.collect_transitions(env, act, stage, worlds, jax.random.key(1), steps=12)[1]
        rows, valid = off_policy.make_transition_rows(transitions, numbers=2, storage="float16")
        outcome = vars(transitions.outcome) | {"reward": transitions.outcome.reward.at[4, 1, 1].set(jnp.nan)}
        broken = unchecked(rollout.Transition, **vars(transitions) | {"outcome": unchecked(rollout.Outcome, **outcome)})
        return rows, valid, off_policy.make_transition_rows(broken, numbers=2, storage="float16")[1]

    rows, valid, left = jax.device_get(collect(stage))
    step = np.arange(12) % min(life, length)
    expected = np.ones((12, 2, 3), bool) & (step < min(life, length) - (length < life))[:, None, None]
    expected[..., 2] = False  # never spawned
    expected[:, 0, 0] = False  # not known
    np.testing.assert_array_equal(valid, expected)
    np.testing.assert_array_equal(rows["follows"][valid], np.broadcast_to((step < life - 1)[:, None, None], valid.shape)[valid])
    assert rows["action"].shape[-1] == 2 and rows["observation"]["cue"].dtype == np.float16
    assert valid[4, 1, 1] and not left[4, 1, 1] and (left == valid).sum() == valid.size - 1  # nor what is not finite


def test_critics_are_independent_and_targets_follow_them(course):
    policy, learner, _ = course("sac")
    stage = scenes(WORLDS)
    before = jax.device_get(learner.init(jax.random.key(0), stage).learner["sac"])
    for leaf in jax.tree.leaves(before.critics):
        assert leaf.shape[0] == 2 and (not leaf.any() or (leaf[0] != leaf[1]).any())  # biases begin as zeros
    observation, action = {"cue": jnp.ones((1, 1))}, jnp.zeros((1, 2))
    derive = jax.jit(jax.grad(lambda critics: policy.networks.critic.apply(critics, observation, action)[0].sum()))
    slope = jax.device_get(derive(before.critics))
    assert not any(leaf[1].any() for leaf in jax.tree.leaves(slope)) and any(leaf[0].any() for leaf in jax.tree.leaves(slope))
    moved = off_policy.move_towards({"x": jnp.float32(1.0)}, {"x": jnp.float32(3.0)}, 0.25)
    assert float(moved["x"]) == 1.5
    state, _ = learner.train_iteration(learner.init(jax.random.key(0), stage), stage)
    distance = lambda tree: max(float(np.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (tree, before.target)), strict=True))  # noqa: E731
    assert 0.0 < distance(state.learner["sac"].target) < distance(state.learner["sac"].critics)


@pytest.mark.slow
def test_the_actor_of_td3_waits():
    policy = late_fusion.make(**SMALL, actor="deterministic", numbers=2)
    learner = td3.make_learner(policy, schema.read({**LEARNERS["td3"], "policy_delay": 3}, TD3Config, where="learner"), None)
    cue = {"cue": jnp.ones((1, 4, 1))}
    one = jnp.ones((1, 4))
    rows = {"observation": cue, "next_observation": cue, "action": jnp.zeros((1, 4, 2)), "reward": one, "follows": one}
    learnt = [jax.jit(lambda key: learner.init(key, policy.init(key, cue), cue))(jax.random.key(0))]
    step = jax.jit(learner.update)
    for index in range(3):
        learnt.append(step(learnt[-1], rows, one, jax.random.key(index))[0])

    def stays(pick):
        same = lambda *both: all((a == b).all() for a, b in zip(*(jax.tree.leaves(jax.device_get(pick(one))) for one in both), strict=True))  # noqa: E731
        return [same(one, other) for one, other in itertools.pairwise(learnt)]

    for pick in (lambda x: x.parameters, lambda x: x.learner.target, lambda x: x.learner.target_actor):
        assert stays(pick) == [True, True, False]
    assert stays(lambda x: x.learner.critics) == [False, False, False]


@pytest.mark.slow
def test_each_network_of_sac_moves_by_its_own_loss():
    """Features of all three are computed in one pass; the steps are those of the two losses alone."""
    policy, config = late_fusion.make(**SMALL, actor="tanh_gaussian", numbers=2), schema.read(LEARNERS["sac"], SACConfig, where="learner")
    whole, networks = sac.SAC(policy, config), policy.networks
    draw = np.random.default_rng(0).normal
    cue, following = ({"cue": jnp.array(draw(size=(1, 4, 1)), jnp.float32)} for _ in range(2))
    rows = {"observation": cue, "next_observation": following, "action": jnp.tanh(jnp.array(draw(size=(1, 4, 2)), jnp.float32))}
    rows |= {"reward": jnp.ones((1, 4)), "follows": jnp.array([[True, True, False, True]])}
    weight, total = jnp.array([[1.0, 1.0, 1.0, 0.0]]), jnp.float32(3.0)

    @jax.jit
    def compare(key):
        learnt = sac.init(whole, key, policy.init(key, cue), cue)
        learnt = learnt._replace(learner=learnt.learner._replace(target=jax.tree.map(lambda leaf: 1.1 * leaf, learnt.learner.critics)))
        noise, next_noise = (rollout.sample_noise(one, rows["action"], None) for one in jax.random.split(key))
        action, density = sac_loss.sample_action(*networks.distribution(learnt.parameters, following), next_noise)
        values, numbers = networks.critic.apply(learnt.learner.target, following, action), {"alpha": jnp.float32(config.alpha)}
        aim = sac_loss.compute_target(rows["reward"], rows["follows"] * 1.0, values, density, gamma=config.gamma, **numbers)
        sums = {"weight": weight, "networks": networks, "total": total}
        of_critics = functools.partial(critics.compute_critic_loss, rows=rows, target=aim, **sums)
        of_actor = functools.partial(sac_loss.compute_actor_loss, critics=learnt.learner.critics, observation=cue, noise=noise, **sums)
        losses = functools.partial(of_actor, raw_penalty=0.0, **numbers), of_critics
        trees = learnt.parameters, learnt.learner.critics
        states = learnt.optimizer.actor, learnt.optimizer.critics
        steps = [off_policy.descend(*parts, None) for parts in zip(losses, whole.optimizers, trees, states, strict=False)]
        return sac.update(whole, learnt, rows, weight, key), steps

    (after, metrics), ((parameters, _, actor), (moved, _, critic)) = jax.device_get(compare(jax.random.key(3)))
    for found, expected in ((after.parameters, parameters), (after.learner.critics, moved)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), found, expected)
    alone = actor | {"actor_gradient_norm": actor["gradient_norm"]} | critic
    assert metrics.pop("alpha") == np.float32(config.alpha) and metrics.keys() == alone.keys()
    for name, value in metrics.items():
        np.testing.assert_allclose(value, alone[name], rtol=1e-4, atol=1e-6, err_msg=name)


@pytest.mark.slow  # test_ppo skips minibatches that are not finite
def test_an_update_that_is_not_finite_changes_nothing():
    policy = late_fusion.make(**SMALL, actor="tanh_gaussian", numbers=2)
    cue = {"cue": jnp.ones((1, 4, 1))}
    rows = {"observation": cue, "next_observation": cue, "action": jnp.zeros((1, 4, 2)), "follows": jnp.ones((1, 4))}
    learner = sac.make_learner(policy, schema.read(LEARNERS["sac"] | {"entropy_target": -1.0}, SACConfig, where="learner"), None)
    learnt = jax.jit(lambda key: learner.init(key, policy.init(key, cue), cue))(jax.random.key(0))
    step = jax.jit(learner.update)
    after, metrics = step(learnt, rows | {"reward": jnp.array([[1.0, jnp.nan, 1.0, 1.0]])}, jnp.ones((1, 4)), jax.random.key(2))
    assert not metrics["changed"]
    jax.tree.map(np.testing.assert_array_equal, after, learnt)
    masked, metrics = step(learnt, rows | {"reward": jnp.ones((1, 4))}, jnp.ones((1, 4)), jax.random.key(2))
    assert metrics["changed"] and float(masked.learner.log_alpha) != float(learnt.learner.log_alpha)


@pytest.mark.parametrize("name", list(LEARNERS))
def test_configs_are_valid(name):
    config = configs.load_config("train", f"learner={name}", "actions=acceleration")
    numbers = off_policy.read_numbers(config, KINDS[name])
    assert numbers.updates == 8 and config["actions"]["numbers"] == 2
    if name.startswith("bc"):
        groups = set_action_time(config["learner"]["expert"], config)["observations"]
        assert groups["log"]["action_s"] == config["actions"]["action_repeat"] / config["timing"]["control_hz"]


def test_mistakes_are_named(monkeypatch):
    stage = scenes(WORLDS)
    wrong = {
        r"learner\.horizon: expected a multiple of unroll 3, got 8": dict(unroll=3),
        r"learner\.updates_per_step: expected a whole number of updates in 2 steps, got 0\.7": dict(updates_per_step=0.7),
        r"learner\.learning_starts: expected at most the 16 transitions of the buffer, got 32": dict(buffer=16),
        r"learner\.shards: expected a multiple of 1 devices, got 0": dict(shards=0),
        r"learner\.batch: expected a multiple of 3 shards, got 64": dict(shards=3),
        r"learner\.alpha: expected a number > 0 where it is tuned \(entropy_target\), got 0": dict(alpha=0.0, entropy_target=-1.0),
        r"learner\.storage: expected one of float16, bfloat16, float32, got 'int8'": dict(storage="int8"),
    }
    for message, change in wrong.items():
        with pytest.raises(ConfigError, match=message):
            make_learner("sac", probe(), **change)
    with pytest.raises(ConfigError, match=r"learner\.loss: expected squared_error of an actor that is deterministic, got log_likelihood"):
        make_learner("bc", probe(), actor="deterministic", loss="log_likelihood")
    with pytest.raises(ConfigError, match=r"learner\.buffer: expected at least 48, unroll 2 x 8 worlds x 3 agents, got 40"):
        make_learner("sac", probe(), buffer=40)[1].init(jax.random.key(0), stage)
    with pytest.raises(ConfigError, match=r"worlds: expected a multiple of 16 shards, got 8"):
        make_learner("sac", probe(), shards=16)[1].init(jax.random.key(0), stage)
    with pytest.raises(ConfigError, match=r"policy: learner sac needs one with critics; valid: policy=late_fusion, policy=actor_critic"):
        sac.make_learner(late_fusion.make(**SMALL), schema.read(LEARNERS["sac"], SACConfig, where="learner"), None)
    with pytest.raises(ConfigError, match=r"learner\.gamma: unknown key; valid: _target_"):
        ppo.make({"learner": {"_target_": "x", "gamma": 0.9}}, probe(), late_fusion.make(**SMALL))
    monkeypatch.setattr("scenefactory_jax.learning.replay_buffer.measure_free_memory", lambda: 10_000)
    size = r"learner\.buffer: 512 transitions of 0\.021 kB take 1\.08e-05 GB of a device's memory, of which 1e-05 GB are free"
    with pytest.raises(ConfigError, match=rf"{size}: at most 476 fit"):
        make_learner("sac", probe())[1].init(jax.random.key(0), stage)
