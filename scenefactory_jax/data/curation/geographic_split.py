"""Finds scenes that show the same streets, and splits scenes so that no street is in two parts.

A recording fleet drives the same streets repeatedly, so a split by file puts one street into training and test. Two scenes overlap if
their driving lanes run through the same places in the same direction, in the coordinates of their dataset. Cities of a dataset may have
overlapping coordinates (WOMD's are up to 40 km wide), so a place is small: a cell of the ground, its height and a direction.
Formats that move every scene to its own centre, without the offset, cannot be compared.

The places of a scene are too many for the metadata of a large bank. `find_streets` keeps a fraction of them, chosen by a hash of the place:
two scenes keep the same ones of their common places (FracMinHash, Irber et al. 2022, bioRxiv 2022.01.11.475838), so their number is
proportional to the metres of common lane.
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

# metadata that identifies the frame of the coordinates: one per generated scene, in some datasets one per city
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
    """Length of each line in the plane; zero for a line without points."""
    arc, first = _arcs(lines)
    begin, end = first[:-1], first[1:]
    filled = end > begin
    found = np.zeros(len(lines))
    found[filled] = arc[end[filled] - 1] - arc[begin[filled]]
    return found


def _arcs(lines: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, " P"], Int[np.ndarray, " N1"]]:
    """Arc length at every point of concatenated lines, without the gaps between them, and the first point of each line."""
    first = np.cumsum([0, *map(len, lines)])
    if not first[-1]:
        return np.zeros(0), first
    points = np.concatenate([line[:, :2] for line in lines])
    length = np.hypot(*(points[1:] - points[:-1]).T)
    ends = first[1:-1]
    length[ends[(ends > 0) & (ends < len(points))] - 1] = 0.0
    return np.concatenate([[0.0], np.cumsum(length)]), first


def sample_along(lines: Sequence[Polyline], *, spacing_m: float, min_points: int = 1) -> Samples:
    """Points in the middle of equal steps of about `spacing_m`, at least `min_points` a line.

    Lines without length give none.
    """
    lines = [line for line in lines if len(line.xyz) >= 2]
    arc, first = _arcs([line.xyz for line in lines])
    begin, end = first[:-1], first[1:] - 1
    total = arc[end] - arc[begin]
    count = np.where(total > 0, np.maximum(np.rint(total / spacing_m), min_points), 0).astype(int)
    line = np.repeat(np.arange(len(lines)), count)
    if not len(line):
        return Samples(np.zeros((0, 3)), line, np.zeros(0), np.zeros(0))
    xyz = np.concatenate([line.xyz for line in lines])
    number = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    step = (total / np.maximum(count, 1))[line]
    at = arc[begin][line] + (number + 0.5) * step
    left = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(arc) - 2)
    fraction = (at - arc[left]) / (arc[left + 1] - arc[left])
    points = xyz[left] + fraction[:, None] * (xyz[left + 1] - xyz[left])
    row = np.arange(len(line))
    before, after = row - (number > 0), row + (number < count[line] - 1)
    chord = points[after, :2] - points[before, :2]
    alone = after == before  # a line of one step: the direction of where its point lies
    chord[alone] = (xyz[left + 1] - xyz[left])[alone, :2]
    return Samples(points, line, step, np.arctan2(chord[:, 1], chord[:, 0]))


def find_streets(raw: RawScene, *, cell_m: float, height_m: float, headings: int, one_in: int) -> Int[np.ndarray, " K"]:
    """Places of a scene's driving lanes as ascending hashes of 32 bits; a place has the same hash in every scene.

    Args:
        cell_m: side of a place on the ground, in the frame that the scene's dataset shares (`RawScene.origin` is added).
        height_m: height of a place: bridges, and cities on top of each other, are different places.
        headings: number of directions.
        one_in: places per place that is kept.

    Raises:
        ConfigError: a number that is not above 0.
    """
    for name, value in {"cell_m": cell_m, "height_m": height_m, "headings": headings, "one_in": one_in}.items():
        check_number(value, where=f"features.streets.{name}", above=0)
    samples = sample_along([line for line in raw.roads if line.kind in DRIVABLE], spacing_m=cell_m / 2)  # skips no place
    # places are centred on round numbers: generated roads lie on these
    cells = np.rint((samples.xyz + np.asarray(raw.origin)) / np.array([cell_m, cell_m, height_m])).astype(np.int64)
    direction = np.rint(samples.heading / (2 * np.pi) * headings).astype(np.int64) % headings
    frame = "/".join(str(raw.metadata[key]) for key in FRAME if raw.metadata.get(key) is not None)
    mixed = np.full(len(cells), zlib.crc32(frame.encode()), np.uint64)
    for value, multiplier in zip((*cells.T, direction), MULTIPLIERS, strict=True):
        mixed = _scramble(mixed ^ (value.astype(np.uint64) * np.uint64(multiplier)))
    kept = mixed[mixed % np.uint64(one_in) == 0]
    return np.unique(kept >> np.uint64(32)).astype(np.int64)


def _scramble(value: np.ndarray) -> np.ndarray:
    """A hash: the finaliser of SplitMix64 (Steele et al. 2014)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


