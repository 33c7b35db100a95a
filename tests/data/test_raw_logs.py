"""The readers of nuPlan's and nuScenes' own files, made by hand from their public schemas, and damaged ones."""

import json
import re
import shutil
import sqlite3

import numpy as np
import pytest
import shapely
from support import fuzzing, raw_documents
from support.raw_documents import LANES, ORIGIN, SPEED, find_centre, token
from support.scene_documents import FORMATS, prepared

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, FormatMismatch, Reject, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGES, LANE_BIKE, LANE_STREET, LINES, STOP_SIGN
from scenefactory_jax.data.formats import nuscenes_map, reader_selection
from scenefactory_jax.data.formats.city_map import CityNumbers

STEPS = 12


def read(path, **numbers):
    entry = FORMATS["nuplan"] | {"steps": STEPS, "current": 3} | numbers
    return list(reader_selection.read(path, reader_selection.make(FORMATS | {"nuplan": entry})))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """nuPlan's folders, with a log."""
    root = tmp_path_factory.mktemp("nuplan")
    raw_documents.write_nuplan_map(root / "maps" / "us-ma-boston" / "9.12.1817" / "map.gpkg")
    raw_documents.write_nuplan_log(root / "nuplan-v1.1" / "splits" / "mini" / "2021.05.12_veh-47.db")
    return root


@pytest.fixture(scope="module")
def log(dataset):
    return next((dataset / "nuplan-v1.1" / "splits" / "mini").glob("*.db"))


@pytest.fixture
def copied(dataset, tmp_path):
    """The same folders, to be changed."""
    shutil.copytree(dataset, tmp_path / "copy")
    return next((tmp_path / "copy").rglob("*.db"))


@pytest.fixture
def tables(tmp_path):
    return raw_documents.write_nuscenes(tmp_path)


def execute(path, *statements):
    with sqlite3.connect(path) as database:
        for statement in statements:
            database.execute(statement)
    database.close()


def by_token(raw):
    names = {number: text for text, number in raw.metadata["tokens"]["tracks"].items()}
    return {names[track.id]: track for track in raw.tracks}


def check_edges(raw, origin):
    """Edges have the road on their left and lie on the outline of the areas; none runs across a lane, one runs around the island."""
    area = shapely.union_all(list(raw_documents.AREAS.values()))
    edges = [shapely.LineString(line.xyz[:, :2] - origin) for line in raw.roads if line.kind in EDGES]
    assert shapely.union_all(edges).hausdorff_distance(area.boundary) < 6.0  # where lanes leave the map there is none
    assert shapely.union_all(edges).length > 0.85 * area.length
    for edge in edges:
        assert shapely.distance(area.boundary, shapely.points(shapely.get_coordinates(edge))).max() < 0.1
        for side in (0.3, -0.3):
            beside = shapely.get_coordinates(edge.offset_curve(side).segmentize(1.0))[1:-1]
            assert (shapely.contains_xy(area, beside) == (side > 0)).mean() > 0.95
    for key in LANES:
        assert not shapely.LineString(find_centre(key)).intersects(shapely.union_all(edges))
    assert sum(shapely.Polygon(raw_documents.ISLAND).buffer(0.1).contains(edge) for edge in edges) == 1


def check_lanes(raw, origin, ids):
    """Lanes follow their centres and are linked; crosswalk, painted lines and stop sign are where they belong."""
    lanes = {line.id: line for line in raw.roads if line.kind in (LANE_STREET, LANE_BIKE)}
    assert len(lanes) == len(LANES) + 2
    for key in LANES:
        lane = lanes[ids[key]]
        np.testing.assert_allclose(lane.xyz[[0, -1], :2] - origin, find_centre(key), atol=0.002)
        assert np.linalg.norm(np.diff(lane.xyz, axis=0), axis=1).max() <= 1.0 + 1e-6
    for key, (before, after) in raw_documents.CONNECTORS.items():
        way = lanes[ids[key]]
        assert (way.entry, way.exit) == ((ids[before],), (ids[after],))
        assert lanes[ids[before]].exit == lanes[ids[after]].entry == (ids[key],)
        np.testing.assert_allclose(way.xyz[0, :2] - origin, find_centre(key)[0], atol=0.002)
    (zebra,) = [line for line in raw.roads if line.kind == CROSSWALK]
    assert shapely.Polygon(zebra.xyz[:, :2] - origin).symmetric_difference(raw_documents.CROSSWALK).area < 0.1
    (sign,) = [line for line in raw.roads if line.kind == STOP_SIGN]
    np.testing.assert_allclose(sign.xyz[0, :2] - origin, [58.0, -4.0], atol=0.01)
    assert len({line.id for line in raw.roads}) == len(raw.roads)
    return lanes, sign, sorted(line.kind for line in raw.roads if line.kind in LINES)


