"""What a command's own keys must be, checked at the door: before scenes are read, and long before anything compiles.

The groups (dynamics, reward, ppo, ...) are checked against the functions that they configure, by `build`. These keys configure commands.
"""

import importlib.util
import os
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError, check_type


class Key(NamedTuple):
    """A key's type, and the least value that makes sense, also for each of a list."""

    hint: Any
    least: float | None = None


COUNT, SEED, FLAG, PLACE = Key(int, 1), Key(int, 0), Key(bool), Key(str | None)
VIDEO = {"enable": FLAG, "worlds": SEED, "seconds": Key(float, 0.1), "stride": COUNT, "fps": Key(float, 0.1), "columns": COUNT}
VIDEO |= {"panel": Key(int, 120), "trail_s": Key(float, 0), "suffix": Key(Literal[".gif", ".mp4"])}
FAILURE_NOTES = {name: Key(float, 0) for name in ("moving_mps", "lane_m", "wrong_way_m", "rest_m", "near_m")}
FAILURE_NOTES |= {"against_cos": Key(float, -1)}
FAILURE_KINDS = {name: Key(float, 0) for name in ("own_share", "own_mps", "stuck_s", "away_m")}
FAILURE_PICTURES = {"enable": FLAG, "panels": COUNT, "before_s": Key(float, 0), "video": FLAG}
FAILURES = {"notes": FAILURE_NOTES, "kinds": FAILURE_KINDS, "pictures": FAILURE_PICTURES}
JUDGE = {"seed": SEED, "repeats": COUNT, "chunk_steps": COUNT, "ttc_limit_s": Key(float, 0), "bootstrap": COUNT, "untrained": FLAG}
PROTOCOL = {"name": Key(str), "settings": Key(list[str]), "termination": Key(list[str]), "seed": SEED, "repeats": COUNT}
EVALUATION = {"enable": FLAG, "every": Key(int | list[int] | None, 0), "protocols": Key(list[str]), **JUDGE}
TRAIN = {"name": Key(str), "out": PLACE, "resume": FLAG, "seed": SEED, "worlds": COUNT, "iterations": COUNT}
TRAIN |= {"devices": Key(int | None, 1), "stream": Key(dict | None)}
TRAIN |= {"minutes": Key(float | None, 0), "checkpoint_every": COUNT, "checkpoints_kept": COUNT, "loggers": Key(dict), "progress": FLAG}
BENCH = {"seed": SEED, "worlds": COUNT, "warmup": SEED, "repeats": COUNT, "out": PLACE, "phases": FLAG, "name": Key(str)}
BENCH |= {"scope": Key(Literal["training", "environment", "physics"]), "variants": Key(dict[str, dict])}
BENCH |= {"devices": Key(int | None, 1), "stream": Key(dict | None), "baseline": Key(dict | None), "resume": FLAG}
BASELINE = {"worlds": COUNT, "steps": COUNT, "repeats": COUNT}
SYSID = {"out": Key(str), "resume": FLAG, "workers": COUNT, "physics_hz": Key(float, 1)}
VALIDATE = {"out": Key(str), "parts": Key(list[str]), "resume": FLAG, "workers": COUNT}
COMPARE = {"runs": Key(list[str]), "out": Key(str), "metrics": Key(list[str]), "window": COUNT, "last": Key(float, 0), "bootstrap": COUNT}
COMPARE |= {"seed": SEED}
EXAMINED = {"seed": SEED, "repeats": COUNT, "chunk_steps": COUNT, "ttc_limit_s": Key(float, 0), "bootstrap": COUNT}
STUDY = {"train_scenes": PLACE, "test_scenes": PLACE, "cut": Key(Literal["test", "validation"]), "runs": Key(str), "out": PLACE}
STUDY |= {"seeds": Key(list[int] | None), "common": Key(list[str]), "only": Key(list[str] | None), "until_s": Key(float | None, 0)}
STUDY |= {"parts": Key(list[Literal["train", "judge", "report", "draw"]]), "target": Key(float, 0), "progress": FLAG, "slim": FLAG}
STUDY |= {"processes": COUNT, "per_gpu": COUNT}
STUDIED = {"name": Key(str), "question": Key(str), "base": Key(list[str]), "common": Key(list[str]), "trainings": Key(dict[str, list])}
STUDIED |= {"seeds": Key(list[int]), "examined": Key(list[str]), "conditions": Key(dict[str, list]), "protocols": Key(list[str])}
STUDIED |= {"judged": Key(dict[str, list] | None), "floors": Key(dict[str, dict]), "compare": Key(list[list[str]])}
STUDIED |= {"figures": Key(list[Literal["learning", "rates", "matrix", "differences", "trend"]]), "trend": Key(dict | None)}
STUDIED |= {"reading": Key(str | None)}
FLOOR = {"of": Key(str), "overrides": Key(list[str]), "conditions": Key(list[str] | None), "seeds": Key(Literal[1] | None)}
TREND = {"label": Key(str), "values": Key(dict[str, float | None])}
WEATHER = {"out": Key(str), "films_mm": Key(list[float]), "speeds_mps": Key(list[float]), "slips": Key(list[float])}
WEATHER |= {"film_most_mm": Key(float, 0)}
VIEW = {"run": PLACE, "trust": FLAG, "overrides": Key(list[str]), "act": Key(Literal["policy", "coast", "random"]), "worlds": COUNT}
VIEW |= {"skip": SEED, "seconds": Key(float, 0.1), "seed": SEED, "out": Key(str), "window": FLAG, "title": PLACE, "car": Key(int | None, 0)}
VIEW |= {"off_map_m": Key(float, 1.0)}
CAMERA = {"distance_m": Key(float, 1), "pitch_deg": Key(float, -90), "lag_s": Key(float, 0)}
FILM = {"view": Key(Literal["chase", "bird", "both"]), "width": Key(int, 64), "height": Key(int, 64), "fps": Key(float, 0.1)}
FILM |= {"stride": COUNT, "at_s": Key(float, 0), "trail_s": Key(float, 0)}
KEYS = {name: Key(str) for name in ("throttle", "brake", "left", "right", "stop", "reset", "pause", "camera")}
RESPONSE = {name: Key(float, 0.01) for name in ("rise_s", "fall_s", "turn_s", "centre_s", "half_steer_mps", "tap_s")}
HANDING_ON = {"run": Key(str), "trust": FLAG, "out": Key(str)}
CARD = {"about": PLACE, "judged": Key(dict[str, str] | None), "bootstrap": COUNT, "seed": SEED}
SCENES = {"op": Key(str), "out": PLACE, "copy": FLAG, "limit": SEED, "seed": SEED, "progress": FLAG, "filter": PLACE}
INFO, SHEET = {"by": PLACE, "json": FLAG}, {"columns": COUNT, "inches": Key(float, 0.5)}
SAMPLE = {"count": Key(int | None, 1), "share": Key(float | None, 0), "stratify": PLACE}
SPLIT = {"shares": Key(dict[str, float] | None), "by": Key(Literal["scene", "streets"]), "least_shared": COUNT}
MERGE = {"banks": Key(list[str]), "duplicates": Key(Literal["refuse", "first"])}
DEDUPE = {"tolerance_m": Key(float, 0.001), "share": Key(float, 0), "slack": Key(float, 1e-6)}
SIMULATE, EXPORT = {"seconds": Key(float, 0.01), "worlds": COUNT}, {"format": Key(str)}
OPERATIONS = {"info": INFO, "sheet": SHEET, "sample": SAMPLE, "split": SPLIT, "merge": MERGE, "dedupe": DEDUPE, "simulate": SIMULATE}
COMPARED = {"traffic": Key(list[str]), "limit": COUNT}
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
        numbers = value if isinstance(value, list) else [value]
        if least is not None and value is not None and not all(number >= least for number in numbers):
            raise ConfigError(f"{place}: {value}; wanted is at least {least}")


