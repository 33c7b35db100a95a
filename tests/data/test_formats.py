"""Readers of ScenarioNet's, Argoverse 2's, PufferDrive's and GPUDrive's files, against independent readings of the same files."""

import gzip
import json
import lzma
import os
import pickle
import sqlite3
import struct
from collections import Counter

import numpy as np
import pyarrow.parquet
import pytest
import shapely
from support import womd_records as records
from support.format_documents import (
    STEPS,
    argoverse2_files,
    dumped,
    encoded,
    in_march_2023,
    in_spring_2023,
    metadrive_document,
    pufferdrive_map,
    scenarionet_document,
    street,
)
from support.scene_documents import FORMATS, document, prepared

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, FormatMismatch, SceneError
from scenefactory_jax.core.types import EDGES
from scenefactory_jax.data.formats import polylines, reader_selection, safe_pickle

LIMITS = {key: FORMATS["scenarionet"][key] for key in ("file_limit_mb", "opcode_limit")}
METRES = 0.01  # positions agree to this


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make(FORMATS)


def written(folder, content, name="scene.pkl"):
    path = folder / name
    path.write_bytes(content)
    return path


def one(path, readers):
    (raw,) = reader_selection.read(path, readers)
    return raw


# ---- ScenarioNet


def equal(a, b):
    """Whether two unpickled values are the same, to the type and the last bit."""
    if isinstance(b, np.ndarray):
        return isinstance(a, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(b, dict):
        return isinstance(a, dict) and list(a) == list(b) and all(equal(a[key], b[key]) for key in b)
    if isinstance(b, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(equal, a, b))
    return type(a) is type(b) and a == b


def test_data_is_unpickled_as_python_does(tmp_path):
    values = {"numbers": [0, -1, 2**40, 1.5, None, True], "texts": ("", "é"), "set": {1, "a"}, "bytes": b"raw", "scalar": np.float32(1.5)}
    values |= {"swapped": np.arange(3, dtype=">f4")}
    tables = [np.arange(6.0).reshape(2, 3).T, np.zeros((0, 3)), np.ones(2, "<f4"), np.eye(2) > 0]
    values["arrays"] = [*tables, np.array(3), np.array(["a", "bc"])]
    values["again"] = values["arrays"]
    for protocol in (3, 4, 5):
        found = safe_pickle.load(written(tmp_path, pickle.dumps(values, protocol=protocol)), **LIMITS)
        assert found.pop("scalar") == 1.5 and found.pop("swapped").tolist() == [0, 1, 2] and found["again"] is found["arrays"]
        assert equal(found, {key: value for key, value in values.items() if key not in ("scalar", "swapped")})


@pytest.mark.parametrize("pattern", ["*overpass*", pytest.param("*training*", marks=pytest.mark.slow)])
def test_real_scenarios_agree_with_an_independent_reading(shared_data, readers, pattern):
    sides = (("left", "left_neighbor"), ("right", "right_neighbor"))
    for path in (shared_data / "formats" / "scenarionet").glob(pattern):
        with open(path, "rb") as file:
            theirs = pickle.load(file)
        raw = one(path, readers)
        assert equal(safe_pickle.load(path, **LIMITS), theirs)
        features, tracks, lights = theirs["map_features"], theirs["tracks"], theirs["dynamic_map_states"]
        assert (len(raw.roads), len(raw.tracks), len(raw.lights)) == (len(features), len(tracks), len(lights))
        lanes = [line for line in raw.roads if line.kind in (1, 2, 3)]
        assert len(lanes) == sum(feature["type"].startswith("LANE") for feature in features.values()) > 50
        assert sum(line.kind in (15, 16) for line in raw.roads) == sum(f["type"].startswith("ROAD_EDGE") for f in features.values())
        for line in raw.roads:
            feature = features[str(line.id)]
            points = feature.get("polyline", feature.get("polygon", feature.get("position")))
            assert np.abs(line.xyz - points).max() < METRES
        for lane in lanes:
            feature = features[str(lane.id)]
            assert lane.entry == tuple(feature["entry_lanes"]) and lane.exit == tuple(feature["exit_lanes"])
            for side, key in sides:
                assert getattr(lane, side) == tuple(dict.fromkeys(int(record["feature_id"]) for record in feature[key]))
            miles = feature["speed_limit_mph"]
            assert lane.speed_limit == pytest.approx(miles * 0.44704) if miles else lane.speed_limit is None
        for track in raw.tracks:
            state = tracks[str(track.id)]["state"]
            assert np.array_equal(track.valid, state["valid"]) and track.kind == tracks[str(track.id)]["type"].lower()
            assert np.abs(track.xyz - state["position"])[track.valid].max(initial=0) < METRES
            assert np.abs(track.velocity - state["velocity"])[track.valid].max(initial=0) < METRES
            turn = np.angle(np.exp(1j * (track.yaw - state["heading"])))[track.valid]
            assert np.abs(turn).max(initial=0) < 1e-5
            assert not track.valid.any() or track.size[0] == state["length"][track.valid][-1]
        for light in raw.lights:
            names = [f"LANE_STATE_{LIGHT_STATES[code].upper()}" if ok else None for code, ok in zip(light.state, light.valid, strict=True)]
            assert names == lights[str(light.lane)]["state"]["object_state"]
            assert np.abs(light.stop - lights[str(light.lane)]["stop_point"]).max() < METRES
        assert raw.tracks[raw.sdc].id == int(theirs["metadata"]["sdc_id"]) and raw.metadata["dataset"] == "WOMD"
        assert raw.current == theirs["metadata"]["current_time_index"]


def test_nuscenes_lanes_have_no_heading_for_a_height_and_its_car_is_as_long_as_it_is(shared_data, readers):
    (path,) = (shared_data / "formats" / "scenarionet").glob("*nuscenes*")
    raw = one(path, readers)
    with open(path, "rb") as file:
        theirs = pickle.load(file)
    assert raw.metadata["dataset"] == "nuScenes" and len(raw.tracks) == len(theirs["tracks"])
    names = {number: text for text, number in raw.metadata["tokens"]["features"].items()}
    for line in raw.roads:
        corners = np.array([row[:2] for row in theirs["map_features"][names[line.id]]["polyline"]])
        near = np.linalg.norm(line.xyz[None, :, :2] - corners[:, None], axis=2).min(axis=1) if len(corners) < 200 else np.zeros(1)
        assert near.max() < METRES and not line.xyz[:, 2].any()  # every corner is kept
        assert np.linalg.norm(np.diff(line.xyz, axis=0), axis=1).max() <= FORMATS["scenarionet"]["point_spacing_m"] + 1e-9
    outlines = [name for name in theirs["map_features"] if name.startswith("boundary_")]
    assert Counter(line.kind for line in raw.roads)[15] == len(outlines) == 44
    assert raw.tracks[raw.sdc].size[:2] == (4.08, 1.73)
    plain = reader_selection.make(FORMATS | {"scenarionet": FORMATS["scenarionet"] | {"outlines_are_edges": False}})
    assert not any(line.kind == 15 for line in one(path, plain).roads)


def test_the_summary_of_a_database_is_no_scene(shared_data, readers, tmp_path):
    with pytest.raises(Companion, match="summary"):
        one(shared_data / "formats" / "scenarionet" / "dataset_summary.pkl", readers)
    with pytest.raises(Companion, match="mapping"):
        one(written(tmp_path, dumped({"sd_a.pkl": "", "sd_b.pkl": "part"}), "dataset_mapping.pkl"), readers)


@pytest.mark.parametrize("layout", [lambda whole: whole, in_spring_2023, in_march_2023], ids=["today", "April 2023", "March 2023"])
def test_every_layout_gives_the_same_scene(tmp_path, readers, layout):
    raw = one(written(tmp_path, dumped(layout(scenarionet_document()))), readers)
    assert [line.kind for line in raw.roads] == [2, 3, 15, 15, 17, 18] and [line.id for line in raw.roads] == [1, 2, 3, 7, 5, 6]
    lane = raw.roads[0]
    assert (lane.entry, lane.exit, lane.left, lane.right) == ((2,), (3, 99), (2,), ())
    assert lane.speed_limit == pytest.approx(11.176) and raw.roads[1].speed_limit is None
    assert [(track.id, track.kind, track.size) for track in raw.tracks] == [
        (7, "vehicle", (4.5, 1.9, 1.5)), (8, "cyclist", (4.5, 1.9, 1.5))
    ]  # fmt: skip
    assert (raw.sdc, raw.current, raw.name) == (0, 10, "street") and not raw.tracks[0].xyz[:2].any()
    np.testing.assert_allclose(raw.times, 0.1 * np.arange(STEPS))
    (light,) = raw.lights
    observed = [LIGHT_STATES[code] if ok else None for code, ok in zip(light.state, light.valid, strict=True)]
    assert observed == ["stop", None, "go", *["arrow_go"] * (STEPS - 3)] and light.lane == 1 and light.stop.tolist() == [5, 0, 0]
    assert raw.metadata["left_out"] == {"ROAD_EDGE_SIDEWALK": 1} and {line.id: line.lanes for line in raw.roads if line.kind == 17} == {
        5: (1,)
    }
    assert json.loads(json.dumps(raw.metadata)) == raw.metadata
    _, report = prepared(raw, require_agents=False)
    assert report.segments_kept


def test_the_rim_of_a_metadrive_map_is_its_road_edge(tmp_path, readers):
    whole = metadrive_document()
    raw = one(written(tmp_path, dumped(whole)), readers)
    names = {number: text for text, number in raw.metadata["tokens"]["features"].items()}
    edges = [names[line.id] for line in raw.roads if line.kind in EDGES]
    assert edges == ["('>', '>>', 2)_1", "('->>', '->', 1)_1"]
    assert Counter(line.kind for line in raw.roads) == {2: 5, 6: 2, 7: 1, 11: 2, 15: 2}  # the ramp is closed off by a line
    limits = [line.speed_limit for line in raw.roads if line.kind == 2]
    assert limits == [None, pytest.approx(40 / 3.6), None, None, None]  # 1,000 km/h is none
    scene, report = prepared(raw, centre="mean", require_agents=False)
    assert len(scene.edges.kind) == 2 * 40 and report.metadata["edges_from_lines"] == 2
    changes = [{"metadata": whole["metadata"] | {"dataset": "waymo"}}]
    changes += [{"map_features": whole["map_features"] | {"edge": {"type": "ROAD_EDGE_MEDIAN", "polyline": street(20.0)}}}]
    for change in changes:
        same = one(written(tmp_path, dumped(whole | change)), readers)
        assert not any(line.kind == 15 for line in same.roads) and "edges_from_lines" not in same.metadata
    plain = reader_selection.make(FORMATS | {"scenarionet": FORMATS["scenarionet"] | {"outlines_are_edges": False}})
    assert not any(line.kind in EDGES for line in one(written(tmp_path, dumped(whole)), plain).roads)


def test_lanes_of_a_metadrive_map_lead_where_they_meet(tmp_path, readers):
    """MetaDrive lists all lanes of the next road as exits, and all lanes to one side as neighbours."""
    whole = metadrive_document()
    features, ahead = whole["map_features"], [f"('>>', '>>>', {number})" for number in range(3)]
    behind = [f"('>', '>>', {number})" for number in range(3)]
    for key, name in zip(behind, ahead, strict=True):
        place = features[key]["polyline"]
        moved = {"polyline": place + (place[-1] - place[0]), "polygon": features[key]["polygon"] + (place[-1] - place[0])}
        features[name] = features[key] | moved | {"entry_lanes": behind}
        features[key] |= {"exit_lanes": ahead}
    features[behind[0]]["right_neighbor"], features[behind[2]]["left_neighbor"] = behind[1:], behind[:2]
    raw = one(written(tmp_path, dumped(whole)), readers)
    names = {number: text for text, number in raw.metadata["tokens"]["features"].items()}
    lanes = {names[line.id]: line for line in raw.roads}
    assert [[names[i] for i in lanes[key].exit] for key in behind] == [[name] for name in ahead]
    assert [[names[i] for i in lanes[name].entry] for name in ahead] == [[key] for key in behind]
    assert [names[i] for i in (*lanes[behind[0]].right, *lanes[behind[2]].left)] == [behind[1]] * 2
    assert raw.metadata["left_out"] == {"ROAD_EDGE_SIDEWALK": 1, "LINK_SIDEWAYS": 6}


class Hostile:
    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


def test_a_hostile_pickle_is_refused_by_name_and_does_nothing(tmp_path, readers):
    trap = tmp_path / "trap"
    calls = {"posix.system": Hostile(os.system, f"touch {trap}"), "builtins.eval": Hostile(eval, f"open({str(trap)!r}, 'w')")}
    calls["builtins.getattr"] = Hostile(getattr, 1, "real")
    calls["io.open"] = Hostile(open, str(trap), "w")
    for name, call in calls.items():
        for protocol in (3, 4, 5):
            content = pickle.dumps(scenarionet_document() | {"id": call}, protocol)
            with pytest.raises(SceneError, match=rf"the global _?{name} is refused"):
                one(written(tmp_path, content), readers)
    assert not trap.exists()


@pytest.mark.parametrize(
    "content, message",
    [
        (b"\x80\x04cnumpy\ndtype\n}(\x8c\x01a\x8c\x01bub.", "BUILD|expected tuple, got dict"),  # attributes of what a global stands for
        (b"\x80\x04}" + b")" + b"\x85" * 20_000 + b"K\x01s.", "a tuple as a key"),  # a hash deeper than the C stack
        (b"\x80\x04" + b"]" * 5_000 + b"a" * 4_999 + b".", "nested deeper"),
        (b"\x80\x04}]q\x00h\x00as.", "cut short|damaged"),
        (b"\x80\x04]\x94h\x00a.", "in themselves"),
        (b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"abc.", "damaged or cut short"),  # bytes that are not there
        (b"\x80\x04\x8a\xff" + b"\x7f" * 255 + b".", "an integer of"),
        (b"\x80\x04" + b"".join([b"]\x94", *[b"](" + b"h" + bytes([n]) + (b"h" + bytes([n])) * 9 + b"e\x94" for n in range(30)]]) + b".",
         "shared over and over|damaged"),  # ten times ten times ten ...
        (b"\x80\x04](" + b"".join(b"J" + struct.pack("<i", n) for n in range(999)) + b"e\x94cbuiltins\nset\n\x94("
         + b"h\x01h\x00\x85R" * 500 + b"t.", "shared over and over"),  # half a million values, copied from 999
        (b"\x80\x04Vtext\n.", "opcode UNICODE is refused"),
        (b"\x80\x04cnumpy.core.numeric\n_frombuffer\n(C\x08" + bytes(8) + b"cnumpy\ndtype\n\x8c\x02f8\x85R(" + b"K\x01" * 33
         + b"t\x8c\x01CtR.", "at most 32 sizes"),
        (pickle.dumps(np.array(["a"]), protocol=4).replace(b"a\0\0\0", struct.pack("<I", 0x110000)), "code point 0x110000"),
        (pickle.dumps(np.str_("a"), protocol=4).replace(b"a\0\0\0", struct.pack("<I", 0xFFFFFFFF)), "code point 0xffffffff"),
        (pickle.dumps(np.array([object], object), protocol=4), "builtins.object is refused"),
        (pickle.dumps(np.array([{}], object), protocol=4), "'O8'|type list"),
        (pickle.dumps(np.zeros(3, "f4,i4"), protocol=4), "'V8'|records"),
        (pickle.dumps(np.arange(1000.0), protocol=4).replace(b"M\xe8\x03", b"M\xe9\x03"), "expected 8008 bytes"),
    ],
)  # fmt: skip
def test_a_bomb_is_refused(tmp_path, content, message):
    with pytest.raises(SceneError, match=message):
        safe_pickle.load(written(tmp_path, content), **LIMITS)


def test_lights_of_more_lanes_than_a_scene_has_are_refused(tmp_path, readers):
    lights = [[{"lane": step}] for step in range(1001)]  # a state of each lane at each step
    path = written(tmp_path, dumped(in_march_2023(scenarionet_document()) | {"dynamic_map_states": lights}))
    with pytest.raises(SceneError, match=r"dynamic_map_states\[999\]\[0\]: expected at most 1000000 states of all lights"):
        one(path, readers)


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress], ids=["gzip", "xz"])
def test_pickles_and_records_may_be_compressed(tmp_path, readers, compress):
    record = records.framed(records.scenario().SerializeToString())
    for content in (dumped(scenarionet_document()), record):
        assert one(written(tmp_path, compress(content), "scene"), readers).name == "street"


