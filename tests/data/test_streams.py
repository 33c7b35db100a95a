"""Scenes that pass through the worlds: what a swap changes, what samplers draw, what is loaded, and that a resumed run is unbroken."""

import contextlib
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.probes import make_trainer, probe, scenes
from support.running import smoke
from support.scene_banks import stacked_scenes
from support.scene_documents import document, thing, written
from support.streets import street

from experiments.benchmarks import loading, streaming
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel import task_map
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import batches, mixture, samplers, scene_source, stream
from scenefactory_jax.learning import checkpoint
from scenefactory_jax.learning.training_loop import train as run_train
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.roadgraph import spatial_grid
from scenefactory_jax.visualization.report import throughput_report

pytestmark = pytest.mark.usefixtures("quickly")

WORLDS = 8
SHORT = ("stream.workers=0", "stream.sample=4", "stream.swap_fraction=0.5")
CLOCK = {"seconds", "casps", "minutes", "stream/wait_s", "years_per_hour"}  # columns that no two runs share


def bits(tree):
    """Leaves as numpy arrays of their own, keys as their data."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x  # noqa: E731
    return jax.tree.map(lambda x: np.array(plain(x)), tree)


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, bits(one), bits(other))


# ---- swap


def trainer_of(**numbers):
    return make_trainer(probe(life=3, episode_steps=50), episode_steps=50, **numbers)


@pytest.fixture(scope="module")
def trainer():
    return trainer_of(stagger_episodes=True)


@pytest.fixture(scope="module")
def swapped(trainer):
    """States and scenes before and after other scenes came into worlds 6, 1 and 4, and what a restart in them alone gives."""
    stage, fresh, worlds = scenes(WORLDS), scenes(3, task=2), np.array([6, 1, 4])
    state, _ = trainer.train_iteration(trainer.init(jax.random.key(0), stage), stage)
    alone = trainer_of(stagger_episodes=False).restart(jax.tree.map(jnp.copy, state), fresh)
    before = bits((state, stage))
    after, stage = trainer.replace_scenes(state, stage, worlds, fresh)
    kept = bits((after, stage))
    following = trainer.train_iteration(after, stage)[0]
    return SimpleNamespace(before=before, after=kept, alone=bits(alone), fresh=bits(fresh), worlds=worlds, following=following, stage=stage)


@pytest.mark.slow  # test_sharding swaps scenes
def test_a_swap_is_a_fresh_start_in_those_scenes(swapped):
    state, stage = swapped.after
    same(jax.tree.map(lambda leaf: leaf[swapped.worlds], state.worlds), swapped.alone.worlds)
    same(jax.tree.map(lambda leaf: leaf[swapped.worlds], stage), swapped.fresh)
    same(state.key, swapped.alone.key)
    assert not np.asarray(state.worlds.state.step)[swapped.worlds].any()  # or the clock would cut lives short, which count as failures


@pytest.mark.slow
def test_a_swap_changes_no_other_world(swapped):
    others = np.setdiff1d(np.arange(WORLDS), swapped.worlds)
    rest = lambda tree: jax.tree.map(lambda leaf: leaf[others], tree)  # noqa: E731
    (before, stage_before), (after, stage_after) = swapped.before, swapped.after
    for name in ("worlds", "scene_stats"):
        same(rest(getattr(before, name)), rest(getattr(after, name)))
    same(rest(stage_before), rest(stage_after))
    for name in ("parameters", "optimizer", "iteration", "steps"):
        same(getattr(before, name), getattr(after, name))


@pytest.mark.slow
def test_records_count_from_the_swap_on(swapped):
    """Lives of three steps: five end in sixteen, of the two agents of each world; what began before the swap does not count."""
    assert (swapped.before[0].scene_stats.episodes == 10).all() and (swapped.before[0].scene_stats.successes == 10).all()
    expected = np.where(np.isin(np.arange(WORLDS), swapped.worlds), 0, 10)
    np.testing.assert_array_equal(swapped.after[0].scene_stats.episodes, expected)
    episodes = np.asarray(swapped.following.scene_stats.episodes)
    assert (episodes[swapped.worlds] >= 10).all() and (episodes[swapped.worlds] <= 14).all()  # at most one more by time
    assert (np.delete(episodes, swapped.worlds) >= 20).all() and (np.asarray(swapped.following.scene_stats.successes) <= episodes).all()


@pytest.mark.slow
def test_nothing_compiles_twice(trainer, swapped):
    state, stage = jax.tree.map(jnp.copy, (swapped.following, swapped.stage))
    for world in range(3):
        state, stage = trainer.replace_scenes(state, stage, np.array([world, 5, 7]), scenes(3, task=world + 1))
        state, _ = trainer.train_iteration(state, stage)
    assert trainer.replace_scenes._cache_size() == trainer.train_iteration._cache_size() == 1
    np.testing.assert_array_equal(stage.weather.surface, [1, 2, 3, 5, 2, 3, 2, 3])


# ---- samplers


def table(draws, episodes=None, successes=None, *, endless=False):
    zeros = np.zeros(len(draws))
    return samplers.SceneOutcomes(
        np.asarray(draws), zeros if episodes is None else episodes, zeros if successes is None else successes, endless
    )


def sequence(sampler, known, counts):
    """What is drawn in parts of these sizes."""
    drawn = []
    for count in counts:
        drawn.append(sampler(known, count))
        known = samplers.count_draws(known, drawn[-1])
    return np.concatenate(drawn), known


def test_shuffled_brings_every_scene_once_an_epoch():
    draw = instantiate({"_target_": "shuffled"}, builtins=samplers, where="stream.sampler", seed=4)
    whole, known = sequence(draw, samplers.empty(11), [33])
    parts, _ = sequence(draw, samplers.empty(11), [3, 7, 1, 2, 20])
    np.testing.assert_array_equal(parts, whole)
    epochs = whole.reshape(3, 11)
    assert all(sorted(epoch) == list(range(11)) for epoch in epochs) and len({tuple(epoch) for epoch in epochs}) == 3
    assert (known.draws == 3).all()
    endless, known = sequence(draw, samplers.empty(None), [4, 5])
    assert list(endless) == list(range(9)) and list(known.draws) == [1] * 9


def test_failing_scenes_come_more_often_in_proportion_to_failure():
    """Four kinds of scenes with 0, 1/4, 1/2 and all of 38 lives without success: draws beside those in turn are as 1 : 10.5 : 20 : 39."""
    kind = np.arange(400) % 4
    failures = np.array([0.0, 9.5, 19.0, 38.0])[kind]
    known, counts = table(np.zeros(400, int), np.full(400, 38.0), 38.0 - failures), np.zeros(4)
    for trial in range(3000):
        drawn = samplers.prioritize_failures(known, 2, seed=trial, floor=0.5)  # one in turn, one that fails
        counts[kind[drawn[0]]] += 1
    expected = 3000 * np.array([1.0, 10.5, 20.0, 39.0]) / 70.5
    assert ((counts - expected) ** 2 / expected).sum() < 16.3  # chi-square with three degrees of freedom: 0.1 %


def test_scenes_that_are_sometimes_mastered_come_more_often():
    """No, a quarter, a half and all of 38 lives without success: draws beside those in turn are as p (1 - p)."""
    kind = np.arange(400) % 4
    failures = np.array([0.0, 9.5, 19.0, 38.0])[kind]
    known, counts = table(np.zeros(400, int), np.full(400, 38.0), 38.0 - failures), np.zeros(4)
    for trial in range(3000):
        counts[kind[samplers.prioritize_learnable(known, 2, seed=trial, floor=0.5)[0]]] += 1
    share = np.array([1.0, 10.5, 20.0, 39.0]) / 40
    expected = 3000 * share * (1 - share) / (share * (1 - share)).sum()
    assert ((counts - expected) ** 2 / expected).sum() < 16.3


@pytest.mark.parametrize("floor", [0.25, 1.0])
def test_failing_scenes_leave_draws_for_all_others(floor):
    """Whatever happens, every scene comes once in N / floor draws, again and again."""
    scenes_, rounds = 60, 4
    episodes = np.full(scenes_, 50.0)
    known = table(np.zeros(scenes_, int), episodes, np.where(np.arange(scenes_) == 7, 0.0, episodes))  # one scene fails always
    for turn in range(1, rounds + 1):
        drawn, known = sequence(
            lambda known, count: samplers.prioritize_failures(known, count, seed=1, floor=floor), known, [4] * int(15 / floor)
        )
        assert known.draws.min() >= turn and drawn.min() >= 0 and drawn.max() < scenes_
    assert known.draws[7] == rounds if floor == 1.0 else known.draws[7] > 3 * np.median(known.draws)


def test_failing_draws_new_scenes_of_an_endless_source():
    known = samplers.count_draws(samplers.empty(None), np.arange(10))
    known = samplers.update_outcomes(known, np.array([2, 3, 3]), np.array([4, 1, 3]), np.array([0, 5, 3]), memory=0.5)
    np.testing.assert_array_equal(known.successes[:4], [0, 0, 0, 4])  # never more than lives
    drawn = samplers.prioritize_failures(known, 6, seed=0, floor=0.5)
    assert set(drawn[:2]) == {2, 3} and list(drawn[2:]) == [10, 11, 12, 13]  # only two were driven in: new ones fill up
    with pytest.raises(ConfigError, match=r"stream\.sampler\.floor: expected a number > 0 and <= 1, got 0"):
        instantiate({"_target_": "prioritize_failures", "floor": 0.0}, builtins=samplers, where="stream.sampler", seed=0)


def test_what_was_learnt_earlier_fades():
    known = table([1, 1], np.array([8.0, 8.0]), np.array([2.0, 2.0]))
    after = samplers.update_outcomes(known, np.array([1, 1, 0]), np.array([3, 1, 0]), np.array([3, 1, 0]), memory=0.5)
    np.testing.assert_array_equal(after.episodes, [8.0, 8.0])  # nobody's life ended in world 0: nothing is forgotten
    np.testing.assert_array_equal(after.successes, [2.0, 5.0])


# ---- what is loaded


def entry(*overrides, **trouble):
    """A training config whose generator makes streets; see `streets.street`."""
    found = hydra_config.load_config("train", "experiment=smoke", "stream=shuffled", *SHORT, *overrides)
    troubles = {"unusable": [], "broken": [], "deadly": [], "endless": []} | trouble
    found["scenes"]["generate"] = {"_target_": "support.streets.street"} | troubles
    return found


def flowing(found):
    """A flow with its scenes as they come, and what puts them where they belong."""

    def put(leaf, row, worlds):
        leaf = np.array(leaf)
        leaf[worlds] = row
        return leaf

    def swap(state, held, worlds, fresh):
        return state, jax.tree.map(lambda leaf, row: put(leaf, row, worlds), held, fresh)

    return stream.open_stream(found, mesh=None, before=None), swap


def alone(found, index, sizes):
    """One street, stacked by itself at the stream's sizes."""
    return load(loader_of(found), [index], sizes).scene


