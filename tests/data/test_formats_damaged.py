"""Damaged and hostile files: every reader refuses them by a SceneError that names the file, and asks for little memory."""

import gzip
import lzma
import struct

import numpy as np
import pytest
from support import fuzzing
from support.format_documents import (
    argoverse2_files,
    argoverse2_map,
    dumped,
    encoded,
    in_march_2023,
    in_spring_2023,
    metadrive_document,
    pufferdrive_map,
    scenarionet_document,
)
from support.scene_documents import FORMATS, document, scenefactory_document, thing

from scenefactory_jax.core.raw_scene import Reject, SceneError
from scenefactory_jax.data.formats import file_content, reader_selection, tfrecord
from scenefactory_jax.data.loading import scene_source

JSON_JUNK = tuple(value for value in fuzzing.JUNK if not isinstance(value, (bytes, set, np.ndarray)))
PEAK_BYTES = 30_000_000


@pytest.fixture(scope="module")
def readers():
    return reader_selection.make(FORMATS)


def gpudrive_document():
    light = {"state": ["stop", "go"], "x": [1.0, 1.0], "y": [2.0, 2.0], "z": [3.0, 3.0], "time_index": [0, 4]}
    return document(objects=[thing(0, id=7)], tl_states={"1": light})


@pytest.fixture
def files(tmp_path):
    """A good file of each format, and where it lies; the readers' own companions lie beside it."""
    table, area = argoverse2_files()
    (tmp_path / "log_map_archive_a-b.json").write_bytes(encoded(area))
    return {
        "scenarionet": (tmp_path / "a.pkl", dumped(scenarionet_document())),
        "argoverse2": (tmp_path / "scenario_a-b.parquet", table),
        "pufferdrive": (tmp_path / "a.bin", pufferdrive_map()),
        "gpudrive": (tmp_path / "a.json", encoded(gpudrive_document())),
    }


@pytest.mark.parametrize("name", ["scenarionet", "argoverse2", "pufferdrive", "gpudrive"])
def test_damaged_bytes(files, readers, name):
    path, content = files[name]
    path.write_bytes(content)
    assert fuzzing.attempt(readers[name], path) == "read"
    verdicts = fuzzing.attack(readers[name], path, content)
    assert verdicts["FormatMismatch"] + verdicts["SceneError"] > fuzzing.CUTS  # all that are cut short, at least
    assert set(verdicts) <= {"read", "FormatMismatch", "SceneError"}


@pytest.mark.parametrize("whole", [scenarionet_document(), in_spring_2023(scenarionet_document()), in_march_2023(scenarionet_document()),
                                   metadrive_document()], ids=["today", "April 2023", "March 2023", "MetaDrive's"])  # fmt: skip
def test_a_wrong_value_anywhere_in_a_scenario(tmp_path, readers, whole):
    path = tmp_path / "a.pkl"
    verdicts = set()
    for what, bad in fuzzing.mutated(whole, count=70):
        path.write_bytes(dumped(bad))
        try:
            verdicts.add(fuzzing.attempt(readers["scenarionet"], path))
        except Exception as error:
            raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error
    assert {"read", "SceneError"} <= verdicts


@pytest.mark.parametrize("name, whole", [("gpudrive", gpudrive_document()), ("argoverse2", argoverse2_map())])
def test_a_wrong_value_anywhere_in_json(files, readers, name, whole):
    path, content = files[name]
    path.write_bytes(content)
    target = path if name == "gpudrive" else path.with_name("log_map_archive_a-b.json")
    for what, bad in fuzzing.mutated(whole, count=60, junk=JSON_JUNK):
        target.write_bytes(encoded(bad))
        try:
            list(readers[name](path))
        except SceneError:
            continue
        except Exception as error:
            raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error


