"""Bounds of an observation's columns, the scaling of lengths without an upper bound, and sets of a fixed number of rows."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.types import SetObservation

ANY, LENGTH, SIGNED, FRACTION = (-jnp.inf, jnp.inf), (0.0, jnp.inf), (-1.0, 1.0), (0.0, 1.0)  # (low, high) of a column


def bound_observation(*columns: tuple[float, float]) -> Callable[[Callable], Callable]:
    """Declares the bounds of a group's columns for interfaces that ask for them (`adapters.bounds`); the last hold for all that follow.

    A group without this decorator is unbounded.
    """

    def declare(group: Callable) -> Callable:
        group.columns = columns  # pyright: ignore[reportFunctionMemberAccess]
        return group

    return declare


def compress_length(length: Float[Array, "*n"], scale: float) -> Float[Array, "*n"]:
    """Computes l / (scale + |l|), so that a metre beside the car counts as much as ten far away; the limit where l is infinite."""
    finite = jnp.where(jnp.isinf(length), 0.0, length)
    return jnp.where(jnp.isinf(length), jnp.sign(length), finite / (scale + jnp.abs(finite)))


def pad_rows(features: Float[Array, "A N F"], mask: Bool[Array, "A N"], count: int) -> SetObservation:
    """Pads to `count` rows, with zeros where the mask is false."""
    padding = count - mask.shape[1]
    features = jnp.where(mask[..., None], features, 0.0)
    return SetObservation(jnp.pad(features, ((0, 0), (0, padding), (0, 0))), jnp.pad(mask, ((0, 0), (0, padding))))
