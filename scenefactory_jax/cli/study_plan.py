"""Trainings and evaluations of a study, read from its config, each with a digest of all that decides its numbers."""

import functools
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.cli.evaluate import load_terminations
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.env import environment, rewards
from scenefactory_jax.learning import run_paths

TASK = tuple(group for group in environment.GROUPS if group != "termination")  # the termination is the protocol's
LEARNER = (*TASK, "termination", "policy", "learner", "ppo", "devices")  # groups that the compiled training depends on
# Keys that do not change what is learnt
IGNORED = ("name", "out", "resume", "progress", "loggers", "checkpoint_every", "checkpoints_kept", "evaluation")
UNCHANGED = (("raw_penalty", 0.0), ("parameter_ema_decay", None))  # of a learner: runs of before there was the key are the same
ACTOR = ("actor", "values")  # of a learner, that decide what network its policy is
SHARED = ("seed", "repeats", "planner_overrides")  # of a protocol: those of the study's decide for all conditions
TRAINED, UNTRAINED = "checkpoints", "untrained"  # weights: a run's checkpoints, or those before training


class Training(NamedTuple):
    """One run of `train`."""

    variant: str
    seed: int
    overrides: list[str]
    config: dict[str, Any]
    folder: Path
    file: Path  # written when the training has ended
    digest: str
    program: str  # digest of what its compiled program depends on

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"training {self.variant}, seed {self.seed}"


class Evaluation(NamedTuple):
    """One policy under one condition and protocol."""

    row: str  # of the report: a variant or a baseline
    training: Training
    weights: str  # TRAINED or UNTRAINED
    condition: str
    protocol: str
    config: dict[str, Any]
    scores: dict[str, Any] | None  # how episodes are scored, of the protocol; None: they are not
    program: str  # digest of all but the weights
    file: Path  # of its records

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"evaluation {self.row}, {self.condition}, {self.protocol}, seed {self.training.seed}"


class Plan(NamedTuple):
    """All trainings and evaluations of a study, in the order of its config."""

    trainings: list[Training]
    evaluations: list[Evaluation]

    def choose(self, only: Sequence[str] | None) -> "Plan":
        """The part of some variants, with the baselines of these, and policies; None: all."""
        if only is None:
            return self
        trainings = [training for training in self.trainings if training.variant in only]
        return Plan(trainings, [evaluation for evaluation in self.evaluations if evaluation.training.variant in only])


def make(config: Mapping[str, Any]) -> Plan:
    """Plans a study.

    Raises:
        ConfigError: a key, a name or an override that does not fit, naming the variant or condition.
    """
    config = complete(config)
    check(config)
    digest_files.cache_clear()  # the files may have changed since this process planned last
    study, protocols = config["study"], {name: _load_protocol(config, name) for name in config["study"]["conditions"]}
    seeds = study["seeds"] if config["seeds"] is None else config["seeds"]
    trainings = [training for variant in study["trainings"] for training in _plan_trainings(config, variant, seeds)]
    evaluations = [
        evaluation
        for training in trainings
        for evaluation in _plan_evaluations(config, training, protocols, is_first=training.seed == seeds[0])
    ]
    evaluations += [one for row in study["policies"] for one in _plan_policy(config, row, protocols)]
    rows, conditions = list_rows(study), list(study["conditions"])
    evaluations.sort(key=lambda evaluation: (conditions.index(evaluation.condition), rows.index(evaluation.row)))
    return Plan(trainings, evaluations)


def list_rows(study: Mapping[str, Any]) -> list[str]:
    """Lists the rows of a study: its variants, baselines and policies."""
    return [*study["trainings"], *study["baselines"], *study["policies"]]


def evaluations_while_training(plan: Plan, training: Training) -> list[Evaluation]:
    """Returns the evaluations that a training repeats while it runs: those under its first condition, in every protocol."""
    evaluations = [task for task in plan.evaluations if task.row == training.variant and task.training.seed == training.seed]
    return [task for task in evaluations if task.condition == evaluations[0].condition]


def digest_scenes(config: Mapping[str, Any], path: str | None) -> str:
    """Computes a digest of the settings of a `scenes` entry that decide its scenes, before `take`."""
    entry = {name: value for name, value in config.items() if name not in ("take", "heldout", "workers", "path", *_unread(path))}
    return result_file.digest({**entry, "path": None if path is None else str(path)})


