"""Mirror images of scenes: as many training scenes again, in which cars keep to the other side."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.types import EDGES

ACROSS = np.array([1.0, -1.0, 1.0])


def mirror(raw: RawScene) -> RawScene:
    """The mirror image of a scene across the x axis of its coordinates, named NAME-mirrored."""
    x, y, z = raw.origin
    # an edge has the road on one side of its direction, so its points are in reverse order; lanes keep their direction
    flipped = [_flip(line.xyz[::-1] if line.kind in EDGES else line.xyz) for line in raw.roads]
    return replace(
        raw,
        name=f"{raw.name}-mirrored",
        roads=tuple(replace(line, xyz=xyz, left=line.right, right=line.left) for line, xyz in zip(raw.roads, flipped, strict=True)),
        tracks=tuple(replace(one, xyz=_flip(one.xyz), yaw=-one.yaw, velocity=_flip(one.velocity)) for one in raw.tracks),
        lights=tuple(replace(light, stop=None if light.stop is None else _flip(light.stop)) for light in raw.lights),
        origin=(x, -y, z),
        metadata={**raw.metadata, "mirrored": True},
    )


def _flip(points: Float[np.ndarray, "*N D"]) -> Float[np.ndarray, "*N D"]:
    """Points or vectors with the other sign of y; 0 stays 0."""
    return points * ACROSS[: points.shape[-1]] + 0.0
