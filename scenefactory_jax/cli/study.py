"""`study`: an experiment from one config: trains and evaluates what is missing, and reports what there is.

A study may be stopped at any moment and called again: trainings continue from their last checkpoint, and nothing is trained or evaluated
twice with the same settings, also across studies.
"""

import datetime
import functools
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import study_plan, study_results
from scenefactory_jax.cli.evaluate import make_training_callback
from scenefactory_jax.cli.study_plan import Evaluation, Plan, Training
from scenefactory_jax.cli.study_results import RESULT, TRAINED
from scenefactory_jax.core import atomic_file, folder_lock, result_file
from scenefactory_jax.core.parallel import gpu_processes
from scenefactory_jax.core.parallel.gpu_processes import TaskClaims
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation.protocols import Evaluator, make_evaluator
from scenefactory_jax.evaluation.records import write_records
from scenefactory_jax.learning import checkpoint, policy_io, training_loop

COMPILATION_S = 120.0  # estimate of what a training takes beside its minutes, before one of its kind has ended
COUNTS = ("policies", "curve points", "seconds")  # of uses of the held-out scenes

Task = TypeVar("Task", Training, Evaluation)


def study(config: Mapping[str, Any]) -> dict[str, Any]:
    """Runs a study as a config says (`load_config("study", "study=navigation", ...)`).

    Returns:
        The contents of result.json: see `study_results.collect`; without the part `report`, those it had before.

    Raises:
        ConfigError: a key, a name or an override that does not fit, by name.
        SceneError: scenes that cannot be read.
    """
    single = {name: [config[name]] for name in ("parts", "only", "seeds") if isinstance(config[name], (str, int))}
    clock, config = Clock(config["time_limit_s"]), {**config, **single}
    if config["parts"] == ["draw"]:
        return study_results.draw(config)
    plan = study_plan.make(config)
    scene_source.use_compilation_cache()
    out = study_results.find_folder(config)
    uses = HeldOutUses(out / RESULT, command=_format_command(config), cut=config["cut"])
    run = _run_part if config["processes"] == 1 else _run_part_in_processes
    if not all(run(part, config, plan, uses, clock) for part in ("train", "evaluate") if part in config["parts"]):
        print("stopped at the time limit; the same command continues", flush=True)
    if "report" not in config["parts"]:
        return uses.read_result()
    return study_results.write(plan, config, out, before=uses.read_result())


def _run_part(
    part: str, config: Mapping[str, Any], plan: Plan, uses: "HeldOutUses", clock: "Clock", claims: TaskClaims | None = None
) -> bool:
    """Runs one part in this process and returns whether all of it was done."""
    work = _train if part == "train" else _evaluate
    return work(plan, Session(config, uses, claims or TaskClaims(None)), clock)


def _run_part_in_processes(part: str, config: Mapping[str, Any], plan: Plan, uses: "HeldOutUses", clock: "Clock") -> bool:
    """Runs one part in several processes, `per_gpu` on each GPU."""
    with tempfile.TemporaryDirectory() as name:
        folder, remaining = Path(name), {**config, "time_limit_s": clock.remaining_s()}
        try:
            done = gpu_processes.run_on_gpus(_run_tasks, config["processes"], part, remaining, folder, per_gpu=config["per_gpu"])
        finally:
            for file in sorted(folder.glob("*-uses.json")):
                uses.add_all(result_file.read(file)["held_out_uses"])
    return all(done)


def _run_tasks(index: int, part: str, config: Mapping[str, Any], folder: Path) -> bool:
    """Runs the tasks that one of several processes claims."""
    scene_source.use_compilation_cache()
    uses = HeldOutUses(folder / f"{index}-uses.json", command="", cut=config["cut"])
    return _run_part(part, config, study_plan.make(config), uses, Clock(config["time_limit_s"]), TaskClaims(folder))


class Clock:
    """Time since the command began."""

    def __init__(self, limit_s: float | None):
        self._start, self._limit_s = time.monotonic(), limit_s

    def remaining_s(self) -> float | None:
        """Seconds until the limit; None: there is no limit."""
        return None if self._limit_s is None else max(0.0, self._limit_s - (time.monotonic() - self._start))

    def fits(self, seconds: float, *, task: str) -> bool:
        """Whether a task of so many seconds ends before the limit. One that is longer than the whole limit starts: it can be resumed."""
        remaining = self.remaining_s()
        if remaining is None or self._limit_s is None:
            return True
        if remaining == 0 or remaining < seconds <= self._limit_s:
            print(f"{task}: would take about {seconds:.0f} s, {remaining:.0f} s remain", flush=True)
            return False
        return True