def test_a_pickle_has_limits(tmp_path):
    path = written(tmp_path, dumped(list(range(1000))))
    with pytest.raises(SceneError, match="expected a content of up to 0 MB, got more"):
        safe_pickle.load(path, file_limit_mb=0, opcode_limit=10**6)
    with pytest.raises(SceneError, match="more than 100 opcodes"):
        safe_pickle.load(path, file_limit_mb=1, opcode_limit=100)
    assert LIMITS["opcode_limit"] <= 10**6  # nine million empty lists took a minute and 1.7 GB; a scenario of 20 s has 141,000
    with pytest.raises(FormatMismatch, match="expected a pickle of protocol 3, 4, 5"):
        safe_pickle.load(written(tmp_path, pickle.dumps([], protocol=0)), **LIMITS)


# ---- Argoverse 2


def test_the_argoverse_scenario_agrees_with_an_independent_reading(shared_data, readers):
    folder = shared_data / "formats" / "argoverse2"
    (path,), (map_path,) = folder.glob("*.parquet"), folder.glob("*.json")
    raw, rows, area = one(path, readers), pyarrow.parquet.read_table(path).to_pylist(), json.loads(map_path.read_text())
    with pytest.raises(Companion, match="map of an Argoverse 2"):
        one(map_path, readers)
    assert (len(raw.times), raw.current, raw.metadata["dataset"]) == (110, 49, "argoverse2")
    np.testing.assert_allclose(np.diff(raw.times), 0.1, atol=1e-6)
    assert len(raw.tracks) == len({row["track_id"] for row in rows}) and sum(track.valid.sum() for track in raw.tracks) == len(rows)
    by_id = {str(track.id): track for track in raw.tracks}
    by_id["AV"] = raw.tracks[raw.sdc]
    for row in rows:
        track, step = by_id[row["track_id"]], row["timestep"]
        assert track.valid[step] and abs(track.xyz[step, :2] - (row["position_x"], row["position_y"])).max() < METRES
        assert abs(np.angle(np.exp(1j * (track.yaw[step] - row["heading"])))) < 1e-9
    segments = area["lane_segments"].values()
    lanes = {line.id: line for line in raw.roads if line.kind in (2, 3)}
    assert set(lanes) == {segment["id"] for segment in segments}
    for segment in segments:
        lane = lanes[segment["id"]]
        own = shapely.LineString([(p["x"], p["y"]) for p in segment["centerline"]])
        assert shapely.hausdorff_distance(own, shapely.LineString(lane.xyz[:, :2]), 0.1) < 0.15  # their points are 2 m apart and rounded
        assert lane.entry == tuple(segment["predecessors"]) and lane.exit == tuple(segment["successors"])
        assert (lane.kind == 3) == (segment["lane_type"] == "BIKE")
    marked = set()
    for segment in segments:
        for side in ("left", "right"):
            points = [tuple(p.values()) for p in segment[f"{side}_lane_boundary"]]
            if segment[f"{side}_lane_mark_type"] != "NONE":
                marked.add(min(tuple(points), tuple(points[::-1])))
    assert sum(6 <= line.kind <= 13 for line in raw.roads) == len(marked)
    assert sum(line.kind == 18 for line in raw.roads) == len(area["pedestrian_crossings"])
    heights = np.concatenate([line.xyz[:, 2] for line in raw.roads])
    assert heights.min() > 20 and heights.max() < 27  # the file's own centrelines are at 0
    whole = shapely.union_all([shapely.Polygon([(p["x"], p["y"]) for p in a["area_boundary"]]) for a in area["drivable_areas"].values()])
    edges = shapely.union_all([shapely.LineString(line.xyz[:, :2]) for line in raw.roads if line.kind == 15])
    assert whole.boundary.buffer(METRES).covers(edges) and 0.9 * whole.length < edges.length < whole.length
    assert not any(edges.distance(shapely.LineString(lane.xyz[:, :2])) < 0.1 for lane in lanes.values())