@pytest.mark.parametrize(
    "name, claim",
    [
        ("pufferdrive", lambda content: struct.pack("<ii", 2**31 - 1, 0) + content[8:]),
        ("pufferdrive", lambda content: content[:12] + struct.pack("<i", 2**31 - 1) + content[16:]),
        ("pufferdrive", lambda content: content[:16] + struct.pack("<f", 3e38) + content[20:-40] + struct.pack("<f", 3e38) + content[-36:]),
        ("scenarionet", lambda content: b"\x80\x04]r\xff\xff\xff\x7f."),  # a memo of two billion entries
        ("scenarionet", lambda content: b"\x80\x04\x96" + struct.pack("<Q", 2**40) + content),
        ("scenarionet", lambda content: dumped({"tracks": {}, "map_features": {n: shared for n in range(2000)}})),
        ("argoverse2", lambda content: content[:-8] + struct.pack("<I", 2**31 - 1) + content[-4:]),
    ],
)
def test_a_claim_of_much_is_not_believed(files, readers, name, claim):
    path, content = files[name]
    path.write_bytes(claim(content))
    assert fuzzing.peak_of(readers[name], path) < PEAK_BYTES


@pytest.mark.parametrize("compress", [lzma.compress, gzip.compress], ids=["xz", "gzip"])
@pytest.mark.parametrize("start", [b'{"objects": [', struct.pack("<iiii", 1, 0, 1, 10**7)], ids=["JSON", "PufferDrive"])
def test_what_unpacks_to_more_than_the_limit_is_refused_on_the_way(tmp_path, compress, start):
    path = tmp_path / "bomb"
    path.write_bytes(compress(start + b" " * 40_000_000))
    readers = reader_selection.make(
        {name: entry | ({"file_limit_mb": 1} if "file_limit_mb" in entry else {}) for name, entry in FORMATS.items()}
    )
    with pytest.raises(SceneError, match="expected a content of up to 1 MB, got more; see file_limit_mb"):
        list(reader_selection.read(path, readers))
    assert fuzzing.peak_of(lambda path: reader_selection.read(path, readers), path) < 16_000_000  # xz itself asks for 8 MB


def test_a_parquet_file_that_unpacks_to_more_than_the_limit_is_refused_unread(tmp_path):
    content = argoverse2_files(scenario="x" * 2_000_000)[0]  # one text, which every row repeats
    assert len(content) < 1_000_000
    path = tmp_path / "scenario.parquet"
    path.write_bytes(content)
    readers = reader_selection.make({"argoverse2": FORMATS["argoverse2"] | {"file_limit_mb": 1}})
    with pytest.raises(SceneError, match=r"\d MB unpacked; formats\.argoverse2\.file_limit_mb is 1"):
        list(reader_selection.read(path, readers))


@pytest.mark.parametrize("document", [scenefactory_document(), {"a": 1}], ids=["the second reader's", "none's"])
def test_a_file_is_unpacked_once_however_many_readers_try_it(tmp_path, monkeypatch, readers, document):
    path, read, counts = tmp_path / "a.xz", file_content._read, []
    path.write_bytes(lzma.compress(encoded(document)))
    monkeypatch.setattr(file_content, "_read", lambda path, count: counts.append(count) or read(path, count))
    [found] = scene_source.read_file(path, readers)
    assert isinstance(found, Reject) == ("road" not in document)
    assert sum(count > file_content.HEAD for count in counts) == 1


def test_a_record_of_any_length_is_not_read(tmp_path, readers):
    path, length = tmp_path / "a.tfrecord.gz", 100_000_000
    head = struct.pack("<Q", length)
    path.write_bytes(gzip.compress(head + struct.pack("<I", tfrecord.mask(head)) + bytes(length)))
    (reject,) = readers["womd"](path)
    assert reject.reason == "record 0 at byte 0: it declares 100000000 bytes of data; formats.womd.record_limit_mb is 64"


shared = {"type": "ROAD_EDGE_BOUNDARY", "polyline": np.zeros((2000, 3))}  # pickled once, and named two thousand times
