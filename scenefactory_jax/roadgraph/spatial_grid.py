"""A square grid over the road. Each cell lists the segments within a radius of any of its points.

A lookup reads the list of one cell instead of all segments. Lists keep the storage order, so the result is that of a search through all.
"""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Scene, SpatialGrid

SIZES = ("side", "rows", "longest_list")  # of a grid: cells along a side, entries of all lists, entries of the longest list
SLACK_M = 0.01  # added to the radius; far above the rounding of float32 at the coordinates of a scene


def find_cell_bounds(grid: SpatialGrid, position: Float[Array, "A 2"]) -> tuple[Int[Array, " A"], Int[Array, " A"]]:
    """Bounds in `grid.rows` of the list of each position's cell."""
    place = jnp.floor((position - grid.origin) / grid.size_m).astype(jnp.int32)
    column, row = jnp.clip(place, 0, grid.side - 1).T
    cell = row * grid.side + column
    return grid.first[cell], grid.first[cell + 1]


def list_segments(grid: SpatialGrid, first: Int[Array, " A"], last: Int[Array, " A"]) -> tuple[Int[Array, "A N"], Bool[Array, "A N"]]:
    """Segments of the lists between these bounds, in storage order, and a mask of the entries that exist."""
    at = first[:, None] + jnp.arange(grid.longest_list, dtype=jnp.int32)
    mask = at < last[:, None]
    return jnp.where(mask, grid.rows[jnp.minimum(at, len(grid.rows) - 1)], 0), mask


def attach_grid(scene: Scene, *, radius_m: float, size_m: float, capacity: Mapping[str, int] | None = None) -> Scene:
    """Stacked scenes (numpy leaves `[W, ...]`) with a grid over their roads.

    Args:
        radius_m: largest radius of a lookup.
        size_m: side of a cell; smaller cells have shorter lists, and there are more of them.
        capacity: `SIZES` of the grids; None: what the largest scene needs. Scenes of equal sizes share a compiled program.

    Raises:
        ConfigError: a scene needs more than the capacity: a list that is cut would hide segments.
    """
    roads = list(zip(np.asarray(scene.road.midpoint), np.asarray(scene.road.valid), strict=True))
    grid = {"radius_m": radius_m, "size_m": size_m}
    side = max(_place_cells(*road, **grid)[1] for road in roads) if capacity is None else capacity["side"]
    grids = [build_grid(*road, **grid, side=side) for road in roads]
    return unchecked(Scene, **(vars(scene) | {"road_grid": stack_grids(grids, capacity)}))


def build_grid(
    midpoint: Float[np.ndarray, "N 2"], valid: Bool[np.ndarray, " N"], *, radius_m: float, size_m: float, side: int
) -> SpatialGrid:
    """The grid of one scene with numpy's leaves, without padding; `side`: cells, more if the scene needs more."""
    origin, needed = _place_cells(midpoint, valid, radius_m=radius_m, size_m=size_m)
    side = max(side, needed)
    segments, counts = _build_lists(midpoint, valid, origin, side=side, radius_m=radius_m, size_m=size_m)
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    segments = segments.astype(np.uint16) if len(midpoint) <= 2**16 else segments  # half as much to send between processes
    static = {"side": side, "size_m": float(size_m), "radius_m": float(radius_m), "longest_list": max(1, int(counts.max()))}
    return unchecked(SpatialGrid, origin=origin.astype(np.float32), first=first, rows=segments, **static)


def require_capacity(grid: SpatialGrid, capacity: Mapping[str, int]) -> None:
    """Refuses a grid that needs more than its capacity; see `attach_grid`."""
    for name, needed in _measure(grid).items():
        if needed > capacity[name]:
            raise ConfigError(f"capacity.{name}: expected at least {needed} for the grid of the scene, got {capacity[name]}")


def stack_grids(grids: Sequence[SpatialGrid], capacity: Mapping[str, int] | None) -> SpatialGrid:
    """Stacks grids of the same cells, padded to the capacity; None: to what the largest needs. Raises as `attach_grid`."""
    sizes = capacity or {name: max(_measure(grid)[name] for grid in grids) for name in SIZES}
    rows = np.zeros((len(grids), sizes["rows"]), np.int32)
    for row, grid in zip(rows, grids, strict=True):
        require_capacity(grid, sizes)
        row[: len(grid.rows)] = grid.rows
    leaves = {"origin": np.stack([grid.origin for grid in grids]), "first": np.stack([grid.first for grid in grids]), "rows": rows}
    return unchecked(SpatialGrid, **(vars(grids[0]) | leaves | {"longest_list": sizes["longest_list"]}))


def _measure(grid: SpatialGrid) -> dict[str, int]:
    """`SIZES` of a grid without padding."""
    return {"side": grid.side, "rows": max(1, len(grid.rows)), "longest_list": grid.longest_list}


def _place_cells(midpoint: np.ndarray, valid: np.ndarray, *, radius_m: float, size_m: float) -> tuple[np.ndarray, int]:
    """Corner of the first cell, and cells along a side."""
    margin = radius_m + size_m  # lists of cells at the rim are empty; they stand for everything beyond
    points = midpoint[valid] if valid.any() else np.zeros((1, 2))
    low = points.min(axis=0)
    return low - margin, int(np.ceil((float((points.max(axis=0) - low).max()) + 2 * margin) / size_m)) + 1


def _build_lists(
    midpoint: np.ndarray, valid: np.ndarray, origin: np.ndarray, *, side: int, radius_m: float, size_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Segments of all cells, cell after cell, and the number of segments of each cell."""
    reach = int(np.ceil(radius_m / size_m)) + 1
    number = np.flatnonzero(valid).astype(np.int32)
    points = (midpoint[number].astype(np.float64) - origin).T[:, None]
    cell = np.floor(points / size_m).astype(np.int32) + np.arange(-reach, reach + 1, dtype=np.int32)[:, None]  # [axis, around, segment]
    beyond = np.maximum(np.maximum(cell * size_m - points, points - (cell + 1) * size_m), 0.0)
    squares = beyond * beyond
    squares[1][(cell[1] < 0) | (cell[1] >= side)] = np.inf
    sides = np.zeros((2, *squares[1].shape), np.int32)  # cells of a row within the radius are neighbours, around the point's
    for column, square in enumerate(squares[0]):
        sides[int(column >= reach)] += squares[1] + square <= (radius_m + SLACK_M) ** 2
    before, after = sides
    low, high = np.maximum(cell[0, reach] - before, 0), np.minimum(cell[0, reach] + after, side)
    counts = np.maximum(high - low, 0).T.ravel()
    ends = np.cumsum(counts, dtype=np.int32)
    first = (cell[1] * side + low).T.ravel()
    flat = np.repeat(first - (ends - counts), counts) + np.arange(counts.sum(), dtype=np.int32)
    bounds = np.concatenate([np.zeros(1, np.int32), ends[2 * reach :: 2 * reach + 1]])  # of each segment's cells
    by_segment = scipy.sparse.csr_array((np.empty(len(flat), bool), flat, bounds), shape=(len(number), side * side))
    by_cell = by_segment.tocsc()  # the segments of a cell keep their order
    return number[by_cell.indices], np.diff(by_cell.indptr)
