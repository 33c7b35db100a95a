"""Files in any known format, or scenes of a generator -> a bank. Files and scenes that cannot be used are listed with their reasons.

Scenes go into the bank uncut. They are also packed on trial: the counts of what packing keeps and drops are stored, and a scene that it
refuses stays in the bank with the reason in its row, because other numbers may accept it. Scenes that the checks refuse are left out.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel.task_map import FailedTask, TaskMap
from scenefactory_jax.core.raw_scene import RawScene, Reject, SceneError, Unpackable
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer, catalogue
from scenefactory_jax.data.bank.bank_index import Index
from scenefactory_jax.data.bank.bank_writer import Compression, SourceFileResult
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading.scene_source import Check, Pack, Read, explain, open_generator, read_file
from scenefactory_jax.data.packing.pack import PackReport, prepare
from scenefactory_jax.data.packing.summary import Summary, count_results, list_entries, summarise


@dataclass(frozen=True)
class SceneTools:
    """Functions for the scenes of a file; all of them can be sent to another process."""

    formats: Mapping[str, reader_selection.Reader]  # tried in order
    check: Check
    pack: Pack
    refine: Callable[[RawScene], RawScene] | None = None  # before anything else; raises `SceneError` for a scene to leave out
    features: catalogue.Features | None = None  # further columns of the catalogue


class Generated(NamedTuple):
    """The first scenes of a generator."""

    generate: Callable[[int, int], RawScene]  # (seed, index) -> scene
    seed: int
    count: int


class Entry(NamedTuple):
    """What a conversion reads at once: a file, or one scene of a generator."""

    name: str  # in the bank
    source: str  # in messages
    read: Read


def convert(
    source: Path | str | Generated,
    out: Path | str,
    *,
    tools: SceneTools,
    settings: Mapping[str, Any],
    spread: TaskMap,
    shard_scenes: int,
    compression: Compression,
    on_file: Callable[[int, int], None] | None = None,
) -> Summary:
    """Reads every file or generated scene into the bank `out`. A stopped conversion continues; a complete one adds new ones.

    Files that could not be read are read again.

    Args:
        source: a file, a folder with its subfolders, or a generator.
        out: the bank's folder.
        settings: the config behind `tools`, stored in the bank; a bank with other settings is refused.
        spread: task map over the entries; order and result do not depend on it.
        shard_scenes, compression: of the bank's files, see `bank_writer.append_files`.
        on_file: called with (entries done, entries in all) after each of them.

    Raises:
        SceneError: no files, `out` is not a bank or has other settings, or no usable scene, with the first reasons.
        ConfigError: a number that a part refuses.
        folder_lock.Busy: another command writes to `out`.
    """
    description, entries = _list_entries(source, tools.formats)
    out = Path(out).resolve()
    bank_writer.check_target(out)
    work = functools.partial(convert_entry, out=out, tools=tools)

    def results(waiting: Sequence[Entry]) -> Iterator[SourceFileResult]:
        done = len(entries) - len(waiting)
        for number, (entry, result) in enumerate(zip(waiting, spread(work, list(enumerate(waiting))), strict=True), start=done + 1):
            if isinstance(result, FailedTask):
                result = SourceFileResult(entry.name, **list_entries([Reject(None, result.reason, None, entry.source)]))
            yield result
            if on_file is not None:
                on_file(number, len(entries))

    with folder_lock.lock_folder(out):
        index = _begin(entries, out, bank_index.plain({"source": description, **settings}))
        known = set(index.files)
        waiting = [entry for entry in entries if entry.name not in known]
        try:
            index = bank_writer.append_files(out, results(waiting), index=index, shard_scenes=shard_scenes, compression=compression)
        finally:
            bank_writer.remove_parts(out)
    files = 0 if isinstance(source, Generated) else len(index.files)
    return summarise(index.account, files=files, rejects=index.rejects, companions=index.companions)


def _list_entries(source: Path | str | Generated, formats: Mapping[str, reader_selection.Reader]) -> tuple[Any, list[Entry]]:
    """What the bank's settings say of a source, and what there is to read."""
    if isinstance(source, Generated):
        scenes = open_generator(source.generate, seed=source.seed)
        numbers = range(source.count)
        return scenes.description, [Entry(f"{source.seed}-{index}", scenes.name(index), scenes.reader(index)) for index in numbers]
    root = Path(source).absolute()
    name = lambda file: file.relative_to(root).as_posix() if file != root else file.name  # noqa: E731
    files = reader_selection.find(root)
    return str(root), [Entry(name(file), str(file), functools.partial(read_file, file, formats)) for file in files]


def _begin(entries: Sequence[Entry], out: Path, settings: dict[str, Any]) -> Index:
    """The index of the bank in `out`, if it has these settings, without the files that gave no scene; else that of a new bank."""
    if not bank_index.is_bank(out):
        return Index(settings)
    index = bank_index.read(out)
    if differences := bank_index.differences(settings, index.settings):
        raise SceneError(f"{out}: a bank made with other settings ({'; '.join(differences)}); give another out, or remove it")
    bank_writer.remove_parts(out)
    failed = {reject["source"] for reject in index.rejects if reject["scene"] is None}
    failed -= set(bank_reader.open(out).metadata["source"].to_pylist())
    again = {entry.name: entry.source for entry in entries if entry.source in failed}
    files = tuple(file for file in index.files if file not in again)
    rejects = tuple(reject for reject in index.rejects if reject["source"] not in set(again.values()))
    return replace(index, files=files, rejects=rejects, complete=False)


def convert_entry(item: tuple[int, Entry], *, out: Path, tools: SceneTools) -> SourceFileResult:
    """Writes the scenes of an entry to a part of the bank's folder. Any error is a reject, but for `ConfigError`."""
    number, entry = item
    rows: list[dict[str, Any]] = []
    trials: list[PackReport | str] = []
    rejects: list[Reject] = []

    def batches() -> Iterator[Any]:
        for raw in _read(entry):
            if isinstance(raw, Reject):
                rejects.append(raw)
                continue
            try:
                raw = raw if tools.refine is None else tools.refine(raw)
                try:
                    trial = prepare(raw, check=tools.check, pack=tools.pack).report
                except Unpackable as refusal:
                    trial = str(refusal.kind)
                row, batch = catalogue.extend_table(raw, tools.features), arrow_codec.encode(raw)
            except ConfigError:
                raise
            except Exception as error:
                rejects.append(explain(error, entry.source, raw.name))
                continue
            trials.append(trial)
            rows.append(row | {"packing": trial if isinstance(trial, str) else catalogue.PACKED})
            yield batch

    try:
        part = bank_writer.write_part(out, number, batches())
    except OSError as error:  # as a reject, a full disk would cost one file after another
        raise ConfigError(f"out: {out}: {error.strerror}; the same command goes on once there is room") from error
    return SourceFileResult(entry.name, part=part, rows=tuple(rows), **list_entries(rejects), account=count_results(trials))


def _read(entry: Entry) -> Iterator[RawScene | Reject]:
    try:
        yield from entry.read()
    except ConfigError:
        raise
    except Exception as error:  # of a generator; of a file it is a reject already
        yield explain(error, entry.source)


def complete(raw: RawScene, *, check: Check, rebuild: Callable[[RawScene], RawScene], gate: Callable[[RawScene], RawScene]) -> RawScene:
    """The scene with lane links where its source has none, without what the quality rules leave out: the `refine` of a bank."""
    check(raw)  # refuses what the geometry of the next two cannot use
    return gate(rebuild(raw))
