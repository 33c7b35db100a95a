"""Scenes on the host: stacks, banks on disk, conversion, MJCF."""

import functools
import gzip
import importlib
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np
import pyarrow as pa
import pytest
import shapely
from support import eventful
from support.choosing import slow_except
from support.scene_banks import packed_scenes, stacked_scenes
from support.scene_documents import (
    FORMATS,
    STEPS,
    WOMD,
    checker,
    curve,
    document,
    packer,
    parsed,
    prepared,
    scenefactory_document,
    thing,
    written,
)

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel import task_map as spreads
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import Light, LightPlan, Polyline, Reject, SceneError, Track
from scenefactory_jax.core.types import Boxes, Scene
from scenefactory_jax.data import conversion
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer
from scenefactory_jax.data.curation import operations
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import columns, stack
from scenefactory_jax.data.packing import summary as summary_text
from scenefactory_jax.visualization import road_lines
from scenefactory_jax.visualization.mujoco import world_mjcf

NONE = dict.fromkeys(stack.AXES)


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make(FORMATS)


@pytest.fixture
def street(tmp_path, readers):
    return parsed(tmp_path, document(), readers)


# ---- stacks


def test_stack_pads_with_masked_rows(street):
    small, large = prepared(street, agents=2).scene, prepared(replace(street, roads=(*street.roads, curve(2, 20, 300))), agents=3).scene
    stacked, report = stack.stack([small, large], capacity=NONE)
    rows = {"road": 512, "lanes": 512, "edges": 256, "agents": 3, "steps": STEPS}
    assert report.capacity == rows | dict.fromkeys(stack.MAY_BE_EMPTY, 0) and not report.cuts
    assert stacked.road.midpoint.shape == (2, 512, 2) and stacked.log.position.shape == (2, 3, STEPS, 2) and stacked.log.dt.shape == (2,)
    for world, scene in enumerate((small, large)):
        for name, leaf in columns.flatten(scene).items():
            whole = columns.flatten(stacked)[name][world]
            np.testing.assert_array_equal(whole[tuple(map(slice, leaf.shape))], leaf)
            if name.endswith((".valid", ".present")):
                assert whole.sum() == leaf.sum()
    assert (stacked.agents.size > 0).all()
    again, _ = stack.stack([columns.assemble_columns(Scene, {n: a[0] for n, a in columns.flatten(stacked).items()})], capacity=NONE)
    np.testing.assert_array_equal(again.road.midpoint[0, :256], stacked.road.midpoint[0, :256])


def test_a_capacity_cuts_what_is_farthest_and_says_so(street):
    scene = prepared(street).scene
    stacked, report = stack.stack([scene], capacity=NONE | {"road": 40, "agents": 1, "steps": 11})
    account = "\n".join(stack.describe(report))
    assert {cut.axis: (cut.had, cut.kept) for cut in report.cuts} == {"road": (160, 40), "agents": (2, 1), "steps": (12, 11)}
    assert "cut to capacity road=40: 120 of 160 in 1 worlds, the nearest" in account and "agents=1" in account and "steps=11" in account
    used = np.concatenate([scene.agents.position[:1], scene.agents.goal[:1], scene.log.position[0, :11]])
    distance = np.linalg.norm(scene.road.midpoint[:, None] - used, axis=2).min(1)
    kept = {tuple(point) for point in stacked.road.midpoint[0].tolist()}
    inside = np.array([tuple(point) in kept for point in scene.road.midpoint.tolist()])
    assert inside.sum() == 40 and distance[inside].max() <= distance[~inside].min() + 1e-5
    assert stacked.road.kind[0].tolist() == sorted(stacked.road.kind[0].tolist())
    for wrong, message in (({"road": 0}, "capacity.road: expected .* >= 1 or null, got 0"), ({"lane": 3}, "capacity.lane: unknown key")):
        with pytest.raises(ConfigError, match=message):
            stack.stack([scene], capacity=wrong)
    with pytest.raises(SceneError, match="no scenes"):
        stack.stack([], capacity=NONE)


# ---- rows and banks


def exactly(one, other):
    """Whether two scenes are the same, bit for bit."""
    assert type(one) is type(other)
    for name, value in vars(one).items():
        there = getattr(other, name)
        if isinstance(value, tuple) and value and hasattr(value[0], "__dataclass_fields__"):
            assert len(value) == len(there)
            for part, its in zip(value, there, strict=True):
                exactly(part, its)
        elif isinstance(value, LightPlan):
            assert value.period_s == there.period_s
            np.testing.assert_array_equal(value.start_s, there.start_s)
            np.testing.assert_array_equal(value.state, there.state)
        elif isinstance(value, np.ndarray):
            assert value.shape == there.shape and value.astype(there.dtype).tobytes() == there.tobytes(), name
        else:
            assert value == there and type(value) is type(there), name


