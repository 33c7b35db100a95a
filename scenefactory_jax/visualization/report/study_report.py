"""NAME.md of a study, from its result.json and its interpretation.md: question, results with intervals, and how to repeat them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import plots, study_figures, tables
from scenefactory_jax.visualization.report.evaluation_report import PROTOCOLS

Result = Mapping[str, Any]

RATES = ("success_rate", "clean_success_rate", "clean_bend_rate", "collision_rate", "road_edge_rate", "crash_rate", "unfinished_rate")
SAFETY = ("mean_max_drac", "high_drac_rate", "mean_min_ttc_s", "min_ttc_s", "near_miss_rate", "mean_time_to_goal_s", "yaw_acceleration",
          "friction_utilization", "stopping_margin_m")  # fmt: skip
CHANGES = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate", "mean_max_drac")
GROUPS = {"spawning": "Starts", "weather": "Weather", "traffic": "Background traffic", "dynamics": "Dynamics"}  # of an episode
AS_TRAINED = "as trained"
INTERPRETATION = "interpretation.md"  # what the result shows and what it does not, written by hand


def write(folder: Path, result: Result) -> Path:
    """Writes `folder`/NAME.md, which includes `folder`/interpretation.md, and its figures, and returns the path of the report."""
    study, interpretation = result["study"], folder / INTERPRETATION
    figures = study_figures.draw_all(result).items()
    pictures = {caption: plots.save(figure, folder / f"{name}.png") for caption, (name, figure) in figures}
    parts = [
        f"# {study['name'].replace('_', ' ').capitalize()}",
        study["question"], interpretation.read_text().strip() if interpretation.is_file() else "", format_headline(result),
        _format_missing(result["missing"]),
        *(f"![{caption}]({path.name})\n\n*{caption}*" for caption, path in pictures.items()),
        _section("Results", *_results(result)),
        _section("Differences", *_differences(result["differences"])),
        _section("Each seed", _each_seed(result["rows"])),
        _section("Trainings", *_trainings(result)),
        _section("Scenes, and how often they were evaluated", *_scenes(result)),
        _section("Definitions", _meaning(result)),
        _section("How to repeat it", *_again(result)),
    ]  # fmt: skip
    path = folder / f"{study['name']}.md"
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return path


def format_headline(result: Result) -> str:
    """Formats success and collisions of every variant, under the first condition and protocol that it was evaluated under."""
    lines = []
    for name in result["study"]["trainings"]:
        row = next((row for row in result["rows"] if row["row"] == name), None)
        if row:
            success, clean, collisions = (tables.format_estimate(Estimate(**row["pooled"][metric])) for metric in study_figures.HEADLINE)
            size = f"{_many(len(row['seeds']), 'seed')} x {row['agents']} agents"
            rates = f"success {success}, without any other event {clean}, collisions {collisions}"
            lines.append(f"- **{name}** ({row['condition']}, {row['protocol']}; {size}): {rates}")
    return "\n".join(lines) or "Nothing is evaluated yet."


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _section(title: str, *parts: str) -> str:
    body = "\n\n".join(part for part in parts if part)
    return f"## {title}\n\n{body}" if body else ""


def _format_missing(missing: Sequence[str]) -> str:
    if not missing:
        return ""
    shown = "; ".join(missing[:6]) + ("; ..." if len(missing) > 6 else "")
    return f"**Not complete**: {len(missing)} trainings and evaluations are missing ({shown})."


# ---- tables


def _results(result: Result) -> list[str]:
    """A table of rates and one of safety for each protocol."""
    parts = []
    for protocol in result["study"]["protocols"]:
        rows = [row for row in result["rows"] if row["protocol"] == protocol]
        if rows:
            parts += [f"### {protocol}: {PROTOCOLS.get(protocol, 'see conf/termination')}", _table(rows, RATES), _table(rows, SAFETY)]
    note = (
        "n: seeds x agents. Brackets: 95 % intervals that resample seeds of training, scenes, and agents within a scene; with one seed "
        "they resample scenes and agents alone, with few seeds they are too narrow. †: Wilson's or Newcombe's score interval over "
        "distinct agents, where a rate does not vary."
    )
    return [_episodes(result["study"]), *parts, note, _agents(result["rows"])] if parts else []


def _agents(rows: Sequence[Mapping[str, Any]]) -> str:
    """Links to the tables of agents."""
    if not any("agents_file" in row for row in rows):
        return "The tables of agents were not kept."
    places = ", ".join(f"[{row['row']}, {row['condition']}, {row['protocol']}]({row['agents_file']})" for row in rows)
    return f"Every agent with its events, one table a row, condition and protocol (CSV, `pandas.read_csv` opens it): {places}."


def _episodes(study: Mapping[str, Any]) -> str:
    """The options of `conf/` that decide the episodes of each condition: of each group the last that the overrides name."""
    cells, varied = [], {override.partition("=")[0] for own in study["trainings"].values() for override in own}
    common = [override for override in study["common"] if override.partition("=")[0] not in varied]
    for name, own in study["conditions"].items():
        chosen = dict(override.partition("=")[::2] for override in [*common, *study["evaluation_overrides"], *own])
        cells.append([name, *(chosen.get(group, AS_TRAINED) for group in GROUPS)])
    return "Episodes of each condition:\n\n" + markdown.format_table(["Condition", *GROUPS.values()], cells)


def _table(rows: Sequence[Mapping[str, Any]], metrics: Sequence[str]) -> str:
    shown = {name: METRICS[name] for name in metrics if any(name in row["pooled"] for row in rows)}
    cells = []
    for row in rows:
        estimates = [row["pooled"].get(name) for name in shown]
        texts = ["" if one is None else tables.format_estimate(Estimate(**one)) for one in estimates]
        cells.append([row["row"], row["condition"], f"{len(row['seeds'])} x {row['agents']}", *texts])
    return markdown.format_table(["", "Condition", "n", *(metric.label for metric in shown.values())], cells)


def _differences(found: Sequence[Mapping[str, Any]]) -> list[str]:
    if not found:
        return []
    labels = {name: METRICS[name] for name in CHANGES}
    cells = [
        [one["before"], one["after"], one["condition"], one["protocol"],
         *(tables.format_estimate(Estimate(**one["change"][name]), signed=True) for name in labels)]
        for one in found
    ]  # fmt: skip
    intervals, without_zero = count_intervals(found)
    words = (
        "The second less the first, on the same scenes, cars and seeds. If all true differences were zero, about one 95 % interval in "
        f"twenty would still exclude zero: {intervals / 20:.1f} of the {intervals} in this table. {without_zero} of them do. No correction "
        "for multiple comparisons is applied."
    )
    return [words, markdown.format_table(["From", "To", "Condition", "Protocol", *(metric.label for metric in labels.values())], cells)]


def count_intervals(found: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Counts the intervals in the table of differences, and those of them that exclude zero."""
    shown = [Estimate(**one["change"][name]) for one in found for name in CHANGES]
    ends = [(one.low, one.high) for one in shown if one.low is not None and one.high is not None]
    return len(ends), sum(low > 0 or high < 0 for low, high in ends)


