"""Lines of points: even steps along them, and points where there are too few."""

import numpy as np
from jaxtyping import Float

MOST = 10_000  # points that `densify` adds to a line: more, 20 km at 2 m, are the work of a damaged coordinate


def resample(line: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "K 3"]:
    """`count` points in even steps along a line; a line of one point is that point everywhere."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(places, arc, line[:, axis]) for axis in range(3)], axis=1)


def densify(line: Float[np.ndarray, "N 3"], spacing_m: float) -> Float[np.ndarray, "M 3"]:
    """The line with its own points and, on segments longer than `spacing_m`, more in even steps.

    Where a source has only the corners of its lines, packing would take long segments for gaps. A line that would need more than `MOST`
    points stays as it is.
    """
    with np.errstate(over="ignore"):
        wanted = np.maximum(np.ceil(np.linalg.norm(np.diff(line, axis=0), axis=1) / spacing_m), 1)
    if not 0 < wanted.sum() - len(wanted) <= MOST:
        return line
    parts = wanted.astype(int)
    start = np.repeat(np.arange(len(parts)), parts)
    share = np.concatenate([np.arange(count) / count for count in parts])[:, None]
    return np.concatenate([line[start] + share * (line[start + 1] - line[start]), line[-1:]])
