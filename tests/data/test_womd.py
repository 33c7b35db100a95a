"""Readers of the Waymo Open Motion Dataset's own files: one scene in two encodings, and the real samples against their bytes."""

from collections import Counter

import numpy as np
import pytest
from support import womd_records as records
from support.scene_documents import FORMATS, prepared
from support.womd_records import JUMP_M, scenes

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data.formats import reader_selection


def agree(a: RawScene, b: RawScene, atol):
    assert [(line.kind, line.id) for line in a.roads] == [(line.kind, line.id) for line in b.roads]
    for one, other in zip(a.roads, b.roads, strict=True):
        np.testing.assert_allclose(one.xyz, other.xyz, atol=atol)
    assert [(track.id, track.kind) for track in a.tracks] == [(track.id, track.kind) for track in b.tracks]
    for one, other in zip(a.tracks, b.tracks, strict=True):
        assert one.valid.tolist() == other.valid.tolist()
        for name in ("size", "xyz", "yaw", "velocity"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol)
    assert [light.lane for light in a.lights] == [light.lane for light in b.lights]
    for one, other in zip(a.lights, b.lights, strict=True):
        assert (one.state.tolist(), one.valid.tolist()) == (other.state.tolist(), other.valid.tolist())
        np.testing.assert_allclose(one.stop, other.stop, atol=atol)
    np.testing.assert_allclose(a.times, b.times, atol=1e-9)
    assert (a.name, a.current, a.sdc) == (b.name, b.current, b.sdc)
    for key in ("dataset", "scenario_id", "tracks_to_predict", "difficulty_levels", "objects_of_interest"):
        assert a.metadata[key] == b.metadata[key], key


# ---- both encodings


def test_both_encodings_give_the_same_scene(tmp_path):
    one, other = scenes(tmp_path, records.scenario(), records.example(records.features()))
    agree(one, other, atol=1e-6)
    assert (one.metadata["format"], other.metadata["format"]) == ("womd_scenario", "womd_example")
    assert one.metadata["record"] == 0 and other.metadata["record"] == 1
    for (identity, kind, points), line in zip(records.ROADS, one.roads, strict=True):
        assert (line.id, line.kind) == (identity, kind)
        np.testing.assert_array_equal(line.xyz, points)
    car, walker = one.tracks
    assert (car.kind, walker.kind, one.sdc, one.current) == ("vehicle", "pedestrian", 0, records.CURRENT)
    assert car.size == records.SIZES[0] and walker.size == records.SIZES[1]  # the walker's at her first valid step
    assert not walker.xyz[~walker.valid].any() and walker.valid.tolist() == records.observed(1).tolist()
    (light,) = one.lights
    assert light.lane == 4 and light.valid.tolist() == [step >= 5 for step in range(12)]
    assert light.state[5:].tolist() == [4, 4, 4, 6, 6, 6, 6]
    assert one.metadata["tracks_to_predict"] == [8] and {line.id: line.lanes for line in one.roads if line.kind == 17} == {12: (4,)}


def test_the_proto_keeps_the_graph_of_lanes(tmp_path):
    lane = scenes(tmp_path, records.scenario())[0].roads[0]
    assert (lane.entry, lane.exit, lane.left, lane.right, lane.rebuilt) == ((1,), (2, 3), (5, 6), (), False)
    assert lane.speed_limit == pytest.approx(25 * 1609.344 / 3600, rel=1e-15)


def test_lights_follow_their_own_clock(tmp_path):
    late, plain = scenes(tmp_path, *(records.example(records.features(lag=lag)) for lag in (2, 0)))
    assert late.metadata["lights_moved"] and not plain.metadata["lights_moved"]
    assert late.lights[0].valid.tolist() == plain.lights[0].valid.tolist()
    assert late.lights[0].state.tolist() == plain.lights[0].state.tolist()