def _each_seed(rows: Sequence[Mapping[str, Any]]) -> str:
    cells = []
    for row in rows:
        for seed, values in row["each"].items():
            rates = ["" if values[name] is None else f"{100 * values[name]:.1f} %" for name in RATES]
            cells.append([row["row"], row["condition"], row["protocol"], seed, *rates])
    header = ["", "Condition", "Protocol", "Seed", *(METRICS[name].label for name in RATES)]
    return f"<details><summary>Rates of each seed</summary>\n\n{markdown.format_table(header, cells)}\n\n</details>" if cells else ""


def _trainings(result: Result) -> list[str]:
    """Durations, and when held-out success reached the target."""
    cells, target = [], result["settings"]["target"]
    for variant, trained in result["trainings"].items():
        for seed, run in trained["runs"].items():
            scenes = "" if run["scenes"] is None else f"{run['scenes']} ({run['agents']} agents)"
            duration = _steps(run["steps"]), f"{run['minutes']:.1f}", f"{run['casps']:,.0f}"
            cells.append([variant, seed, scenes, run["iterations"], *duration, run["device"], f"`{run['commit']}`"])
    if not cells:
        return []
    header = ["", "Seed", "Scenes", "Iterations", "Agent steps", "Minutes", "Steps/s", "Device", "Commit"]
    total = sum(run["minutes"] for trained in result["trainings"].values() for run in trained["runs"].values())
    words = (
        f"{total:.0f} minutes of training in all. Minutes are those of iterations; the first run of a program compiles it in its first "
        "iteration. Agent steps are control steps of spawned slots; of the steps a second, the median over iterations."
    )
    return [words, markdown.format_table(header, cells), _to_target(result, target)]


