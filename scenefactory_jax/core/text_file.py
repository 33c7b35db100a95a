"""Text files that are compressed where their name says so."""

import io
import lzma
from pathlib import Path
from typing import Literal


def open_text(path: Path, mode: Literal["r", "w"]) -> io.TextIOWrapper:
    """A UTF-8 file with line ends as they are written; `.xz` is compressed, the same content always to the same bytes."""
    if path.suffix == ".xz":
        return io.TextIOWrapper(lzma.LZMAFile(path, mode), newline="", encoding="utf-8")
    return path.open(mode, newline="", encoding="utf-8")