def check_train(config: Mapping[str, Any]) -> None:
    """Every key of `train`, also those of the evaluation that comes hours later.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, TRAIN)
    evaluation = config["evaluation"]
    check(evaluation, EVALUATION, where="evaluation")
    check_video(evaluation["video"], where="evaluation.video")
    check_failures(evaluation, where="evaluation.failures")
    _check_protocols(evaluation["protocols"], where="evaluation.protocols")


def _check_protocols(protocols: list[str], *, where: str) -> None:
    known = sorted(path.stem for path in (configs.find_conf() / "termination").glob("*.yaml"))
    for protocol in protocols or [None]:
        if protocol not in known:
            raise ConfigError(f"{where}: {protocols}; valid: one or more of {', '.join(known)}")


def check_evaluate(config: Mapping[str, Any]) -> None:
    """Every key of `evaluate`.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, {"run": Key(str), "trust": FLAG, "out": PLACE, "overrides": Key(list[str]), **JUDGE})
    check(config["protocol"], PROTOCOL, where="protocol")
    _check_protocols(config["protocol"]["termination"], where="protocol.ends")
    check_video(config["video"], where="video")
    check_failures(config, where="failures")


def check_export(config: Mapping[str, Any]) -> None:
    """Every key of `export`.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, HANDING_ON)
    check(config["card"], CARD, where="card")


def check_video(video: Mapping[str, Any], *, where: str) -> None:
    """Every key of a video, and that there is what writes it: it comes last, after all the work.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(video, VIDEO, where=where)
    if video["enable"] and video["suffix"] == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ConfigError(f"{where}.suffix: .mp4 needs ffmpeg, which is missing; `pip install 'scenefactory_jax[video]'`, or choose .gif")


