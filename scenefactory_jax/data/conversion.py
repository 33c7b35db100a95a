"""Files in any known format -> a bank. What cannot be used is listed with its reason, and the rest goes on.

Scenes go into the bank whole. They are also packed once on trial: what packing keeps and drops is counted and thrown away, and a scene that
it refuses stays in the bank, with the reason in its row, because other numbers may take it. What the checks refuse is left out.
"""

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel import task_map as spreads
from scenefactory_jax.core.raw_scene import Companion, RawScene, Reject, SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.bank import arrow_codec, bank_index, bank_reader, bank_writer, catalogue
from scenefactory_jax.data.bank.bank_index import Index
from scenefactory_jax.data.bank.bank_writer import Compression, SourceFileResult
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.packing.pack import CUTS, DROPS, OTHER_DROPS, Packed, PackReport, prepare

SHOWN = 10  # rejects, or companions, that `describe` spells out


@dataclass(frozen=True)
class Summary:
    """What a conversion did."""

    files: int
    scenes: int
    rejects: tuple[dict[str, Any], ...]  # source, scene (null where the file itself cannot be read), reason
    companions: tuple[dict[str, Any], ...]  # source and reason of files that belong to scenes beside them
    agents_kept: int
    agents_dropped: dict[str, int]  # reason -> count
    others_kept: int
    others_dropped: dict[str, int]  # reason -> count
    segments_kept: int
    segments_cut: dict[str, int]  # reason -> count
    refused: dict[str, int]  # why packing refuses scenes -> how many; those of a bank are in it, and among `scenes`
    repaired: dict[str, int]  # repair -> scenes that had it
    centred_on: dict[str, int]  # what the centre was taken from -> scenes


def convert(
    path: Path | str,
    out: Path | str,
    *,
    formats: Mapping[str, reader_selection.Reader],
    check: Callable[..., Any],
    pack: Callable[..., Any],
    refine: Callable[[RawScene], RawScene] | None,
    features: catalogue.Features | None,
    settings: Mapping[str, Any],
    spread: spreads.Spread,
    shard_scenes: int,
    compression: Compression,
    on_file: Callable[[int, int], None] | None = None,
) -> Summary:
    """Read every file below `path` into the bank `out`. One that was stopped goes on where it stopped; a complete one takes up new files.

    Files that could not be read are read again: they may have been repaired.

    Args:
        path: a file, or a folder searched to its bottom.
        out: the bank's folder.
        formats: name -> reader, tried in order (`source.make`).
        check: `checks.check` bound to its numbers.
        pack: `pack.pack` bound to its numbers.
        refine: what is done to a scene before anything else; it raises `SceneError` for one that the bank is not to have. None: nothing.
        features: more columns of the catalogue, of each scene; None: only those that every bank has.
        settings: the config behind them, kept in the bank; a bank made with others is not gone on with.
        spread: who reads the files, see `spread`; order and result do not depend on it.
        shard_scenes, compression: of the bank's files, see `bank_writer.grow`.
        on_file: called with (files done, files in all) after each file.

    Raises:
        SceneError: no files, `out` is no bank or one made with other settings, or not one usable scene, with the first reasons.
        ConfigError: a number that a part refuses.
        folders.Busy: another command writes to `out`.
    """
    root, out = Path(path).absolute(), Path(out).resolve()
    files = reader_selection.find(root)
    bank_writer.check_free_space(out)
    work = functools.partial(convert_file, root=root, out=out, formats=dict(formats), check=check, pack=pack)
    work = functools.partial(work, refine=refine, features=features)

    def pieces(waiting: Sequence[Path]) -> Iterator[SourceFileResult]:
        done = len(files) - len(waiting)
        for number, (file, piece) in enumerate(zip(waiting, spread(work, list(enumerate(waiting))), strict=True), start=done + 1):
            lost = isinstance(piece, spreads.FailedTask)
            yield (
                SourceFileResult(_name(file, root), rejects=({"source": str(file), "scene": None, "reason": piece.reason},))
                if lost
                else piece
            )
            if on_file is not None:
                on_file(number, len(files))

    with folder_lock.lock_folder(out):
        index = _begun(root, out, bank_index.plain({"source": str(root), **settings}))
        known = set(index.files)
        waiting = [file for file in files if _name(file, root) not in known]
        try:
            index = bank_writer.append_files(out, pieces(waiting), index=index, shard_scenes=shard_scenes, compression=compression)
        finally:
            bank_writer.remove_parts(out)
    return _summary(index)


def _begun(root: Path, out: Path, settings: dict[str, Any]) -> Index:
    """The index of the bank that is there, if these settings made it, without the files that gave nothing; else that of a new one."""
    if not bank_index.is_bank(out):
        return Index(settings)
    index = bank_index.read(out)
    if found := bank_index.differences(settings, index.settings):
        raise SceneError(f"{out}: a bank made with other settings ({'; '.join(found)}); give another out, or remove it")
    bank_writer.remove_parts(out)
    lost = {reject["source"] for reject in index.rejects if reject["scene"] is None}
    lost -= set(bank_reader.open(out).metadata["source"].to_pylist())
    files = tuple(file for file in index.files if str(_path(file, root)) not in lost)
    rejects = tuple(reject for reject in index.rejects if reject["source"] not in lost)
    return replace(index, files=files, rejects=rejects, complete=False)


