"""The reader of OpenDRIVE: curves against closed forms, a map made by hand, real maps against their own lengths, and hostile files."""

import re

import numpy as np
import pytest
import shapely
from scipy.special import fresnel
from support import fuzzing
from support.map_documents import LANE_M, opendrive_document
from support.scene_documents import FORMATS, prepared

from scenefactory_jax.core.raw_scene import LIGHT_STATES, RawScene, Reject, SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.formats import reader_selection, xml_content
from scenefactory_jax.data.formats.opendrive_curves import read_reference_line
from scenefactory_jax.data.formats.opendrive_lanes import Road

ENTRY = FORMATS["opendrive"]
MAPS = {  # lanes, links, edges, lights of esmini's maps
    "crest-curve": (2, 0, 2, 0), "curves_elevation": (2, 0, 2, 0), "e6mini": (6, 0, 2, 0), "fabriksgatan": (20, 24, 4, 0),
    "fabriksgatan_traffic_lights": (20, 24, 4, 3), "multi_intersections": (86, 108, 5, 42), "soderleden": (11, 9, 4, 0),
    "velodrome": (3, 3, 2, 0),
}  # fmt: skip


@pytest.fixture(scope="module")
def readers():
    """The reader of maps alone, and the one that draws scenes on them."""
    traffic = ENTRY["traffic"] | {"scenes": 2, "traffic": ENTRY["traffic"]["traffic"] | {"cars": [2, 12]}}
    return {name: reader_selection.make({"opendrive": ENTRY | {"traffic": entry}}) for name, entry in (("map", None), ("drawn", traffic))}


def read(path, readers):
    return list(reader_selection.read(path, readers))


def written(folder, text):
    path = folder / "map.xodr"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def lengths(xyz):
    return np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1).sum()


# ---- curves


def evaluated(shape, length, s):
    """Points and headings of one geometry, from its start."""
    plan = xml_content.Element("planView", {}, "map.xodr: line 1: planView")
    place = {"s": "0", "x": "3", "y": "-2", "hdg": "0", "length": str(length)}
    tag, attributes = shape
    plan.children.append(
        xml_content.Element("geometry", place, "g", [xml_content.Element(tag, {k: str(v) for k, v in attributes.items()}, "s")])
    )
    points, heading = read_reference_line(plan)(np.asarray(s, float))
    return points - [3, -2], heading


def test_curves_are_those_of_their_formulas():
    s = np.linspace(0.0, 80.0, 33)
    points, heading = evaluated(("arc", {"curvature": 0.02}), 80, s)
    np.testing.assert_allclose(points, np.stack([np.sin(0.02 * s), 1 - np.cos(0.02 * s)], axis=1) / 0.02, atol=1e-9)
    np.testing.assert_allclose(heading, 0.02 * s, atol=1e-12)
    rate = 0.05 / 80
    points, heading = evaluated(("spiral", {"curvStart": 0, "curvEnd": 0.05}), 80, s)
    scale = np.sqrt(np.pi / rate)
    sines, cosines = fresnel(s / scale)
    np.testing.assert_allclose(points, scale * np.stack([cosines, sines], axis=1), atol=1e-7)
    np.testing.assert_allclose(heading, rate * s * s / 2, atol=1e-12)
    np.testing.assert_allclose(evaluated(("line", {}), 80, s)[0], np.stack([s, 0 * s], axis=1), atol=1e-9)


@pytest.mark.parametrize("span", ["normalized", "arcLength"])
def test_polynomials_are_followed_by_arc_length(span):
    v = lambda u: 1e-3 * u**3 - 0.02 * u**2  # noqa: E731
    fine = np.linspace(0.0, 20.0, 200_001)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(fine), np.diff(v(fine))))])
    length, s = arc[-1], np.linspace(0.0, arc[-1], 17)
    u = np.interp(s, arc, fine)
    points, heading = evaluated(("poly3", {"a": 0, "b": 0, "c": -0.02, "d": 1e-3}), length, s)
    np.testing.assert_allclose(points, np.stack([u, v(u)], axis=1), atol=2e-3)
    np.testing.assert_allclose(heading, np.arctan(3e-3 * u**2 - 0.04 * u), atol=2e-3)
    end = 1.0 if span == "normalized" else length
    k = 20.0 / end
    numbers = {"aU": 0, "bU": k, "cU": 0, "dU": 0, "aV": 0, "bV": 0, "cV": -0.02 * k**2, "dV": 1e-3 * k**3, "pRange": span}
    np.testing.assert_allclose(evaluated(("paramPoly3", numbers), length, s)[0], points, atol=2e-3)


