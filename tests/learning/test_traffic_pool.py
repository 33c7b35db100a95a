"""A pool as background traffic: members are drawn by weight, each drives as it would alone, and past policies flow in as arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.policy_traffic import ABSENT, CONTEXT, STEPS, make, make_policy, save, simulate, street
from support.probes import SMALL, make_learner, make_trainer, probe_with_past, scenes
from support.running import smoke

from scenefactory_jax.cli import evaluate
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import traffic
from scenefactory_jax.evaluation import circumstances
from scenefactory_jax.learning import checkpoint, past_policies, policy_io, replay_buffer, training_loop
from scenefactory_jax.learning.networks import late_fusion

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two policies of one structure."""
    return [make_policy(tmp_path_factory.mktemp(f"seed_{seed}"), seed=seed) for seed in (0, 1)]


def make_pool(*members, config=None, **changes):
    entry = load_config("task", "traffic=pool")["traffic"] | {"members": [str(member) for member in members]} | changes
    return traffic.make(entry, config=config or {}, **CONTEXT)


@pytest.fixture(scope="module")
def pasts(runs):
    """(parameters of two policies, which there are) -> policies that were drawn in six worlds of a batch, and where their vehicles are."""
    pool, scene = make_pool("past", config=policy_io.load_policy(runs[0]).config), street()

    @jax.jit
    def run(parameters, there):
        bound = pool.past.bind(parameters, there)

        def drive(key):
            state = bound.init(key, scene, jnp.int32(0))
            move = lambda state, step: (bound.advance(scene, state, ABSENT, step), None)  # noqa: E731
            end, _ = jax.lax.scan(move, state, jnp.arange(STEPS))
            return state.state.driver, bound.read(scene, end, jnp.int32(STEPS)).position

        return jax.vmap(drive)(jax.random.split(jax.random.key(0), 6))

    return run


# ---- members


@pytest.mark.slow
def test_a_pool_of_one_policy_is_that_policy_bit_for_bit(runs):
    one, other = (simulate(kind, street())[1] for kind in (make(runs[0]), make_pool(runs[0])))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_members_are_drawn_by_weight(runs):
    pool, scene, draws = make_pool(*runs, "log", "parked", weights=[3.0, 1.0, 2.0, 2.0]), street(), 1000

    @jax.jit
    @jax.vmap
    def draw(key):
        state = pool.init(key, scene, jnp.int32(0))
        return state.chosen, state.states[0].driver

    chosen, driver = map(np.asarray, draw(jax.random.split(jax.random.key(5), draws)))
    counts = [np.sum((chosen == 0) & (driver == 0)), np.sum((chosen == 0) & (driver == 1)), np.sum(chosen == 1), np.sum(chosen == 2)]
    expected = draws * np.array([3, 1, 2, 2]) / 8
    assert np.sum((counts - expected) ** 2 / expected) < 16.3, counts  # chi-squared, 3 degrees of freedom: one of 1,000 is above


# ---- past policies


@pytest.mark.slow  # the training below compiles once with them
def test_past_policies_are_arguments_of_the_program(runs, pasts):
    """Each world drives by the parameters of its own policy, only of slots that have one; other parameters compile nothing."""
    alone = simulate(make(runs[0]), street())[1].position[-1]
    trained = [policy_io.load_policy(run).parameters for run in runs]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trained)
    drivers, positions = jax.device_get(pasts(stacked, jnp.array([True, True])))
    assert set(drivers.tolist()) == {0, 1}
    for slot in (0, 1):
        only, same = jax.device_get(pasts(stacked, jnp.arange(2) == slot))
        assert (only == slot).all()
        np.testing.assert_allclose(positions[drivers == slot], same[drivers == slot], atol=1e-4)
        assert np.abs(same[0] - alone).max() < 1e-4 if slot == 0 else np.abs(same[0] - alone).max() > 0.1
    np.testing.assert_allclose(pasts(jax.tree.map(lambda leaf: leaf[::-1], stacked), jnp.array([False, True]))[1][0], alone, atol=1e-4)
    assert pasts._cache_size() == 1


@pytest.mark.slow
def test_an_environment_without_past_policies_reads_the_traffic_with_them(runs):
    """The experts of learners have environments of their own, with other observations, in which past policies are not bound."""
    trained, scene, step = policy_io.load_policy(runs[0]), street(), jnp.int32(0)
    pool, other = (make_pool("past", runs[1], "log", config=config) for config in (trained.config, trained.config | {"observations": {}}))
    bound = pool.past.bind(jax.tree.map(lambda leaf: leaf[None], trained.parameters), jnp.array([True]))

    @jax.jit
    def read(key):
        state = bound.init(key, scene, step)
        return bound.read(scene, state, step), other.read(scene, state, step)

    jax.tree.map(np.testing.assert_array_equal, *read(jax.random.key(0)))


