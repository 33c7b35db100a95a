"""`compare`: learning curves and evaluations of several runs side by side, seeds of one setting together."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file
from scenefactory_jax.core.config import flatten
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import agent_metrics, hierarchical_bootstrap
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import run_comparison as report

STEPS = "steps/total"
# settings that make no other group
ASIDE = ("seed", "name", "out", "resume", "progress", "loggers", "checkpoint_every", "checkpoints_kept")
ASIDE += ("scenes.take.seed",)  # follows the seed
DIGITS = 6


class ReadRun(NamedTuple):
    """One run, as its folder holds it."""

    folder: Path
    config: dict[str, Any]
    settings: dict[str, Any]  # dotted key -> value, without those of ASIDE
    metrics: list[dict[str, float]]
    records: dict[str, dict[str, np.ndarray]]  # protocol -> agents of the evaluation at the end


def compare(config: Mapping[str, Any]) -> dict[str, Any]:
    """Compare runs as a config says (`load("compare", "runs=[...]")`) and write the report in `out`.

    Returns:
        Group -> what differs, seeds, curves over agent steps and evaluations, as they were written.

    Raises:
        ConfigError: no such run, a run without metrics, one that is named twice, two of one setting and seed, or a metric that one of them
            lacks, by name.
    """
    schema.check(config, schema.Compare)
    if not config["metrics"]:
        raise ConfigError(f"metrics: none; give columns of {metrics_csv.FILE}, as events/goal_reached")
    runs = [_read(folder) for folder in _find(config["runs"])]
    for run in runs:
        if missing := [name for name in (STEPS, *config["metrics"]) if name not in run.metrics[0]]:
            raise ConfigError(
                f"metrics: {run.folder / metrics_csv.FILE} has no column {missing[0]!r}; there are: {', '.join(run.metrics[0])}"
            )
    differing = _differing(run.settings for run in runs)
    groups: dict[str, list[ReadRun]] = {}
    for run in runs:
        label = ", ".join(f"{key}={_shown(run.settings.get(key))}" for key in differing) or str(run.config["name"])
        groups.setdefault(label, []).append(run)
    found = {label: _group(members, config) for label, members in groups.items()}
    shown = {key: config[key] for key in ("metrics", "window", "last")}
    result = {"command": configs.format_command("compare"), "settings": shown, "groups": found}
    result = result_file.plain(result, digits=DIGITS)
    out = Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    result_file.write(out / "compare.json", result, digits=DIGITS)
    print(f"{report.table(result)}\n{report.write(out, result)}", flush=True)
    return result


def _find(patterns: Iterable[str]) -> list[Path]:
    """Run folders in the order in which they are named."""
    found: dict[Path, Path] = {}
    for pattern in patterns:
        path = Path(pattern)
        base = Path(path.anchor) if path.is_absolute() else Path()
        matches = sorted(base.glob(str(path.relative_to(base)))) if any(sign in pattern for sign in "*?[") else [path]
        if not matches:
            raise ConfigError(f"runs: nothing matches {pattern!r}; give folders that `train` wrote")
        for match in matches:
            if match.resolve() in found:
                raise ConfigError(f"runs: {pattern!r} names {match} once more; every run counts once")
            found[match.resolve()] = match
    if not found:
        raise ConfigError("runs: none; give folders that `train` wrote")
    return list(found.values())


def _read(folder: Path) -> ReadRun:
    config, metrics = configs.read_values(folder), metrics_csv.read(folder)
    if not metrics:
        raise ConfigError(f"runs: {folder / metrics_csv.FILE}: no row; the run has not finished an iteration")
    settings = {key: value for key, value in flatten(config).items() if key not in ASIDE and not key.startswith("loggers.")}
    return ReadRun(folder, config, settings, metrics, read_records(folder))


def read_records(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads protocol -> records of the trained policy's agents that an evaluation wrote to a folder; empty without an evaluation.

    Raises:
        RecordsError: a file with other contents.
    """
    files = {path.stem.removeprefix("agents-"): path for path in sorted(folder.glob("agents-*.csv"))}
    return {name: agent_metrics.read_csv(path) for name, path in files.items() if not name.endswith("-untrained")}


def _differing(settings: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys whose values are not the same in all runs."""
    first, *others = settings
    names = dict.fromkeys(name for one in (first, *others) for name in one)
    return [name for name in names if any(one.get(name) != first.get(name) for one in others)]


def _shown(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _group(runs: list[ReadRun], config: Mapping[str, Any]) -> dict[str, Any]:
    """Curves of each seed up to the length of the shortest, and the evaluations of all seeds, resampled by seed, scene and agent."""
    seeds: dict[int, ReadRun] = {}
    for run in runs:
        other = seeds.setdefault(run.config["seed"], run)
        if other is not run:
            same = f"{other.folder} and {run.folder} have one setting and one seed, {run.config['seed']}"
            raise ConfigError(f"runs: {same}: they are no two samples; leave one out")
    length = min(len(run.metrics) for run in runs)
    tail = max(1, round(config["last"] * length))

    def column(run: ReadRun, name: str) -> np.ndarray:
        return np.array([row[name] for row in run.metrics[:length]])

    curves = {name: [_running(column(run, name), config["window"]) for run in runs] for name in config["metrics"]}
    evaluated = {}
    for name in runs[0].records:
        if all(name in run.records for run in runs):
            each = {seed: run.records[name] for seed, run in seeds.items()}
            evaluated[name] = hierarchical_bootstrap.summarise(each, bootstrap=config["bootstrap"], seed=config["seed"])
    return {
        "runs": [run.folder.name for run in runs],
        "seeds": [run.config["seed"] for run in runs],
        "iterations": length,
        "steps": np.mean([column(run, STEPS) for run in runs], axis=0),
        "minutes": [run.metrics[length - 1]["minutes"] for run in runs],
        "casps": [float(np.median(column(run, "casps"))) for run in runs],
        "curves": curves,
        "last": {name: [float(np.nanmean(column(run, name)[-tail:])) for run in runs] for name in config["metrics"]},
        "evaluated": evaluated,
    }


def _running(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of the values up to each one, `window` of them where there are so many."""
    return np.array([np.nanmean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))])
