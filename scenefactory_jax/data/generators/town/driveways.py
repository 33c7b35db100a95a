"""Private driveways: aprons outside the kerb, some with a car on them."""

import numpy as np
import shapely
from scipy.spatial import KDTree

from scenefactory_jax.data.generators.curves import Points, arc_length
from scenefactory_jax.data.generators.ranges import check_range, draw
from scenefactory_jax.data.generators.town.lane_paths import change_to_right
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Network, Spot

CAR_M = 5.0  # depth of an apron's pavement crossing and half a car: where the middle of a parked car is


def draw_driveways(
    rng: np.random.Generator,
    network: Network,
    kerbs: list[Points],
    surface: shapely.Geometry,
    *,
    count: list[int],
    width_m: list[float],
    depth_m: list[float],
    junction_m: float,
) -> tuple[list[Points], list[Spot]]:
    """Outlines outside random places of the kerbs, and where a car may stand on each. Fewer where there is no room.

    Args:
        count: fewest and most.
        width_m: along the kerb.
        depth_m: away from it.
        junction_m: between an apron and the lanes of a junction.
    """
    check_range(count, "aprons.count", low=0.0)
    outlines: list[Points] = []
    spots: list[Spot] = []
    if not kerbs:
        return outlines, spots
    turns = [lane.points[::4] for lane in network.lanes if lane.rank != ON_ROAD]
    turns = KDTree(np.concatenate(turns)) if turns else None
    places, rights = [arc_length(kerb) for kerb in kerbs], [change_to_right(kerb) for kerb in kerbs]
    lengths = np.array([place[-1] for place in places])
    for _ in range(int(rng.integers(count[0], count[1] + 1))):
        chosen = int(rng.choice(len(kerbs), p=lengths / lengths.sum()))
        kerb, place, right = kerbs[chosen], places[chosen], rights[chosen]
        width, depth, at = draw(rng, width_m, "aprons.width_m"), draw(rng, depth_m, "aprons.depth_m"), rng.uniform(0.0, place[-1])
        sample = lambda s, table, place=place: np.array([np.interp(s, place, table[:, i]) for i in (0, 1)])  # noqa: E731
        if width > min(at, place[-1] - at):
            continue
        out = sample(at, right)
        out = out / np.linalg.norm(out)
        near = np.stack([sample(at - width / 2, kerb), sample(at + width / 2, kerb)])
        outline = np.concatenate([near, near[::-1] + depth * out])
        middle = sample(at, kerb) + CAR_M * out
        if turns is not None and turns.query(sample(at, kerb))[0] < junction_m:
            continue
        taken = any(np.linalg.norm(middle - spot.place) < 8.0 for spot in spots)
        if taken or shapely.Polygon(outline + 0.2 * out).intersects(surface) or shapely.Point(middle).buffer(4.0).intersects(surface):
            continue
        outlines.append(np.concatenate([outline, outline[:1]]))
        spots.append(Spot(middle, float(np.arctan2(out[1], out[0])) + np.pi * float(rng.integers(2))))
    return outlines, spots
