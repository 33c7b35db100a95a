"""Heights of roads for pictures: level by level, and under what stands on them. Flat roads have one level at height 0."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Elevation, Road, Scene
from scenefactory_jax.data.packing.elevation_grid import evaluate_basis
from scenefactory_jax.roadgraph.elevation import LEVEL_M

APART_M = 1.0  # levels that are nearer to each other are one


class RoadLevel(NamedTuple):
    """The segments of a road on one level, and its number; None: the road is flat."""

    road: Road
    number: int | None


def list_levels(scene: Scene) -> list[RoadLevel]:
    """Lists the levels of a scene on the host, the lowest first; segments where levels are one are on the lowest that is there."""
    elevation, road = scene.elevation, scene.road
    if elevation is None or road.height is None:
        return [RoadLevel(road, None if elevation is None else 0)]
    height, present = _evaluate(elevation, np.asarray(road.midpoint, float))
    apart = np.where(present, np.abs(height - np.asarray(road.height)), np.inf)
    level = np.argmax(apart <= apart.min(axis=0) + APART_M, axis=0)
    masks = [np.asarray(road.valid, bool) & (level == number) for number in range(len(height))]
    shown = [(number, mask) for number, mask in enumerate(masks) if number == 0 or mask.any()]
    return [RoadLevel(unchecked(Road, **vars(road) | {"valid": mask}), number) for number, mask in shown]


def measure_level(scene: Scene, places: Float[np.ndarray, "N 2"], number: int | None) -> Float[np.ndarray, " N"]:
    """Heights of one level, m."""
    return np.zeros(len(places)) if number is None or scene.elevation is None else _evaluate(scene.elevation, places)[0][number]


def measure_road(scene: Scene, places: Float[np.ndarray, "*n 2"], near: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Heights of the road at places, of the level that is nearest to `near`, m."""
    if scene.elevation is None:
        return np.zeros(np.shape(near))
    height, present = _evaluate(scene.elevation, np.asarray(places, float).reshape(-1, 2))
    level = np.argmin(np.abs(height - np.ravel(near)) + np.where(present, 0.0, LEVEL_M), axis=0)
    return np.take_along_axis(height, level[None], axis=0)[0].reshape(np.shape(near))


def find_covered(scene: Scene, places: Float[np.ndarray, "*n 2"], near: Float[np.ndarray, "*n"] | None) -> Bool[np.ndarray, "*n"]:
    """Mask of what is under a bridge: another level of the road is there, higher than the one nearest to `near`, m. None: nothing is."""
    if scene.elevation is None or near is None:
        return np.zeros(np.shape(places)[:-1], bool)
    height, present = _evaluate(scene.elevation, np.asarray(places, float).reshape(-1, 2))
    own = measure_road(scene, places, near).ravel()
    return np.any(present & (height - own > APART_M), axis=0).reshape(np.shape(near))


def _evaluate(elevation: Elevation, places: Float[np.ndarray, "N 2"]) -> tuple[Float[np.ndarray, "V N"], Bool[np.ndarray, "V N"]]:
    """Heights of all levels, and whether they are there."""
    levels, nodes, _ = np.shape(elevation.height)
    place = (places - np.asarray(elevation.origin, float)) / float(elevation.cell_m)
    height = (evaluate_basis(place, nodes) @ np.asarray(elevation.height, float).reshape(levels, -1).T).T
    if elevation.present is None:
        return height, np.ones(height.shape, bool)
    column, row = np.clip(np.floor(place + 0.5).astype(int), 1, nodes - 2).T
    return height, np.asarray(elevation.present)[:, row, column]
