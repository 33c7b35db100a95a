"""`train learner=sac` from the config to a run folder whose policy drives, one agent in a world; and the expert of `learner=bc`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of
from support.running import smoke
from support.traffic_scenes import track, with_tracks

import scenefactory_jax as sf
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.cli.train import train
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment, traffic
from scenefactory_jax.env.traffic.mixed import make_absent_boxes
from scenefactory_jax.learning import expert, rollout, training_loop
from scenefactory_jax.learning.trainer import get_policy_parameters, start_worlds

pytestmark = pytest.mark.usefixtures("quickly")
SMALL = ("learner.horizon=8", "learner.buffer=512", "learner.learning_starts=8", "learner.batch=16", "evaluation.enable=false")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two iterations of SAC; actions are two numbers, and a world has one agent."""
    out = tmp_path_factory.mktemp("sac") / "run"
    own = ("actions=acceleration", "scenes.pack.agents=1", "~observations.road", "~observations.neighbours")  # less to compile
    return train(smoke(out, "learner=sac", *own, *SMALL))


@pytest.mark.slow  # these share a run; test_learners trains each learner, test_train runs the command
def test_one_word_trains_sac(run):
    first, last = run.metrics
    assert 0 < first["steps/updates"] < last["steps/updates"] == 64
    assert last["sac/buffer"] > first["sac/buffer"] > 0 and last["sac/skipped"] == 0.0
    assert last["updates_per_s"] == pytest.approx(64 / last["seconds"])
    assert last["samples_per_s"] == pytest.approx(16 * 64 / last["seconds"])
    assert last["casps"] == pytest.approx(last["steps/spawned"] / last["seconds"])


@pytest.mark.slow
def test_its_policy_is_the_actor(run):
    trained, observation = sf.load_policy(run.folder), run.state.worlds.observation
    mean, log_std, value = jax.jit(trained.policy.apply)(trained.parameters, observation)
    jax.tree.map(np.testing.assert_array_equal, trained.parameters, get_policy_parameters(run.state))
    assert mean.shape == (4, 1, 3) and log_std.shape == (3,) and value.shape == (4, 1) and np.isneginf(log_std).all()
    assert np.abs(mean).max() <= 1.0 and not mean[..., 2].any()  # the third number is not read


@pytest.mark.slow
def test_its_policy_drives_background_traffic(run):
    """They are sampled under their tanh."""
    entry = load_config("task", "traffic=policy")["traffic"] | {"run": str(run.folder), "sample": True}
    context = {"physics_dt": 1 / 120, "control_dt": 1 / 30, "friction": lambda weather, position, speed: jnp.ones_like(speed)}
    kind, scene = traffic.make(entry, **context), with_tracks(scene_of([[0, 40]], [[50, 40]]), track([0.0, 0.0], (5.0, 0.0)))
    state = jax.eval_shape(kind.init, jax.random.key(0), scene, jnp.int32(0))
    after = jax.eval_shape(kind.advance, scene, state, make_absent_boxes(1), jnp.int32(0))
    assert jax.tree.structure(after) == jax.tree.structure(state) and after.drives.shape == (1,)


@pytest.mark.slow  # test_bicycle_waymax has the expert's actions
def test_the_expert_of_a_run_follows_the_log(tmp_path):
    """Articulated cars or others, thirty times a second or ten: the expert is told by the run's config."""
    config = smoke(tmp_path / "run", "learner=bc", "spawning=logged", "actions=one_pedal_10hz", *SMALL)
    env, act = environment.make_env(config | {"observations": {}, "reward": {}}), expert.make_expert(config)
    stage, _ = scene_source.assign_scenes(scene_source.load_training_scenes(config["scenes"]), 4, seed=0, mesh=None)

    @jax.jit
    def drive(stage):
        worlds = start_worlds(env, jax.random.key(0), stage)
        after, samples, *_ = rollout.collect_transitions(env, act, stage, worlds, jax.random.key(1), steps=15)
        return worlds.state, after.state, samples.known & samples.outcome.active

    before, after, known = jax.device_get(drive(stage))
    row = round(15 * 0.1 / float(stage.log.dt[0]))
    there = known.all(0) & stage.log.valid[:, :, row]
    off = np.linalg.norm(after.motion.position[..., :2] - stage.log.position[:, :, row], axis=-1)
    gone = np.linalg.norm(after.motion.position - before.motion.position, axis=-1)
    assert there.sum() >= 8 and off[there].max() < 0.5 and np.median(gone[there]) > 3.0
    with pytest.raises(ConfigError, match=r"learner\.expert\._target_: 'nothing' is not in"):
        expert.make_expert(config | {"learner": config["learner"] | {"expert": {"_target_": "nothing"}}})


