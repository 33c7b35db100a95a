"""Patches of the road that belong to a scene: `metadata["patches"]` of its source, in the weather of packed scenes (`weather=scene`).

An entry is an outline with a condition: {"outline": [[x, y], ...], "surface": "ICE", "film_mm": 0.0}, m, in the source's coordinates.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.core.types import SURFACES, Patches, Scene, Weather
from scenefactory_jax.data.packing.pack import PackReport

KEY = "patches"  # of a scene's metadata


def make_entry(outline: Float[np.ndarray, "V 2"], *, surface: str, film_mm: float) -> dict[str, Any]:
    """Makes an entry of the metadata, of plain values."""
    return {"outline": np.asarray(outline, float).round(3).tolist(), "surface": surface, "film_mm": float(film_mm)}


def attach_patches(scene: Scene, reports: Sequence[PackReport]) -> Scene:
    """Returns stacked scenes with the patches of their sources; unchanged where no source has any.

    Args:
        reports: of the scenes, in their order.

    Raises:
        SceneError: an entry that is not a patch, with the scene's name.
    """
    entries = [report.metadata.get(KEY) or [] for report in reports]
    if not (count := max(map(len, entries), default=0)):
        return scene
    worlds = [[_read(entry, report) for entry in found] for found, report in zip(entries, reports, strict=True)]
    longest = max(len(outline) for world in worlds for outline, _, _ in world)
    shape = len(worlds), count
    vertices, film_mm = np.zeros((*shape, longest, 2), np.float32), np.zeros(shape, np.float32)
    surface, present = np.zeros(shape, np.int32), np.zeros(shape, bool)
    for row, world in enumerate(worlds):
        for place, (outline, kind, film) in enumerate(world):
            vertices[row, place] = np.pad(outline, ((0, longest - len(outline)), (0, 0)), mode="edge")
            surface[row, place], film_mm[row, place], present[row, place] = kind, film, True
    zeros = np.zeros(shape, np.float32)
    columns = {"vertices": vertices, "closed": present, "radius": zeros, "surface": surface, "film_mm": film_mm, "present": present}
    patches = unchecked(Patches, **columns, open_road_film_fraction=zeros)
    return replace(scene, weather=unchecked(Weather, **{**vars(scene.weather), "patches": patches}))


def _read(entry: Mapping[str, Any], report: PackReport) -> tuple[Float[np.ndarray, "V 2"], int, float]:
    """Outline around the scene's centre, index into SURFACES, and film in mm."""
    try:
        outline = np.asarray(entry["outline"], float) - np.array(report.centre[:2])
        surface, film_mm = SURFACES.index(entry["surface"]), float(entry["film_mm"])
        if outline.ndim != 2 or len(outline) < 3 or not np.isfinite(outline).all() or not 0.0 <= film_mm < np.inf:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        form = f'{{"outline": [[x, y], ...] of 3 or more points, "surface": one of {", ".join(SURFACES)}, "film_mm": 0 or more}}'
        raise SceneError(f"{report.name}: metadata.{KEY}: expected entries {form}, got {str(entry)[:80]}") from None
    return outline, surface, film_mm
