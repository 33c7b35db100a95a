"""Train states on disk, by orbax: a folder of checkpoints, one for each saved iteration.

A checkpoint is written aside and renamed when it is whole, so that an interrupted save leaves the ones before it as they were. On disk
stand plain nested dicts of arrays, named as the fields and keys of the train state; random keys as their data, empty arrays not at all.
SHA256SUMS beside them, as `sha256sum` writes it, has the digest of each file; it is checked before anything is read. What older versions
wrote has none, and is read unchecked.
"""

import contextlib
import errno
import hashlib
import logging
import os
import shutil
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import Array

from scenefactory_jax.core.instantiate import ConfigError

LEARNT, AVERAGED, REST = "parameters", "ema_parameters", "rest"  # apart, so that an evaluation reads no more than it needs
PREFIX = {LEARNT: LEARNT, AVERAGED: AVERAGED, REST: ""}  # of the names of their arrays in a train state
FILE = "policy.npz"  # in place of checkpoints: what a policy learnt, alone
HOST = "host"  # what the loop around the train state carries
SUMS = "SHA256SUMS"
ATTEMPTS = 100  # 5 s
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk, one's share of it, or a file is full


def save(folder: Path | str, train_state: Any, *, keep: int, host: Mapping[str, Any] | None = None) -> Path:
    """Write a train state under its iteration's number and keep the `keep` newest checkpoints of the folder.

    Blocks until the checkpoint is whole: the train state may be donated afterwards.

    Args:
        host: plain JSON values that belong to it, if there are any.

    Raises:
        ConfigError: `keep` below one.
        OSError: the disk is full; what was written of the checkpoint is removed, those before it are as they were.
    """
    if keep < 1:
        raise ConfigError(f"keep: {keep} checkpoints; wanted is at least 1")
    iteration = int(train_state.iteration)
    parts = _parts(_stored(train_state))
    place = Path(folder) / str(iteration)
    with _fitting(place), _manager(Path(folder), keep=keep) as manager:
        if iteration in manager.all_steps():
            manager.delete(iteration)
        items: dict[str, Any] = {name: ocp.args.StandardSave(part) for name, part in parts.items()}
        items |= {} if host is None else {HOST: ocp.args.JsonSave(dict(host))}
        manager.save(iteration, args=ocp.args.Composite(**items), force=True)
        _write_sums(place, [file for file in sorted(place.rglob("*")) if file.is_file()])
    return place


def latest(folder: Path | str) -> int | None:
    """Iteration of the newest whole checkpoint; None if the folder holds none."""
    return max(_steps(Path(folder)), default=None)


def drop_training_state(folder: Path | str) -> None:
    """Leave what the policy learnt, as the newest checkpoint holds it, and remove the rest: for a run that is not to go on."""
    newest = latest(folder)
    for place in Path(folder).iterdir():
        if place.name == str(newest):
            for item in (REST, HOST):
                shutil.rmtree(place / item, ignore_errors=True)
            if (place / SUMS).is_file():
                lines = (place / SUMS).read_text().splitlines()
                _replace(place / SUMS, [line for line in lines if (place / line.partition("  ")[2]).is_file()])
        elif place.name.isdigit():
            shutil.rmtree(place)


def restore(folder: Path | str, like: Any, iteration: int | None = None) -> Any:
    """The train state of an iteration (the newest by default), in the structure and on the devices of `like`.

    Args:
        like: a train state of the same config, for example a fresh `trainer.init(...)`.

    Raises:
        FileNotFoundError: the folder holds no such checkpoint; the message lists those it holds.
        ConfigError: the checkpoint was made with another config, the message names the arrays that differ; or it is damaged.
    """
    wanted = _stored(like)
    with _opened(Path(folder), iteration) as (manager, step):
        if not (Path(folder) / str(step) / REST).is_dir():
            raise ConfigError(f"{folder}: checkpoint {step} was stripped to what the policy learnt; training cannot go on from it")
        held = manager.item_metadata(step)
        shapes = {name: (tuple(x.shape), str(x.dtype)) for name, x in wanted.items()}
        there = [name for name in (LEARNT, AVERAGED, REST) if name in held]
        known = {path: what for name in there for path, what in _shapes(held[name], PREFIX[name]).items()}
        _compare(known, shapes, f"{folder}: checkpoint {step}")
        parts = {name: ocp.args.StandardRestore(part) for name, part in _parts(wanted).items()}
        found = manager.restore(step, args=ocp.args.Composite(**parts))
    return _like({path: leaf for name in parts for path, leaf in _flat(found[name], PREFIX[name]).items()}, like)


