"""Which lanes lie in intersections: those that cross others, as sources of scenes do not say it."""

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

MIN_SINE = 0.3  # of the angle at which lanes cross, 17 degrees: lanes that branch or merge run beside each other
REACH_M = 30.0  # of an intersection around a crossing; lanes that a driveway crosses may be much longer


def find_intersection_segments(
    start: Float[np.ndarray, "P 2"], end: Float[np.ndarray, "P 2"], lane: Int[np.ndarray, " P"], valid: Bool[np.ndarray, " P"]
) -> Bool[np.ndarray, " P"]:
    """Finds the segments in intersections: those of a lane that crosses another one, within REACH_M of a crossing.

    Args:
        start, end: of the segments of centre lines.
        lane: number of each segment's lane.
        valid: segments of lanes that count.
    """
    rows = np.flatnonzero(valid)
    lines = np.asarray(shapely.linestrings(np.stack([start[rows], end[rows]], axis=1)))
    first, second = rows[shapely.STRtree(list(lines)).query(lines, predicate="intersects")]
    along = end - start
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    sine = along[first, 0] * along[second, 1] - along[first, 1] * along[second, 0]
    crosses = (lane[first] != lane[second]) & (np.abs(sine) > MIN_SINE * length[first] * length[second])
    crossing = np.unique(first[crosses])
    if not len(crossing):
        return np.zeros_like(valid)
    near = KDTree(start[crossing]).query(start, distance_upper_bound=REACH_M)[0] < REACH_M
    return valid & near & np.isin(lane, lane[crossing])
