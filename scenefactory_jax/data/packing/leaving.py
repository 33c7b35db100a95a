"""Who is no longer where its track ends: the tracks of cars that wait or turn end in recordings, which parked cars' tracks do as well."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from scenefactory_jax.core.scene_arrays import Logs
from scenefactory_jax.data.packing.drawn_starts import measure_to_box

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
        within = measure_to_box(apart[..., :2], logs.yaw[row, last], logs.size[row, :2]) == 0
        within &= np.abs(apart[..., 2]) <= SAME_LEVEL_M
        leaves[place] = ((valid & within)[:, last + 1 :].any(axis=1) & (valid & ~within).any(axis=1)).any()
    return leaves