def _unread(path: str | None) -> tuple[str, ...]:
    """Keys of a `scenes` entry that decide nothing: the readers of formats read neither banks nor what a generator makes."""
    return () if path is not None and not bank_index.is_bank(path) else ("formats",)


@functools.lru_cache
def digest_files(path: str | None) -> str | None:
    """Computes a digest of the scene files at a path: of a bank's index, or of name, size and time of every file. None: there are none."""
    if path is None or not Path(path).exists():
        return None
    if bank_index.is_bank(path):
        return hashlib.sha256((Path(path) / bank_index.INDEX).read_bytes()).hexdigest()[:16]
    stats = {str(file): file.stat() for file in reader_selection.find(path)}
    return result_file.digest({name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()})


def check(config: Mapping[str, Any]) -> None:
    """Checks every key of the command and of the study, and the names that its parts use of each other.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    schema.check_study(config)
    study, baselines = config["study"], config["study"]["baselines"]
    variants, conditions = list(study["trainings"]), list(study["conditions"])
    if not variants or not conditions:
        raise ConfigError("study: expected one or more trainings and conditions, got none")
    names = {"only": (config["only"], [*variants, *study["policies"]]), "study.evaluated": (study["evaluated"], variants)}
    names |= {f"study.evaluated.{name}": (chosen, conditions) for name, chosen in (study["evaluated"] or {}).items()}
    names |= {f"study.baselines.{name}.of": ([entry["of"]], variants) for name, entry in baselines.items()}
    names |= {f"study.baselines.{name}.conditions": (entry["conditions"], conditions) for name, entry in baselines.items()}
    names |= {f"study.compare.{index}": (pair, list_rows(study)) for index, pair in enumerate(study["compare"])}
    names |= {f"study.drops.{index}": (pair, conditions) for index, pair in enumerate(study["drops"])}
    names["study.trend.values"] = ((study["trend"] or {"values": {}})["values"], variants)
    for where, (chosen, valid) in names.items():
        if unknown := [name for name in chosen or [] if name not in valid]:
            raise ConfigError(f"{where}: expected one of {', '.join(valid)}, got {unknown[0]!r}")
    if "draw" in config["parts"] and len(config["parts"]) > 1:
        raise ConfigError(f"parts: expected `draw` alone, got {config['parts']}; `report` draws, too")
    rows = list_rows(study)
    if doubled := [row for row in (*baselines, *study["policies"]) if rows.count(row) > 1]:
        raise ConfigError(f"study.baselines, study.policies: expected names that no other row has, got {doubled[0]!r}")


def complete(config: Mapping[str, Any]) -> dict[str, Any]:
    """Writes out what a study says in short: lists of overrides within those of its trainings, such as an anchor of YAML repeats, and its
    `planners`, baselines with the overrides that they have in `evaluate` under its protocol.
    """
    study, protocol = config["study"], config["protocol"]
    study = {**study, "trainings": {name: _flatten(overrides) for name, overrides in study["trainings"].items()}}
    config = {**config, "study": study}
    if not study["planners"] or not study["trainings"]:
        return config
    known = configs.load_config("evaluate", "run=null", f"protocol={protocol['name']}")["planner_overrides"]
    own = protocol.get("planner_overrides", {})
    if unknown := [name for name in study["planners"] if name not in known]:
        raise ConfigError(f"study.planners: expected names of {', '.join(known)}, got {unknown[0]!r}")
    first = {"of": next(iter(study["trainings"])), "conditions": None, "seeds": 1}
    planners = {name: {**first, "overrides": [*known[name], *own.get(name, [])]} for name in study["planners"]}
    return {**config, "study": {**study, "planners": [], "baselines": {**study["baselines"], **planners}}}


def _flatten(overrides: Any) -> Any:
    """The overrides of nested lists in one; what is no list stays, for `check`."""
    if not isinstance(overrides, list):
        return overrides
    return [one for entry in overrides for one in (_flatten(entry) if isinstance(entry, list) else [entry])]


class ConditionProtocol(NamedTuple):
    """How the episodes of a condition are judged."""

    overrides: list[str]  # of every evaluation under the condition
    scores: dict[str, Any] | None
    terminations: dict[str, dict[str, Any]]


def _load_protocol(config: Mapping[str, Any], condition: str) -> ConditionProtocol:
    """Loads what a condition judges by: the protocol that it names (`protocol=vmax_noise`), or that of the study."""
    overrides = config["study"]["conditions"][condition]
    settings, protocol = list_evaluation_overrides(config), config["protocol"]
    names = config["study"]["protocols"]
    if named := [override for override in overrides if override.startswith("protocol=")]:
        load = lambda override: configs.load_config("evaluate", "run=null", override)["protocol"]  # noqa: E731
        try:
            protocol, own = load(named[-1]), load(f"protocol={protocol['name']}")
        except ConfigError as error:
            raise ConfigError(f"study.conditions.{condition}: {error}") from None
        for key in SHARED:
            if protocol.get(key) != own.get(key):
                raise ConfigError(f"study.conditions.{condition}: {named[-1]} has other {key} than the study's protocol; expected the same")
        settings, names = configs.list_overrides(protocol["settings"]), protocol["termination"]
    others = [override for override in overrides if override not in named]
    return ConditionProtocol([*settings, *others], protocol.get("scores"), load_terminations(names))


def list_evaluation_overrides(config: Mapping[str, Any]) -> list[str]:
    """Lists the overrides of every evaluation: the study's own, or those of the protocol."""
    own = config["study"]["evaluation_overrides"]
    return configs.list_overrides(config["protocol"]["settings"]) if own is None else list(own)


