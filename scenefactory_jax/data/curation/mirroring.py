"""Mirror images of scenes: as many training scenes again, in which cars keep to the other side."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, Track
from scenefactory_jax.core.types import EDGES

ACROSS = np.array([1.0, -1.0, 1.0])


def mirror(raw: RawScene) -> RawScene:
    """The mirror image of a scene across the x axis of its coordinates, named NAME-mirrored."""
    x, y, z = raw.origin
    roads, tracks, lights = map(_mirror_line, raw.roads), map(_mirror_track, raw.tracks), map(_mirror_light, raw.lights)
    return replace(
        raw,
        name=f"{raw.name}-mirrored",
        roads=tuple(roads),
        tracks=tuple(tracks),
        lights=tuple(lights),
        origin=(x, -y, z),
        metadata={**raw.metadata, "mirrored": True},
    )


def _mirror_line(line: Polyline) -> Polyline:
    """An edge has the road on one side of its direction, so its points are in reverse order; lanes keep their direction."""
    return replace(line, xyz=_flip(line.xyz[::-1] if line.kind in EDGES else line.xyz), left=line.right, right=line.left)


def _mirror_track(track: Track) -> Track:
    return replace(track, xyz=_flip(track.xyz), yaw=-track.yaw, velocity=_flip(track.velocity))


def _mirror_light(light: Light) -> Light:
    return replace(light, stop=None if light.stop is None else _flip(light.stop))


def _flip(points: Float[np.ndarray, "*N D"]) -> Float[np.ndarray, "*N D"]:
    """Points or vectors with the other sign of y; 0 stays 0."""
    return points * ACROSS[: points.shape[-1]] + 0.0
