"""Writes NAME.md of a study, from its result.json and its interpretation.md: question, results with intervals, and how to repeat them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core import markdown
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import document, plots, study_figures, tables
from scenefactory_jax.visualization.report.policy_comparison import LEVEL
from scenefactory_jax.visualization.report.tables import PROTOCOLS, format_estimate, read_estimates

Result = Mapping[str, Any]

RATES = ("success_rate", "clean_success_rate", "clean_bend_rate", "collision_rate", "road_edge_rate", "crash_rate", "unfinished_rate")
SAFETY = ("mean_max_drac", "high_drac_rate", "mean_min_ttc_s", "min_ttc_s", "near_miss_rate", "mean_time_to_goal_s", "yaw_acceleration",
          "friction_utilization", "stopping_margin_m")  # fmt: skip
CHANGES = ("success_rate", "clean_success_rate", "collision_rate", "road_edge_rate", "crash_rate", "mean_max_drac")
GROUPS = {"spawning": "Starts", "weather": "Weather", "traffic": "Background traffic", "dynamics": "Dynamics"}  # of an episode
AS_TRAINED = "as trained"
LABELS = {name: metric.label for name, metric in METRICS.items()}
LABELS |= {"success_rate": "success", "clean_success_rate": "without any other event", "collision_rate": "collisions"}
HOLM = f"\\*: below {LEVEL:g} after Holm's correction for all comparisons of the same metric, {{family}} and protocol."
SINGLE = " With one seed they are differences of these trained policies; another training of the same kind may differ by more."
INTERPRETATION = "interpretation.md"  # of the result; written by a person


def write(folder: Path, result: Result) -> Path:
    """Writes `folder`/NAME.md, which includes `folder`/interpretation.md, and its figures, and returns the path of the report."""
    study, interpretation = result["study"], folder / INTERPRETATION
    chosen = study.get("metrics")
    known = [name for name in chosen or (*RATES, *SAFETY) if any(name in row["pooled"] for row in result["rows"])]
    figures = study_figures.draw_all(result).items()
    pictures = {caption: plots.save(figure, folder / f"{name}.png") for caption, (name, figure) in figures}
    return document.write(
        folder / f"{study['name']}.md",
        f"# {study['name'].replace('_', ' ').capitalize()}",
        study["question"],
        interpretation.read_text().strip() if interpretation.is_file() else "",
        format_headline(result),
        _format_missing(result["missing"]),
        *(document.picture(folder, path, caption) for caption, path in pictures.items()),
        document.section("Results", *_results(result, folder)),
        document.section("Differences", *_differences(result["differences"], chosen or CHANGES)),
        document.section("Differences of conditions", *_differences(result.get("drops", []), chosen or CHANGES, family="row")),
        document.section("Each seed", document.fold("Values of each seed", _each_seed(result["rows"], chosen or RATES))),
        document.section("Trainings", *_trainings(result)),
        document.section("Scenes, and how often they were evaluated", *_scenes(result)),
        document.section("Definitions", tables.define_metrics(known)),
        document.section("How to repeat it", *_settings(result)),
    )


def format_headline(result: Result) -> str:
    """Formats the most important metrics of every variant, under the first condition and protocol that it was evaluated under."""
    lines = []
    for name in result["study"]["trainings"]:
        row = next((row for row in result["rows"] if row["row"] == name), None)
        if row:
            size = f"{document.count(len(row['seeds']), 'seed')} x {row['agents']} agents"
            known = [metric for metric in study_figures.list_headline(result["study"]) if metric in row["pooled"]]
            rates = ", ".join(f"{LABELS[metric]} {format_estimate(Estimate(**row['pooled'][metric]))}" for metric in known)
            lines.append(f"- **{name}** ({row['condition']}, {row['protocol']}; {size}): {rates}")
    return "\n".join(lines) or "Nothing is evaluated yet."


def _format_missing(missing: Sequence[str]) -> str:
    shown = "; ".join(missing[:6]) + ("; ..." if len(missing) > 6 else "")
    return f"**Not complete**: {len(missing)} trainings and evaluations are missing ({shown})." if missing else ""


# ---- results


def _results(result: Result, folder: Path) -> list[str]:
    """A table of rates and one of safety for each protocol, and links to the tables of agents that stand in `folder`."""
    parts, chosen = [], result["study"].get("metrics")
    for protocol in dict.fromkeys(row["protocol"] for row in result["rows"]):
        rows = [row for row in result["rows"] if row["protocol"] == protocol]
        cells = [([row["row"], row["condition"], f"{len(row['seeds'])} x {row['agents']}"], read_estimates(row["pooled"])) for row in rows]
        if rows:
            parts.append(f"### {protocol}: {PROTOCOLS.get(protocol, 'see conf/termination')}")
            groups = (chosen,) if chosen else (RATES, SAFETY)
            parts += [tables.format_rows(["", "Condition", "n"], cells, metrics) for metrics in groups]
    note = (
        "n: seeds x agents. Brackets: 95 % intervals that resample seeds of training, scenes, and agents within a scene; with one seed "
        "they resample scenes and agents alone, with few seeds they are too narrow. †: Wilson's or Newcombe's score interval over "
        "distinct agents, where a rate does not vary."
    )
    return [_episodes(result["study"]), *parts, note, _agents(result["rows"], folder)] if parts else []


def _agents(rows: Sequence[Mapping[str, Any]], folder: Path) -> str:
    """Links to the tables of agents that stand in `folder`."""
    rows = [row for row in rows if "agents_file" in row and (folder / row["agents_file"]).is_file()]
    if not rows:
        return "The tables of agents were not kept."
    places = ", ".join(f"[{row['row']}, {row['condition']}, {row['protocol']}]({row['agents_file']})" for row in rows)
    return f"Every agent with its events, one table a row, condition and protocol (CSV, `pandas.read_csv` opens it): {places}."


def _episodes(study: Mapping[str, Any]) -> str:
    """The options of `conf/` that decide the episodes of each condition: of each group the last that the overrides name."""
    cells, varied = [], {override.partition("=")[0] for overrides in study["trainings"].values() for override in overrides}
    common = [override for override in study["common"] if override.partition("=")[0] not in varied]
    for name, overrides in study["conditions"].items():
        chosen = dict(override.partition("=")[::2] for override in [*common, *study["evaluation_overrides"], *overrides])
        cells.append([name, *(chosen.get(group, AS_TRAINED) for group in GROUPS)])
    return "Episodes of each condition:\n\n" + markdown.format_table(["Condition", *GROUPS.values()], cells)


def _differences(changes: Sequence[Mapping[str, Any]], metrics: Sequence[str], *, family: str = "condition") -> list[str]:
    """A table of differences within each condition, or within each row."""
    if not changes:
        return []
    cells = [([entry[key] for key in ("before", "after", family, "protocol")], read_estimates(entry["change"])) for entry in changes]
    intervals, without_zero = count_intervals(changes, metrics)
    has_p = any(entry["change"].get(name, {}).get("p") is not None for entry in changes for name in metrics)
    text = (
        "The second less the first, on the same scenes, cars and seeds. If all true differences were zero, about one 95 % interval in "
        f"twenty would still exclude zero: {intervals / 20:.1f} of the {intervals} in this table. {without_zero} of them do. "
        + (HOLM.format(family=family) if has_p else "No correction for multiple comparisons is applied.")
        + (SINGLE if family == "condition" and all(max(entry["seeds"]) == 1 for entry in changes) else "")
    )
    findings = find_findings(changes, metrics, family=family)
    return [text, tables.format_rows(["From", "To", family.capitalize(), "Protocol"], cells, metrics, signed=True, findings=findings)]


def find_findings(changes: Sequence[Mapping[str, Any]], metrics: Sequence[str], *, family: str = "condition") -> set[tuple[int, str]]:
    """Finds the differences, as (place in `changes`, metric), that are below LEVEL after Holm's correction in their family: those of the
    same metric, condition (or row) and protocol."""
    families: dict[tuple[str, ...], dict[tuple[int, str], float]] = {}
    for place, entry in enumerate(changes):
        for name in metrics:
            if (p := entry["change"].get(name, {}).get("p")) is not None:
                families.setdefault((name, entry[family], entry["protocol"]), {})[place, name] = p
    adjusted = [item for family in families.values() for item in statistics.adjust_holm(family).items()]
    return {key for key, p in adjusted if p < LEVEL}


def count_intervals(changes: Sequence[Mapping[str, Any]], metrics: Sequence[str] = CHANGES) -> tuple[int, int]:
    """Counts the intervals in the table of differences, and those of them that exclude zero."""
    found = [entry["change"][name] for entry in changes for name in metrics if name in entry["change"]]
    ends = [(estimate["low"], estimate["high"]) for estimate in found]
    ends = [(low, high) for low, high in ends if low is not None and high is not None]
    return len(ends), sum(low > 0 or high < 0 for low, high in ends)


def _each_seed(rows: Sequence[Mapping[str, Any]], metrics: Sequence[str]) -> str:
    cells = []
    for row in rows:
        for seed, values in row["each"].items():
            shown = [_format_value(name, values.get(name)) for name in metrics]
            cells.append([row["row"], row["condition"], row["protocol"], seed, *shown])
    header = ["", "Condition", "Protocol", "Seed", *(METRICS[name].label for name in metrics)]
    return markdown.format_table(header, cells) if cells else ""


def _format_value(name: str, value: float | None) -> str:
    return "" if value is None else format_estimate(Estimate(value, None, None, 1, METRICS[name].unit, statistics.NONE))


# ---- trainings


def _trainings(result: Result) -> list[str]:
    """Durations, and when held-out success reached the target."""
    cells = []
    for variant, trained in result["trainings"].items():
        for seed, run in trained["runs"].items():
            scenes = "" if run["scenes"] is None else f"{run['scenes']} ({run['agents']} agents)"
            driven = "" if run.get("hours") is None else f"{run['hours']:,.1f}"
            duration = _steps(run["steps"]), driven, f"{run['minutes']:.1f}", f"{run['casps']:,.0f}"
            cells.append([variant, seed, scenes, run["iterations"], *duration, run["device"], f"`{run['commit']}`"])
    if not cells:
        return []
    header = ["", "Seed", "Scenes", "Iterations", "Agent steps", "Hours driven", "Minutes", "Steps/s", "Device", "Commit"]
    total = sum(run["minutes"] for trained in result["trainings"].values() for run in trained["runs"].values())
    text = (
        f"{total:.0f} minutes of training in all. Minutes are those of iterations, as `minutes` counts them. "
        "Agent steps are control steps of spawned slots, hours those that they drove; of the steps a second, the median."
    )
    return [text, markdown.format_table(header, cells), _to_target(result)]


def _to_target(result: Result) -> str:
    cells = [
        [variant, protocol, seed, *(_moment(curve[name]) for name in ("to_target", "to_final", "last"))]
        for variant, trained in result["trainings"].items()
        for protocol, seeds in trained["held_out"].items()
        for seed, curve in seeds.items()
    ]
    first = f"First at {100 * result['settings']['target']:.1f} % or more"
    table = markdown.format_table(["", "Protocol", "Seed", first, "First at its last value or more", "Last"], cells)
    return f"Held-out success while training, under the first condition:\n\n{table}" if cells else ""


def _moment(point: Mapping[str, float | int] | None) -> str:
    if not point:
        return "not reached"
    return f"{100 * point['success']:.1f} % after {point['minutes']:.1f} min, {_steps(point['steps'])} steps"


def _steps(count: float | int) -> str:
    return f"{count / 1e6:.1f} M" if count >= 1e6 else f"{count / 1e3:.1f} k"


# ---- scenes and settings


def _scenes(result: Result) -> list[str]:
    cut, scenes, uses = result["settings"]["cut"], result["scenes"], result["held_out_uses"]
    kind = {
        "test": "the test scenes.",
        "validation": "**a validation cut of the training scenes**: these numbers choose settings and are no test.",
    }[cut]
    policies, points = (sum(use[name] for use in uses if use["cut"] == cut) for name in ("policies", "curve points"))
    cells = [
        [use["date"], use["cut"], use["policies"], use["curve points"], f"{use['seconds'] / 60:.1f}", f"`{use['command']}`"] for use in uses
    ]
    table = markdown.format_table(["Date", "Cut", "Policies", "Points of learning curves", "Minutes", "Command"], cells) if cells else ""
    counted = (
        f"This study evaluated them {policies} times for a policy (under one condition and protocol) and "
        f"{points} times for a point of a learning curve, in all calls below. Other studies and commands are not counted."
    )
    return [f"Trained on {scenes['train_scenes']}, evaluated on {scenes['test_scenes']}: {kind}", counted, table]


def _settings(result: Result) -> list[str]:
    study, cut = result["study"], result["settings"]["cut"]
    command = f"study study={study['name']} {'' if cut == 'test' else f'cut={cut} '}train_scenes=... test_scenes=..."
    code = lambda overrides: " ".join(f"`{override}`" for override in overrides)  # noqa: E731
    variants = [[name, code(trained["overrides"])] for name, trained in result["trainings"].items()]
    conditions = [[name, code([*study["evaluation_overrides"], *overrides])] for name, overrides in study["conditions"].items()]
    baselines = [[name, f"untrained, {entry['of']} {code(entry['overrides'])}".strip()] for name, entry in study["baselines"].items()]
    given = study.get("policies", {}).items()
    policies = [[name, f"{Path(entry['run']).name} {code(entry['overrides'])}".strip()] for name, entry in given]
    seeds = sorted({int(seed) for trained in result["trainings"].values() for seed in trained["runs"]})
    settings = ", ".join(f"{name} {value}" for name, value in result["settings"]["evaluation"].items())
    return [
        f"```\npython -m scenefactory_jax {command}\n```",
        f"Seeds of training: {', '.join(map(str, seeds)) or 'none yet'}. "
        f"Evaluation: one deterministic episode a scene and repeat; {settings}.",
        markdown.format_table(["Variant", "Overrides of `train`, beside those of where its scenes lie"], variants),
        markdown.format_table(["Condition", "Overrides of `evaluate`"], conditions),
        markdown.format_table(["Baseline", "What it is"], baselines) if baselines else "",
        markdown.format_table(["Policy", "What it is"], policies) if policies else "",
        markdown.format_table(["The report was made with", ""], list(result["made_with"].items())),
    ]
