"""Train states on disk, by orbax: a folder of checkpoints, one for each saved iteration.

A checkpoint is written under a temporary name and renamed when it is complete, so that an interrupted save leaves the earlier ones as they
were. Files have nested dicts of arrays, named as the fields and keys of the train state; random keys as their data, empty arrays not at
all. SHA256SUMS beside them, as `sha256sum` writes it, has the digest of each file; it is checked before anything is read.
"""

import contextlib
import errno
import hashlib
import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from flax.traverse_util import unflatten_dict
from jaxtyping import Array

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.schema import ConfigError

LEARNT, AVERAGED, REST = "parameters", "ema_parameters", "rest"  # items of a checkpoint: an evaluation reads no more than it needs
HOST = "host"  # item of the JSON values that the training loop adds
FILE = "policy.npz"  # in place of checkpoints: parameters alone
SUMS = "SHA256SUMS"
ATTEMPTS = 100  # 5 s
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk, the user's quota, or a file is full


def save(folder: Path | str, train_state: Any, *, keep: int, host: Mapping[str, Any] | None = None) -> Path:
    """Writes a train state under its iteration's number and keeps the `keep` newest checkpoints of the folder.

    Returns when the checkpoint is complete: the train state may be donated afterwards.

    Args:
        host: plain JSON values to save with it.

    Raises:
        ConfigError: `keep` below one.
        OSError: the disk is full; the incomplete checkpoint is removed, earlier ones are as they were.
    """
    if keep < 1:
        raise ConfigError(f"keep: expected an integer >= 1, got {keep}")
    iteration = int(train_state.iteration)
    place = Path(folder) / str(iteration)
    with _clean_up_full_disk(place), _manager(Path(folder), keep=keep) as manager:
        if iteration in manager.all_steps():
            manager.delete(iteration)
        items: dict[str, Any] = {name: ocp.args.StandardSave(item) for name, item in _split(_to_stored(train_state)).items()}
        items |= {} if host is None else {HOST: ocp.args.JsonSave(dict(host))}
        manager.save(iteration, args=ocp.args.Composite(**items), force=True)
        _write_sums(place, [file for file in sorted(place.rglob("*")) if file.is_file()])
    return place


def latest(folder: Path | str) -> int | None:
    """Iteration of the newest complete checkpoint; None if the folder has none."""
    return max(_list_iterations(Path(folder)), default=None)


def drop_training_state(folder: Path | str) -> None:
    """Removes all but the parameters of the newest checkpoint: for a run that will not be resumed."""
    newest = latest(folder)
    for place in Path(folder).iterdir():
        if place.name == str(newest):
            for item in (REST, HOST):
                shutil.rmtree(place / item, ignore_errors=True)
            lines = (place / SUMS).read_text().splitlines()
            _write_lines(place / SUMS, [line for line in lines if (place / line.partition("  ")[2]).is_file()])
        elif place.name.isdigit():
            shutil.rmtree(place)


def restore(folder: Path | str, like: Any, iteration: int | None = None) -> Any:
    """Reads the train state of an iteration (the newest by default), in the structure and on the devices of `like`.

    Args:
        like: a train state of the same config, for example a new `trainer.init(...)`.

    Raises:
        FileNotFoundError: the folder has no such checkpoint; the message lists those it has.
        ConfigError: the checkpoint was made with another config, the message names the arrays that differ; or it is damaged.
    """
    stored = _to_stored(like)
    with _open(Path(folder), iteration) as (manager, step):
        if not (Path(folder) / str(step) / REST).is_dir():
            raise ConfigError(f"{folder}: checkpoint {step} has parameters only; training cannot go on from it")
        metadata = manager.item_metadata(step)
        known = _join({name: metadata[name] for name in (LEARNT, AVERAGED, REST) if name in metadata})
        _check_same_arrays(known, stored, f"{folder}: checkpoint {step}")
        items = {name: ocp.args.StandardRestore(item) for name, item in _split(stored).items()}
        found = manager.restore(step, args=ocp.args.Composite(**items))
    return _to_structure(_join({name: found[name] for name in items}), like)


def restore_host(folder: Path | str, iteration: int | None = None) -> dict[str, Any] | None:
    """Reads the JSON values that were saved with a train state (the newest by default); None if there were none.

    Raises:
        FileNotFoundError: the folder has no such checkpoint; the message lists those it has.
        ConfigError: it is damaged.
    """
    with _open(Path(folder), iteration) as (manager, step):
        if not (Path(folder) / str(step) / HOST).is_dir():
            return None
        return manager.restore(step, args=ocp.args.Composite(host=ocp.args.JsonRestore()))[HOST]


