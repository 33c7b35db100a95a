"""Scenes on the host: readers, checks, packing."""

import copy
import gzip
import itertools
import json
import lzma
from dataclasses import replace

import numpy as np
import pytest
import shapely
from support.scene_documents import (
    FORMATS,
    STEPS,
    checker,
    curve,
    document,
    packer,
    parsed,
    prepared,
    scenefactory_document,
    straight,
    thing,
    written,
)  # fmt: skip

import scenefactory_jax as sf
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import EDGES, POLYGONS
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import columns, pack


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make(FORMATS)


@pytest.fixture
def street(tmp_path, readers):
    return parsed(tmp_path, document(), readers)


# ---- readers


@pytest.mark.parametrize("opener", [open, gzip.open, lzma.open], ids=["plain", "gzip", "xz"])
def test_compression_is_told_by_content_not_by_suffix(tmp_path, readers, opener):
    (raw,) = reader_selection.read(written(tmp_path, document(), "scene.gz", opener), readers)
    assert (raw.name, raw.current, raw.sdc, len(raw.times)) == ("street", 10, 0, STEPS)
    assert [line.kind for line in raw.roads] == [15, 2, 17] and raw.roads[0].id == 3
    assert raw.metadata["tracks_to_predict"] == [8]
    np.testing.assert_allclose(raw.tracks[0].xyz[:, 0], 4.0 * np.arange(STEPS))


def test_values_at_invalid_steps_are_zero(tmp_path, readers):
    raw = parsed(tmp_path, document(objects=[thing(3, valid=[False] * 4 + [True] * 8)]), readers)
    track = raw.tracks[0]
    assert not track.xyz[:4].any() and not track.yaw[:4].any() and not track.velocity[:4].any() and track.xyz[4:].any()


def test_anything_is_read_from_python(tmp_path):
    written(tmp_path, document(), "a.json")
    (tmp_path / "b.json").write_text("{}")
    raw, reason = sf.read(tmp_path)
    assert raw.roads and reason.startswith(f"{tmp_path / 'b.json'}: unknown format")
    bank_reader.write(tmp_path / "bank", [raw], settings={})
    [again] = sf.read(tmp_path / "bank")
    assert again.name == raw.name and again.metadata == raw.metadata
    with pytest.raises(SceneError, match="no such file or folder"):
        list(sf.read(tmp_path / "c"))


def test_a_reader_that_breaks_costs_its_file_alone(tmp_path):
    for name in ("a", "b_broken", "c_two", "d_map", "e"):
        written(tmp_path, document(name=name), f"{name}.json")
    found = list(scene_source.read_scenes({"path": str(tmp_path), "formats": {"eventful": {"_target_": "support.eventful.read"}}}))
    assert [one if isinstance(one, str) else one.name for one in found] == [
        "a", f"{tmp_path / 'b_broken.json'}: KeyError: 'x'", "c_two",
        f"{tmp_path / 'c_two.json'}: second: record 2 at byte 77: its checksum is wrong", "c_two", "e",
    ]  # fmt: skip


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


