"""Joins road segments into polylines, the form in which all pictures draw a road."""

import itertools
from collections.abc import Iterator

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, SPEED_BUMP, Road

# layer -> kinds of segments
LAYERS: dict[str, tuple[int, ...]] = {
    "driveway": (DRIVEWAY,), "lane": DRIVABLE, "bike": (LANE_BIKE,), "crosswalk": (CROSSWALK,), "bump": (SPEED_BUMP,),
    "white-broken": (6,), "white": (7, 8), "yellow-broken": (9, 10, 13), "yellow": (11, 12), "edge": EDGES,
}  # fmt: skip
WHITE, YELLOW = (0.95, 0.95, 0.95, 1.0), (0.95, 0.75, 0.15, 1.0)  # paint
STRAIGHT_M = 0.03  # tolerance of simplified lines
GAP_M = 0.02  # consecutive segments of a polyline that are farther apart are two lines


def join_segments(road: Road, tolerance_m: float | None = STRAIGHT_M) -> Iterator[tuple[Float[np.ndarray, "N 2"], int]]:
    """Joins valid segments into polylines, simplified within a tolerance (Douglas-Peucker); yields points and kind."""
    valid = np.asarray(road.valid, bool)
    midpoint, direction = np.asarray(road.midpoint, np.float64)[valid], np.asarray(road.direction, np.float64)[valid]
    half = direction * np.asarray(road.half_length, np.float64)[valid, None]
    kind, polyline = np.asarray(road.kind)[valid], np.asarray(road.polyline)[valid]
    starts, ends = midpoint - half, midpoint + half
    joined = (polyline[1:] == polyline[:-1]) & (np.linalg.norm(starts[1:] - ends[:-1], axis=1) <= GAP_M)
    breaks = [0, *(np.flatnonzero(~joined) + 1).tolist(), len(kind)]
    for first, last in itertools.pairwise(breaks):
        if first == last:  # no segments
            continue
        points = np.concatenate([starts[first:last], ends[last - 1 : last]])
        if tolerance_m is not None:
            points = shapely.get_coordinates(shapely.simplify(shapely.LineString(points), tolerance_m, preserve_topology=False))
        yield points, int(kind[first])
