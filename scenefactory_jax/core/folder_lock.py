"""Folders that one command at a time writes: a run that is trained, a bank that grows or is replaced."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from scenefactory_jax.core.instantiate import ConfigError

try:
    import fcntl
except ImportError:  # not on Windows: two commands in one folder are the user's own care there
    fcntl = None

LOCK = ".lock"


class Busy(ConfigError):
    """Another command writes in the folder."""


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder, made if it is not there, against other commands. The system takes the lock back however the process ends.

    At the end the lock is removed, and what had to be made of the folder and its parents and is still empty.

    Raises:
        Busy: another command holds it.
        ConfigError: the folder cannot be written.
    """
    new = find_missing_parents(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = None if fcntl is None else _locked(folder / LOCK)
    except BlockingIOError:
        raise Busy(f"{folder}: another command writes there now; wait for its end, or choose another folder") from None
    except OSError as error:
        remove_empty(new)
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}; choose another folder") from error
    try:
        yield
    finally:
        if file is not None:
            _release(file, folder / LOCK)
        remove_empty(new)


def find_missing_parents(folder: Path) -> list[Path]:
    """The folder and those of its parents that do not exist, the innermost first."""
    return [place for place in (folder, *folder.parents) if not place.exists()]


def remove_empty(places: Sequence[Path]) -> None:
    """Remove folders, the innermost first, up to one that is gone or holds something."""
    with contextlib.suppress(OSError):
        for place in places:
            place.rmdir()


def _locked(path: Path) -> int:
    """The open descriptor of a lock that no other process holds.

    Raises:
        BlockingIOError: a process holds it.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # pyright: ignore[reportOptionalMemberAccess]
        except BlockingIOError:
            os.close(file)
            raise
        except OSError:  # a file system without locks
            return file
        if _lies_at(file, path):
            return file
        os.close(file)  # removed by the one that held it, between opening and locking


def _release(file: int, path: Path) -> None:
    """Remove a lock, if it is still in the folder that it was made in, and let go of it."""
    if _lies_at(file, path):
        path.unlink()
    os.close(file)


def _lies_at(file: int, path: Path) -> bool:
    """Whether an open file is the one at a path: its folder may have been replaced."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except FileNotFoundError:
        return False