# ---- a map made by hand


@pytest.fixture(scope="module")
def scene(tmp_path_factory, readers):
    (raw,) = read(written(tmp_path_factory.mktemp("map"), opendrive_document()), readers["map"])
    return raw


def by_name(raw):
    """The lanes of the first section by road and lane."""
    lanes = {line.id: line for line in raw.roads}
    return {(name.split(".")[0], int(name.split(".")[2])): lanes[number] for name, number in raw.metadata["tokens"]["features"].items()}


def test_lanes_lead_into_those_that_the_file_names(scene):
    lanes = by_name(scene)
    names = {line.id: name for name, line in lanes.items()}
    assert {name: [names[i] for i in line.exit] for name, line in lanes.items() if line.exit} == {
        ("1", -1): [("10", -1)], ("1", -2): [("11", -2)], ("10", -1): [("2", -1)], ("11", -2): [("3", -2)], ("2", 1): [("10", 1)],
        ("10", 1): [("1", 1)],
    }  # fmt: skip
    for line in lanes.values():
        for other in line.exit:
            following = lanes[names[other]]
            assert line.id in following.entry and np.linalg.norm(following.xyz[0] - line.xyz[-1]) < 1e-6
    assert lanes["1", -1].right == (lanes["1", -2].id,) and lanes["1", -2].left == (lanes["1", -1].id,)
    assert not lanes["1", -1].left and not lanes["1", 1].right and not lanes["1", 1].left
    limits = [round(3.6 * lanes[name].speed_limit, 6) for name in (("1", 1), ("1", -1), ("1", -2), ("11", -2))]
    assert limits == [50, 50, 30, 30]  # a lane in a junction without one has that of the lane before it
    assert sorted(names[i] for i in scene.metadata["intersection_lanes"]) == [("10", -1), ("10", 1), ("11", -2)]


def test_lanes_lie_beside_the_reference_line_at_its_height(scene):
    lanes = by_name(scene)
    x = lanes["1", -2].xyz[:, 0]
    np.testing.assert_allclose(lanes["1", -2].xyz, np.stack([x, 0 * x - 1.5 * LANE_M, 0.05 * x], axis=1), atol=1e-9)
    assert lanes["1", 1].xyz[[0, -1], 0] == pytest.approx([60, 0])  # against the road
    np.testing.assert_allclose(np.hypot(*(lanes["11", -2].xyz[:, :2] - [60, -12]).T), 12 - 1.5 * LANE_M, atol=1e-9)
    assert np.diff(x).max() <= ENTRY["point_spacing_m"] + 1e-9


def test_edges_bound_what_is_paved(scene):
    edges = [line for line in scene.roads if line.kind in EDGES]
    outline = shapely.union_all([shapely.LineString(line.xyz[:, :2]) for line in edges])
    lanes = by_name(scene)
    middle = shapely.points(lanes["1", -2].xyz[5:-8, :2])
    np.testing.assert_allclose(shapely.distance(middle, outline), LANE_M / 2, atol=0.02)
    assert all(shapely.distance(shapely.LineString(line.xyz[:, :2]), outline) > 1.0 for line in lanes.values())  # no edge across a lane
    heights = np.concatenate([line.xyz for line in edges])
    assert np.abs(heights[:, 2] - 0.05 * np.minimum(heights[:, 0], 60.0)).max() < 0.06
    (crosswalk,) = [line for line in scene.roads if line.kind == CROSSWALK]
    assert np.ptp(crosswalk.xyz, axis=0)[:2].tolist() == [3.0, 10.5]


