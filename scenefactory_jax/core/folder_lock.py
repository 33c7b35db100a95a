"""Locks folders that one command at a time may write: the run of a training, a bank that grows or is replaced."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from scenefactory_jax.core.instantiate import ConfigError

try:
    import fcntl
except ImportError:  # Windows: folders are not locked
    fcntl = None

LOCK = ".lock"


class Busy(ConfigError):
    """Another command writes in the folder."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Makes a folder and locks it against other commands; the system releases the lock when the process ends, in whatever way.

    At the end the lock file is removed, and those of the new folders that are empty.

    Raises:
        Busy: another command has the lock.
        ConfigError: the folder cannot be written.
    """
    new = find_missing_parents(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = None if fcntl is None else _open_locked(folder / LOCK)
    except BlockingIOError:
        raise Busy(f"{folder}: another command writes there now; wait for its end, or choose another folder") from None
    except OSError as error:
        remove_empty(new)
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}; choose another folder") from error
    try:
        yield
    finally:
        if file is not None:
            if _is_at(file, folder / LOCK):
                (folder / LOCK).unlink()
            os.close(file)
        remove_empty(new)


def find_missing_parents(folder: Path) -> list[Path]:
    """Lists the folder and those of its parents that do not exist, the innermost first."""
    return [place for place in (folder, *folder.parents) if not place.exists()]


def remove_empty(places: Sequence[Path]) -> None:
    """Removes folders, the innermost first, up to one that is missing or not empty."""
    with contextlib.suppress(OSError):
        for place in places:
            place.rmdir()


def _open_locked(path: Path) -> int:
    """Opens and locks a file; raises BlockingIOError if another process has the lock."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # pyright: ignore[reportOptionalMemberAccess]
        except BlockingIOError:
            os.close(file)
            raise
        except OSError:  # a file system without locks
            return file
        if _is_at(file, path):
            return file
        os.close(file)  # the process before removed it between opening and locking


def _is_at(file: int, path: Path) -> bool:
    """Whether an open file is the one at a path: its folder may have been replaced."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False
