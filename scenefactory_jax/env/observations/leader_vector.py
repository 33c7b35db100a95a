"""The vehicle ahead on the agent's own route as a vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.schema import Count, NonNegative, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env import route_following
from scenefactory_jax.env.observations.agent_routes import find_along_route
from scenefactory_jax.env.observations.column_bounds import ANY, FRACTION, LENGTH, SIGNED, bound_observation, compress_length
from scenefactory_jax.env.traffic import corridor

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
    agents, motion = state.agents, state.motion
    free = jnp.zeros((len(state.active), COLUMNS), jnp.float32).at[:, 1].set(1.0)
    if not corridor.has_routes(scene.routes):
        return free
    arc = state.route.arc
    boxes, _, places = find_along_route(scene, state, look_ahead_m=look_ahead_m, chord_m=chord_m)
    strip = {"arc": arc, "size": agents.size, "margin_m": margin_m, "foresight_s": jnp.full(len(boxes.mass), foresight_s)}
    found = corridor.find_obstacles(places, boxes, **strip, shift=jnp.zeros_like(places.offset))
    own = jnp.arange(len(boxes.mass)) == jnp.arange(len(arc))[:, None]
    gap = jnp.where(own, jnp.inf, found.gap)
    nearest = jnp.argmin(gap, axis=1)[:, None]
    distance, speed = (jnp.take_along_axis(table, nearest, axis=1)[:, 0] for table in (gap, found.speed))
    closing = safe_norm(motion.velocity[:, :2]) - speed
    columns = [jnp.ones_like(speed), compress_length(distance, gap_scale_m), speed / speed_scale_mps, closing / speed_scale_mps]
    known = jnp.isfinite(distance) & route_following.find_routed(scene, agents)
    return jnp.where(known[:, None], jnp.stack(columns, axis=1), free)
