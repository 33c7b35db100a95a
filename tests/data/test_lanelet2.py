"""The readers of Lanelet2 maps and of INTERACTION's recordings: made by hand, real ones, and damaged files."""

import re

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import KDTree
from support import fuzzing
from support.map_documents import interaction_tables, lanelet2_document
from support.scene_documents import FORMATS, prepared

from scenefactory_jax.core.raw_scene import Companion, RawScene, SceneError
from scenefactory_jax.core.types import DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.formats import projection, reader_selection

STEPS = 12


@pytest.fixture(scope="module")
def readers():
    entries = {"lanelet2": FORMATS["lanelet2"] | {"traffic": None}, "interaction": FORMATS["interaction"]}
    return reader_selection.make(entries | {"interaction": entries["interaction"] | {"steps": STEPS, "current": 3}})


def read(path, readers):
    return list(reader_selection.read(path, readers))


@pytest.fixture
def recording(tmp_path):
    """The table of a recording, in INTERACTION's folders."""
    folder = tmp_path / "recorded_trackfiles" / "SITE"
    folder.mkdir(parents=True)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "SITE.osm").write_text(lanelet2_document())
    cars, people = interaction_tables()
    (folder / "vehicle_tracks_000.csv").write_text(cars)
    (folder / "pedestrian_tracks_000.csv").write_text(people)
    return folder / "vehicle_tracks_000.csv"


def test_positions_are_projected_as_in_utm():
    eccentric = projection.WGS84_F * (2 - projection.WGS84_F)
    across = lambda phi: projection.WGS84_A / np.sqrt(1 - eccentric * np.sin(phi) ** 2)  # noqa: E731
    along = lambda phi: across(phi) * (1 - eccentric) / (1 - eccentric * np.sin(phi) ** 2)  # noqa: E731
    for latitude in (-33.0, 12.0, 49.0):  # true to scale along the meridian: there, the arc length
        east, north = projection.project(latitude, 9.0, 9.0)
        assert abs(east) < 1e-9 and north == pytest.approx(0.9996 * quad(along, 0, np.deg2rad(latitude), epsabs=1e-9)[0], abs=1e-3)
    for latitude, longitude in ((0.01, 0.01), (49.0, 8.4), (-33.0, 6.2)):  # and conformal: one scale in all directions, right angles
        step = 1e-5
        (e, n), turns = projection.project(latitude, longitude, 9.0), np.deg2rad(step)
        north = np.subtract(projection.project(latitude + step, longitude, 9.0), (e, n)) / (turns * along(np.deg2rad(latitude)))
        phi = np.deg2rad(latitude)
        east = np.subtract(projection.project(latitude, longitude + step, 9.0), (e, n)) / (turns * across(phi) * np.cos(phi))
        np.testing.assert_allclose(north, [-east[1], east[0]], atol=1e-6)


def test_a_place_in_utm():
    tower = projection.project_utm(np.array([[-(79 + 23 / 60 + 13.7 / 3600), 43 + 38 / 60 + 33.24 / 3600]]), zone=17, south=False)
    np.testing.assert_allclose(tower, [[630084, 4833438]], atol=1.5)  # the CN Tower in Toronto, as published to the metre
    below, above = (projection.project_utm(np.array([[-79.4, y]]), zone=17, south=y < 0)[0] for y in (-43.6, 43.6))
    np.testing.assert_allclose(below + above, [2 * above[0], 10_000_000])


