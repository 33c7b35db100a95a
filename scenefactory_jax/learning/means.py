"""Means over samples with weights, on one device or several."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core import sharding


def partial_mean(x: Float[Array, "*batch"], *, weight: Float[Array, "*batch"], total: Float[Array, ""]) -> Float[Array, ""]:
    """Computes the summand of these samples in a weighted mean over the weight `total`; values without weight may be anything, even NaN."""
    return jnp.sum(jnp.where(weight > 0.0, x * weight, 0.0)) / jnp.maximum(total, 1e-8)


def weighted_mean(x: Float[Array, "*batch"], weight: Float[Array, "*batch"], *, axis: str | None = None) -> Float[Array, ""]:
    """Computes the weighted mean over all devices; zero if there is no weight."""
    return sharding.sum_over_devices(partial_mean(x, weight=weight, total=sharding.sum_over_devices(jnp.sum(weight), axis)), axis)