def _name(file: Path, root: Path) -> str:
    """A source file's name in the bank."""
    return file.relative_to(root).as_posix() if file != root else file.name


def _path(name: str, root: Path) -> Path:
    """The source file of that name."""
    return root / name if root.is_dir() else root


def convert_file(
    item: tuple[int, Path],
    *,
    root: Path,
    out: Path,
    formats: Mapping[str, reader_selection.Reader],
    check: Callable[..., Any],
    pack: Callable[..., Any],
    refine: Callable[[RawScene], RawScene] | None,
    features: catalogue.Features | None,
) -> SourceFileResult:
    """One file's scenes, in a part of the bank's folder; it raises only `ConfigError`, whatever the file or a reader does."""
    number, path = item
    rows: list[dict[str, Any]] = []
    tries: list[PackReport | str] = []
    rejects: list[dict[str, Any]] = []
    companions: list[dict[str, Any]] = []

    def batches() -> Iterator[Any]:
        for raw in examine(path, formats, rejects, companions):
            try:
                raw = replace(raw, source=str(path))
                raw = raw if refine is None else refine(raw)
                tried = try_packing(raw, check=check, pack=pack)
                row, batch = catalogue.extend_table(raw, features), arrow_codec.encode(raw)
            except ConfigError:
                raise  # no file is to blame
            except Exception as error:
                rejects.append(_reject(path, raw.name, error))
                continue
            tries.append(tried)
            rows.append(row | {"packing": tried if isinstance(tried, str) else catalogue.PACKED})
            yield batch

    part = bank_writer.write_part(out, number, batches())
    return SourceFileResult(
        file=_name(path, root),
        part=part,
        rows=tuple(rows),
        rejects=tuple(rejects),
        companions=tuple(companions),
        account=count_results(tries),
    )


def try_packing(raw: RawScene, *, check: Callable[..., Any], pack: Callable[..., Any]) -> PackReport | str:
    """What packing keeps and drops; of a scene that it refuses, the kind of the refusal, such as those of `pack.REFUSALS`.

    Raises:
        SceneError: the check refuses it: no packing can use it.
    """
    checked, repairs = check(raw)
    try:
        report = pack(checked)[1]
    except SceneError as refusal:
        return refusal.kind or "other"
    return replace(report, repairs=(*report.repairs, *repairs))


def complete(
    raw: RawScene, *, check: Callable[..., Any], rebuild: Callable[[RawScene], RawScene], gate: Callable[[RawScene], RawScene]
) -> RawScene:
    """How lanes hang together where the source does not say, then what the rules of quality make of it: the `refine` of a bank."""
    check(raw)  # what cannot be used is refused in its words, before geometry stumbles over it
    return gate(rebuild(raw))


def examine(
    path: Path, formats: Mapping[str, reader_selection.Reader], rejects: list[dict[str, Any]], companions: list[dict[str, Any]]
) -> Iterator[RawScene]:
    """The scenes of one file; what is none is added to one of the lists. It raises nothing but `ConfigError`."""
    scenes = reader_selection.read(path, formats)
    while True:
        try:
            raw = next(scenes, None)
        except Companion as companion:
            companions.append({"source": str(path), "reason": _reason(companion, path)})
            return
        except ConfigError:
            raise
        except Exception as error:
            rejects.append({"source": str(path), "scene": None, "reason": _reason(error, path)})
            return  # a reader that has failed yields no more
        if raw is None:
            return
        if isinstance(raw, Reject):
            rejects.append({"source": str(path), "scene": raw.scene, "reason": raw.reason})
        else:
            yield raw


def read(
    path: Path | str, *, formats: Mapping[str, reader_selection.Reader], check: Callable[..., Any], pack: Callable[..., Any], workers: int
) -> tuple[list[Packed], Summary]:
    """The packed scenes of a file or folder in memory, without a bank, and the account.

    Raises:
        SceneError: no files.
        ConfigError: a number that a part refuses.
    """
    files = reader_selection.find(path)
    work = functools.partial(_read_file, formats=dict(formats), check=check, pack=pack)
    results = spreads.local(work, files, workers=workers if len(files) > 1 else 1, timeout_s=None)
    scenes: list[Packed] = []
    rejects: list[dict[str, Any]] = []
    companions: list[dict[str, Any]] = []
    for file, result in zip(files, results, strict=True):
        lost = isinstance(result, spreads.FailedTask)
        good, bad, beside = ([], [{"source": str(file), "scene": None, "reason": result.reason}], []) if lost else result
        scenes.extend(good)
        rejects.extend(bad)
        companions.extend(beside)
    return scenes, summarise([scene.report for scene in scenes], files=len(files), rejects=rejects, companions=companions)