class HeldOutUses:
    """Counts how often the held-out scenes are evaluated, in result.json while it happens: numbers that choose settings are no test."""

    def __init__(self, file: Path, *, command: str, cut: str):
        self._file, self._index = file, None
        self._new: dict[str, Any] = {"date": datetime.date.today().isoformat(), "command": command, "cut": cut}
        self._new |= dict.fromkeys(COUNTS, 0)

    def count(self, evaluator: Evaluator, kind: str) -> Evaluator:
        """Returns the evaluator with a count of its calls, before each begins, and of their seconds."""

        @functools.wraps(evaluator)
        def counted(parameters):
            self._add({kind: 1})
            start = time.monotonic()
            records = evaluator(parameters)
            self._add({"seconds": time.monotonic() - start})
            return records

        return counted

    def add_all(self, uses: Iterable[Mapping[str, Any]]) -> None:
        """Adds the counts of other processes."""
        for one in uses:
            self._add({name: one[name] for name in COUNTS})

    def _add(self, counts: Mapping[str, float | int]) -> None:
        result = self.read_result()
        uses = result.setdefault("held_out_uses", [])
        if self._index is None:
            self._index = len(uses)
            uses.append(dict(self._new))
        for name, count in counts.items():
            uses[self._index][name] += count
        self._file.parent.mkdir(parents=True, exist_ok=True)
        result_file.write(self._file, result, digits=None)

    def read_result(self) -> dict[str, Any]:
        """Reads the file; {}: there is none."""
        return result_file.read(self._file) if self._file.is_file() else {}


class Session:
    """What the tasks of one process share: scenes, each read once, the count of uses, and the claims on tasks."""

    def __init__(self, config: Mapping[str, Any], uses: HeldOutUses, claims: TaskClaims):
        self.config, self.uses, self.claims = config, uses, claims
        self._scenes: dict[str, scene_source.Scenes] = {}

    def training_scenes(self, config: Mapping[str, Any]) -> scene_source.Scenes:
        """Before `scenes.take`."""
        entry = config["scenes"]
        return self._load_once("train " + study_plan.digest_scenes(entry, entry["path"]), scene_source.load_all_scenes, entry)

    def heldout_scenes(self, config: Mapping[str, Any]) -> scene_source.Scenes:
        """The scenes that policies are evaluated on."""
        entry, path = config["scenes"], self.config["test_scenes"]
        key = "test " + study_plan.digest_scenes(entry, path) + result_file.digest(entry["heldout"])
        return self._load_once(key, scene_source.load_heldout_scenes, entry, path=path)

    def _load_once(self, key: str, load, *arguments: Any, **keywords: Any) -> scene_source.Scenes:
        if key not in self._scenes:
            self._scenes[key] = load(*arguments, **keywords)
            print(self._scenes[key].account, flush=True)
        return self._scenes[key]

    def make_evaluator(self, evaluation: Evaluation, kind: str) -> Evaluator:
        """Makes the evaluator of a condition and protocol."""
        settings = {**evaluation.config["evaluation"], **self.config["evaluation"]}
        return self.uses.count(make_evaluator(evaluation.config, self.heldout_scenes(evaluation.config), settings=settings), kind)

    def claim_groups(self, tasks: Iterable[Task]) -> Iterable[tuple[str, list[Task]]]:
        """Groups tasks by program in the order in which programs first appear, those of no other process first."""
        groups: dict[str, list[Task]] = {}
        for task in tasks:
            groups.setdefault(task.program, []).append(task)
        return self.claims.shares(groups)

    def selects(self, variant: str) -> bool:
        """Whether the command selects a variant."""
        return self.config["only"] is None or variant in self.config["only"]


# ---- training


