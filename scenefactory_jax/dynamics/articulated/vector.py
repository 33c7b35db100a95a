"""Vectors with scalar components, for the car's mechanics.

XLA cannot fuse across the stacks and slices of arrays with an axis of three; arithmetic on scalars fuses. A component may have an axis of
wheels and broadcasts: `cross(rate, hub)` combines one angular velocity with four positions.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from scenefactory_jax.core.geometry import safe_sqrt
from scenefactory_jax.core.pytree import pytree_dataclass

Number = Any  # an array, [] per car or [4] per wheel; a float if it comes from the reference car


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


def sum_vectors(vector: Vector) -> Vector:
    """Computes the sum of the four wheels' vectors."""
    return Vector(*(sum_wheels(part) for part in vector))


def sum_wheels(number: Number) -> Number:
    """Computes the sum over the four wheels. Added slices fuse; a reduction is a kernel of its own."""
    number = jnp.asarray(number)
    return number[0] + number[1] + number[2] + number[3]


def length(*parts: Number) -> Array:
    """Computes the Euclidean length; the gradient at zero is zero instead of NaN."""
    return safe_sqrt(jnp.asarray(sum(part * part for part in parts)))
