"""`study`: an experiment from one config: train what is missing, judge what is missing, report what there is.

A study may be stopped at any moment and called again: a training goes on from its last checkpoint, and what was trained or judged with the
same settings is not done twice, also not by another study that wants the same.
"""

import datetime
import functools
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import study_plan, study_results
from scenefactory_jax.cli.evaluate import load_terminations, make_training_callback
from scenefactory_jax.cli.study_plan import Evaluation, Plan, Training
from scenefactory_jax.cli.study_results import RESULT, TRAINED
from scenefactory_jax.core import atomic_file, folder_lock, result_file
from scenefactory_jax.core.parallel import gpu_processes
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import agent_metrics
from scenefactory_jax.evaluation.protocols import Evaluator, make_evaluator
from scenefactory_jax.learning import checkpoint, policy_io, training_loop

COMPILING_S = 120.0  # what a training may take beside its minutes, if none has told yet
LOOKS, COUNTED = "looks.json", ("policies", "curve points", "seconds")

Work = TypeVar("Work", Training, Evaluation)


def study(config: Mapping[str, Any]) -> dict[str, Any]:
    """Do a study as a config says (`load("study", "study=navigation", ...)`).

    Returns:
        What result.json holds: see `study_report.collect`; without the part `report`, what it held before.

    Raises:
        ConfigError: a key, a name or an override that does not fit, by name.
        SceneError: scenes that cannot be read.
    """
    clock = Clock(config["until_s"])
    config = _listed(config)
    if config["parts"] == ["draw"]:
        return study_results.draw(config)
    plan = study_plan.make(config)
    scene_source.use_compilation_cache()
    out = study_results.folder(config)
    looks = Looks(out / RESULT, command=_command(config), cut=config["cut"])
    do = _do if config["processes"] == 1 else _do_together
    if not all(do(part, config, plan, looks, clock) for part in ("train", "judge") if part in config["parts"]):
        print("stopped for want of time; the same command goes on", flush=True)
    if "report" not in config["parts"]:
        return looks.result()
    return study_results.write(plan, config, out, before=looks.result())


def _do(
    part: str, config: Mapping[str, Any], plan: Plan, looks: "Looks", clock: "Clock", claims: gpu_processes.TaskClaims | None = None
) -> bool:
    """One part of a study in this process; whether all could be done."""
    work = _train if part == "train" else _judge
    return work(plan, Shared(config, looks, claims or gpu_processes.TaskClaims(None)), clock)