def load(loader, indices, sizes, how="cut"):
    """A batch of these entries."""
    rows = list(batches.load_rows(loader, indices, sizes, on_overflow=how))
    return batches.stack_rows(loader.source, indices, rows, sizes)


def loader_of(found):
    config = found["scenes"]
    packing = scene_source.make_packing(config)
    return batches.BatchLoader(scene_source.open_source(config), **packing, grid=config["road_grid"], task_map=task_map.in_process)


def measured(loader, *, sample=8, **given):
    return batches.measure(loader, sample=mixture.choose_sample(loader.source, (), sample, seed=0), headroom=1.0, given=given)


def test_every_world_holds_the_scene_that_the_stream_says():
    found = entry("worlds=6")
    context, swap = flowing(found)
    with context as flow:
        held = flow.scenes()
        for _ in range(4):
            _, held = flow.exchange(swap, None, held)
            flow.draw()
            flow.note(np.full(6, 2), np.array([0, 0, 0, 2, 2, 2]))
        told = flow.state()
    assert told["placed"] == [12, 13, 14, 15, 16, 17] and told["waiting"] == [[18, 19, 20], [21, 22, 23]]  # three by three, in turn
    for world, index in enumerate(told["placed"]):
        same(jax.tree.map(lambda leaf, world=world: np.asarray(leaf)[[world]], held), alone(found, index, told["sizes"]))
    settled = np.asarray(told["episodes"])[:12]
    assert (settled[3:] > 0).all() and told["draws"] == [1] * 24


