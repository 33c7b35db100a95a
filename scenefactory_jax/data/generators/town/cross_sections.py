"""Classes of streets, and the cross-sections that are drawn from them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.data.generators.ranges import check_range, draw, fill
from scenefactory_jax.data.generators.town.road_network import BROKEN_YELLOW, DOUBLE_YELLOW, SOLID_YELLOW, Street

NARROWEST_M = 2.6  # lane


class StreetClass(NamedTuple):
    """Ranges from which the streets of a class are drawn; see `draw_street`."""

    name: str
    rank: int
    lanes: list[int]
    lane_width_m: list[float]
    speed_limit_mps: list[float]
    median_m: list[float]
    median_share: float
    bike_share: float
    bike_width_m: float
    parking_share: float
    parking_width_m: float


def make_class(name: str, rank: int, numbers: Mapping[str, Any]) -> StreetClass:
    """A class of streets from its config entry; classes named later go first where they meet.

    Raises:
        ConfigError: a key that is missing, unknown or out of range.
    """
    found = fill(StreetClass, numbers, f"generate.network.streets.{name}", name=name, rank=rank)
    check_range(found.lanes, f"generate.network.streets.{name}.lanes", low=1.0)
    check_range(found.lane_width_m, f"generate.network.streets.{name}.lane_width_m", low=NARROWEST_M)
    check_range(found.speed_limit_mps, f"generate.network.streets.{name}.speed_limit_mps", low=1.0)
    return found


def draw_street(rng: np.random.Generator, kind: StreetClass) -> Street:
    """A street of a class."""
    lanes = int(rng.integers(kind.lanes[0], kind.lanes[1] + 1))
    width = draw(rng, kind.lane_width_m, f"{kind.name}.lane_width_m")
    limit = draw(rng, kind.speed_limit_mps, f"{kind.name}.speed_limit_mps")
    chance = rng.random(3)
    median = draw(rng, kind.median_m, f"{kind.name}.median_m")
    lines = (DOUBLE_YELLOW, SOLID_YELLOW) if lanes > 1 or kind.rank > 1 else (DOUBLE_YELLOW, SOLID_YELLOW, BROKEN_YELLOW)
    return Street(
        forward=lanes,
        backward=lanes,
        width=width,
        median=median if chance[0] < kind.median_share else 0.0,
        limit=limit,
        rank=kind.rank,
        bike=kind.bike_width_m if chance[1] < kind.bike_share else 0.0,
        parking=kind.parking_width_m if chance[2] < kind.parking_share else 0.0,
        centre_line=int(rng.choice(lines)),
    )