GAIL = ("learner=gail", "spawning=logged", "dynamics=bicycle", "learner.expert_steps=8", "learner.batch=64", "learner.buffer=512")


@pytest.mark.slow  # test_adversarial trains with it
def test_one_word_makes_gail(tmp_path):
    """The expert of the config drives, the discriminator reads the policy's observations. Traced, not compiled: tests/learning learns."""
    parts, state, after, metrics = trace(smoke(tmp_path / "run", *GAIL))
    assert jax.tree.structure(after) == jax.tree.structure(state) and after.buffer["gail"].rows["action"].shape[1] == 512
    assert {"gail/buffer", "gail/skipped", "gail/reward", "gail/loss", "reward", "reward/progress", "ppo/skipped"} <= metrics.keys()
    mean, _, value = jax.eval_shape(parts.policy.apply, state.parameters, state.worlds.observation)
    assert mean.shape == (4, 4, 3) and value.shape == (4, 4)


@pytest.mark.slow  # the same, compiled
def test_one_word_trains_gail(tmp_path):
    """The expert drives in the first iteration; the environment's reward is still reported, the policy's is the discriminator's."""
    run = train(smoke(tmp_path / "run", *GAIL, "iterations=1", "evaluation.enable=false"))
    [row] = run.metrics
    assert row["gail/buffer"] > 0 and row["gail/skipped"] == row["ppo/skipped"] == 0.0
    assert row["gail/reward"] > 0.0 and row["gail/loss"] == pytest.approx(2 * np.log(2), abs=0.7)
    trained = sf.load_policy(run.folder)
    jax.tree.map(np.testing.assert_array_equal, trained.parameters, get_policy_parameters(run.state))


def trace(config):
    """Parts of a training, and shapes of its state before and after an iteration and of the metrics."""
    parts = training_loop.prepare(config)
    stage, _ = scene_source.assign_scenes(scene_source.load_training_scenes(config["scenes"]), 4, seed=0, mesh=None)
    state = jax.eval_shape(parts.trainer.init, jax.random.key(0), stage)
    return parts, state, *jax.eval_shape(parts.trainer.train_iteration, state, stage)


@pytest.mark.slow  # test_copo trains with it
def test_one_word_makes_copo(tmp_path):
    """The learner asks the policy for three values, of which no evaluation reads one. It is traced, not compiled."""
    parts, state, after, metrics = trace(smoke(tmp_path / "run", "learner=copo"))
    assert jax.tree.structure(after) == jax.tree.structure(state) and after.buffer["copo"].shape == (4, 4)
    assert {"copo/lcf_mean", "copo/lcf_std", "ppo/explained_variance", "copo/explained_variance_global"} <= metrics.keys()
    mean, _, value = jax.eval_shape(parts.policy.apply, state.parameters, state.worlds.observation)
    assert mean.shape == value.shape == (4, 4, 3)


@pytest.mark.parametrize("words", [("learner=bc",), ("learner=td3",), ("learner=ppo", "ppo=steady"), ("learner=copo",)], ids="+".join)
def test_an_experiment_takes_any_learner(words):
    """Its numbers of SAC are an option of the group, which another learner replaces."""
    training_loop.prepare(load_config("train", "experiment=vmax", *words))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"tau": 2.0}, r"learner\.tau: expected a number > 0 and <= 1, got 2"),
        ({"_target_": "scenefactory_jax.learning.bc.train_iteration.make"}, r"learner\.critic_learning_rate: unknown key; valid: .*expert"),
        ({"_target_": "scenefactory_jax.learning.sac.train_iteration.fit"}, r"learner\._target_: '.*fit' is not in .*; valid: .* make, "),
    ],
)
def test_mistakes_are_named(tmp_path, change, message):
    config = smoke(tmp_path / "run", "learner=sac", *SMALL)
    config["learner"] |= change
    with pytest.raises(ConfigError, match=message):
        training_loop.make_trainer(config, environment.make_env(config | {"observations": {}}), training_loop.make_policy(config))


def test_what_learners_share_is_no_learner(tmp_path):
    with pytest.raises(ConfigError, match=r"learner\._target_: expected the name of a function, got ''"):
        training_loop.prepare(smoke(tmp_path / "run", "learner=base"))