def test_scenefactory_json(tmp_path, readers):
    raw = parsed(tmp_path, scenefactory_document(), readers)
    assert [track.kind for track in raw.tracks] == ["vehicle", "pedestrian"] and raw.metadata["record_index"] == 4
    assert raw.tracks[0].valid.nonzero()[0].tolist() == [0, 80] and raw.tracks[1].valid.sum() == 1
    scene, report = prepared(raw)
    assert report.track_ids == (5,) and report.agents_dropped["not_a_vehicle"] == 1
    np.testing.assert_allclose(scene.agents.goal[0] - scene.agents.position[0], [20.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(scene.agents.route_length[0], 20.0, rtol=1e-6)


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
        (["objects", 1, "position", 10, "x"], float("nan"), r"objects\[1\]\.position\[10\]\.x: expected a finite number, got nan"),
        (["objects", 1, "position", 10, "x"], "far", r"objects\[1\]\.position\[10\]\.x: expected a number, got 'far'"),
        (["objects", 1, "position", 10, "y"], ..., r"objects\[1\]\.position\[10\]\.y: missing; there are: x, z"),
        (["objects", 1, "position", 10], 3, r"objects\[1\]\.position\[10\]: expected an object, got 3"),
        pytest.param(["objects", 1, "position", 10, "x"], 10**400, r"position\[10\]\.x: .*of 1329", id="huge x"),
        pytest.param(["objects", 1, "heading", 2], -(10**400), r"heading\[2\]: .*of 1329", id="huge heading"),
        pytest.param(["objects", 1, "length"], 10**400, r"objects\[1\]\.length: expected .*, got an integer of 1329", id="huge length"),
        (["objects", 1, "heading"], [0.0], r"objects\[1\]\.heading: expected 12 entries, .*, got 1"),
        (["objects", 1, "heading", 3], 90.0, r"objects\[1\]\.heading\[3\]: expected an angle in radians, got 90.0"),
        (["objects", 1, "heading", 3], True, r"objects\[1\]\.heading\[3\]: expected a number, got True"),
        (["objects", 1, "valid", 2], "yes", r"objects\[1\]\.valid\[2\]: expected true or false, got 'yes'"),
        (["objects", 1, "length"], None, r"objects\[1\]\.length: expected a number, got None"),
        (["objects", 1, "type"], ..., r"objects\[1\]\.type: missing"),
        (["objects"], [], r"objects: expected at least one, got none"),
        (["objects"], {}, r"objects: expected a list, got \{\}"),
        (["roads", 0, "geometry", 5, "y"], float("inf"), r"roads\[0\]\.geometry\[5\]\.y: expected a finite number, got inf"),
        (["roads", 0, "map_element_id"], "edge", r"roads\[0\]\.map_element_id: expected an integer, got 'edge'"),
        (["roads", 0], 7, r"roads\[0\]: expected an object, got 7"),
        (["metadata", "sdc_track_index"], 9, r"sdc_track_index: expected a track, 0 to 1, got 9"),
        (["metadata", "objects_of_interest"], [[1.0]], r"metadata\.objects_of_interest\[0\]: expected an integer, got \[1\.0\]"),
        (["objects", 0, "valid"], [True] * 3, r"formats\.gpudrive\.current: expected a step of the log, 0 to 2, got 10"),
    ],
)
def test_a_bad_value_is_named(tmp_path, readers, path, value, message):
    with pytest.raises(SceneError, match=message) as caught:
        parsed(tmp_path, damaged(path, value), readers)
    assert "scene.json" in str(caught.value)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda whole: whole["road"]["polylines"][0]["xyz"].__setitem__(3, [1.0]), r"xyz\[3\]: expected .*, got \[1\.0\]"),
        (lambda whole: whole["road"]["polylines"][0].pop("type"), r"road\.polylines\[0\]\.type: missing"),
        (lambda whole: whole["agents"].pop("items"), r"agents\.items: missing"),
        (lambda whole: whole["agents"]["items"][0]["start"].pop("x"), r"agents\.items\[0\]\.start\.x: missing"),
        (lambda whole: whole["agents"]["items"][0]["end"].__setitem__("t_idx", -1), r"agents\.items\[0\]\.end\.t_idx: expected .*, got -1"),
        (lambda whole: whole["agents"]["items"][0].__setitem__("agent_id", float("nan")), r"agent_id: expected a finite number, got nan"),
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
    wrong = tmp_path / "wrong.json.gz"
    wrong.write_bytes(gzip.compress(b"")[:10] + b"\xff" * 50)  # zlib's own error
    fake = tmp_path / "fake.json.gz"
    fake.write_bytes(b"\x1f\x8bnothing of the kind")
    binary = tmp_path / "scene.bin"
    binary.write_bytes(bytes(range(200)))
    other = written(tmp_path, {"lanes": []}, "other.json")
    cases = {cut: "cut short", squeezed: "begins as xz", fake: "begins as gzip", binary: "unknown format", other: "'objects'.*road.pol"}
    cases |= {wrong: "begins as gzip"}
    for path, message in cases.items():
        with pytest.raises(SceneError, match=message) as caught:
            list(reader_selection.read(path, readers))
        assert path.name in str(caught.value)
    with pytest.raises(SceneError, match="no such file"):
        reader_selection.find(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="empty folder"):
        reader_selection.find(tmp_path / "empty")
    (tmp_path / "empty" / "bank.json").write_text("{}")
    with pytest.raises(SceneError, match="a bank already"):
        reader_selection.find(tmp_path / "empty")
    assert {path.name for path in reader_selection.find(tmp_path)} == {path.name for path in cases}


