"""Scenes on the host: stacks, banks on disk, conversion, MJCF."""

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import shapely
from scene_documents import FORMATS, STEPS, WOMD, checker, curve, document, packer, parsed, prepared, scenefactory_document, thing, written

from scenefactory_jax.scenes import bank, columns, convert, mjcf, source, stack
from scenefactory_jax.scenes.raw import SceneError
from scenefactory_jax.types import Boxes, Scene

NONE = dict.fromkeys(stack.AXES)


@pytest.fixture(scope="module")
def readers():
    return source.make(FORMATS)


@pytest.fixture
def street(tmp_path, readers):
    return parsed(tmp_path, document(), readers)


# ---- stacks and banks


def test_stack_pads_with_masked_rows(street):
    small, large = prepared(street, agents=2).scene, prepared(replace(street, roads=(*street.roads, curve(2, 20, 300))), agents=3).scene
    stacked, report = stack.stack([small, large], capacity=NONE)
    assert report.capacity == {"road": 512, "lanes": 512, "edges": 256, "agents": 3, "steps": STEPS, "others": 0} and not report.cuts
    assert stacked.road.midpoint.shape == (2, 512, 2) and stacked.log.position.shape == (2, 3, STEPS, 2) and stacked.log.dt.shape == (2,)
    for world, scene in enumerate((small, large)):
        for name, leaf in columns.flatten(scene).items():
            whole = columns.flatten(stacked)[name][world]
            np.testing.assert_array_equal(whole[tuple(map(slice, leaf.shape))], leaf)
            if name.endswith((".valid", ".present")):
                assert whole.sum() == leaf.sum()
    assert (stacked.agents.size > 0).all()
    again, _ = stack.stack([columns.assemble(Scene, {n: a[0] for n, a in columns.flatten(stacked).items()})], capacity=NONE)
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
    for wrong, message in (({"road": 0}, "capacity.road: 0"), ({"lane": 3}, "capacity.lane: unknown; valid: road, lanes")):
        with pytest.raises(SceneError, match=message):
            stack.stack([scene], capacity=wrong)
    with pytest.raises(SceneError, match="no scenes"):
        stack.stack([], capacity=NONE)


@pytest.fixture
def made(tmp_path, street):
    """Two scenes of different sizes, and the bank of them."""
    scenes = [prepared(street, agents=3), prepared(replace(street, name="other", roads=street.roads[1:]), agents=2, log_from="current")]
    written = bank.write(tmp_path / "bank", scenes, settings={"box_m": 200.0}, rejects=[{"source": "x", "scene": None, "reason": "bad"}])
    return scenes, written


def test_a_bank_gives_back_what_it_was_given(tmp_path, made):
    scenes, opened = made
    shutil.move(tmp_path / "bank", tmp_path / "elsewhere")
    moved = bank.open(tmp_path / "elsewhere")
    assert moved.names == ("street", "other") and moved.settings == {"box_m": 200.0} and moved.rejects[0]["reason"] == "bad"
    assert isinstance(moved.leaves["road.midpoint"], np.memmap) and len(opened) == 2
    for index, packed in enumerate(scenes):
        found = bank.scene(moved, index)
        assert found.report == packed.report
        for name, leaf in columns.flatten(packed.scene).items():
            back = columns.flatten(found.scene)[name]
            assert back.dtype == leaf.dtype
            np.testing.assert_array_equal(back, leaf)
    stacked, report = bank.load(moved, [1, 0, 1], capacity=NONE | {"road": 79})
    wanted, _ = stack.stack([scenes[i].scene for i in (1, 0, 1)], capacity=NONE | {"road": 79})
    for name, leaf in columns.flatten(wanted).items():
        np.testing.assert_array_equal(columns.flatten(stacked)[name], leaf)
    assert sorted(cut.world for cut in report.cuts) == [0, 1, 2]
    with pytest.raises(SceneError, match="no scene 7; valid: 0 to 1"):
        bank.load(moved, [7], capacity=NONE)


