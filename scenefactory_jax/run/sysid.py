"""`sysid`: fit the articulated car to the teacher, stage by stage, and write what came out.

Every stage writes `out/stages/NAME.json` as soon as it is done; with `resume=true` a stage is kept if it was made with the same settings.
"""

import contextlib
import functools
import hashlib
import json
import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.build import ConfigError, build
from scenefactory_jax.dynamics import car as cars
from scenefactory_jax.report import sysid as report
from scenefactory_jax.report import verdicts
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, sources
from scenefactory_jax.sysid import fit, heldout, manoeuvres, measure, multibody, space, student, teacher
from scenefactory_jax.sysid.fit import Outcome, Refined, Score, Stage
from scenefactory_jax.sysid.manoeuvres import Recording
from scenefactory_jax.sysid.space import Space
from scenefactory_jax.sysid.student import Replay, Suite


def sysid(config: Mapping[str, Any]) -> dict[str, Any]:
    """Fit a config's car (`load("sysid", "sysid=full")`).

    Returns:
        What is in `out/result.json`: the stages, the refinement, the fitted numbers with their spread, and how well each car drives the
        manoeuvres of the fit and those kept out of it.

    Raises:
        ConfigError: a key or number that does not fit, by name; a missing teacher package.
    """
    keys.check(config, keys.SYSID)
    sources.use_compilation_cache()
    out, settings = Path(config["out"]), config["sysid"]
    (out / "stages").mkdir(parents=True, exist_ok=True)
    known = recorded(config, out)
    lessons = [*known["training"], *known["extra"]][:: settings["every"]]
    where = space.make(settings["space"])
    replay = student.make(config["dynamics"], where, settings["friction"], physics_hz=config["physics_hz"])
    plan = student.suite(lessons)
    score = student.scorer(replay, plan, width=settings["width"])
    begin = space.start(where, numbers(config["dynamics"]), settings["friction"])
    outcomes = stages(config, out, lessons, where, score, begin)
    refined = refinement(config, out, where, replay, plan, outcomes[-1].best)
    places, along = fit.slices(score, where, refined.best, range(len(lessons)), weights=settings["weights"], **settings["slices"])
    cars = {"fitted": (replay, where, refined.best), "default": (replay, where, begin), "published": published(config)}
    judged = {name: judge(known, *car, weights=settings["weights"], samples=settings["samples"]) for name, car in cars.items()}
    result = {
        "command": configs.command("sysid"),
        "versions": configs.versions(),
        "manoeuvres": {name: len(recordings) for name, recordings in {"fit": lessons, **known}.items()},
        "space": where._asdict(),
        "default": begin,
        "stages": outcomes,
        "refined": refined,
        "slices": {"place": places, "loss": along},
        "seconds": sum(outcome.seconds for outcome in outcomes) + refined.seconds,
        "cars": {name: suites for name, (suites, _) in judged.items()},
        "samples": shown(known, settings["samples"], {name: traces for name, (_, traces) in judged.items()}),
    }
    _write(out / "result.json", result)
    result = json.loads((out / "result.json").read_text())
    found = report.verdicts(result, settings["targets"])
    print(f"{report.write(out, result, settings['targets'])}\n{verdicts.text(found)}", flush=True)
    return result


