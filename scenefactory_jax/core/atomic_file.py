"""Files that are whole or as they were, wherever a process is killed."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """A place beside `path` to write to; what lies there in the end takes the place of the file."""
    half = path.with_name(f"{path.name}.part")
    yield half
    half.replace(path)
