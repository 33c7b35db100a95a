"""Blocks of lanes with ports, and the road network of joined blocks.

Coordinates are metres on flat ground around the middle of the town, with right-hand traffic. Two ports can be joined if they have the same
place and street and opposite yaws. Every lane that ends at a slot of one port then leads into the lanes that begin there at the other.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_STREET
from scenefactory_jax.data.generators.curves import Points

BROKEN_WHITE, SOLID_WHITE, BROKEN_YELLOW, SOLID_YELLOW, DOUBLE_YELLOW = 6, 7, 9, 11, 12  # WOMD map element ids
WALKING, ON_ROAD, MERGING, CHANGING = 90, 60, 20, 5  # right of way outside of junctions: the higher rank goes first


class Street(NamedTuple):
    """Cross-section of a road, apart from lanes that are gained or dropped."""

    lanes: int  # per direction
    width: float  # of a lane, m
    median: float  # width between the directions, m; 0: a painted line
    limit: float  # m/s
    rank: int  # at a junction without lights the higher rank goes first
    bike: float  # width of a bicycle lane at each side, m; 0: none
    parking: float  # width of a strip of parked cars at each side, m; 0: none
    centre_line: int  # map element
    kind: int = LANE_STREET


class Lane(NamedTuple):
    """Centre line of a lane in driving direction."""

    points: Points
    width: float
    limit: float
    rank: int  # right of way where lanes meet
    kind: int = LANE_STREET
    control: int | None = None  # index into the stops: cars wait at the start of the lane


class Line(NamedTuple):
    """A painted line."""

    kind: int
    points: Points


class Stop(NamedTuple):
    """A light or a sign at the start of the lanes whose `control` is its index."""

    kind: str  # "signal", "stop"
    arm: int  # of its junction
    post: Float[np.ndarray, " 2"]  # of the sign, beside the road
    protected: bool = False  # a turn without oncoming traffic: its light is an arrow
    junction: int = 0  # block


class Crosswalk(NamedTuple):
    """Outline of a crosswalk, and the middles of its two ends at the kerbs."""

    outline: Float[np.ndarray, "4 2"]
    ends: Float[np.ndarray, "2 2"]
    arm: int  # of its junction that it crosses
    junction: int = 0  # block


class ParkingSpace(NamedTuple):
    """Place of one parked car."""

    place: Float[np.ndarray, " 2"]
    yaw: float


class Port(NamedTuple):
    """End of a block where it can be joined to another. Slots are counted from the middle of the road outward."""

    place: Float[np.ndarray, " 2"]  # middle of the road
    yaw: float  # out of the block
    street: Street
    leaving: tuple[tuple[int, ...], ...]  # lanes of the block that end at each slot
    entering: tuple[tuple[int, ...], ...]  # lanes of the block that begin at each slot
    cycles_leaving: tuple[int, ...] = ()
    cycles_entering: tuple[int, ...] = ()
    side: str = "right"  # on which a road to this port gains or drops a lane
    controlled: bool = False  # traffic stops or gives way before it enters


class Block(NamedTuple):
    """A piece of a town, with its lanes numbered from 0."""

    kind: str
    lanes: Sequence[Lane]
    follows: Sequence[tuple[int, int]] = ()  # lane, its successor
    beside: Sequence[tuple[int, int]] = ()  # lane, its right neighbour; cars may change between them
    lines: Sequence[Line] = ()
    areas: Sequence[shapely.Geometry] = ()  # paved
    islands: Sequence[shapely.Polygon] = ()  # not paved, within the areas
    stops: Sequence[Stop] = ()
    crosswalks: Sequence[Crosswalk] = ()
    spots: Sequence[ParkingSpace] = ()
    ports: Sequence[Port] = ()
    phases: Sequence[frozenset[int]] = ()  # arms that have green together, in the order of the phases


class Network(NamedTuple):
    """Joined blocks with all lanes numbered. A lane without entry or exit ends where the road leaves the town."""

    lanes: list[Lane]
    exits: list[tuple[int, ...]]
    left: list[tuple[int, ...]]
    right: list[tuple[int, ...]]
    lines: list[Line]
    areas: list[shapely.Geometry]
    islands: list[shapely.Polygon]
    stops: list[Stop]
    crosswalks: list[Crosswalk]
    spots: list[ParkingSpace]
    phases: dict[int, Sequence[frozenset[int]]]  # junction -> phases
    kinds: list[str]  # of all blocks

    @property
    def entries(self) -> list[tuple[int, ...]]:
        """The lanes that lead into each lane."""
        return _group([(follower, lane) for lane, exits in enumerate(self.exits) for follower in exits], len(self.lanes))


Joint = tuple[tuple[int, int], tuple[int, int]]  # (block, port) and (block, port)


def assemble(blocks: Sequence[Block], joints: Sequence[Joint]) -> Network:
    """Joins blocks at their ports and numbers all lanes and stops."""
    base = list(itertools.accumulate((len(block.lanes) for block in blocks), initial=0))
    stop_base = list(itertools.accumulate((len(block.stops) for block in blocks), initial=0))
    lanes, pairs, beside = [], [], []
    for index, block in enumerate(blocks):
        lanes += [lane if lane.control is None else lane._replace(control=lane.control + stop_base[index]) for lane in block.lanes]
        pairs += [(a + base[index], b + base[index]) for a, b in block.follows]
        beside += [(a + base[index], b + base[index]) for a, b in block.beside]
    for (a, i), (b, j) in joints:
        ends = ((a, blocks[a].ports[i]), (b, blocks[b].ports[j]))
        for (first, from_port), (second, to_port) in (ends, ends[::-1]):
            slots = zip((*from_port.leaving, from_port.cycles_leaving), (*to_port.entering, to_port.cycles_entering), strict=True)
            pairs += [(x + base[first], y + base[second]) for xs, ys in slots for x in xs for y in ys]
    return Network(
        lanes=lanes,
        exits=_group(pairs, len(lanes)),
        left=_group([(right, left) for left, right in beside], len(lanes)),
        right=_group(beside, len(lanes)),
        lines=[line for block in blocks for line in block.lines],
        areas=[area for block in blocks for area in block.areas],
        islands=[island for block in blocks for island in block.islands],
        stops=[stop._replace(junction=index) for index, block in enumerate(blocks) for stop in block.stops],
        crosswalks=[walk._replace(junction=index) for index, block in enumerate(blocks) for walk in block.crosswalks],
        spots=[spot for block in blocks for spot in block.spots],
        phases={index: block.phases for index, block in enumerate(blocks) if block.phases},
        kinds=[block.kind for block in blocks],
    )


def _group(pairs: Sequence[tuple[int, int]], count: int) -> list[tuple[int, ...]]:
    """Collects the second numbers of all pairs by the first."""
    groups: list[list[int]] = [[] for _ in range(count)]
    for key, value in pairs:
        groups[key].append(value)
    return [tuple(group) for group in groups]
