"""Diagonal Gaussians over actions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def sample(key: PRNGKeyArray, mean: Float[Array, "*batch D"], log_std: Float[Array, " D"]) -> Float[Array, "*batch D"]:
    """Samples actions; where a deviation is 0 (its logarithm -inf), the mean."""
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def log_probability(
    action: Float[Array, "*batch D"], mean: Float[Array, "*batch D"], log_std: Float[Array, " D"]
) -> Float[Array, "*batch"]:
    """Computes the log density of an action, before any clipping."""
    z = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(z**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)


def entropy(log_std: Float[Array, " D"]) -> Float[Array, ""]:
    """Computes the differential entropy, nats."""
    return jnp.sum(log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))


def kl_divergence(
    mean_old: Float[Array, "*batch D"], log_std_old: Float[Array, " D"], mean: Float[Array, "*batch D"], log_std: Float[Array, " D"]
) -> Float[Array, "*batch"]:
    """Computes KL(old || new), nats."""
    variance_ratio = jnp.exp(2.0 * (log_std_old - log_std))
    shift = (mean_old - mean) * jnp.exp(-log_std)
    return 0.5 * jnp.sum(variance_ratio + shift**2 - 1.0 - 2.0 * (log_std_old - log_std), axis=-1)
