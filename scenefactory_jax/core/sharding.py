"""Shards worlds over devices: partition specs, sums over devices, and random keys that do not depend on the number of devices.

`axis` is the mesh's axis inside `shard_map`, where each device has its own worlds; None: one device has them all.
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
    """Sums every leaf over the devices."""
    return tree if axis is None else jax.lax.psum(tree, axis)


def gather_over_devices(tree: Tree, axis: str | None) -> Tree:
    """Concatenates the rows of all devices, on every device."""
    return tree if axis is None else jax.lax.all_gather(tree, axis, tiled=True)


def to_local_index(rows: Int[Array, " N"], count: int, axis: str | None) -> Int[Array, " N"]:
    """Converts indices of all worlds to indices of this device's `count` worlds; others become `count`, which a scatter can drop."""
    here = rows if axis is None else rows - jax.lax.axis_index(axis) * count
    return jnp.where((here >= 0) & (here < count), here, count)


def world_keys(key: PRNGKeyArray, count: int, axis: str | None) -> Key[Array, " {count}"]:
    """Makes a key for each of this device's `count` worlds (or groups of worlds), by its index among all."""
    first = 0 if axis is None else jax.lax.axis_index(axis) * count
    return jax.vmap(jax.random.fold_in, (None, 0))(key, first + jnp.arange(count))


def make_sharded_specs(tree: Any) -> Any:
    """Partition specs of a tree whose leaves all have worlds along their first axis."""
    return jax.tree.map(lambda _: PartitionSpec(AXIS), tree)


def make_replicated_specs(tree: Any) -> Any:
    """Partition specs of a tree that every device has a copy of."""
    return jax.tree.map(lambda _: PartitionSpec(), tree)


def map_over_devices(run: Callable, arguments: Sequence[tuple[Any, Any]], make_specs: Callable[[Any], Any], mesh: Mesh) -> Any:
    """Runs a function on every device with its part of the arguments, by `jax.shard_map`.

    Arrays without elements are left out: the partitioner of JAX 0.11 crashes on them.

    Args:
        arguments: trees with their partition specs.
        make_specs: computes the specs of the result.
    """
    given = [_filled(tree, specs) for tree, specs in arguments]
    returned = []

    def each(*leaves: list[Array]) -> tuple[list[Array], list[Array]]:
        parts = (one.refill(own, lambda rows: rows // mesh.size) for one, own in zip(given, leaves, strict=True))
        found = run(*parts)
        returned.append(_filled(found, make_specs(found)))
        pairs = list(zip(returned[-1].leaves, returned[-1].specs, strict=True))
        return [leaf for leaf, spot in pairs if AXIS in spot], [leaf for leaf, spot in pairs if AXIS not in spot]

    out_specs = (PartitionSpec(AXIS), PartitionSpec())
    mapped = jax.shard_map(each, mesh=mesh, in_specs=tuple(one.specs for one in given), out_specs=out_specs, check_vma=False)
    shared, whole = map(iter, mapped(*(one.leaves for one in given)))
    leaves = [next(shared if AXIS in spot else whole) for spot in returned[-1].specs]
    return returned[-1].refill(leaves, lambda rows: rows * mesh.size)


class _Filled(NamedTuple):
    """The leaves of a tree that have elements, with their specs, and the function that rebuilds the tree."""

    leaves: list[Array]
    specs: list[PartitionSpec]
    refill: Callable[[list[Array], Callable[[int], int]], Any]  # (leaves, map of the number of sharded rows)


def _filled(tree: Any, specs: Any) -> _Filled:
    leaves, form = jax.tree.flatten(tree)
    spots = form.flatten_up_to(specs)
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
    """Makes a mesh of the first `count` devices of all processes (None: all); None for a single device.

    Raises:
        ConfigError: more devices than there are.
    """
    devices = jax.devices()
    if count is not None and not 1 <= count <= len(devices):
        raise ConfigError(f"devices: {count}; there are {len(devices)} ({devices[0].device_kind})")
    chosen = devices[:count]
    return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def place_on_devices(scenes: Tree, mesh: Mesh | None) -> Tree:
    """Places arrays on the devices, divided along their first axis; every process has all arrays and places its part."""
    if mesh is None:
        return jax.device_put(scenes)

    def put(leaf: np.ndarray) -> jax.Array:
        # `jit` returns empty arrays replicated: placed otherwise, they would make the next program compile twice
        sharding = NamedSharding(mesh, PartitionSpec(AXIS) if leaf.size else PartitionSpec())
        return jax.make_array_from_callback(leaf.shape, sharding, lambda part: np.asarray(leaf)[part])

    return jax.tree.map(put, scenes)
