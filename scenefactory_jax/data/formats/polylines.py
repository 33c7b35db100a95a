"""Lines of points: resampling in even steps, and further points on long segments."""

import numpy as np
from jaxtyping import Float

MAX_ADDED_POINTS = 10_000  # of a line (20 km at 2 m); more come from a damaged coordinate


def resample(line: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "K 3"]:
    """`count` points in even steps along a line; a line of one point is repeated."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, arc[-1], count)
    return np.stack([np.interp(places, arc, line[:, axis]) for axis in range(3)], axis=1)


def densify(line: Float[np.ndarray, "N D"], spacing_m: float) -> Float[np.ndarray, "M D"]:
    """The line with further points, in even steps, on segments longer than `spacing_m`.

    Packing takes the long segments of a source with corners alone for gaps. A line that needs more than `MAX_ADDED_POINTS` is unchanged.
    """
    with np.errstate(over="ignore"):
        pieces = np.maximum(np.ceil(np.linalg.norm(np.diff(line, axis=0), axis=1) / spacing_m), 1)
    if not 0 < pieces.sum() - len(pieces) <= MAX_ADDED_POINTS:
        return line
    counts = pieces.astype(int)
    start = np.repeat(np.arange(len(counts)), counts)
    fraction = ((np.arange(len(start)) - (np.cumsum(counts) - counts)[start]) / counts[start])[:, None]
    return np.concatenate([line[start] + fraction * (line[start + 1] - line[start]), line[-1:]])
