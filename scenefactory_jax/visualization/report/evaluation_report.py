"""report.md: what was evaluated, what came out, how sure it is, where it failed, and how to do it again."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.evaluation import agent_metrics, failures
from scenefactory_jax.evaluation.agent_metrics import METRICS, Estimate, Records
from scenefactory_jax.visualization.birds_eye.drawing import MARKS
from scenefactory_jax.visualization.report import plots

Summary = Mapping[str, Estimate]

PROTOCOLS = {
    "strict": "any event (goal, collision, crash, road edge) ends the agent",
    "goal_only": "events are counted but only the goal ends an agent, so an agent may collide and still reach its goal",
}
KEY_NUMBERS = (
    "seed", "worlds", "iterations", "minutes", "timing", "dynamics._target_", "dynamics.solver", "weather.sampler", "weather.patches",
    "weather.rain", "weather.friction.mode", "spawning.sampler", "step_metrics.goal_radius_m", "step_metrics.collision_force_n",
    "termination.ending", "ppo", "policy._target_", "scenes",
)  # fmt: skip
_GROUPS, _FAILURES = 20, 40  # the longest tables that a reader still reads; the CSV holds everything


class DocumentError(ValueError):
    """A report that cannot be written; the message names the argument and what would be valid."""


def write(
    folder: Path,
    *,
    title: str,
    summary: Mapping[str, Summary],
    records: Mapping[str, Records],
    config: Mapping[str, Any],
    versions: Mapping[str, str],
    bootstrap: int,
    seed: int,
    baselines: Mapping[str, str] | None = None,
    breakdowns: Sequence[str] = ("surface", "film_mm"),
    figures: Mapping[str, Path] | None = None,
    videos: Mapping[str, Path] | None = None,
    files: Mapping[str, Path] | None = None,
    commands: Sequence[str] = (),
    failed: Mapping[str, Mapping[str, Path]] | None = None,
    kinds: Mapping[str, float] | None = None,
    episodes: Mapping[str, str] | None = None,
) -> Path:
    """Write `folder`/report.md and return its path. Sections without content are left out.

    Args:
        folder: where report.md goes; made if it does not exist.
        title: the heading.
        summary: name ("strict", "strict, untrained") -> `tables.summarise` of its records. The first name gives the headline sentence.
        records: the same names -> records.
        config: the resolved config, shown in full, folded.
        versions: machine and software, "GPU" -> "NVIDIA H200".
        bootstrap, seed: resamples and seed of the intervals in comparisons and breakdowns.
        baselines: name -> the name it is compared with, {"strict": "strict, untrained"}; both must hold the same scenes.
        breakdowns: columns of the records to break the headline down by; a column with one value is skipped.
        figures: caption -> picture; shown in this order.
        videos: caption -> .gif (shown) or .mp4 (linked).
        files: what it is -> file, linked at the end (per-agent CSV, metrics).
        commands: how to get these numbers again.
        failed: name of records with kinds of failures -> kind -> picture of the worst; "film" -> their video.
        kinds: the numbers that the definitions of `failures.KINDS` name.
        episodes: what decided the episodes, "Starts" -> "as recorded, from rest".

    Raises:
        DocumentError: nothing to report, names that do not match, a file that does not exist.
        RecordsError: see `tables.check`.
    """
    baselines = baselines or {}
    drawn = {f"{name}, {kind}": path for name, paths in (failed or {}).items() for kind, path in paths.items()}
    _check(summary, records, baselines, {**(figures or {}), **(videos or {}), **(files or {}), **drawn})
    measured = [name for name in summary if name not in baselines.values()]
    first = measured[0]
    sections = [
        f"# {title}",
        _headline(first, summary[first], records[first]),
        _section("Episodes", agent_metrics.grid(["", ""], list(episodes.items())) if episodes else ""),
        _section("Results", _results({name: summary[name] for name in measured}, records)),
        _section("Comparison", *(_comparison(n, b, summary, records, bootstrap=bootstrap, seed=seed) for n, b in baselines.items())),
        _section("Video", *(_show(folder, caption, path) for caption, path in (videos or {}).items())),
        _section("By condition", _conditions(records[first], first, breakdowns, bootstrap=bootstrap, seed=seed)),
        _section("Where it fails", *(_failures(folder, n, records[n], (failed or {}).get(n, {}), kinds or {}) for n in measured)),
        _section("Figures", *(_show(folder, caption, path) for caption, path in (figures or {}).items())),
        _section("What the numbers mean", _definitions(summary, measured)),
        _section("Set-up", _setup(config, versions), _commands(commands), _links(folder, files or {}), _whole(config)),
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "report.md"
    path.write_text("\n\n".join(section for section in sections if section) + "\n", encoding="utf-8")
    return path


def _check(summary: Mapping[str, Summary], records: Mapping[str, Records], baselines: Mapping[str, str], paths: Mapping[str, Path]) -> None:
    """Refuse names that do not match and files that do not exist."""
    if not summary:
        raise DocumentError("summary: empty, so there is nothing to report; wanted at least one evaluated protocol")
    for name in summary:
        if name not in records:
            raise DocumentError(f"records: no {name!r}, which stands in summary; there are {', '.join(records) or 'none'}")
        agent_metrics.check(records[name])
    for name, other in baselines.items():
        if name not in summary or other not in summary or other == name:
            raise DocumentError(f"baselines: {name!r} -> {other!r}; both must be different names of summary: {', '.join(summary)}")
    if set(summary) == set(baselines.values()):
        raise DocumentError("baselines: every summary is a baseline of another, so none is left to report")
    for caption, path in paths.items():
        if not path.is_file():
            raise DocumentError(f"{path}: no such file, for {caption!r}")


def _section(title: str, *parts: str) -> str:
    """A heading and its paragraphs; nothing if they are all empty."""
    body = "\n\n".join(part for part in parts if part)
    return f"## {title}\n\n{body}" if body else ""


def _headline(name: str, summary: Summary, records: Records) -> str:
    """The result in three sentences."""
    reached, agents = int(np.sum(records["goal_reached"])), len(records["scene"])
    scenes, worlds = len(np.unique(records["scene"])), _worlds(records)
    success, clean = summary["success_rate"], summary["clean_success_rate"]
    parts = [
        f"**{reached} of {agents} cars reached their goal ({agent_metrics.text(success)}),"
        f" {agent_metrics.text(clean)} without any other event** "
        f"(protocol: {name}).",
        f"{_counted(scenes, 'scene')}, {_counted(worlds, 'episode')}; deterministic policy; "
        f"seeds {', '.join(str(s) for s in np.unique(records['seed']))}.",
        "Numbers in brackets are 95 % intervals: were the evaluation repeated on other scenes of this kind, the true rate would lie "
        "inside an interval made this way 19 times of 20.",
    ]
    if scenes < 10:
        parts.append(f"With {_counted(scenes, 'scene')} the intervals are rough and rather too narrow: a hint, not a proof.")
    if faults := int(np.sum(records["numerical_error"])):
        parts.append(f"**{_counted(faults, 'agent')} ended by a fault of the simulation**, a bug to look into, not a driving error.")
    return " ".join(parts)


def _results(table: Mapping[str, Summary], records: Mapping[str, Records]) -> str:
    """Headline table, sizes, and the marks' legend."""
    sizes = [
        [name, len(np.unique(records[name]["scene"])), _worlds(records[name]), len(records[name]["scene"]),
         ", ".join(str(s) for s in np.unique(records[name]["seed"]))]
        for name in table
    ]  # fmt: skip
    return "\n\n".join(
        [agent_metrics.markdown(table), marks(table), agent_metrics.grid(["Protocol", "Scenes", "Episodes", "Agents", "Seeds"], sizes)]
    )


