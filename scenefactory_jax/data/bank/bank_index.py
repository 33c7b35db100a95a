"""`bank.json`: the files of a bank and how it was made. It is replaced as a whole; its last line is the SHA-256 of the text before."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.config import find_differences
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats.reader_selection import BANK_INDEX as INDEX

FORMAT = "scenefactory_jax bank"
SCHEMA = 5  # 4: checksums of `bank.json` and of each scene; 5: cycles of lights, lanes of stop signs (`arrow_codec`)
READABLE = (3, 4, 5)
CHECKED = (4, 5)  # with a checksum
REMEDY = "copy or convert the bank again"
DIGEST = "sha256"  # key of the checksum


@dataclass(frozen=True)
class Shard:
    """One file of a bank, with its size and checksum when it was written."""

    file: str  # relative to the bank's folder; those of a view lie in other folders
    scenes: int
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Index:
    """Content of `bank.json`."""

    settings: dict[str, Any]  # with which the scenes were read, checked and selected
    shards: tuple[Shard, ...] = ()  # of scenes
    metadata: tuple[Shard, ...] = ()  # of the catalogue: a row a scene, with its place
    files: tuple[str, ...] = ()  # converted source files, relative to the source
    rejects: tuple[dict[str, Any], ...] = ()  # source, scene (null: the file itself) and reason
    companions: tuple[dict[str, Any], ...] = ()  # source and reason of files that belong to scenes beside them
    account: dict[str, Any] = field(default_factory=dict)  # counts of the trial packing
    complete: bool = False  # false: the conversion was stopped


def is_bank(path: Path | str) -> bool:
    """Whether a folder has the index of a bank, of any schema; true if the index is damaged."""
    try:
        return _format(_entries(Path(path))) == FORMAT
    except SceneError:
        return True


def check_replaceable(path: Path) -> None:
    """Raises a SceneError unless a folder is a bank whose index is sound."""
    if _format(_entries(path)) != FORMAT:
        raise SceneError(f"{path}: exists and is no bank; give another path, or remove it")


def read(path: Path) -> Index:
    """The index of a bank.

    Raises:
        SceneError: no bank, a bank of another schema, or an index that is damaged.
    """
    found = _entries(path)
    if found is None or _format(found) != FORMAT:
        what = "no such folder" if not path.exists() else f"no bank: it has no {INDEX} of this format"
        raise SceneError(f"{path}: {what}; make one with `convert source=FILES out={path}`")
    if found.get("schema") not in READABLE:
        what = "a bank of packed scenes, schema 2" if found.get("schema") == 2 else f"a bank of schema {found.get('schema')!r}"
        ours = f"this version reads {', '.join(map(str, READABLE))}, whole scenes"
        raise SceneError(f"{path}: {what}; {ours}: convert its source again, to another folder")
    try:
        shards = {name: tuple(map(_shard, found[name])) for name in ("shards", "metadata")}
        lists = {name: tuple(found[name]) for name in ("files", "rejects", "companions")}
        return Index(found["settings"], account=found["account"], complete=found["complete"], **shards, **lists)
    except (KeyError, TypeError) as error:
        wanted = ", ".join(entry.name for entry in fields(Index))
        raise SceneError(f"{path / INDEX}: damaged: {error}; it must hold {wanted}") from error


def _entries(path: Path) -> dict[str, Any] | None:
    """Entries of a folder's index, of any format; None without an index; SceneError: it cannot be read, or is damaged."""
    file = path / INDEX
    try:
        content = file.read_bytes()
        found = json.loads(content)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file}: damaged: no JSON: {error}; {REMEDY}") from error
    if not isinstance(found, dict):
        return {}
    recorded = found.get(DIGEST)
    if recorded is None:
        if found.get("schema") in CHECKED:
            raise SceneError(f"{file}: damaged: no checksum; {REMEDY}")
        return found  # of a schema without one
    body = content.rpartition(f'"{DIGEST}"'.encode())[0]
    if hashlib.sha256(body).hexdigest() != recorded:
        raise SceneError(f"{file}: damaged: its checksum is another; {REMEDY}")
    return found


def _format(entries: Mapping[str, Any] | None) -> Any:
    return None if entries is None else entries.get("format")


def _shard(entry: Any) -> Shard:
    if not isinstance(entry, dict) or {name: type(value) for name, value in entry.items()} != Shard.__annotations__:
        raise TypeError(f"{repr(entry)[:80]} in place of {', '.join(Shard.__annotations__)}")
    return Shard(**entry)


def write(folder: Path, index: Index) -> None:
    """Replaces the index atomically."""
    entries = {"format": FORMAT, "schema": SCHEMA} | {entry.name: getattr(index, entry.name) for entry in fields(Index)}
    entries |= {name: [asdict(shard) for shard in entries[name]] for name in ("shards", "metadata")}
    lines = [f'"{name}": {json.dumps(value, default=_plain)}' for name, value in entries.items()]  # a line each: json's indent is slow
    body = "{\n" + ",\n".join(lines) + ",\n"
    with write_atomically(folder / INDEX) as part:
        part.write_text(f'{body}"{DIGEST}": "{hashlib.sha256(body.encode()).hexdigest()}"\n}}\n')


def describe(folder: Path, file: str, scenes: int) -> Shard:
    """The entry of a finished file: size and checksum."""
    return Shard(file, scenes, (folder / file).stat().st_size, digest(folder / file))


def digest(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_complete(path: Path, shard: Shard) -> None:
    """Raises a SceneError if a file is missing or has another size than when it was written."""
    size = path.stat().st_size if path.is_file() else None
    if size is None:
        raise SceneError(f"{path}: missing; a bank needs all of its files, a view also the banks that it refers to: copy them together")
    if size != shard.bytes:
        raise SceneError(f"{path}: {size} bytes, cut short or changed: there were {shard.bytes}; {REMEDY}")


def differences(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Keys in which two settings differ, with both values."""
    return [f"{name}: {theirs!r} there, {ours!r} here" for name, (theirs, ours) in find_differences(there, here).items()]


def plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with JSON values only, to be compared with those of a bank."""
    return json.loads(json.dumps(settings, default=_plain))


def _plain(value: Any) -> Any:
    """A JSON value for one that JSON lacks."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)
