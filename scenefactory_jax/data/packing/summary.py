"""Counts of what packing kept, dropped and refused of many scenes, and their description."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scenefactory_jax.core.raw_scene import COMPANION, Reject
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.packing.control_columns import CONTROL_DROPS
from scenefactory_jax.data.packing.pack import CUTS, DROPS, TRAFFIC_DROPS, PackReport

MAX_LISTED = 10  # rejects, or companions, in a description


@dataclass(frozen=True)
class Summary:
    """Counts over many scenes, and the scenes and files that were left out."""

    files: int  # 0: no scene came from a file
    scenes: int
    rejects: tuple[dict[str, Any], ...]  # source, scene (null where the file itself cannot be read), reason
    companions: tuple[dict[str, Any], ...]  # source and reason of files that belong to scenes beside them
    agents_kept: int
    agents_dropped: dict[str, int]  # reason -> count
    traffic_kept: int
    traffic_dropped: dict[str, int]  # reason -> count
    controls_kept: int
    controls_dropped: dict[str, int]  # reason -> count
    signs_inferred: int  # stop signs whose lanes were inferred
    routes: dict[str, int]  # kind of route -> count; empty: packed without routes
    segments_kept: int
    segments_cut: dict[str, int]  # reason -> count
    refused: dict[str, int]  # reason of packing -> scenes; a bank holds them all the same
    repaired: dict[str, int]  # repair -> scenes
    centred_on: dict[str, int]  # what the centre was taken from -> scenes


def count_results(results: Sequence[PackReport | str]) -> dict[str, Any]:
    """Counts that add up over scenes: of the report of each packed scene, or the kind of its refusal."""
    reports = [report for report in results if not isinstance(report, str)]
    add = lambda name, reasons: {reason: sum(getattr(report, name).get(reason, 0) for report in reports) for reason in reasons}  # noqa: E731
    reasons = {"agents_dropped": DROPS, "traffic_dropped": TRAFFIC_DROPS, "controls_dropped": CONTROL_DROPS, "segments_cut": CUTS}
    numbers = ("agents_kept", "traffic_kept", "controls_kept", "signs_inferred", "segments_kept")
    return {
        "scenes": len(results),
        **{name: sum(getattr(report, name) for report in reports) for name in numbers},
        **{name: add(name, known) for name, known in reasons.items()},
        "routes": dict(sum((Counter(asdict(report.routes)) for report in reports if report.routes), Counter())),
        "refused": dict(Counter(kind for kind in results if isinstance(kind, str))),
        "repaired": dict(Counter(line.split(":")[0] for report in reports for line in report.repairs)),
        "centred_on": dict(Counter(report.centred_on for report in reports)),
    }


def summarise(
    counts: Mapping[str, Any], *, files: int, rejects: Sequence[Mapping[str, Any]], companions: Sequence[Mapping[str, Any]] = ()
) -> Summary:
    """The summary of counts (`count_results`) and of what was left out."""
    lists = {"rejects": tuple(map(dict, rejects)), "companions": tuple(map(dict, companions))}
    return Summary(files=files, **lists, **count_results([]) | dict(counts))


def summarise_packed(
    reports: Sequence[PackReport], rejects: Sequence[Reject], *, files: int, earlier: Sequence[Mapping[str, Any]] = ()
) -> Summary:
    """The summary of scenes that were packed, after rejects of an earlier conversion."""
    refused = Counter(reject.kind for reject in rejects if reject.kind not in (None, COMPANION))
    entries = list_entries(rejects)
    counts = count_results(reports) | {"refused": dict(refused)}
    return summarise(counts, files=files, rejects=[*earlier, *entries["rejects"]], companions=entries["companions"])


def list_entries(rejects: Iterable[Reject]) -> dict[str, Any]:
    """The entries `rejects` and `companions` of `bank.json`."""
    entries: dict[str, list[dict[str, Any]]] = {"rejects": [], "companions": []}
    for reject in rejects:
        entry = {"source": reject.source, "scene": reject.scene, "reason": reject.reason}
        if reject.kind == COMPANION:
            entries["companions"].append({"source": reject.source, "reason": reject.reason})
        else:
            entries["rejects"].append(entry if reject.kind is None else entry | {"kind": reject.kind})
    return {name: tuple(listed) for name, listed in entries.items()}


def describe(summary: Summary) -> list[str]:
    """The summary as lines; the last one is the total in a sentence."""
    count = lambda table: ", ".join(f"{number} {reason.replace('_', ' ')}" for reason, number in table.items() if number) or "none"  # noqa: E731
    lines = []
    for reject in summary.rejects[:MAX_LISTED]:
        scene = f" ({reject['scene']})" if reject["scene"] else ""
        lines.append(f"rejected {shorten_path(reject['source'])}{scene}: {reject['reason']}")
    if len(summary.rejects) > MAX_LISTED:
        lines.append(f"... and {len(summary.rejects) - MAX_LISTED} more, all in bank.json")
    if names := [Path(companion["source"]).name for companion in summary.companions]:
        more = ", ..." if len(names) > MAX_LISTED else ""
        lines.append(f"{len(names)} files belong to scenes beside them: {', '.join(names[:MAX_LISTED])}{more}")
    lines += [f"in {number} scenes: {repair}" for repair, number in summary.repaired.items()]
    lines.append(f"centred on: {', '.join(f'{origin} in {number} scenes' for origin, number in summary.centred_on.items())}")
    lines.append(f"segments: {summary.segments_kept} kept; cut: {count(summary.segments_cut)}")
    inferred = f"; lanes of {summary.signs_inferred} stop signs inferred" if summary.signs_inferred else ""
    lines.append(f"lights and stop signs: {summary.controls_kept} kept; dropped: {count(summary.controls_dropped)}{inferred}")
    if summary.routes:
        lines.append(f"routes: {count(summary.routes)}")
    lines.append(f"traffic: {summary.traffic_kept} kept; dropped: {count(summary.traffic_dropped)}")
    lines.append(f"agents: {summary.agents_kept} kept; dropped: {count(summary.agents_dropped)}")
    if summary.refused:
        lines.append(f"packing with these numbers refuses: {count(summary.refused)}; such scenes stay in a bank, for other numbers")
    files = f" from {summary.files} files" if summary.files else ""
    lines.append(f"{summary.scenes} scenes with {summary.agents_kept} agents{files}, {len(summary.rejects)} rejected")
    return [escape_for_terminal(line) for line in lines]


def shorten_path(source: Path | str) -> Path:
    """The path relative to the working directory, if it is below."""
    path, here = Path(source), Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