def test_a_converter_is_one_file_and_one_entry(tmp_path, monkeypatch, readers):
    (tmp_path / "my_format.py").write_text(
        "from scenefactory_jax.core.raw_scene import FormatMismatch, Polyline, RawScene\n"
        "import numpy as np\n"
        "def read(path, *, step_m: float):\n"
        "    if not path.read_text().startswith('MINE'):\n"
        "        raise FormatMismatch(f'{path}: not mine')\n"
        "    xyz = np.stack([step_m * np.arange(9.0), np.zeros(9), np.zeros(9)], axis=1)\n"
        "    for n in range(2):\n"
        "        yield RawScene(f'mine{n}', str(path), (Polyline(2, xyz, 0),), (), np.arange(3.0), 0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    formats = reader_selection.make(FORMATS | {"mine": {"_target_": "my_format.read", "step_m": 2.0}})
    path = written(tmp_path, "MINE", "scene.mine")
    assert [raw.name for raw in reader_selection.read(path, formats)] == ["mine0", "mine1"]
    assert next(reader_selection.read(written(tmp_path, document()), formats)).name == "street"
    with pytest.raises(ConfigError, match=r"formats\.mine\.step_m: missing"):
        reader_selection.make({"mine": {"_target_": "my_format.read"}})


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
    checked, lines = checker()(raw)
    text = "\n".join(lines)
    assert "duplicate points removed: 81" in text and "fewer than two points dropped: 1" in text
    assert "without a valid step dropped: 1" in text and "replaced by (4.0, 2.0, 1.0): 2 (ids 51, 51)" in text
    assert "jumps above 45 m/s: 1 steps (ids 51)" in text
    np.testing.assert_array_equal(checked.roads[0].xyz, lane.xyz)
    assert checked.tracks[checked.sdc].id == 7 and checked.tracks[0].size == (4.0, 2.0, 1.0)
    assert any(line.kind == 17 for line in checked.roads)
    again, lines = checker()(replace(checked, tracks=checked.tracks[:-1]))
    assert not lines and len(again.tracks) == len(checked.tracks) - 1


def test_roads_of_unknown_elements_are_dropped_and_named(street):
    strange = [replace(street.roads[0], id=90 + kind % 7, kind=kind) for kind in (1000, -1, 4)]
    checked, lines = checker()(replace(street, roads=(*strange, *street.roads)))
    assert lines == ["roads of unknown map elements dropped: 3 (ids and elements 96: 1000, 96: -1, 94: 4)"]
    assert [line.kind for line in checked.roads] == [15, 2, 17]
    with pytest.raises(SceneError, match=r"no driving lane.*the elements there are: -1, 4, 1000"):
        checker()(replace(street, roads=tuple(strange)))
    unknown = [replace(street.roads[0], kind=kind) for kind in (0, 5, 14)]  # of which it is known that nobody knows them
    assert len(checker()(replace(street, roads=(*unknown, *street.roads)))[0].roads) == 6


def test_refusals_name_the_element(street):
    def refused(message, **changes):
        with pytest.raises(SceneError, match=message) as caught:
            checker()(replace(street, **changes))
        assert "scene.json" in str(caught.value)

    refused(r"no driving lane.*15, 17", roads=(street.roads[0], street.roads[2]))
    broken = street.roads[1].xyz.copy()
    broken[4, 1] = np.nan
    refused(r"roads\[1\] \(id 1\): xyz\[4\]\[1\]: expected a finite number up to 1e\+07 .*, got nan", roads=(
        street.roads[0], replace(street.roads[1], xyz=broken)))  # fmt: skip
    yaw = street.tracks[1].yaw.copy()
    yaw[3] = np.inf
    refused(r"tracks\[1\] \(id 8\): yaw\[3\]: expected a finite .*, got inf", tracks=(street.tracks[0], replace(street.tracks[1], yaw=yaw)))
    refused("current: expected a step of the log, 0 to 11, got 40", current=40)
    far = street.roads[1].xyz.copy()
    far[4, 1] = -1e39  # finite, but not in float32
    refused(r"roads\[1\] \(id 1\): xyz\[4\]\[1\]: expected up to 1e\+07 \(scenes.check.max_coordinate_m\), got -1e\+39", roads=(
        street.roads[0], replace(street.roads[1], xyz=far)))  # fmt: skip
    fast = street.tracks[1].velocity.copy()
    fast[5, 0] = 1e39
    refused(r"tracks\[1\] \(id 8\): velocity\[5\]: expected up to 340 .*, got 1e\+39", tracks=(
        street.tracks[0], replace(street.tracks[1], velocity=fast)))  # fmt: skip
    long = replace(street.tracks[0], size=(1e39, 2.0, 1.0))
    refused(r"tracks\[0\] \(id 7\): size\[0\]: expected up to 100 .*, got 1e\+39", tracks=(long, street.tracks[1]))
    refused("times: expected finite times that rise", times=np.zeros(STEPS))
    refused("sdc: expected a track, 0 to 1, got 5", sdc=5)
    light = Light(lane=1, state=np.zeros(STEPS - 1, int), valid=np.ones(STEPS - 1, bool))
    refused(rf"lights\[0\] \(lane 1\): expected {STEPS} steps, as the log has, got {STEPS - 1}", lights=(light,))


def test_no_single_number_asks_for_much_work(street):
    """Every number below is finite and no coordinate is larger than UTM's northings."""

    def refused(message, **changes):
        with pytest.raises(SceneError, match=message):
            checker()(replace(street, **changes))

    edge, lane, sign = street.roads
    car, other = street.tracks
    far = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e7, 0.0, 0.0]])
    message = r"roads\[1\] \(id 1\): length from xyz\[1\] on: expected up to 1000 \(scenes\.check\.max_segment_m\), got 1e\+07"
    refused(message, roads=(edge, replace(lane, xyz=far), sign))
    refused(r"roads\[0\].*max_segment_m", roads=(replace(edge, xyz=far[1:]), lane))
    to_and_fro = 900.0 * (np.arange(120) % 2)[:, None] * np.array([1.0, 0.0, 0.0])
    message = r"roads: length of all driving lanes: expected up to 100000 \(scenes\.check\.max_lanes_m\), got 107180"
    refused(message, roads=(edge, lane, replace(lane, id=5, xyz=to_and_fro)))
    checker()(replace(street, roads=(replace(edge, xyz=to_and_fro), lane)))  # nothing counts along edges
    fast = replace(other, velocity=other.velocity + 9e6 - 40)
    refused(r"tracks\[1\] \(id 8\): velocity\[0\]: expected up to 340 .*, got 9e\+06", tracks=(car, fast))
    refused(r"size\[1\]: expected up to 100 \(scenes\.check\.max_size_m\), got 1e\+06", tracks=(replace(car, size=(4.0, 1e6, 1.0)),))
    refused(r"times: expected up to 10000 steps \(scenes\.check\.max_steps\), got 20000", times=np.arange(20_000.0))
    refused(r"times\[11\]: .* 0\.001 to 10 s \(scenes\.check\.step_s\), got 1e\+06 s", times=np.append(street.times[:-1], 1e6 + 1.0))
    refused(r"times\[1\]: expected a step of .*, got 1e-12 s", times=1e-12 * np.arange(STEPS))


