"""A square grid over the road. Each cell lists the segments within a radius of any of its points.

A lookup reads the list of one cell instead of all segments. Lists keep the storage order, so the result is that of a search through all.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
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
    midpoint, valid = np.asarray(scene.road.midpoint), np.asarray(scene.road.valid)
    margin = radius_m + size_m  # lists of cells at the rim are empty; they stand for everything beyond
    points = [xy[mask] if mask.any() else np.zeros((1, 2)) for xy, mask in zip(midpoint, valid, strict=True)]
    origin = np.stack([xy.min(axis=0) - margin for xy in points])
    width = max(float(np.ptp(xy, axis=0).max()) for xy in points) + 2 * margin
    needed = {"side": int(np.ceil(width / size_m)) + 1}
    side = max(needed["side"], 0 if capacity is None else capacity["side"])
    lists = [_build_lists(*world, side=side, radius_m=radius_m, size_m=size_m) for world in zip(midpoint, valid, origin, strict=True)]
    needed["rows"] = max(1, *(len(segments) for segments, _ in lists))
    needed["longest_list"] = max(1, *(int(count.max()) for _, count in lists))
    sizes = needed if capacity is None else {name: capacity[name] for name in SIZES}
    for name, size in sizes.items():
        if needed[name] > size:
            raise ConfigError(f"capacity.{name}: expected at least {needed[name]} for the grid of the scene, got {size}")
    rows = np.zeros((len(lists), sizes["rows"]), np.int32)
    for row, (segments, _) in zip(rows, lists, strict=True):
        row[: len(segments)] = segments
    first = np.stack([np.concatenate([[0], np.cumsum(count)]) for _, count in lists]).astype(np.int32)
    leaves = {"origin": origin.astype(np.float32), "first": first, "rows": rows}
    static = {"side": side, "size_m": float(size_m), "radius_m": float(radius_m), "longest_list": sizes["longest_list"]}
    return unchecked(Scene, **(vars(scene) | {"road_grid": unchecked(SpatialGrid, **leaves, **static)}))


def _build_lists(
    midpoint: np.ndarray, valid: np.ndarray, origin: np.ndarray, *, side: int, radius_m: float, size_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Segments of all cells, cell after cell, and the number of segments of each cell."""
    reach = int(np.ceil(radius_m / size_m)) + 1
    number = np.flatnonzero(valid).astype(np.int32)
    points = (midpoint[number].astype(np.float64) - origin).T[:, None]
    cell = np.floor(points / size_m).astype(np.int32) + np.arange(-reach, reach + 1, dtype=np.int32)[:, None]  # [axis, 2 reach + 1, segments]
    beyond = np.maximum(np.maximum(cell * size_m - points, points - (cell + 1) * size_m), 0.0)
    squares = np.where((cell >= 0) & (cell < side), beyond * beyond, np.inf)
    before, after = np.zeros((2, *squares[1].shape), np.int32)  # columns of each row of cells within the radius: neighbours around the point's
    for column, square in enumerate(squares[0]):
        (before if column < reach else after)[...] += squares[1] + square <= (radius_m + SLACK_M) ** 2
    counts = (before + after).T.ravel()
    ends = np.cumsum(counts)
    first = (cell[1] * side + cell[0, reach] - before).T.ravel()
    flat = np.repeat(first - (ends - counts), counts) + np.arange(counts.sum())
    segment = np.repeat(number, counts.reshape(len(number), 2 * reach + 1).sum(axis=1))  # ascending, and a stable sort keeps the order
    keys = flat.astype(np.uint16) if side * side <= 2**16 else flat  # numpy sorts 16 bits by radix, ten times as fast
    return segment[np.argsort(keys, kind="stable")], np.bincount(flat, minlength=side * side)
