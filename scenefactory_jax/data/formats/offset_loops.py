"""Loops of a line that lies beside another one: where that one turns within the distance between them, the line beside it runs back.

Such a line goes beyond the point at which it crosses itself, back, and on to that point again: on a road whose inner lanes are farther from
the reference line than its curve's radius, a car could not follow it.
"""

import numpy as np
import shapely
from jaxtyping import Bool, Float


def remove_loops(xyz: Float[np.ndarray, "N 3"], back: Bool[np.ndarray, " N-1"]) -> Float[np.ndarray, "_ 3"]:
    """Leaves out the loops of a line; of a part that runs back and crosses nothing, its points.

    Args:
        xyz: points, m.
        back: steps from a point to the next that are against the direction of the line beside which this one lies.

    Returns:
        The first and the last point and those in no loop; in place of a loop the point at which the line crosses itself, with the height
        that the line has there before the loop.
    """
    while back.any():
        start = int(np.argmax(back))
        stop = start + int(np.argmin(np.append(back[start:], False)))  # rows `start` to `stop` run back
        first, crossing, last = _find_crossing(xyz, start, stop)
        xyz = np.concatenate([xyz[: first + 1], crossing, xyz[last:]])
        back = np.concatenate([np.zeros(first + len(crossing) + 1, bool), back[last:]])
    return xyz


def _find_crossing(xyz: Float[np.ndarray, "N 3"], start: int, stop: int) -> tuple[int, Float[np.ndarray, "C 3"], int]:
    """Finds where the parts before row `start` and after row `stop` cross: the row before the crossing, the crossing, the row after it."""
    before, after = (shapely.linestrings(np.stack([part[:-1], part[1:]], axis=1)) for part in (xyz[: start + 1, :2], xyz[stop:, :2]))
    hits = shapely.STRtree(after).query(before, predicate="intersects") if len(before) and len(after) else np.zeros((2, 0), int)
    if not hits.size:  # it crosses nothing where the line begins or ends within the turn
        return max(start - 1, 0), xyz[:0], min(stop + 1, len(xyz) - 1)
    one, other = hits[:, np.argmax(hits[0])]  # the smallest loop
    place = shapely.intersection(before[one], after[other])
    share = shapely.line_locate_point(before[one], shapely.centroid(place), normalized=True)
    return int(one), (xyz[one] + share * (xyz[one + 1] - xyz[one]))[None], stop + int(other) + 1
