"""Diagonal Gaussians over actions, and their images under tanh."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

EDGE = 1e-3  # distance of a squashed action from -1 and 1, nearer to which its density is that at this distance: it has no bound there


def sample(key: PRNGKeyArray, mean: Float[Array, "*batch D"], log_std: Float[Array, "*#batch D"]) -> Float[Array, "*batch D"]:
    """Samples actions; where a deviation is 0 (its logarithm -inf), the mean."""
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def log_probability(
    action: Float[Array, "*batch D"], mean: Float[Array, "*batch D"], log_std: Float[Array, "*#batch D"]
) -> Float[Array, "*batch"]:
    """Computes the log density of an action, before any clipping."""
    z = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(z**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)


def clipped_log_probability(
    action: Float[Array, "*batch D"], mean: Float[Array, "*batch D"], log_std: Float[Array, "*#batch D"]
) -> Float[Array, "*batch"]:
    """Computes the log probability of an action after its clipping to [-1, 1]: inside a density, at the edges of all that lies beyond.

    The entropy of what is made has a bound, as that of the Gaussian does not.
    """
    inverse = jnp.exp(-log_std)
    inside = -0.5 * (((action - mean) * inverse) ** 2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi))
    below, above = jax.scipy.special.log_ndtr((-1.0 - mean) * inverse), jax.scipy.special.log_ndtr((mean - 1.0) * inverse)
    return jnp.sum(jnp.where(action <= -1.0, below, jnp.where(action >= 1.0, above, inside)), axis=-1)


def entropy(log_std: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
    """Computes the differential entropy, nats."""
    return jnp.sum(log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e), axis=-1)


def kl_divergence(
    mean_old: Float[Array, "*batch D"],
    log_std_old: Float[Array, "*#batch D"],
    mean: Float[Array, "*batch D"],
    log_std: Float[Array, "*#batch D"],
) -> Float[Array, "*batch"]:
    """Computes KL(old || new), nats."""
    variance_ratio = jnp.exp(2.0 * (log_std_old - log_std))
    shift = (mean_old - mean) * jnp.exp(-log_std)
    return 0.5 * jnp.sum(variance_ratio + shift**2 - 1.0 - 2.0 * (log_std_old - log_std), axis=-1)


def squashed_log_probability(
    raw: Float[Array, "*batch D"], mean: Float[Array, "*batch D"], std: Float[Array, "*batch D"]
) -> Float[Array, "*batch"]:
    """Computes the log density of the action tanh(raw), where `raw` has the Gaussian's density (Haarnoja et al. 2018, equation 21).

    log(1 - tanh(u)^2) is computed as 2 (log 2 - u - softplus(-2 u)), which does not lose its digits at large u.
    """
    slope = 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
    return log_probability(raw, mean, jnp.log(std)) - jnp.sum(slope, axis=-1)


def unsquash(action: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """Computes the `raw` of an action, which is moved into [-1 + EDGE, 1 - EDGE]."""
    return jnp.arctanh(jnp.clip(action, -1.0 + EDGE, 1.0 - EDGE))
