"""Scenes on the host: readers, checks, packing, banks, conversion, MJCF."""

import copy
import gzip
import json
import lzma
import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import shapely
import yaml

from scenefactory_jax.build import ConfigError, build
from scenefactory_jax.scenes import bank, checks, columns, convert, mjcf, pack, source, stack
from scenefactory_jax.scenes.raw import Polyline, RawScene, SceneError, Track
from scenefactory_jax.types import EDGES, Scene

CONF = Path(__file__).resolve().parent.parent / "conf"
FORMATS = yaml.safe_load((CONF / "formats.yaml").read_text())
WOMD = yaml.safe_load((CONF / "scenes" / "womd.yaml").read_text())
STEPS = 12
NONE = dict.fromkeys(stack.AXES)


@pytest.fixture(scope="module")
def readers():
    return source.make(FORMATS)


def checker(**numbers):
    return build(WOMD["check"] | numbers, builtins=checks, where="scenes.check")


def packer(**numbers):
    return build(WOMD["pack"] | numbers, builtins=pack, where="scenes.pack")


def prepared(raw, **numbers):
    return pack.prepare(raw, check=checker(), pack=packer(**numbers))


def straight(x0, x1, y, step=1.0):
    return [{"x": float(x), "y": float(y), "z": 0.0} for x in np.arange(x0, x1 + 1e-9, step)]


def thing(x, y=0.0, *, speed=5.0, kind="vehicle", valid=None, id=0, yaw=0.0):
    """An object that drives along +x."""
    valid = [True] * STEPS if valid is None else valid
    times = 0.1 * np.arange(STEPS)
    position = [{"x": float(x + speed * t), "y": float(y), "z": 0.0} if v else {"x": -1e4, "y": -1e4, "z": -1e4} for t, v in zip(times, valid)]
    velocity = [{"x": float(speed), "y": 0.0} if v else {"x": -1e4, "y": -1e4} for v in valid]
    heading = [float(yaw) if v else -1e4 for v in valid]
    size = {"width": 1.9, "length": 4.5, "height": 1.5}
    return {"position": position, "velocity": velocity, "heading": heading, "valid": valid, "type": kind, "id": id, **size}


def document(*, objects=None, **changes):
    """A street along x of 80 m with edges, in GPUDrive's layout."""
    roads = [
        {"geometry": straight(-40, 40, 6), "type": "road_edge", "map_element_id": 15, "id": 3},
        {"geometry": straight(-40, 40, 0), "type": "lane", "map_element_id": 2, "id": 1},
        {"geometry": [{"x": 9.0, "y": 4.0, "z": 0.0}], "type": "stop_sign", "map_element_id": 17, "id": 4},
    ]
    objects = [thing(0, id=7, speed=40), thing(-30, id=8, speed=40)] if objects is None else objects
    metadata = {"sdc_track_index": 0, "tracks_to_predict": [{"track_index": 1, "difficulty": 0}], "objects_of_interest": []}
    whole = {"name": "street", "scenario_id": "abc", "objects": objects, "roads": roads, "tl_states": {}, "metadata": metadata}
    return whole | changes


def written(folder, content, name="scene.json", opener=open):
    path = folder / name
    with opener(path, "wt") as file:
        file.write(content if isinstance(content, str) else json.dumps(content))
    return path


def parsed(folder, content, readers):
    return next(source.read(written(folder, content), readers))


@pytest.fixture
def street(tmp_path, readers):
    return parsed(tmp_path, document(), readers)


# ---- readers


@pytest.mark.parametrize("opener", [open, gzip.open, lzma.open], ids=["plain", "gzip", "xz"])
def test_compression_is_told_by_content_not_by_suffix(tmp_path, readers, opener):
    (raw,) = source.read(written(tmp_path, document(), "scene.gz", opener), readers)
    assert (raw.name, raw.current, raw.sdc, len(raw.times)) == ("street", 10, 0, STEPS)
    assert [line.kind for line in raw.roads] == [15, 2, 17] and raw.roads[0].id == 3
    assert raw.metadata["tracks_to_predict"] == [8]
    np.testing.assert_allclose(raw.tracks[0].xyz[:, 0], 4.0 * np.arange(STEPS))