def restore_host(folder: Path | str, iteration: int | None = None) -> dict[str, Any] | None:
    """The JSON values that were saved with a train state (the newest by default); None if there were none.

    Raises:
        FileNotFoundError: the folder holds no such checkpoint; the message lists those it holds.
        ConfigError: it is damaged.
    """
    with _opened(Path(folder), iteration) as (manager, step):
        if not (Path(folder) / str(step) / HOST).is_dir():
            return None
        return manager.restore(step, args=ocp.args.Composite(host=ocp.args.JsonRestore()))[HOST]


def restore_parameters(folder: Path | str, iteration: int | None = None) -> Any:
    """Only what the policy learnt, as nested dicts of arrays on the default device: for evaluation, wherever training ran.

    The running mean of the parameters, where training kept one. A folder that `write_parameters` wrote holds nothing else.

    Raises:
        FileNotFoundError: the folder holds no such checkpoint; the message lists those it holds.
        ConfigError: it is damaged.
    """
    if iteration is None and (Path(folder) / FILE).is_file():
        return _read_parameters(Path(folder))
    with _opened(Path(folder), iteration) as (manager, step):
        held = manager.item_metadata(step)
        name = AVERAGED if AVERAGED in held else LEARNT
        plain = jax.tree.map(lambda m: np.zeros(m.shape, m.dtype), held[name], is_leaf=_is_metadata)
        found = manager.restore(step, args=ocp.args.Composite(**{name: ocp.args.StandardRestore(plain)}))
    return jax.tree.map(jnp.asarray, found[name])


def write_parameters(folder: Path | str, parameters: Any) -> Path:
    """What a policy learnt, in one compressed file of the folder that `restore_parameters` reads."""
    file = Path(folder) / FILE
    numbers: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named(parameters)}
    np.savez_compressed(file, **numbers)
    _write_sums(Path(folder), [file])
    return file


def _read_parameters(folder: Path) -> Any:
    """What `write_parameters` wrote."""
    damage = _damage(folder)
    try:
        if damage is None:
            with np.load(folder / FILE) as file:
                return _nest({name: jnp.asarray(file[name]) for name in file.files})
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError) as error:
        damage = " ".join(str(error).split())
    raise ConfigError(f"{folder / FILE}: damaged: {damage}; restore it from a copy")


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
def _opened(folder: Path, iteration: int | None) -> Iterator[tuple[ocp.CheckpointManager, int]]:
    """What reads a checkpoint of the folder (None: the newest), and the iteration of that, once its files are as they were written."""
    step = _find(folder, iteration)
    place = folder / str(step)
    if damage := _damage(place):
        raise ConfigError(_told(folder, step, damage))
    try:
        with _manager(folder) as manager:
            yield manager, step
    except (ValueError, OSError) as error:
        if isinstance(error, ConfigError) or (place / SUMS).is_file():
            raise
        raise ConfigError(_told(folder, step, " ".join(str(error).split()))) from error  # of an older version: nothing else would tell


def _told(folder: Path, step: int, damage: str) -> str:
    """What is damaged, and which checkpoint to use instead."""
    place, before = folder / str(step), [one for one in _steps(folder) if one < step and _damage(folder / str(one)) is None]
    if not before:
        return f"{place}: damaged: {damage}; the folder holds no whole checkpoint before it: restore it from a copy"
    return f"{place}: damaged: {damage}; checkpoint {before[-1]} before it is whole: remove {place}, and the same command uses that one"


def _damage(place: Path) -> str | None:
    """Which file is not as it was written, of those that SHA256SUMS lists; None: none is, or there are no digests."""
    if not (place / SUMS).is_file():
        return None
    lines = (place / SUMS).read_text(errors="replace").splitlines()
    for line in lines or [""]:
        wanted, _, name = line.partition("  ")
        if not name:
            return f"{SUMS} is cut short"
        if not (place / name).is_file():
            return f"{name} is missing"
        if _sha256(place / name) != wanted:
            return f"{name} is not as it was written"
    return None


def _write_sums(place: Path, files: Sequence[Path]) -> None:
    _replace(place / SUMS, [f"{_sha256(file)}  {file.relative_to(place).as_posix()}" for file in files if file.name != SUMS])


def _replace(file: Path, lines: Sequence[str]) -> None:
    """The lines as a file that is whole or as it was before."""
    half = file.with_name(f"{file.name}.part")
    half.write_text("".join(f"{line}\n" for line in lines))
    half.replace(file)