def restore_parameters(folder: Path | str, iteration: int | None = None) -> Any:
    """Reads only parameters, as nested dicts of arrays on the default device: for evaluation, wherever training ran.

    The running mean of the parameters, where training kept one. A folder that `write_parameters` wrote has nothing else.

    Raises:
        FileNotFoundError: the folder has no such checkpoint; the message lists those it has.
        ConfigError: it is damaged.
    """
    if iteration is None and (Path(folder) / FILE).is_file():
        if damage := _find_damage(Path(folder)):
            raise ConfigError(f"{Path(folder) / FILE}: damaged: {damage}; restore it from a copy")
        with np.load(Path(folder) / FILE) as file:
            return unflatten_dict({name: jnp.asarray(file[name]) for name in file.files}, sep="/")
    with _open(Path(folder), iteration) as (manager, step):
        held = manager.item_metadata(step)
        name = AVERAGED if AVERAGED in held else LEARNT
        plain = jax.tree.map(lambda m: np.zeros(m.shape, m.dtype), held[name], is_leaf=_is_metadata)
        found = manager.restore(step, args=ocp.args.Composite(**{name: ocp.args.StandardRestore(plain)}))
    return jax.tree.map(jnp.asarray, found[name])


def write_parameters(folder: Path | str, parameters: Any) -> Path:
    """Writes parameters to one compressed file of the folder, which `restore_parameters` reads."""
    file = Path(folder) / FILE
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _name_leaves(parameters)}
    np.savez_compressed(file, **arrays)
    _write_sums(Path(folder), [file])
    return file


@contextlib.contextmanager
def _manager(folder: Path, *, keep: int | None = None) -> Iterator[ocp.CheckpointManager]:
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, create=keep is not None, enable_async_checkpointing=False)
    handlers: dict[str, Any] = {name: ocp.StandardCheckpointHandler() for name in (LEARNT, AVERAGED, REST)}
    handlers[HOST] = ocp.JsonCheckpointHandler()
    log = logging.getLogger("absl")  # orbax logs what it raises, with its traceback
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with ocp.CheckpointManager(folder.absolute(), options=options, item_handlers=handlers) as manager:
            yield manager
    finally:
        log.setLevel(before)


@contextlib.contextmanager
def _open(folder: Path, iteration: int | None) -> Iterator[tuple[ocp.CheckpointManager, int]]:
    """Opens a checkpoint of the folder (None: the newest) after its files are checked; gives the manager and the iteration."""
    found = _list_iterations(folder)
    if not found:
        raise FileNotFoundError(f"{folder}: no checkpoint there")
    if iteration is not None and iteration not in found:
        raise FileNotFoundError(f"{folder}: no checkpoint of iteration {iteration}; there are {', '.join(map(str, found))}")
    step = found[-1] if iteration is None else iteration
    if damage := _find_damage(folder / str(step)):
        place, before = folder / str(step), [one for one in found if one < step and _find_damage(folder / str(one)) is None]
        hint = "the folder has no complete checkpoint before it: restore it from a copy"
        if before:
            hint = f"checkpoint {before[-1]} before it is complete: remove {place}, and the same command uses that one"
        raise ConfigError(f"{place}: damaged: {damage}; {hint}")
    with _manager(folder) as manager:
        yield manager, step


def _find_damage(place: Path) -> str | None:
    """Finds the first file that differs from its digest in SHA256SUMS; None: none does."""
    if not (place / SUMS).is_file():
        return f"{SUMS} is missing"
    for line in (place / SUMS).read_text(errors="replace").splitlines() or [""]:
        digest, _, name = line.partition("  ")
        if not name:
            return f"{SUMS} is cut short"
        if not (place / name).is_file():
            return f"{name} is missing"
        if _sha256(place / name) != digest:
            return f"{name} has changed since it was written"
    return None


def _write_sums(place: Path, files: Sequence[Path]) -> None:
    _write_lines(place / SUMS, [f"{_sha256(file)}  {file.relative_to(place).as_posix()}" for file in files if file.name != SUMS])


def _write_lines(file: Path, lines: Sequence[str]) -> None:
    with write_atomically(file) as part:
        part.write_text("".join(f"{line}\n" for line in lines))


