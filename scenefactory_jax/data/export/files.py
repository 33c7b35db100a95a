"""Files of an export: complete or as they were before."""

from pathlib import Path

from scenefactory_jax.core.atomic_file import write_atomically
from scenefactory_jax.core.raw_scene import SceneError


def write(path: Path | str, content: bytes) -> None:
    """Writes or replaces a file.

    Raises:
        SceneError: the folder is missing or cannot be written.
    """
    try:
        with write_atomically(Path(path)) as part:
            part.write_bytes(content)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written: {error.strerror}") from error


def make_folder(path: Path) -> None:
    """Makes a folder and its parents where they do not exist.

    Raises:
        SceneError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{path}: cannot be made: {error.strerror}") from error
