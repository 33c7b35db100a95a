"""Fits the road's height to the points of a scene's map: `scenes.pack.elevation`.

The coefficients of `roadgraph.elevation` minimise the squared errors at the points plus the squared second differences of the coefficients
(P. H. C. Eilers and B. D. Marx, Flexible smoothing with B-splines and penalties, Statistical Science 11, 1996). A plane has none, so
constant grades and banks are exact, and places without points continue their surroundings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.raw_scene import RawScene, Unpackable
from scenefactory_jax.core.schema import Bounds, ConfigError, Positive
from scenefactory_jax.core.types import EDGES, LANE_BIKE, LANE_FREEWAY, LANE_STREET, LINES, Elevation
from scenefactory_jax.data.formats.polylines import densify

KINDS = (LANE_FREEWAY, LANE_STREET, LANE_BIKE, *LINES, *EDGES)  # whose points lie on the road; stop signs stand above it
RIM = 2  # cells around the square
OVERLAP = 1.5  # cells, within which two heights are those of one place
CLEAR = 1.75  # cells, within which a level that ends bends away from the road
APART = 5.0  # cells, over which a level may go from the height of one road to that of another
LINK, STEEP = 1.25, 3.0  # cells between points of one road, in which heights count three times


@dataclass(frozen=True)
class ElevationConfig:
    """The key `elevation` of `scenes.pack`."""

    cell_m: Positive  # between the coefficients
    smoothing: Positive  # weight of a squared second difference, against that of a point's squared error
    spacing_m: Positive  # one point of the map is read in a cube of this size
    levels: Annotated[int, Bounds(min=1, max=4)]  # of roads above each other
    rise_m: Positive  # two points of the map at one place that are farther apart are on different levels


def fit_elevation(raw: RawScene, origin: Float[np.ndarray, "3"], half: float, config: ElevationConfig) -> Elevation:
    """Fits the heights of a square of `half` its side around an origin, in float32 and relative to the origin.

    Raises:
        Unpackable: more levels than `config.levels`.
    """
    nodes = 2 * int(np.ceil(half / config.cell_m) + RIM) + 1
    corner = -0.5 * (nodes - 1) * config.cell_m
    lines = [densify(line.xyz, config.spacing_m) - origin for line in raw.roads if line.kind in KINDS and len(line.xyz) >= 2]
    points = np.concatenate([np.zeros((0, 3)), *lines])
    points = _thin(points[(np.abs(points[:, :2]) <= -corner - config.cell_m).all(axis=1)], config.spacing_m)
    below, above = _assign_levels(points, config, raw.source)
    basis, bending = evaluate_basis((points[:, :2] - corner) / config.cell_m, nodes), config.smoothing * _measure_bending(nodes)
    height, present = np.zeros((config.levels, nodes, nodes), np.float32), np.ones((config.levels, nodes, nodes), bool)
    for level in range(config.levels):
        own = (below <= level) & (above <= config.levels - 1 - level)
        rows = basis[own]
        if own.any():
            height[level].flat = scipy.sparse.linalg.spsolve((rows.T @ rows + bending).tocsc(), rows.T @ points[own, 2])
            alone = own & (below + above == config.levels - 1)
            present[level] = _find_present(points, own, alone, corner + config.cell_m * np.arange(nodes))
    place = {"origin": np.full(2, corner, np.float32), "cell_m": np.float32(config.cell_m)}
    return unchecked(Elevation, height=height, **place, present=present if config.levels > 1 else None)


def _find_present(
    points: Float[np.ndarray, "N 3"], own: Bool[np.ndarray, " N"], alone: Bool[np.ndarray, " N"], axis: Float[np.ndarray, " K"]
) -> Bool[np.ndarray, "K K"]:
    """Mask of the coefficients at which a level is there: around points of its own, less the cells in which it leaves other roads.

    Args:
        alone: of its own points those that are on no other level.
    """
    cell = axis[1] - axis[0]
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1)  # rows along y
    near, other, crossing = (_measure_distance(points[mask, :2], nodes) for mask in (own, ~own, alone))
    return (other > np.maximum(near, CLEAR * cell)) | (crossing <= OVERLAP * cell)


def _measure_distance(points: Float[np.ndarray, "N 2"], nodes: Float[np.ndarray, "K K 2"]) -> Float[np.ndarray, "K K"]:
    """Distances of the nearest point; inf without points."""
    return KDTree(points).query(nodes)[0] if len(points) else np.full(nodes.shape[:2], np.inf)


def stack_elevations(worlds: Sequence[Elevation | None]) -> Elevation | None:
    """Stacks the elevations of scenes along a new first axis; None where no scene has one.

    Raises:
        ConfigError: of different sizes, or of some scenes only.
    """
    sizes = {None if world is None else np.shape(world.height) for world in worlds}
    if len(sizes) > 1:
        raise ConfigError(f"scenes.pack.elevation: expected the same sizes in all scenes, got {', '.join(sorted(map(str, sizes)))}")
    if sizes == {None}:
        return None
    parts = {name: [getattr(world, name) for world in worlds] for name in vars(worlds[0])}
    return unchecked(Elevation, **{name: None if part[0] is None else np.stack(part) for name, part in parts.items()})


def _thin(points: Float[np.ndarray, "N 3"], spacing_m: float) -> Float[np.ndarray, "M 3"]:
    """The first point of each cube."""
    return points[np.sort(np.unique(np.floor(points / spacing_m).astype(int), axis=0, return_index=True)[1])]


def _assign_levels(points: Float[np.ndarray, "N 3"], config: ElevationConfig, source: str) -> tuple[np.ndarray, np.ndarray]:
    """Levels that lie below and above each point: it belongs to none of them, but to all others.

    Raises:
        Unpackable: more levels at one place than `config.levels`.
    """
    below, above = np.zeros((2, len(points)), int)
    if not len(points) or np.ptp(points[:, 2]) <= config.rise_m:
        return below, above
    below, above = _count_levels(points, config)
    if (deepest := int((below + above).max()) + 1) > config.levels:
        raise Unpackable("levels", f"{source}: roads: {deepest} levels at one place; scenes.pack.elevation.levels is {config.levels}")
    if deepest > 1:
        source_of = _spread_along_roads(points, below + above > 0, config.cell_m)
        below, above = (np.where(source_of >= 0, counts[source_of], 0) for counts in (below, above))
    below = np.minimum(below, config.levels - 1)
    return below, np.minimum(above, config.levels - 1 - below)


def _count_levels(points: Float[np.ndarray, "N 3"], config: ElevationConfig) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Levels below and above each point, among the points within OVERLAP: their heights in order, divided at gaps of `rise_m`."""
    below, above = np.zeros((2, len(points)), int)
    coarse = _thin(points, config.cell_m)
    near = KDTree(coarse[:, :2]).query_ball_point(points[:, :2], OVERLAP * config.cell_m)
    for row, others in enumerate(near):
        height = np.sort(np.append(coarse[others, 2], points[row, 2]))
        gaps = height[1:][np.diff(height) > config.rise_m]  # lowest heights of the levels but the first
        below[row] = (gaps <= points[row, 2]).sum()
        above[row] = len(gaps) - below[row]
    return below, above


