"""Writes the failures of an evaluation: pictures of the worst of each type, and a file with all of them."""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.evaluation import episode_records, failures
from scenefactory_jax.evaluation.failures import FAILURE_TYPES, Failure
from scenefactory_jax.evaluation.records import select_rows
from scenefactory_jax.visualization.birds_eye import video
from scenefactory_jax.visualization.birds_eye.failure_figures import Case, failures_figure
from scenefactory_jax.visualization.report import plots

_AFTER_S = 2.0  # of a film, after the failure


def draw(
    out: Path, label: str, records: episode_records.Records, recording: episode_records.Recording, settings: Mapping[str, Any]
) -> dict[str, Path]:
    """Draws the worst failures of every type that was recorded; returns type -> picture, and "film" -> film if the settings ask for one."""
    records = select_rows(records, np.asarray(records["world"]) < len(recording.frames.active))
    numbers, stem = settings["failures"]["pictures"], label.replace(", ", "-")
    ranked = failures.rank_failures(records)
    trajectory = functools.cache(functools.partial(episode_records.trajectory, recording))

    def case(failure: Failure) -> Case:
        partner = int(records["collision_partner"][failure.row]) if failure.kind in ("at_fault", "struck") else None
        return Case(failure, trajectory(failure.world), partner)

    paths = {}
    for kind, worst in ranked.items():
        cases = [case(failure) for failure in failures.find_worst_failures(worst, numbers["panels"])]
        figure = failures_figure(cases, before_s=numbers["before_s"])
        paths[kind] = plots.save(figure, out / f"failures-{stem}-{kind}.png", dpi=120)
    if numbers["video"] and ranked:
        films = [_clip(worst[0], trajectory(worst[0].world), before_s=numbers["before_s"]) for worst in ranked.values()]
        path = out / f"failures-{stem}{settings['video']['suffix']}"
        paths["film"] = video.write(path, films, **{key: settings["video"][key] for key in video.SETTINGS})
    return paths


def _clip(failure: Failure, trajectory: Trajectory, *, before_s: float) -> Trajectory:
    """The seconds around a failure."""
    first, last = (round((failure.moment_s + offset) * trajectory.control_hz) for offset in (-before_s, _AFTER_S))
    title = f"{FAILURE_TYPES[failure.kind].label}: car {failure.agent}, {trajectory.title}"
    return trajectory.clip(max(first, 0), last)._replace(title=title)


def write(out: Path, records: Mapping[str, episode_records.Records], pictures: Mapping[str, Mapping[str, Path]]) -> Path:
    """Writes failures.json: name of the records -> counts, fractions, scenes, ranked failures and pictures by type."""
    content = {label: failures.as_json(rows) for label, rows in records.items()}
    for label, paths in pictures.items():
        for kind, entry in content[label]["types"].items():
            if kind in paths:
                entry["picture"] = paths[kind].name
    path = out / "failures.json"
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path