def _do_together(part: str, config: Mapping[str, Any], plan: Plan, looks: "Looks", clock: "Clock") -> bool:
    """One part by several processes, `per_gpu` of them on each GPU; what they could not do within the time is left to the next call."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            shares = {**config, "until_s": clock.left_s()}
            done = gpu_processes.run_on_gpus(_do_share, config["processes"], part, shares, folder, per_gpu=config["per_gpu"])
        finally:
            looks.gather(folder)
    return all(done)


def _do_share(index: int, part: str, config: Mapping[str, Any], folder: Path) -> bool:
    """What one of several processes does."""
    scene_source.use_compilation_cache()
    looks = Looks(folder / f"{index}-{LOOKS}", command="", cut=config["cut"])
    return _do(part, config, study_plan.make(config), looks, Clock(config["until_s"]), gpu_processes.TaskClaims(folder))


class Clock:
    """Time since the command began, and whether something still fits into it."""

    def __init__(self, until_s: float | None):
        self._begun, self._until_s = time.monotonic(), until_s

    def left_s(self) -> float | None:
        """None: without end."""
        return None if self._until_s is None else max(0.0, self._until_s - (time.monotonic() - self._begun))

    def fits(self, seconds: float, *, what: str) -> bool:
        """Whether so many seconds are left. What would never fit is begun all the same: it goes on from its checkpoint."""
        left = self.left_s()
        if left is None or self._until_s is None:
            return True
        if left == 0 or (seconds > left and seconds <= self._until_s):
            print(f"{what}: would take about {seconds:.0f} s, {left:.0f} s are left", flush=True)
            return False
        return True


class Looks:
    """How often the held-out scenes were judged, kept in result.json as it happens: figures chosen by looking are no test."""

    def __init__(self, file: Path, *, command: str, cut: str):
        self._file, self._entry = file, None
        self._new: dict[str, Any] = {"date": datetime.date.today().isoformat(), "command": command, "cut": cut}
        self._new |= dict.fromkeys(COUNTED, 0)

    def counted(self, examine: Evaluator, kind: str) -> Evaluator:
        """`examine`, noting each call before it begins, and what it took."""

        @functools.wraps(examine)
        def noted(parameters):
            self._add(kind, 1)
            begun = time.monotonic()
            found = examine(parameters)
            self._add("seconds", time.monotonic() - begun)
            return found

        return noted

    def _add(self, what: str, much: float | int) -> None:
        result = self.result()
        looks = result.setdefault("looks", [])
        if self._entry is None:
            self._entry = len(looks)
            looks.append(dict(self._new))
        looks[self._entry][what] += much
        self._file.parent.mkdir(parents=True, exist_ok=True)
        result_file.write(self._file, result, digits=None)

    def gather(self, folder: Path) -> None:
        """Add what the processes of a common work counted in files of their own."""
        for file in sorted(folder.glob(f"*-{LOOKS}")):
            for entry in result_file.read(file)["looks"]:
                for what in COUNTED:
                    self._add(what, entry[what])

    def result(self) -> dict[str, Any]:
        """What the file holds."""
        return result_file.read(self._file) if self._file.is_file() else {}


class Shared:
    """What several trainings and judgings use: scenes, each read once, the count of looks, and what is this process's to do."""

    def __init__(self, config: Mapping[str, Any], looks: Looks, claims: gpu_processes.TaskClaims):
        self.config, self.looks, self.claims = config, looks, claims
        self._scenes: dict[str, scene_source.Scenes] = {}

    def training_scenes(self, task: Mapping[str, Any]) -> scene_source.Scenes:
        """Before `scenes.take`."""
        entry = task["scenes"]
        return self._kept("train " + study_plan.scenes_key(entry, entry["path"]), lambda: scene_source.load_all_scenes(entry))

    def heldout(self, task: Mapping[str, Any]) -> scene_source.Scenes:
        """Those that policies are judged on."""
        entry, path = task["scenes"], self.config["test_scenes"]
        key = study_plan.scenes_key(entry, path) + result_file.digest(entry["heldout"])
        return self._kept("test " + key, lambda: scene_source.load_heldout_scenes(entry, path=path))

    def _kept(self, key: str, load: Callable[[], scene_source.Scenes]) -> scene_source.Scenes:
        if key not in self._scenes:
            self._scenes[key] = load()
            print(self._scenes[key].account, flush=True)
        return self._scenes[key]

    def examiner(self, judging: Evaluation, kind: str) -> Evaluator:
        """Plays the held-out scenes under a judging's condition and protocol."""
        settings = {**judging.config["evaluation"], **self.config["evaluation"]}
        scenes = self.heldout(judging.config)
        config = {**judging.config, "termination": load_terminations([judging.protocol])[judging.protocol]}
        return self.looks.counted(make_evaluator(config, scenes, settings=settings), kind)

    def wanted(self, variant: str) -> bool:
        return self.config["only"] is None or variant in self.config["only"]


# ---- training


def _train(plan: Plan, shared: Shared, clock: Clock) -> bool:
    """Train what is not trained yet, seeds and variants that share their programs one after the other; whether all could be done."""
    todo = {one.digest: one for one in plan.trainings if shared.wanted(one.variant) and not is_trained(one)}
    spent: dict[str, float] = {}
    for program, group in shared.claims.shares(_by_program(todo.values())):
        prepared, examiners = None, {}
        for one in group:
            needs = spent.get(program, _estimate(one))
            if not shared.claims.take(one.digest) or is_trained(one):  # by another command, meanwhile
                continue
            if not clock.fits(needs, what=f"training {one.variant}, seed {one.seed}"):
                return False
            begun = time.monotonic()
            prepared = prepared or training_loop.prepare(one.config)
            watched = study_plan.is_watched(plan, one) if one.config["evaluation"]["every"] else []
            examiners |= {j.program: shared.examiner(j, "curve points") for j in watched if j.program not in examiners}
            own, while_training = prepared._replace(scenes=_scenes_of(one, shared)), {j.protocol: examiners[j.program] for j in watched}
            sharing = min(shared.config["per_gpu"], shared.config["processes"])
            try:
                note = _train_one(one, own, while_training) | {"per_gpu": sharing, "watched": {j.protocol: j.program for j in watched}}
            except folder_lock.Busy:
                print(f"training {one.variant}, seed {one.seed}: left to the command that trains in {one.folder}", flush=True)
                continue
            spent[program] = time.monotonic() - begun
            result_file.write(one.folder / TRAINED, note, digits=None)
            if shared.config["slim"]:
                checkpoint.drop_training_state(one.folder / study_plan.TRAINED)
    return True


