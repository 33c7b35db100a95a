"""Patches of a road's weather as coloured areas to draw under its lines."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.types import SURFACES, Weather
from scenefactory_jax.visualization.birds_eye.drawing import ASPHALT, INK, Colour, Stroke, blend

WATER: Colour = (52, 118, 196)
# surface -> colour and name; the asphalts differ by their water alone
GROUNDS: dict[str, tuple[Colour, str]] = {
    "GRAVEL": ((176, 148, 112), "gravel"),
    "SNOW": ((255, 255, 255), "snow"),
    "ICE": ((150, 232, 242), "ice"),
}
DRY: tuple[Colour, str] = ((196, 198, 202), "other asphalt")
_DEEP, _ARC = 1.0, 12  # mm of water that take the strongest tint, and points of a half circle


class Area(NamedTuple):
    """One patch: pieces whose union it is, drawn without seams in one colour, and what a legend calls it."""

    pieces: list[Float[np.ndarray, "n 2"]]
    colour: Colour
    edge: Colour
    label: str


def areas(weather: Weather) -> list[Area]:
    """The present patches of one world's weather, bottom first, with the films of this moment."""
    patches, result = weather.patches, []
    for row in np.flatnonzero(np.asarray(patches.present)):
        film = float(patches.film_mm[row] + patches.open_road_film_fraction[row] * weather.film_mm)
        colour, label = colour_area(SURFACES[int(patches.surface[row])], film)
        pieces = outline(np.asarray(patches.vertices[row], float), float(patches.radius[row]), closed=bool(patches.closed[row]))
        result.append(Area(pieces, colour, blend(INK, colour, 0.3), label))
    return result


def colour_area(surface: str, film_mm: float) -> tuple[Colour, str]:
    """Colour and name of a condition: the deeper the water, the more of its colour."""
    colour, label = GROUNDS.get(surface, DRY)
    if film_mm <= 0:
        return colour, label
    wet = blend(WATER, colour, 0.25 + 0.6 * min(film_mm / _DEEP, 1.0))
    return wet, f"wet {label}" if surface in GROUNDS else "water"


def outline(vertices: Float[np.ndarray, "v 2"], radius: float, *, closed: bool) -> list[Float[np.ndarray, "n 2"]]:
    """Polygons whose union is a patch: its interior, and the capsule about each edge."""
    moved = np.r_[True, (np.diff(vertices, axis=0) != 0).any(axis=1)]
    line = vertices[moved]
    pieces = [line] if closed else []
    if radius <= 0:
        return pieces
    ends = np.roll(line, -1, axis=0) if closed else line[1:]
    starts = line if closed else line[:-1]
    if len(line) == 1:
        starts, ends = line, line
    for start, end in zip(starts, ends, strict=True):
        ahead = np.arctan2(*(end - start)[::-1])
        turn = ahead + np.linspace(-np.pi / 2, np.pi / 2, _ARC)
        half = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        pieces.append(np.concatenate([end + half, start - half]))
    return pieces


def count_strokes_below(strokes: list[Stroke]) -> int:
    """Number of strokes that lie below the patches: the area of the lanes, which comes first."""
    return sum(stroke.colour == ASPHALT for stroke in strokes)
