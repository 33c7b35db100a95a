"""An observation as one flat vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Observation, SetObservation


def flatten_observation(observation: Observation) -> Float[Array, "..."]:
    """One vector for each car, [A, F]: the groups in the order of their names, a set as its rows and then its mask.

    Any axes before the last of a vector, and the last two of a set, are kept: [W, A, F] of many worlds.
    """
    parts = []
    for name in sorted(observation):
        group = observation[name]
        if isinstance(group, SetObservation):
            kept = group.mask.shape[:-1]
            parts += [jnp.where(group.mask[..., None], group.features, 0.0).reshape(*kept, -1), group.mask.astype(jnp.float32)]
        else:
            parts.append(group)
    return jnp.concatenate(parts, axis=-1)