def test_samples_are_put_together_by_id_and_split_at_jumps(tmp_path):
    found = records.features()
    xyz = found["roadgraph_samples/xyz"].reshape(-1, 3)
    xyz[20:41, 0] += 50.0  # the lane's second half
    order = np.r_[np.arange(10), np.arange(41, 82), np.arange(10, 41), np.arange(82, len(xyz))]  # the edge amid the lane
    for name in ("id", "type", "valid"):
        found[f"roadgraph_samples/{name}"] = found[f"roadgraph_samples/{name}"][order]
    found["roadgraph_samples/xyz"] = xyz[order].ravel()
    lines = scenes(tmp_path, records.example(found))[0].roads
    assert [(line.id, len(line.xyz)) for line in lines] == [(4, 20), (4, 21), (7, 41), (9, 4), (12, 1)]
    np.testing.assert_array_equal(lines[0].xyz, xyz[:20])


def test_a_hidden_future_is_none(tmp_path):
    """As in WOMD's test set."""
    found = records.features()
    for key in found:
        if "future" in key:
            found[key] = np.full_like(found[key], -1)
    hidden = scenes(tmp_path, records.example(found))[0]
    assert len(hidden.times) == records.CURRENT + 1 and not hidden.lights
    assert hidden.tracks[0].valid.all() and not hidden.tracks[1].valid.any()


# ---- the real samples, against their bytes

# field of MapFeature, type -> map element
KINDS = {3: [0, 1, 2, 3], 4: list(range(5, 14)), 5: [14, 15, 16], 7: [17], 8: [18], 9: [19], 10: [20]}
PERIODS = ("past", "current", "future")


def sample(shared_data, name):
    path = shared_data / "formats" / "womd_tfrecord" / f"{name}.tfrecord"
    (raw,) = reader_selection.read(path, reader_selection.make(FORMATS))
    content = path.read_bytes()
    return raw, content[12:-4]


@pytest.mark.parametrize("name", ["motion_data_one_scenario", "womd_scenario_input"])
def test_a_real_proto_against_its_bytes(shared_data, name):
    raw, data = sample(shared_data, name)
    top = records.walk(data)
    (current,), (sdc,), (identity,) = ([value for field, value in top if field == expected] for expected in (10, 6, 5))
    assert (raw.current, raw.sdc, raw.name.encode(), raw.metadata["format"]) == (current, sdc, identity, "womd_scenario")
    assert raw.times.tolist() == [value for field, value in top if field == 1]
    expected = []
    for feature in (records.walk(value) for field, value in top if field == 8):
        place, body = next((field, records.walk(value)) for field, value in feature if field in KINDS)
        sort = dict(body).get(2 if place == 3 else 1, 0) if place in (3, 4, 5) else 0
        field = {3: 8, 4: 2, 5: 2, 7: 2}.get(place, 1)
        points = [[dict(records.walk(value))[axis] for axis in (1, 2, 3)] for number, value in body if number == field]
        expected.append((dict(feature)[1], KINDS[place][sort], points, body if place == 3 else []))
    assert Counter(line.kind for line in raw.roads) == Counter(kind for _, kind, _, _ in expected)
    for line, (number, kind, points, body) in zip(raw.roads, expected, strict=True):
        assert (line.id, line.kind) == (number, kind)
        np.testing.assert_array_equal(line.xyz, points)
        near = {field: [value for number, value in body if number == field] for field in (9, 10, 11, 12)}
        for field in (9, 10):  # packed, or one by one
            near[field] = [number for value in near[field] for number in (records.varints(value) if isinstance(value, bytes) else [value])]
        for field in (11, 12):
            near[field] = list(dict.fromkeys(dict(records.walk(value))[1] for value in near[field]))
        assert [list(ids) for ids in (line.entry, line.exit, line.left, line.right)] == list(near.values())
        assert line.speed_limit == (dict(body).get(1, 0) * 0.44704 or None)
    tracks = [records.walk(value) for field, value in top if field == 2]
    assert [(track.id, track.kind) for track in raw.tracks] == [
        (dict(track)[1], ["other", "vehicle", "pedestrian", "cyclist", "other"][dict(track)[2]]) for track in tracks
    ]
    for track, body in zip(raw.tracks, tracks, strict=True):
        states = [dict(records.walk(value)) for field, value in body if field == 3]
        assert track.valid.tolist() == [state.get(11) == 1 for state in states]
        rows = [state for state in states if state.get(11) == 1]
        table = np.array([[state[field] for field in range(2, 11)] for state in rows]).reshape(-1, 9)
        np.testing.assert_array_equal(track.xyz[track.valid], table[:, :3])
        np.testing.assert_allclose(np.cos(track.yaw[track.valid] - table[:, 6]), 1.0, atol=1e-12)
        np.testing.assert_array_equal(track.velocity[track.valid], table[:, 7:])
        assert track.size == tuple(np.array([(states[current] if states[current].get(11) else rows[0])[field] for field in (5, 6, 7)]))
    lights = {}
    for step, moment in enumerate(value for field, value in top if field == 7):
        for signal in (dict(records.walk(value)) for _, value in records.walk(moment)):
            lights.setdefault(signal[1], {})[step] = signal[2]
    assert {light.lane: {int(s): int(light.state[s]) for s in np.flatnonzero(light.valid)} for light in raw.lights} == lights
    chosen = [dict(records.walk(value)) for field, value in top if field == 11]
    assert raw.metadata["tracks_to_predict"] == [dict(tracks[entry[1]])[1] for entry in chosen]
    assert raw.metadata["objects_of_interest"] == [value for field, value in top if field == 4]
    scene, report = prepared(raw)
    assert scene.agents.present.any() and report.segments_kept > 0