def test_loading_is_measured_alone():
    found = loading.measure(entry("worlds=4") | {"warmup": 1, "repeats": 2})
    assert found["scenes"] == 4 and found["scenes_per_s"] > 0 and found["ms_of_this_process_a_scene"] > 0


def test_a_resumed_stream_brings_the_scenes_of_an_unbroken_one():
    found = entry("worlds=6", "stream=failing")
    _, swap = flowing(found)

    def advance(flow, turns):
        held = flow.scenes()
        for turn in turns:
            _, held = flow.exchange(swap, None, held)
            flow.draw()
            flow.note(np.full(6, 3), np.arange(6) % (turn + 2))
        return held, json.loads(json.dumps(flow.state()))

    with stream.open_stream(found, mesh=None, before=None) as flow:
        whole, whole_state = advance(flow, range(5))
    with stream.open_stream(found, mesh=None, before=None) as flow:
        _, state = advance(flow, range(2))
    with stream.open_stream(found, mesh=None, before=state) as flow:
        resumed, resumed_state = advance(flow, range(2, 5))
    assert resumed_state == whole_state and state != whole_state and whole_state["exchanges"] == 5
    same(resumed, whole)


def test_a_bank_and_a_generator_stream_the_same_scenes(tmp_path, monkeypatch):
    monkeypatch.setattr(bank_reader, "SHARD", 2)  # scenes 1 and 4 lie in different files
    found = entry("scenes.pack.agents=3")
    plain = {"unusable": [], "broken": [], "deadly": [], "endless": []}
    written_bank = bank_reader.write(tmp_path / "bank", [street(0, index, **plain) for index in range(5)], settings={})
    banked = {**found, "scenes": {**found["scenes"], "path": str(tmp_path / "bank")}}
    loaders = [loader_of(one) for one in (found, banked)]
    sources, sizes = [one.source for one in loaders], [measured(one, sample=5, side=60) for one in loaders]
    assert [one.count for one in sources] == [None, 5] and sizes[0] == sizes[1] and sources[1].name(3) == "street 3"
    generated, loaded = (load(one, [4, 1, 4], sizes[0]) for one in loaders)
    same(generated.scene, loaded.scene)
    packing = scene_source.make_packing(found["scenes"])
    whole, _ = stacked_scenes(written_bank, [4, 1, 4], capacity={axis: sizes[0][axis] for axis in batches.AXES}, **packing)
    same(
        loaded.scene,
        spatial_grid.attach_grid(whole, **found["scenes"]["road_grid"], capacity={name: sizes[0][name] for name in spatial_grid.SIZES}),
    )


