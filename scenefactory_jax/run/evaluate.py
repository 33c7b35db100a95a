"""`evaluate`: a run's policy on held-out scenes -> per-agent records, tables with intervals, a report and a video."""

import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from scenefactory_jax import evaluation, world
from scenefactory_jax.build import ConfigError
from scenefactory_jax.ppo import checkpoint
from scenefactory_jax.report import tables
from scenefactory_jax.report.canvas import Others, Trajectory
from scenefactory_jax.run import config as configs
from scenefactory_jax.run import keys, log, sources
from scenefactory_jax.run.train import make_policy
from scenefactory_jax.struct import replace
from scenefactory_jax.types import SURFACES, Weather

PROTOCOLS = {"strict": ["strict"], "invincible": ["invincible"], "both": ["strict", "invincible"]}


class Result(NamedTuple):
    """What `evaluate` hands back in Python: protocol -> records, protocol -> metric -> estimate, and the report's place."""

    folder: Path
    records: dict[str, dict[str, np.ndarray]]
    summary: dict[str, dict[str, tables.Estimate]]
    report: Path


def evaluate(config: Mapping[str, Any]) -> Result:
    """Evaluate a run as a config says (`load("evaluate", "run=...")`): deterministic policy, one episode a scene and repeat.

    Raises:
        ConfigError: no such run, no checkpoint in it, a setting that the run does not have.
        SceneError: scenes that cannot be read.
    """
    keys.check_evaluate(config)
    sources.use_compilation_cache()
    run = Path(config["run"])
    trained = configs.amend(configs.read(run), config["overrides"])
    wanted = {True: "invincible", False: "strict"}.get(config["invincible"], config["invincible"])
    if wanted not in PROTOCOLS:
        raise ConfigError(f"invincible: {config['invincible']!r}; valid: true, false, both")
    scenes = sources.heldout(trained["scenes"], path=config["scenes"]["path"])
    out = Path(config["out"]) if config["out"] else run / "evaluation"
    return judge(trained, run, scenes, out, settings=config, protocols=PROTOCOLS[wanted])


def after_training(config: Mapping[str, Any], folder: Path) -> Result:
    """The evaluation that ends `train`: held-out scenes, the run's own settings."""
    settings = config["evaluation"]
    scenes = sources.heldout(config["scenes"], path=None)
    return judge(config, folder, scenes, folder, settings=settings, protocols=settings["protocols"])


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
    config: Mapping[str, Any], run: Path, scenes: sources.Scenes, out: Path, *, settings: Mapping[str, Any], protocols: list[str]
) -> Result:
    """Play every protocol with the trained and, if asked for, the untrained policy; write records, report and video to `out`."""
    from scenefactory_jax.run import reporting

    out.mkdir(parents=True, exist_ok=True)
    print(scenes.account, flush=True)
    parameters = {"trained": checkpoint.restore_parameters(run / "checkpoints")}
    if settings["untrained"]:
        parameters["untrained"] = checkpoint.restore_parameters(run / "untrained")
    records, trajectories = {}, []
    for number, protocol in enumerate(protocols):
        film = settings["video"]["worlds"] if settings["video"]["enable"] and number == 0 else 0
        examine = make_examiner(config, scenes, protocol=protocol, settings=settings, film=film)
        for name, values in parameters.items():
            label = protocol if name == "trained" else f"{protocol}, {name}"
            records[label], recorded = examine(values)
            trajectories = trajectories or recorded
            tables.write_csv(out / f"agents-{label.replace(', ', '-')}.csv", records[label])
    summary = {label: tables.summarise(rows, bootstrap=settings["bootstrap"], seed=settings["seed"]) for label, rows in records.items()}
    report = reporting.write(out, config=config, run=run, settings=settings, records=records, summary=summary, trajectories=trajectories)
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
    env, policy = world.make({**config, "ends": configs.load("task", f"ends={protocol}")["ends"]}), make_policy(config)
    index = np.tile(np.arange(len(scenes)), settings["repeats"])
    names = [scenes.names[i] for i in index]
    batch = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[index], scenes.scene))
    keys = jax.random.split(jax.random.key(settings["seed"]), len(index))
    control_hz, chunk = float(config["timing"]["control_hz"]), settings["chunk_steps"]
    limit, filmed = world.episode_steps(config["timing"]), round(settings["video"]["seconds"] * control_hz)

    def act(parameters, observation):
        return policy.apply(parameters, observation)[0]

    @jax.jit
    def begin(keys, batch):
        return jax.vmap(functools.partial(evaluation.begin, env))(keys, batch)

    @functools.partial(jax.jit, donate_argnums=2)
    def play(parameters, batch, episode):
        one = functools.partial(evaluation.play, env, act, parameters, steps=chunk, ttc_limit_s=settings["ttc_limit_s"])
        episode, frames = jax.vmap(one)(batch, episode)
        return episode, jax.tree.map(lambda leaf: leaf[:film], frames)

    def examine(parameters):
        episode = begin(keys, batch)
        present, started, weather = jax.device_get((episode.state.agents.present, episode.tally.goal_distance, episode.state.weather))
        kept = []
        for step in range(0, limit, chunk):
            episode, frames = play(parameters, batch, episode)
            if step < filmed:
                kept.append(jax.device_get(frames))
            if bool(episode.over.all()):
                break
        records = _records(jax.device_get(episode), present, started, weather, names, seed=settings["seed"], control_hz=control_hz)
        return records, _trajectories(kept, episode, batch, weather, names, filmed, control_hz) if film else []

    return examine


