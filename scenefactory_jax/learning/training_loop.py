"""Trains a policy: scenes, an environment and an algorithm -> a run folder with checkpoints and metrics."""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from scenefactory_jax import loggers
from scenefactory_jax.core import config as configs
from scenefactory_jax.core import distributed, sharding
from scenefactory_jax.core.instantiate import ConfigError, instantiate, resolve_target
from scenefactory_jax.core.types import Env, Policy, Scene
from scenefactory_jax.data.loading import scene_source, stream
from scenefactory_jax.env import environment
from scenefactory_jax.env.action_settings import refuse_rates
from scenefactory_jax.learning import checkpoint, interrupt, past_policies, run_folder, run_paths, sample_stream
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.ppo import train_iteration as ppo
from scenefactory_jax.learning.sample_stream import SampleStream
from scenefactory_jax.learning.trainer import Trainer, TrainState, count_spawned_steps, get_policy_parameters
from scenefactory_jax.loggers import metrics_csv

LOG = logging.getLogger(__name__)
YEAR_S = 31_557_600.0  # a Julian year
OnIteration = Callable[[TrainState, Mapping[str, float | int]], None]
MakeCallback = Callable[[Path, int | None], Callable[[Any, Mapping[str, float | int]], None] | None]


class Prepared(NamedTuple):
    """Shared parts of runs that differ only in seed, scenes or budget, so that they compile once.

    `scenes`: to train on, before `scenes.take`; None: they are read again.
    """

    env: Env
    policy: Policy
    mesh: Mesh | None
    trainer: Trainer
    scenes: scene_source.Scenes | None = None


class Streams(NamedTuple):
    """What comes from the disk while a run trains; None: nothing of the kind."""

    scenes: stream.SceneStream | None
    samples: SampleStream | None

    def state(self) -> dict[str, Any] | None:
        """All that the next scenes and samples depend on, as JSON values."""
        state = {} if self.scenes is None else self.scenes.state()
        return state | ({} if self.samples is None else {"samples": self.samples.state()}) or None


class Run(NamedTuple):
    """The result of `train`."""

    folder: Path
    config: dict[str, Any]
    env: Env
    policy: Policy
    state: TrainState
    metrics: list[dict[str, float]]


def prepare(config: Mapping[str, Any]) -> Prepared:
    """Builds environment, policy and trainer of a config; a ConfigError for one that does not fit."""
    patches = (config["weather"].get("patches") or {}).items()
    if config["stream"] and (read := [name for name, entry in patches if entry and entry["_target_"] == "scene_patches"]):
        raise ConfigError(f"weather.patches.{read[0]}: expected stream=none, as streams do not read the patches of scenes, got a stream")
    env, policy, mesh = environment.make_env(config), make_policy(config), sharding.make_mesh(config["devices"])
    return Prepared(env, policy, mesh, make_trainer(config, env, policy, mesh=mesh))


def train(
    config: dict[str, Any],
    *,
    on_iteration: OnIteration | None = None,
    prepared: Prepared | None = None,
    make_callback: MakeCallback | None = None,
    finish: Callable[[Path], Any] | None = None,
) -> Run:
    """Trains as a config says (`load_config("train", ...)`).

    Args:
        on_iteration: called on the host with (train state, metrics row) after each iteration, for notebooks and sweeps. The state is
            donated to the next iteration: copy what is to outlive the call.
        prepared: `prepare` of a config with the same environment, policy, algorithm and devices; None: this config's.
        make_callback: (folder, iteration that the run resumes at or None) -> function of (parameters, metrics row) to call after each
            iteration, or None.
        finish: called with the folder after the last iteration, before the folder's lock is released.

    Raises:
        ConfigError: a key that does not fit, held-out scenes that cannot be used, a run folder that exists or is in use, nothing to resume.
        SceneError: scenes that cannot be read.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, after the iteration ended and its checkpoint is written.
    """
    watching = loggers.make(config["loggers"])
    scene_source.use_compilation_cache()
    prepared = prepared or prepare(config)
    trainer = Trainer(*(distributed.compile_together(name, part) for name, part in prepared.trainer._asdict().items()))
    with run_folder.open_run_folder(config) as (folder, resume):
        with contextlib.ExitStack() as stack:
            before = checkpoint.restore_host(folder / "checkpoints") if resume else None
            worlds, flow = stack.enter_context(_open_scenes(config, folder, prepared, before))
            state = trainer.init(jax.random.key(config["seed"]), worlds)
            if resume:
                state = checkpoint.restore(folder / "checkpoints", state)
                LOG.info(f"resumed at iteration {int(state.iteration)}")
            elif config["start_from"] is not None:
                state, taken = checkpoint.put_networks(run_paths.find(config["start_from"], key="start_from") / "checkpoints", state)
                LOG.info(f"starts from {config['start_from']}: {', '.join(path.strip('/') for path in taken)}")
            before = before and before.get("samples")
            samples = stack.enter_context(sample_stream.open_stream(config, trainer, state, mesh=prepared.mesh, before=before))
            first = int(state.iteration) if resume else None
            callbacks = [on_iteration] if on_iteration else []
            if distributed.is_first():
                configs.write(folder, config)  # once scenes and checkpoint are read: a failed start leaves no config
            if callback := make_callback and distributed.is_first() and make_callback(folder, first):
                callbacks.insert(0, lambda state, row: callback(get_policy_parameters(state), row))
            streams = Streams(flow, samples)
            state = _loop(config, folder, trainer, worlds, state, streams, watching, first=first, callbacks=callbacks)
        if finish is not None and distributed.is_first():
            finish(folder)
    return Run(folder, config, prepared.env, prepared.policy, state, metrics_csv.read(folder))


