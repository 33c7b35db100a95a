"""Results on the disk: JSON, written whole or not at all, with a digest of the settings that made it."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import atomic_file

JUDGED = "judged.json"  # what an evaluation was asked for, beside its records
# All that an evaluation writes to its folder
WRITTEN = (JUDGED, "agents-*.csv", "comparison-*.png", "failures.json", "failures-*", "learning.png", "outcomes.png", "safety.png")
WRITTEN += ("trajectories.png", "video.gif", "video.mp4", "report.md")


def digest(settings: Mapping[str, Any]) -> str:
    """Tells whether a result was made with these settings; 16 hexadecimal digits."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def write(path: Path, content: Mapping[str, Any], *, digits: int | None) -> None:
    """One JSON file, complete or as it was before.

    Args:
        digits: significant ones that numbers keep; None keeps all.
    """
    with atomic_file.write_atomically(path) as half:
        half.write_text(json.dumps(plain(content, digits=digits), separators=(",", ":")) + "\n")


def plain(value: Any, *, digits: int | None) -> Any:
    """Arrays, tuples and records as lists and dicts; what is no number (NaN, infinity) as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(one, digits=digits) for key, one in value.items()}
    if hasattr(value, "_asdict"):
        return plain(value._asdict(), digits=digits)
    if isinstance(value, (list, tuple)):
        return [plain(one, digits=digits) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist(), digits=digits)
    if not isinstance(value, float):
        return value
    if not np.isfinite(value):
        return None
    return value if digits is None else float(f"{value:.{digits}g}")


def read(path: Path) -> Any:
    """What `write` wrote; null in a list is NaN again."""
    return _numbers(json.loads(path.read_text()))


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _numbers(one) for key, one in value.items()}
    if isinstance(value, list):
        return [float("nan") if one is None else _numbers(one) for one in value]
    return value


def begin(folder: Path, judged: Mapping[str, Any]) -> None:
    """Note what is judged, and remove what an evaluation before wrote to the folder: records of two would be read as those of one."""
    for file in [file for pattern in WRITTEN for file in folder.glob(pattern)]:
        file.unlink()
    write(folder / JUDGED, judged, digits=None)


def read_evaluated(folder: Path) -> dict[str, Any]:
    """What `begin` noted; nothing of an evaluation that did not yet."""
    return read(folder / JUDGED) if (folder / JUDGED).is_file() else {"scenes": None, "overrides": []}
