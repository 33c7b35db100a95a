"""Writing banks so that nobody ever meets half of one: files are finished under another name, and count once the index names them."""

import contextlib
import functools
import itertools
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.bank import arrow_codec, bank_index, catalogue, shard_files
from scenefactory_jax.data.bank.bank_index import Index, Shard

Compression = Literal["zstd", "lz4"] | None
# what a conversion leaves that was killed before its first shard
OWN = re.compile(rf"\.?(part|scenes|metadata)-\d+(-\w+)?\.arrow(\.part)?|\.bank\.json\.part|{re.escape(folder_lock.LOCK)}")


@dataclass(frozen=True)
class SourceFileResult:
    """What one source file came to."""

    file: str  # relative to the source
    part: Path | None = None  # Arrow file of its scenes; None without any
    rows: tuple[dict[str, Any], ...] = ()  # of the catalogue
    rejects: tuple[dict[str, Any], ...] = ()
    companions: tuple[dict[str, Any], ...] = ()
    account: dict[str, Any] = field(default_factory=dict)


def append_files(folder: Path, pieces: Iterable[SourceFileResult], *, index: Index, shard_scenes: int, compression: Compression) -> Index:
    """Add source files to a bank, shard by shard. Killed at any time, the folder holds the bank up to the last finished shard.

    Args:
        folder: the bank's.
        pieces: taken one at a time; their parts are removed.
        index: of the bank as it is; one without shards for a new bank.
        shard_scenes: a shard is finished with the file that brings it to so many scenes or more.
        compression: of the shards; None can be mapped without copying.

    Raises:
        SceneError: not one scene came, with the first reasons for it; no bank is written then.
    """
    pieces = iter(pieces)
    for first in pieces:
        index = _grow_by_shard(folder, itertools.chain([first], pieces), index, shard_scenes, compression)
    if not index.shards:
        reasons = "; ".join(str(reject["reason"]) for reject in index.rejects[:3])
        raise SceneError(f"no scene to write{f': {len(index.rejects)} were rejected: {reasons}' if index.rejects else ''}")
    index = replace(_in_order(index), complete=True)
    bank_index.write(folder, index)
    return index


def _in_order(index: Index) -> Index:
    """Source files in the order in which a conversion that is not stopped reads them."""
    by_source = lambda entries: tuple(sorted(entries, key=lambda entry: Path(entry["source"]).parts))  # noqa: E731
    files = tuple(sorted(index.files, key=lambda file: Path(file).parts))
    return replace(index, files=files, rejects=by_source(index.rejects), companions=by_source(index.companions))


def _grow_by_shard(folder: Path, pieces: Iterator[SourceFileResult], index: Index, shard_scenes: int, compression: Compression) -> Index:
    """One more shard, with its part of the catalogue, and the index that names both."""
    taken: list[SourceFileResult] = []

    def batches() -> Iterator[pa.RecordBatch]:
        rows = 0
        for piece in pieces:
            taken.append(piece)
            if piece.part is not None:
                yield from _batches(piece.part)
                piece.part.unlink()
            if (rows := rows + len(piece.rows)) >= shard_scenes:
                return

    name = f"scenes-{len(index.shards):05d}.arrow"
    _write_scenes(folder / name, batches(), compression)
    index = _counted(index, taken)
    rows = [row for piece in taken for row in piece.rows]
    if not rows:
        (folder / name).unlink()
        return index
    index = _with_shard(folder, index, name, catalogue.table(rows))
    bank_index.write(folder, index)
    return index


def _with_shard(folder: Path, index: Index, name: str, metadata: pa.Table) -> Index:
    """The index with a shard that is finished; its part of the catalogue is written."""
    number, rows = len(index.shards), metadata.num_rows
    places = np.column_stack([np.full(rows, number), np.arange(rows), shard_files.spans(folder / name, rows)])
    written = _write_catalogue(folder, f"metadata-{number:05d}.arrow", metadata, places)
    shard = bank_index.describe(folder, name, rows)
    return replace(index, shards=(*index.shards, shard), metadata=(*index.metadata, written))


def _counted(index: Index, pieces: Sequence[SourceFileResult]) -> Index:
    return replace(
        index,
        files=(*index.files, *(piece.file for piece in pieces)),
        rejects=(*index.rejects, *(reject for piece in pieces for reject in piece.rejects)),
        companions=(*index.companions, *(companion for piece in pieces for companion in piece.companions)),
        account=functools.reduce(add_shards, (piece.account for piece in pieces), index.account),
    )