def test_a_map_made_by_hand(tmp_path, readers):
    path = tmp_path / "map.osm"
    path.write_text(lanelet2_document())
    (raw,) = read(path, readers)
    left, right, ahead, aside = (line for line in raw.roads if line.kind in DRIVABLE)
    assert right.exit == (ahead.id, aside.id) and ahead.entry == aside.entry == (right.id,) and not left.exit
    assert (left.right, right.left, left.left, right.right) == ((right.id,), (left.id,), (), ())
    np.testing.assert_allclose(right.xyz[[0, -1]], [[0, 1.75, 2], [40, 1.75, 2]])
    assert left.speed_limit == pytest.approx(30 * 0.44704) and right.speed_limit == pytest.approx(50 / 3.6) and ahead.speed_limit is None
    assert raw.metadata["intersection_lanes"] == [ahead.id, aside.id]
    (sign,) = [line for line in raw.roads if line.kind == STOP_SIGN]
    assert set(sign.lanes) == {ahead.id, aside.id} == {light.lane for light in raw.lights}
    assert sorted(line.kind for line in raw.roads if 6 <= line.kind < 14) == [6, 7]
    for line in raw.roads:  # the road lies on the left of its edges
        if line.kind in EDGES:
            step = np.diff(line.xyz[:, :2], axis=0)
            beside = line.xyz[:-1, :2] + step / 2 + np.stack([-step[:, 1], step[:, 0]], axis=1) / np.hypot(*step.T)[:, None]
            lanes = KDTree(np.concatenate([lane.xyz[:, :2] for lane in (left, right, ahead, aside)]))
            assert (lanes.query(beside)[0] < lanes.query(line.xyz[:-1, :2] + step / 2)[0]).mean() > 0.95


def test_points_at_the_same_place_are_one(tmp_path, readers):
    """As tools write them that know lanelets, not points: the lane ahead and both sides of the middle line have points of their own."""
    text, links = lanelet2_document(), []
    twin = '<node id="{}" lat="0" lon="0"><tag k="local_x" v="{}"/><tag k="local_y" v="{}"/><tag k="ele" v="{}"/></node>'
    for height in (2, 6):  # 6: of a bridge over the road
        nodes = "".join(twin.format(*row, height) for row in ((104, 40.01, 3.5), (106, 40, 0.01), (204, 40, 3.51), (203, 0, 3.5)))
        ways = text.replace("<nd ref='4'/><nd ref='7'/>", "<nd ref='104'/><nd ref='7'/>")
        ways = ways.replace("<nd ref='6'/><nd ref='8'/>", "<nd ref='106'/><nd ref='8'/>")
        middle = '<way id="121"><nd ref=\'204\'/><nd ref=\'203\'/><tag k="type" v="line_thin"/><tag k="subtype" v="dashed"/></way>\n'
        ways = ways.replace('<way id="22">', middle + '<way id="22">').replace('ref="21" role="left"', 'ref="121" role="left"')
        path = tmp_path / "map.osm"
        path.write_text(ways.replace('<node id="1"', nodes + '<node id="1"', 1))
        (raw,) = read(path, readers)
        left, right, ahead, aside = (line for line in raw.roads if line.kind in DRIVABLE)
        links.append((ahead.id in right.exit, aside.id in right.exit, left.right == (right.id,)))
    assert links == [(True, True, True), (False, False, False)]


def test_any_number_of_points_may_be_at_one_place(tmp_path, readers):
    """All pairs of so many points would not fit into memory."""
    node = '<node id="{}" lat="0" lon="0"><tag k="local_x" v="0"/><tag k="local_y" v="7"/></node>'
    path = tmp_path / "map.osm"
    path.write_text(lanelet2_document().replace('<node id="1"', "".join(node.format(1000 + n) for n in range(30_000)) + '<node id="1"', 1))
    (raw,) = read(path, readers)
    assert sum(line.kind in DRIVABLE for line in raw.roads) == 4


def test_a_recording_is_cut_into_scenes(readers, recording):
    scenes = read(recording, readers)
    assert [raw.name for raw in scenes] == ["SITE-vehicle_tracks_000-0", "SITE-vehicle_tracks_000-1"]
    first, second = scenes
    car, parked, person = first.tracks
    assert [track.kind for track in first.tracks] == ["vehicle", "vehicle", "pedestrian"] and len(second.tracks) == 1
    assert (first.sdc, first.current, len(first.times), second.sdc) == (0, 3, STEPS, 0)
    np.testing.assert_allclose(car.xyz[:, 0], 2 + 0.8 * np.arange(STEPS))
    np.testing.assert_allclose(second.tracks[0].xyz[:, 0], 2 + 0.8 * (STEPS + np.arange(STEPS)))
    assert car.xyz[0, 2] == 2.75 and parked.size == (5.0, 2.0, 1.5) and parked.yaw[0] == pytest.approx(0.1)
    assert np.flatnonzero(person.valid).tolist() == [5, 6, 7, 8] and person.yaw[5] == pytest.approx(-np.pi / 2)
    _, report = prepared(first, centre="sdc")
    assert report.agents_kept == 1
    with pytest.raises(Companion, match="people of a recording"):
        read(recording.with_name("pedestrian_tracks_000.csv"), readers)
    with pytest.raises(Companion, match="map of recordings"):
        read(recording.parents[2] / "maps" / "SITE.osm", readers)