def test_the_roads_of_nuplan(log):
    raw = read(log)[0]
    lanes, sign, kinds = check_lanes(raw, ORIGIN, {key: key for key in (*LANES, *raw_documents.CONNECTORS)})
    check_edges(raw, ORIGIN)
    assert [lanes[key].speed_limit for key in (11, 12, 21)] == [13.41, None, 8.0]
    assert [lanes[key].kind for key in (11, 12)] == [LANE_STREET, LANE_BIKE]
    assert (lanes[11].left, lanes[11].right, lanes[12].left, lanes[13].right) == ((), (12,), (11,), ())
    assert sign.lanes == (21, 22) and kinds == [6, 7] and raw.metadata["intersection_lanes"] == [21, 22]


def test_the_scenes_of_a_log_of_nuplan(log):
    raw, other = read(log)
    assert raw.name == f"{log.stem}-{token(1006).hex()}" and (raw.current, raw.sdc, len(raw.times)) == (3, 0, STEPS)
    about = {"dataset": "nuPlan", "map": "us-ma-boston", "scene_token": token(201).hex(), "scenario_token": token(1006).hex()}
    assert about.items() <= raw.metadata.items() and json.loads(json.dumps(raw.metadata)) == raw.metadata
    assert (raw.metadata["scenario_types"], other.metadata["scenario_types"]) == ([], ["near_pedestrian_on_crosswalk"])
    np.testing.assert_allclose(raw.times, 0.1 * np.arange(STEPS), atol=1e-9)
    objects, later = by_token(raw), by_token(other)
    ego = objects["ego"]
    assert ego is raw.tracks[0] and ego.size == (5.176, 2.297, 1.777)
    ahead = 10 + 1.461 + SPEED * raw.times  # the box's middle lies before the rear axle
    np.testing.assert_allclose(ego.xyz - [*ORIGIN, 0], np.stack([ahead, 0 * ahead - 2, 0 * ahead + 1.777 / 2], axis=1), atol=1e-6)
    np.testing.assert_allclose(ego.velocity, [[SPEED, 0.0]] * STEPS, atol=1e-9)
    car, parked, person = later[token(101).hex()], later[token(102).hex()], later[token(103).hex()]
    np.testing.assert_allclose(car.xyz[:, 0] - ORIGIN[0], 20 + 4.0 * (1.2 + other.times), atol=1e-6)
    assert (car.kind, car.size) == ("vehicle", (4.6, 2.0, 1.5)) and car.velocity[0].tolist() == [4.0, 0.0]
    assert parked.size == (4.2, 1.8, 1.4) and abs(parked.yaw[0]) == pytest.approx(np.pi)
    np.testing.assert_allclose(parked.velocity, 0.0, atol=1e-6)  # NULL in the log: by its positions
    assert (person.kind, person.size) == ("pedestrian", (0.8, 0.7, 1.7)) and np.flatnonzero(person.valid).tolist() == [0, 1, 2]
    assert token(104).hex() not in objects and raw.metadata["left_out"] == {"object without a size": 1}
    (light,) = raw.lights  # of the two the one whose lane is on the map
    names = [LIGHT_STATES[code] if valid else None for code, valid in zip(light.state, light.valid, strict=True)]
    assert light.lane == 21 and names == [None, None, *["stop"] * 10]
    assert [LIGHT_STATES[code] for code in other.lights[0].state] == [*["stop"] * 8, *["go"] * 4]
    scene, report = prepared(raw)
    assert report.agents_kept >= 1 and len(scene.edges.kind) and report.segments_kept


