"""Checkpoints: resumed trainings are exact, and what does not fit is named."""

import dataclasses
import shutil
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util
from support.probes import SMALL, make_trainer, probe, scenes

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.learning import checkpoint, replay_buffer
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.trainer import get_policy_parameters

pytestmark = pytest.mark.usefixtures("quickly")

STAGE = 4


def fresh():
    """A trainer of its own, as in a new process."""
    env = probe(life=3, episode_steps=20)
    numbers = {"horizon": 8, "epochs": 2, "minibatches": 2, "desired_kl": 0.01, "stagger_episodes": True, "parameter_ema_decay": 0.5}
    return make_trainer(env, episode_steps=20, **numbers)


def begin(trainer):
    return trainer.init(jax.random.key(0), scenes(STAGE))


def assert_same(a, b):
    def equal(x, y):
        assert x.dtype == y.dtype
        keys = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        np.testing.assert_array_equal(*((jax.random.key_data(x), jax.random.key_data(y)) if keys else (x, y)))

    jax.tree.map(equal, a, b)


@pytest.fixture(scope="module")
def trainer():
    return fresh()


@pytest.fixture(scope="module")
def saved(trainer, tmp_path_factory):
    """A folder with the checkpoints of iterations 1 to 3, of which two are kept, and the state after iteration 4."""
    folder, train_state, stage = tmp_path_factory.mktemp("run") / "checkpoints", begin(trainer), scenes(STAGE)
    assert checkpoint.latest(folder) is None
    for _ in range(3):
        train_state, _ = trainer.train_iteration(train_state, stage)
        checkpoint.save(folder, train_state, keep=2)
    third = jax.tree.map(jnp.copy, train_state)
    return folder, third, trainer.train_iteration(train_state, stage)[0]


def test_the_newest_are_kept(saved):
    folder, third, _ = saved
    names = [f"{iteration}{part}.npz" for iteration in (2, 3) for part in ("", ".worlds")]
    assert checkpoint.latest(folder) == 3 and sorted(path.name for path in folder.iterdir()) == names
    checkpoint.save(folder, third, keep=2)  # again, under the same number
    assert checkpoint.latest(folder) == 3


def test_a_resumed_training_equals_an_unbroken_one(saved):
    folder, third, unbroken = saved
    other = fresh()
    train_state = checkpoint.restore(folder, third, 2)
    for _ in range(2):
        train_state, _ = other.train_iteration(train_state, scenes(STAGE))
    assert_same(train_state, unbroken)


def test_restore_is_exact_in_every_array(saved, trainer):
    folder, third, _ = saved
    like = begin(trainer)
    restored = checkpoint.restore(folder, like)
    assert_same(restored, third)
    # bound to devices as much as it was: else whoever goes on runs another program, and compiles it first
    assert [leaf.committed for leaf in jax.tree.leaves(restored)] == [leaf.committed for leaf in jax.tree.leaves(like)]


def test_restored_parameters_fit_the_policy(saved):
    folder, third, _ = saved
    parameters = checkpoint.restore_parameters(folder)
    assert_same(parameters, third.ema_parameters)
    mean, _, _ = jax.jit(late_fusion.make(**SMALL).apply)(parameters, third.worlds.observation)
    assert mean.shape == (STAGE, 3, 3)