def whole(street):
    """A scene in which every field says something."""
    steps, rng = len(street.times), np.random.default_rng(0)
    lane = replace(street.roads[1], entry=(2**40, 7), exit=(3,), left=(1,), right=(5, 6), speed_limit=1 / 3, rebuilt=True)
    bare = Polyline(kind=19, xyz=np.zeros((0, 3)), id=-1)
    plan = LightPlan(np.array([0.5, 1 / 3 + 1, 7.0]), np.array([6, 5, 4]), 20.5)
    lights = tuple(Light(lane=i, state=rng.integers(0, 9, steps), valid=rng.random(steps) > 0.5, stop=stop, plan=known)
                   for i, (stop, known) in enumerate(((None, plan), (np.array([1 / 3, 2e4, -0.1]), None))))  # fmt: skip
    sign = Polyline(kind=17, xyz=np.zeros((1, 3)), id=70, lanes=(3, 2**40))
    track = replace(street.tracks[0], xyz=rng.normal(8e3, 1.0, (steps, 3)), kind="cyclist", size=(0.1, 1 / 7, 2.0))
    metadata = {"dataset": "WOMD", "tags": ["é", None, {"a": 1.5}]}
    changes = {"lights": lights, "origin": (0.1, -2e6, 1 / 3), "metadata": metadata, "sdc": None, "name": "straße"}
    return replace(street, roads=(lane, bare, sign, *street.roads), tracks=(*street.tracks, track), **changes)


def test_a_row_gives_back_the_scene_exactly(street):
    empty = replace(street, roads=(), tracks=(), sdc=None, times=np.zeros(1), current=0)
    for raw in (street, whole(street), empty):
        exactly(arrow_codec.decode(arrow_codec.encode(raw)), raw)
    uneven = unchecked(Track, **vars(street.tracks[0]) | {"valid": street.tracks[0].valid[1:]})
    for message, changes in {
        "track 7: xyz, yaw, velocity and valid differ in length": {"tracks": (uneven,)},
        "metadata holds a set": {"metadata": {"a": {1}}},
        "too (big|large)": {"roads": (replace(street.roads[0], id=2**70),)},
    }.items():
        with pytest.raises(SceneError, match=f"scene.json: street: no bank can hold it: .*{message}"):
            arrow_codec.encode(replace(street, **changes))


def age(raw):
    """A scene as banks of schema 4 hold it: stop signs name their lanes in the metadata, lights have no cycle."""
    batch = arrow_codec.encode(replace(raw, metadata=raw.metadata | {"stop_sign_lanes": {"70": [3, 2**40]}}))
    columns = [batch.column(name) for name in batch.schema.names]
    for name, leaf in (("roads", "lanes"), ("lights", "plan"), ("lights", "period_s")):
        place = batch.schema.names.index(name)
        entries = columns[place].values
        kept = [field for field in entries.type if field.name != leaf]
        older = pa.StructArray.from_arrays([entries.field(field.name) for field in kept], fields=kept)
        columns[place] = pa.ListArray.from_arrays(columns[place].offsets, older)
    return pa.RecordBatch.from_arrays(columns, schema=arrow_codec.SCHEMA_4)