def test_an_argoverse_scenario_by_hand(tmp_path, readers):
    content, area = argoverse2_files()
    path = written(tmp_path, content, "scenario_a-b.parquet")
    with pytest.raises(SceneError, match=r"its map is missing: .*log_map_archive_a-b\.json"):
        one(path, readers)
    written(tmp_path, encoded(area), "log_map_archive_a-b.json")
    raw = one(path, readers)
    lanes = {line.id: line for line in raw.roads if line.kind == 2}
    assert not lanes[1].left and lanes[1].exit == (7,)  # the neighbour across the centre line drives the other way
    np.testing.assert_allclose(lanes[1].xyz[[0, -1]], [[-30, -2, 20], [30, -2, 20]])
    assert [line.kind for line in raw.roads] == [2, 2, 12, 15, 15, 18]  # the centre line once; both ends of the road are cuts
    for line in raw.roads[3:5]:
        assert np.all(np.abs(line.xyz[:, 1]) == 4) and np.ptp(line.xyz[:, 0]) == 60
    assert raw.current == 4 and raw.tracks[raw.sdc].xyz[3].tolist() == [-17.0, 0.0, 20.75]
    assert raw.metadata["tracks_to_predict"] == [12, 13] and raw.metadata["focal_track"] == 12
    area["lane_segments"]["2"] = area["lane_segments"]["2"] | {"lane_type": "TRAM"}
    written(tmp_path, encoded(area), "log_map_archive_a-b.json")
    with pytest.raises(SceneError, match=r"b\.json: lane_segments\['2'\]\.lane_type: expected VEHICLE, BUS, BIKE, got 'TRAM'"):
        one(path, readers)