def find_groups(places: Int[np.ndarray, " K"], starts: Int[np.ndarray, " N1"], *, min_shared_places: int) -> Int[np.ndarray, " N"]:
    """The group of every scene: scenes that share streets, directly or through other scenes, are in one.

    Args:
        places: `find_streets` of all scenes, concatenated.
        starts: first place of each scene, and the number of all places.
        min_shared_places: common places of two scenes of one group; fewer may be a crossing of two roads, or chance.
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
        linked = common.data >= min_shared_places
        one, other = np.concatenate([[common.row[linked] + begin, common.col[linked]], [np.arange(count), first]], axis=1)
        links = sparse.coo_matrix((np.ones(len(one), bool), (one, other)), shape=(count, count))
        label = connected_components(links, directed=False)[1]
        first = np.unique(label, return_index=True)[1][label]
    return np.unique(first, return_inverse=True)[1].ravel()


def assign_groups(group: Int[np.ndarray, " N"], fractions: Mapping[str, float | int], *, seed: int) -> dict[str, Int[np.ndarray, " M"]]:
    """Assigns whole groups to parts: the largest first, each to the part that lacks most scenes; groups of one size in a random order.

    Args:
        group: of every scene.
        fractions: of the scenes, by part; divided by their sum.
        seed: of the order.

    Returns:
        The rows of every part, ascending; together all rows, each once.

    Raises:
        ConfigError: fewer than two parts, a fraction that is not above 0, or a part that would stay empty.
    """
    if len(fractions) < 2:
        raise ConfigError(f"split.fractions: expected two parts or more, such as {{train: 0.8, test: 0.2}}, got {dict(fractions)}")
    for name, fraction in fractions.items():
        check_number(fraction, where=f"split.fractions.{name}", above=0)
    size = np.bincount(group)
    order = np.random.default_rng(seed).permutation(len(size))
    order = order[np.argsort(-size[order], kind="stable")]
    weights = np.array(list(fractions.values()), float)
    lacking = weights / weights.sum() * len(group)
    part = np.zeros(len(size), int)
    for number in order:
        part[number] = np.argmax(lacking)
        lacking[part[number]] -= size[number]
    rows = {name: np.flatnonzero(part[group] == index) for index, name in enumerate(fractions)}
    if empty := [name for name, members in rows.items() if not len(members)]:
        sizes = ", ".join(map(str, np.sort(size)[::-1][:5]))
        groups = f"{len(group)} scenes in {len(size)} groups that cannot be divided (the largest: {sizes})"
        hint = "raise it, raise split.min_shared_places, or ignore streets (split.by=scene)"
        raise ConfigError(f"split.fractions.{empty[0]}: {fractions[empty[0]]} of {groups} gives no scene; {hint}")
    return rows


def find_leaks(group: Int[np.ndarray, " N"], parts: Mapping[str, Int[np.ndarray, " M"]]) -> dict[str, int]:
    """Number of scenes of each part whose streets are in another part, too."""
    part = np.full(len(group), -1)
    for index, rows in enumerate(parts.values()):
        part[rows] = index
    assigned = np.flatnonzero(part >= 0)
    pairs = np.unique(np.stack([group[assigned], part[assigned]]), axis=1)
    split = np.bincount(pairs[0], minlength=group.max(initial=0) + 1) > 1
    return {name: int(split[group[rows]].sum()) for name, rows in parts.items()}
