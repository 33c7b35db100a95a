"""Writes the files of an export, each of them complete or as it was before."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.raw_scene import RawScene, SceneError


def write(path: Path | str, content: bytes) -> None:
    """Writes or replaces a file; raises `SceneError` if the folder is missing or cannot be written."""
    try:
        with write_atomically(Path(path)) as part:
            part.write_bytes(content)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error


def write_scenes(
    scenes: Iterable[RawScene], folder: Path | str, refused: list[str], encode: Callable[[RawScene], tuple[str, bytes, Any]]
) -> dict[str, Any]:
    """Writes a file for each scene, one at a time; returns file name -> summary of each scene that was written.

    Args:
        scenes: to write.
        folder: is made if it does not exist.
        refused: gets a line for each scene that is left out: `encode` refuses it, or another scene has its file name.
        encode: scene -> file name, content and a summary.

    Raises:
        SceneError: a file or the folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{folder}: cannot be made: {error.strerror}") from error
    summaries: dict[str, Any] = {}
    for raw in scenes:
        try:
            name, content, summary = encode(raw)
            if name in summaries:
                raise SceneError(f"{raw.source}: {folder / name} is written already; two scenes need two names")
        except SceneError as error:
            refused.append(f"{raw.name}: {error}")
            continue
        write(folder / name, content)
        summaries[name] = summary
    return summaries
