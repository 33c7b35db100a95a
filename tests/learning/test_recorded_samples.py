"""Recorded samples: the files, the stream into a learner's buffer, and the noise of the expert's driving."""

import contextlib
import functools
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import adversarial
from support.probes import STEERS, expert, make_learner, probe, scenes

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import checkpoint, recording, rollout, sample_files, sample_stream, trainer
from scenefactory_jax.learning.expert import Noise, make_disturbance
from scenefactory_jax.learning.trainer import get_policy_parameters

pytestmark = pytest.mark.usefixtures("quickly")
WORLDS, ROWS, CHUNK = 8, 100, 24
CONFIG = {"observations": {"cue": {"count": 1}}, "actions": {}, "dynamics": {"mass": [1.0, None]}, "timing": {"control_hz": 10}}


def make_samples(rows, sizes=(7, 31)):
    """Pieces of samples, each with a cue of its own and the probes' expert's action; sizes take turns."""
    cue, first, pieces = np.linspace(-1, 1, rows, dtype=np.float32)[:, None], 0, []
    while first < rows:
        part = cue[first : first + sizes[len(pieces) % 2]]
        action = np.concatenate([0.5 * part, np.full_like(part, STEERS)], axis=1)
        pieces.append({"observation/cue": part, "action": action, "next_observation/cue": -part, "follows": part[:, 0] > -2.0})
        first += len(part)
    return pieces


def write(folder, chunk=CHUNK):
    pieces = make_samples(ROWS)
    index = sample_files.Index(*recording.write_chunks(folder, iter(pieces), chunk), sample_files.describe_config(CONFIG), {})
    sample_files.write_index(folder, index)
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A folder of samples, and what it has."""
    folder = tmp_path_factory.mktemp("samples")
    return folder, write(folder)


@pytest.fixture(scope="module")
def learners():
    """Behaviour cloning from recorded samples, by the size of its buffer, compiled once."""
    return functools.lru_cache(lambda buffer, name="bc": make_learner(name, probe(), samples="there", buffer=buffer, shards=2))


@contextlib.contextmanager
def open_stream(folder, learner, state, before=None, changes=None):
    config = CONFIG | {"seed": 3, "learner": {"samples": str(folder), "buffer": 0, "learning_starts": 0}} | (changes or {})
    with sample_stream.open_stream(config, learner, state, mesh=None, before=before) as samples:
        assert samples is not None
        yield samples


def run(folder, learner, state, iterations, before=None):
    """The train state after iterations, the cues in the buffer after each, and the stream's state."""
    stage, seen = scenes(WORLDS), []
    with open_stream(folder, learner, state, before) as samples:
        for _ in range(iterations):
            state = samples.exchange(learner.put_samples, state)
            buffer = state.buffer["bc"]
            cues = np.asarray(buffer.rows["observation"]["cue"][..., 0])
            seen.append(np.sort(np.concatenate([row[:filled] for row, filled in zip(cues, np.asarray(buffer.filled), strict=True)])))
            state, _ = learner.train_iteration(state, stage)
        return state, seen, samples.state()


def test_chunks_have_what_was_recorded_in_its_order(bank):
    folder, samples = bank
    index = sample_files.read_index(folder)
    assert index.rows == [24, 24, 24, 24, 4] and index.arrays["action"] == {"shape": [2], "dtype": "float32"}
    found = [sample_files.read_chunk(folder, number, list(samples), rows=rows) for number, rows in enumerate(index.rows)]
    for name, expected in samples.items():
        np.testing.assert_array_equal(np.concatenate([chunk[name] for chunk in found]), expected)
    sample_files.write_chunk(folder / "..", 77777, {"x": np.asarray(jnp.arange(3, dtype=jnp.bfloat16))})
    assert sample_files.read_chunk(folder / "..", 77777, ["x"], rows=3)["x"].tolist() == [0, 1, 2]


