"""Evaluates policies under one or more protocols: records of every agent, and estimates of their metrics while a run trains."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core import result_file
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import episode_records, statistics
from scenefactory_jax.evaluation.episode_records import Recording, Records
from scenefactory_jax.evaluation.metrics.wosac_submission import SceneRollouts
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.loggers import metrics_csv

Evaluator = Callable[[Any], Records]  # parameters -> one row for every agent


class Evaluated(NamedTuple):
    """The episodes of one policy under one protocol."""

    protocol: str
    policy: str
    records: Records
    recording: Recording | None
    rollouts: list[SceneRollouts] | None
    digest: str  # of what decides the episodes, but for scenes and weights

    @property
    def label(self) -> str:
        """The protocol, and the policy unless it is the trained one."""
        return self.protocol if self.policy == "trained" else f"{self.protocol}, {self.policy}"


def evaluate_protocols(
    config: Mapping[str, Any],
    scenes: scene_source.Scenes,
    policies: Mapping[str, Any],
    terminations: Mapping[str, Mapping[str, Any]],
    *,
    settings: Mapping[str, Any],
    recorded_worlds: int | None,
    scores: ScoreSettings | None = None,
) -> Iterator[Evaluated]:
    """Evaluates every policy under every protocol; programs compile once a protocol.

    Args:
        config: of the environment and the network, resolved.
        policies: name -> parameters of the config's network.
        terminations: protocol -> config of the group `termination`.
        settings: `seed`, `repeats`, `stochastic`, `chunk_steps`, `ttc_limit_s` and `failures`, as `conf/command/evaluate.yaml` has them.
        recorded_worlds: how many worlds of the first protocol are recorded; None: all worlds of all protocols.
        scores: how episodes are scored; None: they are not.
    """
    for number, (protocol, termination) in enumerate(terminations.items()):
        worlds = recorded_worlds if number == 0 or recorded_worlds is None else 0
        task = {**config, "termination": termination}
        run = episode_records.make_episode_runner(task, scenes, settings=settings, worlds=worlds, scores=scores)
        parts = {name: task[name] for name in (*environment.GROUPS, "policy")} | {"pack": task["scenes"]["pack"]}
        parts |= {name: settings.get(name, False) for name in ("seed", "repeats", "stochastic")}
        parts |= {"scores": scores and dataclasses.asdict(scores)}
        for policy, parameters in policies.items():
            yield Evaluated(protocol, policy, *run(parameters), result_file.digest(parts))


def make_evaluator(
    config: Mapping[str, Any], scenes: scene_source.Scenes, *, settings: Mapping[str, Any], scores: ScoreSettings | None = None
) -> Evaluator:
    """`episode_records.make_episode_runner`, records alone."""
    run = episode_records.make_episode_runner(config, scenes, settings=settings, worlds=0, scores=scores)
    return lambda parameters: run(parameters).records


def make_training_callback(
    folder: Path, resume_at: int | None, *, evaluators: Mapping[str, Evaluator], settings: Mapping[str, Any]
) -> Callable[[Any, Mapping[str, float | int]], None]:
    """Makes a function (parameters, row of metrics) that adds one row of held-out estimates to `evaluations.csv` of a run.

    Args:
        resume_at: iteration at which a run resumes; None: a new run.
        evaluators: protocol -> evaluator.
        settings: `bootstrap` and `seed` of the intervals.
    """
    file = metrics_csv.MetricsFile(folder, name=metrics_csv.EVALUATIONS, resume_at=resume_at)

    def evaluate(parameters: Any, row: Mapping[str, float | int]) -> None:
        start = time.monotonic()
        cells = {key: row[key] for key in ("iteration", "steps/total", "minutes")}
        for protocol, evaluator in evaluators.items():
            summary = statistics.summarise(evaluator(parameters), bootstrap=settings["bootstrap"], seed=settings["seed"])
            for name, estimate in summary.items():
                for key in ("value", "low", "high"):
                    cells[f"{protocol}/{name}/{key}"] = np.nan if (number := getattr(estimate, key)) is None else number
        file.add({**cells, "seconds": time.monotonic() - start})

    return evaluate
