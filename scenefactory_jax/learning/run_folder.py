"""Opens the folder of a training: a new one or one to resume in, for one command at a time; removed if the training cannot start."""

import contextlib
import datetime
import itertools
import json
import logging
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core import config as configs
from scenefactory_jax.core import distributed, folder_lock
from scenefactory_jax.core.config import find_differences
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.learning import checkpoint

LOG = logging.getLogger(__name__)
MAX_LETTERS = 80  # of a sweep's changes in the name of a folder
# Keys that may change when a run is resumed, with all below them
FREE = ("out", "resume", "progress", "name", "iterations", "minutes", "checkpoint_every", "checkpoints_kept", "devices", "scenes.workers")
FREE += ("loggers", "evaluation", "scenes.heldout", "distributed", "start_from")


@contextlib.contextmanager
def open_run_folder(config: Mapping[str, Any]) -> Iterator[tuple[Path, bool]]:
    """Opens and locks the run's folder; gives it, and whether it has a checkpoint to resume from.

    Of several processes the first one does so, and the others use its folder.

    Raises:
        ConfigError: the folder has a run already, or for `resume` none, or one of other settings; or another command trains there; or a
            process that does not see the first one's folder, or has other settings.
    """
    if not distributed.is_first():
        yield _use_folder_of_first(config)
        return
    if config["resume"] and config["out"] is None:
        raise ConfigError("resume=true needs out=RUN_DIR: the folder to go on in")
    with _make_folder(config) as folder, folder_lock.lock_folder(folder):
        resumable = _find_resumable(folder, config)
        distributed.share("run", lambda: [str(folder.resolve()), resumable, config])
        yield folder, resumable


def _use_folder_of_first(config: Mapping[str, Any]) -> tuple[Path, bool]:
    folder, resumable, settings = distributed.share("run", lambda: None)
    if not Path(folder).is_dir():
        raise ConfigError(f"out: {folder} of the first process is not there on this host; give a folder that all hosts share")
    differ = find_differences(settings, json.loads(json.dumps(config)))
    if keys := [key for key in differ if not key.startswith("distributed.")]:
        raise ConfigError(f"{', '.join(keys[:4])}: expected the settings of the first process; start all processes with the same command")
    return Path(folder), resumable


def make_folder_name(name: str, changes: Sequence[str] = ()) -> Path:
    """Makes a folder name from the present time: `runs/NAME-TIME`, or in a sweep `runs/NAME-weather_wet-seed_1-TIME`.

    Args:
        changes: overrides in which the run differs from the others. Each is written as the last part of its key and its value, without
            characters that a shell or Hydra interprets; beyond MAX_LETTERS a checksum follows.
    """
    parts = [f"{key.rpartition('.')[2]}={value}" for key, _, value in (change.partition("=") for change in changes)]
    text = "-".join(re.sub(r"[^A-Za-z0-9.-]+", "_", part).strip("_") for part in parts)
    if len(text) > MAX_LETTERS:
        text = f"{text[: MAX_LETTERS - 9]}-{zlib.crc32(text.encode()):08x}"
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path("runs", "-".join(part for part in (name, text, stamp) if part))


@contextlib.contextmanager
def _make_folder(config: Mapping[str, Any]) -> Iterator[Path]:
    """Makes the folder; if an error ends the run while it is empty, it is removed with its new parents."""
    named, base = config["out"] is not None, Path(config["out"] or make_folder_name(config["name"]))
    for folder in itertools.chain([base], (base.with_name(f"{base.name}-{attempt}") for attempt in itertools.count(2))):
        new = folder_lock.find_missing_parents(folder)
        try:
            folder.mkdir(parents=True, exist_ok=named)
            break
        except FileExistsError:  # jobs of a parallel sweep start in the same second
            if named:
                raise ConfigError(f"out={folder}: is a file; give a folder") from None
    try:
        yield folder
    except BaseException:
        folder_lock.remove_empty(new)
        raise


def _find_resumable(folder: Path, config: Mapping[str, Any]) -> bool:
    """Whether there is a checkpoint to resume from; a run that was stopped before its first one starts again."""
    has_config, last = (folder / configs.FILE).is_file(), checkpoint.latest(folder / "checkpoints")
    if not config["resume"]:
        if has_config or last is not None:
            raise ConfigError(f"out={folder}: holds a run already; add resume=true to go on with it, or choose another folder")
        return False
    if not has_config:
        raise ConfigError(f"out={folder}: no run to go on with: it has no {configs.FILE}; valid: a folder that `train` wrote")
    _check_same(folder, config)
    if last is None:
        LOG.info(f"{folder} has no checkpoint to go on from: the run begins anew")
    return last is not None


def _check_same(folder: Path, config: Mapping[str, Any]) -> None:
    """Checks that the settings are those of the run, except for `FREE`."""
    show = lambda value: "{...}" if isinstance(value, Mapping) else value  # noqa: E731
    differences = find_differences(configs.read_values(folder), config).items()
    fixed = [(key, pair) for key, pair in differences if not any(f"{key}.".startswith(f"{free}.") for free in FREE)]
    if changed := [f"{key}={show(new)} (the run has {show(old)})" for key, (old, new) in fixed]:
        more = f"; and {len(changed) - 8} more" if len(changed) > 8 else ""
        raise ConfigError(f"resume=true: {'; '.join(changed[:8])}{more}: {folder} keeps its settings; for others choose another out")