# ---- PufferDrive, GPUDrive


def test_the_pufferdrive_map_agrees_with_an_independent_reading(shared_data, readers):
    path = shared_data / "formats" / "pufferdrive" / "map_942.bin"
    content, raw = path.read_bytes(), one(path, readers)
    counts, place = struct.unpack_from("<ii", content), 8
    assert (len(raw.tracks), len(raw.roads)) == counts
    kinds = {4: 2, 5: 6, 6: 15, 7: 17, 8: 18, 9: 19, 10: 20}
    for entity in (*raw.tracks, *raw.roads):
        kind, count = struct.unpack_from("<ii", content, place)
        axes = np.array(struct.unpack_from(f"<{3 * count}f", content, place + 8)).reshape(3, count).T
        place += 8 + 12 * count
        if kind <= 3:
            flags = np.array(struct.unpack_from(f"<{count}i", content, place + 16 * count), bool)
            assert np.array_equal(entity.valid, flags) and np.abs(entity.xyz - axes)[flags].max(initial=0) < METRES
            place += 20 * count
            assert entity.size[:2] == struct.unpack_from("<ff", content, place)[::-1]
        else:
            assert entity.kind == kinds[kind]
            assert np.linalg.norm(entity.xyz[None] - axes[:, None], axis=2).min(axis=1).max() < METRES  # every corner is kept
            assert count == 1 or shapely.LineString(entity.xyz).length == pytest.approx(shapely.LineString(axes).length)
        place += 28
    assert place == len(content) and raw.sdc is None and raw.current == 10


