"""Vectors in the plane with scalar components, and choices among a few values.

XLA cannot fuse across the stacks, slices and reductions of arrays with an axis of two or four; arithmetic on scalars fuses.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.pytree import pytree_dataclass

Number = Any  # an array, or a float
T = TypeVar("T")


@pytree_dataclass
class Planar:
    """A vector of the plane."""

    x: Number
    y: Number

    @classmethod
    def read(cls, array: Float[Array, "*n 2"]) -> "Planar":
        """Takes the components from the last axis."""
        return cls(array[..., 0], array[..., 1])

    def stack(self) -> Float[Array, "*n 2"]:
        """Puts the components into a last axis."""
        return jnp.stack([self.x, self.y], axis=-1)

    def __add__(self, other: "Planar") -> "Planar":
        return Planar(self.x + other.x, self.y + other.y)

    def __sub__(self, other: "Planar") -> "Planar":
        return Planar(self.x - other.x, self.y - other.y)

    def __mul__(self, factor: Number) -> "Planar":
        return Planar(self.x * factor, self.y * factor)

    def __neg__(self) -> "Planar":
        return Planar(-self.x, -self.y)


def dot(a: Planar, b: Planar) -> Number:
    """Inner product."""
    return a.x * b.x + a.y * b.y


def cross(a: Planar, b: Planar) -> Number:
    """The z component of the vector product."""
    return a.x * b.y - a.y * b.x


def rotate_90(a: Planar) -> Planar:
    """Rotates by 90 degrees counter-clockwise."""
    return Planar(-a.y, a.x)


def select(condition: Bool[Array, "*n"], chosen: T, other: T) -> T:
    """Selects one of two numbers, vectors or tuples of these."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, other)


def pick(index: Int[Array, "*n"], values: Sequence[T]) -> T:
    """Picks one of a few values; the last for an index beyond them."""
    found = values[-1]
    for row in reversed(range(len(values) - 1)):
        found = select(index == row, values[row], found)
    return found


def find_largest(values: Sequence[Number]) -> Int[Array, "*n"]:
    """Finds the index of the largest value, of the first one if several are."""
    best, index = values[0], jnp.zeros(jnp.shape(values[0]), jnp.int32)
    for row, value in enumerate(values[1:], 1):
        larger = value > best
        best, index = jnp.where(larger, value, best), jnp.where(larger, row, index)
    return index


def find_any(values: Sequence[Bool[Array, "*n"]]) -> Bool[Array, "*n"]:
    """Whether any of a few values is true."""
    return functools.reduce(operator.or_, values)


def find_all(values: Sequence[Bool[Array, "*n"]]) -> Bool[Array, "*n"]:
    """Whether all of a few values are true."""
    return functools.reduce(operator.and_, values)