def test_signals_govern_the_lanes_behind_them(scene):
    lanes = by_name(scene)
    assert [light.lane for light in scene.lights] == [lanes["10", -1].id, lanes["11", -2].id]
    assert not any(light.valid.any() for light in scene.lights)  # when they are red is not in the file
    (sign,) = [line for line in scene.roads if line.kind == STOP_SIGN]
    assert sign.lanes == (lanes["10", 1].id,)


def test_traffic_is_drawn_on_the_lanes(tmp_path, readers):
    path = written(tmp_path, opendrive_document())
    scenes = read(path, readers["drawn"])
    assert [raw.name for raw in scenes] == ["map-0", "map-1"] and all(isinstance(raw, RawScene) for raw in scenes)
    lanes = shapely.union_all([shapely.LineString(line.xyz[:, :2]) for line in scenes[0].roads if line.kind in DRIVABLE])
    for raw, again in zip(scenes, read(path, readers["drawn"]), strict=True):
        assert len(raw.tracks) >= 2 and raw.sdc is not None and len(raw.times) == ENTRY["traffic"]["log_steps"]
        for track, same in zip(raw.tracks, again.tracks, strict=True):
            assert np.array_equal(track.xyz, same.xyz)
            if track.kind == "vehicle":
                places = track.xyz[track.valid]
                assert shapely.distance(shapely.points(places[:, :2]), lanes).max() < 0.6
                climb = 0.05 * np.minimum(places[:, 0], 60.0) + track.size[2] / 2
                assert np.abs(places[:, 2] - climb).max() < 0.06
        for light in raw.lights:
            assert light.valid.all() and {LIGHT_STATES[code] for code in light.plan.state} == {"go", "caution", "stop"}
        packed, report = prepared(raw, centre="sdc")
        assert report.agents_kept > 0 and report.controls_kept == 3 and np.asarray(packed.edges.valid).any()


def test_a_map_without_room_for_traffic_is_rejected_by_name(tmp_path, readers):
    crowd = ENTRY["traffic"] | {"scenes": 1, "traffic": ENTRY["traffic"]["traffic"] | {"cars": [1, 1], "travel_m": [900.0, 950.0]}}
    (reject,) = read(written(tmp_path, opendrive_document()), reader_selection.make({"opendrive": ENTRY | {"traffic": crowd}}))
    assert isinstance(reject, Reject) and reject.reason.startswith("traffic: 20 places of the map had fewer than 1 moving cars; give")


# ---- real maps


@pytest.mark.parametrize("name", MAPS)
def test_real_maps_have_the_lengths_that_they_give(shared_data, readers, name):
    path = shared_data / "formats" / "opendrive" / f"{name}.xodr"
    (raw,) = read(path, readers["map"])
    lanes = [line for line in raw.roads if line.kind in DRIVABLE]
    by_id = {line.id: line for line in lanes}
    edges = sum(line.kind in EDGES for line in raw.roads)
    assert (len(lanes), sum(len(line.exit) for line in lanes), edges, len(raw.lights)) == MAPS[name]
    for line in lanes:
        for other in line.exit:
            assert np.linalg.norm(line.xyz[-1] - by_id[other].xyz[0]) < 0.01
    document = xml_content.load(path, "OpenDRIVE", file_limit_mb=64, element_limit=10**6)
    for record in document.all("road"):
        road = Road(record)
        points, heading = road.line(np.linspace(0.0, road.length, int(4 * road.length) + 2))
        assert lengths(points) == pytest.approx(road.length, rel=5e-4)
        step = np.diff(points, axis=0)
        turn = np.angle((step[:, 0] + 1j * step[:, 1]) / (np.exp(1j * heading[1:]) + np.exp(1j * heading[:-1])))
        assert np.abs(turn[np.hypot(*step.T) > 0.01]).max() < 0.05  # no jump between geometries, and headings along the line


# ---- made by scenariogeneration