def test_a_jitter_of_the_clock_is_resampled_and_counted(street):
    steps, current = np.arange(199), 50
    times = 0.1 * steps
    times[120:] += 0.01
    x, yaw = 8.0 * times, wrap_angles(np.pi - 0.05 + 0.01 * times)  # past pi
    xyz, velocity = np.stack([x, 0 * x, 0 * x], axis=1), np.tile([8.0, 0.0], (199, 1))
    car = Track(7, "vehicle", (4.0, 2.0, 1.5), xyz, yaw, velocity, np.ones(199, bool))
    brief = replace(car, id=8, valid=(steps >= 60) & (steps < 150))
    light = Light(lane=1, state=steps % 9, valid=steps < 190)
    log = replace(street, tracks=(car, brief), times=times, current=current, sdc=0, lights=(light,))
    even, lines = checker()(log)
    assert lines == ["logs of uneven steps resampled: 1 of 198 steps are not 0.1 s long, by up to 10 ms"]
    assert len(even.times) == 199 and even.times[even.current] == times[current] and even.lights[0].valid.sum() == 191
    np.testing.assert_allclose(np.diff(even.times), 0.1, atol=1e-9)
    for track in even.tracks:
        observed = track.valid
        np.testing.assert_allclose(track.xyz[observed, 0], 8.0 * even.times[observed], atol=1e-9)
        np.testing.assert_allclose(wrap_angles(track.yaw - np.pi - 0.01 * even.times)[observed], -0.05, atol=1e-9)
        assert not track.xyz[~observed].any() and (track.velocity[observed] == [8.0, 0.0]).all()
    assert even.tracks[0].valid.all() and np.flatnonzero(even.tracks[1].valid)[[0, -1]].tolist() == [60, 149]
    once = 0.1 * steps
    once[120] += 0.01  # one stamp is late, the rest is in time
    even, lines = checker()(replace(log, times=once))
    assert len(even.times) == 199 and "2 of 198 steps" in lines[0]
    np.testing.assert_array_equal(even.tracks[0].xyz[:119], car.xyz[:119])
    np.testing.assert_array_equal(even.lights[0].state[:119], light.state[:119])
    for kept in (0.1 * steps + 2e-4 * (steps % 2), 0.1 * steps + 0.1 * (steps >= 120)):  # a clock's noise; a step is missing
        assert checker()(replace(log, times=kept))[0].times is kept


