"""`evaluate`: a run's policy on held-out scenes -> per-agent records, tables with intervals, a report and a video."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.ppo import checkpoint
from scenefactory_jax.report import circumstances, tables
from scenefactory_jax.report.canvas import Trajectory
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, log, playing, policies, results, sources, targets


class Result(NamedTuple):
    """What `evaluate` hands back in Python: protocol -> records, protocol -> metric -> estimate, and the report's place."""

    folder: Path
    records: dict[str, dict[str, np.ndarray]]
    summary: dict[str, dict[str, tables.Estimate]]
    report: Path


def evaluate(config: Mapping[str, Any]) -> Result:
    """Evaluate a run as a config says (`load("evaluate", "run=...")`): deterministic policy, one episode a scene and repeat.

    Raises:
        ConfigError: no such run, no checkpoint in it, a setting that the run does not have, code of others without `trust`.
        SceneError: scenes that cannot be read.
    """
    keys.check_evaluate(config)
    sources.use_compilation_cache()
    run = policies.find(config["run"])
    protocol = config["protocol"]
    trained = configs.amend(configs.read(run, trust=config["trust"]), [*protocol["settings"], *config["overrides"]])
    scenes = sources.heldout(trained["scenes"], path=config["scenes"]["path"])
    out = Path(config["out"] or (Path("runs") / run.name if policies.is_shipped(run) else run) / "evaluation")
    asked = {"run": str(config["run"]), "scenes": config["scenes"]["path"], "overrides": config["overrides"]}
    asked |= {"protocol": protocol["name"], "trust": config["trust"]}
    return judge(trained, run, scenes, out, asked=asked, settings=config, protocols=protocol["ends"])


def after_training(config: Mapping[str, Any], folder: Path) -> Result:
    """The evaluation that ends `train`: held-out scenes, the run's own settings."""
    settings = config["evaluation"]
    scenes = sources.heldout(config["scenes"], path=None)
    asked = {"run": str(folder), "scenes": None, "overrides": [], "protocol": "trained", "trust": bool(targets.outside(config))}
    return judge(config, folder, scenes, folder, asked=asked, settings=settings, protocols=settings["protocols"])


def make_watch(
    config: Mapping[str, Any], folder: Path, *, resume_at: int | None, examiners: Mapping[str, Callable] | None = None
) -> Callable[[Any, Mapping[str, float | int]], None]:
    """A function (parameters, metrics row) that adds one row of held-out estimates to `evaluations.csv`: rates against steps.

    Args:
        examiners: protocol -> `make_examiner`; None: one episode in each of the config's held-out scenes.
    """
    settings = {**config["evaluation"], "repeats": 1}
    if examiners is None:
        scenes = sources.heldout(config["scenes"], path=None)
        examiners = {
            protocol: make_examiner(config, scenes, protocol=protocol, settings=settings, film=0) for protocol in settings["protocols"]
        }
    file = log.MetricsFile(folder, name=log.EVALUATIONS, resume_at=resume_at)

    def watch(parameters: Any, row: Mapping[str, float | int]) -> None:
        begun = time.monotonic()
        found = {key: row[key] for key in ("iteration", "steps/total", "minutes")}
        for protocol, examine in examiners.items():
            summary = tables.summarise(examine(parameters)[0], bootstrap=settings["bootstrap"], seed=settings["seed"])
            for name, estimate in summary.items():
                for key in ("value", "low", "high"):
                    found[f"{protocol}/{name}/{key}"] = np.nan if (number := getattr(estimate, key)) is None else number
        file.add({**found, "seconds": time.monotonic() - begun})

    return watch


def judge(
    config: Mapping[str, Any],
    run: Path,
    scenes: sources.Scenes,
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
    from scenefactory_jax.run import failing, reporting

    asked = {**asked, "protocols": protocols}
    out.mkdir(parents=True, exist_ok=True)
    print(scenes.account, flush=True)
    parameters = {"trained": checkpoint.restore_parameters(run / "checkpoints")}
    if settings["untrained"]:
        parameters["untrained"] = policies.draw_untrained(config, scenes[0])
    records, trajectories, pictures = {}, [], {}
    for number, protocol in enumerate(protocols):
        film = settings["video"]["worlds"] if settings["video"]["enable"] and number == 0 else 0
        drawn = settings["failures"]["pictures"]["enable"]
        play = playing.make_player(config, scenes, protocol=protocol, settings=settings, worlds=None if drawn else film, steps=None)
        for name, values in parameters.items():
            label = protocol if name == "trained" else f"{protocol}, {name}"
            records[label], recording = play(values)
            if len(records) == 1:  # it can be judged: what was there before goes
                noted = {**asked, "episodes": circumstances.describe(config)}
                results.begin(out, {**noted, **{key: settings[key] for key in ("seed", "repeats", "untrained")}})
            tables.write_csv(out / f"agents-{label.replace(', ', '-')}.csv", records[label])
            if recording is None or name != "trained":
                continue
            trajectories = trajectories or _films(config, recording, settings["video"], film)
            if drawn:
                pictures[label] = failing.draw(out, label, records[label], recording, settings)
    summary = {label: tables.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for label, rows in records.items()}
    report = reporting.write(
        out, config=config, run=run, asked=asked, settings=settings, records=records, summary=summary,
        trajectories=trajectories, failed=pictures,
    )  # fmt: skip
    print(tables.markdown(summary), f"\nreport {report}", sep="\n", flush=True)
    return Result(out, records, summary, report)


def make_examiner(
    config: Mapping[str, Any], scenes: sources.Scenes, *, protocol: str, settings: Mapping[str, Any], film: int
) -> Callable[[Any], tuple[dict[str, np.ndarray], list[Trajectory]]]:
    """A function parameters -> (records, trajectories) that plays one deterministic episode for every scene and repeat, all at once.

    It compiles when it is first called, and not again for other parameters.

    Args:
        protocol: an option of the `ends` group.
        film: how many worlds' trajectories to keep.
    """
    play = playing.make_player(
        config, scenes, protocol=protocol, settings=settings, worlds=film, steps=_filmed(config, settings["video"])
    )

    def examine(parameters):
        records, recording = play(parameters)
        return records, [] if recording is None else _films(config, recording, settings["video"], film)

    return examine


def _filmed(config: Mapping[str, Any], video: Mapping[str, Any]) -> int:
    """Control steps that the video shows."""
    return round(video["seconds"] * float(config["timing"]["control_hz"]))


def _films(config: Mapping[str, Any], recording: playing.Recording, video: Mapping[str, Any], film: int) -> list[Trajectory]:
    """The first worlds, as long as the video is."""
    steps = _filmed(config, video)
    return [playing.trajectory(recording, index, steps=steps) for index in range(min(film, len(recording.names)))]
