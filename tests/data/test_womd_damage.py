"""What the readers of the Waymo Open Motion Dataset do with damaged files and with values that no log holds: all of them are named."""

import gzip
import struct
import tracemalloc
from collections import Counter

import numpy as np
import pytest
from support import womd_records as records
from support.scene_documents import FORMATS, checker, document, packer, written
from support.womd_records import saved, scenes

from scenefactory_jax.core.raw_scene import FormatMismatch, RawScene, Reject, SceneError
from scenefactory_jax.data.formats import reader_selection, tfrecord
from scenefactory_jax.data.loading import scene_source


def outcome(path):
    """Scenes and rejects of a file, or its refusal; anything else a reader may raise fails the test."""
    try:
        found = list(records.read(path))
    except SceneError as error:
        assert str(error)
        return error
    for item in found:
        assert isinstance(item, RawScene) or (isinstance(item, Reject) and item.reason.startswith("record "))
    return found


@pytest.fixture(scope="module")
def three():
    """A file of three records, and where each begins."""
    messages = (records.scenario(), records.example(records.features()), records.scenario())
    data = [message.SerializeToString() for message in messages]
    return data, np.cumsum([0, *(len(record) + 16 for record in data)]).tolist()


def test_a_damaged_record_is_named_and_the_others_are_read(tmp_path, three):
    data, starts = three
    content = bytearray(records.framed(*data))
    content[starts[1] + 500] ^= 1
    one, two, last = records.read(saved(tmp_path, bytes(content)))
    assert (one.name, last.name) == ("street", "street") and last.metadata["record"] == 2
    assert two == Reject(None, f"record 1 at byte {starts[1]}: the checksum of its data does not match")
    content = bytearray(records.framed(*data))
    content[starts[1] + 8] ^= 1  # the length's checksum: the data's says that the length is right
    assert [isinstance(item, RawScene) for item in outcome(saved(tmp_path, bytes(content)))] == [True, False, True]
    content[starts[1]] ^= 1  # and the length too: nothing says where the third begins
    _, two = outcome(saved(tmp_path, bytes(content)))
    assert f"record 1 at byte {starts[1]}: the checksum of its length" in two.reason


def test_a_conversion_lists_what_it_could_not_read(tmp_path, three):
    content = bytearray(records.framed(*three[0]))
    content[three[1][1] + 500] ^= 1
    path = saved(tmp_path, bytes(content))
    packed, summary = scene_source.pack_all(scene_source.open_files(path, reader_selection.make(FORMATS)), check=checker(), pack=packer())
    assert [scene.report.metadata["record"] for scene in packed] == [0, 2] and packed[0].report.track_ids == (7,)
    reason = f"record 1 at byte {three[1][1]}: the checksum of its data does not match"
    assert list(summary.rejects) == [{"source": str(path), "scene": None, "reason": reason}]


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
def test_a_truncated_file_gives_what_is_whole_and_names_the_rest(tmp_path, three, packed):
    data, starts = three
    content = records.framed(*data)
    edges = {start + offset for start in starts[:-1] for offset in (0, 1, 8, 11, 12, 13, 300)}
    for cut in sorted({*range(0, len(content), 311), *edges, len(content) - 1}):
        found = outcome(saved(tmp_path, gzip.compress(content[:cut], 1) if packed else content[:cut]))
        whole = sum(start <= cut for start in starts[1:])
        if cut < 12:
            assert isinstance(found, FormatMismatch)
            continue
        assert [isinstance(item, RawScene) for item in found] == [True] * whole + [False] * (cut not in starts), cut
        assert all(isinstance(item, RawScene) or "truncated" in item.reason for item in found)


def test_gzip_is_read_and_its_damage_is_named(tmp_path, three):
    packed = gzip.compress(records.framed(*three[0]), 1)
    assert [item.name for item in outcome(saved(tmp_path, packed))] == ["street"] * 3
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(packed), 60):
        bent = bytearray(packed)
        bent[place] ^= 1 << int(rng.integers(8))
        outcome(saved(tmp_path, bytes(bent)))
    for cut in range(0, len(packed), 97):
        found = outcome(saved(tmp_path, packed[:cut]))
        assert isinstance(found, FormatMismatch) or isinstance(found[-1], Reject)


def test_bit_flips_are_never_read_as_data(tmp_path, three):
    """Framing: whatever bit is flipped, no scene comes from a record that is not as it was written."""
    data, starts = three
    content = records.framed(*data)
    rng = np.random.default_rng(1)
    for place in sorted({*range(12), *rng.integers(0, len(content), 60).tolist()}):
        bent = bytearray(content)
        bent[place] ^= 1 << int(rng.integers(8))
        found = outcome(saved(tmp_path, bytes(bent)))
        if isinstance(found, list):
            hit = sum(start <= place for start in starts[1:])
            assert isinstance(found[hit], Reject) and all(isinstance(item, RawScene) for item in found[:hit])
        else:
            assert place < 12


