"""Writes the folder of an evaluation: tables of agents, figures, video, pictures of failures and report.md."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation import circumstances, episode_records, statistics
from scenefactory_jax.evaluation.metrics import wosac_submission
from scenefactory_jax.evaluation.protocols import Evaluated
from scenefactory_jax.evaluation.records import Records, begin_folder, name_file, write_records
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.birds_eye import figures, video
from scenefactory_jax.visualization.report import evaluation_report, failure_pictures, planner_table, plots, score_table
from scenefactory_jax.visualization.web import episode_page


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
    run: Path | None,
    request: Mapping[str, Any],
    settings: Mapping[str, Any],
    versions: Mapping[str, str],
    command: str,
) -> Result:
    """Writes records, figures, video, pictures of failures and report.md of an evaluation to `out`, while its episodes run.

    Files of an earlier evaluation are removed once the first episodes have run.

    Args:
        config: of the evaluated environment.
        run: folder of the run, for its learning curves; None: planners alone.
        request: run, scenes (None: the run's own held-out ones), overrides, protocol, protocols and trust of the command.
        settings: of the evaluation, with `video`, `failures`, `bootstrap` and `seed`.
        command: repeats the evaluation.
    """
    out.mkdir(parents=True, exist_ok=True)
    episodes = _describe_episodes(config, settings)
    records, trajectories, pictures, pages = {}, [], {}, {}
    for evaluation in evaluated:
        label, recording = evaluation.label, evaluation.recording
        if not records:
            begin_folder(out, {**request, "episodes": episodes, **{key: settings[key] for key in ("seed", "repeats", "untrained")}})
        records[label] = evaluation.records
        _write_agents(out, evaluation, protocol=request["protocol"], versions=versions)
        pages |= _write_episodes(out, evaluation, settings)
        if recording is None or evaluation.policy != "trained":
            continue
        if settings["video"]["enable"] and not trajectories:
            steps = round(settings["video"]["seconds"] * float(config["timing"]["control_hz"]))
            worlds = range(min(settings["video"]["worlds"], len(recording.names)))
            trajectories = [episode_records.trajectory(recording, world, steps=steps) for world in worlds]
        if settings["failures"]["pictures"]["enable"]:
            pictures[label] = failure_pictures.draw(out, label, evaluation.records, recording, settings)
    summary = {name: statistics.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for name, rows in records.items()}
    metrics = metrics_csv.read(run) if run else []
    files = {f"Agents, {name}": out / name_file(name) for name in records} | pages
    files["Scores, all metrics"] = score_table.write(out, summary)
    files["Failures, ranked"] = failure_pictures.write(out, records, pictures)
    if rows := planner_table.select_policies(summary):
        files["Planners and metrics"] = planner_table.write(out, rows, records)
    if run and metrics:
        files["Metrics of the training"] = run / metrics_csv.FILE
    report = evaluation_report.write(
        out,
        title=format_title(config["name"], request),
        records=records,
        summary=summary,
        settings=settings,
        config=config,
        versions=versions,
        episodes={"Protocol": f"`{request['protocol']}`", **episodes},
        command=command,
        figures=_draw_figures(out, metrics, records, summary, trajectories),
        videos=_write_video(out, trajectories, settings["video"], stochastic=settings.get("stochastic", False)) if trajectories else {},
        failure_pictures=pictures,
        files=files,
    )
    return Result(out, records, summary, report)


def _write_agents(out: Path, evaluation: Evaluated, *, protocol: str, versions: Mapping[str, str]) -> None:
    metadata = {"protocol": protocol, "termination": evaluation.protocol, "policy": evaluation.policy}
    metadata |= {"config_digest": evaluation.digest, "versions": versions}
    write_records(out / name_file(evaluation.label), evaluation.records, metadata=metadata)


def _write_episodes(out: Path, evaluation: Evaluated, settings: Mapping[str, Any]) -> dict[str, Path]:
    """Writes the page of scored worlds and the files of a submission, and returns the page by its title."""
    recording, name = evaluation.recording, evaluation.label.replace(", ", "-")
    if evaluation.rollouts and settings["protocol"]["scores"]["wosac"]["submission"]:
        wosac_submission.write_all(out / f"rollouts-{name}", evaluation.rollouts)
    if recording is None or recording.failures is None or not (shown := settings["replay_worlds"]):
        return {}
    page = episode_page.write(out / f"replay-{name}.html", recording, evaluation.records, worlds=shown)
    return {f"Episodes, {evaluation.label}": page}


def _describe_episodes(config: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, str]:
    noise = (settings.get("protocol", {}).get("scores") or {}).get("noise")
    added = {"Second before the start": "one random held action (V-Max's noisy start)"} if noise else {}
    return circumstances.describe(config) | added


def format_title(name: str, request: Mapping[str, Any]) -> str:
    """Formats the heading; only the run's own held-out scenes are called scenes not seen in training."""
    if request["scenes"] is not None:
        return f"{name}: evaluation on {Path(request['scenes']).name}"
    changed = any(override.startswith("scenes") for override in request["overrides"])
    return f"{name}: evaluation on {'other scenes' if changed else 'scenes not seen in training'}"


def _draw_figures(
    out: Path,
    metrics: list[dict[str, float]],
    records: Mapping[str, Records],
    summary: Mapping[str, Mapping[str, Estimate]],
    trajectories: list[Trajectory],
) -> dict[str, Path]:
    """Caption -> picture."""
    drawn = {}
    for name in summary:
        if (baseline := name + planner_table.UNTRAINED) in summary:
            figure = plots.rates_figure({"untrained": summary[baseline], "trained": summary[name]})
            drawn[f"Untrained and trained, {name}"] = figure, f"comparison-{name}"
    if rows := planner_table.select_policies(summary):
        drawn["Planners and metrics"] = planner_table.draw_figure(rows), planner_table.FILE
    if metrics:
        drawn["Training"] = plots.learning_figure(metrics), "learning"
    first = next(iter(records))
    drawn[f"How agents ended in each scene, {first}"] = plots.outcome_figure(records[first]), "outcomes"
    drawn["Surrogate safety"] = plots.safety_figure(records), "safety"
    if trajectories:
        drawn[f"Trajectories, {trajectories[0].title}"] = figures.trajectory_figure(trajectories[0]), "trajectories"
    return {caption: plots.save(figure, out / f"{name}.png") for caption, (figure, name) in drawn.items()}


def _write_video(out: Path, trajectories: list[Trajectory], settings: Mapping[str, Any], *, stochastic: bool) -> dict[str, Path]:
    path = video.write(out / f"video{settings['suffix']}", trajectories, **{key: settings[key] for key in video.SETTINGS})
    speed = settings["fps"] * settings["stride"] / trajectories[0].control_hz
    return {f"{'Stochastic' if stochastic else 'Deterministic'} policy, {speed:g} x real time": path}