def marks(table: Mapping[str, Summary]) -> str:
    """What the marks behind intervals mean, those that occur."""
    used = {estimate.method for column in table.values() for estimate in column.values()}
    notes = ["n: agents that enter a number. Intervals: bootstrap over scenes."]
    if agent_metrics.WILSON in used:
        notes.append("†: Wilson score interval over agents, where a rate does not vary between scenes (all, none, or one scene only).")
    if agent_metrics.NEWCOMBE in used:
        notes.append("†: Newcombe's score interval over agents, where a difference does not vary between scenes.")
    if agent_metrics.AGENTS in used:
        notes.append("‡: bootstrap over agents, where only one scene counts or a mean does not vary between scenes.")
    if used & {agent_metrics.WILSON, agent_metrics.NEWCOMBE, agent_metrics.AGENTS}:
        notes.append("Marked intervals take the agents of a scene for independent, so they may be too narrow.")
    return " ".join(notes)


def _comparison(name: str, other: str, summary: Mapping[str, Summary], records: Mapping[str, Records], *, bootstrap: int, seed: int) -> str:
    """Side by side with the paired difference."""
    change = agent_metrics.difference(records[other], records[name], bootstrap=bootstrap, seed=seed)
    table = {other: summary[other], name: summary[name], "difference": change}
    gain = change["success_rate"]
    verdict = "cannot be told from chance"
    if gain.low is not None and gain.high is not None and (gain.low > 0 or gain.high < 0):
        verdict = "is beyond what chance explains"
    lines = [
        f"### {name} against {other}",
        f"Both drove the same scenes. The change of the success rate, {agent_metrics.text(gain, signed=True)}, {verdict}. "
        "Differences are in percentage points for rates; their intervals resample scenes in pairs.",
        agent_metrics.markdown(table, signed=["difference"]),
        marks({"difference": change}),
    ]
    return "\n\n".join(lines)