def test_files_stream_and_what_cannot_be_used_is_left_out_by_name(tmp_path):
    for name in ("one", "two"):
        written(tmp_path, document(name=name, objects=[thing(0, id=7, speed=40)]), f"{name}.json")
    (tmp_path / "broken.json").write_text("{}")
    found = hydra_config.load_config("train", "experiment=smoke", "scenes=womd", f"scenes.path={tmp_path}")
    files = loader_of(found)
    assert files.source.count == 3 and files.source.name(0).endswith("broken.json")
    sizes = measured(files)
    batch = load(files, [0, 1, 2], sizes)
    assert list(batch.indices) == [1, 1, 2] and list(batch.refused) == [str(tmp_path / "broken.json")]
    with pytest.raises(SceneError, match=r"none of 1 scenes to load can be used: .*broken\.json: .*unknown format"):
        load(files, [0], sizes)


def test_scenes_above_the_capacity_are_cut_or_left_out_and_counted():
    found = entry()
    streets = loader_of(found)
    sizes = measured(streets, road=210, lanes=70, edges=140)  # streets 0 to 2 fit
    cut, skipped = (load(streets, range(8), sizes, how) for how in ("cut", "skip"))
    assert (cut.cut, list(cut.indices), cut.refused) == (5, list(range(8)), {})
    assert (skipped.cut, list(skipped.indices[:3]), len(skipped.refused)) == (0, [0, 1, 2], 5) and set(skipped.indices) == {0, 1, 2}
    assert "cut to capacity lanes=70" in skipped.refused["generated scene 7"]
    small = load(streets, range(8), sizes | {"side": 20})
    assert small.refused and all("capacity.side: expected at least" in reason for reason in small.refused.values())


