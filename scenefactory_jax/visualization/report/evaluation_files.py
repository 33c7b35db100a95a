"""The folder of an evaluation: tables of agents, figures, video, pictures of failures and report.md."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core import result_file
from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation import agent_metrics, circumstances, episode_records, failures
from scenefactory_jax.evaluation.agent_metrics import Estimate
from scenefactory_jax.evaluation.protocols import Evaluated
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.birds_eye import figures, video
from scenefactory_jax.visualization.report import evaluation_report, failure_pictures, plots


class Result(NamedTuple):
    """An evaluation as `evaluate` returns it: protocol -> records, protocol -> metric -> estimate, and the path of the report."""

    folder: Path
    records: dict[str, dict[str, np.ndarray]]
    summary: dict[str, dict[str, Estimate]]
    report: Path


def write(
    out: Path,
    evaluated: Iterable[Evaluated],
    *,
    config: Mapping[str, Any],
    run: Path,
    asked: Mapping[str, Any],
    settings: Mapping[str, Any],
    versions: Mapping[str, str],
    commands: Sequence[str],
) -> Result:
    """Writes records, figures, video, pictures of failures and report.md of an evaluation to `out`, while its episodes run.

    Files of an earlier evaluation are removed once the first episodes have run.

    Args:
        evaluated: see `protocols.evaluate_protocols`.
        config: of the evaluated environment, resolved.
        run: folder of the run, for its learning curves.
        asked: run, scenes (None: the run's own held-out ones), overrides, protocol, protocols and trust, as they were named.
        settings: of the evaluation, with `video`, `failures`, `bootstrap` and `seed`.
    """
    out.mkdir(parents=True, exist_ok=True)
    records, trajectories, pictures = {}, [], {}
    for one in evaluated:
        if not records:
            noted = {**asked, "episodes": circumstances.describe(config)}
            result_file.begin(out, {**noted, **{key: settings[key] for key in ("seed", "repeats", "untrained")}})
        records[one.label] = one.records
        agent_metrics.write_csv(out / _agents_file(one.label), one.records)
        if one.recording is None or one.policy != "trained":
            continue
        if settings["video"]["enable"] and not trajectories:
            trajectories = _filmed_worlds(config, one.recording, settings["video"])
        if settings["failures"]["pictures"]["enable"]:
            pictures[one.label] = failure_pictures.draw(out, one.label, one.records, one.recording, settings)
    resampling = {"bootstrap": settings["bootstrap"], "seed": settings["seed"]}
    summary = {label: agent_metrics.summarise(rows, **resampling) for label, rows in records.items()}
    metrics = metrics_csv.read(run)
    baselines = {name: f"{name}, untrained" for name in summary if f"{name}, untrained" in summary}
    files = {f"Agents, {name}": out / _agents_file(name) for name in records}
    files["Failures, ranked"] = failure_pictures.write(out, records, pictures)
    if metrics:
        files["Metrics of the training"] = run / metrics_csv.FILE
    report = evaluation_report.write(
        out,
        title=title(config["name"], asked),
        summary=summary,
        records=records,
        config=config,
        versions=versions,
        **resampling,
        baselines=baselines,
        figures=_figures(out, metrics, records, summary, baselines, trajectories),
        videos=_videos(out, trajectories, settings["video"]),
        failed=pictures,
        kinds=failures.list_thresholds(settings["failures"]),
        files=files,
        commands=commands,
        episodes={"Protocol": f"`{asked['protocol']}`", **circumstances.describe(config)},
    )
    return Result(out, records, summary, report)


def _agents_file(label: str) -> str:
    return f"agents-{label.replace(', ', '-')}.csv"


def _filmed_worlds(config: Mapping[str, Any], recording: episode_records.Recording, settings: Mapping[str, Any]) -> list[Trajectory]:
    """The first worlds, as long as the video is."""
    steps = round(settings["seconds"] * float(config["timing"]["control_hz"]))
    worlds = min(settings["worlds"], len(recording.names))
    return [episode_records.trajectory(recording, index, steps=steps) for index in range(worlds)]


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
