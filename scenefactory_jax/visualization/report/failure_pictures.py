"""What an evaluation leaves of its failures: pictures of the worst of each kind, and a file with all of them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation import episode_records, failures
from scenefactory_jax.evaluation.failures import KINDS, Failure
from scenefactory_jax.visualization.birds_eye import video
from scenefactory_jax.visualization.birds_eye.failure_figures import Case, failures_figure
from scenefactory_jax.visualization.report import plots

FILE = "failures.json"
_AFTER_S = 2.0  # a film goes on for that long


def draw(
    out: Path, label: str, records: episode_records.Records, recording: episode_records.Recording, settings: Mapping[str, Any]
) -> dict[str, Path]:
    """Draw the worst of every kind that occurred; returns kind -> picture, and "film" -> film if the settings want one."""
    numbers, found, stem = settings["failures"]["pictures"], failures.rank_failures(records), label.replace(", ", "-")
    worlds: dict[int, Trajectory] = {}

    def case(failure: Failure) -> Case:
        if failure.world not in worlds:
            worlds[failure.world] = episode_records.trajectory(recording, failure.world)
        met = failure.kind in ("at_fault", "struck")
        return Case(failure, worlds[failure.world], int(records["hit"][failure.row]) if met else None)

    paths = {}
    for kind, ranked in found.items():
        cases = [case(failure) for failure in failures.find_worst_failures(ranked, numbers["panels"])]
        figure = failures_figure(cases, before_s=numbers["before_s"])
        paths[kind] = plots.save(figure, out / f"failures-{stem}-{kind}.png", dpi=120)
    if numbers["video"] and found:
        look = {key: settings["video"][key] for key in ("fps", "stride", "columns", "panel", "trail_s")}
        films = [_film(case(ranked[0]), before_s=numbers["before_s"]) for ranked in found.values()]
        paths["film"] = video.write(out / f"failures-{stem}{settings['video']['suffix']}", films, **look)
    return paths


def _film(case: Case, *, before_s: float) -> Trajectory:
    """The seconds around a failure."""
    failure, whole = case.failure, case.trajectory
    middle, hz = failure.moment_s * whole.control_hz, whole.control_hz
    first, last = max(round(middle - before_s * hz), 0), round(middle + _AFTER_S * hz)
    title = f"{KINDS[failure.kind].label}: car {failure.agent}, {whole.title}"
    return whole.clip(first, last)._replace(title=title)


def write(out: Path, records: Mapping[str, episode_records.Records], pictures: Mapping[str, Mapping[str, Path]]) -> Path:
    """Write `failures.json`: name of the records -> counts, shares, scenes, ranked failures and pictures by kind."""
    found = {label: failures.as_json(rows) for label, rows in records.items()}
    for label, paths in pictures.items():
        for kind, path in paths.items():
            if kind in found[label]["kinds"]:
                found[label]["kinds"][kind]["picture"] = path.name
    path = out / FILE
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return path
