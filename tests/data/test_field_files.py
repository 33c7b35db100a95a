"""What files of others have that the documents made by hand did not: each test repeats, in small, what a public file showed."""

import gzip
import re

import numpy as np
import pytest
import shapely
from support.map_documents import commonroad_document, lanelet2_document, opendrive_document, sumo_net
from support.scene_documents import FORMATS

from scenefactory_jax.core.raw_scene import Companion, SceneError
from scenefactory_jax.core.types import DRIVABLE, EDGES, STOP_SIGN
from scenefactory_jax.data.formats import drivable_outline, lanelet2, lanelet_map, reader_selection
from scenefactory_jax.data.formats.opendrive_signals import Signal, group_lights
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators import map_traffic

READERS = reader_selection.make({name: FORMATS[name] | {"traffic": None} for name in ("opendrive", "commonroad", "lanelet2")})
READERS |= reader_selection.make({"sumo": FORMATS["sumo"] | {"traffic": None}})


@pytest.fixture
def read(tmp_path):
    """Writes a document into a folder of its own, and reads the only scene in it."""

    def write_and_read(name, text):
        (tmp_path / name).write_bytes(text.encode() if isinstance(text, str) else text)
        (raw,) = reader_selection.read(tmp_path / name, READERS)
        return raw

    return write_and_read


def names(raw):
    return {number: name for name, number in raw.metadata["tokens"]["features"].items()}


# ---- OpenDRIVE


def test_signals_against_their_orientation_govern_the_lanes_that_they_name(read):
    """RoadRunner's maps, such as CARLA's towns: no lane beside the pole, and references in the junction whose orientation is reversed."""
    text = opendrive_document()
    light = re.search(r'<signals><signal id="5".*?/></signals>', text)[0]
    validity = '<validity fromLane="{0}" toLane="{0}"/>'.format
    pole = light.replace('orientation="+"', 'orientation="-"').replace("/></signals>", f">{validity(0)}</signal></signals>")
    reference = f'<signals><signalReference id="5" s="19" t="0" orientation="-">{validity(-1)}</signalReference></signals>'
    before, road, after = re.split(r'(<road id="10".*?)</road>', text.replace(light, pole), maxsplit=1, flags=re.DOTALL)
    raw = read("map.xodr", f"{before}{road}{reference}</road>{after}")
    assert [names(raw)[lamp.lane] for lamp in raw.lights] == ["10.0.-1"]


def test_a_section_without_length_is_passed_over(read):
    """RoadRunner's widths in a section of 1e-6 m, with cubic coefficients of 1e18: the lanes lead on."""
    text = opendrive_document()
    road = re.search(r'<road id="1".*?</road>', text, re.DOTALL)[0]
    section = re.search(r"<laneSection.*</laneSection>", road, re.DOTALL)[0]
    link = lambda side: re.sub(r'(<lane id="(-?\d)" type="driving"><link>)', rf'\1<{side} id="\2"/>', section)  # noqa: E731
    tiny = link("predecessor").replace('<laneSection s="0"', '<laneSection s="59.99999"').replace('d="0"/>', 'd="6.9e18"/>')
    raw = read("map.xodr.gz", gzip.compress(text.replace(road, road.replace(section, link("successor") + tiny)).encode()))
    lanes = {names(raw)[line.id]: [names(raw)[i] for i in line.exit] for line in raw.roads if line.kind in DRIVABLE}
    assert (lanes["1.0.-1"], lanes["1.0.-2"], lanes["10.0.1"]) == (["10.0.-1"], ["11.0.-2"], ["1.0.1"])
    assert raw.name == "map" and raw.metadata["left_out"]["lanes_without_width"] == 0


def test_empty_links_and_unusual_units_are_read(read):
    """Links without an id, and kph, which scenariogeneration wrote for km/h."""
    text = opendrive_document().replace('<link><successor elementType="junction"', '<link><predecessor/><successor elementType="junction"')
    text = text.replace('<link><predecessor id="-1"/>', '<link><predecessor/><predecessor id="-1"/>')
    plain, raw = read("plain.xodr", opendrive_document()), read("map.xodr", text.replace("km/h", "kph"))
    assert [(line.exit, line.speed_limit) for line in raw.roads] == [(line.exit, line.speed_limit) for line in plain.roads]


@pytest.mark.parametrize(("headings", "groups"), [((0.0, np.pi, np.pi / 2), [[0, 1], [2]]), ((0.0, np.pi), [[0, 1]])])
def test_a_controller_of_crossing_lights_groups_nothing(headings, groups):
    """netconvert writes one controller for all lights of a junction."""
    signals = [Signal(str(n), True, np.zeros((1, 3)), (("1", 0, n),), "9", heading) for n, heading in enumerate(headings)]
    controller = Element("controller", {"id": "c"}, "map.xodr: line 1")
    controller.children += [Element("control", {"signalId": signal.id}, "map.xodr: line 2") for signal in signals]
    assert [[key[2] for key in phase] for phase in group_lights(signals, [controller])["9"]] == groups