def _spread_along_roads(points: Float[np.ndarray, "N 3"], crossing: Bool[np.ndarray, " N"], cell_m: float) -> Int[np.ndarray, " N"]:
    """For each point the nearest one at a crossing along roads, by its row; -1 where there is none within APART."""
    near = np.flatnonzero(KDTree(points[crossing, :2]).query(points[:, :2])[0] <= APART * cell_m)
    tree = KDTree(points[near] * [1.0, 1.0, STEEP])
    ways = tree.sparse_distance_matrix(tree, LINK * cell_m, output_type="coo_matrix").tocsr()
    starts = np.flatnonzero(crossing[near])
    *_, found = scipy.sparse.csgraph.dijkstra(ways, indices=starts, limit=APART * cell_m, min_only=True, return_predecessors=True)
    source = np.full(len(points), -1)
    source[near[found >= 0]] = near[found[found >= 0]]
    return source


def evaluate_basis(place: Float[np.ndarray, "N 2"], nodes: int) -> scipy.sparse.csr_array:
    """Weights of the coefficients at places in cells from the first coefficient, [N, nodes^2]."""
    node = np.clip(np.floor(place + 0.5), 1, nodes - 2)
    offset = place - node
    weights = np.stack([0.5 * (0.5 - offset) ** 2, 0.75 - offset**2, 0.5 * (0.5 + offset) ** 2], axis=-1)  # [N, 2, 3]
    index = node.astype(int)[..., None] + np.arange(-1, 2)
    flat = index[:, 1, :, None] * nodes + index[:, 0, None, :]
    values = weights[:, 1, :, None] * weights[:, 0, None, :]
    row = np.repeat(np.arange(len(place)), 9)
    return scipy.sparse.csr_array((values.ravel(), (row, flat.ravel())), shape=(len(place), nodes * nodes))


def _measure_bending(nodes: int) -> scipy.sparse.csr_array:
    """The matrix of the summed squared second differences: along both axes, and twice the mixed ones (a thin plate's energy)."""
    one = np.eye(nodes)
    first, second = np.diff(one, axis=0), np.diff(one, 2, axis=0)
    parts = scipy.sparse.kron(one, second), scipy.sparse.kron(second, one), np.sqrt(2.0) * scipy.sparse.kron(first, first)
    return scipy.sparse.csr_array(sum(part.T @ part for part in parts))
