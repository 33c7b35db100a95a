"""A stream of several sources: each has its share of the draws, its own outcomes, and a resumed run draws on as if unbroken."""

import contextlib
import json

import jax
import numpy as np
import pytest
from support.running import smoke
from support.streets import street

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import mixture, samplers, stream
from scenefactory_jax.learning import checkpoint
from scenefactory_jax.learning.training_loop import train
from scenefactory_jax.loggers import metrics_csv

pytestmark = pytest.mark.usefixtures("quickly")

PLAIN = {"unusable": [], "broken": [], "deadly": [], "endless": []}
SIZES = {"womd": 5, "womd_links": 3}  # scenes of the banks
SHARES = "{womd:0.25,womd_links:0.25,generator:0.5}"
SHORT = ("stream.workers=0", "stream.sample=6", "stream.swap_fraction=0.5")
CLOCK = {"seconds", "casps", "minutes", "stream/wait_s", "years_per_hour"}  # columns that no two runs share


@pytest.fixture(scope="module")
def banks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("banks")
    for number, (name, count) in enumerate(SIZES.items()):
        bank_reader.write(folder / name, [street(0, 100 * (number + 1) + index, **PLAIN) for index in range(count)], settings={})
    return folder


def words(banks, *more):
    paths = ",".join(f"{name}:{banks / name}" for name in SIZES)
    return ["stream=mixture", f"stream.banks={{{paths}}}", f"stream.shares={SHARES}", *SHORT, *more]


def configured(banks, *more, out=None):
    found = smoke(out, *words(banks, *more)) if out else hydra_config.load_config("train", "experiment=smoke", *words(banks, *more))
    found["scenes"]["generate"] = {"_target_": "support.streets.street"} | PLAIN
    return found


def opened(found):
    return mixture.open_mixture(found["scenes"], found["stream"]["banks"], found["stream"]["shares"])


def test_no_experiment_streams_against_a_users_word():
    files = sorted((hydra_config.find_conf() / "experiment").glob("*.yaml"))
    streaming = [file.stem for file in files if "stream" in file.read_text()]
    assert "generalist" in streaming
    for name in streaming:
        assert hydra_config.load_config("benchmark", f"experiment={name}", "stream=none")["stream"] is None, name


def test_entries_of_all_sources_follow_each_other(banks):
    source, parts = opened(configured(banks))
    assert source.count is None and [part.first for part in parts] == [0, 5, 8] and mixture.count_known(source, parts) == 8
    assert [source.name(index) for index in (0, 4, 5, 7, 8, 11)] == [
        "street 100", "street 104", "street 200", "street 202", "generated scene 0", "generated scene 3",
    ]  # fmt: skip
    for index, name in ((4, "street 104"), (6, "street 201"), (9, "street 1")):
        assert source.read_one(index)().name == name
    assert json.loads(json.dumps(source.identity)) == source.identity
    sample = mixture.choose_sample(source, parts, 6, seed=3)
    assert [sum(part.first <= index < end for index in sample) for part, end in zip(parts, (5, 8, 99), strict=True)] == [2, 2, 2]


def test_each_source_has_its_share_of_any_number_of_draws(banks):
    """Draws in calls of uneven size: exact to a draw, every scene of a bank once an epoch, the generator's in their order."""
    _, parts = opened(configured(banks))
    draw = mixture.share_draws(lambda table, count: samplers.shuffled(table, count, seed=1), parts, seed=1)
    table, drawn = samplers.SceneOutcomes(*(np.zeros(8, kind) for kind in (int, float, float)), endless=True), []
    for count in (1, 7, 3, 1, 20, 8):
        drawn += draw(table, count).tolist()
        table = samplers.count_draws(table, np.array(drawn[-count:]))
        for part, share in zip(parts, (0.25, 0.25, 0.5), strict=True):
            assert abs(part.take(table).draws.sum() - share * len(drawn)) <= 1.0
    assert list(table.draws[:5]) == [2] * 5 and sorted(table.draws[5:8]) == [3, 3, 4]
    assert sorted(index - 8 for index in drawn if index >= 8) == list(range(20))


@pytest.mark.parametrize("counts", [[1] * 120, [2, 1, 5] * 15, [64, 1, 64]])
def test_shares_hold_for_draws_one_by_one(banks, counts):
    _, parts = opened(configured(banks, "stream.shares={womd:0.3,womd_links:0.3,generator:0.4}"))
    draw = mixture.share_draws(lambda table, count: samplers.prioritize_failures(table, count, seed=0, floor=0.5), parts, seed=0)
    table, total = samplers.SceneOutcomes(*(np.zeros(8, kind) for kind in (int, float, float)), endless=True), 0
    for count in counts:
        table, total = samplers.count_draws(table, draw(table, count)), total + count
        assert table.draws.sum() == total
        assert all(abs(part.take(table).draws.sum() - part.share * total) <= 1.0 for part in parts)