def test_counts_of_a_binary_map_are_held_against_its_size(tmp_path, readers):
    content = pufferdrive_map()
    raw = one(written(tmp_path, content), readers)
    assert [track.kind for track in raw.tracks] == ["vehicle", "pedestrian"] and raw.metadata["experts"] == [1]
    assert raw.tracks[0].size == pytest.approx((4.5, 1.9, 1.5)) and [len(line.xyz) for line in raw.roads] == [41, 41, 1]
    claims = {0: "it begins with b", 4: "it begins with b", 12: r"objects\[0\]: type 1 with 2147483647 entries"}
    for place, message in claims.items():
        with pytest.raises(SceneError, match=message):
            one(written(tmp_path, content[:place] + struct.pack("<i", 2**31 - 1) + content[place + 4 :]), readers)
    with pytest.raises(SceneError, match=r"roads\[2\]: .* damaged or cut short"):
        one(written(tmp_path, content[:-4]), readers)
    with pytest.raises(SceneError, match="4 bytes more than 2 objects and 3 roads have"):
        one(written(tmp_path, content + bytes(4)), readers)


def test_lights_of_gpudrive_json(tmp_path, readers):
    light = {"state": ["stop", "go"], "x": [1.0, 1.0], "y": [2.0, 2.0], "z": [3.0, 3.0], "time_index": [0, 4]}
    raw = one(written(tmp_path, encoded(document(tl_states={"1": light})), "scene.json"), readers)
    (found,) = raw.lights
    assert found.lane == 1 and found.valid.nonzero()[0].tolist() == [0, 4] and found.stop.tolist() == [1, 2, 3]
    assert [LIGHT_STATES[code] for code in found.state[[0, 4]]] == ["stop", "go"]
    bad = {
        r"tl_states\['1'\]\.state\[0\]: expected one of .*, got 'red'": light | {"state": ["red", "go"]},
        r"tl_states\['1'\]\.time_index\[1\]: expected a step, 0 to 11, got 12": light | {"time_index": [0, 12]},
        r"tl_states\['1'\]\.state: expected 1 entries, .*, got 2": light | {"time_index": [0]},
        r"tl_states\['1'\]\.x: expected 2 entries, .*, got 1": light | {"x": [1.0]},
    }
    for message, record in bad.items():
        with pytest.raises(SceneError, match=message):
            one(written(tmp_path, encoded(document(tl_states={"1": record})), "scene.json"), readers)
    with pytest.raises(SceneError, match="expected the id of a lane, got 'east'"):
        one(written(tmp_path, encoded(document(tl_states={"east": light})), "scene.json"), readers)


