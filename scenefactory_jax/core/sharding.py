"""Worlds shared out among devices: where they lie, sums over all of them, and random keys that do not depend on how many there are.

`axis` is the mesh's axis inside `shard_map`, where each device sees its own worlds; None: one device sees them all.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, Key, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError

AXIS = "worlds"
Tree = TypeVar("Tree")


def sum_over_devices(tree: Tree, axis: str | None) -> Tree:
    """Sums over the devices, of every leaf."""
    return tree if axis is None else jax.lax.psum(tree, axis)


def gather_over_devices(tree: Tree, axis: str | None) -> Tree:
    """Rows of all devices one after the other, on every device."""
    return tree if axis is None else jax.lax.all_gather(tree, axis, tiled=True)


def to_local_index(rows: Int[Array, " N"], count: int, axis: str | None) -> Int[Array, " N"]:
    """Numbers among all worlds -> among this device's `count` worlds; `count` for the worlds of others, which a scatter can drop."""
    here = rows if axis is None else rows - jax.lax.axis_index(axis) * count
    return jnp.where((here >= 0) & (here < count), here, count)


def world_keys(key: PRNGKeyArray, count: int, axis: str | None) -> Key[Array, " {count}"]:
    """A key for each of this device's `count` worlds (or groups of them), by its number among all of them."""
    first = 0 if axis is None else jax.lax.axis_index(axis) * count
    return jax.vmap(jax.random.fold_in, (None, 0))(key, first + jnp.arange(count))


def make_sharded_specs(tree: Any) -> Any:
    """Places of a tree whose leaves all have worlds along their first axis."""
    return jax.tree.map(lambda _: PartitionSpec(AXIS), tree)


def make_replicated_specs(tree: Any) -> Any:
    """Places of a tree that every device holds whole."""
    return jax.tree.map(lambda _: PartitionSpec(), tree)


def map_over_devices(run: Callable, arguments: Sequence[tuple[Any, Any]], places: Callable[[Any], Any], over: Mesh) -> Any:
    """`jax.shard_map` from trees onto a tree: `run` on every device with its part of the arguments.

    Arrays without elements stay outside: the partitioner of JAX 0.11 crashes on them.

    Args:
        arguments: trees, and where their leaves lie.
        places: where the leaves of what `run` returns lie.
    """
    given = [_filled(tree, spots) for tree, spots in arguments]
    returned = []

    def each(*leaves: list[Array]) -> tuple[list[Array], list[Array]]:
        parts = (one.refill(own, lambda rows: rows // over.size) for one, own in zip(given, leaves, strict=True))
        found = run(*parts)
        returned.append(_filled(found, places(found)))
        pairs = list(zip(returned[-1].leaves, returned[-1].places, strict=True))
        return [leaf for leaf, spot in pairs if AXIS in spot], [leaf for leaf, spot in pairs if AXIS not in spot]

    specs = (PartitionSpec(AXIS), PartitionSpec())
    mapped = jax.shard_map(each, mesh=over, in_specs=tuple(one.places for one in given), out_specs=specs, check_vma=False)
    shared, whole = map(iter, mapped(*(one.leaves for one in given)))
    leaves = [next(shared if AXIS in spot else whole) for spot in returned[-1].places]
    return returned[-1].refill(leaves, lambda rows: rows * over.size)


class _Filled(NamedTuple):
    """The leaves of a tree that hold anything, where they lie, and the way back to the tree."""

    leaves: list[Array]
    places: list[PartitionSpec]
    refill: Callable[[list[Array], Callable[[int], int]], Any]  # from such leaves, and what becomes of the number of rows that lie apart


def _filled(tree: Any, places: Any) -> _Filled:
    leaves, form = jax.tree.flatten(tree)
    spots = form.flatten_up_to(places)
    full = [bool(leaf.size) for leaf in leaves]
    shapes = [(leaf.shape, leaf.dtype) for leaf in leaves]

    def refill(values: list[Array], rows: Callable[[int], int]) -> Any:
        remaining = iter(values)

        def empty(shape: tuple[int, ...], dtype: Any, spot: PartitionSpec) -> Array:
            return jnp.zeros((rows(shape[0]), *shape[1:]) if AXIS in spot else shape, dtype)

        known = zip(full, shapes, spots, strict=True)
        return form.unflatten([next(remaining) if holds else empty(*kind, spot) for holds, kind, spot in known])

    kept = [index for index, holds in enumerate(full) if holds]
    return _Filled([leaves[index] for index in kept], [spots[index] for index in kept], refill)


def make_mesh(count: int | None = None) -> Mesh | None:
    """The first `count` devices of all processes (None: all of them) in a row; None for a single one, which needs no mesh.

    Raises:
        ConfigError: more than there are.
    """
    devices = jax.devices()
    if count is not None and not 1 <= count <= len(devices):
        raise ConfigError(f"devices: {count}; there are {len(devices)} ({devices[0].device_kind})")
    chosen = devices[:count]
    return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def place_on_devices(scenes: Tree, over: Mesh | None) -> Tree:
    """Arrays onto the devices, by their first axis; every process holds all of them and gives away its part."""
    if over is None:
        return jax.device_put(scenes)

    def put(leaf: np.ndarray) -> jax.Array:
        # what is empty comes back from `jit` as held by everybody: put elsewhere, it would compile the next program a second time
        sharding = NamedSharding(over, PartitionSpec(AXIS) if leaf.size else PartitionSpec())
        return jax.make_array_from_callback(leaf.shape, sharding, lambda part: np.asarray(leaf)[part])

    return jax.tree.map(put, scenes)
