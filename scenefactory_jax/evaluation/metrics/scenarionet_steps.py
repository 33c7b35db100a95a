"""Step metrics of MetaDrive's ScenarioEnv (ScenarioNet, arXiv:2306.12241), for one car: where it is along its recorded track."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import dot, safe_norm

MAX_LATERAL_M = 4.0  # MetaDrive's default; 2 in its training configurations
SHORT_TRACK_M = 2.0  # a shorter track is completed from the start
SUCCESS_COMPLETION = 0.95


def project_on_track(
    position: Float[Array, "2"], track: Float[Array, "L 2"], valid: Bool[Array, " L"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Projects a position on the segments between valid states that follow each other.

    Returns:
        Arc length of the nearest place and the distance from it; 0 and inf without a segment.
    """
    chord, both = jnp.diff(track, axis=0), valid[1:] & valid[:-1]
    length = jnp.where(both, safe_norm(chord), 0.0)
    along = jnp.clip(dot(position - track[:-1], chord) / jnp.maximum(length**2, 1e-9), 0.0, 1.0)
    offset = position - track[:-1] - along[:, None] * chord
    distance = jnp.where(both, safe_norm(offset), jnp.inf)
    nearest = jnp.argmin(distance)
    start = jnp.cumsum(length) - length
    return start[nearest] + along[nearest] * length[nearest], distance[nearest]


def measure_track(track: Float[Array, "L 2"], valid: Bool[Array, " L"]) -> Float[Array, ""]:
    """Computes the length of a track."""
    return jnp.sum(jnp.where(valid[1:] & valid[:-1], safe_norm(jnp.diff(track, axis=0)), 0.0))
