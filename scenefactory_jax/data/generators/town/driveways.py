"""Draws private driveways outside of the kerbs, each with a parking space."""

import numpy as np
import shapely
from scipy.spatial import KDTree

from scenefactory_jax.core.schema import CountRange, Range
from scenefactory_jax.data.generators.curves import Points, arc_length, interpolate, right_normals
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Network, Pose

CAR_M = 5.0  # from the kerb to the middle of a parked car
MIN_SPACING_M = 8.0  # between the middles of two parked cars
CLEARANCE_M = 4.0  # between the middle of a parked car and the paved surface


def draw_driveways(
    rng: np.random.Generator,
    network: Network,
    kerbs: list[Points],
    surface: shapely.Geometry,
    *,
    count: CountRange,
    width_m: Range,
    depth_m: Range,
    junction_m: float,
) -> tuple[list[Points], list[Pose]]:
    """Draws outlines at random places of the kerbs and their parking spaces, fewer where there is no room."""
    outlines: list[Points] = []
    spots: list[Pose] = []
    turns = [lane.points[::4] for lane in network.lanes if lane.rank != ON_ROAD]
    turns = KDTree(np.concatenate(turns)) if turns else None
    places, normals = [arc_length(kerb) for kerb in kerbs], [right_normals(kerb) for kerb in kerbs]
    lengths = np.array([place[-1] for place in places])
    weights = lengths / lengths.sum()
    for _ in range(int(rng.integers(*count, endpoint=True)) if kerbs else 0):
        chosen = int(rng.choice(len(kerbs), p=weights))
        kerb, place = kerbs[chosen], places[chosen]
        width, depth, at = rng.uniform(*width_m), rng.uniform(*depth_m), rng.uniform(0.0, place[-1])
        if width > min(at, place[-1] - at):
            continue
        out = interpolate(at, place, normals[chosen])
        out = out / np.linalg.norm(out)
        near = interpolate([at - width / 2, at + width / 2], place, kerb)
        outline = np.concatenate([near, near[::-1] + depth * out])
        entry = interpolate(at, place, kerb)
        middle = entry + CAR_M * out
        if turns is not None and turns.query(entry)[0] < junction_m:
            continue
        if any(np.linalg.norm(middle - spot) < MIN_SPACING_M for spot, _ in spots):
            continue
        ground = (shapely.Polygon(outline + 0.2 * out), shapely.Point(middle).buffer(CLEARANCE_M))
        if shapely.intersects(surface, ground).any():
            continue
        outlines.append(np.concatenate([outline, outline[:1]]))
        spots.append((middle, float(np.arctan2(out[1], out[0])) + np.pi * float(rng.integers(2))))
    return outlines, spots
