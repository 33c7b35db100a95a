"""Banks: scenes on disk as their source holds them; checks and packing into worlds happen when they are loaded.

A bank is a folder with `bank.json` (`bank_index`), shards of scenes (`arrow_codec`: Arrow IPC files, a record batch a scene) and their
catalogue (`catalogue`: a row a scene). It can be moved. A view is a bank whose shards are in other banks, by relative path.
Shards are mapped when they are first read, and keep no file open; a damaged scene is refused (`shard_files`).
"""

import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_writer, catalogue, shard_files
from scenefactory_jax.data.bank.bank_index import Index, Shard
from scenefactory_jax.data.bank.catalogue import Features

INDEX = bank_index.INDEX
is_bank = bank_index.is_bank
SHARD = 256  # scenes of a shard, where a bank is written at once
Readers = dict[int, shard_files.Reader]


@dataclass(frozen=True, eq=False)
class Bank:
    """An open bank, or a selection of scenes of banks: `open`, `view`, `join`. Scenes are read from disk on demand."""

    path: Path  # the opened folder; of a view that was never saved: of its first bank
    index: Index
    shards: tuple[Shard, ...]  # by absolute path
    places: Int[np.ndarray, "N 5"]  # of each scene: shard, place in it and checksum (`shard_files.PLACE`)
    metadata: pa.Table  # the catalogue: a row a scene
    readers: Readers = field(default_factory=dict, repr=False)  # of the shards mapped so far; views share them

    def __getstate__(self) -> dict[str, Any]:
        """Readers cannot be sent to another process."""
        return vars(self) | {"readers": {}}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.metadata["name"].to_pylist())

    @property
    def settings(self) -> dict[str, Any]:
        return self.index.settings

    @property
    def rejects(self) -> tuple[dict[str, Any], ...]:
        return self.index.rejects

    @property
    def unfinished(self) -> str:
        """A remark to the bank's name if its conversion was stopped; else empty."""
        return "" if self.index.complete else ", whose conversion was stopped: the same `convert` goes on with it"

    def __len__(self) -> int:
        return len(self.places)


def open(path: Path | str) -> Bank:
    """Opens a bank: reads and checks its catalogue, but not its scenes.

    Raises:
        SceneError: no bank, a bank of another schema, or a file that is missing or damaged, by name.
    """
    path = Path(path).resolve()
    index = bank_index.read(path)
    shards = tuple(replace(shard, file=os.path.normpath(path / shard.file)) for shard in index.shards)
    for shard in shards:
        bank_index.check_complete(Path(shard.file), shard)
    if not shards or not index.metadata:
        raise SceneError(f"{path / INDEX}: damaged: it names no shards; {bank_index.REMEDY}")
    table = _concatenated([shard_files.table(path / part.file, part) for part in index.metadata], str(path))
    places = shard_files.places(table)
    limits = np.array([shard.scenes for shard in shards])
    if (places[:, :2] < 0).any() or (places[:, 0] >= len(shards)).any() or (places[:, 1] >= limits[places[:, 0]]).any():
        raise SceneError(f"{path}: its catalogue names scenes that its shards do not have; {bank_index.REMEDY}")
    return Bank(path, index, shards, places, table.select([name for name in table.column_names if name not in shard_files.PLACE]))


def verify(path: Path | str) -> None:
    """Reads every byte of a bank, and of the banks that a view refers to, and compares it with the checksums.

    Raises:
        SceneError: as `open`, or the files that have changed, by name.
    """
    path = Path(path).resolve()
    index = bank_index.read(path)
    shards = (*index.shards, *index.metadata)
    whole = lambda shard: (path / shard.file).is_file() and bank_index.describe(path, shard.file, shard.scenes) == shard  # noqa: E731
    if damaged := [shard.file for shard in shards if not whole(shard)]:
        raise SceneError(f"{path}: damaged: {', '.join(damaged)}: not what was written; {bank_index.REMEDY}")
    open(path)


def read_raw(bank: Bank, index: int) -> RawScene:
    """One scene as its source holds it. Its arrays are read-only views of the file."""
    return next(read_raws(bank, [index]))


def read_raws(bank: Bank, indices: Sequence[int] | np.ndarray) -> Iterator[RawScene]:
    """Scenes one after another.

    Raises:
        SceneError: no such scene, or a shard that is missing or damaged.
    """
    for number, *place in bank.places[_rows(bank, indices)].tolist():
        yield _reader(bank.shards, number, bank.readers).scene(place)  # a shard is mapped when its first scene is read


def view(bank: Bank, indices: Sequence[int] | np.ndarray) -> Bank:
    """A bank of these scenes in this order, without copying; an index may be repeated.

    Raises:
        SceneError: no such scene, or no indices.
    """
    rows = _rows(bank, indices)
    if not len(rows):
        raise SceneError(f"{bank.path}: a view of no scene; valid indices: 0 to {len(bank) - 1}")
    return replace(bank, index=_chosen(bank.index.settings, [bank]), places=bank.places[rows], metadata=bank.metadata.take(rows))