def test_a_log_is_cut_as_the_config_says(log, copied):
    names = lambda scenes: [raw.name.removeprefix(f"{log.stem}-") for raw in scenes]  # noqa: E731
    assert names(read(log, steps=None)) == [token(201).hex(), token(202).hex()]  # nuPlan's own scenes
    assert [len(raw.times) for raw in read(log, steps=None)] == [15, 15]
    (raw,) = read(log, tags=["near_pedestrian_on_crosswalk"])  # three tags in a row are one scene
    assert names([raw]) == [token(1026).hex()] and "near_pedestrian_on_crosswalk" in raw.metadata["scenario_types"]
    assert names(read(log, steps=None, tags=["near_pedestrian_on_crosswalk"])) == [token(201).hex()]
    with pytest.raises(SceneError, match=r"expected 12 steps of 0\.1 s without a break around a tag of parking, got up to 30"):
        read(log, tags=["parking"])
    execute(copied, "DELETE FROM lidar_pc WHERE timestamp > 1620857891000000 AND timestamp < 1620857891600000")
    assert names(read(copied)) == [token(1030).hex()]  # a break of 0.6 s: too little is before it, and the log goes on behind it


@pytest.mark.parametrize("location, version, folder", [
    ("las_vegas", "us-ma-boston", "us-ma-boston/9.12.1817"), ("Boston", "x/../../y", "us-ma-boston/9.12.1817"),
    ("boston", "us-ma-boston.gpkg", "us-ma-boston/9.9.1"), ("boston", "9.9.1", "us-ma-boston/9.9.1"),
])  # fmt: skip
def test_the_map_of_a_log_is_found(copied, location, version, folder):
    execute(copied, f"UPDATE log SET location = '{location}', map_version = '{version}'")
    maps = copied.parents[3] / "maps"
    if folder.endswith("9.9.1"):
        shutil.copytree(maps / "us-ma-boston" / "9.12.1817", maps / "us-ma-boston" / "9.9.1")
        if version != "9.9.1":
            shutil.rmtree(maps / "us-ma-boston" / "9.12.1817")
    assert read(copied)[0].metadata["map"] == "us-ma-boston"
    with pytest.raises(Companion, match="a map of nuPlan's logs"):
        read(maps / folder / "map.gpkg")
    moved = maps.rename(maps.parents[1] / "elsewhere")
    with pytest.raises(SceneError, match=r"its map is missing: expected .*us-ma-boston/\*/map\.gpkg .* in .*mini/maps or .*nuplan\.maps"):
        read(copied)
    assert read(copied, maps=str(moved))


def test_oddities_of_nuplan(copied):
    gpkg = next(copied.parents[3].glob("maps/*/*/map.gpkg"))
    shape = shapely.transform(shapely.MultiLineString([find_centre(11)]), lambda xy: xy + ORIGIN)
    blob = raw_documents.to_blob(shape, reference=raw_documents.EPSG, envelope=False, project=False)  # in UTM already, of several parts
    with sqlite3.connect(gpkg) as database:
        database.execute("UPDATE baseline_paths SET geom = ? WHERE lane_fid = 11", (blob,))
        database.execute("UPDATE baseline_paths SET geom = ? WHERE lane_connector_fid = 21", (b"GP\x00\x11" + bytes(4),))  # empty
        for layer in ("boundaries", "crosswalks", "stop_polygons", "carpark_areas", "intersections"):
            database.execute(f"DROP TABLE {layer}")
        database.execute("UPDATE lane_connectors SET speed_limit_mps = NULL, entry_lane_fid = NULL WHERE fid = 22")
    execute(copied, "UPDATE ego_pose SET vx = NULL, angular_rate_z = NULL", "DROP TABLE traffic_light_status", "DROP TABLE scenario_tag")
    execute(copied, "UPDATE ego_pose SET x = NULL WHERE token = x'0000000000001388'")  # of the first frame
    execute(copied, "UPDATE lidar_box SET x = NULL WHERE lidar_pc_token = x'00000000000003EB'")
    raw = read(copied)[0]
    lanes = {line.id: line for line in raw.roads}
    np.testing.assert_allclose(lanes[11].xyz[[0, -1], :2] - ORIGIN, find_centre(11), atol=1e-6)
    assert lanes[21].entry == (11,) and lanes[22].exit == () and lanes[22].speed_limit is None and not raw.lights
    assert {line.kind for line in raw.roads} == {LANE_STREET, LANE_BIKE, *{line.kind for line in raw.roads if line.kind in EDGES}}
    np.testing.assert_allclose(raw.tracks[0].velocity, [[SPEED, 0.0]] * STEPS, atol=1e-6)
    assert np.flatnonzero(~by_token(raw)[token(101).hex()].valid).tolist() == [1]


