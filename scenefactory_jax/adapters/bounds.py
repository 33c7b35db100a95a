"""Finite bounds of observations, for interfaces whose spaces have some.

Columns of an observation are quantities divided by a scale of the config. Most are bounded by what they are (a sine, a share, a squashed
length), and their group says so (`observations.bounded`). The others (positions, velocities, yaw rates) are clipped to LIMIT of their
scales; with the scales of the package that is 1 km to the goal, 100 m/s and 10 rad/s, which no car of its own reaches.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Observation, SetObservation
from scenefactory_jax.env.observations import ANY, Group

LIMIT = 10.0  # of its scale, at which a column without a bound of its own is clipped


def clip(group: Group) -> Group:
    """The group with every column clipped to its bounds; without effect on columns that declare them."""

    def clipped(scene: Any, state: Any) -> Array | SetObservation:
        seen = group(scene, state)
        if isinstance(seen, SetObservation):
            return replace(seen, features=jnp.clip(seen.features, *_columns(group, seen.features.shape[-1])))
        return jnp.clip(seen, *_columns(group, seen.shape[-1]))

    return clipped


def flat_bounds(groups: Mapping[str, Callable], observation: Observation) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, " F"]]:
    """Lowest and highest value of each column of `adapters.flat`.

    Args:
        groups: of the environment (`Parts.groups`), by name.
        observation: of any number of agents and worlds, or its shapes (`jax.eval_shape`).
    """
    low, high = [], []
    for name in sorted(observation):
        seen = observation[name]
        features = seen.features if isinstance(seen, SetObservation) else seen
        rows = features.shape[-2] if isinstance(seen, SetObservation) else 1
        bounds = _columns(groups[name], features.shape[-1])
        for found, bound, mask in zip((low, high), bounds, (0.0, 1.0), strict=True):
            found += [*np.tile(bound, rows), *([mask] * rows if isinstance(seen, SetObservation) else [])]
    return np.array(low, np.float32), np.array(high, np.float32)


def _columns(group: Callable, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each column of a group; zero, which finished and absent agents read, is always within."""
    declared = getattr(getattr(group, "func", group), "columns", (ANY,))  # `build` binds numbers by functools.partial
    columns = [*declared, *[declared[-1]] * (count - len(declared))][:count]
    low, high = np.clip(np.array(columns, np.float32), -LIMIT, LIMIT).T
    return np.minimum(low, 0.0), np.maximum(high, 0.0)
