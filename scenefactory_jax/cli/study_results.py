"""Results of a study, read from the folders of its runs: estimates with intervals, durations and versions."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.cli import study_plan
from scenefactory_jax.cli.study_plan import Plan
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import read_records, write_records
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import study_report
from scenefactory_jax.visualization.report.study_figures import CURVES

RESULT = "result.json"
POINTS = 120  # of a learning curve
DIGITS = 5
AGENTS = "agents"  # folder of the tables of agents
RowKey = tuple[str, str, str]  # row, condition, protocol
RowRecords = dict[RowKey, dict[int, dict[str, np.ndarray]]]  # -> seed of training -> records
REDRAWN = ("question", "figures", "trend", "metrics")  # keys of a study that decide no number


def find_folder(config: Mapping[str, Any]) -> Path:
    """Returns the folder of a study's result and report."""
    return Path(config["out"] or Path("experiments") / config["study"]["name"])


def write(plan: Plan, config: Mapping[str, Any], out: Path, *, before: Mapping[str, Any]) -> dict[str, Any]:
    """Collects the results and writes result.json, NAME.md, figures and tables of agents to `out`.

    Nothing is written if nothing is evaluated and `before` holds results of other runs.
    """
    records = _read_rows(plan)
    result = collect(plan, config, records) | {"held_out_uses": before.get("held_out_uses", [])}
    if before.get("rows") and not result["rows"]:
        print(f"no evaluation of this study in {config['runs']}: {out / RESULT} and its report are not changed", flush=True)
        return dict(before)
    result = _name_banks(result_file.plain(result, digits=DIGITS), config["banks"])
    out.mkdir(parents=True, exist_ok=True)
    _write_agents(out, records, digest=result_file.digest({name: config[name] for name in ("study", "evaluation", "protocol")}))
    result_file.write(out / RESULT, result, digits=DIGITS)
    print(f"{study_report.format_headline(result)}\n\nreport {study_report.write(out, result)}", flush=True)
    return result


def _name_banks(value: Any, banks: Mapping[str, Any]) -> Any:
    """Plain values in which an override that gives a bank gives it by its name, without the path on this machine."""
    if isinstance(value, dict):
        return {key: _name_banks(item, banks) for key, item in value.items()}
    if isinstance(value, list):
        return [_name_banks(item, banks) for item in value]
    if isinstance(value, str):
        for name, path in banks.items():
            if value.endswith(f"={path}"):
                return f"{value.removesuffix(str(path))}${{banks.{name}}}"
    return value


def draw(config: Mapping[str, Any]) -> dict[str, Any]:
    """Writes NAME.md and figures again from result.json, with the question and figures of the config; the numbers stay.

    Raises:
        ConfigError: a wrong key of the study; no result.json.
    """
    study_plan.check(config)
    out = find_folder(config)
    if not (out / RESULT).is_file():
        raise ConfigError(f"out: {RESULT} not found in {out}; expected a folder that the part `report` has written")
    result = result_file.read(out / RESULT)
    result["study"] |= {name: config["study"][name] for name in REDRAWN}
    result_file.write(out / RESULT, result, digits=DIGITS)
    print(f"report {study_report.write(out, result)}", flush=True)
    return result


def _read_rows(plan: Plan) -> RowRecords:
    """The records of every evaluation that is done; a row without any has no seeds."""
    rows: RowRecords = {}
    for evaluation in plan.evaluations:
        runs = rows.setdefault((evaluation.row, evaluation.condition, evaluation.protocol), {})
        if evaluation.file.is_file():
            runs[evaluation.training.seed] = read_records(evaluation.file)
    return rows


def _write_agents(out: Path, records: RowRecords, *, digest: str) -> None:
    """Writes a table of all agents for each row, condition and protocol, with all seeds of training; earlier tables are removed.

    Args:
        digest: of the study's config.
    """
    for file in [*(out / AGENTS).glob("*.csv.xz"), *(out / AGENTS).glob("*.parquet")]:
        file.unlink()
    for key, runs in records.items():
        if runs:
            (out / AGENTS).mkdir(exist_ok=True)
            seeds = np.concatenate([np.full(len(rows["scene"]), seed) for seed, rows in runs.items()])
            columns = {name: _round(np.concatenate([rows[name] for rows in runs.values()])) for name in next(iter(runs.values()))}
            metadata = dict(zip(("policy", "condition", "protocol"), key, strict=True))
            metadata |= {"config_digest": digest, "versions": run_config.versions()}
            write_records(out / _agents_file(key), {"training_seed": seeds, **columns}, metadata=metadata)


