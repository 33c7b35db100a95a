"""Free distances to the road edges around the car as a vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.ray_casting import cast_to_segments, make_ray_directions
from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import Scene, State
from scenefactory_jax.env.observations.column_bounds import FRACTION, bound_observation, compress_length
from scenefactory_jax.env.observations.near_segments import gather_nearest
from scenefactory_jax.roadgraph.elevation import LEVEL_M


@bound_observation(FRACTION)
def edge_rays(
    scene: Scene, state: State, *, count: Count, range_m: Positive, segments: Count, distance_scale_m: Positive
) -> Float[Array, "A {count}"]:
    """Distance from the car's centre to the first road edge on each of `count` rays, the first ahead, counter-clockwise.

    Lengths l read l / (`distance_scale_m` + l), so that a metre beside the car counts more than one far away; `range_m` where there is no
    edge. Edges of a road above or below are not seen.

    Args:
        segments: of road edges, the nearest ones, that rays can meet; in whole chunks of `nearest_rows`. Where more reach into the range,
            as in intersections, rays pass through the others.
    """
    place, yaw = state.motion.position, state.motion.yaw
    near = gather_nearest(scene.edges, place[:, :2], yaw, count=segments, range_m=range_m)
    if near.height is not None:
        near = near._replace(present=near.present & (jnp.abs(near.height - place[:, 2:]) < LEVEL_M))
    return compress_length(cast_to_segments(make_ray_directions(count), *near[:4], range_m=range_m), distance_scale_m)