def test_values_at_invalid_steps_are_zero(tmp_path, readers):
    raw = parsed(tmp_path, document(objects=[thing(3, valid=[False] * 4 + [True] * 8)]), readers)
    track = raw.tracks[0]
    assert not track.xyz[:4].any() and not track.yaw[:4].any() and not track.velocity[:4].any() and track.xyz[4:].any()


def test_old_layout_has_degrees_and_type_names(tmp_path, readers):
    old = document(objects=[thing(0, speed=0, yaw=90.0, id=0)])
    for record in old["roads"]:
        del record["map_element_id"], record["id"]
    for key in ("scenario_id", "metadata"):
        del old[key]
    for record in old["objects"]:
        del record["id"], record["height"]
        record["position"] = [{k: p[k] for k in "xy"} for p in record["position"]]
    old["roads"].append({"geometry": straight(0, 5, 9), "type": "driveway"})
    raw = parsed(tmp_path, old, readers)
    assert [line.kind for line in raw.roads] == [15, 2, 17, 20]
    assert raw.sdc is None and raw.tracks[0].size[2] == FORMATS["gpudrive"]["height_m"]
    np.testing.assert_allclose(raw.tracks[0].yaw, np.pi / 2)
    _, report = prepared(raw, require_agents=False)
    assert report.centred_on.startswith("mean: the source names no sdc")


def scenefactory_document():
    pose = {"x": 1.0, "y": 2.0, "z": 0.0, "yaw": 0.5}
    items = [
        {"agent_id": 5, "agent_type": 1, "start": pose, "end": {"x": 21.0, "y": 2.0, "z": 0.0, "yaw": 0.6, "t_idx": 79}},
        {"agent_id": 6, "agent_type": 2, "start": pose | {"x": 11.0}, "end": None},
    ]
    polylines = [{"type": 2, "id": 9, "n": 41, "xyz": [[float(x), 0.0] for x in range(-20, 21)]}]
    return {"meta": {"scene_index_global": 4}, "road": {"polylines": polylines}, "agents": {"items": items, "sdc": None}}


def test_scenefactory_json(tmp_path, readers):
    raw = parsed(tmp_path, scenefactory_document(), readers)
    assert [track.kind for track in raw.tracks] == ["vehicle", "pedestrian"] and raw.metadata["record_index"] == 4
    assert raw.tracks[0].valid.nonzero()[0].tolist() == [0, 80] and raw.tracks[1].valid.sum() == 1
    scene, report = prepared(raw)
    assert report.track_ids == (5,) and report.agents_dropped["not_a_vehicle"] == 1
    np.testing.assert_allclose(scene.agents.goal[0] - scene.agents.position[0], [20.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(scene.agents.route[0], 20.0, rtol=1e-6)


def damaged(path, value):
    """A document with one value replaced (or removed, with ...)."""
    whole = copy.deepcopy(document())
    node = whole
    for key in path[:-1]:
        node = node[key]
    if value is ...:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return json.dumps(whole)


@pytest.mark.parametrize(
    "path, value, message",
    [
        (["objects", 1, "position", 10, "x"], float("nan"), r"objects\[1\]\.position\[10\]\.x: nan is not finite"),
        (["objects", 1, "position", 10, "x"], "far", r"objects\[1\]\.position\[10\]\.x: 'far' is not a number"),
        (["objects", 1, "position", 10, "y"], ..., r"objects\[1\]\.position\[10\]\.y: missing; there are: x, z"),
        (["objects", 1, "position", 10], 3, r"objects\[1\]\.position\[10\]: 3 is not an object"),
        (["objects", 1, "heading"], [0.0], r"objects\[1\]\.heading: 1 entries; there must be 12"),
        (["objects", 1, "heading", 3], 90.0, r"objects\[1\]\.heading\[3\]: 90.0 is no angle in radians"),
        (["objects", 1, "heading", 3], True, r"objects\[1\]\.heading\[3\]: True is not a number"),
        (["objects", 1, "valid", 2], "yes", r"objects\[1\]\.valid\[2\]: 'yes'"),
        (["objects", 1, "length"], None, r"objects\[1\]\.length: None is not a number"),
        (["objects", 1, "type"], ..., r"objects\[1\]\.type: missing"),
        (["objects"], [], r"objects: none"),
        (["objects"], {}, r"objects: \{\} is not a list"),
        (["roads", 0, "geometry", 5, "y"], float("inf"), r"roads\[0\]\.geometry\[5\]\.y: inf is not finite"),
        (["roads", 0, "map_element_id"], "edge", r"roads\[0\]\.map_element_id: 'edge' is not an integer"),
        (["roads", 0], 7, r"roads\[0\]: 7 is not an object"),
        (["metadata", "sdc_track_index"], 9, r"sdc_track_index: 9 is no object; valid: 0 to 1"),
        (["objects", 0, "valid"], [True] * 3, r"3 steps, so no step 10"),
    ],
)
def test_a_bad_value_is_named(tmp_path, readers, path, value, message):
    with pytest.raises(SceneError, match=message) as caught:
        parsed(tmp_path, damaged(path, value), readers)
    assert "scene.json" in str(caught.value)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda whole: whole["road"]["polylines"][0]["xyz"].__setitem__(3, [1.0]), r"road\.polylines\[0\]\.xyz\[3\]: \[1\.0\] is no point"),
        (lambda whole: whole["road"]["polylines"][0].pop("type"), r"road\.polylines\[0\]\.type: missing"),
        (lambda whole: whole["agents"].pop("items"), r"agents\.items: missing"),
        (lambda whole: whole["agents"]["items"][0]["start"].pop("x"), r"agents\.items\[0\]\.start\.x: missing"),
        (lambda whole: whole["agents"]["items"][0]["end"].__setitem__("t_idx", -1), r"agents\.items\[0\]\.end\.t_idx: -1 is no step"),
        (lambda whole: whole.pop("agents"), r"scene\.json: agents: missing"),
    ],
)
def test_a_bad_value_of_scenefactory_json_is_named(tmp_path, readers, change, message):
    whole = scenefactory_document()
    change(whole)
    with pytest.raises(SceneError, match=message):
        parsed(tmp_path, whole, readers)


