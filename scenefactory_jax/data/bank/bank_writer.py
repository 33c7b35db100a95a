"""Writes banks atomically: each file is written under a temporary name, renamed, then named in the index."""

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
from scenefactory_jax.core.atomic_file import name_file, write_atomically
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.bank import arrow_codec, bank_index, catalogue, shard_files
from scenefactory_jax.data.bank.bank_index import Index, Shard

Compression = Literal["zstd", "lz4"] | None
# files that a conversion leaves if it is killed before its first shard
UNFINISHED = re.compile(rf"\.?(part|scenes|metadata)-\d+(-\w+)?\.arrow(\.part)?|\.bank\.json\.part|{re.escape(folder_lock.LOCK)}")


@dataclass(frozen=True)
class SourceFileResult:
    """Scenes and rejects of one source file."""

    file: str  # relative to the source
    part: Path | None = None  # Arrow file of its scenes; None without any
    rows: tuple[dict[str, Any], ...] = ()  # of the catalogue
    rejects: tuple[dict[str, Any], ...] = ()
    companions: tuple[dict[str, Any], ...] = ()
    account: dict[str, Any] = field(default_factory=dict)


def append_files(folder: Path, pieces: Iterable[SourceFileResult], *, index: Index, shard_scenes: int, compression: Compression) -> Index:
    """Adds source files to a bank, shard by shard. If it is stopped, the folder holds the bank up to the last finished shard.

    Args:
        folder: the bank's.
        pieces: taken one at a time; their parts are removed.
        index: of the bank so far; without shards for a new bank.
        shard_scenes: a shard ends with the file that brings it to so many scenes or more.
        compression: of the shards; None can be mapped without copying.

    Raises:
        SceneError: there are no scenes, with the first reasons; no bank is written.
    """
    group: list[SourceFileResult] = []
    for piece in pieces:
        group.append(piece)
        if sum(len(piece.rows) for piece in group) >= shard_scenes:
            index, group = _append_shard(folder, index, group, compression), []
    index = _append_shard(folder, index, group, compression)
    if not index.shards:
        reasons = "; ".join(str(reject["reason"]) for reject in index.rejects[:3])
        raise SceneError(f"no scene to write{f': {len(index.rejects)} were rejected: {reasons}' if index.rejects else ''}")
    index = replace(_sort(index), complete=True)
    bank_index.write(folder, index)
    return index


def _append_shard(folder: Path, index: Index, group: Sequence[SourceFileResult], compression: Compression) -> Index:
    """Writes the scenes of source files as a shard with its catalogue, and the index that names both."""
    index = replace(
        index,
        files=(*index.files, *(piece.file for piece in group)),
        rejects=(*index.rejects, *(reject for piece in group for reject in piece.rejects)),
        companions=(*index.companions, *(companion for piece in group for companion in piece.companions)),
        account=functools.reduce(add_accounts, (piece.account for piece in group), index.account),
    )
    parts = [piece.part for piece in group if piece.part is not None]
    if rows := [row for piece in group for row in piece.rows]:
        batches = itertools.chain.from_iterable(map(_read_batches, parts))
        index = _write_shard(folder, index, batches, catalogue.table(rows), compression)
        bank_index.write(folder, index)
    for part in parts:
        part.unlink()
    return index


def _write_shard(folder: Path, index: Index, batches: Iterable[pa.RecordBatch], metadata: pa.Table, compression: Compression) -> Index:
    """The index with one more shard, whose scenes and catalogue are written."""
    number, rows = len(index.shards), metadata.num_rows
    name = f"scenes-{number:05d}.arrow"
    with write_atomically(folder / name) as fresh, _open_writer(fresh, arrow_codec.SCHEMA, compression) as writer:
        for batch in batches:
            writer.write_batch(batch)
    places = np.column_stack([np.full(rows, number), np.arange(rows), shard_files.spans(folder / name, rows)])
    written = _write_catalogue(folder, f"metadata-{number:05d}.arrow", metadata, places)
    return replace(index, shards=(*index.shards, bank_index.describe(folder, name, rows)), metadata=(*index.metadata, written))


