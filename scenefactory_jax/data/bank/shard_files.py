"""Reads the files of a bank: maps them and compares their content with checksums.

A scene is a message of Arrow's IPC format: a span of bytes of its shard. The catalogue holds each span and its CRC-32, so that
the time to check grows with the scene and not with its shard: about 4 GB/s, 1 to 2 % of the time to pack it.
Banks of schema 3 have no such column: the SHA-256 of a shard is compared once in a process, at about 1.7 GB/s.
"""

import functools
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.data.bank import arrow_codec, bank_index
from scenefactory_jax.data.bank.bank_index import Shard

PLACE = ("_shard", "_row", "_first", "_bytes", "_crc32")  # columns of the catalogue on disk: place and checksum of each scene
OF_SCHEMA_3 = PLACE[:2]
UNKNOWN = -1  # in the other columns of schema 3
MAGIC = 8  # bytes before the first message of an Arrow file


class Reader:
    """A mapped shard. No descriptor stays open; the map lives as long as anything that was read from it.

    Raises:
        SceneError: the file is missing or has another size.
    """

    def __init__(self, shard: Shard):
        bank_index.check_complete(Path(shard.file), shard)
        self._shard, self._content = shard, _mapped(Path(shard.file))

    def batch(self, place: Sequence[int]) -> pa.RecordBatch:
        """One scene as a batch of one row, of one of `arrow_codec.READABLE`, whose buffers are views of the file.

        Args:
            place: row in the shard, first byte, bytes and CRC-32.

        Raises:
            SceneError: the file is damaged, by name.
        """
        row, first, size, checksum = place
        try:
            if first == UNKNOWN:
                batch = self._whole.get_batch(row)
            else:
                span = self._content[max(first, 0) : first + size]
                if zlib.crc32(span) != checksum:
                    raise self._damaged(row, "its checksum is another")
                batch = pa.ipc.read_record_batch(span, self._schema)
            batch.validate(full=True)  # keeps memory safe if the checksum belongs to damaged bytes
        except (pa.ArrowException, OSError, EOFError) as error:
            raise self._damaged(row, str(error)) from error
        if batch.num_rows != 1:
            raise self._damaged(row, f"{batch.num_rows} rows in place of one")
        return batch

    def scene(self, place: Sequence[int]) -> RawScene:
        """One scene; see `batch`."""
        batch = self.batch(place)
        try:
            return arrow_codec.decode(batch)
        except (TypeError, ValueError, IndexError) as error:  # values of no scene
            raise self._damaged(place[0], str(error)) from error

    @functools.cached_property
    def _whole(self) -> pa.ipc.RecordBatchFileReader:
        """The file by its own table of contents, after its checksum was compared."""
        _require_same(self._shard)
        reader = pa.ipc.open_file(pa.BufferReader(self._content))
        if reader.schema not in arrow_codec.READABLE:
            raise self._other_columns()
        return reader

    @functools.cached_property
    def _schema(self) -> pa.Schema:
        """The file's columns: those of this version, or of earlier ones."""
        schema = pa.ipc.read_schema(self._content[MAGIC:])
        if schema not in arrow_codec.READABLE:
            raise self._other_columns()
        return schema

    def _other_columns(self) -> SceneError:
        return SceneError(f"{self._shard.file}: damaged: other columns than a scene has; {bank_index.REMEDY}")

    def _damaged(self, row: int, why: str) -> SceneError:
        return SceneError(f"{self._shard.file}: damaged: scene {row} of {self._shard.scenes}: {why}; {bank_index.REMEDY}")


def table(path: Path, shard: Shard) -> pa.Table:
    """A file of the catalogue.

    Raises:
        SceneError: it is missing or damaged, by name.
    """
    _require_same(Shard(str(path), shard.scenes, shard.bytes, shard.sha256))
    try:
        found = pa.ipc.open_file(pa.BufferReader(_mapped(path))).read_all()
        found.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise SceneError(f"{path}: damaged: {error}; {bank_index.REMEDY}") from error
    if found.num_rows != shard.scenes or not {"name", "source", *OF_SCHEMA_3} <= set(found.column_names):
        wanted = f"there must be {shard.scenes}, with name, source, {', '.join(OF_SCHEMA_3)}"
        raise SceneError(f"{path}: damaged: {found.num_rows} rows of {', '.join(found.column_names)}; {wanted}")
    return found


def places(table: pa.Table) -> Int[np.ndarray, "N 5"]:
    """The columns PLACE of a catalogue; those that it lacks are UNKNOWN."""
    missing = np.full(len(table), UNKNOWN)
    columns = [table[name].fill_null(UNKNOWN).to_numpy() if name in table.column_names else missing for name in PLACE]
    return np.stack(columns, axis=1).astype(np.int64)


def spans(path: Path, scenes: int) -> Int[np.ndarray, "N 3"]:
    """First byte, number of bytes and CRC-32 of each scene of a finished shard."""
    content, found = _mapped(path), []
    with pa.BufferReader(content) as file:
        file.seek(MAGIC)
        pa.ipc.read_message(file)  # the schema
        for _ in range(scenes):
            first = file.tell()
            pa.ipc.read_message(file)
            size = file.tell() - first
            found.append((first, size, zlib.crc32(content[first : first + size])))
    return np.array(found, np.int64).reshape(-1, 3)


def _mapped(path: Path) -> pa.Buffer:
    try:
        with pa.memory_map(str(path)) as file:
            return file.read_buffer()
    except (pa.ArrowException, OSError) as error:
        raise SceneError(f"{path}: cannot be read: {error}; {bank_index.REMEDY}") from error


def _require_same(shard: Shard) -> None:
    """Compares a file with its checksum, once in a process, and again after a change."""
    path = Path(shard.file)
    bank_index.check_complete(path, shard)
    state = path.stat()
    if _digest(path, state.st_ino, state.st_mtime_ns) != shard.sha256:
        raise SceneError(f"{path}: damaged: its checksum is another; {bank_index.REMEDY}")


@functools.cache
def _digest(path: Path, inode: int, changed_ns: int) -> str:
    """The SHA-256 of a file in this state."""
    return bank_index.digest(path)