def _read_file(
    path: Path, *, formats: Mapping[str, reader_selection.Reader], check: Callable[..., Any], pack: Callable[..., Any]
) -> tuple[list[Packed], list[dict[str, Any]], list[dict[str, Any]]]:
    scenes: list[Packed] = []
    rejects: list[dict[str, Any]] = []
    companions: list[dict[str, Any]] = []
    for raw in examine(path, formats, rejects, companions):
        try:
            scenes.append(prepare(replace(raw, source=str(path)), check=check, pack=pack))
        except ConfigError:
            raise
        except Exception as error:
            rejects.append(_reject(path, raw.name, error))
    return scenes, rejects, companions


def _reject(path: Path, scene: str, error: Exception) -> dict[str, Any]:
    """A scene that cannot be used; where packing refused it, with the kind."""
    kind = error.kind if isinstance(error, SceneError) else None
    return {"source": str(path), "scene": scene, "reason": _reason(error, path)} | ({} if kind is None else {"kind": kind})


def _reason(error: Exception, path: Path) -> str:
    """Why, without repeating the file; an error that is no SceneError is named by its type."""
    text = str(error).removeprefix(f"{path}: ")
    return text if isinstance(error, SceneError) else f"{type(error).__name__}: {text}"


def count_results(tries: Iterable[PackReport | str]) -> dict[str, Any]:
    """What packing kept, dropped and refused (see `try_packing`), as numbers that add up over scenes."""
    tries = list(tries)
    reports = [report for report in tries if not isinstance(report, str)]
    total = lambda name, reasons: {reason: sum(getattr(report, name).get(reason, 0) for report in reports) for reason in reasons}  # noqa: E731
    return {
        "scenes": len(tries),
        "agents_kept": sum(report.agents_kept for report in reports),
        "agents_dropped": total("agents_dropped", DROPS),
        "others_kept": sum(report.others_kept for report in reports),
        "others_dropped": total("others_dropped", OTHER_DROPS),
        "segments_kept": sum(report.segments_kept for report in reports),
        "segments_cut": total("segments_cut", CUTS),
        "refused": dict(Counter(kind for kind in tries if isinstance(kind, str))),
        "repaired": dict(Counter(line.split(":")[0] for report in reports for line in report.repairs)),
        "centred_on": dict(Counter(report.centred_on for report in reports)),
    }


def summarise(
    reports: Iterable[PackReport],
    *,
    files: int,
    rejects: Sequence[Mapping[str, Any]],
    companions: Sequence[Mapping[str, Any]] = (),
) -> Summary:
    """The accounts of many scenes as one."""
    listed = {"rejects": tuple(map(dict, rejects)), "companions": tuple(map(dict, companions))}
    refused = dict(Counter(reject["kind"] for reject in rejects if reject.get("kind") is not None))
    return replace(Summary(files=files, **listed, **count_results(reports)), refused=refused)


def _summary(index: Index) -> Summary:
    """That of a bank, as the conversion counted it."""
    return Summary(files=len(index.files), rejects=index.rejects, companions=index.companions, **count_results([]) | index.account)


def describe(summary: Summary) -> list[str]:
    """The account as lines; the last one is the summary in a sentence."""
    count = lambda table: ", ".join(f"{number} {reason.replace('_', ' ')}" for reason, number in table.items() if number) or "none"  # noqa: E731
    lines = [f"rejected {_near(reject['source'])}{_scene(reject)}: {reject['reason']}" for reject in summary.rejects[:SHOWN]]
    if len(summary.rejects) > SHOWN:
        lines.append(f"... and {len(summary.rejects) - SHOWN} more, all in bank.json")
    if names := [Path(companion["source"]).name for companion in summary.companions]:
        more = ", ..." if len(names) > SHOWN else ""
        lines.append(f"{len(names)} files belong to scenes beside them: {', '.join(names[:SHOWN])}{more}")
    lines += [f"in {number} scenes: {repair}" for repair, number in summary.repaired.items()]
    lines.append(f"centred on: {', '.join(f'{what} in {number} scenes' for what, number in summary.centred_on.items())}")
    lines.append(f"segments: {summary.segments_kept} kept; cut: {count(summary.segments_cut)}")
    lines.append(f"others: {summary.others_kept} kept; dropped: {count(summary.others_dropped)}")
    lines.append(f"agents: {summary.agents_kept} kept; dropped: {count(summary.agents_dropped)}")
    if summary.refused:
        lines.append(f"packing with these numbers refuses: {count(summary.refused)}; such scenes stay in a bank, for others")
    lines.append(f"{summary.scenes} scenes with {summary.agents_kept} agents from {summary.files} files, {len(summary.rejects)} rejected")
    return [escape_for_terminal(line) for line in lines]


def _near(source: str) -> Path:
    """A path as one sees it from here."""
    path, here = Path(source), Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _scene(reject: Mapping[str, Any]) -> str:
    return f" ({reject['scene']})" if reject["scene"] else ""