def test_older_banks_are_read_and_their_copies_are_new_ones(tmp_path, street):
    raw = whole(street)
    expected = replace(raw, lights=tuple(replace(light, plan=None) for light in raw.lights))
    path = bank_reader.write(tmp_path / "bank", [raw], settings={}).path
    for file in path.iterdir():
        file.unlink()
    shard = ([age(raw)], bank_reader.catalogue.table([bank_reader.catalogue.row(raw)]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrow_codec, "SCHEMA", arrow_codec.SCHEMA_4)
        patch.setattr(bank_index, "SCHEMA", 4)
        bank_writer.fill(path, [shard], settings={}, compression=None)
    older = bank_reader.open(path)
    exactly(bank_reader.read_raw(older, 0), expected)
    view = bank_reader.save(older, tmp_path / "view", copy=False, settings={})
    copy = bank_reader.save(view, tmp_path / "copy", copy=True, settings={})
    for bank in (view, copy):
        exactly(bank_reader.read_raw(bank, 0), expected)
    assert pa.ipc.open_file(copy.shards[0].file).schema == arrow_codec.SCHEMA


TOOLS = {"check": checker(), "pack": packer(agents=3), "workers": 1}


@pytest.fixture
def made(tmp_path, street):
    """Three scenes of different sizes, and the bank of them."""
    raws = [street, whole(street), replace(street, name="third", roads=street.roads[1:])]
    return raws, bank_reader.write(tmp_path / "bank", raws, settings={"seed": 3}, features=lambda raw: {"letters": len(raw.name)})


def test_a_bank_gives_back_what_it_was_given(tmp_path, made):
    raws, opened = made
    shutil.move(tmp_path / "bank", tmp_path / "elsewhere")
    moved = bank_reader.open(tmp_path / "elsewhere")
    assert moved.names == ("street", "straße", "third") and moved.settings == {"seed": 3} and len(opened) == 3
    for index, raw in enumerate(raws):
        exactly(bank_reader.read_raw(moved, index), raw)
    exactly(bank_reader.read_raw(moved, -1), raws[2])
    with pytest.raises(ValueError, match="read-only"):
        bank_reader.read_raw(moved, 0).tracks[0].xyz[:] = 0.0  # the file itself, not a copy
    table = moved.metadata.to_pydict()
    assert table["letters"] == [6, 6, 5] and table["sdc"] == [7, None, 7] and table["lights"] == [0, 2, 0] and table["edges"] == [1, 1, 0]
    assert table["vehicles"] == [2, 2, 2] and table["cyclists"] == [0, 1, 0] and table["max_x"] == [40.0, 40.0, 40.0]
    stacked, report = stacked_scenes(moved, [2, 0, 2], capacity=NONE | {"road": 79}, **TOOLS)
    expected, _ = stack.stack([prepared(raws[i], agents=3).scene for i in (2, 0, 2)], capacity=NONE | {"road": 79})
    for name, leaf in columns.flatten(expected).items():
        np.testing.assert_array_equal(columns.flatten(stacked)[name], leaf)
    assert sorted(cut.world for cut in report.cuts) == [0, 1, 2]
    with pytest.raises(SceneError, match="no scene 7; valid: 0 to 2"):
        bank_reader.read_raw(moved, 7)


def test_what_cannot_be_packed_is_refused_or_named(made):
    _, opened = made
    [found] = packed_scenes(opened, [0], **TOOLS | {"pack": packer(scene_size_m=2.0)})
    assert (found.scene, found.kind) == ("street", "no_agent_left") and found.reason.startswith("tracks: no agent is left of 2: 1 ")
    found = packed_scenes(opened, [1, 0], **TOOLS | {"pack": packer(scene_size_m=2.0, require_agents=False, centre="mean")})
    assert isinstance(found[0], Reject) and found[0].scene == "straße" and "no driving lane" in found[0].reason


def test_views_refer_and_copies_do_not(tmp_path, made):
    raws, opened = made
    other = bank_reader.write(tmp_path / "b" / "other", raws[:2], settings={})
    both = bank_reader.join([bank_reader.view(opened, [2, 0]), other, bank_reader.view(opened, [2])])
    expected = [2, 0, 0, 1, 2]
    assert both.names == tuple(raws[i].name for i in expected) and both.metadata["letters"].to_pylist() == [5, 6, None, None, 5]
    view = bank_reader.save(both, tmp_path / "views" / "both", copy=False, settings={"filter": "lanes > 1"})
    own = bank_reader.save(both, tmp_path / "copy", copy=True, settings={})
    assert sum(file.stat().st_size for file in view.path.iterdir()) < 20_000 and view.settings == {"filter": "lanes > 1"}
    assert [shard["file"] for shard in json.loads((view.path / bank_reader.INDEX).read_text())["shards"]] == [
        "../../bank/scenes-00000.arrow", "../../b/other/scenes-00000.arrow"]  # fmt: skip
    for found in (view, own, bank_reader.save(bank_reader.view(view, [4, 3]), view.path, copy=False, settings={})):
        order = expected if len(found) == 5 else [2, 1]
        for index, place in enumerate(order):
            exactly(bank_reader.read_raw(found, index), raws[place])
    shutil.move(tmp_path / "bank", tmp_path / "gone")
    with pytest.raises(SceneError, match=r"bank/scenes-00000\.arrow: missing; .* a view also the banks that it refers to"):
        bank_reader.open(view.path)
    exactly(bank_reader.read_raw(bank_reader.open(tmp_path / "copy"), 0), raws[2])
    with pytest.raises(SceneError, match="a view of no scene"):
        bank_reader.view(own, [])
    with pytest.raises(SceneError, match="cannot take the place of the bank that it refers to"):
        bank_reader.save(bank_reader.view(own, [0]), own.path, copy=False, settings={})


def test_a_bank_replaces_a_bank_and_nothing_else(tmp_path, made):
    raws, opened = made
    again = bank_reader.save(bank_reader.view(opened, [1]), opened.path, copy=True, settings={})  # filtered onto itself
    assert again.names == ("straße",)
    exactly(bank_reader.read_raw(opened, 0), raws[0])  # what was mapped stays as it was
    with pytest.raises(SceneError, match="cut short or changed"):
        bank_reader.read_raw(replace(opened, readers={}), 0)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(SceneError, match="exists and is no bank"):
        bank_reader.write(tmp_path / "home", raws, settings={})

    def breaks():
        yield raws[0]
        raise RuntimeError("disk on fire")

    with pytest.raises(RuntimeError):
        bank_reader.write(opened.path, breaks(), settings={})
    assert bank_reader.open(opened.path).names == ("straße",)
    with pytest.raises(SceneError, match="no scene to write"):
        bank_reader.write(tmp_path / "empty", [], settings={})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bank", "home", "scene.json"]  # no leftovers


def test_what_is_chosen_of_a_stopped_conversion_does_not_say_that_it_is_whole(tmp_path, made):
    _, opened = made
    bank_index.write(opened.path, replace(opened.index, complete=False))
    stopped = bank_reader.open(opened.path)
    assert not opened.unfinished and "whose conversion was stopped" in stopped.unfinished
    several = {"view": bank_reader.view(stopped, [0]), "join": bank_reader.join([opened, stopped])}
    several |= {f"copy={copy}": bank_reader.save(several["join"], tmp_path / f"{copy}", copy=copy, settings={}) for copy in (True, False)}
    assert {name: one.unfinished for name, one in several.items()} == dict.fromkeys(several, stopped.unfinished)
    assert not bank_reader.join([opened, opened]).unfinished


def test_a_bank_that_cannot_be_read_is_named(tmp_path, made):
    _, opened = made
    path = opened.path
    with pytest.raises(SceneError, match="no such folder"):
        bank_reader.open(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"no bank: it has no bank\.json"):
        bank_reader.open(tmp_path)
    bank_reader.verify(path)
    for name in ("scenes-00000.arrow", "metadata-00000.arrow"):
        file = path / name
        content = file.read_bytes()
        file.write_bytes(content[:-8])
        with pytest.raises(SceneError, match=rf"{name}: \d+ bytes, cut short or changed: there were \d+"):
            bank_reader.open(path)
        middle = len(content) // 2
        file.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
        with pytest.raises(SceneError, match=rf"damaged: .*{name}: not what was written"):
            bank_reader.verify(path)
        file.write_bytes(bytes(len(content)))
        with pytest.raises(SceneError, match=f"{name}: damaged"):
            bank_reader.read_raw(bank_reader.open(path), 0)
        file.unlink()
        with pytest.raises(SceneError, match=f"{name}: missing"):
            bank_reader.open(path)
        file.write_bytes(content)
    index = json.loads((path / bank_reader.INDEX).read_text())
    for schema, message in ((2, "a bank of packed scenes, schema 2; .*convert its source again"), (99, "a bank of schema 99; this")):
        (path / bank_reader.INDEX).write_text(json.dumps({**index, "schema": schema, "sha256": None}))
        with pytest.raises(SceneError, match=message):
            bank_reader.open(path)
    del index["shards"]
    (path / bank_reader.INDEX).write_text(json.dumps({**index, "schema": 3, "sha256": None}))
    with pytest.raises(SceneError, match=r"bank\.json: damaged: 'shards'"):
        bank_reader.open(path)


def test_scenes_that_are_held_hold_no_file_open(made):
    _, opened = made
    descriptors = lambda: len(os.listdir("/proc/self/fd"))  # noqa: E731
    before = descriptors()
    held = [bank_reader.read_raw(bank_reader.open(opened.path), 1) for _ in range(50)]
    assert descriptors() == before and len(held) == 50
    exactly(bank_reader.read_raw(pickle.loads(pickle.dumps(opened)), 1), held[0])


# ---- conversion


def options(**changes):
    tools = {"formats": reader_selection.make(FORMATS), "check": checker(), "pack": packer()}
    tools |= {name: changes.pop(name) for name in list(changes) if name in ("formats", "check", "pack", "refine", "features")}
    numbers = {"settings": WOMD["pack"], "spread": map, "shard_scenes": 2, "compression": None}
    return {"tools": conversion.SceneTools(**tools)} | numbers | changes


def streets(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        written(folder, document(name=name), f"{name}.json")
    return folder


def test_a_bad_file_is_listed_and_the_rest_goes_on(tmp_path):
    folder = tmp_path / "in"
    (folder / "deep").mkdir(parents=True)
    written(folder, document(), "a.json")
    written(folder, json.dumps(document())[:500], "b.json")
    written(folder, document(objects=[thing(0, speed=0)]), "c.json")
    written(folder / "deep", scenefactory_document(), "d.json.gz", gzip.open)
    written(folder, "hidden", ".note")
    observed = []
    summary = conversion.convert(folder, tmp_path / "bank", **options(on_file=lambda done, total: observed.append((done, total))))
    assert observed == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert (summary.files, summary.scenes, summary.agents_kept, summary.refused) == (4, 3, 3, {"no_agent_left": 1})
    [reject] = summary.rejects
    assert Path(reject["source"]).name == "b.json" and "cut short" in reject["reason"]
    opened = bank_reader.open(tmp_path / "bank")
    assert list(opened.rejects) == list(summary.rejects) and opened.settings["scene_size_m"] == 200.0
    assert opened.index.files == ("a.json", "b.json", "c.json", "deep/d.json.gz") and opened.index.complete
    assert opened.metadata["format"].to_pylist() == ["gpudrive", "gpudrive", "scenefactory"]
    lines = summary_text.describe(summary)
    assert lines[-1] == "3 scenes with 3 agents from 4 files, 1 rejected" and any("rejected" in line and "b.json" in line for line in lines)
    assert lines[-2] == "packing with these numbers refuses: 1 no agent left; such scenes stay in a bank, for other numbers"


def test_a_scene_that_packing_refuses_stays_for_another_box(tmp_path):
    """The cars have 4 m to go: none of their goals lies in a box of 6 m."""
    folder, out = streets(tmp_path / "in", "a", "b"), tmp_path / "bank"
    written(folder, document(name="still", objects=[thing(0, speed=0)]), "c.json")
    narrow = packer(scene_size_m=6.0)
    summary = conversion.convert(folder, out, **options(pack=narrow))
    opened = bank_reader.open(out)
    assert opened.names == ("a", "b", "still") and summary.refused == {"no_agent_left": 3} and not summary.rejects
    assert opened.metadata["packing"].to_pylist() == ["no_agent_left"] * 3
    found = operations.statistics(opened.metadata, by=None)["all"]["texts"]
    assert found["packing"] == {"no_agent_left": 3}
    wide = packed_scenes(opened, range(3), check=checker(), pack=packer(), workers=1)
    assert [type(one).__name__ for one in wide] == ["Packed", "Packed", "Reject"] and wide[2].kind == "no_agent_left"
    assert packed_scenes(opened, [2], check=checker(), pack=packer(require_agents=False), workers=1)[0].report.agents_kept == 0
    whole = conversion.convert(folder, tmp_path / "wide", **options())
    assert bank_reader.open(tmp_path / "wide").metadata["packing"].to_pylist() == ["packed", "packed", "no_agent_left"]
    assert whole.scenes == 3 and whole.agents_kept == 4 and whole.refused == {"no_agent_left": 1}


def test_a_folder_that_cannot_be_listed_is_named_and_read_later(tmp_path, monkeypatch):
    folder, out = streets(tmp_path / "in", "a"), tmp_path / "bank"
    closed, scandir = streets(folder / "closed", "b"), os.scandir
    (folder / "pipe").mkdir()
    os.mkfifo(folder / "pipe" / "endless")
    (folder / "z.json").symlink_to(folder / "nowhere.json")

    def refuses(path):
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    with monkeypatch.context() as patch:
        patch.setattr(os, "scandir", refuses)
        summary = conversion.convert(folder, out, **options())
    reasons = {Path(reject["source"]).name: reject["reason"] for reject in summary.rejects}
    assert summary.scenes == 1 and set(reasons) == {"closed", "z.json"}
    assert "a folder that cannot be listed" in reasons["closed"]
    assert conversion.convert(folder, out, **options()).scenes == 2 and bank_reader.open(out).names == ("a", "b")


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_what_happens_to_a_reader_costs_its_file_alone(tmp_path, workers):
    folder = streets(tmp_path / "in", "a", "b_killed", "c_two", "d_endless", "e_map", "f_broken", "g")
    spread = functools.partial(spreads.local, workers=workers, timeout_s=2.0)
    summary = conversion.convert(folder, tmp_path / "bank", **options(formats={"eventful": eventful.read}, spread=spread))
    reasons = {(Path(reject["source"]).stem, reject["scene"]): reject["reason"] for reject in summary.rejects}
    assert reasons == {
        ("b_killed", None): "its process was ended by SIGKILL, perhaps for want of memory",
        ("c_two", "second"): "record 2 at byte 77: its checksum is wrong",
        ("d_endless", None): "no result after 2 s (timeout_s)",
        ("f_broken", None): "KeyError: 'x'",
    }
    assert [Path(companion["source"]).name for companion in summary.companions] == ["e_map.json"]
    assert "1 files belong to scenes beside them: e_map.json" in summary_text.describe(summary) and summary.files == 7
    opened = bank_reader.open(tmp_path / "bank")
    assert opened.names == ("a", "c_two", "c_two", "g") and len(opened.index.shards) == 2
    assert sorted(path.name for path in opened.path.iterdir())[0] == "bank.json"  # no hidden leftovers


@pytest.mark.parametrize(("number", "kept"), slow_except([(1, 0), (5, 4)], (5, 4)))
def test_a_killed_conversion_goes_on_where_it_stopped(tmp_path, number, kept):
    names = [f"s{index}" for index in range(7)]
    folder, out = streets(tmp_path / "in", *names), tmp_path / "bank"
    rest = {name: value for name, value in options().items() if name != "spread"}
    process = multiprocessing.get_context("spawn").Process(target=eventful.convert_until, args=(number, folder, out, rest))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL and any(path.name.startswith(".") for path in out.iterdir())
    if kept:
        stopped = bank_reader.open(out)
        assert stopped.names == tuple(names[:kept]) and not stopped.index.complete
        assert stopped.index.files == tuple(f"{name}.json" for name in names[:kept])
    read = []
    reader = lambda path: read.append(path.stem) or eventful.read(path)  # noqa: E731
    if kept:
        with pytest.raises(SceneError, match=r"other settings \(scene_size_m: 200\.0 there, 150\.0 here\); give another out, or remove it"):
            conversion.convert(folder, out, **options(settings=WOMD["pack"] | {"scene_size_m": 150.0}))
    summary = conversion.convert(folder, out, **options(formats={"eventful": reader}))
    assert read == names[kept:] and summary.scenes == 7 and summary.agents_kept == 14
    whole = conversion.convert(folder, tmp_path / "straight", **options())
    assert summary == whole
    for file in sorted((tmp_path / "straight").iterdir()):
        if file.name != bank_reader.INDEX:
            assert file.read_bytes() == (out / file.name).read_bytes()
    streets(folder, "t7")  # a file that came later
    assert conversion.convert(folder, out, **options()).scenes == 8 and bank_reader.open(out).names[-1] == "t7"
    assert conversion.convert(folder, out, **options(formats={})).scenes == 8  # nothing is left to read
    assert sorted(path.name[0] for path in out.iterdir())[0] == "b"


def test_a_full_disk_ends_a_conversion_in_place_of_rejecting_every_file(tmp_path):
    resource = pytest.importorskip("resource")  # a limit on files stands for a full disk: the same path, with another reason
    folder, before = streets(tmp_path / "in", "a"), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        with pytest.raises(ConfigError, match=r"out: .*bank: .*File too large; the same command goes on once there is room"):
            conversion.convert(folder, tmp_path / "bank", **options())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert conversion.convert(folder, tmp_path / "bank", **options()).scenes == 1


def test_one_command_at_a_time_writes_a_bank(tmp_path, made):
    folder, out, raws = streets(tmp_path / "in", "a", "b", "c"), tmp_path / "deep" / "bank", made[0]
    writers = {
        "convert": lambda: conversion.convert(folder, out, **options()),
        "write": lambda: bank_reader.write(out, raws, settings={}),
        "save": lambda: bank_reader.save(made[1], out, copy=True, settings={}),
        "view": lambda: bank_reader.save(made[1], out, copy=False, settings={}),
    }

    def refused():
        for writer in writers.values():
            with pytest.raises(folder_lock.Busy, match=r"deep/bank: another command writes there now; wait for its end, or choose another"):
                writer()

    def stop(done, total):
        refused()
        raise KeyboardInterrupt

    def scenes():
        yield raws[0]
        refused()
        yield raws[1]

    for unfinished in (lambda: conversion.convert(folder, out, **options(on_file=stop)), lambda: bank_reader.write(out, [], settings={})):
        with pytest.raises((KeyboardInterrupt, SceneError)):
            unfinished()
        assert not out.parent.exists()
    assert bank_reader.write(out, scenes(), settings={}).names == ("street", "straße")
    assert len(writers["view"]()) == 3  # the lock went with the folder that was replaced
    shutil.rmtree(out)
    conversion.convert(folder, out, **options(on_file=lambda *_: refused()))
    assert sorted(path.name for path in out.iterdir())[0] == bank_reader.INDEX and bank_reader.open(out).names == ("a", "b", "c")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/bank: cannot be written: Not a directory; choose another folder"):
        bank_reader.write(tmp_path / "file" / "bank", raws, settings={})


@pytest.mark.slow
def test_a_file_that_gave_nothing_is_read_again(tmp_path):
    folder, out, read = streets(tmp_path / "in", "a_killed", "b", "c_two", "d_broken"), tmp_path / "bank", []
    spread = functools.partial(spreads.local, workers=2, timeout_s=9.0)
    first = conversion.convert(folder, out, **options(formats={"eventful": eventful.read}, spread=spread))
    assert (first.scenes, first.files, len(first.rejects)) == (3, 4, 3)
    reader = lambda path: read.append(path.stem) or eventful.plainly(path)  # noqa: E731
    again = conversion.convert(folder, out, **options(formats={"whole": reader}))  # they were repaired
    assert read == ["a_killed", "d_broken"] and (again.scenes, again.files, again.agents_kept) == (5, 4, 10)
    assert [reject["scene"] for reject in again.rejects] == ["second"] and sorted(bank_reader.open(out).names)[0] == "a_killed"
    assert conversion.convert(folder, out, **options(formats={"whole": reader})) == again and len(read) == 2


@pytest.mark.slow
def test_a_mistake_in_the_config_is_an_error_of_no_file(tmp_path):
    folder = streets(tmp_path / "in", "a", "b", "c")
    source = scene_source.open_files(folder, reader_selection.make(FORMATS))
    for workers in (1, 2):
        with pytest.raises(ConfigError, match=r"scenes\.pack\.car_size_m: expected \[length, width\] or null, got \[4.0\]"):
            scene_source.pack_all(source, check=checker(), pack=packer(car_size_m=[4.0]), workers=workers)


@pytest.mark.parametrize("numbers", [{"workers": 0}, {"timeout_s": 0.0}, {"timeout_s": -1.0}])
def test_numbers_with_which_nothing_would_be_done_are_refused(numbers):
    [name] = numbers
    with pytest.raises(ConfigError, match=rf"spread\.{name}: expected "):
        instantiate({"_target_": "local", "workers": 1, "timeout_s": None, **numbers}, builtins=spreads, where="spread")
    with pytest.raises(ConfigError, match=r"spread\.pending: expected an integer >= 1, got 0"):
        instantiate({"_target_": "ray", "address": None, "pending": 0, "timeout_s": None}, builtins=spreads, where="spread")


def test_nothing_usable_writes_no_bank(tmp_path):
    path = written(tmp_path, document(), "broken.json")
    with pytest.raises(SceneError, match=r"1 were rejected: KeyError: 'x'"):
        conversion.convert(path, tmp_path / "bank", **options(formats={"eventful": eventful.read}))
    assert not (tmp_path / "bank").exists()
    with pytest.raises(SceneError, match="1 were rejected: features: 'name' is a column that every bank has"):
        conversion.convert(written(tmp_path, document()), tmp_path / "bank", **options(features=lambda raw: {"name": 1}))


def cluster(monkeypatch):
    """A stand-in for Ray: it runs what it is given when that is asked for, and loses what dies."""

    class RayError(Exception):
        pass

    class RayTaskError(RayError):
        pass

    def get(reference):
        function, arguments = reference
        try:
            return function(*arguments)
        except KeyboardInterrupt as death:
            raise RayError("the worker died\nlong story") from death
        except SystemError as error:
            raise RayTaskError(f"ray::_timed() (pid=7)\n  File ...\n{error}\n") from error

    remote = lambda **_: lambda function: SimpleNamespace(remote=lambda *arguments: (function, arguments))  # noqa: E731
    fake = SimpleNamespace(init=lambda **_: None, put=lambda value: value, get=get, remote=remote)
    fake.exceptions, fake.cloudpickle = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError), pickle
    monkeypatch.setitem(sys.modules, "ray", fake)


def dies_of_three(item):
    if item == 3:
        raise KeyboardInterrupt
    return 10 * item


def missing(*_):
    raise SystemError("ModuleNotFoundError: No module named 'scenefactory_jax'")  # which the stand-in says in Ray's words


def test_a_cluster_is_a_spread_like_any_other(tmp_path, monkeypatch):
    ray = functools.partial(spreads.ray, address=None, pending=2, timeout_s=5.0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SceneError, match=r'Ray is not installed; `pip install "scenefactory_jax\[ray\]"`'):
        list(ray(dies_of_three, [1]))
    cluster(monkeypatch)
    assert list(ray(dies_of_three, [1, 2, 3, 4])) == [10, 20, spreads.FailedTask("Ray: RayError: the worker died"), 40]
    with monkeypatch.context() as without:
        without.setattr(spreads.worker, "run_task", missing)
        with pytest.raises(SceneError, match="cannot load the work: ModuleNotFoundError: No module named 'scenefactory_jax'; "):
            list(ray(dies_of_three, [1]))
    folder = streets(tmp_path / "in", "a", "b")
    assert conversion.convert(folder, tmp_path / "bank", **options(spread=ray)).scenes == 2


@pytest.mark.parametrize("over", ["processes", "cluster"])
def test_work_that_a_process_cannot_load_says_why(tmp_path, monkeypatch, over):
    """A reader in a module that only this process has."""
    (tmp_path / "here_alone.py").write_text("def read(path):\n    yield from ()\n")
    monkeypatch.syspath_prepend(tmp_path)
    work = importlib.import_module("here_alone").read
    pack = spreads._pack

    def pack_and_forget(*given):
        packed = pack(*given)
        (tmp_path / "here_alone.py").unlink()
        del sys.modules["here_alone"]
        return packed

    monkeypatch.setattr(spreads, "_pack", pack_and_forget)
    cluster(monkeypatch)
    spread = spreads.ray if over == "cluster" else spreads.local
    numbers = {"address": None, "pending": 2} if over == "cluster" else {"workers": 2}
    with pytest.raises(SceneError, match="cannot load the work: ModuleNotFoundError: No module named 'here_alone'; every process"):
        list(spread(work, [1, 2, 3], timeout_s=9.0, **numbers))
    monkeypatch.setattr(spreads, "_pack", pack)
    with pytest.raises(SceneError, match=r"cannot be sent to another process: .*; readers and parts must be functions of a module"):
        list(spreads.local(lambda item: item, [1], workers=1, timeout_s=9.0))


# ---- real data


@pytest.mark.slow
def test_real_scenes_convert_alike_in_one_process_and_in_two(tmp_path, shared_data):
    for path in [*sorted((shared_data / "womd" / "train").iterdir())[:2], *(shared_data / "formats" / "nocturne_old").iterdir()]:
        (tmp_path / path.name).symlink_to(path)
    alone = conversion.convert(tmp_path, tmp_path / "banks" / "one", **options())
    two = functools.partial(spreads.local, workers=2, timeout_s=None)
    summary = conversion.convert(tmp_path, tmp_path / "banks" / "two", **options(spread=two, compression="zstd"))
    assert alone.scenes == 3 and not alone.rejects and alone.agents_kept > 15 and summary == alone
    one, two = bank_reader.open(tmp_path / "banks" / "one"), bank_reader.open(tmp_path / "banks" / "two")
    assert sum(shard.bytes for shard in two.shards) < 0.4 * sum(shard.bytes for shard in one.shards)
    raws = [
        raw
        for path in reader_selection.find(tmp_path)
        if path.suffix == ".xz"
        for raw in reader_selection.read(path, reader_selection.make(FORMATS))
    ]
    for index, raw in enumerate(raws):
        exactly(bank_reader.read_raw(one, index), raw)
        exactly(bank_reader.read_raw(two, index), raw)
    stacked, report = stacked_scenes(one, range(3), capacity=NONE, check=checker(), pack=packer(), workers=1)
    finite = [leaf for name, leaf in columns.flatten(stacked).items() if name not in stack.ENDLESS]
    assert not report.cuts and all(np.isfinite(leaf).all() for leaf in finite)
    assert np.abs(stacked.road.midpoint).max() <= 100 and np.abs(stacked.agents.goal).max() <= 100
    near = np.linalg.norm(stacked.lanes.midpoint[:, None] - stacked.agents.position[:, :, None], axis=-1)
    near = np.where(stacked.lanes.valid[:, None], near, np.inf).min(axis=2)[stacked.agents.present]
    assert np.median(near) < 1.5  # cars drive on lanes: centre, units and axes agree
    agents = stacked.agents
    along = np.einsum("wad,wad->wa", agents.goal - agents.position, np.stack([np.cos(agents.yaw), np.sin(agents.yaw)], -1))
    assert (along[agents.present] > 0).mean() > 0.8  # goals lie ahead: headings are right, in degrees or radians


# ---- size


@pytest.mark.slow
def test_a_hundred_thousand_scenes_open_at_once(tmp_path, street):
    count, rng = 100_000, np.random.default_rng(0)
    lanes = [street.roads, (*street.roads, curve(2, 20.0, 9))]
    scenes = (replace(street, name=f"scene-{i:06d}", roads=lanes[i % 2], current=i % 11) for i in range(count))
    path = bank_reader.write(tmp_path / "bank", scenes, settings={}).path
    start = time.process_time()
    opened = bank_reader.open(path)
    assert time.process_time() - start < 1.0 and len(opened) == count and len(opened.shards) == 391
    start = time.process_time()
    chosen = np.flatnonzero((opened.metadata["lanes"].to_numpy() == 2) & (opened.metadata["current"].to_numpy() > 7))
    view = bank_reader.save(bank_reader.view(opened, chosen), tmp_path / "view", copy=False, settings={})
    assert time.process_time() - start < 1.0 and [int(name[-6:]) % 22 for name in view.names] == [i % 22 for i in chosen]
    order = rng.integers(0, len(view), 2000)
    start = time.process_time()
    raws = list(bank_reader.read_raws(view, order))
    assert time.process_time() - start < 2.0 and [raw.name for raw in raws] == [f"scene-{chosen[i]:06d}" for i in order]


# ---- MJCF


def stand_in_car():
    car = mujoco.MjSpec()
    chassis = car.worldbody.add_body(name="chassis", pos=[0, 0, 0.6])
    chassis.add_freejoint(name="root")
    chassis.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 1, 0.5], mass=1800)
    return car


