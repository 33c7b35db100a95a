"""Frozen dataclasses that are JAX pytrees, and operations on pytrees.

`flax.struct` rebuilds a dataclass through `__init__` when a pytree is unflattened, so a shape check on the fields would see
the tracers, `None`s and batched arrays of `vmap`, `scan` and `eval_shape`. Here unflattening bypasses `__init__`: shapes are checked where
code builds a value, never where JAX rebuilds one.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Iterable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool

T = TypeVar("T")

replace = dataclasses.replace

LARGEST = 1e12  # above any length, speed or force of a car; float32 squares overflow at 3e38
KINDS = {"float": jnp.floating, "int": jnp.integer, "bool": jnp.bool_}


def tree_where(condition: Bool[Array, " rows"], chosen: T, other: T) -> T:
    """Selects rows of two pytrees whose leaves all start with the axis of `condition`: agents, or worlds."""

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, chosen, other)


def is_finite(tree: Any) -> Bool[Array, " rows"]:
    """Mask of the rows of a pytree, whose leaves all start with the same axis, in which every number and its square are finite."""
    columns = [(jnp.abs(leaf) < LARGEST).reshape(len(leaf), math.prod(leaf.shape[1:])) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.concatenate(columns, axis=1), axis=1)


def to_jax(tree: T) -> T:
    """Converts leaves to JAX arrays, also numpy arrays inside the tracers of `vmap`, on which `custom_jvp` fails: a copy converts them.

    Compiled, a copy is no operation.
    """
    return jax.tree.map(lambda leaf: jnp.copy(leaf) if isinstance(leaf, Tracer) else jnp.asarray(leaf), tree)


def check(value: Any, kind: type, *, where: str, sizes: dict[str, int | None]) -> None:
    """Checks shape and kind of number of a struct's fields against their annotations. Only shapes and dtypes are read.

    Args:
        where: name of the value, for the ValueError.
        sizes: axis -> size, None if it is not known yet; unknown sizes are filled in. These axes have one size in all parts of the value,
            other axes have their own in each part.
    """
    if not isinstance(value, kind):
        raise ValueError(f"{where}: expected a {kind.__name__}, got {type(value).__name__}")
    local_sizes: dict[str, int | None] = {}
    for entry in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        leaf, expected = getattr(value, entry.name, None), entry.type
        if isinstance(expected, types.UnionType):  # a part that may be missing
            expected = None if leaf is None else typing.get_args(expected)[0]
        if dataclasses.is_dataclass(expected):
            check(leaf, expected, where=f"{where}.{entry.name}", sizes=sizes)  # pyright: ignore[reportArgumentType]
        elif hasattr(expected, "dim_str"):
            check_array(leaf, expected, where=f"{where}.{entry.name}", sizes=sizes, local_sizes=local_sizes)


def check_array(
    leaf: Any, expected: Any, *, where: str, sizes: dict[str, int | None], local_sizes: dict[str, int | None] | None = None
) -> None:  # fmt: skip
    """Checks one array, as `check`; `local_sizes`: sizes of the axes that `sizes` does not name."""
    local_sizes, axes = {} if local_sizes is None else local_sizes, expected.dim_str.split()
    kind = next(kind for kind in KINDS if expected.dtypes[0].startswith(kind))
    if leaf is None:
        raise ValueError(f"{where}: missing; expected {kind} of shape {_format_shape(axes)}")
    shape, dtype = jnp.shape(leaf), jnp.result_type(leaf)
    known = [int(axis) if axis.isdigit() else (sizes if axis in sizes else local_sizes).get(axis) for axis in axes]
    if len(shape) != len(axes) or any(size not in (None, actual) for size, actual in zip(known, shape, strict=True)):
        worlds = "; for many worlds map over them with jax.vmap" if len(shape) == len(axes) + 1 else ""
        expected_shape = [axis if size is None else size for axis, size in zip(axes, known, strict=True)]
        raise ValueError(f"{where}: expected shape {_format_shape(expected_shape)}, got {_format_shape(shape)}{worlds}")
    if not jnp.issubdtype(dtype, KINDS[kind]):
        raise ValueError(f"{where}: expected {kind}, got {dtype}")
    for axis, size in zip(axes, shape, strict=True):
        (sizes if axis in sizes else local_sizes)[axis] = size


def _format_shape(shape: Iterable[Any]) -> str:
    return f"({', '.join(map(str, shape))})"


def to_strong_type(tree: T) -> T:
    """Removes weak types, with which a carried state would make its function trace twice."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tree)


def unchecked(kind: type[T], /, **fields: Any) -> T:
    """Builds a struct without `__init__` and its checks, for leaves of other kinds than the annotations say."""
    value = object.__new__(kind)
    for name, field in fields.items():
        object.__setattr__(value, name, field)
    return value


def static(**options: Any) -> Any:
    """A field that is part of the tree's structure (hashable, no array)."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Makes `cls` a frozen dataclass and a pytree; every field that is not `static()` is a child."""
    return pytree(dataclasses.dataclass(frozen=True, eq=False)(cls))


def pytree(cls: type[T]) -> type[T]:
    """Makes a frozen dataclass a pytree."""
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    data = [f.name for f in fields if not f.metadata.get("static")]
    meta = [f.name for f in fields if f.metadata.get("static")]

    def flatten_with_keys(value: T):
        children = [(jax.tree_util.GetAttrKey(name), getattr(value, name)) for name in data]
        return children, tuple(getattr(value, name) for name in meta)

    def flatten(value: T):
        return [getattr(value, name) for name in data], tuple(getattr(value, name) for name in meta)

    def unflatten(aux: Iterable[Any], children: Iterable[Any]) -> T:
        return unchecked(cls, **dict(zip(data, children, strict=True)), **dict(zip(meta, aux, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