def test_the_running_mean_is_evaluated(saved, trainer):
    folder, third, fourth = saved
    second = checkpoint.restore(folder, begin(trainer), 2)
    for before, after in ((second, third), (third, fourth)):
        expected = jax.tree.map(lambda old, new: 0.5 * np.asarray(old) + 0.5 * np.asarray(new), before.ema_parameters, after.parameters)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), after.ema_parameters, expected)
        pairs = zip(jax.tree.leaves(after.ema_parameters), jax.tree.leaves(after.parameters), strict=True)
        assert any((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)
    assert_same(get_policy_parameters(fourth), fourth.ema_parameters)
    alone = dataclasses.replace(third, ema_parameters=None)
    assert_same(get_policy_parameters(alone), third.parameters)


def test_a_run_without_a_mean_is_saved_and_restored(saved, tmp_path):
    folder, third, _ = saved
    alone = dataclasses.replace(third, ema_parameters=None)
    checkpoint.save(tmp_path, alone, keep=1)
    assert_same(checkpoint.restore(tmp_path, alone), alone)
    assert_same(checkpoint.restore_parameters(tmp_path), third.parameters)
    with pytest.raises(ConfigError, match=r"ema_parameters/params/actor/.*: it has .* float32, the config expects none"):
        checkpoint.restore(folder, alone)


def test_a_buffer_goes_on_in_the_groups_of_other_devices(saved, tmp_path):
    _, third, _ = saved
    two = replay_buffer.Buffer({"action": jnp.arange(8.0).reshape(2, 4)}, jnp.array([1, 2]), jnp.array([4, 2]))
    one = replay_buffer.make_empty({"action": jax.ShapeDtypeStruct((), jnp.float32)}, groups=1, capacity=8)
    checkpoint.save(tmp_path, dataclasses.replace(third, buffer={"sac": two}), keep=1)
    restored = checkpoint.restore(tmp_path, dataclasses.replace(third, buffer={"sac": one}))
    rows = restored.buffer["sac"]
    assert rows.rows["action"].tolist() == [[1.0, 2.0, 4.0, 3.0, 5.0, 0.0, 0.0, 0.0]]
    assert rows.filled.tolist() == rows.position.tolist() == [6]
    assert_same(dataclasses.replace(restored, buffer=()), third)


def test_an_incomplete_checkpoint_is_ignored(saved):
    folder, third, _ = saved
    (folder / ".9.npz.part").write_bytes(b"PK")
    assert checkpoint.latest(folder) == 3
    assert int(checkpoint.restore(folder, third).iteration) == 3


def put(file, content):
    file.write_bytes(content)


def flipped(content, place):
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


def flip_in(file, array):
    """Changes a bit in the middle of an array."""
    content = file.read_bytes()
    with zipfile.ZipFile(file) as archive:
        entry = archive.getinfo(f"{array}.npy")
    return flipped(content, entry.header_offset + entry.compress_size // 2 + 100)


KERNEL = "parameters/params/actor/trunk/layer_0/kernel"
DAMAGE = {
    "cut short": (lambda file: file.read_bytes()[:500], "File is not a zip file"),
    "empty": (lambda file: b"", "File is not a zip file"),
    "a flipped bit": (lambda file: flip_in(file, KERNEL), f"{KERNEL} has changed since it was written"),
    "a flipped bit in the index": (lambda file: flipped(file.read_bytes(), -100), ""),
}


@pytest.mark.parametrize(("damage", "reason"), DAMAGE.values(), ids=DAMAGE)
def test_damage_is_named_with_the_checkpoint_before(saved, tmp_path, damage, reason):
    folder, third, _ = saved
    for name in ("2.npz", "3.npz"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "3.npz").write_bytes(damage(folder / "3.npz"))
    for read in (lambda: checkpoint.restore(tmp_path, third), lambda: checkpoint.restore_parameters(tmp_path)):
        with pytest.raises(ConfigError) as caught:
            read()
        assert str(caught.value).startswith(f"{tmp_path / '3.npz'}: damaged: {reason}")
        assert "; checkpoint 2 before it is complete: remove" in str(caught.value) and "\n" not in str(caught.value)
    (tmp_path / "3.npz").unlink()  # what the message says
    assert int(checkpoint.restore(tmp_path, third).iteration) == 2
    (tmp_path / "2.npz").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"2\.npz: damaged: .*; the folder has no complete checkpoint before it"):
        checkpoint.restore_parameters(tmp_path)


def test_an_exported_policy_of_half_precision_is_read_back_rounded(saved, tmp_path):
    parameters = checkpoint.restore_parameters(saved[0])
    with np.load(checkpoint.write_parameters(tmp_path, parameters, dtype="float16")) as file:
        assert {file[name].dtype for name in file.files} == {np.dtype(np.float16)}
    read = checkpoint.restore_parameters(tmp_path)
    assert {leaf.dtype for leaf in jax.tree.leaves(read)} == {np.dtype(np.float32)}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), read, parameters)


def test_damage_of_an_exported_policy_is_found(saved, tmp_path):
    parameters = checkpoint.restore_parameters(saved[0])
    file = checkpoint.write_parameters(tmp_path, parameters)
    assert_same(checkpoint.restore_parameters(tmp_path), parameters)
    file.write_bytes(flip_in(file, KERNEL.removeprefix("parameters/")))
    with pytest.raises(ConfigError, match=r"policy\.npz: damaged: .+; restore it from a copy"):
        checkpoint.restore_parameters(tmp_path)
    file.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"policy\.npz: damaged: "):
        checkpoint.restore_parameters(tmp_path)


