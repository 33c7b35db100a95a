"""Parts of a line that run back, which no car could follow, and how they are left out.

A lane beside a reference line runs back where that one turns within the distance between them (OpenDRIVE): it goes beyond the point at
which it crosses itself, back, and on to that point again. Borders that were joined from several pieces run back where these overlap, in
published maps for up to 12 m.
"""

import itertools

import numpy as np
import shapely
from jaxtyping import Bool, Float

REVERSAL = np.cos(2.0)  # of the angle between two steps: 115 degrees
SAME_WAY = np.cos(np.pi / 3)


def remove_loops(xyz: Float[np.ndarray, "N 3"], back: Bool[np.ndarray, " N-1"]) -> Float[np.ndarray, "_ 3"]:
    """Leaves out the parts of a line that run back, and what it goes over twice.

    Args:
        xyz: points, m.
        back: steps from a point to the next that run back.

    Returns:
        The first and the last point, and those between that lie ahead of those before. Where the line crosses itself, before and behind a
        part that runs back, a point with the height that it has there before that part stands for the loop.
    """
    while back.any():
        start = int(np.argmax(back))
        stop = start + int(np.argmin(np.append(back[start:], False)))  # the line runs back from row `start` to row `stop`
        first, crossing, last = _find_crossing(xyz, start, stop)
        xyz = np.concatenate([xyz[: first + 1], crossing, xyz[last:]])
        back = np.concatenate([np.zeros(first + len(crossing) + 1, bool), back[last:]])
    return xyz


def find_reversals(xyz: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N-1"]:
    """Finds the steps of a line that run back: those between two reversals, behind which it goes on in about the direction of before."""
    step = np.diff(xyz[:, :2], axis=0)
    length = np.linalg.norm(step, axis=1)
    moving = np.flatnonzero(length > 0)
    way, back = step[moving] / length[moving, None], np.zeros(len(moving), bool)
    turns = np.flatnonzero((way[:-1] * way[1:]).sum(axis=1) < REVERSAL) + 1  # steps that begin with a reversal
    for begin, end in itertools.pairwise(turns):
        before = way[begin - 1]
        if not back[begin - 1] and (way[begin:end] @ before < 0.0).all() and way[end] @ before > SAME_WAY:
            back[begin:end] = True
    result = np.zeros(len(step), bool)
    result[moving] = back
    return result


def _find_crossing(xyz: Float[np.ndarray, "N 3"], start: int, stop: int) -> tuple[int, Float[np.ndarray, "C 3"], int]:
    """Finds where the parts before row `start` and behind row `stop` cross: the row before, the crossing, the row behind."""
    before, after = (_list_segments(part) for part in (xyz[: start + 1], xyz[stop:]))
    hits = shapely.STRtree(after).query(before, predicate="intersects") if before and after else np.zeros((2, 0), int)
    if not hits.size:  # as two borders beside each other, or where the line begins or ends within the turn
        ahead = (xyz[stop + 1 :, :2] - xyz[start, :2]) @ (xyz[start, :2] - xyz[stop, :2]) > 0.0
        return start, xyz[:0], stop + 1 + int(np.argmax(ahead)) if ahead.any() else len(xyz) - 1
    one, other = hits[:, np.argmax(hits[0])]  # the smallest loop
    place = shapely.centroid(shapely.intersection(before[one], after[other]))
    share = shapely.line_locate_point(before[one], place, normalized=True)
    return int(one), (xyz[one] + share * (xyz[one + 1] - xyz[one]))[None], stop + int(other) + 1


def _list_segments(line: Float[np.ndarray, "N 3"]) -> list[shapely.LineString]:
    return [shapely.LineString(pair) for pair in zip(line[:-1, :2], line[1:, :2], strict=True)]
