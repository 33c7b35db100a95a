"""Road edges: the boundary of the surface that lanes cover, so that each is half a lane and a shoulder from every lane centre."""

import numpy as np
import shapely
from shapely.geometry.polygon import orient

from scenefactory_jax.data.generators.curves import Points
from scenefactory_jax.data.generators.procedural.road_layout import Lane, check_positive, entries

SIMPLIFY_M = 0.03  # how far a simplified edge may lie from the boundary
OPENING_M = 0.1  # half depth of the strip across an open road end in which there is no edge


def boundary(
    lanes: list[Lane], *, shoulder_m: float, rounding_m: float, island_m2: float, spacing_m: float
) -> tuple[list[Points], list[Points]]:
    """Edges of the drivable surface, the surface on their left, without the ends where the road goes on beyond the scene.

    Args:
        lanes: every lane of the scene.
        shoulder_m: between a lane's side and the edge.
        rounding_m: radius of the smallest corner; narrower gaps between lanes are paved.
        island_m2: islands smaller than this are paved.
        spacing_m: longest edge segment.

    Returns:
        outer edges, and the edges of islands.

    Raises:
        ConfigError: a number that is not above zero.
    """
    for value, name in ((shoulder_m, "shoulder_m"), (rounding_m, "rounding_m"), (spacing_m, "spacing_m")):
        check_positive(value, f"edges.{name}")
    strips = [
        shapely.LineString(lane.points).simplify(0.005).buffer(lane.width / 2 + shoulder_m + SIMPLIFY_M, cap_style="flat") for lane in lanes
    ]
    surface = shapely.union_all(strips).buffer(rounding_m, quad_segs=12).buffer(-rounding_m, quad_segs=12)
    openings = shapely.union_all(_openings(lanes, shoulder_m))
    outer, islands = [], []
    for polygon in getattr(surface, "geoms", [surface]):
        polygon = orient(polygon)
        outer += _pieces(polygon.exterior, openings, spacing_m)
        islands += [p for ring in polygon.interiors if shapely.Polygon(ring).area >= island_m2 for p in _pieces(ring, openings, spacing_m)]
    return outer, islands


def _openings(lanes: list[Lane], shoulder: float) -> list[shapely.Polygon]:
    """Thin strips across the ends of lanes that nothing leads into or that lead nowhere."""
    ends = []
    for lane, entry in zip(lanes, entries(lanes), strict=True):
        reach = lane.width / 2 + shoulder + 2 * SIMPLIFY_M
        for missing, end, next_to_end in ((not entry, 0, 1), (not lane.exits, -1, -2)):
            if missing:
                ahead = lane.points[end] - lane.points[next_to_end]
                side = reach * np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
                ends.append(shapely.LineString([lane.points[end] - side, lane.points[end] + side]).buffer(OPENING_M, cap_style="flat"))
    return ends


def _pieces(ring: shapely.LinearRing, openings: shapely.Geometry, spacing: float) -> list[Points]:
    """The parts of a ring outside the openings, simplified, in segments no longer than `spacing`."""
    left = shapely.LineString(ring).difference(openings)
    if left.geom_type == "MultiLineString":
        left = shapely.line_merge(left)
    parts = [part for part in getattr(left, "geoms", [left]) if part.length > 1.0]
    return [shapely.get_coordinates(shapely.segmentize(part.simplify(SIMPLIFY_M), spacing)) for part in parts]