def _conditions(records: Records, name: str, columns: Sequence[str], *, bootstrap: int, seed: int) -> str:
    """A table for each column that has more than one value: a row a value, rates across."""
    metrics = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate", "mean_time_to_goal_s")
    parts, seen = [], {}
    for column in columns:
        table = agent_metrics.breakdown(records, column, bootstrap=bootstrap, seed=seed)
        if len(table) < 2:
            continue
        shown = list(table)
        note = ""
        if len(shown) > _GROUPS:
            shown = sorted(shown, key=lambda value: table[value]["success_rate"].value or 0.0)[:_GROUPS]
            note = f"The {_GROUPS} of {len(table)} with the lowest success rate."
        rows = [[value, table[value]["success_rate"].count, *(agent_metrics.text(table[value][m]) for m in metrics)] for value in shown]
        header = [column, "Agents", *(METRICS[metric].label for metric in metrics)]
        parts += [f"### By {column} ({name})", *([note] if note else []), agent_metrics.grid(header, rows)]
        seen |= {f"{column}={value}": {metric: table[value][metric] for metric in metrics} for value in shown}
    return "\n\n".join([*parts, marks(seen)]) if parts else ""


def _failures(folder: Path, name: str, records: Records, drawn: Mapping[str, Path], numbers: Mapping[str, float]) -> str:
    """How agents ended or failed, the worst of each kind, and a list of those that did not reach their goal cleanly."""
    parts = [f"### {name}"]
    if "failure" in records:
        parts += [failures.table(records), failures.list_definitions(records, numbers), _worst(folder, name, records, drawn)]
    else:
        result = plots.outcomes(records)
        counts = [[outcome, int(np.sum(result == outcome)), f"{100 * np.mean(result == outcome):.1f} %"] for outcome in plots.OUTCOMES]
        parts.append(agent_metrics.grid(["Outcome", "Agents", "Share"], [row for row in counts if row[1]]))
    parts = [part for part in parts if part]
    rows = np.flatnonzero(~np.asarray(records["clean"], bool))
    if not len(rows):
        return "\n\n".join([*parts, "Every agent reached its goal without any other event."])
    place = ("scene", "world", "seed", "agent")
    share = {scene: np.mean(records["clean"][records["scene"] == scene]) for scene in np.unique(records["scene"][rows])}
    order = sorted(rows, key=lambda row: (share[records["scene"][row]], *(records[column][row] for column in place)))
    lines = [
        [*(records[column][row] for column in place), _story(records, int(row)), f"{records['time_s'][row]:.1f}",
         f"{records['end_distance_m'][row]:.1f} of {records['start_distance_m'][row]:.1f}", f"{records['max_drac'][row]:.1f}"]
        for row in order[:_FAILURES]
    ]  # fmt: skip
    header = ["Scene", "World", "Seed", "Agent", "What happened", "Driven, s", "Left to the goal, m", "Max DRAC, m/s²"]
    extent = f"all {len(rows)}" if len(rows) <= _FAILURES else f"{_FAILURES} of {len(rows)}, worst scenes first; the CSV has all"
    summary = f"<details><summary>Agents that did not arrive cleanly ({extent})</summary>"
    return "\n\n".join([*parts, summary, agent_metrics.grid(header, lines), "</details>"])


