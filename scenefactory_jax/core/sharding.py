"""Shards worlds over devices: partition specs, sums over devices, and random keys that do not depend on the number of devices.

`axis` is the mesh's axis inside `shard_map`, where each device has its own worlds; None: one device has them all.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding
from jaxtyping import Array, Int, Key, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError

AXIS = "worlds"
Tree = TypeVar("Tree")
Specs = Callable[[Any], Any]


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


def map_over_devices(run: Callable, trees: Sequence[Any], in_specs: Sequence[Specs], out_specs: Specs, mesh: Mesh | None) -> Any:
    """Runs a function on every device with its part of the trees, by `jax.shard_map`; without a mesh it is called as it is.

    Arrays without elements are left out: the partitioner of JAX 0.11 crashes on them.

    Args:
        in_specs, out_specs: functions that compute the partition specs of each tree and of the result.
    """
    if mesh is None:
        return run(*trees)
    devices = mesh.size
    parts = [_describe(tree, specs(tree), lambda rows: rows // devices) for tree, specs in zip(trees, in_specs, strict=True)]
    full = [jax.tree.map(lambda leaf: leaf if leaf.size else None, tree) for tree in trees]
    results = []

    def each(*leaves: Any) -> tuple[Any, Any]:
        result = run(*map(_fill, leaves, parts))
        specs = out_specs(result)
        results.append(_describe(result, specs, lambda rows: rows * mesh.size))
        keep = lambda sharded: lambda leaf, spec: leaf if leaf.size and (AXIS in spec) == sharded else None  # noqa: E731
        return jax.tree.map(keep(True), result, specs), jax.tree.map(keep(False), result, specs)

    specs_of_parts = tuple(specs(tree) for specs, tree in zip(in_specs, full, strict=True))
    mapped = jax.shard_map(each, mesh=mesh, in_specs=specs_of_parts, out_specs=(PartitionSpec(AXIS), PartitionSpec()), check_vma=False)
    sharded, replicated = mapped(*full)
    return _fill(jax.tree.map(lambda one, other: other if one is None else one, sharded, replicated, is_leaf=_is_none), results[-1])


def _describe(tree: Any, specs: Any, count: Callable[[int], int]) -> Any:
    """Shapes and types of a tree whose sharded arrays have `count(rows)` rows."""

    def describe(leaf: Array, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((count(leaf.shape[0]), *leaf.shape[1:]) if AXIS in spec else leaf.shape, leaf.dtype)

    return jax.tree.map(describe, tree, specs)


def _fill(tree: Any, shapes: Any) -> Any:
    """Puts arrays without elements where a tree has None instead."""
    fill = lambda leaf, shape: jnp.zeros(shape.shape, shape.dtype) if leaf is None and shape is not None else leaf  # noqa: E731
    return jax.tree.map(fill, tree, shapes, is_leaf=_is_none)


def _is_none(leaf: Any) -> bool:
    return leaf is None


def make_mesh(count: int | None = None) -> Mesh | None:
    """Makes a mesh of the first `count` devices of all processes (None: all); None for a single device.

    Raises:
        ConfigError: more devices than there are, or of several processes not all.
    """
    devices = jax.devices()
    if count is not None and not 1 <= count <= len(devices):
        raise ConfigError(f"devices: {count}; there are {len(devices)} ({devices[0].device_kind})")
    if count not in (None, len(devices)) and jax.process_count() > 1:
        raise ConfigError(f"devices: expected null, all {len(devices)} of {jax.process_count()} processes, got {count}")
    chosen = devices[:count]
    return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def place_on_devices(scenes: Tree, mesh: Mesh | None) -> Tree:
    """Places arrays on the devices, divided along their first axis; every process has all arrays and places its part."""
    if mesh is None:
        return jax.device_put(scenes)
    # `jit` returns empty arrays replicated: placed otherwise, they would make the next program compile twice
    spec = lambda leaf: PartitionSpec(AXIS) if leaf.size else PartitionSpec()  # noqa: E731
    return jax.tree.map(lambda leaf: place(np.asarray(leaf), NamedSharding(mesh, spec(leaf))), scenes)


def place(value: np.ndarray, to: Sharding) -> jax.Array:
    """Places an array that every process has; each places the part of its devices."""
    return jax.make_array_from_callback(value.shape, to, lambda part: value[part])


def fetch(tree: Any) -> Any:
    """Copies arrays to the host, in every process; parts on devices of other processes are gathered, one array after the other."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    return jax.tree.map(lambda leaf: np.asarray(leaf if leaf.is_fully_addressable else _gather(leaf)), tree)


def _gather(leaf: Array) -> Array:
    if leaf.is_fully_replicated:
        return leaf
    assert isinstance(leaf.sharding, NamedSharding)
    everywhere = NamedSharding(leaf.sharding.mesh, PartitionSpec())
    return jax.jit(lambda x: x, out_shardings=everywhere)(leaf)
