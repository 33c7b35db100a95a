"""`study`: an experiment from one config: trains and evaluates what is missing, and reports what there is.

A study may be stopped at any moment and called again: trainings continue from their last checkpoint, and nothing is trained or evaluated
twice with the same settings, also across studies.
"""

import datetime
import functools
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from scenefactory_jax.cli import study_plan, study_results
from scenefactory_jax.cli.evaluate import make_training_callback
from scenefactory_jax.cli.study_plan import Evaluation, Plan, Training
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import folder_lock, result_file
from scenefactory_jax.core.parallel import gpu_processes
from scenefactory_jax.core.parallel.gpu_processes import TaskClaims
from scenefactory_jax.core.schema import read as read_settings
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation.protocols import Evaluator, make_evaluator
from scenefactory_jax.evaluation.records import write_records
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.learning import checkpoint, policy_io, training_loop

COUNTS = ("policies", "curve points", "seconds")  # of uses of the held-out scenes
EVENTS_SHOWN = ("goal_reached", "clean", "collision")  # columns of records, in messages of studies without `metrics`

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
    deadline, config = time.time() + (math.inf if config["time_limit_s"] is None else config["time_limit_s"]), {**config, **single}
    config = study_plan.complete(config)
    if config["parts"] == ["draw"]:
        return study_results.draw(config)
    plan = study_plan.make(config)
    scene_source.use_compilation_cache()
    out = study_results.find_folder(config)
    uses = HeldOutUses(out / study_results.RESULT, command=_format_command(config), cut=config["cut"])
    for part in ("train", "evaluate"):
        if part not in config["parts"]:
            continue
        if config["processes"] == 1:
            done = _run(part, plan, Session(config, uses, TaskClaims(None), deadline))
        else:
            done = _run_in_processes(part, plan, config, uses, deadline)
        if not done:
            print("stopped at the time limit; the same command continues", flush=True)
            break
    if "report" not in config["parts"]:
        return uses.read_result()
    return study_results.write(plan, config, out, before=uses.read_result())


