"""Uniform noise as an observation: for policies that act at random, since a policy has no random key."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import Count
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.observations.column_bounds import SIGNED, bound_observation


@bound_observation(SIGNED)
def noise(scene: Scene, state: State, *, columns: Count) -> Float[Array, "A F"]:
    """Uniform numbers in [-1, 1], new ones at every control step; they depend on the world's key and on the control step."""
    key = jax.random.fold_in(state.key, state.step)
    return jax.random.uniform(key, (len(state.active), columns), jnp.float32, -1.0, 1.0)
