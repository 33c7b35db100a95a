"""Random indices in given proportions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def draw_index(key: PRNGKeyArray, chances: Float[Array, " N"], shape: tuple[int, ...] = ()) -> Int[Array, "*shape"]:
    """Draws indices of `chances`, which add up to 1, as `jax.random.choice`, bit for bit; that searches in a loop of many kernels."""
    total = jnp.cumsum(chances)
    drawn = total[-1] * (1.0 - jax.random.uniform(key, shape))
    return jnp.searchsorted(total, drawn, method="scan_unrolled").astype(jnp.int32)
