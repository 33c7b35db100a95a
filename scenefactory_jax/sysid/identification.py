"""The fit of the articulated car to the teacher: recordings, search stage by stage, refinement, and the errors of each car.

Every stage writes `out/stages/NAME.json` when it ends; with `resume` a stage that was made with the same settings is read instead.
"""

import functools
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.parallel.task_map import open_pool, require_results
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
    response_metrics,
    tyre_curves,
)
from scenefactory_jax.sysid.candidate_simulation import ManoeuvreBatch, Simulator
from scenefactory_jax.sysid.manoeuvres import ManoeuvreRecording
from scenefactory_jax.sysid.multibody_model import ReferenceVehicle
from scenefactory_jax.sysid.optimization import Outcome, RefinementResult, Score, Stage
from scenefactory_jax.sysid.parameter_space import Space

LOG = logging.getLogger(__name__)
Suites = Mapping[str, Sequence[ManoeuvreRecording]]  # training, extra and heldout
TYRE_SPEED = 20.0  # m/s, of the wheel in the curves of friction against slip


def identify(config: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """Fits the car of a config (`conf/command/sysid.yaml`) and, with the same budget, the published structure; evaluates both.

    Returns:
        The content of result.json: manoeuvres, fits (space, stages, refined, by structure), slices, seconds, cars, responses, tyres and
        samples.

    Raises:
        ConfigError: a name or number that does not fit; a missing teacher package.
    """
    settings = config["sysid"]
    structures = {
        "fitted": config,
        "published": {**config, "dynamics": config["others"]["published"], "sysid": {**settings, "space": settings["published_space"]}},
    }
    valid = dict.fromkeys(name for structure in structures.values() for name in structure["sysid"]["space"])
    for name, entry in settings["stages"].items():
        if unknown := [parameter for parameter in entry["tuned"] if parameter not in valid]:
            raise ConfigError(f"sysid.stages.{name}.tuned: {unknown[0]!r}; valid: {', '.join(valid)}")
    suites = record_suites(config, out)
    batch = candidate_simulation.stack_recordings([recording for recordings in suites.values() for recording in recordings])
    fits = {name: fit(structure, out / "stages" / name, suites, batch) for name, structure in structures.items()}
    cars = {name: (fit.simulator, fit.refined.best) for name, fit in fits.items()}
    cars = {"fitted": cars["fitted"], "start": (fits["fitted"].simulator, fits["fitted"].space.start), "published": cars["published"]}
    measured = {suite: response_metrics.measure_recordings(recordings)._asdict() for suite, recordings in suites.items()}
    errors, responses, traces = {}, {"teacher": measured}, {}
    for name, (car, values) in cars.items():
        errors[name], responses[name], traces[name] = evaluate_car(suites, batch, car, values, settings)
    return {
        "manoeuvres": {name: len(suite) for name, suite in suites.items()},
        "fits": {name: {"space": fit.space, "stages": fit.stages, "refined": fit.refined} for name, fit in fits.items()},
        "slices": dict(zip(("place", "loss"), fits["fitted"].slices, strict=True)),
        "seconds": sum(fit.seconds for fit in fits.values()),
        "cars": errors,
        "responses": responses,
        "tyres": draw_tyres(structures, fits),
        "samples": sample_traces(suites, settings["samples"], traces),
    }


class Fit(NamedTuple):
    """A structure fitted to the recordings."""

    space: Space
    simulator: Simulator
    stages: list[Outcome]
    refined: RefinementResult
    slices: tuple[np.ndarray, np.ndarray]  # of the loss along each parameter: places in the range, losses
    seconds: float


def fit(config: Mapping[str, Any], folder: Path, suites: Suites, batch: ManoeuvreBatch) -> Fit:
    """Fits the car of `config["dynamics"]` to the manoeuvres that are not held out; writes its stages into a folder.

    Args:
        batch: all recordings, those of the fit first. The fit uses the held-out ones nowhere; one batch saves a compilation.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings = config["sysid"]
    recordings, space = [*suites["training"], *suites["extra"]], parameter_space.make(settings["space"])
    simulator = candidate_simulation.make_simulator(config["dynamics"], space, settings["friction"], physics_hz=float(config["physics_hz"]))
    score = candidate_simulation.make_scorer(simulator, batch, width=settings["width"])
    stages = search_stages(config, folder, recordings, space, score)
    indices = range(len(recordings))
    refined = refine(config, folder, space, simulator, batch, indices, stages[-1].best)
    slices = optimization.compute_slices(score, space, refined.best, indices, weights=settings["weights"], **settings["slices"])
    return Fit(space, simulator, stages, refined, slices, sum(stage.seconds for stage in stages) + refined.seconds)


def record_suites(config: Mapping[str, Any], out: Path) -> dict[str, list[ManoeuvreRecording]]:
    """Records the teacher on the published manoeuvres, on further ones and on held-out ones, or reads its files of the same settings.

    Of each suite every `sysid.every`-th manoeuvre, mirrored ones left out.
    """
    reference = make_reference(config)
    modules = {"training": manoeuvres, "extra": manoeuvres, "heldout": heldout_manoeuvres}
    masses = {name: config["dynamics"]["car"][name] for name in multibody_model.READS}
    every, suites = config["sysid"]["every"], {}
    with open_pool(config["workers"] if config["workers"] > 1 else 0) as task_map:
        for name, module in modules.items():
            path, entries = out / f"{name}.npz", config["manoeuvres"][name]
            digest = result_file.digest({"car": masses, "teacher": config["teacher"], "manoeuvres": entries, "every": every})
            if path.is_file():
                try:
                    suites[name] = reference_recordings.load(path, digest=digest)
                    continue
                except ConfigError:
                    LOG.info("%s: of other settings, recorded anew", path)
            start = time.perf_counter()
            record = functools.partial(reference_recordings.record, reference=reference)
            suite = manoeuvres.make_suite(entries, builtins=module, where=f"manoeuvres.{name}", reference=reference)
            suites[name] = list(require_results(task_map(record, manoeuvres.drop_mirrored(suite)[::every])))
            reference_recordings.save(path, suites[name], digest=digest)
            LOG.info("%s: %d manoeuvres driven by the teacher in %.0f s", path, len(suites[name]), time.perf_counter() - start)
    return suites


def make_reference(config: Mapping[str, Any]) -> ReferenceVehicle:
    """Makes the reference car of a config."""
    car, _ = cars.read_parameters(config["dynamics"])
    return instantiate(config["teacher"], builtins=multibody_model, where="teacher", car=car)()


def search_stages(
    config: Mapping[str, Any], folder: Path, recordings: Sequence[ManoeuvreRecording], space: Space, score: Score
) -> list[Outcome]:
    """Searches stage by stage, each from the end of the stage before."""
    settings, outcomes, start = config["sysid"], dict[str, Outcome](), space.start
    for place, (name, entry) in enumerate(settings["stages"].items(), start=1):
        stage, rows = _make_stage(name, entry, settings, space, recordings)
        start = start.copy()
        if entry["restores"] is not None:  # the published fifth stage begins with the first one's values of its parameters
            tuned = [space.names.index(parameter) for parameter in stage.tuned]
            start[tuned] = outcomes[entry["restores"]].best[tuned]
        digest = result_file.digest(
            {"stage": entry, "budget": settings["budget"][name], "start": start.tolist(), "settings": _shared_settings(config)}
        )
        path = folder / f"{place}_{name}.json"
        outcome = _read(path, digest, Outcome) if config["resume"] else None
        if outcome is None:
            outcome = optimization.search(
                score, space, start, stage, rows, seed=settings["seed"] + place, weights=settings["weights"], **settings["search"],
                clock=time.perf_counter, report=LOG.info,
            )  # fmt: skip
            result_file.write(path, {"made": digest, **outcome._asdict()}, digits=None)
        LOG.info(
            "%s: %.4f -> %.4f, %d candidates on %d manoeuvres, %.0f s",
            name, outcome.start_loss, outcome.loss, outcome.evaluations, len(rows), outcome.seconds,
        )  # fmt: skip
        outcomes[name], start = outcome, outcome.best
    return list(outcomes.values())


def _make_stage(
    name: str, entry: Mapping[str, Any], settings: Mapping[str, Any], space: Space, recordings: Sequence[ManoeuvreRecording]
) -> tuple[Stage, list[int]]:
    """A stage of the config, with the parameters that a structure has, and the indices of its manoeuvres; none stand for all."""
    families = entry["families"] or sorted({recording.manoeuvre.family for recording in recordings})
    rows = [i for i, recording in enumerate(recordings) if recording.manoeuvre.family in families]
    if not rows:
        raise ConfigError(f"sysid.stages.{name}.families: {families}; sysid.every={settings['every']} leaves none of their manoeuvres")
    population, generations = settings["budget"][name]
    tuned = tuple(parameter for parameter in entry["tuned"] or space.names if parameter in space.names)
    return Stage(name, tuple(families), tuned, entry["window"], population, generations), rows


def refine(
    config: Mapping[str, Any], folder: Path, space: Space, simulator: Simulator, batch: ManoeuvreBatch, manoeuvres: Sequence[int],
    start: np.ndarray,
) -> RefinementResult:  # fmt: skip
    """Fits by least squares on all manoeuvres of the fit, indices into a batch."""
    settings, path = config["sysid"], folder / "refine.json"
    digest = result_file.digest({"refine": settings["refine"], "start": start.tolist(), "shared": _shared_settings(config)})
    refined = _read(path, digest, RefinementResult) if config["resume"] else None
    if refined is None:
        weights, index = optimization.weight_row(settings["weights"]), np.asarray(manoeuvres)

        def residuals(candidates: np.ndarray) -> np.ndarray:
            pairs = np.repeat(candidates, len(index), axis=0), np.tile(index, len(candidates))
            paths = candidate_simulation.trace_pairs(simulator, *pairs, batch, width=settings["width"])
            parts = [slice(i * len(index), (i + 1) * len(index)) for i in range(len(candidates))]
            each = [jax.tree.map(lambda leaf, part=part: leaf[part], paths) for part in parts]
            return np.stack([candidate_simulation.residuals(path, batch, index, weights) for path in each])

        refined = optimization.refine(residuals, space, start, **settings["refine"], clock=time.perf_counter)
        result_file.write(path, {"made": digest, **refined._asdict()}, digits=None)
    LOG.info("least squares: %.4f -> %.4f, %d candidates", refined.start_loss, refined.loss, refined.evaluations)
    return refined


def _shared_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that every stage depends on."""
    settings = config["sysid"]
    car = {name: value for name, value in config["dynamics"]["car"].items() if name not in settings["space"]}
    fitted = {name: suite for name, suite in config["manoeuvres"].items() if name != "heldout"}
    shared = {"teacher": config["teacher"], "manoeuvres": fitted, "physics_hz": config["physics_hz"]}
    shared["dynamics"] = {**config["dynamics"], "car": car}
    return shared | {name: settings[name] for name in ("seed", "friction", "weights", "space", "search", "every")}


def _read(path: Path, digest: str, kind: type) -> Any:
    """The result of an earlier run if it was made with these settings, else None."""
    content = result_file.read(path) if path.is_file() else {"made": None}
    if content.pop("made") != digest:
        return None
    return kind(**{name: np.array(value) if isinstance(value, list) else value for name, value in content.items()})


def evaluate_car(
    suites: Suites, batch: ManoeuvreBatch, car: Simulator, values: np.ndarray, settings: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any], dict[str, candidate_simulation.CandidatePath]]:
    """Computes the errors and the responses of a car on every manoeuvre by suite, and its traces by manoeuvre."""
    row, errors, responses, traces = optimization.weight_row(settings["weights"]), {}, {}, {}
    index = np.arange(len(batch.frames))
    paths = candidate_simulation.trace_pairs(car, np.tile(values, (len(index), 1)), index, batch, width=settings["width"])
    single = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], paths) for i in index]
    losses = [float((candidate_simulation.residuals(trace, batch, index[i : i + 1], row) ** 2).sum()) for i, trace in enumerate(single)]
    first = 0
    for suite, recordings in suites.items():
        rows = slice(first, first + len(recordings))
        path, first = jax.tree.map(lambda leaf, rows=rows: leaf[rows], paths), rows.stop
        errors[suite] = {
            "name": [recording.manoeuvre.name for recording in recordings],
            "family": [recording.manoeuvre.family for recording in recordings],
            "frames": [len(recording.yaw) for recording in recordings],
            "loss": losses[rows],
            **error_metrics.compute_errors(path, recordings)._asdict(),
        }
        responses[suite] = response_metrics.measure_paths(path, recordings)._asdict()
        traces |= {name: jax.tree.map(lambda leaf: leaf[0], trace) for name, trace in zip(errors[suite]["name"], single[rows], strict=True)}
    return errors, responses, traces