def test_a_full_disk_leaves_the_checkpoints_before_it(saved, tmp_path):
    resource = pytest.importorskip("resource")  # a limit on files stands for a full disk: the same path, with another reason
    folder, third, fourth = saved
    shutil.copy(folder / "3.npz", tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        with pytest.raises(OSError, match="File too large; checkpoint 3 is complete: with resume=true training goes on from it") as caught:
            checkpoint.save(tmp_path, fourth, keep=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "4.npz") and [file.name for file in tmp_path.iterdir()] == ["3.npz"]
    assert_same(checkpoint.restore(tmp_path, third), third)


def test_mistakes_are_named(saved, tmp_path):
    folder, third, _ = saved
    with pytest.raises(FileNotFoundError, match="nowhere: no checkpoint there"):
        checkpoint.restore(tmp_path / "nowhere", third)
    with pytest.raises(FileNotFoundError, match="no checkpoint there"):
        checkpoint.restore_parameters(tmp_path)
    with pytest.raises(FileNotFoundError, match="no checkpoint of iteration 7; there are 2, 3"):
        checkpoint.restore(folder, third, 7)
    with pytest.raises(ConfigError, match="keep: expected an integer >= 1, got 0"):
        checkpoint.save(folder, third, keep=0)


def test_a_checkpoint_of_another_config_is_refused_by_name(saved):
    folder, third, _ = saved

    def with_policy(**sizes):
        parameters = jax.jit(late_fusion.make(**{**SMALL, **sizes}).init)(jax.random.key(0), third.worlds.observation)
        stats = jax.tree.map(lambda x: x[:2], third.worlds.episode_stats)
        return dataclasses.replace(third, parameters=parameters, worlds=dataclasses.replace(third.worlds, episode_stats=stats))

    wider = r"parameters/params/actor/vector/layer_0/kernel: it has \(1, 16\) float32, the config expects \(1, 24\) float32"
    with pytest.raises(ConfigError, match=wider) as caught:
        checkpoint.restore(folder, with_policy(vector=[24]))
    assert "episode_stats" not in str(caught.value)  # a consequence, not the cause
    with pytest.raises(ConfigError, match=r"parameters/params/actor/vector/layer_1/bias: it has none, the config expects \(16,\) float32"):
        checkpoint.restore(folder, with_policy(vector=[16, 16]))
    with pytest.raises(ConfigError, match=r"worlds/episode_stats/returns: it has \(4, 3\) float32, the config expects \(2, 3\) float32"):
        checkpoint.restore(folder, with_policy())


def test_empty_arrays_and_half_precision_survive(saved, tmp_path):
    _, third, _ = saved
    observation = {"none": jnp.zeros((STAGE, 3, 0)), "half": jnp.ones((STAGE, 3), jnp.bfloat16)}
    odd = dataclasses.replace(third, worlds=dataclasses.replace(third.worlds, observation=observation))
    checkpoint.save(tmp_path, odd, keep=1)
    assert_same(checkpoint.restore(tmp_path, odd), odd)


def test_a_stripped_checkpoint_has_networks_alone(saved, trainer, tmp_path):
    folder = shutil.copytree(saved[0], tmp_path / "run")
    parameters, size = checkpoint.restore_parameters(folder), (folder / "3.npz").stat().st_size
    checkpoint.drop_training_state(folder)
    assert sorted(file.name for file in folder.glob("*.npz")) == ["3.npz"] and (folder / "3.npz").stat().st_size < size
    assert_same(checkpoint.restore_parameters(folder), parameters)
    with pytest.raises(ConfigError, match="has networks only; training cannot go on, only start_from this run"):
        checkpoint.restore(folder, begin(trainer))


def test_values_of_the_host_are_saved_with_it(saved, tmp_path):
    _, third, fourth = saved
    host = {"rows": [1, 2], "share": 0.1, "name": "a"}
    checkpoint.save(tmp_path, third, keep=2, host=host)
    checkpoint.save(tmp_path, fourth, keep=2)
    assert checkpoint.restore_host(tmp_path, 3) == host and checkpoint.restore_host(tmp_path) is None
    assert_same(checkpoint.restore(tmp_path, third, 3), third)


def test_replay_buffers_have_their_own_file(saved, tmp_path):
    _, third, fourth = saved
    for state, start in ((third, 0.0), (fourth, 1.0)):
        full = dataclasses.replace(state, buffer={"sac": {"rows": start + jnp.arange(4.0)}})
        (tmp_path / "2.buffer.npz").write_bytes(b"")  # of a save that ended before its checkpoint
        checkpoint.save(tmp_path, full, keep=1)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["4.buffer.npz", "4.npz", "4.worlds.npz"]
    assert_same(checkpoint.restore(tmp_path, full), full)
    put(tmp_path / "4.buffer.npz", (tmp_path / "4.buffer.npz").read_bytes().replace(np.float32(1.0).tobytes(), np.float32(7.0).tobytes()))
    with pytest.raises(ConfigError, match=r"buffer\.npz: damaged: buffer/sac/rows has changed"):
        checkpoint.restore(tmp_path, full)
    (tmp_path / "4.buffer.npz").unlink()
    assert_same(checkpoint.restore_parameters(tmp_path), full.ema_parameters)
    with pytest.raises(ConfigError, match=r"4\.npz: 4\.buffer\.npz is not beside it, the replay buffer; training cannot go on"):
        checkpoint.restore(tmp_path, full)


def test_without_its_worlds_a_run_goes_on_in_new_episodes(saved, trainer, tmp_path, caplog):
    folder, new = shutil.copytree(saved[0], tmp_path / "run"), begin(trainer)
    worlds = (folder / "3.worlds.npz").read_bytes()
    (folder / "3.worlds.npz").unlink()
    caplog.set_level("INFO")
    found = checkpoint.restore(folder, new)
    assert "3.worlds.npz is not beside it: all worlds start new episodes" in caplog.text
    assert_same(found, dataclasses.replace(saved[1], worlds=new.worlds, scene_stats=new.scene_stats))
    put(folder / "3.worlds.npz", worlds[:-200])
    with pytest.raises(ConfigError, match=r"3\.worlds\.npz: damaged"):
        checkpoint.restore(folder, new)


def test_a_new_training_starts_from_the_networks_of_another(trainer, saved):
    folder, third, _ = saved
    new = trainer.init(jax.random.key(9), scenes(STAGE))
    started, taken = checkpoint.put_networks(folder, new)
    assert taken == ["parameters/"]
    assert_same(started.parameters, third.ema_parameters)  # those that an evaluation reads
    assert_same(started.ema_parameters, third.ema_parameters)
    assert_same((started.optimizer, started.worlds, started.key, started.steps), (new.optimizer, new.worlds, new.key, new.steps))
    trainer.train_iteration(started, scenes(STAGE))  # the same program, and no array is another's
    with pytest.raises(ConfigError, match=r"does not fit this config: parameters/mean: it has \(2,\) float32, the config expects none"):
        checkpoint.put_networks(_write(folder.parent / "other", {"parameters/mean": np.zeros(2, np.float32)}), new)


def test_critics_are_taken_if_they_fit_and_numbers_never(tmp_path):
    ones = {name: np.ones(shape, np.float32) for name, shape in SHAPES.items()}
    arrays = ones | {"learner/target/params/kernel": np.ones(4, np.float32)}
    folder = _write(tmp_path, arrays | {"optimizer/mu": np.ones(3, np.float32)})
    checkpoint.drop_training_state(folder)  # a finished run keeps its critics
    assert set(np.load(folder / "7.npz").files) == set(arrays) - {"past/parameters/params/bias"}
    nested = traverse_util.unflatten_dict({name: jnp.zeros(shape) for name, shape in SHAPES.items()}, sep="/")
    started, taken = checkpoint.put_networks(folder, nested)
    assert taken == ["parameters/", "learner/critics/params/"]
    values = {name: float(leaf.max()) for name, leaf in traverse_util.flatten_dict(started, sep="/").items()}
    assert values == dict.fromkeys(SHAPES, 1.0) | {"learner/target/params/kernel": 0.0, "learner/log_alpha": 0.0}
    np.testing.assert_array_equal(started["past"]["parameters"]["params"]["bias"][:, 0], [1.0, 0.0])


SHAPES = {
    "parameters/params/bias": (3,),
    "learner/critics/params/kernel": (2,),
    "learner/target/params/kernel": (2,),
    "learner/log_alpha": (),
    "past/parameters/params/bias": (2, 3),
}


def _write(folder, arrays):
    folder.mkdir(exist_ok=True)
    np.savez(folder / "7.npz", **arrays)
    return folder