def check_failures(settings: Mapping[str, Any], *, where: str) -> None:
    """Every key of the group `failures` in an evaluation's settings.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    if "failures" not in settings:
        raise ConfigError(f"{where}: missing; an evaluation needs the group `failures`")
    for name, own in FAILURES.items():
        if name not in settings["failures"]:
            raise ConfigError(f"{where}.{name}: missing; {where} needs {', '.join(FAILURES)}")
        check(settings["failures"][name], own, where=f"{where}.{name}")
        if unknown := [key for key in settings["failures"][name] if key not in own]:
            raise ConfigError(f"{where}.{name}.{unknown[0]}: unknown key; valid: {', '.join(own)}")


def check_study(config: Mapping[str, Any]) -> None:
    """Every key of `study` and of the study that it names; the names that they use of each other are `study_plan.check`'s.

    Raises:
        ConfigError: naming the key, the value and what would be valid.
    """
    check(config, STUDY)
    check(config["evaluation"], EXAMINED, where="evaluation")
    entries = [(config["study"], STUDIED, "study")]
    check(config["study"], STUDIED, where="study")
    entries += [(floor, FLOOR, f"study.floors.{name}") for name, floor in config["study"]["floors"].items()]
    entries += [] if config["study"]["trend"] is None else [(config["study"]["trend"], TREND, "study.trend")]
    for entry, known, where in entries:
        check(entry, known, where=where)
        if unknown := [key for key in entry if key not in known]:
            raise ConfigError(f"{where}.{unknown[0]}: unknown key; valid: {', '.join(known)}")
    _check_protocols(config["study"]["protocols"], where="study.protocols")
    for where, seeds in {"seeds": config["seeds"], "study.seeds": config["study"]["seeds"]}.items():
        if seeds is not None and (not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds)):
            raise ConfigError(f"{where}: {seeds}; wanted are one or more different numbers from 0 up")
    if odd := [pair for pair in config["study"]["compare"] if len(pair) != 2]:
        raise ConfigError(f"study.compare: {odd[0]}; wanted are pairs, [before, after]")


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