LOOKS = {"goal_radius_m": 3.0, "scene_size_m": 200.0}


def test_a_scene_becomes_one_model(street):
    scene = prepared(replace(street, roads=(*street.roads, curve(2, 20, 50))), agents=4).scene
    model = world_mjcf.build_world(scene, dict.fromkeys(range(2), stand_in_car()), straight_m=None, **LOOKS)
    compiled = model.compile()
    assert compiled.ngeom == 1 + len(scene.road.kind) + 2 * 2 and compiled.nv == 2 * 6
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    for slot in (0, 1):
        np.testing.assert_allclose(data.body(f"agent{slot}/chassis").xpos, [*scene.agents.position[slot], 0.6], atol=1e-6)
        np.testing.assert_allclose(data.geom(f"goal{slot}").xpos[:2], scene.agents.goal[slot], atol=1e-6)
    for _ in range(200):
        mujoco.mj_step(compiled, data)
    assert {data.contact[i].geom1 for i in range(data.ncon)} == {compiled.geom("ground").id}  # road and goals touch nobody
    np.testing.assert_allclose(data.qpos[2], 0.5, atol=0.01)
    mujoco.MjModel.from_xml_string(model.to_xml())
    with pytest.raises(ValueError, match="free joint"):
        world_mjcf.build_world(scene, {0: mujoco.MjSpec()}, straight_m=None, **LOOKS)


