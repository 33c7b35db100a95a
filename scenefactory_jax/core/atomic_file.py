"""Files that are complete or as they were before, wherever a process is killed."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A hidden path beside `path` to write to.

    In the end its file is flushed to the disk and replaces `path`; after an error it is removed.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with name_file(path):
            yield part
            with part.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def name_file(path: Path) -> Iterator[None]:
    """Names the file in an OSError that names none, as those of a full disk."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
