"""Which scenes show the same streets, and how to split scenes so that no street is on both sides.

A recording fleet drives the same streets again and again, so a split by file puts one street into training and test. Scenes overlap here if
their driving lanes run through the same places in the same direction, in the coordinates that their dataset shares. Datasets put several
cities on top of each other (WOMD's are up to 40 km wide and overlap), so a place is fine: a cell of the ground, its height and a direction.
Formats that move every scene to a centre of its own, without saying from where, have lost what it takes.

A scene's places are too many to keep for every scene of a large bank. `streets` keeps one in so many, chosen by a hash of the place itself:
two scenes keep the same ones of what they share (FracMinHash, Irber et al. 2022, bioRxiv 2022.01.11.475838), so the number that two
scenes have in common is still proportional to the metres of lane that they share.
"""

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from scenefactory_jax.core.instantiate import ConfigError, check_number
from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.types import DRIVABLE

# what of a scene's metadata says in which frame its coordinates are: generated scenes have one each, some datasets one a city
FRAME = ("dataset", "city", "location", "map", "town", "seed", "index")
BLOCK = 4096  # scenes whose overlaps with all others are counted at once: bounds memory, changes no result
MULTIPLIERS = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5)  # odd: primes of xxHash


class Samples(NamedTuple):
    """Points along polylines, evenly spaced on each."""

    xyz: Float[np.ndarray, "N 3"]
    line: Int[np.ndarray, " N"]  # which polyline
    step: Float[np.ndarray, " N"]  # metres of the polyline that a point stands for
    heading: Float[np.ndarray, " N"]  # of the chord between the neighbouring points


def lengths(lines: Sequence[np.ndarray]) -> Float[np.ndarray, " N"]:
    """Length in the plane of each of many lines of points; zero of a line without points."""
    arc, first = _arcs(lines)
    begin, end = first[:-1], first[1:]
    filled = end > begin
    found = np.zeros(len(lines))
    found[filled] = arc[end[filled] - 1] - arc[begin[filled]]
    return found


def _arcs(lines: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, " P"], Int[np.ndarray, " N1"]]:
    """Arc length at every point of lines laid end to end without the ways between them, and where each line begins."""
    first = np.cumsum([0, *map(len, lines)])
    if not first[-1]:
        return np.zeros(0), first
    points = np.concatenate([line[:, :2] for line in lines])
    way = points[1:] - points[:-1]
    length = np.hypot(way[:, 0], way[:, 1])
    ends = first[1:-1]
    length[ends[(ends > 0) & (ends < len(points))] - 1] = 0.0
    return np.concatenate([[0.0], np.cumsum(length)]), first


def sample_along(lines: Sequence[Polyline], *, spacing_m: float, least: int = 1) -> Samples:
    """Points in the middle of equal steps of about `spacing_m`, `least` a line or more, whatever the spacing of the source.

    Lines without length give none.
    """
    lines = [line for line in lines if len(line.xyz) >= 2]
    arc, first = _arcs([line.xyz for line in lines])
    begin, end = first[:-1], first[1:] - 1
    total = arc[end] - arc[begin]
    count = np.where(total > 0, np.maximum(np.rint(total / spacing_m), least), 0).astype(int)
    line = np.repeat(np.arange(len(lines)), count)
    if not len(line):
        return Samples(np.zeros((0, 3)), line, np.zeros(0), np.zeros(0))
    xyz = np.concatenate([line.xyz for line in lines])
    number = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    step = (total / np.maximum(count, 1))[line]
    at = arc[begin][line] + (number + 0.5) * step
    left = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(arc) - 2)
    share = (at - arc[left]) / (arc[left + 1] - arc[left])
    points = xyz[left] + share[:, None] * (xyz[left + 1] - xyz[left])
    row = np.arange(len(line))
    before, after = row - (number > 0), row + (number < count[line] - 1)
    chord = points[after, :2] - points[before, :2]
    alone = after == before  # a line of one step: the direction of where its point lies
    chord[alone] = (xyz[left + 1] - xyz[left])[alone, :2]
    return Samples(points, line, step, np.arctan2(chord[:, 1], chord[:, 0]))


def find_streets(raw: RawScene, *, cell_m: float, height_m: float, headings: int, one_in: int) -> Int[np.ndarray, " K"]:
    """The places of a scene's driving lanes, as ascending hashes of 32 bits: the same place has the same one in every scene.

    Args:
        cell_m: side of a place on the ground, in the frame that the scene's dataset shares (`RawScene.origin` is added).
        height_m: height of a place: bridges, and cities on top of each other, are different places.
        headings: directions that are told apart.
        one_in: how many places one that is kept stands for.

    Raises:
        ConfigError: one that is not above 0.
    """
    for name, value in {"cell_m": cell_m, "height_m": height_m, "headings": headings, "one_in": one_in}.items():
        check_number(value, where=f"features.streets.{name}", above=0)
    samples = sample_along([line for line in raw.roads if line.kind in DRIVABLE], spacing_m=cell_m / 2)  # no place is jumped over
    # places are centred on round numbers: made-up roads lie on these, and should not fall between two places
    cells = np.rint((samples.xyz + np.asarray(raw.origin)) / np.array([cell_m, cell_m, height_m])).astype(np.int64)
    towards = np.rint(samples.heading / (2 * np.pi) * headings).astype(np.int64) % headings
    frame = "/".join(str(raw.metadata[key]) for key in FRAME if raw.metadata.get(key) is not None)
    mixed = np.full(len(cells), zlib.crc32(frame.encode()), np.uint64)
    for value, multiplier in zip((*cells.T, towards), MULTIPLIERS, strict=True):
        mixed = _scrambled(mixed ^ (value.astype(np.uint64) * np.uint64(multiplier)))
    kept = mixed[mixed % np.uint64(one_in) == 0]
    return np.unique(kept >> np.uint64(32)).astype(np.int64)