def _by_program(works: Iterable[Work]) -> dict[str, list[Work]]:
    """In the order in which the programs first appear."""
    groups: dict[str, list[Work]] = {}
    for one in works:
        groups.setdefault(one.program, []).append(one)
    return groups


def _scenes_of(one: Training, shared: Shared) -> scene_source.Scenes | None:
    return shared.training_scenes(one.config) if one.config["stream"] is None else None


def is_trained(one: Training) -> bool:
    """Whether a run was brought to its end with these settings."""
    return (one.folder / TRAINED).is_file()


def _estimate(one: Training) -> float:
    """Seconds that a training may take, before one of its kind has told; nothing is known of one without `minutes`."""
    return 0.0 if one.config["minutes"] is None else 60.0 * one.config["minutes"] + COMPILING_S


def _train_one(one: Training, prepared: training_loop.Prepared, evaluators: Mapping[str, Evaluator]) -> dict[str, Any]:
    """One run, from its last checkpoint if there is one, and what there is to note of it."""
    resume = (one.folder / configs.FILE).is_file()
    print(f"training {one.variant}, seed {one.seed}" + (" (goes on)" if resume else ""), flush=True)
    config = {**one.config, "out": str(one.folder), "resume": resume}
    callback = functools.partial(make_training_callback, config, evaluators=evaluators)
    last = training_loop.train(config, prepared=prepared, make_callback=callback).metrics[-1]
    note = {"digest": one.digest, "seed": one.seed, "iterations": int(last["iteration"]), "steps": last["steps/total"]}
    note |= {"minutes": last["minutes"], "commit": configs.find_commit(), "versions": configs.versions()}
    if prepared.scenes is not None:
        scenes = scene_source.take_scenes(prepared.scenes, config["scenes"])
        note |= {"scenes": len(scenes), "agents": int(np.asarray(scenes.scene.agents.present).sum())}
    return note


# ---- judging


def _judge(plan: Plan, shared: Shared, clock: Clock) -> bool:
    """Judge what is not judged yet, all policies of one program after the other; whether all could be done."""
    todo = {one.file: one for one in plan.judgings if shared.wanted(one.training.variant) and not one.file.is_file()}
    ready = [one for one in todo.values() if _is_ready(one)]
    longest = 0.0
    for _, group in shared.claims.shares(_by_program(ready)):
        begun, examine = time.monotonic(), None
        for one in group:
            if not shared.claims.take(f"{one.training.digest}-{one.file.name}"):
                continue
            if not clock.fits(longest, what=f"judging {one.row}, {one.condition}, {one.protocol}"):
                return False
            examine = examine or shared.examiner(one, "policies")
            records = examine(_weights(one, shared))
            with atomic_file.write_atomically(one.file) as half:
                agent_metrics.write_csv(half, records)
            counts = [f"{name} {100 * np.mean(records[name]):.1f} %" for name in ("goal_reached", "clean", "collision")]
            print(f"{one.row}, seed {one.training.seed}, {one.condition}, {one.protocol}: {', '.join(counts)}", flush=True)
        longest = max(longest, time.monotonic() - begun)
    return True


def _is_ready(one: Evaluation) -> bool:
    """Whether there is what is to be judged; what learns nothing has its place in the folder of a run that was begun."""
    return (one.training.folder / configs.FILE).is_file() if one.weights == study_plan.UNTRAINED else is_trained(one.training)


def _weights(one: Evaluation, shared: Shared) -> Any:
    if one.weights == study_plan.UNTRAINED:
        return policy_io.draw_untrained(one.config, shared.heldout(one.config)[0])
    return checkpoint.restore_parameters(one.training.folder / one.weights)


# ---- the command


def _listed(config: Mapping[str, Any]) -> dict[str, Any]:
    """Single values where lists are meant: `parts=train`, `only=rigid`, `seeds=0`."""
    single = {name: [config[name]] for name in ("parts", "only", "seeds") if isinstance(config[name], (str, int))}
    return {**config, **single}


def _command(config: Mapping[str, Any]) -> str:
    """How the study was called, without saying where this machine keeps its files."""
    command = configs.format_command("study")
    for name in ("train_scenes", "test_scenes", "runs"):
        if config[name] is not None:
            command = command.replace(str(config[name]), Path(config[name]).name)
    return command