def _sha256(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


@contextlib.contextmanager
def _clean_up_full_disk(place: Path) -> Iterator[None]:
    """Turns an error of a full disk into one line and removes the incomplete checkpoint: orbax raises tensorstore's ValueError, which has
    the system's reason in its text, and leaves writes of other arrays running that may still add files."""
    try:
        yield
    except (ValueError, OSError) as error:
        code = next((code for code in FULL if os.strerror(code) in str(error)), None)
        if code is None:
            raise
        for _ in range(ATTEMPTS):
            if not (parts := list(place.parent.glob(f"{place.name}.orbax-checkpoint-tmp*"))):
                break
            for part in parts:
                shutil.rmtree(part, ignore_errors=True)
            time.sleep(0.05)
        held = latest(place.parent)
        kept = "there is no complete checkpoint"
        if held is not None:
            kept = f"checkpoint {held} is complete: with resume=true training goes on from it"
        raise OSError(code, f"{os.strerror(code)}; {kept}", str(place)) from None


def _list_iterations(folder: Path) -> list[int]:
    """Iterations of the complete checkpoints, ascending; incomplete ones have other names."""
    return sorted(int(place.name) for place in folder.iterdir() if place.name.isdecimal()) if folder.is_dir() else []


def _check_same_arrays(held: Mapping[str, Any], expected: Mapping[str, Any], where: str) -> None:
    """Checks that a checkpoint has the expected arrays, with their shapes and types."""
    arrays = [{name: (tuple(leaf.shape), str(np.dtype(leaf.dtype))) for name, leaf in tree.items()} for tree in (held, expected)]
    differ = [name for name in sorted(arrays[0].keys() | arrays[1].keys()) if arrays[0].get(name) != arrays[1].get(name)]
    named = [name for name in differ if name.startswith(f"{LEARNT}/")] or differ  # optimizer states differ where parameters do
    if not named:
        return
    lines = []
    for name in named[:4]:
        there, here = arrays[0].get(name), arrays[1].get(name)
        if there is None or here is None:
            has, expects = ("no", "one") if there is None else ("an", "none")
            lines.append(f"checkpoint has {has} array {name}, config expects {expects}")
        else:
            index = int(there[0] == here[0])  # the shape, or if that is the same, the type
            lines.append(f"checkpoint has {name} {there[index]}, config expects {here[index]}")
    more = f"; and {len(named) - 4} more" if len(named) > 4 else ""
    hint = "use the settings of the run, or another folder"
    raise ConfigError(f"{where} does not fit this config: {'; '.join(lines)}{more}; {hint}")


def _name_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Leaves with their paths: 'parameters/params/actor/trunk/layer_0/kernel'."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=_is_metadata)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]


def _to_stored(train_state: Any) -> dict[str, Array]:
    """The arrays that are written, by name."""
    return {name: _to_data(leaf) for name, leaf in _name_leaves(train_state) if leaf.size}


def _to_data(leaf: Any) -> Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _to_structure(arrays: dict[str, Any], like: Any) -> Any:
    """`like` with other values."""

    def place(value: Array, leaf: Array) -> Array:  # bound to a device only if `leaf` is: otherwise a resumed run compiles again
        return value if leaf.committed else jnp.array(np.asarray(value))

    def put(name: str, leaf: Any) -> Any:
        if not leaf.size:
            return jnp.copy(leaf)  # a buffer of its own, so that donating one does not delete the other
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(place(arrays[name], leaf), impl=jax.random.key_impl(leaf))
        return place(arrays[name], leaf)

    return jax.tree.unflatten(jax.tree.structure(like), [put(name, leaf) for name, leaf in _name_leaves(like)])


def _split(stored: dict[str, Any]) -> dict[str, dict]:
    """Divides named arrays into the items of a checkpoint, nested; items without arrays are left out."""
    nested = unflatten_dict(stored, sep="/")
    items = {LEARNT: nested.pop(LEARNT, {}), AVERAGED: nested.pop(AVERAGED, {}), REST: nested}
    return {name: item for name, item in items.items() if item}


def _join(items: Mapping[str, Any]) -> dict[str, Any]:
    """Joins the items of a checkpoint to leaves by name."""
    prefixes = {name: "" if name == REST else f"{name}/" for name in items}
    return {f"{prefixes[name]}{path}": leaf for name, item in items.items() for path, leaf in _name_leaves(item)}


def _is_metadata(x: Any) -> bool:
    return hasattr(x, "shape") and hasattr(x, "dtype")