@contextlib.contextmanager
def _open_scenes(
    config: Mapping[str, Any], folder: Path, prepared: Prepared, before: Mapping[str, Any] | None
) -> Iterator[tuple[Scene, stream.SceneStream | None]]:
    """Loads the scenes of all worlds onto their devices; the second value is the stream of further scenes, if there is one."""
    if config["stream"] is None:
        if prepared.scenes is None:
            loaded = scene_source.load_training_scenes(config["scenes"])
        else:
            loaded = scene_source.take_scenes(prepared.scenes, config["scenes"])
        worlds, chosen = scene_source.assign_scenes(loaded, config["worlds"], seed=config["seed"], mesh=prepared.mesh)
        LOG.info(f"run {folder}\n{loaded.account}\n{chosen}")
        yield worlds, None
        return
    with stream.open_stream(config, mesh=prepared.mesh, before=before) as flow:
        worlds = flow.scenes()
        LOG.info(f"run {folder}")
        yield worlds, flow


def make_policy(config: Mapping[str, Any]) -> Policy:
    """Builds the policy of a config's `policy` entry.

    Planners are given the run's `dynamics`, encoders its `observations`, and networks the kind of actor and the number of values
    that its `learner` trains, and how many numbers of an action its `actions` read.

    Raises:
        ConfigError: an entry that does not fit; a planner, which acts by pedals, where actions are rates.
    """
    if "evaluation.planners" in str(config["policy"].get("_target_")):
        refuse_rates(config, what="a planner")
    names = {"dynamics": "dynamics", "observations": "observation_groups"}  # planners have numbers that are called observations
    context = {names[key]: config[key] for key in names if key in config}
    learner, actions = config.get("learner", {}), config.get("actions", {})
    context |= {name: part[name] for name, part in (("actor", learner), ("values", learner), ("numbers", actions)) if name in part}
    return instantiate(config["policy"], builtins=late_fusion, where="policy", **context)()


