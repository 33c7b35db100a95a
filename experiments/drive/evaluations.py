"""Evaluations of several runs, or of a planner, that share one compiled program, kept on disk by what decides them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.schema import read as read_settings
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import protocols, records, statistics
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning import checkpoint, run_paths

REQUEST = "request.json"  # beside the tables of agents


class Asked(NamedTuple):
    """An evaluation: of runs that differ in their seed alone, or of a planner of `evaluate`."""

    runs: tuple[str, ...]  # folders, or names of bundled policies; none: a planner
    planner: str | None
    protocol: tuple[str, ...]  # words of `evaluate`: protocol=NAME, protocol.mu=...
    overrides: tuple[str, ...]  # behind the protocol's
    scenes: str | None  # None: towns


def parse_runs(words: Sequence[str]) -> dict[str, list[str]]:
    """Reads NAME=FOLDER,FOLDER... of a command line."""
    named = {}
    for name, equals, folders in (word.partition("=") for word in words):
        if not equals or not folders:
            raise SystemExit(f"expected NAME=FOLDER,FOLDER..., got {name!r}")
        named[name] = folders.split(",")
    return named


def evaluate(asked: Asked, kept: Path) -> statistics.Runs:
    """Evaluates, or reads what an earlier call with the same words measured; number of the run -> records."""
    request = {"versions": run_config.versions(), **asked._asdict()}
    folder = _find_folder(asked, kept)
    if not (folder / REQUEST).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        for number, table in enumerate(_measure(asked)):
            records.write_records(folder / f"run-{number}.csv", table, metadata=request)
        result_file.write(folder / REQUEST, request, digits=None)  # last: it says that the tables are whole
    return {number: records.read_records(folder / f"run-{number}.csv") for number in range(max(len(asked.runs), 1))}


def find_device(asked: Asked, kept: Path) -> str:
    """Reads on which device `evaluate` measured."""
    return result_file.read(_find_folder(asked, kept) / REQUEST)["versions"]["device"]


def _find_folder(asked: Asked, kept: Path) -> Path:
    return kept / result_file.digest(asked._asdict())


def compose(asked: Asked) -> tuple[dict[str, Any], dict[str, Any]]:
    """Composes the config of the episodes, and that of `evaluate` which asked for them."""
    name = asked.runs[0] if asked.runs else "null"
    planners = [f"planners=[{asked.planner}]"] if asked.planner else []
    found = hydra_config.load_config("evaluate", f"run={name}", *planners, *asked.protocol)
    protocol, planned = found["protocol"], asked.planner or ""
    words = [*hydra_config.list_overrides(protocol["settings"]), f"termination={protocol['termination'][-1]}", *asked.overrides]
    if asked.planner:
        own = [*found["planner_overrides"][planned], *protocol.get("planner_overrides", {}).get(planned, [])]
        return hydra_config.apply_overrides(hydra_config.load_config("train", "scenes=town", *words), own), found
    return hydra_config.apply_overrides(hydra_config.read(run_paths.find(name)), words), found


def _measure(asked: Asked) -> list[records.Records]:
    config, found = compose(asked)
    scores = found["protocol"].get("scores")
    scores = scores and read_settings(scores, ScoreSettings, where="protocol.scores")
    scenes = scene_source.load_heldout_scenes(config["scenes"], path=asked.scenes)
    evaluator = protocols.make_evaluator(config, scenes, settings=found, scores=scores)
    parameters = [checkpoint.restore_parameters(run_paths.find(run) / "checkpoints") for run in asked.runs] or [{}]
    return [evaluator(tree) for tree in parameters]
