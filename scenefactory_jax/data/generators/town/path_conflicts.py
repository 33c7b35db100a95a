"""Finds where the paths of road users meet: for every pair, which places of one lie on the other."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path

STRIDE = 2  # points of a path per row of the projections
ROW_M = STRIDE * STEP_M
SIDE_M = 0.35  # minimum gap between two road users that pass each other
ALONG_COS = 0.7  # minimum cosine between two paths that run together
LEAD_M = 1.0  # into a zone, where the lanes are those that meet


class Zones(NamedTuple):
    """Stretches of the path `first` that lie on the path `second`; every zone occurs twice, once for each."""

    first: Int[np.ndarray, " Z"]
    second: Int[np.ndarray, " Z"]
    start: Float[np.ndarray, " Z"]  # on the first path, m
    end: Float[np.ndarray, " Z"]
    second_start: Float[np.ndarray, " Z"]  # on the second path, m
    second_end: Float[np.ndarray, " Z"]
    along: Bool[np.ndarray, " Z"]  # the paths run together rather than cross
    rank: Float[np.ndarray, " Z"]  # right of way of the first less that of the second


def project_paths(paths: list[Path], width: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N N S"]:
    """Projects all paths onto each other, where road users of the given widths would touch.

    Returns:
        [i, j, row]: place on path j of a row of path i; NaN where path j is not near.
    """
    count = len(paths)
    thinned = [path.points[::STRIDE] for path in paths]
    path_of = np.repeat(np.arange(count), [len(points) for points in thinned])
    row = np.concatenate([np.arange(len(points)) for points in thinned])
    points = np.concatenate(thinned)
    pairs = KDTree(points).query_pairs(float(width.max()) + SIDE_M, output_type="ndarray")
    pairs = pairs[path_of[pairs[:, 0]] != path_of[pairs[:, 1]]]
    limit = (width[path_of[pairs[:, 0]]] + width[path_of[pairs[:, 1]]]) / 2 + SIDE_M
    pairs = pairs[((points[pairs[:, 0]] - points[pairs[:, 1]]) ** 2).sum(axis=1) < limit**2]
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    shape = (count, count, int(row.max()) + 1)
    key = np.ravel_multi_index((path_of[one], path_of[other], row[one]), shape)
    hits = np.bincount(key, minlength=np.prod(shape))
    with np.errstate(invalid="ignore"):  # the projection is the mean of the near points, which lie around it
        return (ROW_M * np.bincount(key, weights=row[other], minlength=len(hits)) / hits).reshape(shape)


def find_zones(paths: list[Path], place: Float[np.ndarray, "N N S"]) -> Zones:
    """Finds the zones: runs of rows that have a projection."""
    padded = np.pad(np.isfinite(place), ((0, 0), (0, 0), (1, 1)))
    first, second, begin = np.nonzero(padded[:, :, 1:-1] & ~padded[:, :, :-2])
    end = np.nonzero(padded[:, :, 1:-1] & ~padded[:, :, 2:])[2]
    a, b = place[first, second, begin], place[first, second, end]
    rank, yaw = stack_columns([path.rank for path in paths]), stack_columns([path.yaw for path in paths])
    at = lambda table, path, metres: table[path, np.clip((metres / STEP_M).astype(int), 0, table.shape[1] - 1)]  # noqa: E731
    middle = (begin + end) // 2
    turn = at(yaw, first, middle * ROW_M) - at(yaw, second, place[first, second, middle])
    difference = at(rank, first, begin * ROW_M + LEAD_M) - at(rank, second, np.minimum(a, b) + LEAD_M)
    return Zones(first, second, begin * ROW_M, end * ROW_M, np.minimum(a, b), np.maximum(a, b), np.cos(turn) > ALONG_COS, difference)


def stack_columns(columns: Sequence[Float[np.ndarray, " _"]]) -> Float[np.ndarray, "N P"]:
    """Stacks arrays of different lengths as a table, with the last value repeated."""
    length = max(len(column) for column in columns)
    return np.stack([np.pad(column, (0, length - len(column)), mode="edge") for column in columns])
