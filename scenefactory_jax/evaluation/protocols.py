"""`evaluate`: a run's policy on held-out scenes -> per-agent records, tables with intervals, a report and a video."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file, trusted_targets
from scenefactory_jax.core.trajectory import Trajectory
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import agent_metrics, circumstances, episode_records
from scenefactory_jax.learning import checkpoint, policy_io
from scenefactory_jax.loggers import metrics_csv


class Result(NamedTuple):
    """What `evaluate` hands back in Python: protocol -> records, protocol -> metric -> estimate, and the report's place."""

    folder: Path
    records: dict[str, dict[str, np.ndarray]]
    summary: dict[str, dict[str, agent_metrics.Estimate]]
    report: Path


def evaluate(config: Mapping[str, Any]) -> Result:
    """Evaluate a run as a config says (`load("evaluate", "run=...")`): deterministic policy, one episode a scene and repeat.

    Raises:
        ConfigError: no such run, no checkpoint in it, a setting that the run does not have, code of others without `trust`.
        SceneError: scenes that cannot be read.
    """
    schema.check_evaluate(config)
    scene_source.use_compilation_cache()
    run = policy_io.find(config["run"])
    protocol = config["protocol"]
    trained = configs.apply_overrides(configs.read(run, trust=config["trust"]), [*protocol["settings"], *config["overrides"]])
    scenes = scene_source.load_heldout_scenes(trained["scenes"], path=config["scenes"]["path"])
    out = Path(config["out"] or (Path("runs") / run.name if policy_io.is_bundled(run) else run) / "evaluation")
    asked = {"run": str(config["run"]), "scenes": config["scenes"]["path"], "overrides": config["overrides"]}
    asked |= {"protocol": protocol["name"], "trust": config["trust"]}
    return evaluate_protocols(trained, run, scenes, out, asked=asked, settings=config, protocols=protocol["termination"])


def after_training(config: Mapping[str, Any], folder: Path) -> Result:
    """The evaluation that ends `train`: held-out scenes, the run's own settings."""
    settings = config["evaluation"]
    scenes = scene_source.load_heldout_scenes(config["scenes"], path=None)
    asked = {
        "run": str(folder),
        "scenes": None,
        "overrides": [],
        "protocol": "trained",
        "trust": bool(trusted_targets.find_outside_targets(config)),
    }
    return evaluate_protocols(config, folder, scenes, folder, asked=asked, settings=settings, protocols=settings["protocols"])


def make_watch(
    config: Mapping[str, Any], folder: Path, *, resume_at: int | None, examiners: Mapping[str, Callable] | None = None
) -> Callable[[Any, Mapping[str, float | int]], None]:
    """A function (parameters, metrics row) that adds one row of held-out estimates to `evaluations.csv`: rates against steps.

    Args:
        examiners: protocol -> `make_examiner`; None: one episode in each of the config's held-out scenes.
    """
    settings = {**config["evaluation"], "repeats": 1}
    if examiners is None:
        scenes = scene_source.load_heldout_scenes(config["scenes"], path=None)
        examiners = {
            protocol: make_evaluator(config, scenes, protocol=protocol, settings=settings, film=0) for protocol in settings["protocols"]
        }
    file = metrics_csv.MetricsFile(folder, name=metrics_csv.EVALUATIONS, resume_at=resume_at)

    def watch(parameters: Any, row: Mapping[str, float | int]) -> None:
        begun = time.monotonic()
        found = {key: row[key] for key in ("iteration", "steps/total", "minutes")}
        for protocol, examine in examiners.items():
            summary = agent_metrics.summarise(examine(parameters)[0], bootstrap=settings["bootstrap"], seed=settings["seed"])
            for name, estimate in summary.items():
                for key in ("value", "low", "high"):
                    found[f"{protocol}/{name}/{key}"] = np.nan if (number := getattr(estimate, key)) is None else number
        file.add({**found, "seconds": time.monotonic() - begun})

    return watch


def evaluate_protocols(
    config: Mapping[str, Any],
    run: Path,
    scenes: scene_source.Scenes,
    out: Path,
    *,
    asked: Mapping[str, Any],
    settings: Mapping[str, Any],
    protocols: list[str],
) -> Result:
    """Play every protocol with the trained and, if asked for, the untrained policy; write records, report and video to `out`.

    Args:
        asked: run, scenes (None: the run's own held-out ones), overrides, protocol and trust, as they were named.
        protocols: options of the group `ends`, each of them played.
    """
    from scenefactory_jax.visualization.report import evaluation_files, failure_pictures

    asked = {**asked, "protocols": protocols}
    out.mkdir(parents=True, exist_ok=True)
    print(scenes.account, flush=True)
    parameters = {"trained": checkpoint.restore_parameters(run / "checkpoints")}
    if settings["untrained"]:
        parameters["untrained"] = policy_io.draw_untrained(config, scenes[0])
    records, trajectories, pictures = {}, [], {}
    for number, protocol in enumerate(protocols):
        film = settings["video"]["worlds"] if settings["video"]["enable"] and number == 0 else 0
        drawn = settings["failures"]["pictures"]["enable"]
        play = episode_records.make_episode_runner(
            config, scenes, protocol=protocol, settings=settings, worlds=None if drawn else film, steps=None
        )
        for name, values in parameters.items():
            label = protocol if name == "trained" else f"{protocol}, {name}"
            records[label], recording = play(values)
            if len(records) == 1:  # it can be judged: what was there before goes
                noted = {**asked, "episodes": circumstances.describe(config)}
                result_file.begin(out, {**noted, **{key: settings[key] for key in ("seed", "repeats", "untrained")}})
            agent_metrics.write_csv(out / f"agents-{label.replace(', ', '-')}.csv", records[label])
            if recording is None or name != "trained":
                continue
            trajectories = trajectories or _films(config, recording, settings["video"], film)
            if drawn:
                pictures[label] = failure_pictures.draw(out, label, records[label], recording, settings)
    summary = {
        label: agent_metrics.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for label, rows in records.items()
    }
    report = evaluation_files.write(
        out, config=config, run=run, asked=asked, settings=settings, records=records, summary=summary,
        trajectories=trajectories, failed=pictures,
    )  # fmt: skip
    print(agent_metrics.markdown(summary), f"\nreport {report}", sep="\n", flush=True)
    return Result(out, records, summary, report)


def make_evaluator(
    config: Mapping[str, Any], scenes: scene_source.Scenes, *, protocol: str, settings: Mapping[str, Any], film: int
) -> Callable[[Any], tuple[dict[str, np.ndarray], list[Trajectory]]]:
    """A function parameters -> (records, trajectories) that plays one deterministic episode for every scene and repeat, all at once.

    It compiles when it is first called, and not again for other parameters.

    Args:
        protocol: an option of the `ends` group.
        film: how many worlds' trajectories to keep.
    """
    play = episode_records.make_episode_runner(
        config, scenes, protocol=protocol, settings=settings, worlds=film, steps=_filmed(config, settings["video"])
    )

    def examine(parameters):
        records, recording = play(parameters)
        return records, [] if recording is None else _films(config, recording, settings["video"], film)

    return examine


def _filmed(config: Mapping[str, Any], video: Mapping[str, Any]) -> int:
    """Control steps that the video shows."""
    return round(video["seconds"] * float(config["timing"]["control_hz"]))


def _films(config: Mapping[str, Any], recording: episode_records.Recording, video: Mapping[str, Any], film: int) -> list[Trajectory]:
    """The first worlds, as long as the video is."""
    steps = _filmed(config, video)
    return [episode_records.trajectory(recording, index, steps=steps) for index in range(min(film, len(recording.names)))]
