"""`compare`: learning curves and evaluations of several runs side by side, seeds of one setting together; or two evaluations in pairs."""

import glob
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.cli import schema
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.config import flatten
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import read_all, read_folder
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import evaluation_comparison
from scenefactory_jax.visualization.report import run_comparison as report

STEPS = "steps/total"
# settings that make no other group; `scenes.take.seed` follows the seed
IGNORED = ("seed", "name", "out", "resume", "progress", "loggers", "checkpoint_every", "checkpoints_kept", "scenes.take.seed")
DIGITS = 6


class ReadRun(NamedTuple):
    """Contents of a run's folder."""

    folder: Path
    config: dict[str, Any]
    settings: dict[str, Any]  # dotted key -> value, without those of IGNORED
    metrics: list[dict[str, float]]
    records: dict[str, dict[str, np.ndarray]]  # protocol -> agents of the evaluation at the end


def compare(config: Mapping[str, Any]) -> dict[str, Any]:
    """Compares runs as a config says (`load_config("compare", "runs=[...]")`) and writes the report to `out`.

    Returns:
        Group -> what differs, seeds, curves over agent steps and evaluations, as they were written; of evaluations the report's path.

    Raises:
        ConfigError: no such run, a run without metrics, one that is named twice, two of one setting and seed, or a metric that one of them
            lacks, by name; see also `compare_evaluations`.
    """
    schema.check(config, schema.Compare)
    if config["evaluations"]:
        return {"report": compare_evaluations(config)}
    if not config["metrics"]:
        raise ConfigError(f"metrics: none; give columns of {metrics_csv.FILE}, as events/goal_reached")
    runs = [_read(folder, config["metrics"]) for folder in _find(config["runs"])]
    names = dict.fromkeys(name for run in runs for name in run.settings)
    varied = [name for name in names if any(run.settings.get(name) != runs[0].settings.get(name) for run in runs)]
    groups: dict[str, dict[int, ReadRun]] = {}
    for run in runs:
        label = ", ".join(f"{name}={_format(run.settings.get(name))}" for name in varied) or str(run.config["name"])
        other = groups.setdefault(label, {}).setdefault(run.config["seed"], run)
        if other is not run:
            same = f"{other.folder} and {run.folder} have one setting and one seed, {run.config['seed']}"
            raise ConfigError(f"runs: {same}: they are no two samples; leave one out")
    result = {
        "command": run_config.format_command("compare"),
        "settings": {key: config[key] for key in ("metrics", "window", "last")},
        "groups": {label: _summarise(seeds, config) for label, seeds in groups.items()},
    }
    result, out = result_file.plain(result, digits=DIGITS), Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    result_file.write(out / "compare.json", result, digits=DIGITS)
    print(f"{report.table(result)}\n{report.write(out, result)}", flush=True)
    return result


def compare_evaluations(config: Mapping[str, Any]) -> Path:
    """Compares the policies that two folders of `evaluate` have both, and writes the report to `out`: the first less the second.

    Raises:
        ConfigError: runs too, not two folders, one without an evaluation, or two without a policy in common.
        RecordsError: two evaluations of different scenes.
    """
    folders, out = [Path(folder) for folder in config["evaluations"]], Path(config["out"])
    if config["runs"] or len(folders) != 2:
        raise ConfigError(f"evaluations: expected two folders and no runs, got {len(folders)} and {len(config['runs'])} runs")
    records = [read_all(folder) for folder in folders]
    if empty := [str(folder) for folder, rows in zip(folders, records, strict=True) if not rows]:
        raise ConfigError(f"evaluations: {empty[0]} holds no records of agents; give a folder that `evaluate` wrote")
    labels = [label for label in records[0] if label in records[1]]
    if not labels:
        raise ConfigError(f"evaluations: expected a policy that both have, got {', '.join(records[0])} and {', '.join(records[1])}")
    names = [str(folder) for folder in folders] if folders[0].name == folders[1].name else [folder.name for folder in folders]
    chosen = {name: {label: rows[label] for label in labels} for name, rows in zip(names, records, strict=True)}
    out.mkdir(parents=True, exist_ok=True)
    resampling = {"bootstrap": config["bootstrap"], "seed": config["seed"]}
    path = evaluation_comparison.write(out, chosen, resampling, command=run_config.format_command("compare"))
    print(f"{path.read_text(encoding='utf-8')}\nreport {path}", flush=True)
    return path


def _find(patterns: Iterable[str]) -> list[Path]:
    """Run folders in the order in which they are named."""
    found: dict[Path, Path] = {}
    for pattern in patterns:
        matches = sorted(glob.glob(pattern)) if glob.has_magic(pattern) else [pattern]
        if not matches:
            raise ConfigError(f"runs: nothing matches {pattern!r}; give folders that `train` wrote")
        for match in map(Path, matches):
            if match.resolve() in found:
                raise ConfigError(f"runs: {pattern!r} names {match} once more; every run counts once")
            found[match.resolve()] = match
    if not found:
        raise ConfigError("runs: none; give folders that `train` wrote")
    return list(found.values())


def _read(folder: Path, metrics: Iterable[str]) -> ReadRun:
    config, rows = run_config.read_values(folder), metrics_csv.read(folder)
    if not rows:
        raise ConfigError(f"runs: {folder / metrics_csv.FILE}: no row; the run has not finished an iteration")
    if missing := [name for name in (STEPS, *metrics) if name not in rows[0]]:
        raise ConfigError(f"metrics: {folder / metrics_csv.FILE} has no column {missing[0]!r}; there are: {', '.join(rows[0])}")
    settings = {key: value for key, value in flatten(config).items() if key not in IGNORED and not key.startswith("loggers.")}
    return ReadRun(folder, config, settings, rows, read_folder(folder))


def _format(value: Any) -> str:
    """Formats a value as in a config."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _summarise(seeds: Mapping[int, ReadRun], config: Mapping[str, Any]) -> dict[str, Any]:
    """Curves of each seed up to the length of the shortest, and the evaluations of all seeds, resampled by seed, scene and agent."""
    runs = list(seeds.values())
    length = min(len(run.metrics) for run in runs)
    tail = max(1, round(config["last"] * length))
    column = lambda run, name: np.array([row[name] for row in run.metrics[:length]])  # noqa: E731
    evaluated = {
        name: statistics.summarise_runs(
            {seed: run.records[name] for seed, run in seeds.items()}, bootstrap=config["bootstrap"], seed=config["seed"]
        )
        for name in runs[0].records
        if all(name in run.records for run in runs)
    }
    return {
        "runs": [run.folder.name for run in runs],
        "seeds": list(seeds),
        "iterations": length,
        "steps": np.mean([column(run, STEPS) for run in runs], axis=0),
        "minutes": [run.metrics[length - 1]["minutes"] for run in runs],
        "casps": [float(np.median(column(run, "casps"))) for run in runs],
        "curves": {name: [_running_mean(column(run, name), config["window"]) for run in runs] for name in config["metrics"]},
        "last": {name: [float(np.nanmean(column(run, name)[-tail:])) for run in runs] for name in config["metrics"]},
        "evaluated": evaluated,
    }


def _running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Means over the last `window` values up to each one, over fewer at the start."""
    return np.array([np.nanmean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))])
