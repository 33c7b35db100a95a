"""Banks whose files were damaged, or whose writing was killed: a bank gives what was written, or one line that names the file."""

import itertools
import json
import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support import eventful
from support.choosing import slow_except
from support.scene_documents import FORMATS, WOMD, checker, document, packer, parsed, thing, written

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data import conversion
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer, shard_files
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source

PAGE = 4096
TIMES = itertools.count(1)  # of files: a file that is changed twice within a tick of the clock would seem unchanged


@pytest.fixture
def scenes(tmp_path):
    street = parsed(tmp_path, document(), reader_selection.make(FORMATS))
    return [replace(street, name=name, roads=street.roads[first:]) for name, first in (("first", 0), ("second", 1), ("third", 0))]


def made(folder, scenes, schema, compression=None):
    """A bank of two shards, of this or of the earlier schema."""
    parts = [scenes[:2], scenes[2:]]
    path = bank_reader.write(folder, scenes[:1], settings={}).path  # the folder of a bank, which is then written anew
    for file in path.iterdir():
        file.unlink()
    tables = [bank_reader.catalogue.table([bank_reader.catalogue.row(raw) for raw in part]) for part in parts]
    pairs = [(map(arrow_codec.encode, part), table) for part, table in zip(parts, tables, strict=True)]
    bank_writer.fill(path, pairs, settings={"seed": 3}, compression=compression)
    if schema == 3:
        age(path)
    return path


def age(path):
    """A bank as schema 3 wrote it: no checksum of the index, nor of single scenes."""
    index = json.loads((path / bank_reader.INDEX).read_text())
    for number, part in enumerate(index["metadata"]):
        table = pa.ipc.open_file((path / part["file"]).read_bytes()).read_all().drop_columns(list(shard_files.PLACE[2:]))
        with pa.ipc.new_file(str(path / part["file"]), table.schema) as writer:
            writer.write_table(table)
        index["metadata"][number] = vars(bank_index.describe(path, part["file"], part["scenes"]))
    del index["sha256"]
    (path / bank_reader.INDEX).write_text(json.dumps(index | {"schema": 3}))


def put(file, content):
    """Replace what a file holds, at a time of its own."""
    file.write_bytes(content)
    moment = next(TIMES)
    os.utime(file, ns=(moment, moment))


def outcome(path, expected, file):
    """ "same" if every scene comes as it was written, "refused" if one line names the damaged file; nothing else may happen."""
    try:
        opened = bank_reader.open(path)
        found = [arrow_codec.encode(raw) for raw in bank_reader.read_raws(opened, range(len(opened)))]
    except SceneError as error:
        assert file.name in str(error) and "\n" not in str(error) and len(str(error)) < 500, error
        return "refused"
    assert found == expected, "other scenes than were written"
    return "same"