def test_a_scene_of_nuplan_is_refused_alone(copied):
    execute(copied, "UPDATE traffic_light_status SET status = 'blue' WHERE lidar_pc_token < x'00000000000003F0'")
    reject, raw = read(copied)
    assert re.search(r"^traffic_light_status: status: expected green, .*, got 'blue'", reject.reason) and raw.lights
    assert reject.scene == token(1006).hex()
    execute(copied, "ALTER TABLE lidar_box RENAME COLUMN yaw TO heading")
    assert all(re.search(r"^expected a table lidar_box with a column yaw, got the columns token, ", r.reason) for r in read(copied))


@pytest.mark.parametrize("which, change, message", [
    ("log", "DROP TABLE category", r"expected a table category with a column token, got the tables"),
    ("log", "UPDATE ego_pose SET qw = 'up'", r"ego_pose: expected numbers: could not convert string to float: 'up'"),
    ("log", "UPDATE ego_pose SET x = x + 50000", r"map\.gpkg: lanes_polygons: expected lanes within \[.*, got none"),
    ("map", "UPDATE meta SET value = 'epsg:4326'", r"projectedCoordSystem: expected a zone of UTM, .*4326"),
    ("map", "UPDATE lanes_polygons SET geom = x'0011'", r"lanes_polygons: fid 11: expected a shape with the header of a GeoPackage"),
    ("map", "UPDATE lanes_polygons SET geom = substr(geom, 1, 60)", r"lanes_polygons: expected shapes in well-known binary"),
    ("map", "DROP TABLE baseline_paths", r"expected a map of nuPlan with the layer baseline_paths, got gpkg_spatial_ref_sys"),
])  # fmt: skip
def test_a_fault_of_nuplan_is_named(copied, which, change, message):
    gpkg = next(copied.parents[3].glob("maps/*/*/map.gpkg"))
    execute(gpkg if which == "map" else copied, change)
    with pytest.raises(SceneError, match=message) as caught:
        read(copied)
    assert str(caught.value).startswith(str(gpkg if which == "map" or "gpkg" in message else copied)) and "\n" not in str(caught.value)


def test_nuscenes(tables):
    (raw,) = read(tables)
    tokens = {f"{'way' if key in raw_documents.CONNECTORS else 'lane'}{key}": key for key in (*LANES, *raw_documents.CONNECTORS)}
    places = {key: number for number, key in enumerate((*LANES, *raw_documents.CONNECTORS))}  # numbered in the order of the map
    lanes, sign, kinds = check_lanes(raw, 0.0, places)
    check_edges(raw, 0.0)
    assert len(tokens) == len(lanes) and sign.lanes == (places[11], places[12]) and kinds == [6, 11]
    assert raw.metadata["intersection_lanes"] == [places[21], places[22]] and {lane.speed_limit for lane in lanes.values()} == {None}
    (dashes,) = [line for line in raw.roads if line.kind == 6]
    np.testing.assert_allclose(dashes.xyz[[0, -1], :2], [[0, -4], [40, -4]], atol=1e-9)  # where it is painted
    bend = lanes[places[22]].xyz[:, :2]  # half a radian to the left, one to the right, half to the left, of 8 m
    np.testing.assert_allclose(bend[-1], [60 + 4 * 8 * np.sin(0.5), -6], atol=1e-9)
    assert bend[:, 1].max() == pytest.approx(-6 + 2 * 8 * (1 - np.cos(0.5)))
    path = tables.parents[1] / "maps" / "expansion" / "boston-seaport.json"
    path.write_text(path.read_text().replace('"LRL"', '"RLR"'))  # to the rim of the road: what a lane covers is drivable
    (raw,) = read(tables)
    way = shapely.LineString(next(line.xyz[:, :2] for line in raw.roads if line.id == places[22]))
    apart = [shapely.LineString(line.xyz[:, :2]).distance(way) for line in raw.roads if line.kind in EDGES]
    assert min(apart) == pytest.approx(1.25, abs=0.05)


