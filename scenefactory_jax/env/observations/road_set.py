"""Road segments near the car as a set of rows."""

from scenefactory_jax.core.schema import Count, Positive
from scenefactory_jax.core.types import Scene, SetObservation, State
from scenefactory_jax.env.observations.column_bounds import LENGTH, SIGNED, bound_observation
from scenefactory_jax.roadgraph import queries


@bound_observation(SIGNED, SIGNED, LENGTH, SIGNED, SIGNED)
def road(scene: Scene, state: State, *, count: Count, radius_m: Positive, kind_scale: Positive, kernels: bool) -> SetObservation:
    """Road segments whose midpoints are within a radius, the first `count` in storage order: x, y, kind, direction x, y.

    Lanes come first in storage, so that a dense map drops road edges first: the published `road_running` mode. A scene with a grid of at
    least that radius is looked up there, with the same result.

    Args:
        kernels: a Triton kernel where there is an NVIDIA GPU and the scene has a grid; False: plain JAX.
    """
    numbers = {"count": count, "radius_m": radius_m, "kind_scale": kind_scale, "kernels": kernels}
    return queries.gather_segments(scene, state.motion.position[:, :2], state.motion.yaw, state.active, **numbers)