def test_damaged_and_foreign_files_are_named(tmp_path, readers):
    text = json.dumps(document())
    cut = written(tmp_path, text[: len(text) // 2], "cut.json")
    squeezed = tmp_path / "cut.json.xz"
    squeezed.write_bytes(lzma.compress(text.encode())[:200])
    fake = tmp_path / "fake.json.gz"
    fake.write_bytes(b"\x1f\x8bnothing of the kind")
    binary = tmp_path / "scene.bin"
    binary.write_bytes(bytes(range(200)))
    other = written(tmp_path, {"lanes": []}, "other.json")
    cases = {cut: "damaged or cut short", squeezed: "begins as xz", fake: "begins as gzip", binary: "no reader", other: "'objects'.*road.pol"}
    for path, message in cases.items():
        with pytest.raises(SceneError, match=message) as caught:
            list(source.read(path, readers))
        assert path.name in str(caught.value)
    with pytest.raises(SceneError, match="no such file"):
        source.find(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="empty folder"):
        source.find(tmp_path / "empty")


def test_a_converter_is_one_file_and_one_entry(tmp_path, monkeypatch, readers):
    (tmp_path / "my_format.py").write_text(
        "from scenefactory_jax.scenes.raw import OtherFormat, Polyline, RawScene\n"
        "import numpy as np\n"
        "def read(path, *, step_m: float):\n"
        "    if not path.read_text().startswith('MINE'):\n"
        "        raise OtherFormat(f'{path}: not mine')\n"
        "    xyz = np.stack([step_m * np.arange(9.0), np.zeros(9), np.zeros(9)], axis=1)\n"
        "    for n in range(2):\n"
        "        yield RawScene(f'mine{n}', str(path), (Polyline(2, xyz, 0),), (), np.arange(3.0), 0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    formats = source.make(FORMATS | {"mine": {"_target_": "my_format.read", "step_m": 2.0}})
    path = written(tmp_path, "MINE", "scene.mine")
    assert [raw.name for raw in source.read(path, formats)] == ["mine0", "mine1"]
    assert next(source.read(written(tmp_path, document()), formats)).name == "street"
    with pytest.raises(ConfigError, match=r"formats\.mine\.step_m: missing"):
        source.make({"mine": {"_target_": "my_format.read"}})


# ---- checks


def test_repairs_are_named_and_counted(street):
    lane = street.roads[1]
    doubled = replace(lane, xyz=np.repeat(lane.xyz, 2, axis=0))
    point = Polyline(kind=6, xyz=np.zeros((1, 3)), id=99)
    ghost = replace(street.tracks[0], id=50, valid=np.zeros(STEPS, bool))
    flat = replace(street.tracks[1], id=51, size=(0.0, 2.0, 1.0))
    far = street.tracks[1].xyz.copy()
    far[5:] += 30.0
    raw = replace(street, roads=(doubled, point, *street.roads), tracks=(ghost, flat, *street.tracks, replace(flat, xyz=far)), sdc=2)
    checked, lines = checks.check(raw, track_speed_limit_m_s=45.0, car_size_m=[4.0, 2.0, 1.0])
    text = "\n".join(lines)
    assert "duplicate points removed: 81" in text and "fewer than two points dropped: 1" in text
    assert "without a valid step dropped: 1" in text and "replaced by (4.0, 2.0, 1.0): 2 (ids 51, 51)" in text
    assert "jumps above 45 m/s: 1 steps (ids 51)" in text
    np.testing.assert_array_equal(checked.roads[0].xyz, lane.xyz)
    assert checked.tracks[checked.sdc].id == 7 and checked.tracks[0].size == (4.0, 2.0, 1.0)
    assert any(line.kind == 17 for line in checked.roads)
    again, lines = checks.check(replace(checked, tracks=checked.tracks[:-1]), track_speed_limit_m_s=45.0, car_size_m=[4.0, 2.0, 1.0])
    assert not lines and len(again.tracks) == len(checked.tracks) - 1


def test_refusals_name_the_element(street):
    def refused(message, **changes):
        with pytest.raises(SceneError, match=message) as caught:
            checker()(replace(street, **changes))
        assert "scene.json" in str(caught.value)

    refused(r"no driving lane.*15, 17", roads=(street.roads[0], street.roads[2]))
    broken = street.roads[1].xyz.copy()
    broken[4, 1] = np.nan
    refused(r"roads\[1\] \(id 1\): xyz\[4\]\[1\]: nan", roads=(street.roads[0], replace(street.roads[1], xyz=broken)))
    yaw = street.tracks[1].yaw.copy()
    yaw[3] = np.inf
    refused(r"tracks\[1\] \(id 8\): yaw\[3\]: inf", tracks=(street.tracks[0], replace(street.tracks[1], yaw=yaw)))
    refused("current: 40 is no step", current=40)
    refused("times: they must be finite and rise", times=np.zeros(STEPS))
    refused("sdc: 5 is no track", sdc=5)


# ---- packing


def curve(kind, radius, points, id=0):
    angle = np.linspace(0, 2, points)
    return Polyline(kind=kind, xyz=np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1), id=id)


def test_segments_keep_length_direction_and_order(street):
    roads = (curve(16, 30, 60), curve(2, 20, 50), curve(1, 25, 40), curve(2, 22, 30))
    scene, report = prepared(replace(street, roads=roads), centre="mean", require_agents=False)
    road = scene.road
    np.testing.assert_allclose(np.linalg.norm(road.direction, axis=1), 1.0, atol=1e-6)
    for index, line in enumerate(roads):
        rows = road.polyline == index
        length = np.linalg.norm(np.diff(line.xyz, axis=0), axis=1).sum()
        np.testing.assert_allclose(2 * road.half_length[rows].sum(), length, rtol=1e-6)
        np.testing.assert_allclose(road.arc[rows][-1] + road.half_length[rows][-1], length, rtol=1e-5)
        ends = road.midpoint[rows] + road.half_length[rows, None] * road.direction[rows]
        np.testing.assert_allclose(ends + np.array(report.centre)[:2], line.xyz[1:, :2], atol=1e-4)
    assert road.kind.tolist() == sorted(road.kind.tolist()) and road.polyline[:39].tolist() == [2] * 39
    assert set(scene.lanes.kind) == {1, 2} and set(scene.edges.kind) == {16} and EDGES == (15, 16)
    np.testing.assert_allclose(report.centre, np.concatenate([line.xyz for line in roads]).mean(0))
    assert report.segments_kept == len(road.kind) == 59 + 49 + 39 + 29 and not any(report.segments_cut.values())
    assert {name: leaf.dtype for name, leaf in columns.flatten(scene).items()} == {n: c.dtype for n, c in columns.COLUMNS.items()}


def test_cut_segments_are_counted_by_reason(street):
    points = np.array([[-99.0, 0, 0], [-98.0, 0, 0], [-94.0, 0, 0], [-93.0, 0, 0], [99.5, 0, 0], [100.0, 0, 0], [100.5, 0, 0]])
    raw = replace(street, roads=(Polyline(kind=2, xyz=points, id=0),))
    scene, report = prepared(raw, require_agents=False)
    assert report.segments_cut == {"outside_box": 2, "gap": 2, "degenerate": 0} and report.segments_kept == 2
    np.testing.assert_allclose(2 * scene.road.half_length, 1.0, rtol=1e-6)
    np.testing.assert_allclose(scene.road.arc, [0.5, 5.5])
    with pytest.raises(SceneError, match="no driving lane within 20 m"):
        prepared(raw, box_m=40.0)


def test_agents_are_dropped_by_reason_and_ordered_from_the_centre(tmp_path, readers):
    late = [False] * 11 + [True]
    objects = [
        thing(0, id=1, speed=40),
        thing(-20, id=2, speed=40),
        thing(-21, id=3, speed=40),  # on top of 2, farther from the centre
        thing(5, y=4, id=4, speed=40),
        thing(0, y=8, id=5, kind="pedestrian"),
        thing(0, y=12, id=6, valid=late),
        thing(20, y=4, id=7, speed=0),
        thing(99 + 40 - 30, y=0, id=8, speed=30),
        thing(200, y=0, id=9, speed=30),
        thing(-35, id=10, speed=40),
    ]
    raw = parsed(tmp_path, document(objects=objects), readers)
    scene, report = prepared(raw, agents=3)
    assert report.track_ids == (1, 4, 2)
    wanted = {"overlaps": 1, "not_a_vehicle": 1, "absent_at_start": 1, "too_short": 1, "goal_outside_box": 1, "start_outside_box": 1}
    assert report.agents_dropped == {name: wanted.get(name, 0) for name in pack.DROPS} | {"over_capacity": 1}
    assert report.agents_kept + sum(report.agents_dropped.values()) == len(objects)
    assert report.centred_on == "sdc" and report.centre == (40.0, 0.0, 0.0)
    agents, log = scene.agents, scene.log
    assert agents.present.all() and agents.size.tolist() == [[4.0, 2.0]] * 3
    np.testing.assert_allclose(agents.position[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(agents.goal[0], [4.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(agents.speed, 40.0)
    np.testing.assert_allclose(log.position[:, report.current], agents.position)
    assert log.valid.all() and log.position.shape == (3, STEPS, 2) and log.dt == np.float32(0.1)


def test_packing_options(street):
    scene, report = prepared(street, agents=5, car_size_m=None, start_speed="zero", log_from="current")
    agents = scene.agents
    assert agents.present.tolist() == [True, True, False, False, False] and report.current == 0 and report.steps == 2
    np.testing.assert_allclose(agents.size, [[4.5, 1.9]] * 5, rtol=1e-6)  # absent slots too: nobody may divide by zero
    assert not agents.speed.any() and not agents.position[2:].any() and not scene.log.valid[2:].any()
    np.testing.assert_allclose(scene.log.position[:2, 0], agents.position[:2])


def test_backwards_is_no_start_speed_and_a_detour_is_a_longer_route(street):
    angle = np.linspace(0, np.pi, STEPS - 10)
    track = street.tracks[0]
    xyz = track.xyz.copy()
    xyz[10:] = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle], axis=1)
    scene, _ = prepared(replace(street, tracks=(replace(track, xyz=xyz, yaw=track.yaw + 3 * np.pi),)), centre="mean")
    assert scene.agents.speed[0] == 0.0 and -np.pi <= scene.agents.yaw[0] < np.pi
    np.testing.assert_allclose(scene.agents.route[0], np.linalg.norm(np.diff(xyz[10:], axis=0), axis=1).sum(), rtol=1e-6)


def test_no_agent_left_is_refused_with_reasons(tmp_path, readers):
    raw = parsed(tmp_path, document(objects=[thing(0, speed=0), thing(50, kind="cyclist", id=1)]), readers)
    with pytest.raises(SceneError, match=r"no agent is left of 2: 1 not_a_vehicle, 1 too_short"):
        prepared(raw)
    scene, _ = prepared(raw, require_agents=False)
    assert not scene.agents.present.any()


def test_box_overlap_agrees_with_shapely():
    rng = np.random.default_rng(0)
    boxes = [pack.corners(rng.uniform(-4, 4, 2), rng.uniform(-4, 4), *rng.uniform(0.5, 5, 2)) for _ in range(60)]
    polygons = [shapely.Polygon(box) for box in boxes]
    for box, polygon in zip(boxes, polygons, strict=True):
        wanted = [polygon.intersection(other).area > 1e-9 for other in polygons]
        assert pack.overlaps(box, np.array(boxes)).tolist() == wanted


# ---- stacks and banks


def test_stack_pads_with_masked_rows(street):
    small, large = prepared(street, agents=2).scene, prepared(replace(street, roads=(*street.roads, curve(2, 20, 300))), agents=3).scene
    stacked, report = stack.stack([small, large], capacity=NONE)
    assert report.capacity == {"road": 512, "lanes": 512, "edges": 256, "agents": 3, "steps": STEPS} and not report.cuts
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
    with pytest.raises(SceneError, match="no bank: it has no bank.json"):
        bank.open(tmp_path)
    column = path / "road.arc.npy"
    whole = column.read_bytes()
    column.write_bytes(whole[:-8])
    with pytest.raises(SceneError, match="road.arc.npy: damaged or cut short"):
        bank.open(path)
    np.save(column, np.zeros(3, np.float32))
    with pytest.raises(SceneError, match="road.arc.npy: 3 rows"):
        bank.open(path)
    np.save(column, np.zeros(3))
    with pytest.raises(SceneError, match="road.arc.npy: float64"):
        bank.open(path)
    column.unlink()
    with pytest.raises(SceneError, match="road.arc.npy: missing column"):
        bank.open(path)
    index = json.loads((path / bank.INDEX).read_text())
    (path / bank.INDEX).write_text(json.dumps(index | {"schema": 99}))
    with pytest.raises(SceneError, match="a bank of schema 99; this version reads 1"):
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
    along = np.einsum("wad,wad->wa", stacked.agents.goal - stacked.agents.position, np.stack([np.cos(stacked.agents.yaw), np.sin(stacked.agents.yaw)], -1))
    assert (along[stacked.agents.present] > 0).mean() > 0.8  # goals lie ahead: headings are right, in degrees or radians


# ---- MJCF


def stand_in_car():
    car = mujoco.MjSpec()
    chassis = car.worldbody.add_body(name="chassis", pos=[0, 0, 0.6])
    chassis.add_freejoint(name="root")
    chassis.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 1, 0.5], mass=1800)
    return car


LOOKS = {"half_width_m": 0.05, "height_m": 0.02, "goal_radius_m": 3.0, "box_m": 200.0}


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


def test_merged_segments_stay_within_the_tolerance(street):
    scene = prepared(replace(street, roads=(*street.roads, curve(2, 20, 50))), require_agents=False).scene
    single, merged = (list(mjcf.chains(scene.road, tolerance)) for tolerance in (None, 0.05))
    assert [len(points) for points, _ in single] == [81, 50, 81] and [kind for _, kind in merged] == [2, 2, 15]
    assert sum(len(points) - 1 for points, _ in merged) < 20
    for (fine, _), (coarse, _) in zip(single, merged, strict=True):
        assert shapely.LineString(coarse).hausdorff_distance(shapely.LineString(fine)) <= 0.05


def test_raw_scene_types_are_plain():
    track = Track(1, "vehicle", (4.0, 2.0, 1.5), np.zeros((2, 3)), np.zeros(2), np.zeros((2, 2)), np.ones(2, bool))
    raw = RawScene("n", "s", (), (track,), np.arange(2.0), 0)
    assert raw.sdc is None and raw.origin == (0.0, 0.0, 0.0) and raw.lights == {}