def _sha256(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


@contextlib.contextmanager
def _fitting(place: Path) -> Iterator[None]:
    """Say that the disk is full in one line: orbax hands on tensorstore's ValueError, which has the system's reason in its text."""
    try:
        yield
    except (ValueError, OSError) as error:
        code = next((code for code in FULL if os.strerror(code) in str(error)), None)
        if code is None:
            raise
        _remove_unfinished(place)
        held = latest(place.parent)
        kept = "no checkpoint is whole" if held is None else f"checkpoint {held} is whole: with resume=true training goes on from it"
        raise OSError(code, f"{os.strerror(code)}; {kept}", str(place)) from None


def _remove_unfinished(place: Path) -> None:
    """Remove what was written of a checkpoint; orbax leaves writes of other arrays running that may still add files: try until they end."""
    for _ in range(ATTEMPTS):
        if not (halves := list(place.parent.glob(f"{place.name}.orbax-checkpoint-tmp*"))):
            return
        for half in halves:
            shutil.rmtree(half, ignore_errors=True)
        time.sleep(0.05)


def _steps(folder: Path) -> list[int]:
    """Iterations of the whole checkpoints, ascending; unfinished ones have other names."""
    return sorted(int(place.name) for place in folder.iterdir() if place.name.isdecimal()) if folder.is_dir() else []


def _find(folder: Path, iteration: int | None) -> int:
    held = _steps(folder)
    if not held:
        raise FileNotFoundError(f"{folder}: no checkpoint there")
    if iteration is not None and iteration not in held:
        raise FileNotFoundError(f"{folder}: no checkpoint of iteration {iteration}; there are {', '.join(map(str, held))}")
    return held[-1] if iteration is None else iteration


def _compare(held: dict[str, tuple], wanted: dict[str, tuple], where: str) -> None:
    """Refuse a checkpoint whose arrays differ, in shape or type, from the wanted ones."""
    differ = [name for name in sorted(held.keys() | wanted.keys()) if held.get(name) != wanted.get(name)]
    learnt = [name for name in differ if name.startswith(f"{LEARNT}/")]
    told = learnt or differ  # moments of differing parameters differ too: no news
    if not told:
        return
    lines = []
    for name in told[:4]:
        there, here = held.get(name), wanted.get(name)
        if there is None or here is None:
            lines.append(f"checkpoint has {'no' if there is None else 'an array'} {name}, config wants {'none' if here is None else 'one'}")
        else:
            which = int(there[0] == here[0])  # the shape, or if that is the same, the type
            lines.append(f"checkpoint has {name} {there[which]}, config wants {here[which]}")
    more = f"; and {len(told) - 4} more" if len(told) > 4 else ""
    out = "use the settings that the run was made with, or another folder"
    raise ConfigError(f"{where} does not fit this config: {'; '.join(lines)}{more}; {out}")


def _named(tree: Any) -> list[tuple[str, Any]]:
    """Leaves and their paths: 'parameters/params/actor/trunk/layer_0/kernel'."""
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _stored(train_state: Any) -> dict[str, Array]:
    """What goes to disk, by name."""
    return {name: _data(leaf) for name, leaf in _named(train_state) if leaf.size}


def _data(leaf: Any) -> Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _like(flat: dict[str, Any], like: Any) -> Any:
    """`like` with the values of `flat`."""

    def placed(value: Array, leaf: Array) -> Array:  # bound to a device only if `leaf` is: else a run that goes on compiles anew
        return value if leaf.committed else jnp.array(np.asarray(value))

    def put(name: str, leaf: Any) -> Any:
        if not leaf.size:
            return jnp.copy(leaf)  # its own, so that donating the one does not delete the other
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(placed(flat[name], leaf), impl=jax.random.key_impl(leaf))
        return placed(flat[name], leaf)

    return jax.tree.unflatten(jax.tree.structure(like), [put(name, leaf) for name, leaf in _named(like)])


def _parts(stored: dict[str, Any]) -> dict[str, dict]:
    """What was learnt, its mean, the rest: nested, without those that are empty."""
    parts: dict[str, dict] = {LEARNT: {}, AVERAGED: {}, REST: {}}
    for path, leaf in stored.items():
        first, _, below = path.partition("/")
        name = first if first in (LEARNT, AVERAGED) else REST
        parts[name][path if name == REST else below] = leaf
    return {name: _nest(part) for name, part in parts.items() if part}


def _nest(flat: dict[str, Any]) -> dict:
    nested: dict = {}
    for name, leaf in flat.items():
        *path, last = name.split("/")
        inner = nested
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = leaf
    return nested


def _flat(nested: Any, prefix: str = "") -> dict[str, Any]:
    return {f"{prefix}/{name}" if prefix else name: leaf for name, leaf in _named(nested)}


def _shapes(metadata: Any, prefix: str = "") -> dict[str, tuple]:
    flat = jax.tree_util.tree_leaves_with_path(metadata, is_leaf=_is_metadata)
    named = {jax.tree_util.keystr(path, simple=True, separator="/"): (tuple(m.shape), str(np.dtype(m.dtype))) for path, m in flat}
    return {f"{prefix}/{name}" if prefix else name: what for name, what in named.items()}


def _is_metadata(x: Any) -> bool:
    return hasattr(x, "shape") and hasattr(x, "dtype")