def test_a_line_keeps_its_points_and_gets_more():
    corners = np.array([[0.0, 0, 0], [5, 0, 1], [5, 1, 1]])
    dense = polylines.densify(corners, 2.0)
    assert np.linalg.norm(np.diff(dense, axis=0), axis=1).max() <= 2.0 and all((dense == corner).all(axis=1).any() for corner in corners)
    assert polylines.densify(dense, 2.0) is dense and polylines.densify(1e300 * corners, 2.0).shape == corners.shape
    assert shapely.LineString(dense).length == pytest.approx(shapely.LineString(corners).length)
    np.testing.assert_allclose(polylines.resample(corners[:, :3] * [1, 1, 0], 7)[:, :2], [[x, 0] for x in range(6)] + [[5, 1]])


def test_real_files_are_told_apart_whatever_they_are_called(shared_data, readers, tmp_path):
    kinds = {"gpudrive": "nocturne_old/*", "scenarionet": "scenarionet/*overpass*", "pufferdrive": "pufferdrive/*"}
    for name, pattern in kinds.items():
        (path,) = (shared_data / "formats").glob(pattern)
        content = path.read_bytes()
        if name == "gpudrive":
            content = lzma.decompress(content)
        assert one(written(tmp_path, content, "scene"), readers).metadata["format"] == name


