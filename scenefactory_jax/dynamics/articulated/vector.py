"""Vectors whose components are single numbers: what a car's mechanics is written in.

An array with an axis of three would cut XLA's loops at every stack and slice; arithmetic on numbers fuses. A component may have an axis of
wheels, and broadcasts: `cross(rate, hub)` is of one angular velocity and four places.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from scenefactory_jax.core.geometry import safe_sqrt
from scenefactory_jax.core.pytree import pytree_dataclass

Number = Any  # an array, [] of a car or [4] of its wheels; plain where it comes from the reference car alone


@pytree_dataclass
class Vector:
    """Along a car's axes: forward, left, up."""

    x: Number
    y: Number
    z: Number

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vector") -> "Vector":
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, factor: Number) -> "Vector":
        return Vector(self.x * factor, self.y * factor, self.z * factor)

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def __getitem__(self, axis: int) -> Number:
        return (self.x, self.y, self.z)[axis]

    def __iter__(self) -> Iterator[Number]:
        return iter((self.x, self.y, self.z))


def dot(a: Vector, b: Vector) -> Number:
    """Inner product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def wheels(vector: Vector) -> Vector:
    """Sum over the four wheels. Slices that are added fuse; a reduction is a kernel of its own."""
    return Vector(*(over_wheels(part) for part in vector))


def over_wheels(number: Number) -> Number:
    """Sum over the four wheels of a number that each of them has."""
    number = jnp.asarray(number)
    return number[0] + number[1] + number[2] + number[3]


def length(*parts: Number) -> Array:
    """Euclidean length of components; its gradient at zero is zero instead of NaN."""
    return safe_sqrt(jnp.asarray(sum(part * part for part in parts)))