def test_areas_that_touch_along_slivers_are_united(monkeypatch):
    """CARLA's Town13: GEOS refuses to unite its lanes without a grid."""
    unite = shapely.union_all

    def refuse(areas, grid_size=None):
        if grid_size is None and areas[0].geom_type == "Polygon":
            raise shapely.errors.GEOSException("TopologyException: found non-noded intersection")
        return unite(areas, grid_size=grid_size)

    monkeypatch.setattr(shapely, "union_all", refuse)
    areas = [np.array([[x, 0, 0], [x + 10, 0, 0], [x + 10, 4, 0], [x, 4, 0]], float) for x in (0, 10)]
    lane, numbers = np.array([[5.0, 2, 0], [15, 2, 0]]), drivable_outline.OutlineNumbers(0.1)
    (edge,) = drivable_outline.find_edges(areas, [lane], numbers, "map: lanes")
    assert shapely.Polygon(edge).area == pytest.approx(80.0)


def test_a_scene_has_the_map_around_it(read):
    """A bridge at the other end of CARLA's Town04 refused every scene of the town; scenes of Town13 had 24,000 lines each."""
    raw = read("map.xodr", opendrive_document())
    phases = [[[lamp.lane for lamp in raw.lights]]]
    part, near = map_traffic.cut_map(raw, phases, np.array([0.0, 0.0]), 30.0)
    lanes = {names(raw)[line.id]: line for line in part.roads if line.kind in DRIVABLE}
    assert set(lanes) == {"1.0.1", "1.0.-1", "1.0.-2"} and all(line in raw.roads for line in lanes.values())
    assert near == [[[]]] and not part.lights and not part.metadata["intersection_lanes"]
    edges = [line.xyz for line in part.roads if line.kind in EDGES]
    assert edges and np.abs(np.concatenate(edges)[:, :2]).max() <= 30 and len({line.id for line in part.roads}) == len(part.roads)
    whole, _ = map_traffic.cut_map(raw, phases, np.array([60.0, 0.0]), 300.0)
    assert whole.roads == raw.roads and whole.lights == raw.lights


# ---- CommonRoad


def test_limits_with_units_and_signs_without_an_id_are_read(read):
    """The maps of INTERACTION in commonroad-dataset-converter: 80kmh on a sign 274, 25mph on a sign without an id."""
    change = lambda sign, value: commonroad_document().replace(">R2-1<", f">{sign}<").replace(">12.5<", f">{value}<")  # noqa: E731
    limit = lambda text: next(line.speed_limit for line in read("map.xml", text).roads if line.id == 1)  # noqa: E731
    assert limit(change("274", "80kmh")) == pytest.approx(80 / 3.6) and limit(change("", "25mph")) == pytest.approx(25 * 0.44704)
    assert limit(change("274", "-1.0")) is None and limit(change("", "25")) is None and limit(change("C43", "20")) == 20
    with pytest.raises(SceneError, match=r"map\.xml: line \d+: .*additionalValue: text: expected a finite number, got 'fast'"):
        read("map.xml", change("274", "fast"))


def test_restricted_lanelets_are_no_lanes(read):
    """The islands of rounD's roundabouts."""
    raw = read("map.xml", commonroad_document().replace("<laneletType>urban</laneletType>", "<laneletType>restricted</laneletType>", 1))
    assert {line.id for line in raw.roads if line.kind in DRIVABLE} == {2, 3, 4}
    edges = np.concatenate([line.xyz for line in raw.roads if line.kind in EDGES])
    assert edges[:, 1].min() == pytest.approx(0.0)  # it is paved


# ---- Lanelet2


def test_a_map_in_left_handed_axes_is_mirrored(read):
    """CARLA's towns of TorchDriveSim: y to the south, and centre lines that run against the borders."""
    centre = '<member type="way" ref="22" role="centerline"/>'
    text = lanelet2_document().replace('<tag k="type" v="lanelet"/>', f'{centre}<tag k="type" v="lanelet"/>')
    plain = read("map.osm", text)
    mirrored = read("mirror.osm", re.sub(r'(k="local_y" v=")(-?)', lambda m: m[1] + ("" if m[2] else "-"), text))
    for line, other in zip(plain.roads, mirrored.roads, strict=True):
        np.testing.assert_allclose(other.xyz, line.xyz)
        assert (line.kind, line.exit, line.left, line.lanes) == (other.kind, other.exit, other.left, other.lanes)


