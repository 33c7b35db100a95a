"""`sysid`: fit the articulated car to the teacher, stage by stage, and write what came out.

Every stage writes `out/stages/NAME.json` as soon as it is done; with `resume=true` a stage is kept if it was made with the same settings.
"""

import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel.task_map import open_pool, require_results
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.sysid import (
    candidate_simulation,
    error_metrics,
    heldout_manoeuvres,
    manoeuvres,
    multibody_model,
    optimization,
    parameter_space,
    reference_recordings,
)
from scenefactory_jax.sysid.candidate_simulation import ManoeuvreBatch, Simulator
from scenefactory_jax.sysid.manoeuvres import ManoeuvreRecording
from scenefactory_jax.sysid.optimization import Outcome, RefinementResult, Score, Stage
from scenefactory_jax.sysid.parameter_space import Space
from scenefactory_jax.visualization.report import sysid_report as report
from scenefactory_jax.visualization.report import verdicts

DIGITS = 7  # of the numbers in result.json


def sysid(config: Mapping[str, Any]) -> dict[str, Any]:
    """Fit a config's car (`load("sysid", "sysid=full")`).

    Returns:
        What is in `out/result.json`: the stages, the refinement, the fitted numbers with their spread, and how well each car drives the
        manoeuvres of the fit and those kept out of it.

    Raises:
        ConfigError: a key or number that does not fit, by name; a missing teacher package.
    """
    schema.check(config, schema.Sysid)
    scene_source.use_compilation_cache()
    out, settings = Path(config["out"]), config["sysid"]
    (out / "stages").mkdir(parents=True, exist_ok=True)
    known = recorded(config, out)
    lessons = [*known["training"], *known["extra"]]
    where = parameter_space.make(settings["space"])
    simulator = candidate_simulation.make_simulator(config["dynamics"], where, settings["friction"], physics_hz=float(config["physics_hz"]))
    plan = candidate_simulation.stack_recordings(lessons)
    score = candidate_simulation.make_scorer(simulator, plan, width=settings["width"])
    outcomes = stages(config, out, lessons, where, score)
    refined = refinement(config, out, where, simulator, plan, outcomes[-1].best)
    options = {"weights": settings["weights"], **settings["slices"]}
    places, along = optimization.compute_slices(score, where, refined.best, range(len(lessons)), **options)
    drivers = {"fitted": (simulator, refined.best), "default": (simulator, where.start), "published": published(config)}
    samples = drawn(known, settings["samples"])
    judged = {name: judge(known, *car, weights=settings["weights"], samples=samples) for name, car in drivers.items()}
    result = {
        "command": configs.format_command("sysid"),
        "versions": configs.versions(),
        "manoeuvres": {name: len(recordings) for name, recordings in known.items()},
        "space": where._asdict(),
        "stages": outcomes,
        "refined": refined,
        "slices": {"place": places, "loss": along},
        "seconds": sum(outcome.seconds for outcome in outcomes) + refined.seconds,
        "cars": {name: suites for name, (suites, _) in judged.items()},
        "samples": shown(known, samples, {name: traces for name, (_, traces) in judged.items()}),
    }
    result_file.write(out / "result.json", result, digits=DIGITS)
    (out / "fitted.yaml").write_text(yaml.safe_dump(result_file.plain(fitted(where, refined.best), digits=5), sort_keys=False))
    result = result_file.read(out / "result.json")
    found = report.verdicts(result, settings["targets"])
    print(f"{report.write(out, result, settings['targets'])}\n{verdicts.text(found)}", flush=True)
    return result


