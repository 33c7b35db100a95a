"""Kerbs of a town: the boundary of everything paved, and of the medians and islands within it."""

import shapely
from shapely.geometry.polygon import orient

from scenefactory_jax.data.generators.curves import Points
from scenefactory_jax.data.generators.ranges import check_positive
from scenefactory_jax.data.generators.town.road_network import Network

SIMPLIFY_M = 0.03  # how far a simplified edge may lie from the boundary


def boundary(
    network: Network, reach: float, *, rounding_m: float, island_m2: float, block_m2: float, spacing_m: float
) -> tuple[list[Points], list[Points], shapely.Geometry]:
    """Edges of the paved surface, the surface on their left, within the square of half side `reach`, beyond which the roads go on.

    Args:
        rounding_m: radius of the smallest corner; narrower gaps between areas are paved, but for the network's islands.
        island_m2: smaller gaps within the surface are paved; the network's islands never are.
        block_m2: larger gaps are blocks of houses, whose edges are outer ones.
        spacing_m: longest edge segment.

    Returns:
        outer edges, edges of islands and medians, and the surface.

    Raises:
        ConfigError: a number that is not above zero.
    """
    for value, name in ((rounding_m, "rounding_m"), (spacing_m, "spacing_m")):
        check_positive(value, f"surface.{name}")
    paved = shapely.union_all([area if shapely.is_valid(area) else shapely.buffer(area, 0.0) for area in network.areas])
    paved = paved.simplify(SIMPLIFY_M).buffer(rounding_m, quad_segs=8).buffer(-rounding_m, quad_segs=8)
    solid = [orient(shapely.Polygon(part.exterior, _gaps(part, island_m2))) for part in getattr(paved, "geoms", [paved])]
    outer = [piece for part in solid for piece in _pieces(part.exterior, reach, spacing_m)]
    inner = []
    for ring in (ring for part in solid for ring in part.interiors):
        (outer if shapely.Polygon(ring).area > block_m2 else inner).extend(_pieces(ring, reach, spacing_m))
    for island in network.islands:
        inner += _pieces(orient(island, -1.0).exterior, reach, spacing_m)
    surface = shapely.difference(shapely.MultiPolygon(solid), shapely.union_all(network.islands))
    return outer, inner, surface


def _gaps(part: shapely.Polygon, island_m2: float) -> list[shapely.LinearRing]:
    """The holes that are worth an island."""
    return [ring for ring in part.interiors if shapely.Polygon(ring).area >= island_m2]


def _pieces(ring: shapely.LinearRing, reach: float, spacing: float) -> list[Points]:
    """The parts of a ring within the square, simplified, in segments no longer than `spacing`."""
    line = shapely.LineString(ring).simplify(SIMPLIFY_M)
    within = shapely.clip_by_rect(line, -reach, -reach, reach, reach)
    if within.geom_type == "MultiLineString":
        within = shapely.line_merge(within)
    parts = [part for part in getattr(within, "geoms", [within]) if part.geom_type == "LineString" and part.length > 1.0]
    return [shapely.get_coordinates(shapely.segmentize(part, spacing)) for part in parts]
