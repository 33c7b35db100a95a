"""Replay buffers: rings of rows on the device, one for each group of worlds.

Agents differ in number from step to step and worlds are divided over devices, for which neither Brax's nor flashbax's buffers are made:
they store every row of a fixed batch, empty slots with the others, and Brax's joins all arrays in one of one type and moves the whole
ring when it is full. Here rows with a mask are compacted as they are written, so that empty slots take no memory and are never drawn;
groups are the first axis, which a mesh divides as it divides worlds (`TrainState.buffer`), so that any number of devices draws the same
rows.

The next observation is stored with each transition: a slot's next row is not at a fixed distance once rows are compacted.
"""

import os
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core import sharding
from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation

Storage = Literal["float16", "bfloat16", "float32"]


@pytree_dataclass
class Buffer:
    """Rows of `G` groups of worlds."""

    rows: Any  # a pytree of arrays [G, N, ...]
    position: Int[Array, " G"]  # index of the next row that is written
    filled: Int[Array, " G"]  # rows so far, at most N


def make_empty(row: Any, *, groups: int, capacity: int) -> Buffer:
    """Makes a buffer without rows.

    Args:
        row: of one sample, arrays or their shapes.
        capacity: rows of each group.
    """
    rows = jax.tree.map(lambda leaf: jnp.zeros((groups, capacity, *leaf.shape), leaf.dtype), row)
    return Buffer(rows, jnp.zeros(groups, jnp.int32), jnp.zeros(groups, jnp.int32))


def insert(buffer: Buffer, rows: Any, valid: Bool[Array, "T W A"]) -> Buffer:
    """Writes the valid rows `[T, W, A, ...]`, each group those of its worlds, over the oldest ones."""
    groups = len(buffer.position)
    rows, valid = jax.tree.map(lambda leaf: divide_worlds(leaf, groups), (rows, valid))
    return Buffer(*jax.vmap(_write)(buffer.rows, buffer.position, buffer.filled, rows, valid))


def divide_worlds(x: Array, groups: int) -> Array:
    """Divides `[T, W, A, ...]` into `[G, T * W / G * A, ...]`, one group of worlds after the other."""
    time, worlds, agents, *rest = x.shape
    return x.reshape(time, groups, worlds // groups, agents, *rest).swapaxes(0, 1).reshape(groups, -1, *rest)


def _write(rings: Any, position: Int[Array, ""], filled: Int[Array, ""], rows: Any, valid: Bool[Array, " M"]) -> tuple[Any, Array, Array]:
    """Writes the valid rows of one group."""
    capacity = jax.tree.leaves(rings)[0].shape[0]
    rank, count = jnp.cumsum(valid) - 1, jnp.sum(valid, dtype=jnp.int32)
    outside = capacity + jnp.arange(len(valid))  # indices that the scatter drops, each its own
    index = jnp.where(valid, (position + rank) % capacity, outside)
    rings = jax.tree.map(lambda ring, new: ring.at[index].set(new, mode="drop", unique_indices=True), rings, rows)
    return rings, (position + count) % capacity, jnp.minimum(filled + count, capacity)


def sample(buffer: Buffer, key: PRNGKeyArray, size: int, *, axis: str | None) -> tuple[Any, Float[Array, "G size"]]:
    """Draws `size` rows of each group uniformly, with replacement; those of an empty group have the weight 0, all others 1.

    Args:
        axis: mesh axis of the devices that share the groups.
    """

    def draw(key: PRNGKeyArray, rows: Any, filled: Int[Array, ""]) -> Any:
        index = jax.random.randint(key, (size,), 0, jnp.maximum(filled, 1))
        return jax.tree.map(lambda ring: ring.at[index].get(mode="promise_in_bounds"), rows)

    rows = jax.vmap(draw)(sharding.world_keys(key, len(buffer.filled), axis), buffer.rows, buffer.filled)
    return rows, jnp.broadcast_to((buffer.filled > 0).astype(jnp.float32)[:, None], (len(buffer.filled), size))


def count_rows(buffer: Buffer, *, axis: str | None) -> Int[Array, ""]:
    """Counts the rows of all devices."""
    return sharding.sum_over_devices(jnp.sum(buffer.filled), axis)


def regroup(stored: Mapping[str, np.ndarray], groups: int, capacity: int) -> dict[str, np.ndarray]:
    """Deals the rows of a stored buffer to another number of groups, on the host; the oldest are left out where they do not fit.

    Args:
        stored: the buffer's arrays by their paths, `position`, `filled` and the rows [G, N, ...].
        groups, capacity: numbers of the new groups and of the rows of each.
    """
    position, filled = stored["position"], stored["filled"]
    size = next(leaf.shape[1] for leaf in stored.values() if leaf.ndim > 1)
    age = np.concatenate([np.arange(count) for count in filled])  # 0: a group's newest row
    group = np.repeat(np.arange(len(filled)), filled)
    newest_first = np.lexsort((group, age))[: groups * capacity]
    group, row = group[newest_first], (position[group] - 1 - age)[newest_first] % size
    counts = np.bincount(np.arange(len(row)) % groups, minlength=groups).astype(np.int32)
    now = np.arange(len(row)) % groups, counts[np.arange(len(row)) % groups] - 1 - np.arange(len(row)) // groups

    def deal(leaf: np.ndarray) -> np.ndarray:
        made = np.zeros((groups, capacity, *leaf.shape[2:]), leaf.dtype)
        made[now] = leaf[group, row]
        return made

    rows = {name: deal(leaf) for name, leaf in stored.items() if name not in ("position", "filled")}
    return {**rows, "position": counts % np.int32(capacity), "filled": counts}


def compress(observation: Observation, storage: Storage) -> Observation:
    """Converts the numbers of an observation to the type that is stored; numbers beyond its range become its largest ones."""
    kind = jnp.dtype(storage)
    bound = float(jnp.finfo(kind).max)

    def convert(leaf: Array) -> Array:
        return jnp.clip(leaf, -bound, bound).astype(kind) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(convert, observation)


def expand(observation: Observation) -> Observation:
    """Converts the numbers of a stored observation back to float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, observation)


def find_finite_rows(rows: Any, valid: Bool[Array, "T W A"]) -> Bool[Array, "T W A"]:
    """Mask of the valid rows whose numbers are all finite: a ring would return others again and again."""
    for leaf in jax.tree.leaves(rows):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            valid &= jnp.all(jnp.isfinite(leaf), axis=tuple(range(valid.ndim, leaf.ndim)))
    return valid


def check_memory(row: Any, rows: int, *, devices: int, taken: int = 0, key: str) -> int:
    """Checks that the rows of a device fit into its memory; returns how many bytes they take.

    Args:
        row: as of `make_empty`.
        rows: of all devices.
        taken: bytes of other buffers on each device.
        key: of the config, for the message.

    Raises:
        ConfigError: naming the size and the number that fits.
    """
    size = sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(row))
    free, needed = max(measure_free_memory() - taken, 0), size * rows // devices
    if needed > free:
        fits = free // size * devices
        raise ConfigError(
            f"{key}: {rows:,} transitions of {size / 1e3:.3g} kB take {needed / 1e9:.3g} GB of a device's memory, of which"
            f" {free / 1e9:.3g} GB are free: at most {fits:,} fit; take fewer, or a smaller learner.storage"
        )
    return needed


def measure_free_memory() -> int:
    """Measures the free memory of the first device in bytes; a CPU's is the machine's memory."""
    stats = jax.local_devices()[0].memory_stats()
    if not stats or "bytes_limit" not in stats:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