def judge(
    known: Mapping[str, Sequence[ManoeuvreRecording]],
    simulator: Simulator,
    row: np.ndarray,
    *,
    weights: Mapping[str, float],
    samples: Sequence[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """How one car drives the manoeuvres of the fit and those kept out of it: measures of every manoeuvre, and traces of the samples."""
    row_of_weights, found, traces = optimization.weight_row(weights), {}, {}
    for name, recordings in known.items():
        plan, index = candidate_simulation.stack_recordings(recordings), np.arange(len(recordings))
        rows = jnp.asarray(np.tile(row, (len(index), 1)), jnp.float32)
        path = jax.tree.map(np.asarray, simulator.trace(rows, jnp.asarray(index), plan))
        one = lambda i, path=path: jax.tree.map(lambda leaf: leaf[i : i + 1], path)  # noqa: E731
        squares = [candidate_simulation.residuals(one(i), plan, index[i : i + 1], row_of_weights) for i in index]
        found[name] = {
            "name": [recording.manoeuvre.name for recording in recordings],
            "family": [recording.manoeuvre.family for recording in recordings],
            "loss": [float((square**2).sum()) for square in squares],
            **error_metrics.compute_errors(path, recordings)._asdict(),
        }
        named = [(i, name) for i, name in enumerate(found[name]["name"]) if name in samples]
        traces |= {name: jax.tree.map(lambda leaf, i=i: leaf[i], path) for i, name in named}
    return found, traces


def drawn(known: Mapping[str, Sequence[ManoeuvreRecording]], samples: Sequence[str]) -> list[str]:
    """The samples that the teacher has driven, or the first manoeuvre of each suite."""
    names = [recording.manoeuvre.name for recordings in known.values() for recording in recordings]
    return [name for name in samples if name in names] or [recordings[0].manoeuvre.name for recordings in known.values()]


def shown(
    known: Mapping[str, Sequence[ManoeuvreRecording]], samples: Sequence[str], traces: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """The samples of the report, ten times a second: sample -> teacher and cars -> time, position, speed, yaw rate."""
    stride = round(manoeuvres.RATE_HZ / 10.0)
    taught = {recording.manoeuvre.name: recording for recordings in known.values() for recording in recordings}

    def every(position: Any, speed: Any, yaw_rate: Any, frames: int) -> dict[str, Any]:
        time_s = np.arange(1, frames + 1) / manoeuvres.RATE_HZ
        columns = {"time_s": time_s, "position": position, "speed": speed, "yaw_rate": yaw_rate}
        return {name: np.round(np.asarray(column, float)[:frames:stride], 4) for name, column in columns.items()}

    def sample(name: str) -> dict[str, Any]:
        teacher = taught[name]
        frames = len(teacher.yaw)
        cars = {car: every(own[name].position, own[name].pace, own[name].yaw_rate, frames) for car, own in traces.items()}
        return {"teacher": every(teacher.position, teacher.speed, teacher.yaw_rate, frames), **cars}

    return {name: sample(name) for name in samples}


def published(config: Mapping[str, Any]) -> tuple[Simulator, np.ndarray]:
    """The published car, with its own friction of the surfaces and nothing left open."""
    friction = config["sysid"]["published_friction"]
    return candidate_simulation.make_simulator(
        config["others"]["published"], parameter_space.make({}), friction, physics_hz=float(config["physics_hz"])
    ), np.zeros(0)


def fitted(where: Space, row: np.ndarray) -> dict[str, Any]:
    """Values by name: those of `dynamics.car`, and the surfaces' friction."""
    found = dict(zip(where.names, row.tolist(), strict=True))
    return {"car": {name: value for name, value in found.items() if name not in parameter_space.FRICTION},
            "friction": {name: found[name] for name in parameter_space.FRICTION if name in found}}  # fmt: skip


def recorded(config: Mapping[str, Any], out: Path) -> dict[str, list[ManoeuvreRecording]]:
    """What the teacher did on the published manoeuvres, on ours and on those kept out of the fit: from files of these settings, or now.

    Of each suite every `sysid.every`-th manoeuvre.
    """
    car, _ = cars.read_parameters(config["dynamics"])
    reference = instantiate(config["teacher"], builtins=multibody_model, where="teacher", car=car)()
    modules = {"training": manoeuvres, "extra": manoeuvres, "heldout": heldout_manoeuvres}
    masses = {name: config["dynamics"]["car"][name] for name in multibody_model.READS}
    every, found = config["sysid"]["every"], {}
    with open_pool(config["workers"] if config["workers"] > 1 else 0) as task_map:
        for name, module in modules.items():
            path, entries = out / f"{name}.npz", config["manoeuvres"][name]
            made = result_file.digest({"car": masses, "teacher": config["teacher"], "manoeuvres": entries, "every": every})
            if path.is_file():
                try:
                    found[name] = reference_recordings.load(path, digest=made)
                    continue
                except ConfigError:
                    print(f"{path}: of other settings, recorded anew", flush=True)
            begun = time.perf_counter()
            suite = manoeuvres.make_suite(entries, builtins=module, where=f"manoeuvres.{name}", reference=reference)
            record = functools.partial(reference_recordings.record, reference=reference)
            found[name] = list(require_results(task_map(record, suite[::every])))
            reference_recordings.save(path, found[name], digest=made)
            print(f"{path}: {len(found[name])} manoeuvres driven by the teacher in {time.perf_counter() - begun:.0f} s", flush=True)
    return found


def stages(config: Mapping[str, Any], out: Path, lessons: Sequence[ManoeuvreRecording], where: Space, score: Score) -> list[Outcome]:
    """The search, each stage from where the one before ended."""
    settings = config["sysid"]
    found: dict[str, Outcome] = {}
    begin = where.start
    for place, (name, entry) in enumerate(settings["stages"].items()):
        stage, rows = _stage(name, entry, settings, where, lessons)
        start = begin.copy()
        if entry["restores"] is not None:  # the published fifth stage: what the first found for its parameters, once more
            tuned = [where.names.index(parameter) for parameter in stage.tuned]
            start[tuned] = found[entry["restores"]].best[tuned]
        made = result_file.digest(
            {"stage": entry, "budget": settings["budget"][name], "start": start.tolist(), "settings": _shared(config)}
        )
        path = out / "stages" / f"{place + 1}_{name}.json"
        outcome = _kept(path, made, Outcome) if config["resume"] else None
        if outcome is None:
            outcome = optimization.search(
                score, where, start, stage, rows, seed=settings["seed"] + place + 1, weights=settings["weights"], **settings["search"],
                clock=time.perf_counter, report=lambda line: print(line, flush=True),
            )  # fmt: skip
            result_file.write(path, {"made": made, **outcome._asdict()}, digits=None)
        print(f"{name}: {outcome.start_loss:.4f} -> {outcome.loss:.4f}, {outcome.evaluations} candidates on {len(rows)} manoeuvres, "
              f"{outcome.seconds:.0f} s", flush=True)  # fmt: skip
        found[name], begin = outcome, outcome.best
    return list(found.values())


def _stage(
    name: str, entry: Mapping[str, Any], settings: Mapping[str, Any], where: Space, lessons: Sequence[ManoeuvreRecording]
) -> tuple[Stage, list[int]]:  # fmt: skip
    """A stage of the config, and the manoeuvres that it looks at; no families are all of them, no parameters likewise."""
    families = entry["families"] or sorted({recording.manoeuvre.family for recording in lessons})
    rows = [i for i, recording in enumerate(lessons) if recording.manoeuvre.family in families]
    if unknown := [parameter for parameter in entry["tuned"] if parameter not in where.names]:
        raise ConfigError(f"sysid.stages.{name}.tuned: {unknown[0]!r}; valid: {', '.join(where.names)}")
    if not rows:
        raise ConfigError(f"sysid.stages.{name}.families: {families}; sysid.every={settings['every']} leaves none of their manoeuvres")
    population, generations = settings["budget"][name]
    return Stage(name, tuple(families), tuple(entry["tuned"]) or where.names, entry["window"], population, generations), rows


def refinement(
    config: Mapping[str, Any], out: Path, where: Space, simulator: Simulator, plan: ManoeuvreBatch, begin: np.ndarray
) -> RefinementResult:
    """Least squares on all manoeuvres."""
    settings = config["sysid"]
    made = result_file.digest({"refine": settings["refine"], "start": begin.tolist(), "shared": _shared(config)})
    path = out / "stages" / "refine.json"
    found = _kept(path, made, RefinementResult) if config["resume"] else None
    if found is None:
        weights, index = optimization.weight_row(settings["weights"]), np.arange(len(plan.frames))
        together = max(1, settings["width"] // len(index) // 4)  # candidates whose whole traces are on the device at once

        def piece(some: np.ndarray) -> list[np.ndarray]:
            pairs = jnp.asarray(np.repeat(some, len(index), axis=0), jnp.float32), jnp.asarray(np.tile(index, len(some)))
            path = jax.tree.map(np.asarray, simulator.trace(*pairs, plan))
            each = [slice(i * len(index), (i + 1) * len(index)) for i in range(len(some))]
            return [
                candidate_simulation.residuals(jax.tree.map(lambda leaf, own=own: leaf[own], path), plan, index, weights) for own in each
            ]

        def residuals(rows: np.ndarray) -> np.ndarray:
            pieces = [np.resize(rows[i : i + together], (together, rows.shape[1])) for i in range(0, len(rows), together)]
            return np.stack([row for some in pieces for row in piece(some)][: len(rows)])

        found = optimization.refine(residuals, where, begin, **settings["refine"], clock=time.perf_counter)
        result_file.write(path, {"made": made, **found._asdict()}, digits=None)
    print(f"least squares: {found.start_loss:.4f} -> {found.loss:.4f}, {found.evaluations} candidates", flush=True)
    return found


def _shared(config: Mapping[str, Any]) -> dict[str, Any]:
    """What every stage depends on."""
    names = ("seed", "friction", "weights", "space", "search", "every")
    rest = {name: config[name] for name in ("teacher", "manoeuvres", "physics_hz")}
    left = {name: value for name, value in config["dynamics"]["car"].items() if name not in config["sysid"]["space"]}
    return {**rest, "dynamics": {**config["dynamics"], "car": left}, **{name: config["sysid"][name] for name in names}}


def _kept(path: Path, made: str, kind: type) -> Any:
    """What an earlier run left, if it was made with these settings."""
    if not path.is_file():
        return None
    content = result_file.read(path)
    if content.pop("made") != made:
        return None
    return kind(**{name: np.array(value) if isinstance(value, list) else value for name, value in content.items()})