def test_samples_that_fit_are_all_in_the_buffer_and_are_learnt(bank, learners):
    """As if they had been in memory from the start: each once, before the first update, and nothing after it."""
    (folder, samples), (policy, learner) = bank, learners(512)
    state, seen, end = run(folder, learner, learner.init(jax.random.key(0), scenes(WORLDS)), 40)
    for cues in seen:
        np.testing.assert_array_equal(cues, np.sort(samples["observation/cue"][:, 0]))
    assert end["position"] == 5 and state.buffer["bc"].filled.tolist() == [50, 50]
    rows = jax.tree.map(lambda leaf: leaf[:, :50].reshape(100, -1), state.buffer["bc"].rows)
    np.testing.assert_allclose(rows["action"][:, :1], 0.5 * rows["observation"]["cue"])  # arrays of a sample stay together
    action = policy.apply(get_policy_parameters(state), {"cue": jnp.array([[-1.0], [1.0]])})[0]
    np.testing.assert_allclose(action[:, :2], [[-0.5, STEERS], [0.5, STEERS]], atol=0.1)


@pytest.mark.slow
def test_samples_that_do_not_fit_pass_through_the_buffer(bank, learners):
    """60 of 100 samples are there at a time; every chunk comes once an epoch, in another order each."""
    (folder, samples), (_, learner) = bank, learners(60)
    state, seen, end = run(folder, learner, learner.init(jax.random.key(0), scenes(WORLDS)), 9)
    assert end["position"] == 10 + (len(seen[0]) == 52) and state.buffer["bc"].filled.tolist() == [30, 30]
    assert len(np.unique(np.concatenate(seen[:4]))) == len(samples["action"]) == 100
    assert all(not np.array_equal(one, other) for one, other in itertools.pairwise(seen))


def test_a_killed_and_resumed_run_is_the_unbroken_one(bank, learners, tmp_path):
    (folder, _), (_, learner) = bank, learners(60)
    start = lambda: learner.init(jax.random.key(1), scenes(WORLDS))  # noqa: E731
    unbroken, _, end = run(folder, learner, start(), 6)
    half, _, before = run(folder, learner, start(), 3)
    checkpoint.save(tmp_path, half, keep=1, host={"samples": before})
    restored = checkpoint.restore(tmp_path, start())
    resumed, _, last = run(folder, learner, restored, 3, (checkpoint.restore_host(tmp_path) or {})["samples"])
    assert last == end
    one, other = ((state.parameters, state.optimizer, state.buffer, jax.random.key_data(state.key)) for state in (unbroken, resumed))
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow  # compiles for long
def test_bc_sac_imitates_them_in_its_turns(bank, learners):
    stage, (_, both) = scenes(WORLDS), learners(512, "bc_sac")
    state = both.init(jax.random.key(0), stage)
    with open_stream(bank[0], both, state) as samples:
        for _ in range(2):
            state, metrics = both.train_iteration(samples.exchange(both.put_samples, state), stage)
    assert float(metrics["bc/buffer"]) == 100 and float(metrics["steps/updates"]) == 32 and float(metrics["sac/buffer"]) > 0