def test_a_source_that_fails_takes_no_draws_from_the_others(banks):
    _, parts = opened(configured(banks))
    numbers = {"seed": 0, "floor": 0.5}
    draw = mixture.share_draws(lambda table, count: samplers.prioritize_failures(table, count, **numbers), parts, seed=0)
    episodes, successes = np.full(12, 40.0), np.array([0, *[40] * 4, *[40] * 3, *[40] * 4], float)  # one scene of the first bank fails
    table = samplers.SceneOutcomes(np.zeros(12, int), episodes, successes, endless=True)
    for _ in range(30):
        table = samplers.count_draws(table, draw(table, 4))
    assert [part.take(table).draws.sum() for part in parts] == [30, 30, 60]
    assert table.draws[0] > 2 * table.draws[1:5].max()
    assert mixture.summarise_parts(table, parts) == {
        "stream/success/womd": 0.8, "stream/success/womd_links": 1.0, "stream/success/generator": 1.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shares": {"town": 1.0}}, r"stream\.shares\.town: expected womd, womd_links, generator"),
        ({"shares": {"womd": 0.0}}, r"stream\.shares: expected a number > 0 for one source or more, got \{'womd': 0\.0\}"),
        ({"banks": {"womd": None}, "shares": {"womd": 1.0}}, r"stream\.banks\.womd: null; give a bank"),
        ({"curriculum": {"levels": 2, "promote_at": 0.5, "min_episodes": 1, "traffic_weight": 0.0}}, r"stream\.curriculum: expected null"),
    ],
)
def test_mistakes_are_named(banks, changes, message):
    found = configured(banks)
    with (
        pytest.raises(ConfigError, match=message),
        stream.open_stream(found | {"stream": found["stream"] | changes}, mesh=None, before=None),
    ):
        pass


def test_scenes_of_a_path_and_heldout_ones_are_refused(banks):
    found = configured(banks, f"scenes.heldout.path={banks / 'womd_links'}")
    with pytest.raises(ConfigError, match=r"stream\.banks\.womd_links: expected other scenes than scenes\.heldout\.path"):
        opened(found)
    with pytest.raises(ConfigError, match=r"scenes\.path: expected null beside stream\.shares"):
        opened({**found, "scenes": {**found["scenes"], "path": str(banks / "womd")}})


def test_a_resumed_stream_of_a_mixture_is_the_unbroken_one(banks):
    found = configured(banks, "worlds=4")

    def advance(flow, turns):
        held = flow.scenes()
        for turn in turns:
            _, held = flow.exchange(lambda state, held, worlds, fresh: (state, fresh), None, held)
            flow.draw()
            row = flow.note(np.full(4, 3), np.arange(4) % (turn + 2))
        return row, json.loads(json.dumps(flow.state()))

    with stream.open_stream(found, mesh=None, before=None) as flow:
        whole, whole_state = advance(flow, range(5))
    with stream.open_stream(found, mesh=None, before=None) as flow:
        _, state = advance(flow, range(2))
    with stream.open_stream(found, mesh=None, before=state) as flow:
        resumed, resumed_state = advance(flow, range(2, 5))
    assert resumed_state == whole_state and state != whole_state and len(state["draws"]) > 8
    del whole["stream/wait_s"], resumed["stream/wait_s"]
    assert resumed == whole and {f"stream/success/{name}" for name in (*SIZES, "generator")} <= set(whole)
    other = state | {"source": {"kind": "bank", "entries": 7}}
    message = r"the run streamed 7 scenes of a bank; now there are womd: 5 scenes of a bank, .*generator: scenes of a generator"
    with pytest.raises(ConfigError, match=message), stream.open_stream(found, mesh=None, before=other):
        pass


@pytest.mark.slow
def test_a_killed_and_resumed_run_of_a_mixture_is_the_unbroken_one(banks, tmp_path):
    def run(name, *more, **callbacks):
        fixed = ("evaluation.enable=false", "iterations=4", "checkpoint_every=2", "worlds=4", "timing.episode_s=0.2")
        return train(configured(banks, *fixed, *more, out=tmp_path / name), **callbacks)

    def kill(state, row):
        if row["iteration"] == 3:
            raise KeyboardInterrupt

    whole = run("whole")
    with contextlib.suppress(KeyboardInterrupt):
        run("run", on_iteration=kill)
    assert checkpoint.latest(tmp_path / "run" / "checkpoints") == 2
    resumed = run("run", "resume=true")
    jax.tree.map(np.testing.assert_array_equal, resumed.state.parameters, whole.state.parameters)
    told, again = (checkpoint.restore_host(tmp_path / name / "checkpoints") for name in ("whole", "run"))
    assert told == again and told is not None and told["source"]["parts"]["generator"] == {"kind": "generator", "entries": None}
    rows, others = metrics_csv.read(tmp_path / "whole"), metrics_csv.read(tmp_path / "run")
    assert len(rows) == 4 and rows[-1]["stream/success/generator"] >= 0 and rows[-1]["years"] > rows[0]["years"] > 0
    for row, other in zip(rows, others, strict=True):
        np.testing.assert_equal(*({name: one[name] for name in one if name not in CLOCK} for one in (row, other)))
