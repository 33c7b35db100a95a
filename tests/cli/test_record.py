"""`record` from the config to a folder of samples, and `train learner.samples=...` that learns from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.running import smoke

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.cli.record import record
from scenefactory_jax.cli.train import train
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.env import environment
from scenefactory_jax.learning import recording, sample_files, training_loop

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]
CHUNK, NOISE = 50, "learner.expert_noise.part=0.5"
TASK = ("spawning=logged", "actions=one_pedal_10hz")
SMALL = ("learner.horizon=8", "learner.buffer=120", "learner.learning_starts=8", "learner.batch=16", "evaluation.enable=false")


def load(out, *overrides):
    sizes = ("worlds=3", "samples.steps=8", f"samples.chunk={CHUNK}", "stream.workers=0", "stream.sample=4")  # of 4 scenes: two batches
    return load_config("record", "experiment=smoke", f"out={out}", *TASK, *sizes, *overrides)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("record") / "samples"
    record(load(out, NOISE))
    return out


def test_what_is_recorded_can_be_read_by_numpy(folder):
    """Each of four scenes once, agents from the start of their logs to the end of the episode, at most 20 actions."""
    files = sorted(folder.glob("*.npz"))
    chunks = [dict(np.load(file)) for file in files]
    samples = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    index = sample_files.read_index(folder)
    assert [len(chunk["action"]) for chunk in chunks] == index.rows and set(index.rows[:-1]) == {CHUNK}
    assert {name: {"shape": list(value.shape[1:]), "dtype": str(value.dtype)} for name, value in samples.items()} == index.arrays
    assert samples["observation/ego"].dtype == np.float16 and samples["observation/road/mask"].dtype == bool
    assert set(samples["scene"]) == {0, 1, 2, 3} and samples["step"].max() < 20
    places = np.stack([samples[name] for name in sample_files.ORIGIN], axis=1)
    assert len(np.unique(places, axis=0)) == len(places)  # nothing twice, though the second batch repeats scenes
    for scene, agent in np.unique(places[:, :2], axis=0):
        steps = np.sort(places[(places[:, :2] == (scene, agent)).all(1), 2])
        np.testing.assert_array_equal(steps, np.arange(len(steps)))
    assert np.abs(samples["action"]).max() <= 1.0 and samples["action"].std(0)[0] > 0.01
    assert index.about["expert_noise"]["part"] == 0.5 and index.config["timing"] == {"control_hz": 30}


def test_every_scene_is_driven_once_to_the_end_of_its_log(tmp_path):
    """Whatever the stream's sampler; a scene that cannot be used gives no other one twice, and a gap in the logs ends nothing."""
    config = load(tmp_path / "out", "worlds=4", "stream=levels", "stream.curriculum.levels=2")
    config["scenes"]["generate"] = {"_target_": "support.streets.street", "unusable": [3], "broken": [], "deadly": [], "endless": []}
    known = jnp.arange(60) % 5 == 3

    def run(scenes, worlds, now, key):
        valid = jnp.broadcast_to(known[now // 3], (1, 4, 4))
        return worlds, ({"action": jnp.zeros((1, 4, 4, 3))}, valid)

    pieces = list(recording.drive_scenes(config, environment.make_env(config), run, 1, 20))
    places = np.concatenate([np.stack([piece[name] for name in sample_files.ORIGIN], axis=1) for piece in pieces])
    assert set(places[:, 0]) == {0, 1, 2} and set(places[:, 2]) == {3, 8}  # of 11 actions
    assert len(np.unique(places, axis=0)) == len(places) == 3 * 4 * 2


@pytest.mark.slow  # test_train resumes, test_recorded_samples learns
def test_a_killed_and_resumed_run_is_the_unbroken_one(folder, tmp_path):
    config = smoke(tmp_path / "whole", "learner=bc", *TASK, *SMALL, f"learner.samples={folder}", "iterations=4")
    prepared = training_loop.prepare(config)
    whole = train(config, prepared=prepared)
    assert [row["bc/buffer"] for row in whole.metrics] == [100, 120, 120, 120]  # two chunks of 50 fit
    assert whole.metrics[-1]["steps/updates"] == 64 and whole.metrics[-1]["casps"] == 0.0
    parts = config | {"out": str(tmp_path / "parts")}
    train(parts | {"iterations": 2}, prepared=prepared)
    resumed = train(parts | {"resume": True}, prepared=prepared)
    state = lambda run: (run.state.parameters, run.state.optimizer, run.state.buffer)  # noqa: E731
    jax.tree.map(np.testing.assert_array_equal, state(whole), state(resumed))


@pytest.mark.parametrize(
    "overrides, message",
    [
        ((), r"out=.*: expected a new or an empty folder"),
        (("samples.next_observations=true", NOISE), r"samples\.next_observations: expected false beside learner\.expert_noise\.part=0\.5"),
        (("learner.samples=there",), r"learner\.samples: expected null, got there"),
        (("learner=sac",), r"learner: expected one with an expert: bc, bc_sac, gail or airl"),
        (("samples.chunk=0",), r"samples\.chunk: expected an integer >= 1, got 0"),
        (("out=null",), r"out: missing; `record out=FOLDER`"),
    ],
)
def test_mistakes_are_named(folder, overrides, message):
    with pytest.raises(ConfigError, match=message):
        record(load(folder, *overrides))