def test_a_bank_replaces_a_bank_and_nothing_else(tmp_path, made):
    scenes, opened = made
    again = bank.write(opened.path, (bank.scene(opened, i) for i in (1,)), settings={})  # filtered onto itself
    assert again.names == ("other",)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(SceneError, match="exists and is no bank"):
        bank.write(tmp_path / "home", scenes, settings={})

    def breaks():
        yield scenes[0]
        raise RuntimeError("disk on fire")

    with pytest.raises(RuntimeError):
        bank.write(opened.path, breaks(), settings={})
    assert bank.open(opened.path).names == ("other",)
    with pytest.raises(SceneError, match="no scene to write"):
        bank.write(tmp_path / "empty", [], settings={})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bank", "home", "scene.json"]  # no leftovers


def test_a_bank_that_cannot_be_read_is_named(tmp_path, made):
    _, opened = made
    path = opened.path
    with pytest.raises(SceneError, match="no such folder"):
        bank.open(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"no bank: it has no bank\.json"):
        bank.open(tmp_path)
    column = path / "road.arc.npy"
    whole = column.read_bytes()
    column.write_bytes(whole[:-8])
    with pytest.raises(SceneError, match=r"road\.arc\.npy: damaged or cut short"):
        bank.open(path)
    np.save(column, np.zeros(3, np.float32))
    with pytest.raises(SceneError, match=r"road\.arc\.npy: 3 rows"):
        bank.open(path)
    np.save(column, np.zeros(3))
    with pytest.raises(SceneError, match=r"road\.arc\.npy: float64"):
        bank.open(path)
    column.unlink()
    with pytest.raises(SceneError, match=r"road\.arc\.npy: missing column"):
        bank.open(path)
    index = json.loads((path / bank.INDEX).read_text())
    (path / bank.INDEX).write_text(json.dumps(index | {"schema": 99}))
    with pytest.raises(SceneError, match="a bank of schema 99; this version reads 2"):
        bank.open(path)


# ---- conversion


def options(**changes):
    return {"formats": source.make(FORMATS), "check": checker(), "pack": packer(), "settings": WOMD, "workers": 1} | changes


def test_a_bad_file_is_listed_and_the_rest_goes_on(tmp_path):
    folder = tmp_path / "in"
    (folder / "deep").mkdir(parents=True)
    written(folder, document(), "a.json")
    written(folder, json.dumps(document())[:500], "b.json")
    written(folder, document(objects=[thing(0, speed=0)]), "c.json")
    written(folder / "deep", scenefactory_document(), "d.json.gz", gzip.open)
    written(folder, "hidden", ".note")
    seen = []
    summary = convert.convert(folder, tmp_path / "bank", **options(on_file=lambda done, total: seen.append((done, total))))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert (summary.files, summary.scenes, summary.agents_kept) == (4, 2, 3)
    reasons = {Path(reject["source"]).name: reject["reason"] for reject in summary.rejects}
    assert set(reasons) == {"b.json", "c.json"} and "cut short" in reasons["b.json"] and "1 too_short" in reasons["c.json"]
    opened = bank.open(tmp_path / "bank")
    assert list(opened.rejects) == list(summary.rejects) and opened.settings["pack"]["box_m"] == 200.0
    lines = convert.describe(summary)
    assert lines[-1] == "2 scenes with 3 agents from 4 files, 2 rejected" and any("rejected" in line and "b.json" in line for line in lines)


def broken_reader(path):
    raise KeyError("x")
    yield


def test_nothing_usable_writes_no_bank(tmp_path):
    path = written(tmp_path, document())
    with pytest.raises(SceneError, match=r"1 were rejected: KeyError: 'x'"):
        convert.convert(path, tmp_path / "bank", **options(formats={"broken": broken_reader}))
    assert not (tmp_path / "bank").exists()


# ---- real data


