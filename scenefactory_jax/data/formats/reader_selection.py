"""From a path to scenes: which files there are, and which reader reads each."""

import os
import stat
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import FormatMismatch, OtherContent, RawScene, Reject, SceneError
from scenefactory_jax.data.formats import foreign, json_documents

REASON = 80  # characters of what one reader says of a file that is not its own
BANK_INDEX = "bank.json"  # the file that makes a folder a bank
Reader = Callable[[Path], Iterator[RawScene | Reject]]


def make(formats: Mapping[str, Any]) -> dict[str, Reader]:
    """Config entries -> readers, in the order in which they are tried.

    Raises:
        ConfigError: an entry that cannot be built, by name.
    """
    return {name: instantiate(entry, builtins=__name__, where=f"formats.{name}") for name, entry in formats.items() if entry is not None}


def find(path: Path | str) -> list[Path]:
    """The file itself, or every file below a folder in sorted order; hidden ones, and banks that lie among them, are left out.

    A folder that cannot be listed stands for what is in it: reading it says why.

    Raises:
        SceneError: no such path, a bank, or nothing in it.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise SceneError(f"{path}: no such file or folder; give a scene file or a folder of them")
    if (path / BANK_INDEX).is_file():
        raise SceneError(f"{path}: a bank already; give the files that it was made from")
    found: list[Path] = []
    for folder, folders, names in os.walk(path, onerror=lambda error: found.append(Path(error.filename))):
        folders[:] = [name for name in folders if not name.startswith(".")]
        if BANK_INDEX not in names:
            found.extend(file for name in names if not name.startswith(".") and _holds_content(file := Path(folder, name)))
    files = sorted(found)
    if not files:
        raise SceneError(f"{path}: an empty folder; give a scene file or a folder of them")
    return files


def _holds_content(path: Path) -> bool:
    """Whether this is a file, no pipe or device; one of which that cannot be found out is, and reading it says why."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def read(path: Path | str, formats: Mapping[str, Reader]) -> Iterator[RawScene | Reject]:
    """The scenes of one file, and its records that could not be read, by the first reader that knows its format.

    Raises:
        Companion: the file belongs to scenes beside it.
        SceneError: a folder that cannot be listed; a format that no reader knows, named if it can be told; or what the reader that knows
            the format found wrong.
    """
    if Path(path).is_dir():
        raise SceneError(f"{path}: a folder that cannot be listed; allow it to be read, or give the files beside it")
    with json_documents.unpacked_once():
        first, scenes = _begin(Path(path), formats)
    yield first
    yield from scenes


def _begin(path: Path, formats: Mapping[str, Reader]) -> tuple[RawScene | Reject, Iterator[RawScene | Reject]]:
    """What the first reader that knows the format yields first, and the rest of it. See `read`."""
    near: list[str] = []
    for name, reader in formats.items():
        scenes = iter(reader(path))
        try:
            first = next(scenes, None)
        except OtherContent as refusal:
            near.append(textwrap.shorten(f"{name}: {str(refusal).removeprefix(f'{path}: ')}", REASON))
            continue
        except FormatMismatch:
            continue
        if first is None:
            raise SceneError(f"{path}: no scene in it, says the reader {name!r}")
        return first, scenes
    raise SceneError(f"{path}: {_refusal(path, near)}; formats: {', '.join(formats) or 'none'}")


def _refusal(path: Path, near: Sequence[str]) -> str:
    """Why no reader reads a file: what it is, or else what those say that read other files of its kind, or else how it begins."""
    with path.open("rb") as file:
        head = file.read(foreign.HEAD)
    if not head:
        return "an empty file"
    if name := foreign.find_name(head):
        return f"this is {name}: it is not read"
    return f"no reader knows this format: {'; '.join(near) or f'it begins with {head[:16]!r}'}"
