"""Frozen dataclasses that are JAX pytrees, and what one does with pytrees.

`flax.struct` rebuilds a dataclass through `__init__` when a pytree is unflattened, so a shape check on the fields would see
the tracers, `None`s and batched arrays that `vmap`, `scan` and `eval_shape` put there. Here unflattening bypasses `__init__`:
shapes are checked where people build a value, never where JAX rebuilds one.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

T = TypeVar("T")

replace = dataclasses.replace


def choose(condition: Bool[Array, " rows"], chosen: T, other: T) -> T:
    """Row by row of two pytrees whose leaves all start with the axis of `condition`: agents, or worlds."""

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, chosen, other)


def strong(tree: T) -> T:
    """Cast away weak types: a carried state with one traces its function a second time."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), tree)


def unchecked(kind: type[T], /, **fields: Any) -> T:
    """A struct past its `__init__`, whatever its leaves are: the annotations speak of device arrays, hosts and JAX put others there."""
    value = object.__new__(kind)
    for name, field in fields.items():
        object.__setattr__(value, name, field)
    return value


def static(**options: Any) -> Any:
    """A field that is part of the tree's structure (hashable, no array)."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def struct(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and a pytree; every field not declared `static()` is a child."""
    return pytree(dataclasses.dataclass(frozen=True, eq=False)(cls))


def pytree(cls: type[T]) -> type[T]:
    """Make a frozen dataclass a pytree."""
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
