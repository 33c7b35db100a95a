"""The reader of SUMO: a network and recordings made by hand against closed forms, and hostile files."""

import gzip
import re

import numpy as np
import pytest
import shapely
from support import fuzzing
from support.map_documents import sumo_net, sumo_recording
from support.scene_documents import FORMATS, prepared

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, FormatMismatch, RawScene, SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.generators import map_traffic

STEPS = 20
ENTRY = FORMATS["sumo"] | {"steps": STEPS, "current": 3, "traffic": None}
TYPES = '<additional><vTypeDistribution id="d"><vType id="long" length="8" width="2.4" vClass="truck"/></vTypeDistribution></additional>'


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make({"sumo": ENTRY})


def read(path, readers):
    return list(reader_selection.read(path, readers))


@pytest.fixture
def folder(tmp_path):
    """A network, a recording of three scenes' length as XML, and the types of its vehicles."""
    (tmp_path / "town.net.xml").write_text(sumo_net())
    (tmp_path / "types.add.xml").write_text(TYPES)
    (tmp_path / "run.fcd.xml").write_text(sumo_recording(2 * STEPS + 5)[0])
    return tmp_path


def test_a_network_is_read_with_its_links_lights_and_edges(tmp_path, readers):
    (tmp_path / "town.net.xml.gz").write_bytes(gzip.compress(sumo_net().encode()))
    (raw,) = read(tmp_path / "town.net.xml.gz", readers)
    lanes = {line.id: line for line in raw.roads if line.kind in DRIVABLE}
    ids = raw.metadata["tokens"]["features"]
    names = {number: name for name, number in ids.items()}
    assert (raw.name, raw.origin, set(ids)) == ("town", (500.0, -20.0, 0.0), {names[number] for number in lanes})
    assert {names[line.id]: [names[i] for i in line.exit] for line in lanes.values() if line.exit} == {
        "in_1": [":J_0_0"], "in_2": [":J_1_0"], ":J_0_0": ["ahead_0"], ":J_1_0": [":J_2_0"], ":J_2_0": ["aside_0"],
    }  # fmt: skip
    assert all(line.id in lanes[other].entry for line in lanes.values() for other in line.exit)
    right, left = lanes[ids["in_1"]], lanes[ids["in_2"]]
    assert (right.left, right.right, left.right, left.left) == ((left.id,), (), (right.id,), ())
    limits = {name: lanes[ids[name]].speed_limit for name in ("in_2", ":J_0_0", ":J_2_0", "aside_0")}
    assert limits == {"in_2": 10.0, ":J_0_0": 13.89, ":J_2_0": 10.0, "aside_0": 8.33}  # SUMO's speeds in turns are no limits
    np.testing.assert_allclose(right.xyz[[0, -1]], [[0, -1.6, 0], [40, -1.6, 2]])
    assert sorted(names[number] for number in raw.metadata["intersection_lanes"]) == [":J_0_0", ":J_1_0", ":J_2_0"]
    assert raw.metadata["left_out"] == {"not_for_cars": 1, "crossing": 1, "walkingarea": 1}
    (dashed,) = (line for line in raw.roads if line.kind == 6)
    np.testing.assert_allclose(dashed.xyz[[0, -1], :2], [[0, 0], [40, 0]])
    (crossing,) = (line for line in raw.roads if line.kind == CROSSWALK)
    np.testing.assert_allclose([crossing.xyz[:, :2].min(axis=0), crossing.xyz[:, :2].max(axis=0)], [[36, -3], [40, 3]])
    edges = shapely.union_all([shapely.LineString(line.xyz[:, :2]) for line in raw.roads if line.kind in EDGES])
    assert edges.distance(shapely.Point(20, -3.2)) < 0.02 and edges.distance(shapely.Point(42, -3.2)) < 0.02  # along the pavement
    assert edges.distance(shapely.Point(0, 0)) > 1.5 and edges.distance(shapely.Point(100, -1.6)) > 1.5  # open where lanes leave the map
    times = np.array([0.0, 4.9, 5.1, 24.9, 25.1, 28.9, 29.1, 44.9, 45.1])  # the offset delays the cycle
    shown = {names[light.lane]: [LIGHT_STATES[i] for i in map_traffic.read_plan(light.plan, times)] for light in raw.lights}
    assert shown[":J_0_0"] == ["stop", "stop", "go", "go", "caution", "caution", "stop", "stop", "go"]
    assert shown[":J_1_0"] == ["go", "go", "stop", "stop", "stop", "stop", "go", "go", "stop"]
    assert all(np.array_equal(light.stop, lanes[lanes[light.lane].entry[0]].xyz[-1]) for light in raw.lights)


