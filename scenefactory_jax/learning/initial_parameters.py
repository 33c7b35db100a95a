"""What training begins with: keys and the policy's first parameters, the same wherever they are asked for."""

from typing import Any

import jax
from jaxtyping import Array, PRNGKeyArray

from scenefactory_jax.core.types import Observation, Policy


def split_key(key: PRNGKeyArray) -> Array:
    """Three keys of a run's: for the policy's parameters, for the worlds' starts, and for the iterations."""
    return jax.random.split(key, 3)


def draw_parameters(key: PRNGKeyArray, policy: Policy, observation: Observation) -> Any:
    """The parameters of a policy before training.

    Args:
        key: of the run, `jax.random.key(seed)`.
        observation: of one world or more, along the first axis; its shapes alone count.
    """
    return policy.init(split_key(key)[0], jax.tree.map(lambda leaf: leaf[:1], observation))