def make_trainer(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the learner of a config, on one device or on a mesh (`sharding.make_mesh`).

    The entry `learner` names a function (config, env, policy, mesh=) -> Trainer, and has the numbers that it reads.
    """
    make = resolve_target(config["learner"].get("_target_", ""), builtins=ppo, where="learner")
    if env.past is None:
        return make(config, env, policy, mesh=mesh)
    return past_policies.add_past_policies(lambda bound: make(config, bound, policy, mesh=mesh), env, policy, mesh=mesh)


def _loop(
    config: Mapping[str, Any],
    folder: Path,
    trainer: Trainer,
    worlds: Scene,
    state: TrainState,
    streams: Streams,
    watching: Mapping[str, loggers.Logger],
    *,
    first: int | None,
    callbacks: list[OnIteration],
) -> TrainState:
    """Iterates until `iterations` or `minutes` is reached; every row is written to metrics.csv before the next iteration starts.

    Of several processes the first one writes, and all end after the same iteration.

    `minutes` counts iterations, not checkpoints or evaluations, and not the first iteration of each process, which compiles, so that equal
    minutes are equal times of training. A signal ends the loop after the current iteration, with a checkpoint.

    Args:
        first: iteration that the run resumes at; None: a new run.
    """
    total, start, writes = config["iterations"], first or 0, distributed.is_first()
    file = metrics_csv.MetricsFile(folder, resume_at=first) if writes else None
    spent, years = (file.rows[-1].get(name, 0.0) if file and file.rows else 0.0 for name in ("minutes", "years"))
    with (
        interrupt.defer_interrupt() as get_signal,
        loggers.open_loggers(watching if writes else {}, folder, config, after=start) as log,
        metrics_csv.progress(total, enable=config["progress"] and writes, start=start) as show,
    ):
        for iteration in range(start + 1, total + 1):
            before = time.monotonic()
            state, worlds, row = step(trainer, state, worlds, streams, first=iteration == 1)
            seconds = time.monotonic() - before
            spent += seconds / 60 if iteration > start + 1 else 0.0
            row = {"iteration": iteration, "minutes": spent, "steps/total": count_spawned_steps(state), **row, "seconds": seconds}
            row["casps"] = row["steps/spawned"] / seconds
            row |= count_years(row, years, control_hz=config["timing"]["control_hz"])
            years = row["years"]
            row |= {f"{name}_per_s": row[f"steps/{name}"] / seconds for name in ("updates", "samples") if f"steps/{name}" in row}
            if file is not None:
                file.add(row)
            log(row)
            show(iteration, describe(row))
            check_finite(row)
            for callback in callbacks:
                callback(state, row)
            late = config["minutes"] is not None and spent >= config["minutes"]
            late, stop = distributed.share_stop(iteration, late=late, signal=get_signal())
            if late or stop or iteration == total or iteration % config["checkpoint_every"] == 0:
                checkpoint.save(folder / "checkpoints", state, keep=config["checkpoints_kept"], host=streams.state())
            if stop:
                interrupt.end(folder, iteration, stop)
            if late:
                break
    return state


def count_years(row: Mapping[str, float | int], before: float, *, control_hz: float | int) -> dict[str, float]:
    """Counts the years that active agents have driven since the run began, and those of this iteration in an hour of the clock."""
    driven = row.get("steps/active", 0.0) / control_hz / YEAR_S
    return {"years": before + driven, "years_per_hour": 3600.0 * driven / row["seconds"]}


def check_finite(row: Mapping[str, float | int]) -> None:
    """Checks that the iteration could learn: a reward term that is not finite may have made every sample unusable.

    A car whose state is not finite ends as `numerical_error`; then single minibatches are left out (`ppo/skipped`), which is no error.

    Raises:
        ConfigError: naming the terms.
    """
    terms = [name for name, value in row.items() if name.startswith("reward/") and not math.isfinite(value)]
    if terms and any(row[f"{name}/gradient_norm"] == 0.0 for name in _find_unusable(row)):
        values = ", ".join(f"{name.replace('/', '.')}: {row[name]}" for name in terms)
        raise ConfigError(
            f"{values} in iteration {row['iteration']}, so no minibatch could be learnt from;"
            " look for a division by zero, or a log or root below zero, or leave it out: ~" + terms[0].replace("/", ".")
        )


def _find_unusable(row: Mapping[str, float | int]) -> list[str]:
    """Finds the learners that skipped minibatches, or whose buffer is still empty."""
    learners = [name.removesuffix("/gradient_norm") for name in row if name.endswith("/gradient_norm")]
    return [name for name in learners if row.get(f"{name}/skipped", 0) > 0 or row.get(f"{name}/buffer") == 0.0]


def step(
    trainer: Trainer, state: TrainState, worlds: Scene, streams: Streams, *, first: bool
) -> tuple[TrainState, Scene, dict[str, float | int]]:
    """Makes one iteration, with the streams' next scenes in some worlds and next samples; gives its metrics on the host."""
    flow, samples = streams
    if samples is not None:
        state = samples.exchange(trainer.put_samples, state)
    if flow is not None and not first:
        state, worlds = flow.exchange(trainer.replace_scenes, state, worlds)
    state, metrics = trainer.train_iteration(state, worlds)
    if flow is not None:
        flow.draw()  # while the devices compute
    metrics, stats = jax.device_get((metrics, state.scene_stats))
    row = {name: float(value) for name, value in metrics.items()}
    return state, worlds, row if flow is None else row | flow.note(stats.episodes, stats.successes)


def describe(row: Mapping[str, float | int]) -> str:
    """Describes a row of metrics in one line."""
    names = {"goal_reached": "goal", "collision": "collision", "road_edge_contact": "edge", "out_of_bounds": "crash"}
    rates = " ".join(f"{label} {100 * row[f'events/{name}']:.0f}%" for name, label in names.items() if f"events/{name}" in row)
    speed = f"{row['casps']:,.0f} steps/s" if row["casps"] else f"{row.get('samples_per_s', 0.0):,.0f} samples/s"
    return f"{rates} | {speed}"
