"""Train states on disk: a folder of checkpoints, one npz file for each saved iteration, with its worlds and replay buffers beside it.

A policy needs neither to be evaluated or started from. Buffers take gigabytes; without their file training does not go on. Worlds take
hundreds of megabytes; without their file training goes on in new episodes, so that a run moves to another machine as a small file. A file
has the arrays of a train state by their paths ("parameters/params/actor/trunk/layer_0/kernel"), random keys as their data, and no empty
arrays. It is written atomically. The checksums of its arrays (CRC-32, as in every zip file) are compared before anything is read.
"""

import json
import logging
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict
from jaxtyping import Array

from scenefactory_jax.core import distributed, sharding
from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.learning import replay_buffer
from scenefactory_jax.learning.replay_buffer import Buffer

PARAMETERS, AVERAGED, LEARNT, BUFFER = "parameters/", "ema_parameters/", "learner/", "buffer/"  # paths of arrays begin with these
NETWORKS = (PARAMETERS, AVERAGED, LEARNT)  # what a finished run is left with
NETWORK = "/params/"  # behind the path of a network
PARTS = {"buffer": (BUFFER,), "worlds": ("worlds/", "scene_stats/")}  # in files of their own: N.buffer.npz, N.worlds.npz
HOST = "host"  # JSON text of the values that the training loop adds
FILE = "policy.npz"  # in place of checkpoints: parameters alone
Arrays = dict[str, np.ndarray]
LOG = logging.getLogger(__name__)


def save(folder: Path | str, train_state: Any, *, keep: int, host: Mapping[str, Any] | None = None) -> Path:
    """Writes a train state under its iteration's number and keeps the `keep` newest checkpoints of the folder.

    Of several processes all call it; the first one writes, and the others wait for it.

    Args:
        host: plain JSON values to save with it.

    Raises:
        ConfigError: `keep` below one.
        OSError: the disk is full; earlier checkpoints are as they were.
    """
    if keep < 1:
        raise ConfigError(f"keep: expected an integer >= 1, got {keep}")
    file = _path(folder, int(train_state.iteration))
    arrays: Arrays = sharding.fetch({name: _to_data(leaf) for name, leaf in name_leaves(train_state).items() if leaf.size})
    if not distributed.is_first():
        distributed.share(f"saved/{file.stem}", lambda: None)
        return file
    arrays |= {} if host is None else {HOST: np.array(json.dumps(host))}
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        for part, prefixes in PARTS.items():  # first: a checkpoint without its buffers would be the newest
            if arrays_of_part := {name: arrays.pop(name) for name in list(arrays) if name.startswith(prefixes)}:
                _write(_beside(file, part), arrays_of_part)
        _write(file, arrays)
    except OSError as error:
        hint, newest = "there is no complete checkpoint", latest(folder)
        if newest is not None:
            hint = f"checkpoint {newest} is complete: with resume=true training goes on from it"
        raise OSError(error.errno, f"{error.strerror}; {hint}", str(file)) from None
    _remove(folder, _list_iterations(folder)[:-keep])
    distributed.share(f"saved/{file.stem}", lambda: None)
    return file


def latest(folder: Path | str) -> int | None:
    """Iteration of the newest checkpoint; None if the folder has none."""
    return max(_list_iterations(folder), default=None)


def drop_training_state(folder: Path | str) -> None:
    """Removes all but the networks of the newest checkpoint: for a run that will not be resumed; others may start from it."""
    *earlier, newest = _list_iterations(folder)
    _write(_path(folder, newest), _load(_path(folder, newest), NETWORKS))
    _remove(folder, earlier)
    for part in PARTS:
        _beside(_path(folder, newest), part).unlink(missing_ok=True)


def restore(folder: Path | str, like: Any, iteration: int | None = None) -> Any:
    """Reads the train state of an iteration (the newest by default), in the structure and on the devices of `like`.

    Replay buffers may have other groups, of another number of devices: their rows are dealt anew. Without a file
    of worlds those of `like` are taken.

    Args:
        like: a train state of the same config, for example a new `trainer.init(...)`.

    Raises:
        FileNotFoundError: the folder has no such checkpoint; the message lists those it has.
        ConfigError: the checkpoint was made with another config, the message names the arrays that differ; or it is damaged.
    """
    file = _find(folder, iteration)
    stored = {name: value for name, value in _load(file).items() if name != HOST}
    if all(name.startswith(NETWORKS) for name in stored):
        raise ConfigError(f"{file}: has networks only; training cannot go on, only start_from this run")
    leaves, held = name_leaves(like), {}
    for part, prefixes in PARTS.items():
        wanted = {name: leaf for name, leaf in leaves.items() if name.startswith(prefixes) and leaf.size}
        if _beside(file, part).is_file():
            stored |= _load_part(_beside(file, part))
        elif wanted and not any(name.startswith(prefixes) for name in stored):  # older checkpoints have all in one file
            if part != "worlds":
                missing = f"{_beside(file, part).name} is not beside it, the replay buffer"
                raise ConfigError(f"{file}: {missing}; training cannot go on, only start_from this run")
            LOG.info(f"{file}: {_beside(file, part).name} is not beside it: all worlds start new episodes")
            held = wanted
    stored |= _regroup_buffers(stored, like)
    expected = {name: _to_data(leaf) for name, leaf in leaves.items() if leaf.size and name not in held}
    _check_same_arrays(stored, expected, file)
    placed = [leaf if name in held else _place(stored.get(name), leaf) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(like), placed)


