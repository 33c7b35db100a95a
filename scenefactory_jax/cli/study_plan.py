"""What a study is to train and to judge, read out of its config: every training and every judging with a digest of all that decides it."""

import functools
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.env import environment

TASK = tuple(group for group in environment.GROUPS if group != "termination")  # how episodes end is the protocol's
LEARNER = (*TASK, "termination", "policy", "ppo", "devices")  # what programs of training are made of
# What changes nothing about what is learnt
ASIDE = ("name", "out", "resume", "progress", "loggers", "checkpoint_every", "checkpoints_kept", "evaluation")
TRAINED, UNTRAINED = "checkpoints", "untrained"  # weights: a run's checkpoints, and what it began with


class Training(NamedTuple):
    """One run of `train`."""

    variant: str
    seed: int
    overrides: list[str]
    config: dict[str, Any]
    folder: Path
    digest: str
    program: str


class Evaluation(NamedTuple):
    """One policy under one condition and protocol."""

    row: str  # of the report: a variant, or a floor
    training: Training
    weights: str  # TRAINED or UNTRAINED
    condition: str
    protocol: str
    config: dict[str, Any]
    program: str
    file: Path  # of its records


class Plan(NamedTuple):
    """Everything that a study wants, in the order of its config."""

    name: str
    trainings: list[Training]
    judgings: list[Evaluation]


def make(config: Mapping[str, Any]) -> Plan:
    """The plan of a `study` config.

    Raises:
        ConfigError: a key, a name or an override that does not fit, naming the variant or condition.
    """
    check(config)
    scenes_print.cache_clear()  # other scenes may lie there than when this process planned before
    study, runs = config["study"], Path(config["runs"])
    seeds = study["seeds"] if config["seeds"] is None else config["seeds"]
    trainings = [one for variant in study["trainings"] for one in _trainings(config, variant, seeds, runs)]
    judgings = [one for training in trainings for one in _judgings(config, training, first=seeds[0])]
    rows = {name: index for index, name in enumerate([*study["trainings"], *study["floors"]])}
    places = {name: index for index, name in enumerate(study["conditions"])}
    return Plan(study["name"], trainings, sorted(judgings, key=lambda one: (places[one.condition], rows[one.row])))


def is_watched(plan: Plan, training: Training) -> list[Evaluation]:
    """How a variant is judged while it trains: under its first condition, in every protocol."""
    own = [one for one in plan.judgings if one.row == training.variant and one.training.seed == training.seed]
    return [one for one in own if one.condition == own[0].condition]


def scenes_key(config: Mapping[str, Any], path: str | None) -> str:
    """Tells which settings of a `scenes` entry give the same scenes, before `take`."""
    entry = {name: value for name, value in config.items() if name not in ("take", "heldout", "workers", "path")}
    return result_file.digest({**entry, "path": None if path is None else str(path)})


@functools.lru_cache
def scenes_print(path: str | None) -> str | None:
    """Tells other scenes of the same path: a bank's index, which has digests of its files, or name, size and time of every file; None where
    there are none."""
    if path is None or not Path(path).exists():
        return None
    if bank_index.is_bank(path):
        return hashlib.sha256((Path(path) / bank_index.INDEX).read_bytes()).hexdigest()[:16]
    stats = {str(file): file.stat() for file in reader_selection.find(path)}
    return result_file.digest({name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()})