def test_real_scenes_convert_alike_in_one_process_and_in_two(tmp_path, shared_data):
    for path in [*sorted((shared_data / "womd" / "train").iterdir())[:3], *(shared_data / "formats" / "nocturne_old").iterdir()]:
        (tmp_path / path.name).symlink_to(path)
    alone = convert.convert(tmp_path, tmp_path / "banks" / "one", **options())
    summary = convert.convert(tmp_path, tmp_path / "banks" / "two", **options(workers=2))
    assert alone.scenes == 4 and not alone.rejects and alone.agents_kept > 15
    one, two = bank.open(tmp_path / "banks" / "one"), bank.open(tmp_path / "banks" / "two")
    assert summary.scenes == 4 and [r.track_ids for r in one.reports] == [r.track_ids for r in two.reports]
    for name, leaf in one.leaves.items():
        np.testing.assert_array_equal(leaf, two.leaves[name])
    stacked, report = bank.load(one, range(4), capacity=NONE)
    assert not report.cuts and all(np.isfinite(leaf).all() for leaf in columns.flatten(stacked).values())
    assert np.abs(stacked.road.midpoint).max() <= 100 and np.abs(stacked.agents.goal).max() <= 100
    near = np.linalg.norm(stacked.lanes.midpoint[:, None] - stacked.agents.position[:, :, None], axis=-1)
    near = np.where(stacked.lanes.valid[:, None], near, np.inf).min(axis=2)[stacked.agents.present]
    assert np.median(near) < 1.5  # cars drive on lanes: centre, units and axes agree
    agents = stacked.agents
    along = np.einsum("wad,wad->wa", agents.goal - agents.position, np.stack([np.cos(agents.yaw), np.sin(agents.yaw)], -1))
    assert (along[agents.present] > 0).mean() > 0.8  # goals lie ahead: headings are right, in degrees or radians


# ---- MJCF


def stand_in_car():
    car = mujoco.MjSpec()
    chassis = car.worldbody.add_body(name="chassis", pos=[0, 0, 0.6])
    chassis.add_freejoint(name="root")
    chassis.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 1, 0.5], mass=1800)
    return car


LOOKS = {"half_width_m": 0.05, "height_m": 0.02, "goal_radius_m": 3.0, "other_height_m": 1.5, "box_m": 200.0}


def test_a_scene_becomes_one_model(street):
    scene = prepared(replace(street, roads=(*street.roads, curve(2, 20, 50))), agents=4).scene
    model = mjcf.world(scene, stand_in_car(), merge_tolerance_m=None, **LOOKS)
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
        mjcf.world(scene, mujoco.MjSpec(), merge_tolerance_m=None, **LOOKS)


def test_others_stand_in_the_model_and_can_be_hit(street):
    scene = prepared(street, agents=2).scene
    f = lambda *rows: jnp.array(rows, jnp.float32)  # noqa: E731
    still, size = f([0, 0], [0, 0]), f([4, 2], [4, 2])
    boxes = Boxes(f([9, 3], [0, 0]), f(0.7, 0), f(0.5, 0), still, f(0, 0), size, f(np.inf, np.inf), jnp.array([True, False]))
    model = mjcf.world(replace(scene, boxes=boxes), stand_in_car(), merge_tolerance_m=None, **LOOKS).compile()
    assert model.geom("other0").size.tolist() == [2.0, 1.0, 0.75] and model.geom("other0").contype == 1
    with pytest.raises(KeyError):
        model.geom("other1")


def test_merged_segments_stay_within_the_tolerance(street):
    scene = prepared(replace(street, roads=(*street.roads, curve(2, 20, 50))), require_agents=False).scene
    single, merged = (list(mjcf.chains(scene.road, tolerance)) for tolerance in (None, 0.05))
    assert [len(points) for points, _ in single] == [81, 50, 81] and [kind for _, kind in merged] == [2, 2, 15]
    assert sum(len(points) - 1 for points, _ in merged) < 20
    for (fine, _), (coarse, _) in zip(single, merged, strict=True):
        assert shapely.LineString(coarse).hausdorff_distance(shapely.LineString(fine)) <= 0.05