def _load_part(file: Path) -> Arrays:
    """The arrays of a file beside a checkpoint."""
    if damage := _find_damage(file):
        raise ConfigError(f"{file}: damaged: {damage}; restore it from a copy, or start_from this run")
    return _load(file)


def _regroup_buffers(stored: Arrays, like: Any) -> Arrays:
    """Deals the rows of replay buffers to as many groups as `like` has, which may be of another number of devices."""
    regrouped: Arrays = {}
    for name, buffer in like.buffer.items() if isinstance(like.buffer, Mapping) else ():
        prefix = f"{BUFFER}{name}/"
        found = {path.removeprefix(prefix): leaf for path, leaf in stored.items() if path.startswith(prefix)}
        if isinstance(buffer, Buffer) and "filled" in found and len(found["filled"]) != len(buffer.filled):
            groups, capacity = jax.tree.leaves(buffer.rows)[0].shape[:2]
            regrouped |= {f"{prefix}{path}": leaf for path, leaf in replay_buffer.regroup(found, groups, capacity).items()}
    return regrouped


def restore_host(folder: Path | str, iteration: int | None = None) -> dict[str, Any] | None:
    """Reads the JSON values that were saved with a train state; None if there were none. Raises as `restore`."""
    stored = _load(_find(folder, iteration), HOST)
    return json.loads(str(stored[HOST])) if stored else None


def restore_parameters(folder: Path | str, iteration: int | None = None) -> Any:
    """Reads only parameters, as nested dicts of arrays on the default device: for evaluation, wherever training ran.

    The running mean of the parameters, where training kept one. A folder that `write_parameters` wrote has nothing else. Raises as
    `restore`.
    """
    exported = Path(folder) / FILE
    if iteration is None and exported.is_file():
        if damage := _find_damage(exported):
            raise ConfigError(f"{exported}: damaged: {damage}; restore it from a copy")
        arrays = {name: leaf.astype(np.float32) if leaf.dtype == np.float16 else leaf for name, leaf in _load(exported).items()}
    else:
        file = _find(folder, iteration)
        averaged, last = _load(file, AVERAGED), _load(file, PARAMETERS)
        arrays = {name.partition("/")[2]: value for name, value in (averaged or last).items()}
    return jax.device_put(unflatten_dict(arrays, sep="/"), may_alias=False)  # copied; `jnp.array` would compile a program for every shape


def put_networks(folder: Path | str, state: Any) -> tuple[Any, list[str]]:
    """Puts networks of the newest checkpoint into a new train state, for a training that starts from them.

    The policy's are those that `restore_parameters` reads. Of what else the algorithm learns (critics, target networks), a network is taken
    if all of its arrays fit. Optimizers start anew, and numbers beside the networks (alpha) stay as the config has them.

    Args:
        state: a new `trainer.init(...)`.

    Returns:
        The train state, and the paths of the networks that were taken.

    Raises:
        ConfigError: the policy's parameters do not fit, the message names the arrays that differ. Otherwise as `restore`.
    """
    leaves = name_leaves(state)
    policy = {f"{PARAMETERS}{name}": np.asarray(leaf) for name, leaf in name_leaves(restore_parameters(folder)).items()}
    _check_same_arrays(policy, {name: leaf for name, leaf in leaves.items() if name.startswith(PARAMETERS)}, Path(folder))
    found = {} if (Path(folder) / FILE).is_file() else _load(_find(folder, None), LEARNT)
    describe = lambda arrays, path: {name: (leaf.shape, leaf.dtype) for name, leaf in arrays.items() if name.startswith(path)}  # noqa: E731
    paths = sorted({name.partition(NETWORK)[0] + NETWORK for name in leaves if name.startswith(LEARNT) and NETWORK in name})
    taken = [path for path in paths if describe(found, path) == describe(leaves, path)]
    chosen = policy | {name: leaf for name, leaf in found.items() if name.startswith(tuple(taken))}
    for name, value in policy.items():
        if (averaged := name.replace(PARAMETERS, AVERAGED, 1)) in leaves:
            chosen[averaged] = value
        if (past := f"past/{name}") in leaves:  # the window over past policies has this one first
            chosen[past] = np.asarray(leaves[past].at[0].set(value))
    placed = [_place(chosen[name], leaf) if name in chosen else leaf for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(state), placed), [PARAMETERS, *taken]