def test_room_for_more_changes_no_look_up():
    found = entry()
    sizes = measured(loader_of(found))
    places = np.random.default_rng(0).uniform(-90.0, 90.0, (200, 2)).astype(np.float32)
    observed = []
    for one in (sizes, sizes | {"side": 45, "rows": 30_000, "longest_list": 400}):
        grid = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), alone(found, 3, one).road_grid)
        rows, listed = map(np.asarray, spatial_grid.list_segments(grid, *spatial_grid.find_cell_bounds(grid, jnp.asarray(places))))
        observed.append([list(row[there]) for row, there in zip(rows, listed, strict=True)])
    assert observed[0] == observed[1] and any(observed[0])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["stream.capacity.road=8"], r"stream\.capacity\.road: 8; all 4 scenes of the sample need more: 177 to 213"),
        (["stream.capacity.road=1000000000"], r"stream\.capacity\.road: 1000000000; the scenes of 8 worlds would take .* GiB, stream\.mem"),
        (["stream.capacity.lanes=true"], r"stream\.capacity\.lanes: expected an integer or null, got True"),
        (["+stream.capacity.lane=8"], r"stream\.capacity\.lane: unknown; valid: road, lanes, "),
        (["stream.swap_fraction=1.5"], r"stream\.swap_fraction: expected a number >= 0 and <= 1, got 1\.5"),
        (["stream.prefetch=0"], r"stream\.prefetch: expected an integer >= 1, got 0"),
        (["stream.on_overflow=drop"], r"stream\.on_overflow: expected cut or skip, got 'drop'"),
        (["stream.sampler._target_=random"], r"stream\.sampler\._target_: 'random' is not in .*; valid: .*prioritize_failures, .*shuffled"),
        (["+stream.speed=2"], r"stream\.speed: unknown key"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message), stream.open_stream(entry(*overrides), mesh=None, before=None):
        pass


def test_processes_with_nothing_to_load_are_named(capsys):
    for workers, said in ((2, True), (1, False)):
        few = entry("stream.prefetch=1", "stream.swap_fraction=0.01", f"stream.workers={workers}")
        with stream.open_stream(few, mesh=None, before=None):
            assert ("stream.workers: 2 processes for stream.prefetch=1 x 1 worlds: the others" in capsys.readouterr().out) == said


def test_errors_of_the_loader_surface_by_name_and_never_hang(capsys):
    context, swap = flowing(entry(unusable=[6], broken=[9]))
    with pytest.raises(RuntimeError, match="generated scene 9: cannot be loaded: ZeroDivisionError: a bug"), context as flow:
        held = flow.scenes()
        for _ in range(9):
            _, held = flow.exchange(swap, None, held)
            flow.draw()
    assert "left out generated scene 6: street 6: nobody drives here" in capsys.readouterr().out
    context, swap = flowing(entry("stream.wait_s=2.0", unusable=list(range(4, 99))))
    with pytest.raises(SceneError, match="none of 2 scenes to load can be used: generated scene 4: street 4: nobody"), context as flow:
        flow.exchange(swap, None, flow.scenes())
    with pytest.raises(SceneError, match="not one of 4 can be used: street 0: nobody"), flowing(entry(unusable=list(range(9))))[0]:
        pass


