"""Arrays of a replay as few bytes: quantised to 16 bits, differences along the last axis, low and high bytes apart, deflated together.

`replay/data.js` is the inverse. A motion sampled 30 times a second changes little from step to step, and not at all while a car stands, so
the differences are small numbers that deflate to a fraction.
"""

import base64
import zlib
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt16

MISSING = 65535  # the code of what is not finite
_MOST = MISSING - 1


class Packer:
    """Arrays of one world, one after another; the directory says where each lies and how its codes read."""

    def __init__(self) -> None:
        self.directory: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: Shaped[np.ndarray, "rows columns"], *, resolution: float) -> None:
        """Keep an array to within half of `resolution`, or of a 65,534th of its range if that is coarser. What is not finite is missing."""
        values = np.asarray(values, np.float64)
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        entry: dict[str, Any] = {"shape": list(values.shape), "low": low}
        if high > low or not known.all():
            entry |= {"step": max(resolution, (high - low) / _MOST), "at": self._size}
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
        """Everything, deflated (zlib's format) and in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode()