def test_without_a_training_past_policies_are_left_out(runs):
    logged = traffic.make(load_config("task", "traffic=log_playback")["traffic"], control_dt=1 / 30)
    found, step = make_pool("past"), jnp.int32(7)
    read = jax.jit(lambda: (found.read(street(), (), step).position, logged.read(street(), (), step).position))
    np.testing.assert_array_equal(*read())
    pool = make_pool("past", runs[0])
    state = jax.eval_shape(lambda: pool.init(jax.random.key(0), street(), step))
    assert state.driver.shape == ()
    config = smoke("unused", "traffic=pool", f"traffic.members=[past,{runs[0]},idm]")
    assert not trusted_targets.find_outside_targets({"traffic": config["traffic"]})
    told = lambda *members: circumstances.describe({"traffic": config["traffic"] | {"members": [*members]}})["Background traffic"]  # noqa: E731
    absent = "without the past policies that drive in training"
    assert told("past", str(runs[0]), "idm") == f"one of `{runs[0].name}`, `idm` in each episode, {absent}"
    assert told("past") == f"`log`, {absent}" and told("idm", "log") == "one of `idm`, `log` in each episode"


def test_an_evaluation_says_that_past_policies_are_missing(tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise SceneError("none")

    monkeypatch.setattr(scene_source, "load_heldout_scenes", stop)
    for members, said in (("past,idm", "background traffic: `idm`, without the past policies that drive in training\n"), ("idm", "")):
        with pytest.raises(SceneError):
            evaluate.evaluate_run(smoke(tmp_path, "traffic=pool", f"traffic.members=[{members}]"), tmp_path)
        assert capsys.readouterr().out == said


def make_probe_trainer(learner, env, seen):
    """A learner of the probe with its past policies; `seen` gets one with these whenever a program is traced."""

    def make(bound):
        seen.extend([bound] if bound.past is None else [])
        return make_trainer(bound, episode_steps=3) if learner == "ppo" else make_learner(learner, bound, episode_steps=3)[1]

    policy = late_fusion.make(**SMALL, **({} if learner == "ppo" else {"actor": "tanh_gaussian", "numbers": 2}))
    return past_policies.add_past_policies(make, env, policy, mesh=None)


@pytest.mark.parametrize("learner", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_a_training_keeps_the_latest_policies_and_resumes_bit_for_bit(tmp_path, learner):
    seen, every, taken = [], 2, []
    trainer, stage = make_probe_trainer(learner, probe_with_past(every, life=2, episode_steps=3), seen), scenes(4)
    state = trainer.init(jax.random.key(0), stage)
    first = jax.device_get(state.parameters)
    jax.tree.map(lambda kept, own: np.testing.assert_array_equal(kept[0], own), state.past.parameters, first)
    history, paid = {0: first}, []
    for iteration in range(1, 7):
        state, metrics = trainer.train_iteration(state, stage)
        history[iteration] = jax.device_get(state.parameters)
        taken.append(np.asarray(state.past.iteration).tolist())
        paid.append((float(metrics["reward/past"]), float(metrics["reward/there"])))
        if iteration == 3:
            checkpoint.save(tmp_path, state, keep=1)
    assert taken == [[0, -1], [0, 2], [0, 2], [4, 2], [4, 2], [4, 6]]
    for slot, iteration in enumerate(taken[-1]):
        kept = jax.tree.map(lambda leaf, slot=slot: leaf[slot], state.past.parameters)
        jax.tree.map(np.testing.assert_array_equal, kept, history[iteration])
    bias = [jax.tree.leaves(history[iteration])[0].sum() for iteration in range(7)]
    window = [[0], [0], [0, 2], [0, 2], [4, 2], [4, 2]]  # that each iteration plays against
    np.testing.assert_allclose(paid, [(sum(bias[one] for one in now), len(now)) for now in window], rtol=1e-4, atol=1e-5)
    assert len(seen) == 2 and trainer.train_iteration._cache_size() == 1, "one program for init, one for all iterations"

    again = checkpoint.restore(tmp_path, trainer.init(jax.random.key(1), stage))
    for _ in range(3):
        again, _ = trainer.train_iteration(again, stage)
    for one, other in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        data = [jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf for leaf in (one, other)]
        np.testing.assert_array_equal(*data)


@pytest.mark.slow
def test_a_run_among_its_past_policies_resumes_bit_for_bit(tmp_path):
    """From the command's config to the folder, in two parts and in one."""
    words = ("traffic=pool", "traffic.members=[past,idm]", "traffic.past.slots=2", "traffic.past.every=1", "evaluation.enable=false")
    words += ("scenes.pack.traffic=4", "checkpoint_every=1")
    prepared = training_loop.prepare(smoke(tmp_path / "whole", *words))
    train = lambda place, *more: training_loop.train(smoke(tmp_path / place, *words, *more), prepared=prepared)  # noqa: E731
    whole = train("whole", "iterations=3")
    assert np.asarray(whole.state.past.iteration).tolist() == [2, 3]
    assert [row["past/policies"] for row in whole.metrics] == [2.0, 2.0, 2.0]
    train("parts", "iterations=2")
    parts = train("parts", "iterations=3", "resume=true")
    for name in ("parameters", "past", "worlds"):
        one, other = (checkpoint_arrays(run.folder, name) for run in (whole, parts))
        assert one.keys() == other.keys() and one
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


def checkpoint_arrays(folder, name):
    """Of iteration 3; worlds lie in a file of their own."""
    with np.load(folder / "checkpoints" / ("3.worlds.npz" if name == "worlds" else "3.npz")) as stored:
        return {key: stored[key] for key in stored.files if key.startswith(f"{name}/")}


# ---- refusals


@pytest.mark.parametrize(
    "members, changes, message",
    [
        (["elsewhere"], {}, r"^traffic\.members: config\.yaml not found in elsewhere; .*: drive, town; or past, idm, .*pdm_closed"),
        ([], {}, r"^traffic\.members: expected one member or more, each once, got \[\]"),
        (["idm", "idm"], {}, r"^traffic\.members: expected one member or more, each once, got \['idm', 'idm'\]"),
        (["idm", "log"], {"weights": [1.0]}, r"^traffic\.weights: expected 2 numbers, one for each of traffic\.members, got 1"),
        (["idm"], {"weights": [0.0]}, r"^traffic\.weights: expected a number > 0, got 0"),
        (["past"], {"past": {"slots": 0, "every": 1}}, r"^traffic\.past\.slots: expected an integer >= 1, got 0"),
        (["past"], {"kinds": {}}, r"^traffic\.kinds\.log: missing; it takes the place of past policies"),
        (["idm"], {"kinds": {"past": {}}}, r"^traffic\.kinds\.past: expected another name"),
        (["idm"], {"vehicles": {"run": "town"}}, r"^traffic\.vehicles\.run: expected null, got 'town'; traffic\.members has"),
    ],
)
def test_mistakes_are_named(members, changes, message):
    with pytest.raises(ConfigError, match=message):
        make_pool(*members, **changes)


def test_a_policy_that_does_not_fit_its_observation_is_refused(runs, tmp_path):
    config = run_config.read(runs[0])
    config["observations"]["turning"] = {"_target_": "yaw_rate_and_steer", "turn_scale_radps": 1.0, "steer_scale_rad": 0.5}
    save(tmp_path, config, checkpoint.restore_parameters(runs[0] / "checkpoints"))
    pool = make_pool(runs[1], tmp_path)
    with pytest.raises(ConfigError, match=rf"^traffic\.members: {tmp_path}: expected a policy of this version without memory"):
        jax.eval_shape(pool.init, jax.random.key(0), street(), jnp.int32(0))


def test_past_policies_within_another_kind_are_refused():
    pool = load_config("task", "traffic=pool")["traffic"] | {"members": ["past"], "weight": 1.0}
    with pytest.raises(ConfigError, match=r"^traffic: expected past policies as a member of traffic=pool, got them in a part"):
        traffic.make({"_target_": "mixed", "parts": {"pool": pool}}, config={}, **CONTEXT)


def test_more_past_policies_than_memory_are_refused(monkeypatch):
    monkeypatch.setattr(replay_buffer, "measure_free_memory", lambda: 10_000_000)
    past_policies.check_memory({"w": jnp.zeros(250_000)}, 6, worlds=4)
    with pytest.raises(ConfigError, match=r"^traffic\.past\.slots: 7 policies of 1 MB, and one for each of 4 worlds, .*: at most 6 fit"):
        past_policies.check_memory({"w": jnp.zeros(250_000)}, 7, worlds=4)
