"""Scenes that are one recording twice: under another name, from another format, in other coordinates.

A hash of rounded content misses copies whose numbers differ in the last digit (JSON rounded to a centimetre, float32 in a TFRecord), and
copies that were moved. So candidates are found by measures that neither touches, and every candidate is compared point by point.
"""

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.types import DRIVABLE
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.bank.bank_reader import Bank
from scenefactory_jax.data.curation import geographic_split
from scenefactory_jax.data.curation.operations import BankResult

SPACING_M = 0.5  # of the lanes' points that are compared


def dedupe(bank: Bank, table: pa.Table, *, tolerance_m: float, share: float, slack: float) -> BankResult:
    """The first scene of every content.

    Args:
        table: the bank's metadata with features (`operations.described`).
        tolerance_m: how far a point of one scene may be from the other's.
        share: of each scene's points that must have a partner in the other.
        slack: relative difference of lane length and travelled distance up to which two scenes are compared at all.

    Returns:
        The bank without the others, and an account with all groups by name, the kept scene first.
    """
    pairs = find_candidates(table, tolerance_m=tolerance_m, slack=slack)
    equal = [
        is_same_scene(banks.read_raw(bank, one), banks.read_raw(bank, other), tolerance_m=tolerance_m, share=share)
        for one, other in pairs.tolist()
    ]
    one, other = pairs[np.array(equal, bool)].T
    links = coo_matrix((np.ones(len(one), bool), (one, other)), shape=(len(table), len(table)))
    _, group = connected_components(links, directed=False)
    _, first, size = np.unique(group, return_index=True, return_counts=True)
    names = np.array(bank.names)
    found = [names[group == number].tolist() for number in np.flatnonzero(size > 1)]
    account = {"scenes": len(table), "compared": len(pairs), "kept": len(first), "groups": found}
    return BankResult(banks.view(bank, np.sort(first)), account)


def find_candidates(table: pa.Table, *, tolerance_m: float, slack: float) -> Int[np.ndarray, "N 2"]:
    """Pairs of rows whose steps, extents, lane length and travelled distance agree: whoever is the same scene agrees in them."""
    measure = {name: table.column(name).to_numpy().astype(float) for name in ("steps", "extent_x_m", "extent_y_m", "lane_m", "distance_m")}
    place = [measure["steps"] * 2, *(measure[name] / (2 * tolerance_m) for name in ("extent_x_m", "extent_y_m"))]
    place += [np.log(measure[name] + 1.0) / slack for name in ("lane_m", "distance_m")]
    return KDTree(np.stack(place, axis=1)).query_pairs(1.0, p=np.inf, output_type="ndarray").astype(int)


def is_same_scene(one: RawScene, other: RawScene, *, tolerance_m: float, share: float) -> bool:
    """Whether two scenes hold the same lanes and the same motion, one shifted against the other or not, whatever their names and order."""
    roads = [
        geographic_split.sample_along([line for line in raw.roads if line.kind in DRIVABLE], spacing_m=SPACING_M).xyz[:, :2]
        for raw in (one, other)
    ]
    if not (len(roads[0]) and len(roads[1])):
        return False
    corner = [np.concatenate([line.xyz[:, :2] for line in raw.roads if line.kind in DRIVABLE]).min(axis=0) for raw in (one, other)]
    roads = [points - low for points, low in zip(roads, corner, strict=True)]
    if not _cover(*roads, tolerance_m=tolerance_m + SPACING_M / 2, share=share):
        return False
    motion = [_motion(raw, low, apart_m=4 * tolerance_m) for raw, low in zip((one, other), corner, strict=True)]
    return _cover(*motion, tolerance_m=tolerance_m, share=share)


def _motion(raw: RawScene, corner: Float[np.ndarray, "2"], *, apart_m: float) -> Float[np.ndarray, "N 3"]:
    """Where anybody was at any step; the third axis is time, on which steps are too far apart to be mistaken for each other."""
    steps = [np.flatnonzero(track.valid) for track in raw.tracks]
    points = [track.xyz[step, :2] - corner for track, step in zip(raw.tracks, steps, strict=True)]
    step = np.concatenate([*steps, np.zeros(0)])
    return np.concatenate([np.concatenate([*points, np.zeros((0, 2))]), step[:, None] * apart_m], axis=1)


def _cover(one: np.ndarray, other: np.ndarray, *, tolerance_m: float, share: float) -> bool:
    """Whether enough points of each lie near one of the other."""
    if not (len(one) and len(other)):
        return len(one) == len(other)
    apart = (KDTree(one).query(other, distance_upper_bound=tolerance_m)[0], KDTree(other).query(one, distance_upper_bound=tolerance_m)[0])
    return all(np.isfinite(distance).mean() >= share for distance in apart)