def _worst(folder: Path, name: str, records: Records, drawn: Mapping[str, Path]) -> str:
    """The pictures of the worst of each kind, folded."""
    if not drawn:
        return ""
    shown = [
        _show(folder, f"{failures.KINDS[kind].label}, {name}", drawn[kind]) for kind in failures.rank_failures(records) if kind in drawn
    ]
    if "film" in drawn:
        shown.append(_show(folder, f"The worst of each kind, {name}; clocks start where the film does", drawn["film"]))
    return "\n\n".join([f"<details><summary>The worst of each kind, side by side ({name})</summary>", *shown, "</details>"])


def _story(records: Records, row: int) -> str:
    """An agent's events in words."""
    past_events = [MARKS[event].label for event in MARKS if records[event][row]]
    if "failure" in records:
        kind = failures.KINDS[str(records["failure"][row])].label
        also = [event for event in past_events if event not in kind]
        return kind + (f"; also {', '.join(also)}" if also else "")
    return ", ".join(past_events) if past_events else "out of time"


def _definitions(table: Mapping[str, Summary], measured: Sequence[str]) -> str:
    """Every metric and protocol in a line."""
    lines = [f"- **{metric.label}**: {metric.definition}" for name, metric in METRICS.items() if any(name in c for c in table.values())]
    rules = [f"- **{name}**: {PROTOCOLS[name]}." for name in PROTOCOLS if any(name in label.split(", ") for label in measured)]
    note = (
        "DRAC treats cars as circles and the gap as at least 1 m, in every direction, so it is large for any two cars that pass closely; "
        "compare it between policies rather than with road data."
    )
    protocols = "How an episode is run:\n\n" + "\n".join(rules) if rules else ""
    return "\n\n".join(part for part in ("\n".join(lines), note, protocols) if part)


def _setup(config: Mapping[str, Any], versions: Mapping[str, str]) -> str:
    """Machine, versions, and the config's key numbers."""
    flat = flatten(config)
    rows = [[f"`{k}`", _shown(v)] for key in KEY_NUMBERS for k, v in flat.items() if k == key or k.startswith(key + ".")]
    parts = [
        agent_metrics.grid(["Machine and software", ""], [[name, value] for name, value in versions.items()]) if versions else "",
        agent_metrics.grid(["Setting", "Value"], rows) if rows else "",
    ]
    return "\n\n".join(part for part in parts if part)


def _commands(commands: Sequence[str]) -> str:
    return "To get these numbers again:\n\n```bash\n" + "\n".join(commands) + "\n```" if commands else ""


def _links(folder: Path, files: Mapping[str, Path]) -> str:
    return "\n".join(f"- [{caption}]({_relative(folder, path)})" for caption, path in files.items())


def _whole(config: Mapping[str, Any]) -> str:
    """The resolved config, folded."""
    lines = "\n".join(f"{key}: {_shown(value)}" for key, value in flatten(config).items())
    return f"<details><summary>The whole configuration</summary>\n\n```\n{lines}\n```\n\n</details>" if lines else ""


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys of a nested mapping."""
    result = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        result.update(flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value})
    return result


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _show(folder: Path, caption: str, path: Path) -> str:
    """A picture with its caption, or a link to a film that Markdown cannot show."""
    link = _relative(folder, path)
    return f"[{caption}]({link})" if path.suffix == ".mp4" else f"![{caption}]({link})\n\n*{caption}*"


def _relative(folder: Path, path: Path) -> str:
    """The link from the report to a file, with blanks escaped."""
    return Path(os.path.relpath(path, folder)).as_posix().replace(" ", "%20")


def _worlds(records: Records) -> int:
    """How many episodes the records hold."""
    return len(set(zip(records["scene"].tolist(), records["world"].tolist(), records["seed"].tolist(), strict=True)))


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