def judge(
    known: Mapping[str, Sequence[Recording]],
    replay: Replay,
    where: Space,
    row: np.ndarray,
    *,
    weights: Mapping[str, float],
    samples: Sequence[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """How one car drives the manoeuvres of the fit and those kept out of it: measures of every manoeuvre, and traces of the samples."""
    del where
    found, traces = {}, {}
    for name, recordings in known.items():
        plan, index = student.suite(recordings), np.arange(len(recordings))
        rows = jnp.asarray(np.tile(row, (len(index), 1)), jnp.float32)
        path = jax.tree.map(np.asarray, replay.trace(rows, jnp.asarray(index), plan))
        one = lambda i, path=path: jax.tree.map(lambda leaf: leaf[i : i + 1], path)  # noqa: E731
        squares = [student.residuals(one(i), plan, index[i : i + 1], fit.weight_row(weights)) for i in index]
        found[name] = {
            "name": [recording.manoeuvre.name for recording in recordings],
            "family": [recording.manoeuvre.family for recording in recordings],
            "loss": [float((square**2).sum()) for square in squares],
            **measure.measure(path, recordings)._asdict(),
        }
        named = [(i, name) for i, name in enumerate(found[name]["name"]) if name in samples]
        traces |= {name: jax.tree.map(lambda leaf, i=i: leaf[i], path) for i, name in named}
    return found, traces


def shown(known: Mapping[str, Sequence[Recording]], samples: Sequence[str], traces: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
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

    return {name: sample(name) for name in samples if name in taught}


def published(config: Mapping[str, Any]) -> tuple[Replay, Space, np.ndarray]:
    """The published car, with its own friction of the surfaces and nothing left open."""
    nothing = space.make({})
    replay = student.make(config["others"]["published"], nothing, config["sysid"]["published_friction"], physics_hz=config["physics_hz"])
    return replay, nothing, np.zeros(0)


def recorded(config: Mapping[str, Any], out: Path) -> dict[str, list[Recording]]:
    """What the teacher did on the published manoeuvres, on ours and on those kept out of the fit: from files of these settings, or now."""
    instructor = build(config["teacher"], builtins=multibody, where="teacher")(numbers(config["dynamics"]))
    suites = {"training": manoeuvres.training, "extra": manoeuvres.extra, "heldout": functools.partial(heldout.heldout, teacher=instructor)}
    found = {}
    with contextlib.ExitStack() as stack:
        for name, suite in suites.items():
            path, entries = out / f"{name}.npz", config["manoeuvres"][name]
            made = _digest({"car": config["dynamics"]["car"], "teacher": config["teacher"], "manoeuvres": entries})
            if path.is_file():
                try:
                    found[name] = teacher.load(path, digest=made)
                    continue
                except ConfigError:
                    print(f"{path}: of other settings, recorded anew", flush=True)
            begun = time.perf_counter()
            drive = functools.partial(teacher.record, teacher=instructor)
            found[name] = list(_mapping(config["workers"], stack)(drive, suite(entries)))
            teacher.save(path, found[name], digest=made)
            print(f"{path}: {len(found[name])} manoeuvres driven by the teacher in {time.perf_counter() - begun:.0f} s", flush=True)
    return found


def _mapping(workers: int, stack: contextlib.ExitStack) -> Any:
    """`map`, in this process or over several."""
    if workers == 1:
        return map
    return stack.enter_context(ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))).map


def numbers(dynamics: Mapping[str, Any]) -> cars.CarParameters:
    """The car of a config's dynamics."""
    return build({**dynamics["car"], "_target_": "CarParameters"}, builtins=cars.__name__, where="dynamics.car")()


def stages(
    config: Mapping[str, Any], out: Path, lessons: Sequence[Recording], where: Space, score: Score, begin: np.ndarray
) -> list[Outcome]:  # fmt: skip
    """The search, each stage from where the one before ended."""
    settings = config["sysid"]
    found: dict[str, Outcome] = {}
    for place, (name, entry) in enumerate(settings["stages"].items()):
        stage, rows = _stage(name, entry, settings, where, lessons)
        start = begin.copy()
        if entry["restores"] is not None:  # the published fifth stage: what the first found for its parameters, once more
            tuned = [where.names.index(parameter) for parameter in stage.tuned]
            start[tuned] = found[entry["restores"]].best[tuned]
        made = _digest({"stage": entry, "budget": settings["budget"][name], "start": start.tolist(), "settings": _shared(config)})
        path = out / "stages" / f"{place + 1}_{name}.json"
        outcome = _kept(path, made, Outcome) if config["resume"] else None
        if outcome is None:
            outcome = fit.search(
                score, where, start, stage, rows, seed=settings["seed"] + place + 1, weights=settings["weights"], **settings["search"],
                clock=time.perf_counter, tell=lambda line: print(line, flush=True),
            )  # fmt: skip
            _write(path, {"made": made, **outcome._asdict()})
        print(f"{name}: {outcome.start_loss:.4f} -> {outcome.loss:.4f}, {outcome.evaluations} candidates on {len(rows)} manoeuvres, "
              f"{outcome.seconds:.0f} s", flush=True)  # fmt: skip
        found[name], begin = outcome, outcome.best
    return list(found.values())


def _stage(
    name: str, entry: Mapping[str, Any], settings: Mapping[str, Any], where: Space, lessons: Sequence[Recording]
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


def refinement(config: Mapping[str, Any], out: Path, where: Space, replay: Replay, plan: Suite, begin: np.ndarray) -> Refined:
    """Least squares on all manoeuvres."""
    settings = config["sysid"]
    path, made = out / "stages" / "refine.json", _digest({"refine": settings["refine"], "start": begin.tolist(), "shared": _shared(config)})
    found = _kept(path, made, Refined) if config["resume"] else None
    if found is None:
        weights, index = fit.weight_row(settings["weights"]), np.arange(len(plan.frames))
        together = max(1, settings["width"] // len(index) // 4)  # candidates whose whole traces are on the device at once

        def piece(some: np.ndarray) -> list[np.ndarray]:
            pairs = jnp.asarray(np.repeat(some, len(index), axis=0), jnp.float32), jnp.asarray(np.tile(index, len(some)))
            path = jax.tree.map(np.asarray, replay.trace(*pairs, plan))
            each = [slice(i * len(index), (i + 1) * len(index)) for i in range(len(some))]
            return [student.residuals(jax.tree.map(lambda leaf, own=own: leaf[own], path), plan, index, weights) for own in each]

        def residuals(rows: np.ndarray) -> np.ndarray:
            pieces = [np.resize(rows[i : i + together], (together, rows.shape[1])) for i in range(0, len(rows), together)]
            return np.stack([row for some in pieces for row in piece(some)][: len(rows)])

        found = fit.refine(residuals, where, begin, **settings["refine"], clock=time.perf_counter)
        _write(path, {"made": made, **found._asdict()})
    print(f"least squares: {found.start_loss:.4f} -> {found.loss:.4f}, {found.evaluations} candidates", flush=True)
    return found


def _shared(config: Mapping[str, Any]) -> dict[str, Any]:
    """What every stage depends on."""
    names = ("seed", "friction", "weights", "space", "search", "every")
    rest = {name: config[name] for name in ("dynamics", "teacher", "manoeuvres", "physics_hz")}
    return {**rest, **{name: config["sysid"][name] for name in names}}


def _digest(settings: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def _write(path: Path, content: Mapping[str, Any]) -> None:
    """All of it or nothing."""
    half = path.with_suffix(".part")
    half.write_text(json.dumps(plain(content)) + "\n")
    half.replace(path)


def _kept(path: Path, made: str, kind: type) -> Any:
    """What an earlier run left, if it was made with these settings."""
    if not path.is_file():
        return None
    content = json.loads(path.read_text())
    if content.pop("made") != made:
        return None
    return kind(**{name: np.array(value) if isinstance(value, list) else value for name, value in content.items()})


def plain(value: Any) -> Any:
    """Arrays and tuples as lists, what is not a number as null, for JSON."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value
