"""Computes the kerbs of a town: the boundary of the paved surface, and the edges of the medians and islands within it."""

import shapely
from shapely.geometry.polygon import orient

from scenefactory_jax.core.schema import Positive
from scenefactory_jax.data.generators.curves import Points
from scenefactory_jax.data.generators.town.road_network import Network

SIMPLIFY_M = 0.03  # maximum distance of a simplified edge from the boundary
MIN_EDGE_M = 1.0
SAME_M = 1e-3  # points of a cut edge that are closer are one


def boundary(
    network: Network, reach: float, *, rounding_m: Positive, island_m2: float, block_m2: float, spacing_m: Positive
) -> tuple[list[Points], list[Points], shapely.Geometry]:
    """Computes road edges within the square of half side `reach`, with the paved surface on their left.

    Returns:
        Outer edges, edges of islands and medians, and the surface.
    """
    paved = shapely.union_all([area if shapely.is_valid(area) else shapely.buffer(area, 0.0) for area in network.areas])
    paved = paved.simplify(SIMPLIFY_M).buffer(rounding_m, quad_segs=8).buffer(-rounding_m, quad_segs=8)
    solid = []
    for part in getattr(paved, "geoms", [paved]):
        gaps = [ring for ring in part.interiors if shapely.Polygon(ring).area >= island_m2]
        solid.append(orient(shapely.Polygon(part.exterior, gaps)))
    gaps = [ring for part in solid for ring in part.interiors]
    rings = [part.exterior for part in solid] + [ring for ring in gaps if shapely.Polygon(ring).area > block_m2]
    island_rings = [ring for ring in gaps if shapely.Polygon(ring).area <= block_m2]
    island_rings += [orient(island, -1.0).exterior for island in network.islands]
    open_ends = shapely.union_all(network.open_ends)
    outer, inner = ([piece for ring in group for piece in _cut_ring(ring, reach, spacing_m, open_ends)] for group in (rings, island_rings))
    surface = shapely.difference(shapely.MultiPolygon(solid), shapely.union_all(network.islands))
    shapely.prepare(surface)  # it is asked about many points
    return outer, inner, surface


def _cut_ring(ring: shapely.LinearRing, reach: float, spacing: float, open_ends: shapely.Geometry) -> list[Points]:
    """Cuts the parts of a ring within the square and outside of open ends, simplified, in segments no longer than `spacing`."""
    line = shapely.LineString(ring).simplify(SIMPLIFY_M)
    within = shapely.clip_by_rect(line, -reach, -reach, reach, reach)
    if not shapely.is_empty(open_ends):
        within = shapely.simplify(shapely.difference(within, open_ends), SAME_M)
    if within.geom_type == "MultiLineString":
        within = shapely.line_merge(within)
    parts = [part for part in getattr(within, "geoms", [within]) if part.geom_type == "LineString" and part.length > MIN_EDGE_M]
    return [shapely.get_coordinates(shapely.segmentize(part, spacing)) for part in parts]