def test_a_real_example_against_its_bytes(shared_data):
    raw, data = sample(shared_data, "motion_data_one_example")
    ((_, body),) = records.walk(data)
    found = {}
    for _, entry in records.walk(body):
        (_, key), (_, feature) = records.walk(entry)
        ((sort, values),) = records.walk(feature)
        ((_, packed),) = records.walk(values)
        found[key.decode()] = packed if sort == 1 else np.frombuffer(packed, "<f4") if sort == 2 else np.array(records.varints(packed))
    whole = lambda name: np.concatenate([found[f"state/{p}/{name}"].reshape(128, -1) for p in PERIODS], axis=1)  # noqa: E731
    assert raw.metadata["format"] == "womd_example" and raw.name.encode() == found["scenario/id"] and raw.metadata["map_full"]
    assert [track.id for track in raw.tracks] == found["state/id"].tolist() and raw.sdc == int(np.argmax(found["state/is_sdc"]))
    for name, column in (("x", 0), ("y", 1), ("z", 2)):
        for row, track in enumerate(raw.tracks):
            np.testing.assert_array_equal(track.xyz[:, column], np.where(whole("valid")[row] == 1, whole(name)[row], 0))
    measured = np.where(whole("valid")[:, 10] == 1, 10, np.argmax(whole("valid"), axis=1))
    assert [track.size[0] for track in raw.tracks] == whole("length")[np.arange(128), measured].tolist()
    assert Counter(track.kind for track in raw.tracks) == {"vehicle": 119, "pedestrian": 8, "cyclist": 1}
    np.testing.assert_allclose(raw.times * 1e6, whole("timestamp_micros").max(axis=0))
    points = found["roadgraph_samples/xyz"].reshape(-1, 3).astype(float)
    ids, kinds = found["roadgraph_samples/id"], found["roadgraph_samples/type"]
    starts = [i for i in range(len(ids)) if i == 0 or ids[i] != ids[i - 1] or np.linalg.norm(points[i] - points[i - 1]) > JUMP_M]
    assert len(set(ids.tolist())) == len(starts) - 1  # the sample has one jump, in an edge
    assert Counter(line.kind for line in raw.roads) == Counter(kinds[starts].tolist())
    assert [line.id for line in raw.roads] == ids[starts].tolist()
    np.testing.assert_array_equal(np.concatenate([line.xyz for line in raw.roads]), points)
    lane, state, valid = (
        np.concatenate([found[f"traffic_light_state/{p}/{name}"] for p in PERIODS]).tolist() for name in ("id", "state", "valid")
    )
    said = {(lane[i], i // 16): state[i] for i in range(len(lane)) if valid[i] == 1}
    assert {(light.lane, int(s)): int(light.state[s]) for light in raw.lights for s in np.flatnonzero(light.valid)} == said
    scene, _ = prepared(raw)
    assert scene.agents.present.any()
