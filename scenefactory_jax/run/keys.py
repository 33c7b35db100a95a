"""What a command's own keys must be, checked at the door: before scenes are read, and long before anything compiles.

The groups (dynamics, reward, ppo, ...) are checked against the functions that they configure, by `build`. These keys configure commands.
"""

import os
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from scenefactory_jax.build import ConfigError, check_type
from scenefactory_jax.run import config as configs


class Key(NamedTuple):
    """A key's type, and the least value that makes sense."""

    hint: Any
    least: float | None = None


COUNT, SEED, FLAG, PLACE = Key(int, 1), Key(int, 0), Key(bool), Key(str | None)
VIDEO = {"enable": FLAG, "worlds": SEED, "seconds": Key(float, 0.1), "stride": COUNT, "fps": Key(float, 0.1), "columns": COUNT}
VIDEO |= {"panel": Key(int, 120), "trail_s": Key(float, 0), "suffix": Key(Literal[".gif", ".mp4"])}
JUDGE = {"seed": SEED, "repeats": COUNT, "chunk_steps": COUNT, "ttc_limit_s": Key(float, 0), "bootstrap": COUNT, "untrained": FLAG}
EVALUATION = {"enable": FLAG, "every": Key(int | None, 0), "protocols": Key(list[str]), **JUDGE}
TRAIN = {"name": Key(str), "out": PLACE, "resume": FLAG, "seed": SEED, "worlds": COUNT, "iterations": COUNT}
TRAIN |= {"devices": Key(int | None, 1), "stream": Key(dict | None)}
TRAIN |= {"minutes": Key(float | None, 0), "checkpoint_every": COUNT, "checkpoints_kept": COUNT, "tensorboard": FLAG, "progress": FLAG}
BENCH = {"seed": SEED, "worlds": COUNT, "warmup": SEED, "repeats": COUNT, "out": PLACE, "phases": FLAG, "name": Key(str)}
BENCH |= {"scope": Key(Literal["training", "environment", "physics"]), "variants": Key(dict[str, dict])}
BENCH |= {"devices": Key(int | None, 1), "stream": Key(dict | None), "baseline": Key(dict | None), "resume": FLAG}
BASELINE = {"worlds": COUNT, "steps": COUNT, "repeats": COUNT}
SYSID = {"out": Key(str), "resume": FLAG, "workers": COUNT, "physics_hz": Key(float, 1)}
VALIDATE = {"out": Key(str), "parts": Key(list[str]), "resume": FLAG, "workers": COUNT}
COMPARE = {"runs": Key(list[str]), "out": Key(str), "metrics": Key(list[str]), "window": COUNT, "last": Key(float, 0), "bootstrap": COUNT}
COMPARE |= {"seed": SEED}
RENDER = {"index": SEED, "seed": SEED, "out": Key(str)}
SCENES = {"op": Key(str), "out": PLACE, "copy": FLAG, "limit": SEED, "seed": SEED, "progress": FLAG, "filter": PLACE}
INFO, SHEET = {"by": PLACE, "json": FLAG}, {"columns": COUNT, "inches": Key(float, 0.5)}
SAMPLE = {"count": Key(int | None, 1), "share": Key(float | None, 0), "stratify": PLACE}
SPLIT = {"shares": Key(dict[str, float] | None), "by": Key(Literal["scene", "streets"]), "least_shared": COUNT}
MERGE = {"banks": Key(list[str]), "duplicates": Key(Literal["refuse", "first"])}
DEDUPE = {"tolerance_m": Key(float, 0.001), "share": Key(float, 0), "slack": Key(float, 1e-6)}
SIMULATE, EXPORT = {"seconds": Key(float, 0.01), "worlds": COUNT}, {"format": Key(str)}
OPERATIONS = {"info": INFO, "sheet": SHEET, "sample": SAMPLE, "split": SPLIT, "merge": MERGE, "dedupe": DEDUPE, "simulate": SIMULATE}
COMPARED = {"others": Key(list[str]), "limit": COUNT}
OPERATIONS |= {"export": EXPORT, "compare": COMPARED}
CONVERT = {"source": PLACE, "out": PLACE, "progress": FLAG, "features": Key(dict | None), "spread": Key(dict)}
BANK = {"shard_scenes": COUNT, "compression": Key(Literal["zstd", "lz4"] | None)}
SOURCE = {"path": PLACE, "seed": SEED, "count": COUNT, "workers": COUNT}
CELLS = {"radius_m": Key(float | None, 0), "size_m": Key(float, 0.1)}
TAKE = {"count": Key(int | None, 1), "seed": SEED}
HELDOUT = {"path": PLACE, "seed": SEED, "count": COUNT}


def check(config: Mapping[str, Any], keys: Mapping[str, Key], *, where: str = "") -> None:
    """Refuse a key that is missing, of another type, or too small.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    for name, (hint, least) in keys.items():
        place = f"{where}.{name}" if where else name
        if name not in config:
            raise ConfigError(f"{place}: missing; {where or 'the command'} needs {', '.join(keys)}")
        value = os.fspath(config[name]) if isinstance(config[name], os.PathLike) else config[name]
        check_type(value, hint, where=place)
        if least is not None and value is not None and not value >= least:
            raise ConfigError(f"{place}: {value}; wanted is at least {least}")


def check_train(config: Mapping[str, Any]) -> None:
    """Every key of `train`, also those of the evaluation that comes hours later.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, TRAIN)
    evaluation = config["evaluation"]
    check(evaluation, EVALUATION, where="evaluation")
    check(evaluation["video"], VIDEO, where="evaluation.video")
    known = sorted(path.stem for path in (configs.folder() / "ends").glob("*.yaml"))
    for protocol in evaluation["protocols"] or [None]:
        if protocol not in known:
            raise ConfigError(f"evaluation.protocols: {evaluation['protocols']}; valid: one or more of {', '.join(known)}")


def check_evaluate(config: Mapping[str, Any]) -> None:
    """Every key of `evaluate`.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, {"run": Key(str), "out": PLACE, "overrides": Key(list[str]), **JUDGE})
    check(config["video"], VIDEO, where="video")


def check_scenes(config: Mapping[str, Any]) -> None:
    """Every key of a scenes config that is no function's own.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, SOURCE, where="scenes")
    check(config["heldout"], HELDOUT, where="scenes.heldout")
    check(config["cells"], CELLS, where="scenes.cells")
    check(config.get("take") or {"count": None, "seed": 0}, TAKE, where="scenes.take")


def check_operations(config: Mapping[str, Any]) -> None:
    """Every key of `scenes` and of its operations.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, SCENES)
    for name, own in OPERATIONS.items():
        check(config[name], own, where=name)
        if unknown := [key for key in config[name] if key not in own]:
            raise ConfigError(f"{name}.{unknown[0]}: unknown key; valid: {', '.join(own)}")
