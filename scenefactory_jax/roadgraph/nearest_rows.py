"""The nearest of many rows without a sort: a search for the distance within which they lie, then a gather."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.roadgraph.queries import find_first_true

LEVELS, PASSES = 16, 5  # thresholds that a pass compares with; 16^5 steps are a millionth of the largest squared distance


def select_nearest(squared: Float[Array, "A P"], *, count: int) -> tuple[Int[Array, "A K"], Bool[Array, "A K"]]:
    """Selects the `count` rows with the smallest squared distances, nearest first; inf: not to be selected.

    Rows whose squared distances differ by less than a millionth of the largest one count as equally far; of these the first are taken.

    Returns:
        Indices, and a mask of those that exist.
    """
    count_all = squared.shape[1]
    if count >= count_all:
        order = jnp.argsort(squared, axis=1)
        order = jnp.pad(order, ((0, 0), (0, count - count_all)))
        sorted_squared = jnp.take_along_axis(squared, order, axis=1) if count_all else jnp.zeros(order.shape)
        mask = (jnp.arange(count) < count_all) & jnp.isfinite(sorted_squared)
        return jnp.where(mask, order, 0), mask
    largest = jnp.max(jnp.where(jnp.isfinite(squared), squared, 0.0), axis=1)
    low, width = jnp.zeros_like(largest), 1.000001 * largest + 1e-6

    def narrow(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        """Keeps the interval in which the number of nearer rows passes `count`."""
        low, width = bounds
        step = width / LEVELS
        within = [jnp.sum(squared <= (low + level * step)[:, None], axis=1) for level in range(1, LEVELS)]
        place = sum((number < count).astype(jnp.int32) for number in within)
        return low + place * step, step

    low, width = jax.lax.fori_loop(0, PASSES, narrow, (low, width))
    index, mask = find_first_true(squared <= (low + width)[:, None], count=count)
    chosen = jnp.where(mask, jnp.take_along_axis(squared, index, axis=1), jnp.inf)
    order = jnp.argsort(chosen, axis=1)
    return jnp.take_along_axis(index, order, axis=1), jnp.take_along_axis(mask, order, axis=1)
