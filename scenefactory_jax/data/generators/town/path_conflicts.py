"""Where the ways of road users meet: for every two of them, which places of one lie on the other."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.data.generators.town.lane_paths import STEP_M, Path

STRIDE = 2  # points of a path from one row of the table to the next
ROW_M = STRIDE * STEP_M
SIDE_M = 0.35  # between two who pass one another
ALONG = 0.7  # cosine between two ways that run together


class PathProjections(NamedTuple):
    """The projection of every way on every other."""

    place: Float[np.ndarray, "N N S"]  # [i, j, row]: place on j's way of a row of i's; NaN where j's way is not near
    rows: Int[np.ndarray, " N"]  # of each way


class Zones(NamedTuple):
    """Stretches of one's way that lie on another's, seen by `own`."""

    own: Int[np.ndarray, " Z"]
    other: Int[np.ndarray, " Z"]
    start: Float[np.ndarray, " Z"]  # on own's way, m
    end: Float[np.ndarray, " Z"]
    other_start: Float[np.ndarray, " Z"]  # on other's way
    other_end: Float[np.ndarray, " Z"]
    along: Bool[np.ndarray, " Z"]  # the two run together rather than cross
    rank: Float[np.ndarray, " Z"]  # own's right of way less the other's


def find_conflicts(paths: list[Path], width: Float[np.ndarray, " N"]) -> tuple[PathProjections, Zones]:
    """Project all ways on one another; two ways meet where the boxes that drive them would touch.

    Args:
        width: of the road users.
    """
    count = len(paths)
    thinned = [path.points[::STRIDE] for path in paths]
    rows = np.array([len(points) for points in thinned])
    owner = np.repeat(np.arange(count), rows)
    row = np.concatenate([np.arange(n) for n in rows])
    points = np.concatenate(thinned)
    pairs = KDTree(points).query_pairs(float(width.max()) + SIDE_M, output_type="ndarray")
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    limit = (width[owner[pairs[:, 0]]] + width[owner[pairs[:, 1]]]) / 2 + SIDE_M
    pairs = pairs[((points[pairs[:, 0]] - points[pairs[:, 1]]) ** 2).sum(axis=1) < limit**2]
    both = np.concatenate([pairs, pairs[:, ::-1]])
    most = int(rows.max())
    key = (owner[both[:, 0]] * count + owner[both[:, 1]]) * most + row[both[:, 0]]
    size = count * count * most
    hits = np.bincount(key, minlength=size)
    # the mean over all near points is the projection: they lie around it
    with np.errstate(invalid="ignore"):
        place = (ROW_M * np.bincount(key, weights=row[both[:, 1]], minlength=size) / hits).reshape(count, count, most)
    return PathProjections(place, rows), _zones(paths, place)


def _zones(paths: list[Path], place: Float[np.ndarray, "N N S"]) -> Zones:
    """Runs of rows that have a projection."""
    near = np.isfinite(place)
    padded = np.pad(near, ((0, 0), (0, 0), (1, 1)))
    own, other, first = np.nonzero(padded[:, :, 1:-1] & ~padded[:, :, :-2])
    _, _, last = np.nonzero(padded[:, :, 1:-1] & ~padded[:, :, 2:])
    a, b = place[own, other, first], place[own, other, last]
    rank, yaw, most = _columns(paths)
    at = lambda table, who, metres: table[who, np.clip((metres / STEP_M).astype(int), 0, most - 1)]  # noqa: E731
    middle = (first + last) // 2
    turn = at(yaw, own, middle * ROW_M) - at(yaw, other, place[own, other, middle])
    lead = 1.0  # m into the zone: where the lanes are those that meet
    difference = at(rank, own, first * ROW_M + lead) - at(rank, other, np.minimum(a, b) + lead)
    return Zones(own, other, first * ROW_M, last * ROW_M, np.minimum(a, b), np.maximum(a, b), np.cos(turn) > ALONG, difference)


def _columns(paths: list[Path]) -> tuple[Float[np.ndarray, "N P"], Float[np.ndarray, "N P"], int]:
    """Right of way and yaw of all ways as tables, the last value repeated."""
    most = max(len(path.points) for path in paths)
    rank, yaw = (np.stack([np.pad(column, (0, most - len(column)), mode="edge") for column in columns])
                 for columns in ([path.rank for path in paths], [path.yaw for path in paths]))  # fmt: skip
    return rank, yaw, most
