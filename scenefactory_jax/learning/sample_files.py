"""Recorded samples of an expert on disk: a folder of chunks, one npz file of equally many samples each, and an index.

A chunk has arrays with the samples along their first axis, by their paths: `action`, `observation/GROUP`, in a set
`observation/GROUP/features` and `/mask`, with next observations also `next_observation/...` and `follows`; and where a sample comes
from: `scene` (entry of the scenes), `agent` (slot) and `step` (actions since the start of the episode). The index, `samples.json`, is
written last.
"""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import result_file
from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.config import find_differences
from scenefactory_jax.core.schema import ConfigError

FILE = "samples.json"
ORIGIN = ("scene", "agent", "step")  # arrays that no learner reads
GROUPS = ("observations", "actions", "dynamics")  # of the config, in which a run must be as the recording
RATE = "control_hz"  # of the group `timing`, too
Arrays = dict[str, np.ndarray]


class Index(NamedTuple):
    """What `samples.json` has."""

    rows: list[int]  # samples of each chunk; all have the same number, but for the last one
    arrays: dict[str, dict[str, Any]]  # path -> shape of a sample and dtype
    config: dict[str, Any]  # in which a run must be as the recording
    about: dict[str, Any]  # scenes, expert and noise, seed, versions


def describe_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a config in which a run must be as the recording."""
    return result_file.plain({name: config[name] for name in GROUPS} | {"timing": {RATE: config["timing"][RATE]}}, digits=None)


def write_chunk(folder: Path, number: int, arrays: Arrays) -> None:
    """Writes one chunk."""
    with write_atomically(locate_chunk(folder, number)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def write_index(folder: Path, index: Index) -> None:
    """Writes the index, after all chunks."""
    result_file.write(folder / FILE, index._asdict(), digits=None)


def locate_chunk(folder: Path, number: int) -> Path:
    """The file of a chunk."""
    return folder / f"{number:05d}.npz"


def read_index(folder: Path) -> Index:
    """Reads the index of a folder.

    Raises:
        ConfigError: there is none, or it is damaged.
    """
    file = folder / FILE
    if not file.is_file():
        raise ConfigError(f"learner.samples: {folder} has no {FILE}; expected a folder that `record` has written to its end")
    try:
        return Index(**json.loads(file.read_text()))
    except (ValueError, TypeError) as error:
        raise ConfigError(f"learner.samples: {file}: damaged: {error}; restore it from a copy") from None


def read_chunk(folder: Path, number: int, names: list[str], *, rows: int) -> Arrays:
    """Reads some arrays of a chunk; numpy reads bfloat16 as two bytes without a type.

    Raises:
        ConfigError: a file that is missing or damaged.
    """
    file = locate_chunk(folder, number)
    try:
        with np.load(file) as stored:
            arrays = {name: stored[name] for name in names}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise ConfigError(f"learner.samples: {file}: cannot be read: {error}; restore it from a copy") from None
    if wrong := [name for name, value in arrays.items() if len(value) != rows]:
        raise ConfigError(f"learner.samples: {file}: expected {rows} samples, got {len(arrays[wrong[0]])}; restore it from a copy")
    return {name: value.view(jnp.bfloat16) if value.dtype.kind == "V" else value for name, value in arrays.items()}


def check_fit(folder: Path, index: Index, config: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Checks that samples are those of a run.

    Args:
        expected: path -> array, or shape and type, of each row that the run's learner stores.

    Raises:
        ConfigError: naming the keys or arrays that differ.
    """
    if differences := find_differences(index.config, describe_config(config)):
        lines = [f"{key}: it has {old!r}, the run {new!r}" for key, (old, new) in list(differences.items())[:4]]
        raise ConfigError(f"learner.samples: {folder} does not fit: {'; '.join(lines)}; record with the settings of the run")
    for name, leaf in expected.items():
        found = index.arrays.get(name)
        if found is None:
            raise ConfigError(f"learner.samples: {folder} has no {name}; `record samples.next_observations=true` writes it")
        if tuple(found["shape"]) != tuple(leaf.shape) or found["dtype"] != str(leaf.dtype):
            old = f"{tuple(found['shape'])} {found['dtype']}"
            raise ConfigError(f"learner.samples: {folder} has {name} as {old}, the run needs {tuple(leaf.shape)} {leaf.dtype}")