@pytest.mark.parametrize("index", [0, 1], ids=["scenario", "example"])
def test_flips_under_a_right_checksum_give_scenes_or_reasons(tmp_path, three, index):
    """The messages themselves: protobuf's own errors, and values that no log holds."""
    rng = np.random.default_rng(2 + index)
    whole = three[0][index]
    flipped = []
    for _ in range(150):
        bent = bytearray(whole)
        for place in rng.integers(0, len(bent), int(rng.integers(1, 4))):
            bent[place] ^= 1 << int(rng.integers(8))
        flipped.append(bytes(bent))
    cut = [whole[:place] for place in range(0, len(whole), 301)]
    found = outcome(saved(tmp_path, records.framed(whole, *flipped, *cut, whole)))
    assert len(found) == len(flipped) + len(cut) + 2 and isinstance(found[-1], RawScene)
    kinds = Counter(type(item) for item in found[1:-1])
    assert kinds[Reject] > 20 and kinds[RawScene] > 20


@pytest.mark.parametrize("length", [2**30, 2**31, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
def test_a_huge_length_takes_no_memory(tmp_path, three, length, packed):
    head = struct.pack("<Q", length)
    content = records.framed(three[0][0]) + head + struct.pack("<I", records.masked(head)) + bytes(1000)
    path = saved(tmp_path, gzip.compress(content, 1) if packed else content)
    outcome(path)  # imports and caches
    tracemalloc.start()
    _, reject = outcome(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    fault = f"it declares {length} bytes of data; formats.womd.record_limit_mb is 64"
    assert f"record 1 at byte {len(three[0][0]) + 16}: {fault}" in reject.reason and peak < 2**23


def test_foreign_files_are_refused_and_go_to_their_readers(tmp_path):
    readers = reader_selection.make(FORMATS)
    assert next(reader_selection.read(written(tmp_path, document()), readers)).metadata["format"] == "gpudrive"
    foreign = {"empty": b"", "short": b"abc", "noise": bytes(range(256)) * 9, "record": records.framed(b"\x0a\x03abc", b"")}
    for name, content in foreign.items():
        path = saved(tmp_path, content, name)
        assert isinstance(outcome(path), FormatMismatch)
        said = {"empty": "an empty file", "record": "womd: record 0 at byte 0: neither a Scenario"}.get(name, "it begins with b'")
        with pytest.raises(SceneError, match=said):
            list(reader_selection.read(path, readers))
    later = outcome(saved(tmp_path, records.framed(records.scenario().SerializeToString(), b"\x0a\x03abc")))
    assert "neither a Scenario nor a tf.Example" in later[1].reason
    with pytest.raises(SceneError, match="cannot be read"):
        list(records.read(tmp_path / "nowhere"))


def test_the_checksum_is_the_published_one():
    """CRC-32C of "123456789" (RFC 3720's polynomial), masked by hand."""
    crc = 0xE3069283
    assert tfrecord.mask(b"123456789") == ((crc >> 15 | (crc << 17) & 0xFFFFFFFF) + 0xA282EAD8) & 0xFFFFFFFF


# ---- values


def bent(change):
    message = records.scenario()
    change(message)
    return message


SCENARIO_FAULTS = [
    (lambda m: m.tracks[1].states[6].ClearField("center_y"), r"tracks\[1\]\.states\[6\]\.center_y: missing"),
    (lambda m: setattr(m.tracks[1].states[6], "heading", float("nan")), r"tracks\[1\]\.states\[6\]\.heading: .*, got nan"),
    (lambda m: setattr(m.tracks[0], "object_type", 9), r"tracks\[0\]\.object_type: expected a type of object, 0 to 4, got 9"),
    (lambda m: m.tracks[0].ClearField("id"), r"tracks\[0\]\.id: missing"),
    (lambda m: m.tracks[1].states.pop(), r"tracks\[1\]\.states: expected 12 entries, .*, got 11"),
    (lambda m: setattr(m, "sdc_track_index", 2), r"sdc_track_index: expected a track, 0 to 1, got 2"),
    (lambda m: setattr(m, "current_time_index", -1), r"current_time_index: expected a step of the log, 0 to 11, got -1"),
    (lambda m: m.ClearField("current_time_index"), r"current_time_index: missing"),
    (lambda m: m.timestamps_seconds.__setitem__(4, 0.0), r"timestamps_seconds\[4\]: expected a time after 0\.3.* s, got 0\.0 s"),
    (lambda m: m.timestamps_seconds.__setitem__(4, float("inf")), r"timestamps_seconds\[4\]: expected a finite number, got inf"),
    (lambda m: m.ClearField("timestamps_seconds"), r"timestamps_seconds: expected at least one step, got none"),
    (lambda m: setattr(m.tracks_to_predict[0], "track_index", 5), r"tracks_to_predict\[0\]\.track_index: expected a track, 0 to 1, got 5"),
    (lambda m: setattr(m.map_features[0].lane, "type", 4), r"map_features\[0\]\.lane\.type: expected a type of lane, 0 to 3, got 4"),
    (lambda m: setattr(m.map_features[1].road_edge, "type", 3), r"map_features\[1\]\.road_edge\.type: .*, got 3"),
    (lambda m: setattr(m.map_features[0].lane, "speed_limit_mph", -5.0), r"map_features\[0\]\.lane\.speed_limit_mph: .*, got -5\.0"),
    (lambda m: setattr(m.map_features[0].lane.polyline[7], "z", float("nan")), r"map_features\[0\]\.lane\.polyline\[7\]\.z: .*, got nan"),
    (lambda m: m.map_features[0].lane.polyline[7].ClearField("x"), r"map_features\[0\]\.lane\.polyline\[7\]\.x: missing"),
    (lambda m: m.map_features[3].stop_sign.ClearField("position"), r"map_features\[3\]\.stop_sign\.position: missing"),
    (lambda m: m.map_features[2].ClearField("id"), r"map_features\[2\]\.id: missing"),
    (lambda m: setattr(m.dynamic_map_states[6].lane_states[0], "state", 9), r"dynamic_map_states\[6\]\.lane_states\[0\]\.state: .*, got 9"),
    (lambda m: m.dynamic_map_states[6].lane_states[0].ClearField("lane"), r"dynamic_map_states\[6\]\.lane_states\[0\]\.lane: missing"),
    (lambda m: m.dynamic_map_states.add(), r"dynamic_map_states: expected at most 12 entries, .*, got 13"),
]


def test_a_bad_value_of_a_proto_is_named(tmp_path):
    found = scenes(tmp_path, *(bent(change) for change, _ in SCENARIO_FAULTS))
    for number, (reject, (_, message)) in enumerate(zip(found, SCENARIO_FAULTS, strict=True)):
        assert isinstance(reject, Reject) and reject.scene == "street"
        with pytest.raises(SceneError, match=rf"^record {number} at byte \d+: {message}"):
            raise SceneError(reject.reason)


EXAMPLE_FAULTS = [
    ("state/past/x", ..., r"state/past/x: missing"),
    ("state/past/valid", ..., r"state/past/valid: missing"),
    ("state/current/y", ..., r"state/current/y: missing"),
    ("state/current/x", np.zeros(7), r"state/current/x: expected 4 numbers, got 7"),
    ("state/past/valid", np.zeros(7, int), r"state/past/valid: expected a multiple of 4 numbers, .*, got 7"),
    ("state/future/width", np.zeros(3), r"state/future/width: expected 32 numbers, got 3"),
    ("state/future/x", b"text", r"state/future/x: expected 32 numbers, got 0"),
    (("state/past/bbox_yaw", 2), np.nan, r"state/past/bbox_yaw\[2\]: expected a finite number, got nan"),
    (("state/past/valid", 0), 7, r"state/past/valid\[0\]: expected 1, 0 or, as padding, -1, got 7"),
    (("state/id", 0), 7.5, r"state/id\[0\]: expected a whole number, got 7\.5"),
    (("state/id", 0), -1.0, r"state/id\[0\]: expected an id, 0 or more, .*, got -1"),
    (("state/type", 2), 6.0, r"state/type\[2\]: expected a type of object, 0 to 4, got 6"),
    (("state/is_sdc", 2), 1, r"state/is_sdc: expected one recording car at most, got 2"),
    ("state/id", np.zeros(0), r"state/id: expected at least one object, got none"),
    (("roadgraph_samples/type", 3), 4, r"roadgraph_samples/type\[3\]: expected a map element, 0 to 20 without 4, got 4"),
    (("roadgraph_samples/xyz", 10), np.inf, r"roadgraph_samples/xyz\[3\]\.y: expected a finite number, got inf"),
    ("roadgraph_samples/valid", np.zeros(3, int), r"roadgraph_samples/valid: expected \d+ numbers, got 3"),
    ("roadgraph_samples/id", ..., r"roadgraph_samples/id: missing"),
    (("traffic_light_state/future/state", 13), 12, r"traffic_light_state/future/state\[13\]: expected a state of a light, 0 to 8, got 12"),
    (("traffic_light_state/future/x", 13), np.nan, r"traffic_light_state/future/x\[13\]: expected a finite number, got nan"),
    ("traffic_light_state/current/id", np.zeros(0, int), r"traffic_light_state/current/state: expected 0 numbers, got 3"),
]


def test_a_bad_value_of_an_example_is_named(tmp_path):
    messages = []
    for key, value, _ in EXAMPLE_FAULTS:
        found = records.features()
        if isinstance(key, tuple):
            found[key[0]] = found[key[0]].copy()
            found[key[0]][key[1]] = value
        elif value is ...:
            del found[key]
        else:
            found[key] = value
        messages.append(records.example(found))
    for number, (reject, (_, _, message)) in enumerate(zip(scenes(tmp_path, *messages), EXAMPLE_FAULTS, strict=True)):
        assert isinstance(reject, Reject) and reject.scene == "street", message
        with pytest.raises(SceneError, match=rf"^record {number} at byte \d+: {message}"):
            raise SceneError(reject.reason)