def damages(content, other, *, seed, flips):
    """(name, content) of damaged files; `other` is a sound file of the same kind."""
    random = np.random.default_rng(seed)
    for place in np.linspace(0, len(content) - 1, 8).astype(int):
        yield f"cut at {place}", content[:place]
    yield "longer", content + bytes(8)
    yield "another file", other
    yield "another file, as long", (other + bytes(len(content)))[: len(content)]
    for start in range(0, len(content), max(PAGE, len(content) // 12 // PAGE * PAGE)):
        yield f"page of zeros at {start}", content[:start] + bytes(len(content[start : start + PAGE])) + content[start + PAGE :]
    with pa.BufferReader(content) as file:  # Arrow's own numbers: the head of each message, and the table of contents at the end
        file.seek(8)
        heads = []
        while file.tell() < len(content) - 8 and content[file.tell() + 4 : file.tell() + 8] != bytes(4):
            heads.append(file.tell())
            pa.ipc.read_message(file)
        heads.append(file.tell())
    for turn in range(flips):
        changed = bytearray(content)
        span = (0, len(content)) if turn % 3 == 0 else (head := heads[turn % len(heads)], min(head + 700, len(content)))
        for _ in range(1 + turn % 3):
            changed[int(random.integers(*span))] ^= 1 << int(random.integers(8))
        yield f"flips {turn}", bytes(changed)


@pytest.mark.parametrize(("schema", "compression"), [(5, None), (5, "zstd"), (3, None)])
def test_a_damaged_file_gives_the_same_scenes_or_is_refused_by_name(tmp_path, scenes, schema, compression):
    path = made(tmp_path / "bank", scenes, schema, compression)
    expected = list(map(arrow_codec.encode, scenes))
    assert outcome(path, expected, path) == "same"
    for name, other in (("scenes-00000.arrow", "scenes-00001.arrow"), ("metadata-00000.arrow", "metadata-00001.arrow")):
        content, counts = (path / name).read_bytes(), {"refused": 0, "same": 0}
        for what, damaged in damages(content, (path / other).read_bytes(), seed=schema, flips=80):
            put(path / name, damaged)
            try:
                counts[outcome(path, expected, path / name)] += 1
            except Exception as error:
                raise AssertionError(f"{name}, {what}: {type(error).__name__}: {error}") from error
        put(path / name, content)
        assert counts["refused"] > 50 and sum(counts.values()) > 90, counts  # the same: Arrow's table of contents is not needed
    assert outcome(path, expected, path) == "same"
    one, two = path / "scenes-00000.arrow", path / "scenes-00001.arrow"
    sizes = one.read_bytes(), two.read_bytes()
    put(one, sizes[1])
    put(two, sizes[0])
    assert outcome(path, expected, one) == "refused"
    with pytest.raises(SceneError, match=r"^/.*/scenes-00000\.arrow: "):
        scene_source.pack_scenes(scene_source.open_bank(bank_reader.open(path)), [0], check=checker(), pack=packer(), workers=1)


def test_a_damaged_index_is_refused(tmp_path, scenes):
    path = made(tmp_path / "bank", scenes, 4)
    file, expected = path / bank_reader.INDEX, list(map(arrow_codec.encode, scenes))
    content, random = file.read_bytes(), np.random.default_rng(0)
    for _ in range(120):
        changed = bytearray(content)
        changed[int(random.integers(len(content)))] ^= 1 << int(random.integers(8))
        put(file, bytes(changed))
        told = bank_reader.is_bank(path)
        assert outcome(path, expected, file) == "refused" and told, bytes(changed)
        with pytest.raises(SceneError, match=r"bank\.json: damaged"):
            bank_writer.check_target(path)  # it may be a bank of which something can be saved: nothing takes its place
    for place in (0, 1, len(content) // 2, len(content) - 3):
        put(file, content[:place])
        assert outcome(path, expected, file) == "refused"
    entries = json.loads(content)
    for damaged in (entries | {"sha256": None}, {name: value for name, value in entries.items() if name != "sha256"}):
        put(file, json.dumps(damaged).encode())
        assert outcome(path, expected, file) == "refused"
    for shards in (3, [3], [{"file": 3, "scenes": 2, "bytes": 1, "sha256": ""}], [{}]):
        put(file, json.dumps(entries | {"schema": 3, "sha256": None, "shards": shards}).encode())
        assert outcome(path, expected, file) == "refused"
    put(file, b"[" * 200_000)
    assert outcome(path, expected, file) == "refused"


def test_an_older_bank_is_read_chosen_from_and_gone_on_with(tmp_path, scenes):
    old = bank_reader.open(made(tmp_path / "old", scenes, 3))
    new = bank_reader.open(made(tmp_path / "new", scenes[:1], 4))
    both = bank_reader.save(bank_reader.join([bank_reader.view(old, [2, 0]), new]), tmp_path / "view", copy=False, settings={})
    copied = bank_reader.save(both, tmp_path / "copy", copy=True, settings={})
    for found in (both, copied):
        assert [arrow_codec.encode(raw) for raw in bank_reader.read_raws(found, range(3))] == [
            arrow_codec.encode(scenes[i]) for i in (2, 0, 0)
        ]
    assert (both.places[:, 2] == shard_files.UNKNOWN).tolist() == [True, True, False] and (copied.places[:, 2] > 0).all()
    folder, out = tmp_path / "in", tmp_path / "grown"
    folder.mkdir()
    written(folder, document(name="a"), "a.json")
    conversion.convert(folder, out, **options())
    age(out)
    written(folder, document(name="b"), "b.json")
    conversion.convert(folder, out, **options())
    grown = bank_reader.open(out)
    assert grown.names == ("a", "b") and [raw.name for raw in bank_reader.read_raws(grown, [0, 1])] == ["a", "b"]


# ---- killed


def options(**changes):
    tools = conversion.SceneTools({"plain": eventful.plainly}, check=checker(), pack=packer())
    return {"tools": tools, "settings": WOMD["pack"], "spread": map, "shard_scenes": 2, "compression": None} | changes


# before the first catalogue, the first index, and the second index take their places
@pytest.mark.parametrize("number", slow_except([1, 2, 5], 5))
def test_a_bank_whose_writing_was_killed_becomes_the_undisturbed_one(tmp_path, number):
    folder, out = tmp_path / "in", tmp_path / "bank"
    folder.mkdir()
    for name in ("a", "c", "d", "f", "g"):
        written(folder, document(name=name), f"{name}.json")
    written(folder, json.dumps(document())[:500], "b.json")
    written(folder, document(name="still", objects=[thing(0, speed=0)]), "e.json")
    rest = {name: value for name, value in options().items() if name != "spread"}
    process = multiprocessing.get_context("spawn").Process(target=eventful.convert_until_placed, args=(number, folder, out, rest))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    summary = conversion.convert(folder, out, **options())
    whole = conversion.convert(folder, tmp_path / "straight", **options())
    assert summary == whole and whole.scenes == 6 and len(whole.rejects) == 1
    files = {file.name: file.read_bytes() for file in (tmp_path / "straight").iterdir()}
    assert {file.name: file.read_bytes() for file in out.iterdir()} == files
    assert [Path(file).stem for file in bank_reader.open(out).index.files] == list("abcdefg")