def _to_target(result: Result, target: float) -> str:
    cells = []
    for variant, trained in result["trainings"].items():
        for protocol, seeds in trained["held_out"].items():
            for seed, curve in seeds.items():
                moments = [_moment(curve[name]) for name in ("to_target", "to_final", "last")]
                cells.append([variant, protocol, seed, *moments])
    if not cells:
        return ""
    header = ["", "Protocol", "Seed", f"First at {100 * target:.1f} % or more", "First at its last value or more", "Last"]
    return "Held-out success while training, under the first condition:\n\n" + markdown.format_table(header, cells)


def _moment(found: Mapping[str, float | int] | None) -> str:
    if not found:
        return "not reached"
    return f"{100 * found['success']:.1f} % after {found['minutes']:.1f} min, {_steps(found['steps'])} steps"


def _steps(count: float | int) -> str:
    return f"{count / 1e6:.1f} M" if count >= 1e6 else f"{count / 1e3:.1f} k"


# ---- scenes and settings


def _scenes(result: Result) -> list[str]:
    cut, scenes = result["settings"]["cut"], result["scenes"]
    named = f"Trained on {scenes['train_scenes']}, evaluated on {scenes['test_scenes']}"
    kind = {
        "test": "the test scenes.",
        "validation": "**a validation cut of the training scenes**: these numbers choose settings and are no test.",
    }[cut]
    uses = result["held_out_uses"]
    times = {name: sum(use[name] for use in uses if use["cut"] == cut) for name in ("policies", "curve points")}
    shown = ("date", "cut", "policies", "curve points")
    cells = [[*(use[name] for name in shown), f"{use['seconds'] / 60:.1f}", f"`{use['command']}`"] for use in uses]
    table = markdown.format_table(["Date", "Cut", "Policies", "Points of learning curves", "Minutes", "Command"], cells) if cells else ""
    counted = (
        f"This study evaluated them {times['policies']} times for a policy (under one condition and protocol) and "
        f"{times['curve points']} times for a point of a learning curve, in all calls below. Other studies and commands are not counted."
    )
    return [f"{named}: {kind}", counted, table]


def _meaning(result: Result) -> str:
    shown = {name: METRICS[name] for name in (*RATES, *SAFETY) if any(name in row["pooled"] for row in result["rows"])}
    return "\n".join(f"- **{metric.label}**: {metric.definition}" for metric in shown.values())


def _again(result: Result) -> list[str]:
    study, made = result["study"], result["made_with"]
    cut = "" if result["settings"]["cut"] == "test" else f"cut={result['settings']['cut']} "
    text = ["```", f"python -m scenefactory_jax study study={study['name']} {cut}train_scenes=... test_scenes=...", "```"]
    variants = [[name, " ".join(f"`{x}`" for x in trained["overrides"])] for name, trained in result["trainings"].items()]
    conditions = [[name, " ".join(f"`{x}`" for x in [*study["evaluation_overrides"], *own])] for name, own in study["conditions"].items()]
    baselines = [
        [name, " ".join([f"untrained, {one['of']}", *(f"`{x}`" for x in one["overrides"])])] for name, one in study["baselines"].items()
    ]
    seeds = sorted({int(seed) for trained in result["trainings"].values() for seed in trained["runs"]})
    settings = ", ".join(f"{name} {value}" for name, value in result["settings"]["evaluation"].items())
    return [
        "\n".join(text),
        f"Seeds of training: {', '.join(map(str, seeds)) or 'none yet'}. "
        f"Evaluation: one deterministic episode a scene and repeat; {settings}.",
        markdown.format_table(["Variant", "Overrides of `train`, beside those of where its scenes lie"], variants),
        markdown.format_table(["Condition", "Overrides of `evaluate`"], conditions),
        markdown.format_table(["Baseline", "What it is"], baselines) if baselines else "",
        markdown.format_table(["The report was made with", ""], [[name, value] for name, value in made.items()]),
    ]
