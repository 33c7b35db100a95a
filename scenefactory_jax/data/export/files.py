"""Files that are whole or not there."""

import os
import tempfile
from pathlib import Path

from scenefactory_jax.core.raw_scene import SceneError


def write(path: Path | str, content: bytes) -> None:
    """Write beside the place and rename, so that nobody ever meets half a file; one that is there is replaced.

    Raises:
        SceneError: the folder is missing or cannot be written.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error


def make_folder(path: Path) -> None:
    """A folder and those above it, where they are not there yet.

    Raises:
        SceneError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{path}: cannot be made: {error.strerror}") from error


def _umask() -> int:
    """The mask that ordinary files of this process get; reading it means to set it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
