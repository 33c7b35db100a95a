"""Builds a parking lot behind a driveway: one lane in, around and out again, with rows of parking spaces."""

import itertools
from typing import Annotated

import numpy as np
import shapely

from scenefactory_jax.core.schema import Bounds
from scenefactory_jax.data.generators.curves import FINE_M, connect, heading
from scenefactory_jax.data.generators.town.intersections import compute_paved_area
from scenefactory_jax.data.generators.town.road_network import ON_ROAD, Lane, Network, Place, Port, Street

AISLE_M = 6.0  # width that a car needs to turn into a space at a right angle
SPACE_M = (5.2, 2.7)  # depth and width of a space
THROAT_M = 16.0  # from the port to the first space
LANE_M = 3.5  # width of the lane
PAVED_M = 0.3  # beside lanes and spaces


def parking_lot(
    rng: np.random.Generator,
    network: Network,
    place: Place,
    yaw: float,
    street: Street,
    *,
    depth_m: Annotated[tuple[float, float], Bounds(min=15, is_range=True)],
    limit_mps: float,
) -> list[Port]:
    """Builds a lot with two aisles and parking spaces on both sides of each.

    Args:
        place, yaw: of its port, at the end of the driveway `street`.
    """
    ahead, left = heading(yaw + np.pi), heading(yaw + 3 * np.pi / 2)
    to_town = lambda points: place + points[..., :1] * ahead + points[..., 1:] * left  # noqa: E731
    half = AISLE_M / 2 + SPACE_M[0]  # from the middle to the centre of an aisle
    far, gate = THROAT_M + rng.uniform(*depth_m), street.width / 2
    straight = lambda a, b: np.linspace(a, b, max(3, round(abs(b[0] - a[0]) / FINE_M)))  # noqa: E731
    turn = np.linspace(-np.pi / 2, np.pi / 2, max(8, round(np.pi * half / FINE_M)))
    paths = [
        connect(np.array([0.0, -gate]), 0.0, np.array([THROAT_M, -half]), 0.0),
        straight(np.array([THROAT_M, -half]), np.array([far - half, -half])),
        half * heading(turn) + np.array([far - half, 0.0]),
        straight(np.array([far - half, half]), np.array([THROAT_M, half])),
        connect(np.array([THROAT_M, half]), np.pi, np.array([0.0, gate]), np.pi),
    ]
    network.add_block("parking_lot")
    lanes = [Lane(to_town(path), LANE_M, limit_mps, ON_ROAD) for path in paths]
    numbers = [network.add_lane(lane) for lane in lanes]
    for lane, follower in itertools.pairwise(numbers):
        network.link(lane, follower)
    rectangle = lambda x0, x1, y: shapely.Polygon(to_town(np.array([[x0, -y], [x1, -y], [x1, y], [x0, y]])))  # noqa: E731
    network.areas += [
        rectangle(THROAT_M - 5.0, far + AISLE_M / 2 + PAVED_M, half + AISLE_M / 2 + SPACE_M[0] + PAVED_M),
        *(compute_paved_area(lane, PAVED_M) for lane in lanes[::4]),
        rectangle(-0.1, 6.0, gate + LANE_M / 2),
    ]
    along = np.arange(THROAT_M + SPACE_M[1] / 2, far - half, SPACE_M[1])
    rows = [(side * (half + toward * (AISLE_M + SPACE_M[0]) / 2), side * toward) for side in (-1, 1) for toward in (-1, 1)]
    turns = rng.integers(0, 2, (len(rows), len(along)))  # whether a car is parked forward or backward
    network.spots += [
        (to_town(np.array([x, y])), float(yaw + np.pi + sign * np.pi / 2 + turns[row, i] * np.pi))
        for row, (y, sign) in enumerate(rows)
        for i, x in enumerate(along)
    ]
    return [Port(place, yaw, street, [numbers[-1:]], [numbers[:1]], [], [])]
