"""Finite bounds of observations, for interfaces with bounded spaces.

Columns of an observation are quantities divided by a scale of the config. Most are bounded by definition (a sine, a fraction, a squashed
length), which their group declares (`observations.bound_observation`). The others (positions, velocities, yaw
rates) are clipped to LIMIT of their scales: with the package's scales 1 km to the goal, 100 m/s and 10 rad/s, which no car reaches.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Observation, SetObservation
from scenefactory_jax.env.observations import ANY, Group

LIMIT = 10.0  # of its scale, at which a column without a declared bound is clipped


def clip(group: Group) -> Group:
    """The group with every column clipped to its bounds; without effect on columns that declare them."""

    def clipped(scene: Any, state: Any) -> Array | SetObservation:
        observation = group(scene, state)
        if isinstance(observation, SetObservation):
            features = observation.features
            return replace(observation, features=jnp.clip(features, *_columns(group, features.shape[-1])))
        return jnp.clip(observation, *_columns(group, observation.shape[-1]))

    return clipped


def flat_bounds(groups: Mapping[str, Callable], observation: Observation) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, " F"]]:
    """Lowest and highest value of each column of `adapters.flatten_observation`.

    Args:
        groups: of the environment (`Parts.groups`), by name.
        observation: of any number of agents and worlds, or its shapes (`jax.eval_shape`).
    """
    low, high = [], []
    for name in sorted(observation):
        values = observation[name]
        is_set = isinstance(values, SetObservation)
        features = values.features if is_set else values
        rows = features.shape[-2] if is_set else 1
        for bounds, bound, mask in zip((low, high), _columns(groups[name], features.shape[-1]), (0.0, 1.0), strict=True):
            bounds += [*np.tile(bound, rows), *([mask] * rows if is_set else [])]
    return np.array(low, np.float32), np.array(high, np.float32)


def _columns(group: Callable, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each column of a group; zero, the value of finished and absent agents, is always within."""
    declared = getattr(getattr(group, "func", group), "columns", (ANY,))  # `instantiate` binds numbers by functools.partial
    columns = [*declared, *[declared[-1]] * (count - len(declared))][:count]
    low, high = np.clip(np.array(columns, np.float32), -LIMIT, LIMIT).T
    return np.minimum(low, 0.0), np.maximum(high, 0.0)
