"""Who is no longer where its track ends: the tracks of cars that wait or turn end in recordings, which parked cars' tracks do as well."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from scenefactory_jax.core.scene_arrays import Logs

SAME_LEVEL_M = 3.0  # between the heights of vehicles' centres


def find_leaving(logs: Logs, rows: Sequence[int], vehicles: Bool[np.ndarray, " T"]) -> Bool[np.ndarray, " O"]:
    """Whether the centre of one of the vehicles is in the last logged box of each of these tracks later, and is not there all the time, as
    that of the same car with another number; false for people."""
    leaves = np.zeros(len(rows), bool)
    valid = logs.valid[vehicles]
    for place, row in enumerate(rows):
        last = np.flatnonzero(logs.valid[row])[-1]
        if not vehicles[row] or not valid[:, last + 1 :].any():
            continue
        apart = logs.xyz[vehicles] - logs.xyz[row, last]
        cos, sin = np.cos(logs.yaw[row, last]), np.sin(logs.yaw[row, last])
        along, across = apart[..., 0] * cos + apart[..., 1] * sin, apart[..., 1] * cos - apart[..., 0] * sin
        within = (abs(along) <= logs.size[row, 0] / 2) & (abs(across) <= logs.size[row, 1] / 2) & (abs(apart[..., 2]) <= SAME_LEVEL_M)
        leaves[place] = ((valid & within)[:, last + 1 :].any(axis=1) & (valid & ~within).any(axis=1)).any()
    return leaves