@pytest.mark.parametrize("shape, start, end, radius, lengths", [  # of lanes of the published maps
    ("LSR", [421.2419602954602, 1087.9127960414617, 2.739593514975998], [391.7142849867393, 1100.464077182952], 999.999,
     [0.23651121617864976, 28.593481378991886, 3.254561444252876]),
    ("RSL", [222.2254118951833, 915.391419147894, 3.0714875295916646], [191.21890533615024, 917.7923193982866], 999.999,
     [9.660415496296451, 13.603044909701394, 7.835994888818709]),
])  # fmt: skip
def test_a_path_of_nuscenes_ends_where_the_map_says(tables, shape, start, end, radius, lengths):
    path = tables.parents[1] / "maps" / "expansion" / "boston-seaport.json"
    whole = json.loads(path.read_text())
    record = {"start_pose": start, "end_pose": [*end, 0.0], "shape": shape, "radius": radius, "segment_length": lengths}
    path.write_text(json.dumps(whole | {"arcline_path_3": {"lane11": [record]}}))
    city = nuscenes_map.read_map(path, numbers=CityNumbers(**FORMATS["nuscenes"]["roads"]), file_limit_mb=1)
    np.testing.assert_allclose(city.lanes[0].xyz[[0, -1], :2], [start[:2], end], atol=1e-6)


def test_the_tracks_of_nuscenes(tables):
    (raw,) = read(tables)
    assert (raw.name, raw.current, len(raw.times), raw.metadata["dataset"]) == ("scene-0061", 10, 31, "nuScenes")
    objects = by_token(raw)
    ego, car, walker, cycle = (objects[name] for name in ("ego", "car", "walker", "cycle"))
    np.testing.assert_allclose(ego.xyz[:, :2], np.stack([10 + 1.385 + SPEED * raw.times, np.full(31, -2.0)], axis=1), atol=1e-6)
    np.testing.assert_allclose(ego.velocity, [[SPEED, 0.0]] * 31, atol=1e-6)
    assert raw.sdc == 0 and ego.size == (4.084, 1.73, 1.562) and car.size == (4.5, 1.9, 1.6) and ego.valid.all() and car.valid.all()
    np.testing.assert_allclose(car.xyz[:, 0], 20 + 4.0 * raw.times, atol=1e-6)
    np.testing.assert_allclose(car.velocity, [[4.0, 0.0]] * 31, atol=1e-6)
    assert np.abs(np.abs(car.yaw) - np.pi).max() <= 0.1 + 1e-6  # from 0.1 before the angle of 180 degrees to 0.1 behind it, never around
    assert np.flatnonzero(walker.valid).tolist() == [*range(10, 16), 25]  # key frames 2, 3 and 5
    assert (walker.kind, cycle.kind, car.kind) == ("pedestrian", "other", "vehicle")  # the cycle has no rider
    np.testing.assert_allclose(walker.velocity[walker.valid], [*[[0.0, 2.0]] * 6, [0.0, 0.0]], atol=1e-6)
    scene, report = prepared(raw)
    assert report.agents_kept >= 1 and report.metadata["dataset"] == "nuScenes" and len(scene.edges.kind)


