"""Scenes that are one recording twice: under another name, from another format, in other coordinates.

A hash of rounded content misses copies whose numbers differ in the last digit (JSON rounded to a centimetre, float32 in a TFRecord), and
copies that were moved. So candidates are found by measures that neither touches, and every candidate is compared point by point.
"""

import functools

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

SPACING_M = 0.5  # of the lanes' points that are compared


def find_recordings(
    bank: Bank, table: pa.Table, *, tolerance_m: float, min_matched_fraction: float, max_relative_difference: float
) -> tuple[Int[np.ndarray, " N"], int]:
    """The recording of every scene: copies of one recording have the same number.

    Args:
        table: the bank's metadata with features (`operations.describe_scenes`).
        tolerance_m: largest distance of a point of one scene from the other's.
        min_matched_fraction: of each scene's points that must have a partner in the other.
        max_relative_difference: of lane length and travelled distance up to which two scenes are compared.

    Returns:
        Numbers from 0, scene by scene, and how many pairs of scenes were compared.
    """
    pairs = find_candidates(table, tolerance_m=tolerance_m, max_relative_difference=max_relative_difference)
    scenes = (map(functools.partial(banks.read_raw, bank), pair) for pair in pairs.tolist())
    equal = [is_same_scene(*pair, tolerance_m=tolerance_m, min_matched_fraction=min_matched_fraction) for pair in scenes]
    one, other = pairs[np.array(equal, bool)].T
    links = coo_matrix((np.ones(len(one), bool), (one, other)), shape=(len(table), len(table)))
    return connected_components(links, directed=False)[1], len(pairs)


def find_candidates(table: pa.Table, *, tolerance_m: float, max_relative_difference: float) -> Int[np.ndarray, "N 2"]:
    """Pairs of rows whose steps, extents, lane length and travelled distance agree, as those of copies do."""
    measure = {name: table.column(name).to_numpy().astype(float) for name in ("steps", "extent_x_m", "extent_y_m", "lane_m", "distance_m")}
    scaled = [measure["steps"] * 2, *(measure[name] / (2 * tolerance_m) for name in ("extent_x_m", "extent_y_m"))]
    scaled += [np.log(measure[name] + 1.0) / max_relative_difference for name in ("lane_m", "distance_m")]
    return KDTree(np.stack(scaled, axis=1)).query_pairs(1.0, p=np.inf, output_type="ndarray").astype(int)


def is_same_scene(one: RawScene, other: RawScene, *, tolerance_m: float, min_matched_fraction: float) -> bool:
    """Whether two scenes hold the same lanes and motion; names, order and a shift of the coordinates do not count."""
    roads = [
        geographic_split.sample_along([line for line in raw.roads if line.kind in DRIVABLE], spacing_m=SPACING_M).xyz[:, :2]
        for raw in (one, other)
    ]
    if not (len(roads[0]) and len(roads[1])):
        return False
    corner = [np.concatenate([line.xyz[:, :2] for line in raw.roads if line.kind in DRIVABLE]).min(axis=0) for raw in (one, other)]
    roads = [points - low for points, low in zip(roads, corner, strict=True)]
    if not _cover(*roads, tolerance_m=tolerance_m + SPACING_M / 2, min_matched_fraction=min_matched_fraction):
        return False
    motion = [_motion(raw, low, apart_m=4 * tolerance_m) for raw, low in zip((one, other), corner, strict=True)]
    return _cover(*motion, tolerance_m=tolerance_m, min_matched_fraction=min_matched_fraction)


def _motion(raw: RawScene, corner: Float[np.ndarray, "2"], *, apart_m: float) -> Float[np.ndarray, "N 3"]:
    """Positions of all tracks at all steps; the third axis is time, scaled so that points of two steps never match."""
    steps = [np.flatnonzero(track.valid) for track in raw.tracks]
    points = [track.xyz[step, :2] - corner for track, step in zip(raw.tracks, steps, strict=True)]
    step = np.concatenate([*steps, np.zeros(0)])
    return np.concatenate([np.concatenate([*points, np.zeros((0, 2))]), step[:, None] * apart_m], axis=1)


def _cover(one: np.ndarray, other: np.ndarray, *, tolerance_m: float, min_matched_fraction: float) -> bool:
    """Whether enough points of each lie near one of the other."""
    if not (len(one) and len(other)):
        return len(one) == len(other)
    apart = (KDTree(one).query(other, distance_upper_bound=tolerance_m)[0], KDTree(other).query(one, distance_upper_bound=tolerance_m)[0])
    return all(np.isfinite(distance).mean() >= min_matched_fraction for distance in apart)