def _sort(index: Index) -> Index:
    """Source files in the order in which an unbroken conversion reads them."""
    by_source = lambda entries: tuple(sorted(entries, key=lambda entry: Path(entry["source"]).parts))  # noqa: E731
    files = tuple(sorted(index.files, key=lambda file: Path(file).parts))
    return replace(index, files=files, rejects=by_source(index.rejects), companions=by_source(index.companions))


def add_accounts(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The sum of two accounts: numbers by name, or accounts by name."""
    both = {name: (one.get(name), other.get(name)) for name in {**one, **other}}
    total = lambda a, b: add_accounts(a or {}, b or {}) if isinstance(a or b, Mapping) else (a or 0) + (b or 0)  # noqa: E731
    return {name: total(a, b) for name, (a, b) in both.items()}


def write_part(folder: Path, number: int, batches: Iterable[pa.RecordBatch]) -> Path:
    """Writes the scenes of one source file to a file that `append_files` reads."""
    path = folder / f".part-{number:07d}-{uuid.uuid4().hex}.arrow"  # a process of a killed command may still write its own
    with name_file(path), _open_writer(path, arrow_codec.SCHEMA, None) as writer:
        for batch in batches:
            writer.write_batch(batch)
    return path


def remove_parts(folder: Path) -> None:
    """Removes unfinished files of a stopped conversion."""
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
    """Writes a bank into a new folder; each shard is scenes and their part of the catalogue."""
    index = Index(bank_index.plain(settings), complete=complete)
    for batches, metadata in shards:
        index = _write_shard(folder, index, batches, metadata, compression)
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
    """Writes a view into a new folder, which will be moved to `path`: the paths of the shards are relative to that."""
    used, shard = np.unique(places[:, 0], return_inverse=True)
    written = _write_catalogue(folder, "metadata-00000.arrow", metadata, np.column_stack([shard, places[:, 1:]]))
    chosen = tuple(replace(shards[number], file=os.path.relpath(shards[number].file, path)) for number in used)
    bank_index.write(folder, Index(bank_index.plain(settings), shards=chosen, metadata=(written,), complete=complete))


@contextlib.contextmanager
def replace_bank(path: Path) -> Iterator[Path]:
    """A new folder that replaces `path` at the end of the context; after an error it is removed.

    Raises:
        SceneError: the path exists and is no bank.
        folder_lock.Busy: another command writes there.
    """
    check_target(path)
    with folder_lock.lock_folder(path):
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            fresh = temporary / "new"
            fresh.mkdir()
            yield fresh
            path.rename(temporary / "old")
            fresh.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_target(path: Path) -> None:
    """Refuses a path that holds something else than a bank, or what a stopped conversion leaves."""
    stopped = path.is_dir() and all(UNFINISHED.fullmatch(file.name) for file in path.iterdir())
    if path.exists() and not stopped:
        bank_index.check_replaceable(path)


def _open_writer(path: Path, schema: pa.Schema, compression: Compression) -> pa.ipc.RecordBatchFileWriter:
    return pa.ipc.new_file(str(path), schema, options=pa.ipc.IpcWriteOptions(compression=compression))


def _read_batches(path: Path) -> Iterator[pa.RecordBatch]:
    reader = pa.ipc.open_file(pa.memory_map(str(path)))
    return (reader.get_batch(number) for number in range(reader.num_record_batches))


def _write_catalogue(folder: Path, name: str, table: pa.Table, places: Int[np.ndarray, "N 5"]) -> Shard:
    for column, values in zip(shard_files.PLACE, places.T, strict=True):
        table = table.append_column(column, pa.array(np.ascontiguousarray(values), pa.int64()))
    with write_atomically(folder / name) as fresh, _open_writer(fresh, table.schema, None) as writer:
        writer.write_table(table)
    return bank_index.describe(folder, name, table.num_rows)