def refusal(path, readers):
    """Why no reader reads a file; two lines of a terminal, whatever is in it."""
    with pytest.raises(SceneError) as caught:
        next(reader_selection.read(path, readers))
    reason = str(caught.value).removeprefix(f"{path}: ")
    assert len(reason) <= 2 * 140
    return reason


def test_a_refusal_names_the_format_of_real_files(shared_data):
    readers = reader_selection.make({name: FORMATS[name] for name in ("womd", "gpudrive", "pufferdrive")})  # without those of the files
    kinds = {
        "opendrive/*": "OpenDRIVE",
        "commonroad/*": "CommonRoad",
        "interaction/*/*.osm": "OpenStreetMap XML, such as the Lanelet2 maps of INTERACTION",
        "interaction/*/*/*.csv": "a recording of INTERACTION (CSV)",
    }
    for pattern, name in kinds.items():
        paths = sorted((shared_data / "formats").glob(pattern))
        assert paths
        assert all(refusal(path, readers).startswith(f"this is {name}: it is not read; formats: womd, gpudrive, ") for path in paths)


def test_a_refusal_says_what_a_file_is_or_what_it_is_not(tmp_path, readers):
    long = json.dumps({f"key_{number}": 1 for number in range(500)})
    database = sqlite3.connect(":memory:")
    database.execute("CREATE TABLE other (x)")
    comment = f"<?xml version='1.0'?>\n<!-- <net> {'x' * 5000} -->\n"
    cases = {
        f"{comment}<routes/>": "this is a route file of SUMO: give the network (.net.xml), or a recording (--fcd-output) beside it",
        "Vehicle_ID,Frame_ID,Total_Frames": "this is a recording of NGSIM (CSV): it is not read",
        '{"type": "FeatureCollection", "features": []}': "this is GeoJSON: it is not read",
        f"{comment}<kml xmlns='x'>": "this is XML of the root element 'kml': it is not read",
        "<?xml version='1.0' encoding='utf-16'?><OpenSCENARIO>".encode("utf-16"): "this is OpenSCENARIO",
        "<" + "?" * 9000: "unknown format: it begins with b'<???",
        database.serialize(): "unknown format: nuplan: an SQLite database, but no log of nuPlan: no table lidar_pc; formats: womd, ",
        "": f"an empty file; formats: {', '.join(FORMATS)}",
        "frame,id\n1,2\n": "unknown format: it begins with b'frame,id",
        long: "unknown format: gpudrive: expected GPUDrive JSON with 'objects', got the keys [",
        pickle.dumps([1]): "unknown format: scenarionet: expected a ScenarioNet pickle with a dict, got list",
    }
    for content, reason in cases.items():
        path = tmp_path / "file"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        assert refusal(path, readers).startswith(reason)