def test_a_recording_is_cut_into_scenes(folder, readers):
    scenes = read(folder / "run.fcd.xml", readers)
    assert [raw.name for raw in scenes] == ["run-0", "run-1"] and all(isinstance(raw, RawScene) for raw in scenes)
    for number, raw in enumerate(scenes):
        truck, car, person = raw.tracks
        time = 0.1 * (STEPS * number + np.arange(STEPS))
        assert (truck.size, car.size, person.kind) == ((8.0, 2.4, 2.4), (5.0, 1.8, 1.5), "pedestrian")
        np.testing.assert_allclose(truck.xyz[:, :2], np.stack([1 + 5 * time, np.full(STEPS, -1.6)], axis=1), atol=1e-4)  # the box's centre
        np.testing.assert_allclose(truck.xyz[:, 2], 1.2 + (1 + 5 * time) / 20, atol=0.05)  # on the street that climbs
        half = np.arcsin(2.5 / 12)
        turn = 5 * time / 12 - half
        np.testing.assert_allclose(car.yaw, turn, atol=1e-4)
        centre = 12 * np.cos(half) * np.stack([np.sin(turn), -np.cos(turn)], axis=1)
        np.testing.assert_allclose(car.xyz[:, :2], centre + np.array([43, 12]), atol=1e-3)
        assert (raw.sdc, raw.current, raw.metadata["first_time_s"]) == (0, 3, 30.0 + 2 * number)
        assert raw.lights[0].valid.all() and np.array_equal(map_traffic.read_plan(raw.lights[0].plan, raw.times), raw.lights[0].state)
    ahead = np.concatenate([raw.lights[0].state for raw in scenes])  # lights of a step are those before the next one
    assert LIGHT_STATES[ahead[0]] == "stop" and prepared(scenes[0], centre="sdc")[1].agents_kept >= 1
    for name in ("town.net.xml", "types.add.xml"):
        with pytest.raises(Companion, match="SUMO"):
            read(folder / name, readers)


def test_tables_and_long_steps_give_the_same_tracks(folder, readers):
    (first, _) = read(folder / "run.fcd.xml", readers)
    (folder / "run.fcd.csv").write_text(sumo_recording(2 * STEPS + 5)[1])
    for one, other in zip(first.tracks, read(folder / "run.fcd.csv", readers)[0].tracks, strict=True):
        assert one.kind == other.kind and one.size == other.size and np.array_equal(one.xyz, other.xyz)
    (folder / "run.fcd.csv").write_text(sumo_recording(4, 1.0)[1])
    car = read(folder / "run.fcd.csv", readers)[0].tracks[1]
    assert np.abs(car.xyz - first.tracks[1].xyz).max() < 0.05 and car.valid.all()  # 5 m/s on a circle of 12 m: chords would be 0.26 m off


@pytest.mark.parametrize(
    "change, message",
    [
        (('angle="90', 'heading="90'), r"line 4: timestep.vehicle: angle: missing"),
        (('x="5.0000"', 'x="east"'), r"line 4: timestep.vehicle: x: expected a finite number, got 'east'"),
        (('time="30.10"', 'time="99999999"'), r"expected states at most steps of 0.1 s, got \d+ over"),
        (('x="10.0000"', 'x="13000.0"'), r"expected positions on the network \(without --fcd-output.geo\), got 'person a' 1.29e"),
    ],
)
def test_a_fault_of_a_recording_is_named(folder, readers, change, message):
    path = folder / "run.fcd.xml"
    text = path.read_text()
    path.write_text(text.replace(*change, *([1] if "time" in change[0] else [])))
    with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: .*{message}"):
        read(path, readers)
    (folder / "town.net.xml").unlink()
    path.write_text(text)
    with pytest.raises(SceneError, match="its network is missing"):
        read(path, readers)


@pytest.mark.parametrize(
    "change, message",
    [
        (("0,-1.6,0 40,-1.6,2", "0,-1.6,0 40"), r"line 3: edge.lane: shape: expected points as x,y or x,y,z, got '0,-1.6,0 40'"),
        (('state="Gr"', 'state="G"'), r"phase: state: expected one of .* at 1, for a time of 0 s or more, got 'G' for 20 s"),
        (('disallow="pedestrian"', 'allow="ship"'), r"line 2: net: expected lanes for cars, got 10 others"),
    ],
)
def test_a_fault_of_a_network_is_named(tmp_path, readers, change, message):
    path = tmp_path / "town.net.xml"
    path.write_text(sumo_net().replace(*change))
    with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: .*{message}"):
        read(path, readers)


def test_a_network_without_lanes_in_junctions_gets_them(tmp_path, readers):
    text = re.sub(r'<edge id=":J_\d.*\n|<connection from=":.*\n', "", sumo_net())
    (tmp_path / "town.net.xml").write_text(re.sub(r' via="[^"]*"| tl="J" linkIndex="\d"', "", text).replace('state="O"', 'state="s"'))
    (raw,) = read(tmp_path / "town.net.xml", readers)
    lanes = {line.id: line for line in raw.roads if line.kind in DRIVABLE}
    inside = [lanes[number] for number in raw.metadata["intersection_lanes"]]
    assert len(lanes) == 6 and len(inside) == 2 and not raw.lights
    for line in inside:
        before, after = lanes[line.entry[0]], lanes[line.exit[0]]
        assert np.linalg.norm(line.xyz[0] - before.xyz[-1]) + np.linalg.norm(line.xyz[-1] - after.xyz[0]) < 1e-9
    (sign,) = (line for line in raw.roads if line.kind == STOP_SIGN)
    assert lanes[sign.lanes[0]].entry == (raw.metadata["tokens"]["features"]["in_1"],)


def test_damaged_files_are_refused_or_read(folder, readers):
    reader = readers["sumo"]
    for path in (folder / "town.net.xml", folder / "run.fcd.xml"):
        text = path.read_text()
        assert fuzzing.attack(reader, path, text.encode(), flips=8, cuts=4)["SceneError"] > 3
        for what, bad in fuzzing.junk_in_xml(text, count=2):
            path.write_text(bad)
            assert fuzzing.attempt(reader, path) in ("read", "SceneError", "Companion"), what
        path.write_text(text)
    (folder / "x.rou.xml").write_text("<routes/>")
    with pytest.raises(Companion, match="whose network lies beside it"):
        list(reader(folder / "x.rou.xml"))
    (folder / "town.net.xml").unlink()
    with pytest.raises(FormatMismatch):
        list(reader(folder / "x.rou.xml"))