def test_rules_of_autoware_and_signs_of_germany(read):
    """A stop sign that a lanelet names itself, in a map without latitudes; and a limit whose number is on its sign alone."""
    rule = r'(<relation id="41">.*?)<member type="relation" ref="31" role="yield"/>(.*?)right_of_way'
    named = '<member ref="{}" role="regulatory_element"/>'.format
    text = re.sub(rule, r"\1\2traffic_sign", lanelet2_document())
    text = text.replace('<member type="relation" ref="40"', f'{named(41)}<member ref="40"')
    raw = read("map.osm", text.replace("usR1-1", "stop_sign").replace('lat="0" lon="0"', 'lat="" lon=""'))
    (sign,) = [line for line in raw.roads if line.kind == STOP_SIGN]
    assert sign.lanes == tuple(raw.metadata["intersection_lanes"])
    assert lanelet_map.parse_speed("de274-60", "km/h") == pytest.approx(60 / 3.6) and lanelet_map.parse_speed("de274", "km/h") is None
    limit = text.replace('<tag k="sign_type" v="50"/>', '<member type="way" ref="27" role="refers"/>').replace("usR1-1", "de274-60")
    lanes = [line for line in read("limit.osm", limit).roads if line.kind in DRIVABLE]
    assert lanes[1].speed_limit == pytest.approx(60 / 3.6)


def test_what_was_deleted_in_josm_is_left_out(read):
    text = lanelet2_document()
    for tag in ('<relation id="30"', '<way id="20"', '<node id="1"'):
        text = text.replace(tag, f'{tag} action="delete"')
    raw = read("map.osm", text)
    assert sum(line.kind in DRIVABLE for line in raw.roads) == 3


def test_lights_of_each_junction_have_their_own_cycle(tmp_path):
    """Maps of towns: the lights of all junctions were one group."""
    text = lanelet2_document()
    far = re.sub(r'(k="local_x" v=")(\d+)', lambda m: f"{m[1]}{int(m[2]) + 300}", re.sub(r"""\b(id|ref)=(["'])""", r"\1=\g<2>9", text))
    (tmp_path / "map.osm").write_text(text.replace("</osm>", far[far.index("<node") :]))
    found = lanelet2.read_map(
        tmp_path / "map.osm", point_spacing_m=1.0, outline=drivable_outline.OutlineNumbers(0.1), element_limit=1000, file_limit_mb=1
    )
    assert [len(groups) for groups in found.phases] == [1, 1] and len(found.inside) == 4


def test_plain_openstreetmap_is_named(read):
    with pytest.raises(SceneError, match="expected relations of the type lanelet for cars, got 1 others, as plain OpenStreetMap has;"):
        read("map.osm", '<osm><node id="1" lat="0" lon="0"/><relation id="2"><tag k="type" v="route"/></relation></osm>')


# ---- SUMO


def test_left_hand_networks_have_their_neighbours_on_the_other_side(read):
    """`netconvert --lefthand`: lanes are numbered from the left."""
    text = sumo_net().replace('version="1.20"', 'version="1.20" lefthand="true"')
    flip = lambda shape: re.sub(r",(-?)([\d.]+)", lambda m: f",{'' if m[1] else '-'}{m[2]}", shape, count=1)  # noqa: E731
    text = re.sub(r'shape="([^"]*)"', lambda m: f'shape="{" ".join(map(flip, m[1].split()))}"', text)
    raw = read("town.net.xml", text)
    outer, inner = (next(line for line in raw.roads if names(raw).get(line.id) == f"in_{n}") for n in (1, 2))
    assert (outer.right, outer.left, inner.left, inner.right) == ((inner.id,), (), (outer.id,), ())
    (dashed,) = (line for line in raw.roads if line.kind == 6)
    np.testing.assert_allclose(dashed.xyz[:, 1], 0.0, atol=1e-9)


def test_junctions_of_paths_are_not_paved(read):
    """Networks made of OpenStreetMap have junctions of footpaths, whose outlines were islands of road."""
    raw = read("town.net.xml", sumo_net().replace("</net>", '<junction id="P" type="priority" shape="200,0 204,0 204,4 200,4"/></net>'))
    assert max(line.xyz[:, 0].max() for line in raw.roads if line.kind in EDGES) < 150


@pytest.mark.parametrize("root", ["nodes", "edges", "connections", "viewsettings"])
def test_inputs_of_netconvert_belong_to_the_network_beside_them(read, tmp_path, root):
    with pytest.raises(SceneError, match=f"this is {'an input of' if root != 'viewsettings' else 'XML of the root'}"):
        read("town.add.xml", f"<{root}></{root}>")
    (tmp_path / "town.net.xml").write_text(sumo_net())
    with pytest.raises(Companion):
        read("town.add.xml", f"<{root}></{root}>")
