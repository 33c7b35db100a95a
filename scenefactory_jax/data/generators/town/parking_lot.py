"""A parking lot behind a driveway: one way in, around and out again, with rows of spaces."""

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import FINE_M, connect, heading
from scenefactory_jax.data.generators.ranges import draw
from scenefactory_jax.data.generators.town.intersections import find_paved_area
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Block, Lane, Port, Spot, Street

AISLE_M = 6.0  # width that a car needs to turn into a space at a right angle
SPACE_M = (5.2, 2.7)  # depth and width of a space
THROAT_M = 16.0  # from the port to the first space: room for the way to swing out to the aisle
LANE_M = 3.5  # width of the way in and out


def parking_lot(
    rng: np.random.Generator, place: Float[np.ndarray, " 2"], yaw: float, street: Street, *, depth_m: list[float], limit_mps: float
) -> Block:
    """A lot whose port lies at `place`, looking out along `yaw`: two aisles with spaces on both sides.

    Args:
        street: the driveway's.
        depth_m: of the lot behind the first space.
        limit_mps: how fast cars go in it.
    """
    depth = draw(rng, depth_m, "parking_lot.depth_m", low=15.0)
    ahead, left = heading(yaw + np.pi), heading(yaw + 3 * np.pi / 2)
    put = lambda points: place + points[..., :1] * ahead + points[..., 1:] * left  # noqa: E731
    half = AISLE_M / 2 + SPACE_M[0]  # between the middle and an aisle's centre
    far, gate = THROAT_M + depth, street.width / 2
    straight = lambda a, b: np.linspace(a, b, max(3, round(abs(b[0] - a[0]) / FINE_M)))  # noqa: E731
    paths = [
        connect(np.array([0.0, -gate]), 0.0, np.array([THROAT_M, -half]), 0.0),
        straight(np.array([THROAT_M, -half]), np.array([far - half, -half])),
        half * heading(np.linspace(-np.pi / 2, np.pi / 2, max(8, round(np.pi * half / FINE_M)))) + np.array([far - half, 0.0]),
        straight(np.array([far - half, half]), np.array([THROAT_M, half])),
        connect(np.array([THROAT_M, half]), np.pi, np.array([0.0, gate]), np.pi),
    ]
    lanes = [Lane(put(path), LANE_M, limit_mps, ON_ROAD) for path in paths]
    wide = half + AISLE_M / 2 + SPACE_M[0] + 0.3
    corners = np.array([[THROAT_M - 5.0, -wide], [far + AISLE_M / 2 + 0.3, -wide], [far + AISLE_M / 2 + 0.3, wide], [THROAT_M - 5.0, wide]])
    areas = [shapely.Polygon(put(corners)), *(find_paved_area(lane, 0.3) for lane in lanes[::4])]
    throat = np.array([[-0.1, -gate - LANE_M / 2], [6.0, -gate - LANE_M / 2], [6.0, gate + LANE_M / 2], [-0.1, gate + LANE_M / 2]])
    port = Port(place, yaw, street, ((4,),), ((0,),))
    along = np.arange(THROAT_M + SPACE_M[1] / 2, far - half, SPACE_M[1])
    rows = [(side * (half + toward * (AISLE_M + SPACE_M[0]) / 2), side * toward) for side in (-1, 1) for toward in (-1, 1)]
    turns = rng.integers(0, 2, (len(rows), len(along)))  # forward or backward into the space
    spots = [
        Spot(put(np.array([x, y])), float(yaw + np.pi + sign * np.pi / 2 + turns[row, i] * np.pi))
        for row, (y, sign) in enumerate(rows)
        for i, x in enumerate(along)
    ]
    follows = [(i, i + 1) for i in range(4)]
    return Block("parking_lot", lanes, follows, areas=[*areas, shapely.Polygon(put(throat))], spots=spots, ports=[port])