def add_shards(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The sum of two accounts: numbers by name, or accounts by name."""
    both = {name: (one.get(name), other.get(name)) for name in {**one, **other}}
    total = lambda a, b: add_shards(a or {}, b or {}) if isinstance(a or b, Mapping) else (a or 0) + (b or 0)  # noqa: E731
    return {name: total(a, b) for name, (a, b) in both.items()}


def write_part(folder: Path, number: int, batches: Iterable[pa.RecordBatch]) -> Path:
    """Scenes of one source file, for `grow` to collect."""
    path = folder / f".part-{number:07d}-{uuid.uuid4().hex}.arrow"  # a process whose command was killed may still write its own
    with _writer(path, arrow_codec.SCHEMA, None) as writer:
        for batch in batches:
            writer.write_batch(batch)
    return path


def remove_parts(folder: Path) -> None:
    """What was being written when a conversion was stopped."""
    for path in [*folder.glob(".*.arrow"), *folder.glob(".*.part")]:
        path.unlink()


def fill(
    folder: Path,
    shards: Iterable[tuple[Iterable[pa.RecordBatch], pa.Table]],
    *,
    settings: Mapping[str, Any],
    compression: Compression,
    complete: bool = True,
) -> None:
    """A whole bank in a new folder, of shards: scenes, and their part of the catalogue."""
    index = Index(bank_index.plain(settings), complete=complete)
    for number, (batches, metadata) in enumerate(shards):
        name = f"scenes-{number:05d}.arrow"
        _write_scenes(folder / name, batches, compression)
        index = _with_shard(folder, index, name, metadata)
    if not index.shards:
        raise SceneError("no scene to write")
    bank_index.write(folder, index)


def write_view(
    folder: Path,
    path: Path,
    shards: Sequence[Shard],
    places: Int[np.ndarray, "N 5"],
    metadata: pa.Table,
    *,
    settings: Mapping[str, Any],
    complete: bool,
) -> None:
    """A view, in a new folder: the shards' paths relative to `path`, where the folder is to lie."""
    used, own = np.unique(places[:, 0], return_inverse=True)
    placed = np.column_stack([own, places[:, 1:]])
    written = _write_catalogue(folder, "metadata-00000.arrow", metadata, placed)
    chosen = tuple(replace(shards[number], file=os.path.relpath(shards[number].file, path)) for number in used)
    bank_index.write(folder, Index(bank_index.plain(settings), shards=chosen, metadata=(written,), complete=complete))


@contextlib.contextmanager
def replace_bank(path: Path) -> Iterator[Path]:
    """A new folder beside `path` that takes its place at the end; what an error leaves of it vanishes.

    No other command writes to `path` meanwhile.

    Raises:
        SceneError: the path exists and is no bank.
        folders.Busy: another command writes there.
    """
    check_free_space(path)
    with folder_lock.lock_folder(path):
        workshop = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            made = workshop / "new"
            made.mkdir()
            yield made
            path.rename(workshop / "old")
            made.rename(path)
        finally:
            shutil.rmtree(workshop, ignore_errors=True)


def check_free_space(path: Path) -> None:
    """Refuse a path where something else than a bank is."""
    ours = path.is_dir() and all(OWN.fullmatch(file.name) for file in path.iterdir())
    if path.exists() and not ours:
        bank_index.check_replaceable(path)


def _writer(path: Path, schema: pa.Schema, compression: Compression) -> pa.ipc.RecordBatchFileWriter:
    return pa.ipc.new_file(str(path), schema, options=pa.ipc.IpcWriteOptions(compression=compression))


def _write_scenes(path: Path, batches: Iterable[pa.RecordBatch], compression: Compression) -> None:
    with write_atomically(path) as fresh, _writer(fresh, arrow_codec.SCHEMA, compression) as writer:
        for batch in batches:
            writer.write_batch(batch)


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    reader = pa.ipc.open_file(pa.memory_map(str(path)))
    return (reader.get_batch(number) for number in range(reader.num_record_batches))


def _write_catalogue(folder: Path, name: str, table: pa.Table, places: Int[np.ndarray, "N 5"]) -> Shard:
    for column, values in zip(shard_files.PLACE, places.T, strict=True):
        table = table.append_column(column, pa.array(np.ascontiguousarray(values), pa.int64()))
    with write_atomically(folder / name) as fresh, _writer(fresh, table.schema, None) as writer:
        writer.write_table(table)
    return bank_index.describe(folder, name, table.num_rows)