@pytest.mark.slow
def test_processes_that_die_or_hang_end_the_run_by_name():
    context, swap = flowing(entry("stream.workers=1", deadly=[5]))
    with pytest.raises(RuntimeError, match=r"generated scene 5: cannot be loaded: its process ended with code 1"), context as flow:
        flow.exchange(swap, None, flow.scenes())
    context, swap = flowing(entry("stream.workers=1", "stream.wait_s=20.0", endless=[5]))
    with pytest.raises(RuntimeError, match=r"stream\.wait_s: no scenes after 20 s from generated scenes of seed"), context as flow:
        flow.exchange(swap, None, flow.scenes())


# ---- training


def streamed(folder, *overrides):
    """A run of seconds on streets that come and go."""
    found = smoke(folder, "stream=failing", *SHORT, "evaluation.enable=false", *overrides)
    found["scenes"]["generate"] = entry()["scenes"]["generate"]
    return found


@pytest.mark.slow
def test_a_killed_and_resumed_run_is_the_unbroken_one(tmp_path):
    whole = run_train(streamed(tmp_path / "whole", "iterations=5", "checkpoint_every=2"))

    def killed(state, row):
        if row["iteration"] == 3:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        run_train(streamed(tmp_path / "run", "iterations=5", "checkpoint_every=2"), on_iteration=killed)
    assert checkpoint.latest(tmp_path / "run" / "checkpoints") == 2
    with pytest.raises(ConfigError, match=r"resume=true: stream=None \(the run has \{\.\.\.\}\)"):
        run_train(streamed(tmp_path / "run", "iterations=5", "resume=true") | {"stream": None})
    resumed = run_train(streamed(tmp_path / "run", "iterations=5", "checkpoint_every=2", "resume=true"))
    same(resumed.state, whole.state)
    told, again = (checkpoint.restore_host(tmp_path / name / "checkpoints") for name in ("whole", "run"))
    assert told == again and told is not None and told["exchanges"] == 4
    rows, others = metrics_csv.read(tmp_path / "whole"), metrics_csv.read(tmp_path / "run")
    assert len(rows) == 5 and [row["stream/scenes"] for row in rows][-1] == len(told["draws"])
    for row, other in zip(rows, others, strict=True):
        assert {name: row[name] for name in row if name not in CLOCK} == {name: other[name] for name in other if name not in CLOCK}
    np.testing.assert_array_equal(told["record"], [whole.state.scene_stats.episodes, whole.state.scene_stats.successes])


def test_the_cost_of_a_stream_stands_beside_the_same_worlds_in_memory():
    row = {"name": "in memory", "fits": True, "scope": "training", "worlds": 64, "slots": 16, "devices": 1, "horizon": 32, "per_s": 9.0,
           "slots_per_s": 2000.0, "ms_a_control_step": 512.0}  # fmt: skip
    told = {"swapped": 4, "wait_ms": 12.34, "scenes": 4096, "cut": 3, "refused": 1}
    moving = row | {"name": "shuffled", "slots_per_s": 1900.0, "ms_a_control_step": 500.0, "stream": told}
    other = moving | {"name": "larger", "worlds": 128}
    table = throughput_report.streaming_table({"rows": [row | {"devices": 2, "slots_per_s": 1.0}, row, moving, other]}).splitlines()[2:]
    assert table[0] == "| shuffled | 4 of 64 | 0.2 | 9 | 1,900 | 5.0 % of `in memory` | 12.3 | 4,096 | 3 and 1 |"
    assert "of `in memory`" not in table[1] and throughput_report.streaming_table({"rows": [row]}) == ""
    with pytest.raises(ConfigError, match=r"stream: scenes are exchanged while training; scope=physics has stream=none"):
        streaming.measure(hydra_config.load_config("benchmark", "stream=shuffled", "scope=physics"), mesh=None)
