"""report.md of an evaluation: what was evaluated, the results with their intervals, the failures, and how to repeat it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import markdown
from scenefactory_jax.core.config import flatten
from scenefactory_jax.evaluation import failures, statistics
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.records import Records
from scenefactory_jax.visualization.birds_eye.drawing import MARKS
from scenefactory_jax.visualization.report import document, planner_table, policy_comparison, tables
from scenefactory_jax.visualization.report.planner_table import UNTRAINED
from scenefactory_jax.visualization.report.tables import Summary, format_estimate

BREAKDOWNS = ("surface", "film_mm")  # columns of records
RATES = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate", "mean_time_to_goal_s")  # of breakdowns
MAX_GROUPS, MAX_FAILURES = 20, 40  # rows of tables; the CSV files have all


def write(
    folder: Path,
    *,
    title: str,
    records: Mapping[str, Records],
    summary: Mapping[str, Summary],
    settings: Mapping[str, Any],
    config: Mapping[str, Any],
    versions: Mapping[str, str],
    episodes: Mapping[str, str],
    command: str,
    figures: Mapping[str, Path],
    videos: Mapping[str, Path],
    failure_pictures: Mapping[str, Mapping[str, Path]],
    files: Mapping[str, Path],
) -> Path:
    """Writes `folder`/report.md and returns its path; sections without content are left out.

    Args:
        records: name ("strict", "strict, untrained") -> records. The first name gives the headline.
        summary: the same names -> `statistics.summarise` of the records.
        settings: `bootstrap` and `seed` of the intervals, and the config group `failures`.
        config: of the environment, shown in full.
        episodes: what decides the episodes, "Starts" -> "as recorded, from rest".
        command: repeats the evaluation.
        figures, videos, files: caption -> file; videos are .gif (shown) or .mp4 (linked).
        failure_pictures: name of records -> failure type -> picture of the worst; "film" -> their video.
    """
    resampling = {"bootstrap": settings["bootstrap"], "seed": settings["seed"]}
    rows = planner_table.select_policies(records)
    trained = {name: rows for name, rows in records.items() if ", " not in name}
    first, thresholds = next(iter(trained or records)), failures.list_thresholds(settings["failures"])
    return document.write(
        folder / "report.md",
        f"# {title}",
        _headline(first, summary[first], records[first], stochastic=settings.get("stochastic", False)),
        document.section("Episodes", markdown.format_table(["", ""], list(episodes.items())) if episodes else ""),
        document.section("Results", *_results({name: summary[name] for name in trained | rows}, trained | rows)),
        document.section("Comparison", *(_compare(name, summary, records, resampling) for name in trained if name + UNTRAINED in records)),
        document.section("Planners and metrics", *_tabulate_planners({name: summary[name] for name in rows}, rows)),
        document.section("Differences", *policy_comparison.compare_policies(rows, resampling)),
        document.section("Video", *(document.picture(folder, path, caption) for caption, path in videos.items())),
        document.section("By condition", *_break_down(first, records[first], resampling)),
        document.section(
            "Where it fails",
            *(_failures(folder, name, rows, failure_pictures.get(name, {}), thresholds) for name, rows in trained.items()),
        ),
        document.section("Figures", *(document.picture(folder, path, caption) for caption, path in figures.items())),
        document.section("What the numbers mean", *_definitions(summary)),
        document.section(
            "Set-up",
            markdown.format_table(["Machine and software", ""], list(versions.items())),
            f"To get these numbers again:\n\n```bash\n{command}\n```",
            "\n".join(f"- [{caption}]({document.relative(folder, path)})" for caption, path in files.items()),
            document.fold("The whole configuration", _format_config(config)),
        ),
    )


def _headline(name: str, summary: Summary, records: Records, *, stochastic: bool) -> str:
    reached, agents = int(np.sum(records["goal_reached"])), len(records["scene"])
    scenes, success, clean = len(np.unique(records["scene"])), summary["success_rate"], summary["clean_success_rate"]
    what = f"{reached} of {agents} cars reached their goal ({format_estimate(success)}), {format_estimate(clean)} without any other event"
    if "accuracy" in summary:
        scores = (f"{METRICS[score].label} {format_estimate(summary[score])}" for score in planner_table.SCORED if score in summary)
        what = f"{agents} cars: {', '.join(scores)}"
    parts = [
        f"**{what}** (protocol: {name}).",
        f"{document.count(scenes, 'scene')}, {document.count(_count_episodes(records), 'episode')}; "
        f"{'stochastic' if stochastic else 'deterministic'} policy; "
        f"seeds {_list_seeds(records)}.",
        "Numbers in brackets are 95 % intervals: were the evaluation repeated on other scenes of this kind, the true rate would lie "
        "inside an interval made this way 19 times of 20.",
    ]
    if scenes < 10:
        parts.append(f"With {document.count(scenes, 'scene')} the intervals are rough and rather too narrow: a hint, not a proof.")
    if faults := int(np.sum(records["numerical_error"])):
        parts.append(f"**{document.count(faults, 'agent')} ended by a fault of the simulation**, a bug to look into, not a driving error.")
    return " ".join(parts)


def _tabulate_planners(summary: Mapping[str, Summary], records: Mapping[str, Records]) -> list[str]:
    if not records:
        return []
    return [planner_table.format_table(summary, records), planner_table.NOTE, tables.explain_marks(summary.values())]


def _results(summary: Mapping[str, Summary], records: Mapping[str, Records]) -> list[str]:
    """All metrics, the meaning of their marks, and the sizes of the evaluation."""
    sizes = [
        [name, len(np.unique(rows["scene"])), _count_episodes(rows), len(rows["scene"]), _list_seeds(rows)]
        for name, rows in records.items()
    ]
    sizes = markdown.format_table(["Protocol", "Scenes", "Episodes", "Agents", "Seeds"], sizes)
    return [tables.format_summaries(summary), tables.explain_marks(summary.values()), sizes]


def _compare(name: str, summary: Mapping[str, Summary], records: Mapping[str, Records], resampling: Mapping[str, int]) -> str:
    """The trained policy beside the untrained one, with the paired difference."""
    baseline = name + UNTRAINED
    change = statistics.difference(records[baseline], records[name], **resampling)
    gain = change["success_rate"]
    certain = gain.low is not None and gain.high is not None and (gain.low > 0 or gain.high < 0)
    return document.join(
        f"### {name} against {baseline}",
        f"Both drove the same scenes. The change of the success rate, {format_estimate(gain, signed=True)}, "
        f"{'is beyond what chance explains' if certain else 'cannot be told from chance'}. "
        "Differences are in percentage points for rates; their intervals resample scenes in pairs.",
        tables.format_summaries({baseline: summary[baseline], name: summary[name], "difference": change}, signed=["difference"]),
        tables.explain_marks([change]),
    )


def _break_down(name: str, records: Records, resampling: Mapping[str, int]) -> list[str]:
    """A table for each column that has more than one value: a row a value, rates across."""
    parts, summaries = [], []
    for column in BREAKDOWNS:
        groups = statistics.breakdown(records, column, **resampling)
        if len(groups) < 2:
            continue
        values, note = list(groups), ""
        if len(values) > MAX_GROUPS:
            values = sorted(values, key=lambda value: groups[value]["success_rate"].value or 0.0)[:MAX_GROUPS]
            note = f"The {MAX_GROUPS} of {len(groups)} with the lowest success rate."
        rows = [([value, groups[value]["success_rate"].count], groups[value]) for value in values]
        parts += [f"### By {column} ({name})", note, tables.format_rows([column, "Agents"], rows, RATES)]
        summaries += [{metric: groups[value][metric] for metric in RATES} for value in values]
    return [*parts, tables.explain_marks(summaries)] if parts else []


def _failures(folder: Path, name: str, records: Records, pictures: Mapping[str, Path], thresholds: Mapping[str, float]) -> str:
    """Failures by type, pictures of the worst, and a list of the agents without a clean success."""
    labels = {kind: f"{failures.FAILURE_TYPES[kind].label}, {name}" for kind in failures.rank_failures(records)}
    labels["film"] = f"The worst of each kind, {name}; clocks start where the film does"
    worst = [document.picture(folder, pictures[kind], label) for kind, label in labels.items() if kind in pictures]
    return document.join(
        f"### {name}",
        failures.format_table(records),
        failures.format_definitions(records, thresholds),
        document.fold(f"The worst of each kind, side by side ({name})", *worst),
        _list_failures(records) or "Every agent reached its goal without any other event.",
    )


def _list_failures(records: Records) -> str:
    """A folded table of the agents without a clean success, worst scenes first; empty if there are none."""
    rows = np.flatnonzero(~np.asarray(records["clean"], bool))
    if not len(rows):
        return ""
    place = ("scene", "world", "seed", "agent")
    clean = {scene: np.mean(records["clean"][records["scene"] == scene]) for scene in np.unique(records["scene"][rows])}
    order = sorted(rows, key=lambda row: (clean[records["scene"][row]], *(records[column][row] for column in place)))
    cells = [
        [*(records[column][row] for column in place), _describe_failure(records, int(row)), f"{records['time_s'][row]:.1f}",
         f"{records['end_distance_m'][row]:.1f} of {records['start_distance_m'][row]:.1f}", f"{records['max_drac'][row]:.1f}"]
        for row in order[:MAX_FAILURES]
    ]  # fmt: skip
    header = ["Scene", "World", "Seed", "Agent", "What happened", "Driven, s", "Left to the goal, m", "Max DRAC, m/s²"]
    extent = f"all {len(rows)}" if len(rows) <= MAX_FAILURES else f"{MAX_FAILURES} of {len(rows)}, worst scenes first; the CSV has all"
    return document.fold(f"Agents that did not arrive cleanly ({extent})", markdown.format_table(header, cells))


def _describe_failure(records: Records, row: int) -> str:
    kind = failures.FAILURE_TYPES[str(records["failure"][row])].label
    events = [mark.label for name, mark in MARKS.items() if records[name][row] and mark.label not in kind]
    return kind + (f"; also {', '.join(events)}" if events else "")


def _definitions(summary: Mapping[str, Summary]) -> list[str]:
    protocols = tables.define_protocols({name.partition(", ")[0] for name in summary})
    note = (
        "DRAC treats cars as circles and the gap as at least 1 m, in every direction, so it is large for any two cars that pass closely; "
        "compare it between policies rather than with road data."
    )
    metrics = tables.define_metrics(tables.find_metrics(summary.values()))
    return [metrics, note, f"How an episode is run:\n\n{protocols}" if protocols else ""]


def _format_config(config: Mapping[str, Any]) -> str:
    lines = (f"{key}: {f'{value:g}' if isinstance(value, float) else value}" for key, value in flatten(config).items())
    return "```\n{}\n```".format("\n".join(lines))


def _count_episodes(records: Records) -> int:
    return len(set(zip(*(np.asarray(records[column]).tolist() for column in ("scene", "world", "seed")), strict=True)))


def _list_seeds(records: Records) -> str:
    return ", ".join(str(seed) for seed in np.unique(records["seed"]))