def write_parameters(folder: Path | str, parameters: Any, *, dtype: str = "float32") -> Path:
    """Writes parameters to one compressed file of the folder, which `restore_parameters` reads.

    Args:
        dtype: of floating-point numbers in the file; with float16 it has half the size, and they are read back rounded.
    """
    file = Path(folder) / FILE
    arrays = jax.device_get(name_leaves(parameters))
    stored = {name: leaf.astype(dtype) if np.issubdtype(leaf.dtype, np.floating) else leaf for name, leaf in arrays.items()}
    _write(file, stored, savez=np.savez_compressed)
    return file


def _path(folder: Path | str, iteration: int) -> Path:
    return Path(folder) / f"{iteration}.npz"


def _beside(file: Path, part: str) -> Path:
    """The file of a part of a checkpoint."""
    return file.with_suffix(f".{part}.npz")


def _remove(folder: Path | str, iterations: Iterable[int]) -> None:
    """Removes checkpoints, and parts without one: a save may have ended between the files."""
    for iteration in iterations:
        _path(folder, iteration).unlink()
    for part in PARTS:
        kept = {_beside(_path(folder, iteration), part) for iteration in _list_iterations(folder)}
        for file in set(Path(folder).glob(f"*.{part}.npz")) - kept:
            file.unlink()


def _list_iterations(folder: Path | str) -> list[int]:
    """Iterations of the checkpoints, ascending."""
    return sorted(int(file.stem) for file in Path(folder).glob("*.npz") if file.stem.isdecimal())


def _find(folder: Path | str, iteration: int | None) -> Path:
    """Finds the file of a checkpoint (None: the newest) and compares its checksums."""
    iterations = _list_iterations(folder)
    if not iterations:
        raise FileNotFoundError(f"{folder}: no checkpoint there")
    if iteration is not None and iteration not in iterations:
        raise FileNotFoundError(f"{folder}: no checkpoint of iteration {iteration}; there are {', '.join(map(str, iterations))}")
    chosen = iterations[-1] if iteration is None else iteration
    file = _path(folder, chosen)
    if damage := _find_damage(file):
        hint = "the folder has no complete checkpoint before it: restore it from a copy"
        if before := [earlier for earlier in iterations if earlier < chosen and not _find_damage(_path(folder, earlier))]:
            hint = f"checkpoint {before[-1]} before it is complete: remove {file}, and the same command uses that one"
        raise ConfigError(f"{file}: damaged: {damage}; {hint}")
    return file


def _find_damage(file: Path) -> str | None:
    """Finds the first array that differs from its checksum, or why the file cannot be read; None: it is as it was written."""
    try:
        with zipfile.ZipFile(file) as archive:
            changed = archive.testzip()
    except Exception as error:  # of zipfile, zlib, struct: whatever the changed bytes lead to
        return str(error)
    return changed and f"{changed.removesuffix('.npy')} has changed since it was written"


def _write(file: Path, arrays: Mapping[str, np.ndarray], *, savez: Callable[..., None] = np.savez) -> None:
    with write_atomically(file) as part, part.open("wb") as opened:
        savez(opened, **arrays)


def _load(file: Path, prefix: str | tuple[str, ...] = "") -> Arrays:
    """Reads the arrays whose names begin with a prefix, or with one of several; numpy reads bfloat16 as two bytes without a type."""
    with np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files if name.startswith(prefix)}
    return {name: value.view(jnp.bfloat16) if value.dtype.kind == "V" else value for name, value in arrays.items()}


def _check_same_arrays(stored: Mapping[str, Any], expected: Mapping[str, Any], file: Path) -> None:
    """Checks that a checkpoint has the expected arrays, with their shapes and types."""
    old, new = ({name: f"{tuple(leaf.shape)} {leaf.dtype}" for name, leaf in tree.items()} for tree in (stored, expected))
    differ = [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]
    if not differ:
        return
    named = [name for name in differ if name.startswith(PARAMETERS)] or differ  # optimizer states differ where parameters do
    lines = [f"{name}: it has {old.get(name, 'none')}, the config expects {new.get(name, 'none')}" for name in named[:4]]
    more = f"; and {len(named) - 4} more" if len(named) > 4 else ""
    raise ConfigError(f"{file} does not fit this config: {'; '.join(lines)}{more}; use the settings of the run, or another folder")


def name_leaves(tree: Any) -> dict[str, Any]:
    """Path -> leaf, in the order of the leaves."""
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def _to_data(leaf: Any) -> Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _place(value: np.ndarray | None, leaf: Array) -> Array:
    """Places a value on the devices of `leaf`. It is bound to a device only if `leaf` is: otherwise a resumed run compiles again."""
    if value is None:
        return jnp.copy(leaf)  # an empty array, as a buffer of its own: donating one does not delete the other
    placed = sharding.place(value, leaf.sharding) if leaf.committed else jax.device_put(value, may_alias=False)
    return jax.random.wrap_key_data(placed, impl=jax.random.key_impl(leaf)) if leaf.dtype != value.dtype else placed