def test_a_real_recording(shared_data, readers):
    table = shared_data / "formats" / "interaction" / "recorded_trackfiles" / "DR_USA_Intersection_GL" / "vehicle_tracks_000.csv"
    scenes = read(table, readers)
    assert len(scenes) == 600 // STEPS and all(isinstance(raw, RawScene) for raw in scenes)
    raw = scenes[0]
    lanes = [line for line in raw.roads if line.kind in DRIVABLE]
    assert (len(lanes), sum(len(line.exit) for line in lanes), sum(line.kind == STOP_SIGN for line in raw.roads)) == (90, 100, 4)
    assert [line.speed_limit for line in lanes] == [pytest.approx(40 * 0.44704)] * 90
    near = KDTree(np.concatenate([line.xyz[:, :2] for line in lanes]))
    places = np.concatenate([track.xyz[track.valid][:, :2] for raw in scenes for track in raw.tracks])
    assert (
        len(places) == len(table.read_text().splitlines()) - 1 and np.median(near.query(places)[0]) < 0.8  # cars in turns leave the centre
    )  # recording and map are in the same coordinates


@pytest.mark.parametrize(
    "change, message",
    [
        (("<nd ref='4'/>", "<nd ref='99'/>"), r"line 16: way: nd: expected the id of a node, got '99'"),
        (('ref="22" role="right"', 'ref="77" role="right"'), r"relation: member: expected ways of the role right .*, got \['77'\]"),
        (('lat="0"', 'lat="95"'), r"line 3: node: expected degrees of latitude and longitude, got 95, 0"),
        (('v="lanelet"', 'v="area"'), r"expected relations of the type lanelet for cars, got 7 others"),
    ],
)  # fmt: skip
def test_a_fault_of_a_map_is_named(tmp_path, readers, change, message):
    path = tmp_path / "map.osm"
    path.write_text(lanelet2_document().replace(*change))
    with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: .*{message}"):
        read(path, readers)


@pytest.mark.parametrize(
    "change, message",
    [
        ((",8.0,0.0,0.0,4.5", ",fast,0.0,0.0,4.5"), r"line 2: vx: expected a finite number, got 'fast'"),
        (("1,2,200,", "1,2,20000000,"), r"timestamp_ms: expected a row for each 100 ms or more, got \d+ over \d+ steps"),
        (("psi_rad,length,width\n", 'psi_rad,length,width\n"'), r"not a valid table, damaged|expected rows, got none"),
    ],
)
def test_a_fault_of_a_recording_is_named(readers, recording, change, message):
    recording.write_text(recording.read_text().replace(*change))
    with pytest.raises(SceneError, match=f"^{re.escape(str(recording))}: .*({message})"):
        read(recording, readers)
    (recording.parents[2] / "maps" / "SITE.osm").unlink()
    recording.write_text(interaction_tables()[0])
    with pytest.raises(SceneError, match=r"its map is missing: .*SITE\.osm"):
        read(recording, readers)


def test_damaged_files_are_refused_or_read(tmp_path, readers, recording):
    path, text = tmp_path / "map.osm", lanelet2_document()
    assert fuzzing.attack(readers["lanelet2"], path, text.encode(), flips=12, cuts=5)["SceneError"] > 5
    for what, bad in fuzzing.junk_in_xml(text, count=3):
        path.write_text(bad)
        assert fuzzing.attempt(readers["lanelet2"], path) in ("read", "SceneError"), what
    verdicts = fuzzing.attack(readers["interaction"], recording, recording.read_bytes(), flips=12, cuts=5)
    assert set(verdicts) <= {"read", "SceneError", "FormatMismatch"}
