"""Reads and writes results: JSON files, written atomically, with a digest of their settings."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import atomic_file

JUDGED = "judged.json"  # settings of an evaluation, beside its records
# Files that an evaluation writes
WRITTEN = (JUDGED, "agents-*.csv", "comparison-*.png", "failures.json", "failures-*", "learning.png", "outcomes.png", "safety.png")
WRITTEN += ("trajectories.png", "video.gif", "video.mp4", "report.md")


def digest(settings: Mapping[str, Any]) -> str:
    """Computes a digest of settings: 16 hexadecimal digits."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def write(path: Path, content: Mapping[str, Any], *, digits: int | None) -> None:
    """Writes a JSON file atomically.

    Args:
        digits: significant digits of numbers; None: all.
    """
    with atomic_file.write_atomically(path) as temporary:
        temporary.write_text(json.dumps(plain(content, digits=digits), separators=(",", ":")) + "\n")


def plain(value: Any, *, digits: int | None) -> Any:
    """Converts arrays, tuples and records to lists and dicts, and numbers that are not finite to None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits=digits) for key, item in value.items()}
    if hasattr(value, "_asdict"):
        return plain(value._asdict(), digits=digits)
    if isinstance(value, (list, tuple)):
        return [plain(item, digits=digits) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist(), digits=digits)
    if not isinstance(value, float):
        return value
    if not np.isfinite(value):
        return None
    return value if digits is None else float(f"{value:.{digits}g}")


def read(path: Path) -> Any:
    """Reads what `write` wrote; null in a list is NaN."""
    return _numbers(json.loads(path.read_text()))


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [float("nan") if item is None else _numbers(item) for item in value]
    return value


def begin(folder: Path, judged: Mapping[str, Any]) -> None:
    """Writes what is evaluated, and removes the files of an earlier evaluation in the folder."""
    for file in [file for pattern in WRITTEN for file in folder.glob(pattern)]:
        file.unlink()
    write(folder / JUDGED, judged, digits=None)


def read_evaluated(folder: Path) -> dict[str, Any]:
    """Reads what `begin` wrote; defaults without it."""
    return read(folder / JUDGED) if (folder / JUDGED).is_file() else {"scenes": None, "overrides": []}