def test_other_files_of_nuscenes_are_companions(tables):
    root = tables.parents[1]
    for path in (*(p for p in tables.parent.iterdir() if p != tables), *(root / "maps" / "expansion").iterdir()):
        with pytest.raises(Companion, match=r"a (table|map) of nuScenes"):
            read(path)
    others = {"sweeps/LIDAR_TOP/a.pcd.bin": b"\0" * 80, "samples/CAM_FRONT/a.jpg": b"\xff\xd8\xff", "maps/nuplan-maps-v1.0.json": b"{}"}
    for name, content in others.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
        with pytest.raises(Companion, match=r"a recording of a sensor|the list of nuPlan's maps"):
            read(root / name)
    (root / "maps" / "expansion").rename(root / "maps" / "other")
    (reject,) = read(tables)
    assert isinstance(reject, Reject) and reject.scene == "scene-0061"
    expected = r"its map is missing: expected expansion/boston-seaport\.json or boston-seaport\.json in .*v1\.0-mini/maps or in maps of"
    assert re.search(expected, reject.reason)
    next((root / "maps" / "other").iterdir()).rename(root / "maps" / "boston-seaport.json")  # as older versions unpack
    assert read(tables)[0].name == "scene-0061"
    (tables.parent / "log.json").unlink()
    with pytest.raises(SceneError, match=r"its table is missing: .*v1\.0-mini/log\.json"):
        read(tables)


@pytest.mark.parametrize("table, change, message", [
    ("sample_annotation", ('"size": [', '"size": ["x", '), r"sample_annotation\.json: \[0\]\.size: expected 3 entries"),
    ("ego_pose", ('"timestamp"', '"time"'), r"ego_pose\.json: \[\d+\]\.timestamp: missing"),
    ("sample", ("}\n]", "}\n"), r"sample\.json: not valid JSON, damaged or cut short behind row 7"),
    ("log", ("boston-seaport", "paris"), r"log: location: expected boston-seaport, .*, got 'paris'"),
])  # fmt: skip
def test_a_fault_of_nuscenes_is_named(tables, table, change, message):
    path = tables.with_name(f"{table}.json")
    path.write_text(path.read_text().replace(*change))
    try:
        (found,) = read(tables)
        assert isinstance(found, Reject) and re.search(message, found.reason)
    except SceneError as error:
        assert re.search(message, str(error)) and str(error).startswith(str(tables.parent))


def test_damaged_files_are_refused_or_read(copied, tables):
    readers = reader_selection.make({"nuplan": FORMATS["nuplan"] | {"steps": STEPS, "current": 3}, "nuscenes": FORMATS["nuscenes"]})
    gpkg = next(copied.parents[3].glob("maps/*/*/map.gpkg"))
    content = gpkg.read_bytes()

    def read_log(path):
        try:
            yield from readers["nuplan"](copied)
        except SceneError as error:
            assert str(copied) in str(error) or str(path) in str(error)
            raise FormatMismatch(str(path)) from error

    assert fuzzing.attack(read_log, gpkg, content, flips=6, cuts=3)["FormatMismatch"] > 3
    gpkg.write_bytes(content)
    assert set(fuzzing.attack(readers["nuplan"], copied, copied.read_bytes(), flips=6, cuts=3)) <= {"read", "SceneError", "FormatMismatch"}
    for name in ("scene", "sample_annotation", "ego_pose"):
        path = tables.with_name(f"{name}.json")
        content = path.read_bytes()
        for _, bad in fuzzing.damaged(content, flips=2, cuts=2):
            path.write_bytes(bad)
            try:
                list(readers["nuscenes"](tables))
            except SceneError as error:
                assert str(path) in str(error)
        path.write_bytes(content)
    junk = (None, -1, "x", [], {}, 1e300)
    names = ("scene", "sample", "sample_data", "ego_pose", "sample_annotation", "log", "calibrated_sensor")
    for path in (tables.parents[1] / "maps" / "expansion" / "boston-seaport.json", *(tables.with_name(f"{name}.json") for name in names)):
        content = path.read_text()
        for what, bad in fuzzing.mutated(json.loads(content), count=4 + 20 * path.stem.startswith("boston"), junk=junk):
            path.write_text(json.dumps(bad))
            try:
                list(readers["nuscenes"](tables))
            except SceneError as error:
                assert str(tables.parents[1]) in str(error), what
        path.write_text(content)
