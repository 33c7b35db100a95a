"""Road edges from the areas on which cars drive: the outline of all of them together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from scipy.spatial import KDTree
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats import polylines

Points = Float[np.ndarray, "_ 3"]  # any number of them
Area = Points | shapely.Polygon
SIMPLIFY_M = 0.01  # maximum distance of a closed outline from what it was
GRID_M = 1e-4  # of points, where areas that touch along slivers cannot be united without


@dataclass(frozen=True)
class OutlineNumbers:
    """Numbers of road edges."""

    cut_m: float  # the map was cut where an outline comes so near to a lane's centre
    seam_m: float = 0.0  # narrower gaps between areas are closed
    hole_m2: float = 0.0  # smaller holes are closed


def find_edges(
    areas: Sequence[Area], centres: Sequence[Points], numbers: OutlineNumbers, where: str, *, spacing_m: float = np.inf
) -> list[Points]:
    """The outline of all drivable areas together, without the pieces at which a lane leaves the map; heights are those of the corners.

    What is drivable lies on the left of every edge, as in WOMD.

    Args:
        areas, centres: outlines of the areas, or polygons, which may have holes and are level; and lines of lanes.
        where: file and key, for messages.
        spacing_m: maximum between points.
    """
    areas = [area for area in areas if isinstance(area, shapely.Polygon) or len(area) > 2]
    if not areas:
        return []
    try:
        polygons = [area if isinstance(area, shapely.Polygon) else shapely.Polygon(area[:, :2]) for area in areas]
        area = _unite([shapely.make_valid(polygon) for polygon in polygons])
        if (seam_m := numbers.seam_m) > 0:
            area = area.buffer(seam_m, join_style="mitre").buffer(-seam_m, join_style="mitre").simplify(SIMPLIFY_M)
        parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]
        parts = [shapely.Polygon(p.exterior, [hole for hole in p.interiors if shapely.Polygon(hole).area > numbers.hole_m2]) for p in parts]
        parts = [orient(part) for part in parts]
        lanes = shapely.union_all([shapely.LineString(xyz[:, :2]) for xyz in centres])
        rings = [np.asarray(ring.coords) for ring in shapely.get_rings(parts)]
        shapely.prepare(lanes)
        gaps = [np.asarray(shapely.dwithin(lanes, shapely.linestrings(np.stack([r[:-1], r[1:]], axis=1)), numbers.cut_m)) for r in rings]
    except (shapely.errors.ShapelyError, ValueError) as error:
        raise SceneError(f"{where}: no outline can be drawn around them: {error}") from error
    pieces = [polylines.densify(piece, spacing_m) for ring, cut in zip(rings, gaps, strict=True) for piece in _pieces(ring, cut)]
    corners = np.concatenate([np.pad(shapely.get_coordinates(a), ((0, 0), (0, 1))) if isinstance(a, shapely.Polygon) else a for a in areas])
    tree = KDTree(corners[:, :2])
    return [np.column_stack([piece, corners[tree.query(piece)[1], 2]]) for piece in pieces]


def _unite(polygons: Sequence[shapely.Geometry]) -> BaseGeometry:
    """The area of all polygons together."""
    try:
        return shapely.union_all(polygons)
    except shapely.errors.GEOSException:
        return shapely.union_all(polygons, grid_size=GRID_M)


def _pieces(ring: Float[np.ndarray, "N 2"], cut: np.ndarray) -> list[Float[np.ndarray, "K 2"]]:
    """The pieces of a closed ring between the segments that are cut."""
    if not cut.any():
        return [ring]
    first = int(np.flatnonzero(cut)[0])
    points, gaps = np.roll(ring[:-1], -first - 1, axis=0), np.roll(cut, -first - 1)  # begins behind a gap and ends with it
    starts = np.concatenate([[0], np.flatnonzero(gaps[:-1]) + 1])
    return [points[start : stop + 1] for start, stop in zip(starts, np.flatnonzero(gaps), strict=True) if stop > start]