def check(config: Mapping[str, Any]) -> None:
    """Every key of the command and of the study, and every name that one part of it uses of another.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    schema.check_study(config)
    study = config["study"]
    variants, conditions = list(study["trainings"]), list(study["conditions"])
    rows = [*variants, *study["floors"]]
    names = {"only": (config["only"], variants), "study.judged": (study["judged"], variants)}
    names |= {f"study.judged.{name}": (chosen, conditions) for name, chosen in (study["judged"] or {}).items()}
    names |= {f"study.floors.{name}.of": ([floor["of"]], variants) for name, floor in study["floors"].items()}
    names |= {f"study.floors.{name}.conditions": (floor["conditions"], conditions) for name, floor in study["floors"].items()}
    names |= {f"study.compare.{index}": (pair, rows) for index, pair in enumerate(study["compare"])}
    names["study.trend.values"] = ((study["trend"] or {"values": {}})["values"], variants)
    for where, (chosen, valid) in names.items():
        for name in chosen or []:
            if name not in valid:
                raise ConfigError(f"{where}: unknown {name!r}; valid: {', '.join(valid)}")
    if "draw" in config["parts"] and len(config["parts"]) > 1:
        raise ConfigError(f"parts: {config['parts']}; `draw` stands alone: `report` draws, too")
    if doubled := set(variants) & set(study["floors"]):
        raise ConfigError(f"study.floors: {sorted(doubled)[0]!r} is a variant, too; rows need names of their own")
    if not variants or not conditions:
        raise ConfigError("study: without trainings or without conditions there is nothing to find out")


def merge_overrides(overrides: Sequence[str]) -> list[str]:
    """Overrides without those that a later one of the same key replaces; Hydra takes no group twice."""
    last = {override.partition("=")[0].lstrip("+"): index for index, override in enumerate(overrides)}
    return [override for index, override in enumerate(overrides) if last[override.partition("=")[0].lstrip("+")] == index]


def _trainings(config: Mapping[str, Any], variant: str, seeds: list[int], runs: Path) -> list[Training]:
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
    return [_training({**one, "name": f"{study['name']}, {variant}"}, variant, overrides, runs) for one in each]


def _training(settings: dict[str, Any], variant: str, overrides: list[str], runs: Path) -> Training:
    entry = {name: value for name, value in settings.items() if name not in ASIDE}
    entry["scenes"] = {name: value for name, value in settings["scenes"].items() if name not in ("heldout", "workers")}
    entry |= _printed(settings["scenes"]["path"])
    if settings["scenes"]["take"]["count"] is None:
        entry["scenes"].pop("take")  # its seed follows that of the run
    digest, seed = result_file.digest(entry), settings["seed"]
    known = sorted(runs.glob(f"*-{digest}/"))  # another study may have trained it, under a name of its own
    folder = known[0] if known else runs / f"{slug(variant)}-{seed}-{digest}"
    program = result_file.digest({name: settings[name] for name in LEARNER})
    return Training(variant, seed, overrides, settings, folder, digest, program)


def _judgings(config: Mapping[str, Any], training: Training, *, first: int) -> list[Evaluation]:
    """All that is judged of one training: its policy, and the floors that begin with it."""
    study = config["study"]
    everywhere = list(study["conditions"])
    judged = everywhere if study["judged"] is None else study["judged"].get(training.variant, [])
    found = [_judging(config, training, training.variant, TRAINED, name, [], p) for name in judged for p in study["protocols"]]
    for name, floor in study["floors"].items():
        if floor["of"] != training.variant or (floor["seeds"] == 1 and training.seed != first):
            continue
        for condition in everywhere if floor["conditions"] is None else floor["conditions"]:
            own = list(floor["overrides"])
            found += [_judging(config, training, name, UNTRAINED, condition, own, protocol) for protocol in study["protocols"]]
    return found


def _judging(
    config: Mapping[str, Any], training: Training, row: str, weights: str, condition: str, own: list[str], protocol: str
) -> Evaluation:
    study = config["study"]
    try:
        examined = configs.apply_overrides(training.config, [*study["examined"], *study["conditions"][condition], *own])
    except ConfigError as error:
        raise ConfigError(f"study.conditions.{condition}: {error}") from None
    path = config["test_scenes"]
    settings = {name: value for name, value in config["evaluation"].items() if name != "bootstrap"}
    parts = {name: examined[name] for name in (*TASK, "policy")} | {"protocol": protocol, "settings": settings}
    # without a path they are the recipe's own held-out ones
    heldout = examined["scenes"]["heldout"] if path is None else None
    drawn = {"scenes": scenes_key(examined["scenes"], path), "heldout": heldout}
    program = result_file.digest(parts | drawn | _printed(path if heldout is None else heldout["path"]))
    file = training.folder / f"judged-{weights}-{program}.csv"
    return Evaluation(row, training, weights, condition, protocol, examined, program, file)


def _printed(path: str | None) -> dict[str, str]:
    """What a digest holds of scenes that are not made by a generator."""
    found = scenes_print(path)
    return {} if found is None else {"scenes_print": found}


def _quoted(path: str) -> str:
    """A path as a value in Hydra's grammar."""
    return "'" + str(path).replace("'", "\\'") + "'"


def slug(name: str) -> str:
    """A name as part of a file's."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