def _train(plan: Plan, session: Session, clock: Clock) -> bool:
    """Trains what is not trained yet, trainings of one program after the other, and returns whether all was done."""
    todo = {one.digest: one for one in plan.trainings if session.selects(one.variant) and not is_trained(one)}
    for _, group in session.claim_groups(todo.values()):
        prepared, evaluators, seconds = None, {}, None
        for one in group:
            label = f"training {one.variant}, seed {one.seed}"
            if not session.claims.take(one.digest) or is_trained(one):  # by another command, meanwhile
                continue
            minutes = one.config["minutes"]
            estimate = 0.0 if minutes is None else 60.0 * minutes + COMPILATION_S
            if not clock.fits(estimate if seconds is None else seconds, task=label):
                return False
            start = time.monotonic()
            prepared = prepared or training_loop.prepare(one.config)
            watched = study_plan.evaluations_while_training(plan, one) if one.config["evaluation"]["every"] else []
            evaluators |= {e.program: session.make_evaluator(e, "curve points") for e in watched if e.program not in evaluators}
            scenes = session.training_scenes(one.config) if one.config["stream"] is None else None
            try:
                note = _train_one(one, prepared._replace(scenes=scenes), {e.protocol: evaluators[e.program] for e in watched})
            except folder_lock.Busy:
                print(f"{label}: left to the command that trains in {one.folder}", flush=True)
                continue
            seconds = time.monotonic() - start
            per_gpu = min(session.config["per_gpu"], session.config["processes"])
            note |= {"per_gpu": per_gpu, "watched": {e.protocol: e.program for e in watched}}
            result_file.write(one.folder / TRAINED, note, digits=None)
            if session.config["slim"]:
                checkpoint.drop_training_state(one.folder / study_plan.TRAINED)
    return True


def is_trained(training: Training) -> bool:
    """Whether a training has reached its end."""
    return (training.folder / TRAINED).is_file()


def _train_one(one: Training, prepared: training_loop.Prepared, evaluators: Mapping[str, Evaluator]) -> dict[str, Any]:
    """Runs one training from its last checkpoint, if there is one, and returns what there is to note of it."""
    resume = (one.folder / configs.FILE).is_file()
    print(f"training {one.variant}, seed {one.seed}" + (" (resumed)" if resume else ""), flush=True)
    config = {**one.config, "out": str(one.folder), "resume": resume}
    callback = functools.partial(make_training_callback, config, evaluators=evaluators)
    last = training_loop.train(config, prepared=prepared, make_callback=callback).metrics[-1]
    note = {"digest": one.digest, "seed": one.seed, "iterations": int(last["iteration"]), "steps": last["steps/total"]}
    note |= {"minutes": last["minutes"], "commit": configs.find_commit(), "versions": configs.versions()}
    if prepared.scenes is not None:
        scenes = scene_source.take_scenes(prepared.scenes, config["scenes"])
        note |= {"scenes": len(scenes), "agents": int(np.asarray(scenes.scene.agents.present).sum())}
    return note


# ---- evaluation


def _evaluate(plan: Plan, session: Session, clock: Clock) -> bool:
    """Evaluates what is not evaluated yet, policies of one program after the other, and returns whether all was done."""
    todo = {one.file: one for one in plan.evaluations if session.selects(one.training.variant) and not one.file.is_file()}
    longest = 0.0
    for _, group in session.claim_groups(one for one in todo.values() if _is_ready(one)):
        start, evaluator = time.monotonic(), None
        for one in group:
            if not session.claims.take(f"{one.training.digest}-{one.file.name}"):
                continue
            if not clock.fits(longest, task=f"evaluation {one.row}, {one.condition}, {one.protocol}"):
                return False
            evaluator = evaluator or session.make_evaluator(one, "policies")
            records = evaluator(_load_weights(one, session))
            with atomic_file.write_atomically(one.file) as temporary:
                write_records(temporary, records)
            rates = ", ".join(f"{name} {100 * np.mean(records[name]):.1f} %" for name in ("goal_reached", "clean", "collision"))
            print(f"{one.row}, seed {one.training.seed}, {one.condition}, {one.protocol}: {rates}", flush=True)
        longest = max(longest, time.monotonic() - start)
    return True


def _is_ready(one: Evaluation) -> bool:
    """Whether the weights exist; records of an untrained policy need the folder of a run that has begun."""
    return (one.training.folder / configs.FILE).is_file() if one.weights == study_plan.UNTRAINED else is_trained(one.training)


def _load_weights(one: Evaluation, session: Session) -> Any:
    if one.weights == study_plan.UNTRAINED:
        return policy_io.draw_untrained(one.config, session.heldout_scenes(one.config)[0])
    return checkpoint.restore_parameters(one.training.folder / one.weights)


def _format_command(config: Mapping[str, Any]) -> str:
    """Formats the command without the paths of this machine."""
    command = configs.format_command("study")
    for name in ("train_scenes", "test_scenes", "runs"):
        if config[name] is not None:
            command = command.replace(str(config[name]), Path(config[name]).name)
    return command
