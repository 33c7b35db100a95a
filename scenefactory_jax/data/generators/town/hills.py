"""Hills under a generated town: a smooth height for every place, as a sum of waves."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.schema import Bounds
from scenefactory_jax.core.types import DRIVABLE

WAVES = 4


@dataclass(frozen=True)
class Hills:
    """The key `hills` of `scenes.generate`; ranges are [min, max]."""

    grade: Annotated[list[float], Bounds(min=0.0, max=0.3, is_range=True)]  # the steepest along a driving lane, rise over run
    wave_m: Annotated[list[float], Bounds(above=0.0, is_range=True)]  # from one hill to the next


def add_hills(raw: RawScene, rng: np.random.Generator, hills: Hills) -> RawScene:
    """Lifts a flat scene, all that lies and stands on its roads included; no driving lane is steeper than the drawn grade."""
    direction, phase = rng.uniform(0.0, 2 * np.pi, (2, WAVES, 1))
    number = np.concatenate([np.cos(direction), np.sin(direction)], axis=1)
    number = number * 2 * np.pi / rng.uniform(hills.wave_m[0], hills.wave_m[1], (WAVES, 1))
    share = rng.uniform(0.5, 1.0, (WAVES, 1)) / np.linalg.norm(number, axis=1, keepdims=True)  # each wave is about as steep

    def compute_heights(xy: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
        return (share * np.sin(number @ xy.T + phase)).sum(axis=0)

    lanes = [line.xyz[:, :2] for line in raw.roads if line.kind in DRIVABLE]
    rise = np.concatenate([np.diff(compute_heights(xy)) for xy in lanes])
    run = np.concatenate([np.linalg.norm(np.diff(xy, axis=0), axis=1) for xy in lanes])
    steepest = float(np.max(np.abs(rise) / np.maximum(run, 1e-6)))
    scale, middle = rng.uniform(hills.grade[0], hills.grade[1]) / steepest, np.zeros((1, 2))

    def lift(xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        height = scale * (compute_heights(xyz[:, :2]) - compute_heights(middle))
        return np.column_stack([xyz[:, :2], xyz[:, 2] + height])

    tracks = tuple(replace(track, xyz=np.where(track.valid[:, None], lift(track.xyz), 0.0)) for track in raw.tracks)
    lights = tuple(light if light.stop is None else replace(light, stop=lift(light.stop[None])[0]) for light in raw.lights)
    return replace(raw, roads=tuple(replace(line, xyz=lift(line.xyz)) for line in raw.roads), tracks=tracks, lights=lights)