def _records(
    episode, present, started, weather: Weather, names: list[str], *, seed: int, control_hz: float
) -> dict[str, np.ndarray]:
    """One row for every spawned agent of every world; film and surface are the open road's at the start."""
    tally, state = episode.tally, episode.state
    row_world, row_agent = np.nonzero(present)
    of = lambda leaf: np.asarray(leaf)[row_world, row_agent]  # noqa: E731
    events = {name: of(value) for name, value in vars(tally.happened).items()}
    others = events["collided"] | events["crashed"] | events["touched_edge"] | events["fault"]
    steps = np.maximum(of(tally.steps), 1)
    seen = of(tally.ttc_steps)
    return {
        "scene": np.array(names)[row_world],
        "world": row_world,
        "seed": np.full(len(row_world), seed),
        "agent": row_agent,
        **events,
        "clean": events["reached"] & ~others,
        "time_s": of(tally.steps) / control_hz,
        "route_m": of(state.agents.route),
        "start_distance_m": of(started),
        "end_distance_m": of(tally.goal_distance),
        "max_drac": of(tally.drac_max),
        "min_ttc_s": of(tally.ttc_min),
        "mean_ttc_s": of(tally.ttc_sum) / np.maximum(seen, 1),
        "has_ttc": seen > 0,
        "mean_speed": of(tally.speed_sum) / steps,
        "max_contact_force_n": of(tally.force_max),
        "film_mm": np.asarray(weather.film_mm)[row_world],
        "surface": np.array(SURFACES)[np.asarray(weather.surface)[row_world]],
        "friction": of(tally.grip_sum) / steps,
    }


def _trajectories(
    kept: list, episode, batch, weathers: Weather, names: list[str], steps: int, control_hz: float
) -> list[Trajectory]:
    """The filmed worlds as a viewer wants them: cut where the last car finished."""
    frames = jax.tree.map(lambda *chunks: np.concatenate(chunks, axis=1)[:, :steps], *kept)
    found = []
    for index in range(frames.active.shape[0]):
        scene = jax.device_get(jax.tree.map(lambda leaf, i=index: leaf[i], batch))
        live = np.flatnonzero(frames.active[index].any(axis=1))
        end = min((live[-1] if len(live) else 0) + round(control_hz), frames.active.shape[1])
        cut = lambda leaf, i=index, end=end: leaf[i, :end]  # noqa: E731
        weather = jax.tree.map(lambda leaf, i=index: leaf[i], weathers)
        agents = jax.device_get(jax.tree.map(lambda leaf, i=index: leaf[i], episode.state.agents))
        found.append(
            Trajectory(
                scene=replace(scene, weather=weather),
                position=cut(frames.position),
                yaw=cut(frames.yaw),
                speed=cut(frames.speed),
                active=cut(frames.active),
                events={name: cut(value) for name, value in vars(frames.events).items()},
                size=agents.size,
                goal=cut(frames.goal),
                present=agents.present,
                control_hz=control_hz,
                title=names[index],
                weather=_describe(weather, seconds=end / control_hz),
                others=Others(*(cut(getattr(frames.others, name)) for name in Others._fields)),
            )
        )
    return found


def _describe(weather: Weather, *, seconds: float) -> str:
    """Surface and film of the open road at the start, and the film at the end where that is another."""
    rain, first = weather.rain, f"{float(weather.film_mm):.1f}"
    last = f"{np.interp(seconds, rain.time_s, rain.film_mm):.1f}" if len(rain.time_s) else first
    return f"{SURFACES[int(weather.surface)]}, {first} mm" if first == last else f"{SURFACES[int(weather.surface)]}, {first} to {last} mm"