def merge_overrides(overrides: Sequence[str]) -> list[str]:
    """Drops overrides that a later one of the same key replaces; Hydra takes no group twice."""
    last = {override.partition("=")[0].lstrip("+"): index for index, override in enumerate(overrides)}
    return [override for index, override in enumerate(overrides) if last[override.partition("=")[0].lstrip("+")] == index]


def _plan_trainings(config: Mapping[str, Any], variant: str, seeds: list[int]) -> list[Training]:
    """A variant's training with each seed."""
    study = config["study"]
    scenes = [] if config["train_scenes"] is None else ["scenes=womd", f"scenes.path={_quoted(config['train_scenes'])}"]
    scenes += [] if config["test_scenes"] is None else [f"scenes.heldout.path={_quoted(config['test_scenes'])}"]
    overrides = merge_overrides([*study["base"], *scenes, *study["common"], *study["trainings"][variant], *config["common"]])
    fixed = ["loggers=[]", "evaluation.enable=false", f"progress={str(config['progress']).lower()}"]
    try:
        each = configs.load_each("train", *merge_overrides([*overrides, *fixed]), key="seed", values=seeds)
    except ConfigError as error:
        raise ConfigError(f"study.trainings.{variant}: {error}") from None
    name, runs = f"{study['name']}, {variant}", Path(config["runs"])
    return [_plan_training({**settings, "name": name}, variant, overrides, runs) for settings in each]


def _plan_training(settings: dict[str, Any], variant: str, overrides: list[str], runs: Path) -> Training:
    entry = {name: value for name, value in settings.items() if name not in IGNORED}
    unread = ("heldout", "workers", *_unread(settings["scenes"]["path"]))
    entry["scenes"] = {name: value for name, value in settings["scenes"].items() if name not in unread}
    entry |= _digest_entry(settings["scenes"]["path"])
    if settings["scenes"]["take"]["count"] is None:
        entry["scenes"].pop("take")  # its seed follows that of the run
    if settings["start_from"] is None:
        entry.pop("start_from")  # runs of before there was the key are the same
    entry["learner"] = {name: value for name, value in settings["learner"].items() if (name, value) not in UNCHANGED}
    digest, seed = result_file.digest(entry), settings["seed"]
    existing = sorted(runs.glob(f"*-{digest}/"))  # another study may have trained it under another name
    folder = existing[0] if existing else runs / f"{slug(variant)}-{seed}-{digest}"
    program = result_file.digest({name: settings[name] for name in LEARNER})
    return Training(variant, seed, overrides, settings, folder, folder / "trained.json", digest, program)