def _agents_file(key: RowKey) -> str:
    return f"{AGENTS}/{'--'.join(study_plan.slug(name) for name in key)}.csv.xz"


def _round(column: np.ndarray) -> np.ndarray:
    return np.array([float(f"{value:.{DIGITS}g}") for value in column]) if column.dtype.kind == "f" else column


def collect(plan: Plan, config: Mapping[str, Any], records: RowRecords) -> dict[str, Any]:
    """Collects the content of the report, as plain values.

    Returns:
        study: its config; scenes: names of the sources; missing: what of `only` is not trained or evaluated yet; rows: one for each row,
        condition and protocol; differences; drops: of conditions; trainings: variant -> durations, versions and curves.
    """
    study, settings, chosen = config["study"], config["evaluation"], plan.choose(config["only"])
    resampling = {"bootstrap": settings["bootstrap"], "seed": settings["seed"]}
    scenes = {name: config[name] and Path(config[name]).name for name in ("train_scenes", "test_scenes")}
    return {
        "study": {**study, "evaluation_overrides": study_plan.list_evaluation_overrides(config)},
        "settings": {name: config[name] for name in ("seeds", "common", "cut", "target", "evaluation")},
        "scenes": {name: scene or "the recipe's own" for name, scene in scenes.items()},
        "missing": [task.label for task in (*chosen.trainings, *chosen.evaluations) if not task.file.is_file()],
        "rows": [_summarise(key, runs, resampling, study["metrics"]) for key, runs in records.items() if runs],
        "differences": _restrict(_compare(study["compare"], records, resampling), study["metrics"]),
        "drops": _restrict(_compare_conditions(study["drops"], records, resampling), study["metrics"]),
        "trainings": {variant: _describe_trainings(variant, plan, config["target"]) for variant in study["trainings"]},
        "made_with": {"commit": run_config.find_commit(), **run_config.versions()},
    }


def _summarise(key: RowKey, runs: statistics.Runs, resampling: Mapping[str, int], metrics: list[str] | None) -> dict[str, Any]:
    each = statistics.summarise_each_run(runs)
    first = next(iter(runs.values()))
    return {
        **dict(zip(("row", "condition", "protocol"), key, strict=True)), "seeds": list(runs), "agents": len(first["scene"]),
        "scenes": len(np.unique(first["scene"])), "agents_file": _agents_file(key),
        "friction": float(np.mean([records["friction"].mean() for records in runs.values()])),
        "pooled": _choose(statistics.summarise_runs(runs, **resampling), metrics),
        "each": {seed: _choose(values, metrics) for seed, values in each.items()},
    }  # fmt: skip


def _restrict(changes: list[dict[str, Any]], metrics: list[str] | None) -> list[dict[str, Any]]:
    return [{**entry, "change": _choose(entry["change"], metrics)} for entry in changes]


def _choose(values: Mapping[str, Any], metrics: list[str] | None) -> dict[str, Any]:
    """The values of the study's own metrics, if it has any: those of all metrics, which nothing shows, are most of a large file."""
    return {name: value for name, value in values.items() if metrics is None or name in metrics}


def _compare(pairs: Iterable[list[str]], records: RowRecords, resampling: Mapping[str, int]) -> list[dict[str, Any]]:
    """The differences of every pair under each condition and protocol in which both were evaluated, on the seeds that both have."""
    differences = []
    for before, after in pairs:
        for (row, condition, protocol), old in records.items():
            new = records.get((after, condition, protocol), {})
            if row != before or not old or not new:
                continue
            if shared := [seed for seed in old if seed in new]:
                old, new = ({seed: runs[seed] for seed in shared} for runs in (old, new))
            key = {"before": before, "after": after, "condition": condition, "protocol": protocol, "seeds": [len(old), len(new)]}
            differences.append({**key, "change": statistics.difference_of_runs(old, new, **resampling)})
    return differences


