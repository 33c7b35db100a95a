"""Files in any known format -> a bank. What cannot be used is listed with its reason, and the rest goes on.

Scenes go into the bank uncut. They are also packed on trial: the counts of what packing keeps and drops are stored, and a scene that it
refuses stays in the bank with the reason in its row, because other numbers may take it. Scenes that the checks refuse are left out.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel.task_map import FailedTask, TaskMap
from scenefactory_jax.core.raw_scene import COMPANION, RawScene, Reject, SceneError
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer, catalogue
from scenefactory_jax.data.bank.bank_index import Index
from scenefactory_jax.data.bank.bank_writer import Compression, SourceFileResult
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading.scene_source import Check, Pack, explain, read_file
from scenefactory_jax.data.packing.pack import PackReport
from scenefactory_jax.data.packing.summary import Summary, as_entry, count_results, summarise


@dataclass(frozen=True)
class SceneTools:
    """What is done to each scene of a file; all of it can be sent to another process."""

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
    """Reads every file below `path` into the bank `out`. A stopped conversion goes on where it stopped; a complete one takes up new files.

    Files that could not be read are read again: they may have been repaired.

    Args:
        path: a file, or a folder with its subfolders.
        out: the bank's folder.
        settings: the config behind `tools`, stored in the bank; a bank made with others is not continued.
        spread: task map over the files; order and result do not depend on it.
        shard_scenes, compression: of the bank's files, see `bank_writer.append_files`.
        on_file: called with (files done, files in all) after each file.

    Raises:
        SceneError: no files, `out` is no bank or one made with other settings, or not one usable scene, with the first reasons.
        ConfigError: a number that a part refuses.
        folder_lock.Busy: another command writes to `out`.
    """
    root, out = Path(path).absolute(), Path(out).resolve()
    files = reader_selection.find(root)
    bank_writer.check_target(out)
    work = functools.partial(convert_file, root=root, out=out, tools=tools)

    def pieces(waiting: Sequence[Path]) -> Iterator[SourceFileResult]:
        done = len(files) - len(waiting)
        for number, (file, piece) in enumerate(zip(waiting, spread(work, list(enumerate(waiting))), strict=True), start=done + 1):
            if isinstance(piece, FailedTask):
                piece = SourceFileResult(_name(file, root), rejects=(as_entry(Reject(None, piece.reason, None, str(file))),))
            yield piece
            if on_file is not None:
                on_file(number, len(files))

    with folder_lock.lock_folder(out):
        index = _begin(root, out, bank_index.plain({"source": str(root), **settings}))
        known = set(index.files)
        waiting = [file for file in files if _name(file, root) not in known]
        try:
            index = bank_writer.append_files(out, pieces(waiting), index=index, shard_scenes=shard_scenes, compression=compression)
        finally:
            bank_writer.remove_parts(out)
    return summarise(index.account, files=len(index.files), rejects=index.rejects, companions=index.companions)


def _begin(root: Path, out: Path, settings: dict[str, Any]) -> Index:
    """The index of the bank in `out`, if these settings made it, without the files that gave nothing; else that of a new bank."""
    if not bank_index.is_bank(out):
        return Index(settings)
    index = bank_index.read(out)
    if found := bank_index.differences(settings, index.settings):
        raise SceneError(f"{out}: a bank made with other settings ({'; '.join(found)}); give another out, or remove it")
    bank_writer.remove_parts(out)
    lost = {reject["source"] for reject in index.rejects if reject["scene"] is None}
    lost -= set(bank_reader.open(out).metadata["source"].to_pylist())
    path = lambda name: str(root / name if root.is_dir() else root)  # noqa: E731
    files = tuple(file for file in index.files if path(file) not in lost)
    rejects = tuple(reject for reject in index.rejects if reject["source"] not in lost)
    return replace(index, files=files, rejects=rejects, complete=False)


def _name(file: Path, root: Path) -> str:
    """A source file's name in the bank."""
    return file.relative_to(root).as_posix() if file != root else file.name


def convert_file(item: tuple[int, Path], *, root: Path, out: Path, tools: SceneTools) -> SourceFileResult:
    """Writes the scenes of one file to a part of the bank's folder; it raises only `ConfigError`, whatever the file or a reader does."""
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
                trial = try_packing(raw, check=tools.check, pack=tools.pack)
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
    return SourceFileResult(
        file=_name(path, root),
        part=part,
        rows=tuple(rows),
        rejects=tuple(as_entry(reject) for reject in rejects if reject.kind != COMPANION),
        companions=tuple(as_entry(reject) for reject in rejects if reject.kind == COMPANION),
        account=count_results(trials),
    )


def try_packing(raw: RawScene, *, check: Check, pack: Pack) -> PackReport | str:
    """The report of packing; of a scene that packing refuses, the kind of the refusal, such as those of `pack.REFUSALS`.

    Raises:
        SceneError: the check refuses the scene: no packing can use it.
    """
    checked, repairs = check(raw)
    try:
        report = pack(checked)[1]
    except SceneError as refusal:
        return refusal.kind or "other"
    return replace(report, repairs=(*report.repairs, *repairs))


def complete(
    raw: RawScene, *, check: Check, rebuild: Callable[[RawScene], RawScene], gate: Callable[[RawScene], RawScene]
) -> RawScene:
    """The scene with lane links where its source has none, without what the quality rules leave out: the `refine` of a bank."""
    check(raw)  # refuses what the geometry of the next two cannot use
    return gate(rebuild(raw))
