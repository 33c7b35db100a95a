"""What packing kept, dropped and refused of many scenes: counted, added up and described."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scenefactory_jax.core.raw_scene import COMPANION, Reject
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.packing.pack import CUTS, DROPS, TRAFFIC_DROPS, PackReport

SHOWN = 10  # rejects, or companions, that `describe` lists


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
    segments_kept: int
    segments_cut: dict[str, int]  # reason -> count
    refused: dict[str, int]  # reason of packing -> scenes; a bank holds them all the same
    repaired: dict[str, int]  # repair -> scenes
    centred_on: dict[str, int]  # what the centre was taken from -> scenes


def count_results(results: Iterable[PackReport | str]) -> dict[str, Any]:
    """Counts that add up over scenes: of the report of each packed scene, or the kind of its refusal."""
    results = list(results)
    reports = [report for report in results if not isinstance(report, str)]
    add = lambda name, reasons: {reason: sum(getattr(report, name).get(reason, 0) for report in reports) for reason in reasons}  # noqa: E731
    return {
        "scenes": len(results),
        "agents_kept": sum(report.agents_kept for report in reports),
        "agents_dropped": add("agents_dropped", DROPS),
        "traffic_kept": sum(report.traffic_kept for report in reports),
        "traffic_dropped": add("traffic_dropped", TRAFFIC_DROPS),
        "segments_kept": sum(report.segments_kept for report in reports),
        "segments_cut": add("segments_cut", CUTS),
        "refused": dict(Counter(kind for kind in results if isinstance(kind, str))),
        "repaired": dict(Counter(line.split(":")[0] for report in reports for line in report.repairs)),
        "centred_on": dict(Counter(report.centred_on for report in reports)),
    }


def summarise(
    counts: Mapping[str, Any], *, files: int, rejects: Sequence[Mapping[str, Any]], companions: Sequence[Mapping[str, Any]] = ()
) -> Summary:
    """The summary of counts (`count_results`) and of what was left out."""
    listed = {"rejects": tuple(map(dict, rejects)), "companions": tuple(map(dict, companions))}
    return Summary(files=files, **listed, **count_results([]) | dict(counts))


def summarise_packed(
    reports: Iterable[PackReport], rejects: Sequence[Reject], *, files: int, earlier: Sequence[Mapping[str, Any]] = ()
) -> Summary:
    """The summary of scenes that were packed, after rejects of an earlier conversion."""
    listed = [*earlier, *(as_entry(reject) for reject in rejects if reject.kind != COMPANION)]
    companions = [as_entry(reject) for reject in rejects if reject.kind == COMPANION]
    refused = Counter(reject.kind for reject in rejects if reject.kind not in (None, COMPANION))
    return replace(summarise(count_results(reports), files=files, rejects=listed, companions=companions), refused=dict(refused))


def as_entry(reject: Reject) -> dict[str, Any]:
    """A reject as an entry of `bank.json`."""
    if reject.kind == COMPANION:
        return {"source": reject.source, "reason": reject.reason}
    kind = {} if reject.kind is None else {"kind": reject.kind}
    return {"source": reject.source, "scene": reject.scene, "reason": reject.reason} | kind


def describe(summary: Summary) -> list[str]:
    """The summary as lines; the last one is the total in a sentence."""
    count = lambda table: ", ".join(f"{number} {reason.replace('_', ' ')}" for reason, number in table.items() if number) or "none"  # noqa: E731
    lines = [f"rejected {_relative(one['source'])}{_scene(one)}: {one['reason']}" for one in summary.rejects[:SHOWN]]
    if len(summary.rejects) > SHOWN:
        lines.append(f"... and {len(summary.rejects) - SHOWN} more, all in bank.json")
    if names := [Path(companion["source"]).name for companion in summary.companions]:
        more = ", ..." if len(names) > SHOWN else ""
        lines.append(f"{len(names)} files belong to scenes beside them: {', '.join(names[:SHOWN])}{more}")
    lines += [f"in {number} scenes: {repair}" for repair, number in summary.repaired.items()]
    lines.append(f"centred on: {', '.join(f'{what} in {number} scenes' for what, number in summary.centred_on.items())}")
    lines.append(f"segments: {summary.segments_kept} kept; cut: {count(summary.segments_cut)}")
    lines.append(f"others: {summary.traffic_kept} kept; dropped: {count(summary.traffic_dropped)}")
    lines.append(f"agents: {summary.agents_kept} kept; dropped: {count(summary.agents_dropped)}")
    if summary.refused:
        lines.append(f"packing with these numbers refuses: {count(summary.refused)}; such scenes stay in a bank, for others")
    files = f" from {summary.files} files" if summary.files else ""
    lines.append(f"{summary.scenes} scenes with {summary.agents_kept} agents{files}, {len(summary.rejects)} rejected")
    return [escape_for_terminal(line) for line in lines]


def _relative(source: str) -> Path:
    path, here = Path(source), Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _scene(reject: Mapping[str, Any]) -> str:
    return f" ({reject['scene']})" if reject["scene"] else ""