def _run_in_processes(part: str, plan: Plan, config: Mapping[str, Any], uses: "HeldOutUses", deadline: float) -> bool:
    """Runs one part in several processes, `per_gpu` on each GPU, and returns whether all of it was done."""
    processes, per_gpu = config["processes"], config["per_gpu"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            done = gpu_processes.run_on_gpus(_run_claimed, processes, part, plan, config, folder, deadline, per_gpu=per_gpu)
        finally:
            for file in sorted(folder.glob("*-uses.json")):
                for use in result_file.read(file)["held_out_uses"]:
                    uses.add({name: use[name] for name in COUNTS})
    return all(done)


def _run_claimed(index: int, part: str, plan: Plan, config: Mapping[str, Any], folder: Path, deadline: float) -> bool:
    """Runs the tasks that one of several processes claims. The plan is given: making it takes half a minute for a large study."""
    scene_source.use_compilation_cache()
    uses = HeldOutUses(folder / f"{index}-uses.json", command="", cut=config["cut"])
    return _run(part, plan, Session(config, uses, TaskClaims(folder), deadline))


class HeldOutUses:
    """Counts how often the held-out scenes are evaluated, in result.json while it happens: numbers that choose settings are no test."""

    def __init__(self, file: Path, *, command: str, cut: str):
        self._file, self._index = file, None
        self._new = {"date": datetime.date.today().isoformat(), "command": command, "cut": cut, **dict.fromkeys(COUNTS, 0)}

    def count(self, evaluator: Evaluator, kind: str) -> Evaluator:
        """Returns the evaluator with a count of its calls, before each begins, and of their seconds."""

        @functools.wraps(evaluator)
        def counted(parameters):
            self.add({kind: 1})
            start = time.monotonic()
            records = evaluator(parameters)
            self.add({"seconds": time.monotonic() - start})
            return records

        return counted

    def add(self, counts: Mapping[str, float | int]) -> None:
        """Adds counts to those of this call of the command."""
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
    """State that the tasks of one process share: scenes, each read once, the count of uses, the claims on tasks, and the time limit."""

    def __init__(self, config: Mapping[str, Any], uses: HeldOutUses, claims: TaskClaims, deadline: float):
        self.config, self.uses, self.claims, self.deadline = config, uses, claims, deadline
        self._scenes: dict[str, scene_source.Scenes] = {}

    def training_scenes(self, config: Mapping[str, Any]) -> scene_source.Scenes:
        """Loads the scenes of a training config, before `scenes.take`."""
        entry = config["scenes"]
        return self._load_once("train " + study_plan.digest_scenes(entry, entry["path"]), scene_source.load_all_scenes, entry)

    def heldout_scenes(self, config: Mapping[str, Any]) -> scene_source.Scenes:
        """Loads the scenes that policies are evaluated on."""
        entry, path = config["scenes"], self.config["test_scenes"]
        key = "test " + study_plan.digest_scenes(entry, path) + result_file.digest(entry["heldout"])
        return self._load_once(key, scene_source.load_heldout_scenes, entry, path=path)

    def _load_once(self, key: str, load: Callable[..., scene_source.Scenes], *arguments: Any, **keywords: Any) -> scene_source.Scenes:
        if key not in self._scenes:
            self._scenes[key] = load(*arguments, **keywords)
            print(self._scenes[key].account, flush=True)
        return self._scenes[key]

    def make_evaluator(self, evaluation: Evaluation, kind: str) -> Evaluator:
        """Makes the evaluator of a condition and protocol."""
        settings = {**evaluation.config["evaluation"], **self.config["evaluation"]}
        found = evaluation.scores
        scores = None if found is None else read_settings(found, ScoreSettings, where="protocol.scores")
        scenes = self.heldout_scenes(evaluation.config)
        return self.uses.count(make_evaluator(evaluation.config, scenes, settings=settings, scores=scores), kind)


def _run(part: str, plan: Plan, session: Session) -> bool:
    """Runs one part in this process and returns whether all of it was done."""
    chosen = plan.choose(session.config["only"])
    if part == "train":
        return _run_tasks(chosen.trainings, functools.partial(_make_trainer, plan, session), session)
    evaluations = [task for task in chosen.evaluations if _is_ready(task)]
    return _run_tasks(evaluations, functools.partial(_make_evaluation, session), session)


def _is_ready(evaluation: Evaluation) -> bool:
    """Whether the weights exist; records of an untrained policy need the folder of a run that has begun."""
    training = evaluation.training
    return (training.folder / run_config.FILE if evaluation.weights == study_plan.UNTRAINED else training.file).is_file()


def _run_tasks(tasks: Iterable[Task], make_work: Callable[[Task], Callable[[Task], None]], session: Session) -> bool:
    """Runs the tasks whose files do not exist, those of one program after the other, and returns whether all were begun in time.

    Args:
        make_work: called with the first task of a program; returns a function that runs a task.
    """
    groups: dict[str, dict[str, Task]] = {}
    for task in tasks:
        if not task.file.is_file():
            groups.setdefault(task.program, {})[f"{task.file.parent.name}-{task.file.name}"] = task
    for _, group in session.claims.shares(groups):
        work = None
        for key, task in group.items():
            if not session.claims.take(key) or task.file.is_file():  # by another command, meanwhile
                continue
            if time.time() >= session.deadline:
                return False
            work = work or make_work(task)
            work(task)
    return True


def _make_trainer(plan: Plan, session: Session, first: Training) -> Callable[[Training], None]:
    """Returns a function that runs a training from its last checkpoint, if there is one, and notes its duration."""
    prepared, evaluators = training_loop.prepare(first.config), dict[str, Evaluator]()

    def run(training: Training) -> None:
        watched = study_plan.evaluations_while_training(plan, training) if training.config["evaluation"]["every"] else []
        for evaluation in watched:
            if evaluation.program not in evaluators:
                evaluators[evaluation.program] = session.make_evaluator(evaluation, "curve points")
        scenes = session.training_scenes(training.config) if training.config["stream"] is None else None
        try:
            note = _train(training, prepared._replace(scenes=scenes), {task.protocol: evaluators[task.program] for task in watched})
        except folder_lock.Busy:
            print(f"{training.label}: left to the command that trains in {training.folder}", flush=True)
            return
        note |= {"per_gpu": min(session.config["per_gpu"], session.config["processes"])}
        note |= {"watched": {evaluation.protocol: evaluation.program for evaluation in watched}}
        result_file.write(training.file, note, digits=None)
        if session.config["slim"]:
            checkpoint.drop_training_state(training.folder / study_plan.TRAINED)

    return run


def _train(training: Training, prepared: training_loop.Prepared, evaluators: Mapping[str, Evaluator]) -> dict[str, Any]:
    """Runs a training and returns what it was: settings, duration, scenes and versions."""
    resume = (training.folder / run_config.FILE).is_file()
    print(training.label + (" (resumed)" if resume else ""), flush=True)
    config = {**training.config, "out": str(training.folder), "resume": resume}
    callback = functools.partial(make_training_callback, config, evaluators=evaluators)
    last = training_loop.train(config, prepared=prepared, make_callback=callback).metrics[-1]
    note = {"digest": training.digest, "seed": training.seed, "iterations": int(last["iteration"]), "steps": last["steps/total"]}
    note |= {"hours": last["steps/total"] / float(config["timing"]["control_hz"]) / 3600}  # that agents drove
    note |= {"minutes": last["minutes"], "commit": run_config.find_commit(), "versions": run_config.versions()}
    if prepared.scenes is not None:
        scenes = scene_source.take_scenes(prepared.scenes, config["scenes"])
        note |= {"scenes": len(scenes), "agents": int(np.asarray(scenes.scene.agents.present).sum())}
    return note


def _make_evaluation(session: Session, first: Evaluation) -> Callable[[Evaluation], None]:
    """Returns a function that evaluates a policy and writes its records."""
    evaluator = session.make_evaluator(first, "policies")

    def run(evaluation: Evaluation) -> None:
        training = evaluation.training
        if evaluation.weights == study_plan.UNTRAINED:
            parameters = policy_io.draw_untrained(evaluation.config, session.heldout_scenes(evaluation.config)[0])
        else:
            parameters = checkpoint.restore_parameters(training.folder / evaluation.weights)
        records = evaluator(parameters)
        evaluation.file.parent.mkdir(parents=True, exist_ok=True)
        metadata = {"protocol": evaluation.protocol, "policy": evaluation.row, "condition": evaluation.condition}
        metadata |= {"config_digest": evaluation.program, "versions": run_config.versions()}
        write_records(evaluation.file, records, metadata=metadata)
        known = [name for name, column in records.items() if column.dtype.kind in "bf" and np.isfinite(column).any()]
        shown = [name for name in session.config["study"]["metrics"] or EVENTS_SHOWN if name in known]
        rates = ", ".join(f"{name} {np.nanmean(records[name]):.3f}" for name in shown)
        print(f"{evaluation.label}: {rates}", flush=True)

    return run


def _format_command(config: Mapping[str, Any]) -> str:
    """Formats the command without the paths of this machine."""
    command = run_config.format_command("study")
    for path in (*(config[name] for name in ("train_scenes", "test_scenes", "runs")), *config["banks"].values()):
        if path is not None:
            command = command.replace(str(path), Path(path).name)
    return command