def test_a_map_of_scenariogeneration(tmp_path, readers):
    xodr = pytest.importorskip("scenariogeneration", reason="needs scenariogeneration").xodr
    bend = [xodr.Spiral(0.001, 0.02, 60), xodr.Arc(0.02, 40)]
    roads = [
        xodr.create_road(shape, id=number, left_lanes=1, right_lanes=1) for number, shape in enumerate((bend, xodr.Line(80), xodr.Line(70)))
    ]
    junction = xodr.CommonJunctionCreator(100, "crossing")
    for road, angle in zip(roads, (0, np.pi / 2, np.pi), strict=True):
        junction.add_incoming_road_circular_geometry(road, 20, angle, "predecessor")
    for pair in ((0, 1), (1, 2), (0, 2)):
        junction.add_connection(*pair)
    made = xodr.OpenDrive("made")
    for road in roads:
        made.add_road(road)
    made.add_junction_creator(junction)
    made.adjust_roads_and_lanes()
    made.write_xml(str(tmp_path / "made.xodr"))
    (raw,) = read(tmp_path / "made.xodr", readers["map"])
    lanes = {line.id: line for line in raw.roads if line.kind in DRIVABLE}
    assert len(lanes) == 3 * 2 + 3 * 2
    inside = [lanes[number] for number in raw.metadata["intersection_lanes"]]
    assert len(inside) == 6 and all(len(line.entry) == len(line.exit) == 1 for line in inside)
    for line in lanes.values():
        for other in line.exit:
            assert np.linalg.norm(line.xyz[-1] - lanes[other].xyz[0]) < 0.01


# ---- damaged and hostile files


BOMB = '<?xml version="1.0"?>\n<!DOCTYPE OpenDRIVE [\n<!ENTITY a "aaaa">\n<!ENTITY b "&a;&a;">]>\n<OpenDRIVE>&b;</OpenDRIVE>'


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda text: BOMB, r"line 3: the entity 'a' is declared; entities are refused"),
        (lambda text: text[: len(text) // 2], r"not valid XML, damaged or cut short: .* line \d+, column \d+"),
        (lambda text: text.replace('hdg="0"', 'hdg="north"', 1), r"line 4: road.planView.geometry: hdg: expected a finite number, got"),
        (lambda text: text.replace("<line/>", "<circle/>", 1), r"geometry: expected one of line, arc, spiral, .*, got circle"),
        (lambda text: text.replace('length="60"', 'length="1e9"'), r"length: expected lanes of 0 to 5e\+06 m together"),
        (lambda text: text.replace('curvEnd="0.02"', 'curvEnd="1e9"'), r"spiral: expected a curve that turns by up to 1000 rad"),
        (lambda text: text.replace('unit="km/h"', 'unit="knots"', 1), r"unit: expected one of m/s, km/h, mph, .*, got 'knots'"),
        (lambda text: text.replace('id="3"', 'id="1"'), r"road: id: expected another id than that of an earlier road, got '1'"),
        (lambda text: text.replace('"driving"', '"sidewalk"'), r"expected lanes of the types driving, .*, got none"),
        (lambda text: text.replace("<OpenDRIVE>", "<OpenDRIVE>" + "<a>" * 99), r"expected up to 64 elements in another"),
    ],
)  # fmt: skip
def test_a_fault_is_named_with_its_line(tmp_path, readers, change, message):
    path = written(tmp_path, change(opendrive_document()))
    with pytest.raises(SceneError, match=f"^{re.escape(str(path))}: .*{message}"):
        read(path, readers["map"])


def test_damaged_maps_are_refused_or_read(tmp_path, readers):
    path, text = tmp_path / "map.xodr", opendrive_document()
    read_map = readers["map"]["opendrive"]
    verdicts = fuzzing.attack(read_map, path, text.encode(), flips=10, cuts=5)
    assert verdicts["SceneError"] > 5
    for what, bad in fuzzing.junk_in_xml(text, count=3):
        path.write_text(bad)
        assert fuzzing.attempt(read_map, path) in ("read", "SceneError"), what


def test_sizes_are_bounded(tmp_path, readers):
    many = reader_selection.make({"opendrive": ENTRY | {"element_limit": 50, "traffic": None}})
    with pytest.raises(SceneError, match=r"line \d+: expected up to 50 elements \(element_limit of its reader\), got more"):
        read(written(tmp_path, opendrive_document()), many)
    with pytest.raises(SceneError, match=r"this is XML of the root element 'kml'"):
        read(written(tmp_path, "<kml/>"), readers["map"])