@pytest.mark.slow  # compiles for long
def test_gail_takes_them_for_pairs_of_its_expert(bank):
    """Who sees -x after x is the expert; its rollouts are the policy's alone."""
    learner, stage = adversarial.make_learner("gail", env=probe(), samples="there", expert=None), scenes(WORLDS, 5)
    state = learner.init(jax.random.key(0), stage)
    with open_stream(bank[0], learner, state) as samples:
        for _ in range(3):
            state, metrics = learner.train_iteration(samples.exchange(learner.put_samples, state), stage)
    assert float(metrics["gail/buffer"]) == 100 and float(metrics["gail/skipped"]) == 0 and float(metrics["steps/spawned"]) > 0
    np.testing.assert_allclose(state.buffer["gail"].rows["next_observation"]["cue"], -state.buffer["gail"].rows["observation"]["cue"])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"timing": {"control_hz": 30}}, r"does not fit: timing\.control_hz: it has 10, the run 30; record with the settings of the run"),
        ({"observations": {"cue": {"count": 2}}}, r"observations\.cue\.count: it has 1, the run 2"),
        ({"dynamics": {"mass": [2.0, None]}}, r"dynamics\.mass: it has \[1\.0, None\], the run \[2\.0, None\]"),
        ({"learner": {"samples": "elsewhere", "buffer": 0}}, r"learner\.samples: elsewhere has no samples\.json"),
        ({"learner": {"buffer": 40, "learning_starts": 101}}, r"learner\.learning_starts: expected at most 100, .*, got 101"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_by_name(bank, learners, change, message):
    folder, learner = bank[0], learners(512)[1]
    change = {name: {"samples": str(folder)} | value if name == "learner" else value for name, value in change.items()}
    state = jax.eval_shape(learner.init, jax.random.key(0), scenes(WORLDS))
    with pytest.raises(ConfigError, match=message), open_stream(folder, learner, state, changes=change):
        pass


def test_files_that_do_not_fit_are_refused_by_name(bank, learners, tmp_path):
    learner, state = learners(512)[1], jax.eval_shape(learners(512)[1].init, jax.random.key(0), scenes(WORLDS))
    write(tmp_path)
    entries = json.loads((tmp_path / "samples.json").read_text())

    def refuse(message, arrays=None, before=None):
        (tmp_path / "samples.json").write_text(json.dumps(entries | {"arrays": entries["arrays"] | (arrays or {})}))
        with pytest.raises(ConfigError, match=message), open_stream(tmp_path, learner, state, before) as samples:
            samples.exchange(lambda state, rows, valid: state, state)

    refuse(r"has observation/cue as \(7,\) float16, the run needs \(1,\) float32", {"observation/cue": {"shape": [7], "dtype": "float16"}})
    refuse(r"resume=true: learner\.samples: .* has changed since", before={"position": 1, "index": "another"})
    small = jax.eval_shape(learners(60)[1].init, jax.random.key(0), scenes(WORLDS))
    whole = tmp_path / "whole"
    write(whole, chunk=ROWS)
    message = r"learner\.buffer: expected at least the 100 samples of a chunk of .*, got 0"
    with pytest.raises(ConfigError, match=message), open_stream(whole, learner, small):
        pass
    (tmp_path / "00002.npz").write_bytes((tmp_path / "00002.npz").read_bytes()[:-40])
    refuse(r"learner\.samples: .*00002\.npz: cannot be read: .*; restore it from a copy")
    with pytest.raises(ConfigError, match=r"has no elsewhere; `record samples\.next_observations=true` writes it"):
        sample_files.check_fit(tmp_path, sample_files.read_index(tmp_path), CONFIG, {"elsewhere": jnp.zeros(1)})


def test_labels_have_no_noise():
    """The action that is learnt is the expert's of the same state; the one that is made differs, smoothly, for half of the agents."""
    env, stage = probe(life=400)._replace(action_repeat=1), scenes(64)
    noise = Noise(std=(0.2, 0.05, 0.0), time_s=0.5, part=0.5)
    disturb = make_disturbance(noise, {"timing": {"control_hz": 10}})
    assert make_disturbance(Noise(std=(0.2, 0.1, 0.0), time_s=0.5, part=0.0), {"timing": {"control_hz": 10}}) is None

    @jax.jit
    def drive(stage):
        def step(worlds, key):
            label, _ = expert(stage, worlds, key)
            worlds, taken, *_ = rollout.collect_transitions(env, expert, stage, worlds, key, steps=1, disturb=disturb)
            return worlds, (label, taken.action[0], worlds.state.previous_action)

        worlds = trainer.start_worlds(env, jax.random.key(0), stage)
        return jax.lax.scan(step, worlds, jax.random.split(jax.random.key(1), 100))[1]

    label, learnt, made = (np.asarray(x)[:, :, :2] for x in jax.device_get(drive(stage)))  # the third slot is empty
    np.testing.assert_array_equal(learnt, label)
    error = made - label
    noisy = (error != 0).any((0, 3))
    assert 0.35 < noisy.mean() < 0.65 and not error[..., 2].any()
    off = error[:, noisy]
    np.testing.assert_allclose(off.std((0, 1))[:2], noise.std[:2], rtol=0.12)
    related = lambda lag: np.corrcoef(off[lag:, :, 0].ravel(), off[: len(off) - lag, :, 0].ravel())[0, 1]  # noqa: E731
    assert related(1) > 0.85 and abs(related(10)) < 0.1  # 0.1 s and 1 s
    by_time = off[..., 0].std(1)
    assert by_time.min() > 0.1  # also between the drawn values