def _compare_conditions(pairs: Iterable[list[str]], records: RowRecords, resampling: Mapping[str, int]) -> list[dict[str, Any]]:
    """The differences of every pair of conditions in each row that was evaluated under both, with the same seeds."""
    drops = []
    for before, after in pairs:
        for (row, condition, protocol), old in records.items():
            new = records.get((row, after, protocol), {})
            if condition == before and old and list(old) == list(new):
                key = {"before": before, "after": after, "row": row, "protocol": protocol}
                drops.append({**key, "change": statistics.difference_of_runs(old, new, **resampling)})
    return drops


# ---- trainings


def _describe_trainings(variant: str, plan: Plan, target: float) -> dict[str, Any]:
    """Durations and curves of a variant's seeds."""
    trainings = [training for training in plan.trainings if training.variant == variant]
    ended = {training.seed: training for training in trainings if training.file.is_file()}
    notes = {seed: result_file.read(training.file) for seed, training in ended.items()}
    metrics = {seed: metrics_csv.read(training.folder) for seed, training in ended.items()}
    held_out: dict[str, dict[int, dict[str, Any]]] = {}
    for seed, training in ended.items():
        rows, programs = metrics_csv.read(training.folder, metrics_csv.EVALUATIONS), notes[seed].get("watched", {})
        for evaluation in study_plan.evaluations_while_training(plan, training):
            if rows and programs.get(evaluation.protocol) == evaluation.program:  # another study may have evaluated another condition
                held_out.setdefault(evaluation.protocol, {})[seed] = _held_out_curve(rows, evaluation.protocol, target)
    return {
        "overrides": [override for override in trainings[0].overrides if "path=" not in override],  # without paths of this machine
        "digests": {training.seed: training.digest for training in trainings},
        "runs": {seed: _describe_run(note, metrics[seed]) for seed, note in notes.items()},
        "curves": _curves(metrics),
        "held_out": held_out,
    }


def _describe_run(note: Mapping[str, Any], rows: list[dict[str, float]]) -> dict[str, Any]:
    """Duration of one training; casps: control steps of spawned slots a second, median over iterations."""
    device = note["versions"]["device"] + (f", shared by {note['per_gpu']}" if note.get("per_gpu", 1) > 1 else "")
    values = {name: note.get(name) for name in ("iterations", "steps", "hours", "minutes", "commit", "scenes", "agents")}
    return values | {"casps": float(np.median([row["casps"] for row in rows])), "device": device}


def _curves(metrics: Mapping[int, list[dict[str, float]]]) -> dict[str, Any]:
    """Rates of each seed against agent steps, at the same iterations, averaged to `POINTS` points."""
    if not metrics:
        return {}
    length = min(len(rows) for rows in metrics.values())
    ends = np.unique(np.linspace(0, length, min(POINTS, length) + 1).round().astype(int))
    column = lambda rows, name: np.array([row.get(name, np.nan) for row in rows[:length]])  # noqa: E731
    steps = np.mean([column(rows, "steps/total") for rows in metrics.values()], axis=0)[ends[1:] - 1]

    def average(values: np.ndarray) -> list[float]:
        parts = np.split(values, ends[1:-1])
        return [float(np.nanmean(part)) if np.isfinite(part).any() else np.nan for part in parts]

    return {"steps": steps, "curves": {name: [average(column(rows, name)) for rows in metrics.values()] for name in CURVES}}


def _held_out_curve(rows: list[dict[str, float]], protocol: str, target: float) -> dict[str, Any]:
    """Success and collisions against agent steps, the first points at which success reached the target and its last value, and the last."""
    points = [{"minutes": row["minutes"], "steps": row["steps/total"], "success": row[f"{protocol}/success_rate/value"]} for row in rows]
    first = lambda minimum: next((point for point in points if point["success"] >= minimum), None)  # noqa: E731
    return {
        "steps": [point["steps"] for point in points],
        "success": [point["success"] for point in points],
        "collisions": [row[f"{protocol}/collision_rate/value"] for row in rows],
        "to_target": first(target),
        "to_final": first(points[-1]["success"]),
        "last": points[-1],
    }
