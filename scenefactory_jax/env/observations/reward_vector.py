"""The reward weights that an agent drew as a vector, so that one policy learns to drive for all of them (arXiv:2502.03349)."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.observations.column_bounds import SIGNED, bound_observation


@bound_observation(SIGNED)
def reward_weights(scene: Scene, state: State, *, reward_ranges: dict[str, Any]) -> Float[Array, "A F"]:
    """The agent's weight of every reward term with a range, in the order of their names: -1 at its low, 1 at its high end.

    Zeros, the middle, where nothing is drawn: for traffic that drives by the policy.

    Raises:
        ConfigError: no term has a range.
    """
    if not reward_ranges:
        raise ConfigError("observations.reward_weights: expected a reward term with a range, reward.TERM.weight=[low, high]; there is none")
    zero = jnp.zeros(len(state.active), jnp.float32)
    columns = []
    for name, span in sorted(reward_ranges.items()):
        half = (span.high - span.low) / 2
        columns.append((state.reward_weights[name] - (span.low + half)) / half if state.reward_weights and half > 0 else zero)
    return jnp.stack(columns, axis=1)
