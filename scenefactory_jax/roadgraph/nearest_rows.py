"""The nearest of many rows without a sort of all rows.

Rows in storage order are joined to chunks of neighbours, of which only the near ones are looked through. Within these a search finds the
distance below which the wanted number of rows lies.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.roadgraph.queries import find_first_true

CHUNK = 16  # rows; of a polyline with points 1 m apart a piece of 15 m
LEVELS, PASSES = 16, 5  # thresholds that a pass compares with; 16^5 steps are a millionth of the largest squared distance


class Chunks(NamedTuple):
    """Two circles around CHUNK rows in storage order: one for the rows of the first row's polyline, one for the others."""

    centre: Float[Array, "C 2 2"]
    radius: Float[Array, "C 2"]
    valid: Bool[Array, "C 2"]  # it has a valid row


def make_chunks(position: Float[Array, "P 2"], reach: Float[Array, " P"], line: Int[Array, " P"], valid: Bool[Array, " P"]) -> Chunks:
    """Makes the chunks of rows of polylines that extend to `reach` around their positions."""
    padding = -position.shape[0] % CHUNK
    split = lambda table: jnp.pad(table, ((0, padding), *((0, 0),) * (table.ndim - 1))).reshape(-1, 1, CHUNK, *table.shape[1:])  # noqa: E731
    position, reach, line, valid = split(position), split(reach), split(line), split(valid)
    same = line == line[..., :1]
    valid = valid & jnp.concatenate([same, ~same], axis=1)  # [C, 2, CHUNK]
    low = jnp.min(jnp.where(valid[..., None], position, jnp.inf), axis=2)
    high = jnp.max(jnp.where(valid[..., None], position, -jnp.inf), axis=2)
    any_valid = jnp.any(valid, axis=2)
    centre = jnp.where(any_valid[..., None], 0.5 * (low + high), 0.0)
    radius = jnp.max(jnp.where(valid, safe_norm(position - centre[:, :, None]) + reach, 0.0), axis=2)
    return Chunks(centre, radius, any_valid)


def gather_chunks(
    chunks: Chunks, position: Float[Array, "A 2"], near: Bool[Array, "A C 2"], *, count: int, rows: int
) -> tuple[Int[Array, "A M"], Bool[Array, "A M"]]:
    """Gathers the rows of the `count` chunks that are nearest to a position, of those with a circle that is near, in storage order.

    Args:
        rows: of the table.

    Returns:
        Indices of rows, and a mask of those that exist; they may be invalid in the table.
    """
    gap = jnp.maximum(safe_norm(chunks.centre - position[:, None, None]) - chunks.radius, 0.0)
    gap = jnp.min(jnp.where(near & chunks.valid, gap, jnp.inf), axis=2)
    chosen, mask = find_nearest(gap * gap, count=count)
    index = chosen[..., None] * CHUNK + jnp.arange(CHUNK)
    mask = mask[..., None] & (index < rows)
    flat = lambda table: table.reshape(len(position), -1)  # noqa: E731
    return flat(jnp.where(mask, index, 0)), flat(mask)


def find_nearest(squared: Float[Array, "A P"], *, count: int) -> tuple[Int[Array, "A K"], Bool[Array, "A K"]]:
    """Finds the `count` rows with the smallest squared distances, in storage order; inf: not to be found.

    Rows whose squared distances differ by less than a millionth of the largest one count as equally far; of these the first are taken.

    Returns:
        Indices, and a mask of those that exist.
    """
    if squared.shape[1] == 0:
        return jnp.zeros((len(squared), count), jnp.int32), jnp.zeros((len(squared), count), bool)
    if count >= squared.shape[1]:
        return find_first_true(jnp.isfinite(squared), count=count)
    largest = jnp.max(jnp.where(jnp.isfinite(squared), squared, 0.0), axis=1)

    def narrow(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        """Keeps the interval in which the number of nearer rows passes `count`."""
        low, width = bounds
        step = width / LEVELS
        within = [jnp.sum(squared <= (low + level * step)[:, None], axis=1) for level in range(1, LEVELS)]
        place = sum((number < count).astype(jnp.int32) for number in within)
        return low + place * step, step

    low, width = jax.lax.fori_loop(0, PASSES, narrow, (jnp.zeros_like(largest), 1.000001 * largest + 1e-6))
    return find_first_true(squared <= (low + width)[:, None], count=count)


def select_nearest(squared: Float[Array, "A P"], *, count: int) -> tuple[Int[Array, "A K"], Bool[Array, "A K"]]:
    """Selects the `count` rows with the smallest squared distances, nearest first, as `find_nearest`."""
    index, mask = find_nearest(squared, count=count)
    if squared.shape[1] == 0:
        return index, mask
    chosen = jnp.where(mask, jnp.take_along_axis(squared, index, axis=1), jnp.inf)
    order = jnp.argsort(chosen, axis=1)
    return jnp.take_along_axis(index, order, axis=1), jnp.take_along_axis(mask, order, axis=1)