def _scrambled(value: np.ndarray) -> np.ndarray:
    """Every bit of the result depends on every bit of the value (the finaliser of SplitMix64, Steele et al. 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


def find_groups(places: Int[np.ndarray, " K"], starts: Int[np.ndarray, " N1"], *, least_shared: int) -> Int[np.ndarray, " N"]:
    """The group of every scene: scenes that share streets, directly or through others, are in one.

    Args:
        places: `streets` of all scenes, end to end.
        starts: where each scene's begin, and where the last one's end.
        least_shared: kept places that two scenes must have in common; fewer is a crossing of two roads, or chance.
    """
    count = len(starts) - 1
    column = pa.array(places).dictionary_encode().indices.to_numpy()
    shared = np.bincount(column)[column] > 1
    scene = np.repeat(np.arange(count), np.diff(starts))[shared]
    width = int(column.max(initial=0)) + 1
    table = sparse.csr_matrix((np.ones(len(scene), np.int32), (scene, column[shared])), shape=(count, width))
    across = table.T.tocsr()
    first = np.arange(count)  # scene of each scene's group so far
    for begin in range(0, count, BLOCK):
        common = (table[begin : begin + BLOCK] @ across).tocoo()
        linked = common.data >= least_shared
        one, other = np.concatenate([[common.row[linked] + begin, common.col[linked]], [np.arange(count), first]], axis=1)
        links = sparse.coo_matrix((np.ones(len(one), bool), (one, other)), shape=(count, count))
        label = connected_components(links, directed=False)[1]
        first = np.unique(label, return_index=True)[1][label]
    return np.unique(first, return_inverse=True)[1].ravel()


def assign_groups(group: Int[np.ndarray, " N"], shares: Mapping[str, float | int], *, seed: int) -> dict[str, Int[np.ndarray, " M"]]:
    """Whole groups to parts: the largest first, each to the part that lacks most of its share; groups of one size in a random order.

    Args:
        group: of every scene.
        shares: of the scenes, by part; they are divided by their sum.
        seed: of the order.

    Returns:
        The rows of every part, ascending; together all rows, each once.

    Raises:
        ConfigError: shares that are none, or a part that would stay empty because there are too few groups.
    """
    weights = check_shares(shares)
    size = np.bincount(group)
    order = np.random.default_rng(seed).permutation(len(size))
    order = order[np.argsort(-size[order], kind="stable")]
    lacking = weights * len(group)
    part = np.zeros(len(size), int)
    for number in order:
        part[number] = np.argmax(lacking)
        lacking[part[number]] -= size[number]
    rows = {name: np.flatnonzero(part[group] == index) for index, name in enumerate(shares)}
    if empty := [name for name, found in rows.items() if not len(found)]:
        sizes = ", ".join(map(str, np.sort(size)[::-1][:5]))
        some = f"{len(group)} scenes in {len(size)} groups that cannot be divided (the largest: {sizes})"
        more = "ask for more, raise split.least_shared, or take no heed of streets (split.by=scene)"
        raise ConfigError(f"split.shares.{empty[0]}: {shares[empty[0]]} of {some} is none; {more}")
    return rows


def check_shares(shares: Mapping[str, float | int]) -> Float[np.ndarray, " P"]:
    """Shares that sum to 1.

    Raises:
        ConfigError: fewer than two parts, or a share that is not above 0.
    """
    if len(shares) < 2:
        raise ConfigError(f"split.shares: {dict(shares)}; wanted are two parts or more, such as {{train: 0.8, test: 0.2}}")
    for name, share in shares.items():
        if not (share > 0 and np.isfinite(share)):
            raise ConfigError(f"split.shares.{name}: {share!r}; wanted is a number above 0")
    weights = np.array(list(shares.values()), float)
    return weights / weights.sum()


def find_leaks(group: Int[np.ndarray, " N"], parts: Mapping[str, Int[np.ndarray, " M"]]) -> dict[str, int]:
    """Scenes of each part whose streets are on another part as well: what a split should not have."""
    home = np.full(len(group), -1)
    for index, rows in enumerate(parts.values()):
        home[rows] = index
    dealt = np.flatnonzero(home >= 0)
    pairs = np.unique(np.stack([group[dealt], home[dealt]]), axis=1)
    split = np.bincount(pairs[0], minlength=group.max(initial=0) + 1) > 1
    return {name: int(split[group[rows]].sum()) for name, rows in parts.items()}
