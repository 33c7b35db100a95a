"""Looking road segments up by place: a square grid whose cells list what lies within a radius of any of their points.

A place looks through its cell's list instead of all segments. The lists keep the storage order, so that the segments found are the same,
in the same order, as by looking through all of them.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Scene, SpatialGrid

SIZES = ("side", "rows", "most")  # of a grid: cells along it, entries of all its lists, entries of the longest one
SLACK_M = 0.01  # on the radius, so that rounding loses nobody: far above float32's at the coordinates of a scene


def find_cell_bounds(cells: SpatialGrid, position: Float[Array, "A 2"]) -> tuple[Int[Array, " A"], Int[Array, " A"]]:
    """Where in `cells.rows` the list of each position's cell begins and ends: segments that may lie within the radius of it."""
    place = jnp.floor((position - cells.origin) / cells.size_m).astype(jnp.int32)
    column, row = jnp.clip(place, 0, cells.side - 1).T
    cell = row * cells.side + column
    return cells.first[cell], cells.first[cell + 1]


def list_segments(cells: SpatialGrid, first: Int[Array, " A"], last: Int[Array, " A"]) -> tuple[Int[Array, "A N"], Bool[Array, "A N"]]:
    """Segments of lists that begin and end there, in storage order, and which entries are any."""
    at = first[:, None] + jnp.arange(cells.most, dtype=jnp.int32)
    there = at < last[:, None]
    return jnp.where(there, cells.rows[jnp.minimum(at, len(cells.rows) - 1)], 0), there


def attach_grid(scene: Scene, *, radius_m: float, size_m: float, capacity: Mapping[str, int] | None = None) -> Scene:
    """Stacked scenes (numpy leaves `[W, ...]`) with cells for their roads.

    Args:
        radius_m: that lookups will ask for.
        size_m: side of a cell; smaller ones have shorter lists, and more of them.
        capacity: `SIZES` of the grids; None: what the largest scene needs. Scenes share a compiled program where these are the same.

    Raises:
        ConfigError: a scene that needs more: a list that was cut would hide segments from whoever looks there.
    """
    midpoint, valid = np.asarray(scene.road.midpoint), np.asarray(scene.road.valid)
    margin = radius_m + size_m  # around the segments: cells at the grid's edge list nothing, and stand for everything beyond
    shown = [points[seen] if seen.any() else np.zeros((1, 2)) for points, seen in zip(midpoint, valid, strict=True)]
    origin = np.stack([points.min(axis=0) - margin for points in shown])
    width = max(float((points.max(axis=0) - points.min(axis=0)).max()) for points in shown) + 2 * margin
    needed = int(np.ceil(width / size_m)) + 1
    side = needed if capacity is None else max(capacity["side"], needed)
    lists = [
        _lists(points, seen, corner, side=side, radius_m=radius_m, size_m=size_m)
        for points, seen, corner in zip(midpoint, valid, origin, strict=True)
    ]
    sizes = {"side": needed, "rows": max(1, *(len(found) for found, _ in lists)), "most": max(1, *(int(count.max()) for _, count in lists))}
    if capacity is not None:
        sizes = _within(sizes, capacity)
    first = np.stack([np.concatenate([[0], np.cumsum(count)]) for _, count in lists]).astype(np.int32)
    rows = np.zeros((len(lists), sizes["rows"]), np.int32)
    for own, (found, _) in zip(rows, lists, strict=True):
        own[: len(found)] = found
    leaves = {"origin": origin.astype(np.float32), "first": first, "rows": rows}
    cells = unchecked(SpatialGrid, **leaves, side=side, size_m=float(size_m), radius_m=float(radius_m), most=sizes["most"])
    return unchecked(Scene, **(vars(scene) | {"road_grid": cells}))


def _within(needed: Mapping[str, int], capacity: Mapping[str, int]) -> dict[str, int]:
    """The capacity, if it holds what is needed."""
    for name in SIZES:
        if needed[name] > capacity[name]:
            raise ConfigError(f"capacity.{name}: {capacity[name]}; the cells of the scene need {needed[name]}")
    return {name: capacity[name] for name in SIZES}


def _lists(
    midpoint: np.ndarray, valid: np.ndarray, origin: np.ndarray, *, side: int, radius_m: float, size_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Segments of all cells, cell after cell, and how many each has."""
    reach = int(np.ceil(radius_m / size_m)) + 1
    number = np.flatnonzero(valid).astype(np.int32)
    points = midpoint[number].astype(np.float64) - origin
    limit = (radius_m + SLACK_M) ** 2
    apart, place, there = [], [], []
    for axis in (0, 1):  # from each point to each column, then to each row of cells around its own
        along = points[:, axis, None]
        cell = np.floor(along / size_m).astype(np.int32) + np.arange(-reach, reach + 1, dtype=np.int32)
        beyond = np.maximum(np.maximum(cell * size_m - along, along - (cell + 1) * size_m), 0.0)
        apart.append(beyond * beyond)
        place.append(cell)
        there.append((cell >= 0) & (cell < side))
    reached = (apart[1][:, :, None] + apart[0][:, None, :] <= limit) & (there[1][:, :, None] & there[0][:, None, :])
    flat = (place[1][:, :, None] * side + place[0][:, None, :])[reached]
    segment = np.repeat(number, reached.sum(axis=(1, 2)))  # ascending, and a stable sort keeps it so
    narrow = flat.astype(np.uint16) if side * side <= 2**16 else flat  # numpy sorts 16 bits by radix, ten times as fast
    return segment[np.argsort(narrow, kind="stable")], np.bincount(flat, minlength=side * side)
