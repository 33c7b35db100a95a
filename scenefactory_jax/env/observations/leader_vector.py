"""The vehicle ahead on the agent's own route as a vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.leaders import find_leaders
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation, compress_length

COLUMNS = 4


@bound_observation(FRACTION, SIGNED, LENGTH, ANY)
def leader(
    scene: Scene,
    state: State,
    *,
    look_ahead_m: Positive,
    chord_m: Count,
    margin_m: NonNegative,
    foresight_s: NonNegative,
    gap_scale_m: Positive,
    speed_scale_mps: Positive,
) -> Float[Array, "A 4"]:
    """The nearest box in the strip of the agent's width along its own route, of other active agents and of the background traffic.

    Columns: 1 if there is one; the gap along the route between the car's front and the box, as l / (scale + |l|), 1 without one; the box's
    speed along the route, not below 0, and by how much the car is faster than that, both over `speed_scale_mps`. Boxes that cross the
    strip within `foresight_s` at their present velocity count, too. An agent without a route has no leader.

    Args:
        look_ahead_m: length of the route that is searched, read as chords of `chord_m` points.
        margin_m: by which the strip is wider than the agent, on both sides.
    """
    found = find_leaders(scene, state, look_ahead_m=look_ahead_m, chord_m=chord_m, margin_m=margin_m, foresight_s=foresight_s)
    closing = safe_norm(state.motion.velocity[:, :2]) - found.speed
    gap = compress_length(found.gap, gap_scale_m)
    columns = [jnp.ones_like(gap), gap, found.speed / speed_scale_mps, closing / speed_scale_mps]
    free = jnp.zeros((len(state.active), COLUMNS), jnp.float32).at[:, 1].set(1.0)
    return jnp.where(jnp.isfinite(found.gap)[:, None], jnp.stack(columns, axis=1), free)
