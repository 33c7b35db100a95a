"""Maps written as OpenDRIVE and read again: lanes, links, lights, signs and crosswalks of towns, and of a map made by hand."""

import re

import numpy as np
import pytest
import shapely
from support.map_documents import sumo_net
from support.scene_documents import FORMATS

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, LANE_BIKE, STOP_SIGN
from scenefactory_jax.data.export import opendrive, opendrive_curves
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.formats.opendrive_curves import read_reference_line
from scenefactory_jax.data.formats.xml_content import Element, load

LANES = (*DRIVABLE, LANE_BIKE)
CENTRE_M = 0.05


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make({name: FORMATS[name] | {"traffic": None} for name in ("opendrive", "sumo")})


def written_and_read(raw, folder, readers):
    """The scene from the file, with the ids of lanes as they were."""
    path = folder / "map.xodr"
    path.write_bytes(opendrive.encode(raw))
    (again,) = reader_selection.read(path, readers)
    groups = list(opendrive._group({line.id: line for line in raw.roads if line.kind in LANES}))
    name = {f"{road}.0.{-1 - index}": lane.id for road, group in enumerate(groups) for index, lane in enumerate(group)}
    return again, {number: name[token] for token, number in again.metadata["tokens"]["features"].items()}


def require_same_map(raw, again, ids):
    ours = {line.id: line for line in raw.roads if line.kind in LANES}
    theirs = {ids[line.id]: line for line in again.roads if line.kind in LANES}
    assert set(ours) == set(theirs)
    for number, line in ours.items():
        other = theirs[number]
        assert other.kind == line.kind and other.speed_limit == pytest.approx(line.speed_limit)
        assert shapely.hausdorff_distance(*(shapely.LineString(entry.xyz[:, :2]) for entry in (line, other))) < CENTRE_M
        way = shapely.line_locate_point(shapely.LineString(other.xyz[:, :2]), shapely.points(line.xyz[:, :2]))
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(other.xyz[:, :2], axis=0), axis=1)))
        assert np.abs(line.xyz[:, 2] - np.interp(way, arc, other.xyz[:, 2])).max() < CENTRE_M
        for links in ("entry", "exit", "left", "right"):
            assert {ids[entry] for entry in getattr(other, links)} == set(getattr(line, links)), links
    assert {ids[light.lane] for light in again.lights} == {light.lane for light in raw.lights}
    governed = [{lane for line in scene.roads if line.kind == STOP_SIGN for lane in line.lanes} for scene in (raw, again)]
    assert governed[0] == {ids[lane] for lane in governed[1]}
    walks = [sorted(line.xyz[:, :2].mean(axis=0).round(2).tolist() for line in s.roads if line.kind == CROSSWALK) for s in (raw, again)]
    np.testing.assert_allclose(*walks, atol=0.02)


@pytest.mark.parametrize("index", [4, *(pytest.param(index, marks=pytest.mark.slow) for index in (1, 6, 7))])
def test_a_town_comes_back_with_its_lanes_and_links(tmp_path, readers, index):
    entry = hydra_config.load_config("convert", "scenes=town")["scenes"]["generate"]
    entry |= {"hills": {"grade": [0.08, 0.08], "wave_m": [100.0, 200.0]}}
    raw = instantiate(entry, builtins="scenefactory_jax.data.generators.town.town_scene", where="generate")(0, index)
    again, ids = written_and_read(raw, tmp_path, readers)
    require_same_map(raw, again, ids)
    root = load(tmp_path / "map.xodr", "OpenDRIVE", element_limit=10**6, file_limit_mb=64)
    inside = {road.get("id") for road in root.all("road") if road.get("junction") != "-1"}
    common = [junction for junction in root.all("junction") if junction.get("type", "default") == "default"]
    connected = {entry.get("connectingRoad") for junction in common for entry in junction.all("connection")}
    named = {road.get("junction") for road in root.all("road")} - {"-1"}
    assert named == {junction.get("id") for junction in common}
    assert inside and connected == inside  # roads of junctions are those that connect others
    controlled = {entry.get("signalId") for entry in root.walk("controller", "control")}
    assert controlled == {s.get("id") for road in root.all("road") for s in road.walk("signals", "signal") if s.get("dynamic") == "yes"}


def test_a_map_with_heights_comes_back(tmp_path, readers):
    (tmp_path / "town.net.xml").write_text(sumo_net())
    (raw,) = reader_selection.read(tmp_path / "town.net.xml", readers)
    again, ids = written_and_read(raw, tmp_path, readers)
    require_same_map(raw, again, ids)
    assert again.origin == raw.origin


def test_curves_keep_near_their_points():
    turn = np.linspace(0, np.pi / 2, 30)
    line = np.concatenate([[[x, 0.0] for x in range(-20, 0)], 9 * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1), [[9.0, 12], [9, 25]]])
    s, length, xml = opendrive_curves.fit(line)
    path = Element("planView", {}, "x")
    for head, tag, shape in re.findall(r"<geometry ([^>]*)><(\w+)([^>]*)/></geometry>", xml):
        read = lambda text: dict(re.findall(r'(\w+)="([^"]*)"', text))  # noqa: E731
        path.children.append(Element("geometry", read(head), "g", [Element(tag, read(shape), "s")]))
    points, heading = read_reference_line(path)(s - 1e-9 * (s == length))
    assert np.linalg.norm(points - line, axis=1).max() < 0.01 and length == pytest.approx(20 + 9 * np.pi / 2 + 16, abs=0.01)
    assert len(path.children) < len(line) / 4 and np.abs(np.diff(heading)).max() < 0.2


def test_a_scene_without_lanes_is_refused(tmp_path, readers):
    (tmp_path / "town.net.xml").write_text(sumo_net())
    (raw,) = reader_selection.read(tmp_path / "town.net.xml", readers)
    refused = []
    bare = raw.__class__(**vars(raw) | {"roads": tuple(line for line in raw.roads if line.kind not in LANES), "name": "bare"})
    assert opendrive.write_all([raw, bare], tmp_path / "maps", refused) == 1 and "expected lanes" in refused[0]
    with pytest.raises(SceneError, match="expected lanes with two points or more"):
        opendrive.encode(bare)