def join(banks: Sequence[Bank]) -> Bank:
    """The scenes of several banks, one bank after another, without copying.

    Raises:
        SceneError: catalogues with different types of a column.
    """
    shards = {shard.file: shard for bank in banks for shard in bank.shards}
    number = {file: place for place, file in enumerate(shards)}
    places = []
    for bank in banks:
        own = np.array([number[shard.file] for shard in bank.shards])
        places.append(np.column_stack([own[bank.places[:, 0]], bank.places[:, 1:]]))
    table = _concatenated([bank.metadata for bank in banks], ", ".join(str(bank.path) for bank in banks))
    settings = {"joined": [dict(bank.index.settings) for bank in banks]}
    return Bank(banks[0].path, _chosen(settings, banks), tuple(shards.values()), np.concatenate(places), table)


def save(bank: Bank, path: Path | str, *, copy: bool, settings: Mapping[str, Any]) -> Bank:
    """Writes a bank or a view and opens it. An existing bank is replaced when the new one is complete.

    Args:
        path: of the new folder.
        copy: also write the scenes; else refer to the banks that hold them.
        settings: stored in the bank.

    Raises:
        SceneError: the path exists and is no bank, or is one that the view would refer to.
    """
    path = Path(path).resolve()
    if not copy and any(Path(shard.file).parent == path for shard in bank.shards):
        raise SceneError(f"{path}: a view cannot take the place of the bank that it refers to; give another path, or copy=true")
    with bank_writer.replace_bank(path) as folder:
        if copy:
            parts = [slice(start, start + SHARD) for start in range(0, len(bank), SHARD)]
            shards = ((_batches(bank.shards, bank.places[part], bank.readers), bank.metadata[part]) for part in parts)
            bank_writer.fill(folder, shards, settings=settings, compression=None, complete=bank.index.complete)
        else:
            bank_writer.write_view(folder, path, bank.shards, bank.places, bank.metadata, settings=settings, complete=bank.index.complete)
    return open(path)


def write(
    path: Path | str,
    scenes: Iterable[RawScene],
    *,
    settings: Mapping[str, Any],
    features: Features | None = None,
    compression: bank_writer.Compression = None,
) -> Bank:
    """Writes scenes as a bank and opens it. An existing bank is replaced when the new one is complete.

    Args:
        path: of the new folder.
        scenes: taken one shard at a time.
        settings: stored in the bank.
        features: computes further columns of the catalogue.
        compression: of the shards; None can be mapped without copying.

    Raises:
        SceneError: the path exists and is no bank, there are no scenes, or one that cannot be encoded.
    """
    path, scenes = Path(path).resolve(), iter(scenes)
    with bank_writer.replace_bank(path) as folder:
        parts = iter(lambda: list(itertools.islice(scenes, SHARD)), [])
        shards = (
            (map(arrow_codec.encode, part), catalogue.table([catalogue.extend_table(raw, features) for raw in part])) for part in parts
        )
        bank_writer.fill(folder, shards, settings=settings, compression=compression)
    return open(path)


def _batches(shards: Sequence[Shard], places: Int[np.ndarray, "N 5"], readers: Readers) -> Iterator[pa.RecordBatch]:
    """Scenes as they are encoded in their shards, those of earlier schemas encoded again."""
    found = (_reader(shards, number, readers).batch(place) for number, *place in places.tolist())
    return (batch if batch.schema.equals(arrow_codec.SCHEMA) else arrow_codec.encode(arrow_codec.decode(batch)) for batch in found)


def _reader(shards: Sequence[Shard], number: int, readers: Readers) -> shard_files.Reader:
    if number not in readers:
        readers[number] = shard_files.Reader(shards[number])
    return readers[number]


def _concatenated(tables: Sequence[pa.Table], where: str) -> pa.Table:
    """Concatenated catalogues; a column that one lacks is null there."""
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise SceneError(f"{where}: catalogues that do not go together: {error}") from error


def _rows(bank: Bank, indices: Sequence[int] | np.ndarray) -> Int[np.ndarray, " N"]:
    """Indices as rows; negative ones count from the end."""
    rows, count = np.asarray(indices, np.int64).reshape(-1), len(bank)
    if (wrong := rows[(rows < -count) | (rows >= count)]).size:
        raise SceneError(f"{bank.path}: no scene {wrong[0]}; valid: 0 to {count - 1}")
    return rows % max(count, 1)


def _chosen(settings: Mapping[str, Any], banks: Sequence[Bank]) -> Index:
    """The index of a selection: complete if all banks are, without the account of a conversion."""
    return Index(settings=dict(settings), complete=all(bank.index.complete for bank in banks))