def test_others_stand_in_the_model_and_can_be_hit(street):
    scene = prepared(street, agents=2).scene
    f = lambda *rows: jnp.array(rows, jnp.float32)  # noqa: E731
    still, size = f([0, 0], [0, 0]), f([4, 2], [4, 2])
    boxes = Boxes(f([9, 3], [0, 0]), f(0.7, 0), f(0.5, 0), still, f(0, 0), size, f(np.inf, np.inf), jnp.array([True, False]))
    model = world_mjcf.build_world(replace(scene, traffic=boxes), {0: stand_in_car()}, straight_m=None, **LOOKS).compile()
    assert model.geom("traffic0").size.tolist() == [2.0, 1.0, 0.75] and model.geom("traffic0").contype == 1
    with pytest.raises(KeyError):
        model.geom("traffic1")


def test_merged_segments_stay_within_the_tolerance(street):
    scene = prepared(replace(street, roads=(*street.roads, curve(2, 20, 50))), require_agents=False).scene
    single, merged = (list(road_lines.join_segments(scene.road, tolerance)) for tolerance in (None, 0.05))
    assert [len(points) for points, _ in single] == [81, 50, 81] and [kind for _, kind in merged] == [2, 2, 15]
    assert sum(len(points) - 1 for points, _ in merged) < 20
    for (fine, _), (coarse, _) in zip(single, merged, strict=True):
        assert shapely.LineString(coarse).hausdorff_distance(shapely.LineString(fine)) <= 0.05
