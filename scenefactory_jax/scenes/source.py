"""From a path to scenes: which files there are, and which reader reads each."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from scenefactory_jax.build import build
from scenefactory_jax.scenes.formats import documents
from scenefactory_jax.scenes.raw import OtherFormat, RawScene, Reject, SceneError

BANK_INDEX = "bank.json"  # the file that makes a folder a bank
Reader = Callable[[Path], Iterator[RawScene | Reject]]


def make(formats: Mapping[str, Any]) -> dict[str, Reader]:
    """Config entries -> readers, in the order in which they are tried.

    Raises:
        ConfigError: an entry that cannot be built, by name.
    """
    return {name: build(entry, builtins=__name__, where=f"formats.{name}") for name, entry in formats.items() if entry is not None}


def find(path: Path | str) -> list[Path]:
    """The file itself, or every file below a folder in sorted order; hidden ones, and banks that lie among them, are left out.

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
    hidden = lambda file: any(part.startswith(".") for part in file.relative_to(path).parts)  # noqa: E731
    found = (file for file in path.rglob("*") if file.is_file() and not hidden(file))
    files = sorted(file for file in found if not (file.parent / BANK_INDEX).is_file())
    if not files:
        raise SceneError(f"{path}: an empty folder; give a scene file or a folder of them")
    return files


def read(path: Path | str, formats: Mapping[str, Reader]) -> Iterator[RawScene | Reject]:
    """The scenes of one file, and its records that could not be read, by the first reader that knows its format.

    Raises:
        Companion: the file belongs to scenes beside it.
        SceneError: no reader knows the format, each with its reason; or what the reader that knows it found wrong.
    """
    with documents.unpacked_once():
        first, scenes = _begin(Path(path), formats)
    yield first
    yield from scenes


def _begin(path: Path, formats: Mapping[str, Reader]) -> tuple[RawScene | Reject, Iterator[RawScene | Reject]]:
    """What the first reader that knows the format yields first, and the rest of it. See `read`."""
    refusals = []
    for name, reader in formats.items():
        scenes = iter(reader(path))
        try:
            first = next(scenes, None)
        except OtherFormat as refusal:
            reason = str(refusal).removeprefix(f"{path}: ")
            refusals.append(f"{name}: {reason}")
            continue
        if first is None:
            raise SceneError(f"{path}: no scene in it, says the reader {name!r}")
        return first, scenes
    raise SceneError(f"{path}: no reader knows this format ({'; '.join(refusals) or 'there are no readers'})")