def _plan_evaluations(
    config: Mapping[str, Any], training: Training, protocols: Mapping[str, ConditionProtocol], *, is_first: bool
) -> Iterator[Evaluation]:
    """The evaluations of a training's policy, and of the baselines that begin with it."""
    study, variant = config["study"], training.variant
    conditions = list(study["conditions"])
    rows = [(variant, TRAINED, conditions if study["evaluated"] is None else study["evaluated"].get(variant, []), [])]
    for name, baseline in study["baselines"].items():
        if baseline["of"] == variant and (is_first or baseline["seeds"] != 1):
            chosen = conditions if baseline["conditions"] is None else baseline["conditions"]
            rows.append((name, UNTRAINED, chosen, list(baseline["overrides"])))
    for row, weights, chosen, overrides in rows:
        judged = {condition: protocols[condition] for condition in chosen}
        yield from _plan_row(config, row, training, weights, judged, overrides, folder=training.folder)


def _plan_row(
    config: Mapping[str, Any],
    row: str,
    training: Training,
    weights: str,
    protocols: Mapping[str, ConditionProtocol],
    overrides: Sequence[str],
    *,
    folder: Path,
) -> Iterator[Evaluation]:
    """The evaluations of one row under some conditions; `folder`: of the records."""
    for condition, judged in protocols.items():
        try:
            settings = configs.apply_overrides(training.config, [*judged.overrides, *overrides])
            schema.check_mu(settings)
        except ConfigError as error:
            raise ConfigError(f"study.conditions.{condition}: {error}") from None
        for protocol, termination in judged.terminations.items():
            program = _digest_program(config, settings, protocol, judged.scores)
            file = folder / f"evaluated-{weights}-{program}.csv"
            task = {**settings, "termination": termination}
            yield Evaluation(row, training, weights, condition, protocol, task, judged.scores, program, file)


def _plan_policy(config: Mapping[str, Any], row: str, protocols: Mapping[str, ConditionProtocol]) -> Iterator[Evaluation]:
    """The evaluations of a policy that the study does not train, on the study's held-out scenes."""
    entry = config["study"]["policies"][row]
    try:
        folder = run_paths.find(entry["run"])
        settings = run_config.read(folder)
    except ConfigError as error:
        raise ConfigError(f"study.policies.{row}: {error}") from None
    if config["test_scenes"] is None:
        raise ConfigError(f"study.policies.{row}: expected test_scenes=PATH, as each policy has held-out scenes of its own, got null")
    file, weights = folder / run_config.FILE, sorted(path for path in (folder / TRAINED).rglob("*") if path.is_file())
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in (file, *weights))).hexdigest()[:16]
    given = Training(row, settings["seed"], [], settings, folder, file, digest, digest)
    yield from _plan_row(config, row, given, TRAINED, protocols, entry["overrides"], folder=Path(config["runs"]) / f"{slug(row)}-{digest}")


def _digest_program(config: Mapping[str, Any], settings: Mapping[str, Any], protocol: str, scores: Mapping[str, Any] | None) -> str:
    evaluation = {name: value for name, value in config["evaluation"].items() if name != "bootstrap"}
    path, scenes = config["test_scenes"], settings["scenes"]
    heldout = scenes["heldout"] if path is None else None  # without a path: the recipe's own held-out scenes
    parts = {name: settings[name] for name in (*TASK, "policy")} | {"protocol": protocol, "settings": evaluation}
    parts["reward"] = {name: settings["reward"][name] for name in rewards.read_ranges(settings["reward"])}  # no more of it is seen
    learner = settings.get("learner", {})  # policies of before have none
    parts |= {name: learner[name] for name in ACTOR if name in learner}
    parts |= {"scenes": digest_scenes(scenes, path), "heldout": heldout} | ({"scores": scores} if scores else {})
    return result_file.digest(parts | _digest_entry(path if heldout is None else heldout["path"]))


def _digest_entry(path: str | None) -> dict[str, str]:
    """The part of a digest for scenes that no generator makes."""
    digest = digest_files(path)
    return {} if digest is None else {"scenes_print": digest}


def _quoted(path: str) -> str:
    """Formats a path as a value in Hydra's grammar."""
    return "'" + str(path).replace("'", "\\'") + "'"


def slug(name: str) -> str:
    """Returns a name as part of a file's name."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