def draw_tyres(structures: Mapping[str, Mapping[str, Any]], fits: Mapping[str, Fit]) -> dict[str, Any]:
    """Computes friction against slip of the teacher's tyre and of each fitted one on dry road."""
    curves = {"teacher": tyre_curves.compute_reference_curves(multibody_model.Vehicle(make_reference(structures["fitted"])))}
    for name, structure in structures.items():
        car, _ = cars.read_parameters(structure["dynamics"])
        friction, row = structure["sysid"]["friction"], jnp.asarray(fits[name].refined.best)
        fitted, mu = parameter_space.set_parameters(fits[name].space, car, friction, row)
        curves[name] = tyre_curves.compute_curves(fitted, float(mu[0]), speed=TYRE_SPEED)
    return {"slip": tyre_curves.SLIP, "slip_angle_deg": tyre_curves.SLIP_ANGLE_DEG, "curves": curves}


def sample_traces(suites: Suites, samples: Sequence[str], traces: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Returns sample -> teacher and cars -> time, position, speed and yaw rate at 10 Hz.

    Without a sample among the manoeuvres, the first manoeuvre of each suite.
    """
    stride = round(manoeuvres.RATE_HZ / 10.0)
    recorded = {recording.manoeuvre.name: recording for recordings in suites.values() for recording in recordings}
    names = [name for name in samples if name in recorded] or [recordings[0].manoeuvre.name for recordings in suites.values()]

    def sample(teacher: ManoeuvreRecording) -> dict[str, Any]:
        paths = {car: paths[teacher.manoeuvre.name] for car, paths in traces.items()}
        columns = {"teacher": (teacher.position, teacher.speed, teacher.yaw_rate)}
        columns |= {car: (path.position, path.pace, path.yaw_rate) for car, path in paths.items()}
        time_s, keys = np.arange(1, len(teacher.yaw) + 1) / manoeuvres.RATE_HZ, ("time_s", "position", "speed", "yaw_rate")
        thin = lambda column: np.round(np.asarray(column, float)[: len(time_s) : stride], 4)  # noqa: E731
        return {car: dict(zip(keys, map(thin, (time_s, *values)), strict=True)) for car, values in columns.items()}

    return {name: sample(recorded[name]) for name in names}
