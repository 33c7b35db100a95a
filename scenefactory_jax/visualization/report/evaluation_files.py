"""Figures, video and report.md of an evaluation."""

import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation import agent_metrics, circumstances, failures
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.birds_eye import figures, video
from scenefactory_jax.visualization.report import evaluation_report, failure_pictures, plots


def write(
    out: Path,
    *,
    config: Mapping[str, Any],
    run: Path,
    asked: Mapping[str, Any],
    settings: Mapping[str, Any],
    records: Mapping[str, dict[str, np.ndarray]],
    summary: Mapping[str, Mapping[str, agent_metrics.Estimate]],
    trajectories: list[Trajectory],
    failed: Mapping[str, Mapping[str, Path]],
) -> Path:
    """Write everything that a reader of the evaluation wants to see to `out`, and return the report's path.

    `asked` is as `evaluate.judge` has it, with the protocols; `failed` has the pictures of failures: name of records -> kind -> picture.
    """
    metrics = metrics_csv.read(run)
    baselines = {name: f"{name}, untrained" for name in summary if f"{name}, untrained" in summary}
    figures = _figures(out, metrics, records, summary, baselines, trajectories)
    videos = _videos(out, trajectories, settings["video"])
    files = {f"Agents, {name}": out / f"agents-{name.replace(', ', '-')}.csv" for name in records}
    files["Failures, ranked"] = failure_pictures.write(out, records, failed)
    if metrics:
        files["Metrics of the training"] = run / metrics_csv.FILE
    return evaluation_report.write(
        out,
        title=title(config["name"], asked),
        summary=summary,
        records=records,
        config=config,
        versions=configs.versions(),
        bootstrap=settings["bootstrap"],
        seed=settings["seed"],
        baselines=baselines,
        figures=figures,
        videos=videos,
        failed=failed,
        kinds=failures.list_thresholds(settings["failures"]),
        files=files,
        commands=[format_rerun_command(asked, settings)],
        episodes={"Protocol": f"`{asked['protocol']}`", **circumstances.describe(config)},
    )


def format_rerun_command(asked: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """The command that makes an evaluation's numbers anew, with every setting that is not its default."""
    default = configs.load_config("evaluate", "run=null", f"protocol={asked['protocol']}")
    protocol = {**settings.get("protocol", default["protocol"]), "termination": asked["protocols"]}
    own = {name: asked[name] for name in ("run", "overrides", "trust")} | {"scenes": {"path": asked["scenes"]}}
    own |= {"out": None, "protocol": protocol}
    wanted, usual = (
        evaluation_report.flatten({name: {**settings, **own}[name] for name in ("run", *default)}),
        evaluation_report.flatten(default),
    )
    words = [f"{key}={_word(value)}" for key, value in wanted.items() if value != usual.get(key)]
    named = [] if asked["protocol"] == "trained" else [f"protocol={asked['protocol']}"]
    return f"python -m scenefactory_jax evaluate {shlex.join([*words[:1], *named, *words[1:]])}"


def _word(value: Any) -> str:
    """A value in Hydra's grammar."""
    bare = isinstance(value, str) and re.fullmatch(r"[A-Za-z/._][\w/.+-]*", value)
    return value if bare else json.dumps(value, ensure_ascii=False, separators=(",", ":"), default=str)


def title(name: str, asked: Mapping[str, Any]) -> str:
    """The heading, which says of no other scenes than the run's own held-out ones that training never saw them."""
    changed = any(override.startswith("scenes") for override in asked["overrides"])
    own = "other scenes" if changed else "scenes not seen in training"
    return f"{name}: evaluation on {own if asked['scenes'] is None else Path(asked['scenes']).name}"


def _figures(out: Path, metrics, records, summary, baselines, trajectories) -> dict[str, Path]:
    """Caption -> picture."""
    found = {}
    for name, baseline in baselines.items():
        figure = plots.comparison_figure(summary[baseline], summary[name], names=("untrained", "trained"))
        found[f"Untrained and trained, {name}"] = plots.save(figure, out / f"comparison-{name}.png")
    if metrics:
        found["Training"] = plots.save(plots.learning_figure(metrics), out / "learning.png")
    first = next(iter(records))
    found[f"How agents ended in each scene, {first}"] = plots.save(plots.outcome_figure(records[first]), out / "outcomes.png")
    found["Surrogate safety"] = plots.save(plots.safety_figure(records), out / "safety.png")
    if trajectories:
        figure = figures.trajectory_figure(trajectories[0])
        found[f"Ways driven, {trajectories[0].title}"] = plots.save(figure, out / "trajectories.png")
    return found


def _videos(out: Path, trajectories: list[Trajectory], settings: Mapping[str, Any]) -> dict[str, Path]:
    if not trajectories:
        return {}
    path = out / f"video{settings['suffix']}"
    look = {key: settings[key] for key in ("fps", "stride", "columns", "panel", "trail_s")}
    video.write(path, trajectories, **look)
    speed = settings["fps"] * settings["stride"] / trajectories[0].control_hz
    return {f"Deterministic policy, {speed:g} x real time": path}
