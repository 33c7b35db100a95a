"""Files in any known format -> a bank. Files and scenes that cannot be used are listed with their reasons.

Scenes go into the bank uncut. They are also packed on trial: the counts of what packing keeps and drops are stored, and a scene that it
refuses stays in the bank with the reason in its row, because other numbers may accept it. Scenes that the checks refuse are left out.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel.task_map import FailedTask, TaskMap
from scenefactory_jax.core.raw_scene import RawScene, Reject, SceneError, Unpackable
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer, catalogue
from scenefactory_jax.data.bank.bank_index import Index
from scenefactory_jax.data.bank.bank_writer import Compression, SourceFileResult
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading.scene_source import Check, Pack, explain, read_file
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


def convert(
    path: Path | str,
    out: Path | str,
    *,
    tools: SceneTools,
    settings: Mapping[str, Any],
    spread: TaskMap,
    shard_scenes: int,
    compression: Compression,
    on_file: Callable[[int, int], None] | None = None,
) -> Summary:
    """Reads every file below `path` into the bank `out`. A stopped conversion continues; a complete one adds new files.

    Files that could not be read are read again.

    Args:
        path, out: a file or a folder with its subfolders; the bank's folder.
        settings: the config behind `tools`, stored in the bank; a bank with other settings is refused.
        spread: task map over the files; order and result do not depend on it.
        shard_scenes, compression: of the bank's files, see `bank_writer.append_files`.
        on_file: called with (files done, files in all) after each file.

    Raises:
        SceneError: no files, `out` is not a bank or has other settings, or no usable scene, with the first reasons.
        ConfigError: a number that a part refuses.
        folder_lock.Busy: another command writes to `out`.
    """
    root, out = Path(path).absolute(), Path(out).resolve()
    files = reader_selection.find(root)
    bank_writer.check_target(out)
    work = functools.partial(convert_file, root=root, out=out, tools=tools)

    def results(waiting: Sequence[Path]) -> Iterator[SourceFileResult]:
        done = len(files) - len(waiting)
        for number, (file, result) in enumerate(zip(waiting, spread(work, list(enumerate(waiting))), strict=True), start=done + 1):
            if isinstance(result, FailedTask):
                result = SourceFileResult(_name(file, root), **list_entries([Reject(None, result.reason, None, str(file))]))
            yield result
            if on_file is not None:
                on_file(number, len(files))

    with folder_lock.lock_folder(out):
        index = _begin(root, out, bank_index.plain({"source": str(root), **settings}))
        known = set(index.files)
        waiting = [file for file in files if _name(file, root) not in known]
        try:
            index = bank_writer.append_files(out, results(waiting), index=index, shard_scenes=shard_scenes, compression=compression)
        finally:
            bank_writer.remove_parts(out)
    return summarise(index.account, files=len(index.files), rejects=index.rejects, companions=index.companions)


def _begin(root: Path, out: Path, settings: dict[str, Any]) -> Index:
    """The index of the bank in `out`, if it has these settings, without the files that gave no scene; else that of a new bank."""
    if not bank_index.is_bank(out):
        return Index(settings)
    index = bank_index.read(out)
    if differences := bank_index.differences(settings, index.settings):
        raise SceneError(f"{out}: a bank made with other settings ({'; '.join(differences)}); give another out, or remove it")
    bank_writer.remove_parts(out)
    failed = {reject["source"] for reject in index.rejects if reject["scene"] is None}
    failed -= set(bank_reader.open(out).metadata["source"].to_pylist())
    files = tuple(file for file in index.files if str(root / file if root.is_dir() else root) not in failed)
    rejects = tuple(reject for reject in index.rejects if reject["source"] not in failed)
    return replace(index, files=files, rejects=rejects, complete=False)


def _name(file: Path, root: Path) -> str:
    """A source file's name in the bank."""
    return file.relative_to(root).as_posix() if file != root else file.name


def convert_file(item: tuple[int, Path], *, root: Path, out: Path, tools: SceneTools) -> SourceFileResult:
    """Writes the scenes of one file to a part of the bank's folder. Any error is a reject, but for `ConfigError`."""
    number, path = item
    rows: list[dict[str, Any]] = []
    trials: list[PackReport | str] = []
    rejects: list[Reject] = []

    def batches() -> Iterator[Any]:
        for raw in read_file(path, tools.formats):
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
                rejects.append(explain(error, str(path), raw.name))
                continue
            trials.append(trial)
            rows.append(row | {"packing": trial if isinstance(trial, str) else catalogue.PACKED})
            yield batch

    part = bank_writer.write_part(out, number, batches())
    return SourceFileResult(_name(path, root), part=part, rows=tuple(rows), **list_entries(rejects), account=count_results(trials))


def complete(
    raw: RawScene, *, check: Check, rebuild: Callable[[RawScene], RawScene], gate: Callable[[RawScene], RawScene]
) -> RawScene:
    """The scene with lane links where its source has none, without what the quality rules leave out: the `refine` of a bank."""
    check(raw)  # refuses what the geometry of the next two cannot use
    return gate(rebuild(raw))