# ---- packing


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
    x = [-99.0, -98.0, -94.0, -93.0, 99.5, 100.0, 100.5]
    points = np.stack([x, np.zeros(7), np.zeros(7)], axis=1) + street.tracks[0].xyz[street.current]
    raw = replace(street, roads=(Polyline(kind=2, xyz=points, id=0),))
    scene, report = prepared(raw, require_agents=False)
    assert report.segments_cut == {"outside_box": 1, "gap": 2, "degenerate": 0} and report.segments_kept == 3
    np.testing.assert_allclose(2 * scene.road.half_length, [1.0, 1.0, 0.5], rtol=1e-6)
    np.testing.assert_allclose(scene.road.arc, [0.5, 5.5, 198.75])
    with pytest.raises(SceneError, match="no driving lane within 20 m"):
        prepared(raw, scene_size_m=40.0)
    doubled = replace(raw, roads=(replace(raw.roads[0], xyz=np.repeat(points, 2, axis=0)),))  # and not repaired by the checks
    assert packer(require_agents=False)(doubled)[1].segments_cut == {"outside_box": 2, "gap": 2, "degenerate": 6}


@pytest.mark.parametrize("kind", POLYGONS)
def test_polygons_keep_their_outline(street, kind):
    centre = street.tracks[0].xyz[street.current]
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [10, 4, 0], [0, 4, 0.0]]) + centre
    closed = np.concatenate([corners, corners[:1]])
    dense = np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in itertools.pairwise(closed)])
    rims = {"open": corners, "closed": closed, "dense": dense, "line": corners[:2], "across the box": corners + np.array([95.0, 0, 0])}
    found = {}
    for name, xyz in rims.items():
        raw = replace(street, roads=(*street.roads, Polyline(kind, xyz, 99)))
        (scene, report), (bare, _) = prepared(raw, require_agents=False), prepared(street, require_agents=False)
        rows = scene.road.kind == kind
        assert report.segments_cut["gap"] == report.segments_cut["degenerate"] == 0
        assert (len(scene.lanes.kind), len(scene.edges.kind)) == (len(bare.lanes.kind), len(bare.edges.kind))
        half, arc = scene.road.half_length[rows], scene.road.arc[rows]
        if name != "across the box":
            np.testing.assert_allclose(arc, np.cumsum(2 * half) - half, rtol=1e-5)
        assert 2 * half.max() <= 2.0 + 1e-5
        found[name] = round(float(2 * half.sum()), 3), int(rows.sum())
    assert found == {"open": (28, 14), "closed": (28, 14), "dense": (28, 32), "line": (10, 5), "across the box": (12, 6)}
    assert raw.roads[-1].xyz is xyz  # an export has the corners that its source had


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
    expected = {"overlaps": 1, "not_a_vehicle": 1, "absent_at_start": 1, "too_short": 1, "goal_outside_box": 1, "start_outside_box": 1}
    assert report.agents_dropped == {name: expected.get(name, 0) for name in pack.DROPS} | {"over_capacity": 1}
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
    np.testing.assert_allclose(scene.agents.route_length[0], np.linalg.norm(np.diff(xyz[10:], axis=0), axis=1).sum(), rtol=1e-6)


def test_no_agent_left_is_refused_with_reasons(tmp_path, readers):
    raw = parsed(tmp_path, document(objects=[thing(0, speed=0), thing(50, kind="cyclist", id=1)]), readers)
    with pytest.raises(SceneError, match=r"no agent is left of 2: 1 not_a_vehicle, 1 too_short"):
        prepared(raw)
    scene, _ = prepared(raw, require_agents=False)
    assert not scene.agents.present.any()


def test_box_overlap_agrees_with_shapely():
    rng = np.random.default_rng(0)
    boxes = [pack.box_corners(rng.uniform(-4, 4, 2), rng.uniform(-4, 4), *rng.uniform(0.5, 5, 2)) for _ in range(60)]
    polygons = [shapely.Polygon(box) for box in boxes]
    for box, polygon in zip(boxes, polygons, strict=True):
        expected = [polygon.intersection(other).area > 1e-9 for other in polygons]
        assert pack.overlaps(box, np.array(boxes)).tolist() == expected


def test_raw_scene_types_are_plain():
    track = Track(1, "vehicle", (4.0, 2.0, 1.5), np.zeros((2, 3)), np.zeros(2), np.zeros((2, 2)), np.ones(2, bool))
    raw = RawScene("n", "s", (), (track,), np.arange(2.0), 0)
    assert raw.sdc is None and raw.origin == (0.0, 0.0, 0.0) and raw.lights == ()
