"""Packs arrays: quantised to 16 bits, differences along the last axis, low and high bytes apart, deflated together.

`page/data.js` is the inverse. Motion at 30 Hz changes little from step to step, so the differences are small and deflate well.
"""

import base64
import zlib
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt16

MISSING = 65535  # code of values that are not finite
MAX_CODE = MISSING - 1


class Packer:
    """Packs the arrays of one world; `directory` holds place, shape and scale of each."""

    def __init__(self) -> None:
        self.directory: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: Shaped[np.ndarray, "rows columns"], *, resolution: float) -> None:
        """Adds an array, to half of `resolution`, or of a 65,534th of its range if that is coarser. Non-finite values are missing."""
        values = np.asarray(values, np.float64)
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        entry: dict[str, Any] = {"shape": list(values.shape), "low": low}
        if high > low or not known.all():
            entry |= {"step": max(resolution, (high - low) / MAX_CODE), "at": self._size}
            codes = np.where(known, np.round((np.where(known, values, low) - low) / entry["step"]), MISSING)
            self._append(codes.astype(np.uint16))
        self.directory[name] = entry  # without a step all of it is `low`

    def _append(self, codes: UInt16[np.ndarray, "rows columns"]) -> None:
        change = np.diff(codes, axis=1, prepend=np.uint16(0)).view(np.int16).astype(np.int32)
        folded = (change << 1 ^ change >> 15) & 0xFFFF  # 0, -1, 1, -2, 2: small either way
        part = (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
        self._parts.append(part)
        self._size += len(part)

    def text(self) -> str:
        """All arrays, deflated (zlib's format) and in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode()
