"""What a town is put together from: blocks of lanes with ports, and the network that joined blocks make.

Blocks are laid out in the town's own frame, metres on flat ground, right-hand traffic. Two ports fit one another where they lie on the same
place with opposite yaws and the same street; joining them lets every lane that ends at a slot lead into those that begin there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_STREET
from scenefactory_jax.data.generators.curves import Points

BROKEN_WHITE, SOLID_WHITE, BROKEN_YELLOW, SOLID_YELLOW, DOUBLE_YELLOW = 6, 7, 9, 11, 12  # WOMD map element ids
ON_ROAD, MERGING, CHANGING = 60, 20, 5  # right of way of lanes outside junctions: higher goes first
WALKING = 90


class Street(NamedTuple):
    """Cross-section of a road, the same from end to end but for lanes that are gained or dropped."""

    forward: int  # lanes from its first end to its second
    backward: int
    width: float  # of a lane, m
    median: float  # between the directions, m; 0: a painted line
    limit: float  # m/s
    rank: int  # whose roads go first at a junction without lights
    bike: float  # width of a bicycle lane at each side, m; 0: none
    parking: float  # width of a strip of parked cars at each side, m; 0: none
    centre_line: int  # map element
    kind: int = LANE_STREET


class Lane(NamedTuple):
    """Centre line of a lane in driving direction."""

    points: Points
    width: float
    limit: float
    rank: int  # right of way where it meets another
    kind: int = LANE_STREET
    control: int | None = None  # index into the stops: cars wait at the lane's start


class Line(NamedTuple):
    """A painted line."""

    kind: int
    points: Points


class Stop(NamedTuple):
    """Where cars wait for a light or a sign: the start of the lanes whose `control` it is."""

    kind: str  # "signal", "stop"
    arm: int  # of its junction
    post: Float[np.ndarray, " 2"]  # of the sign, beside the road
    protected: bool = False  # a turn that no oncoming car meets: its light is an arrow
    junction: int = 0  # block


class Crosswalk(NamedTuple):
    """A zebra: its outline, and the middles of its two ends at the kerbs."""

    outline: Float[np.ndarray, "4 2"]
    ends: Float[np.ndarray, "2 2"]
    arm: int  # of its junction that it crosses
    junction: int = 0  # block


class Spot(NamedTuple):
    """Room for one parked car."""

    place: Float[np.ndarray, " 2"]
    yaw: float


class Port(NamedTuple):
    """Where a block meets the next one. Slots are counted from the middle of the road outward."""

    place: Float[np.ndarray, " 2"]  # middle of the road
    yaw: float  # out of the block
    street: Street
    leaving: tuple[tuple[int, ...], ...]  # lanes of the block that end at each slot
    entering: tuple[tuple[int, ...], ...]  # lanes of the block that begin at each slot
    cycles_leaving: tuple[int, ...] = ()
    cycles_entering: tuple[int, ...] = ()
    side: str = "right"  # at which a slot too many or too few is gained or dropped on the way here
    controlled: bool = False  # traffic stops or gives way before it enters


class Block(NamedTuple):
    """A piece of a town; lanes are numbered within it."""

    kind: str
    lanes: Sequence[Lane]
    follows: Sequence[tuple[int, int]] = ()  # lane, the next
    beside: Sequence[tuple[int, int]] = ()  # lane, the one on its right into which a car may change, and back
    lines: Sequence[Line] = ()
    areas: Sequence[shapely.Geometry] = ()  # what is paved
    islands: Sequence[shapely.Polygon] = ()  # what is not, within the paved
    stops: Sequence[Stop] = ()
    crosswalks: Sequence[Crosswalk] = ()
    spots: Sequence[Spot] = ()
    ports: Sequence[Port] = ()
    phases: Sequence[frozenset[int]] = ()  # arms that have green together, one phase after the other


class Network(NamedTuple):
    """Blocks with their lanes numbered throughout; a lane without entry or exit ends where the road leaves the town."""

    lanes: list[Lane]
    exits: list[tuple[int, ...]]
    left: list[tuple[int, ...]]
    right: list[tuple[int, ...]]
    lines: list[Line]
    areas: list[shapely.Geometry]
    islands: list[shapely.Polygon]
    stops: list[Stop]
    crosswalks: list[Crosswalk]
    spots: list[Spot]
    phases: dict[int, Sequence[frozenset[int]]]  # junction -> its phases
    kinds: list[str]  # of all blocks

    @property
    def entries(self) -> list[tuple[int, ...]]:
        """The lanes that lead into each lane."""
        before: list[list[int]] = [[] for _ in self.lanes]
        for own, exits in enumerate(self.exits):
            for follower in exits:
                before[follower].append(own)
        return [tuple(ids) for ids in before]


Joint = tuple[tuple[int, int], tuple[int, int]]  # (block, port) and (block, port)


def assemble(blocks: Sequence[Block], joints: Sequence[Joint]) -> Network:
    """Number the lanes of all blocks throughout and join them at their ports."""
    base = np.concatenate([[0], np.cumsum([len(block.lanes) for block in blocks])]).tolist()
    stop_base = np.concatenate([[0], np.cumsum([len(block.stops) for block in blocks])]).tolist()
    lanes, pairs, beside = [], [], []
    for index, block in enumerate(blocks):
        lanes += [
            lane if lane.control is None else lane._replace(control=lane.control + stop_base[index]) for lane in block.lanes
        ]
        pairs += [(a + base[index], b + base[index]) for a, b in block.follows]
        beside += [(a + base[index], b + base[index]) for a, b in block.beside]
    for (a, i), (b, j) in joints:
        ends = ((a, blocks[a].ports[i]), (b, blocks[b].ports[j]))
        for (first, one), (second, other) in (ends, ends[::-1]):
            slots = zip((*one.leaving, one.cycles_leaving), (*other.entering, other.cycles_entering), strict=True)
            pairs += [(x + base[first], y + base[second]) for xs, ys in slots for x in xs for y in ys]
    return Network(
        lanes=lanes,
        exits=_grouped(pairs, len(lanes)),
        left=_grouped([(right, left) for left, right in beside], len(lanes)),
        right=_grouped(beside, len(lanes)),
        lines=[line for block in blocks for line in block.lines],
        areas=[area for block in blocks for area in block.areas],
        islands=[island for block in blocks for island in block.islands],
        stops=[stop._replace(junction=index) for index, block in enumerate(blocks) for stop in block.stops],
        crosswalks=[walk._replace(junction=index) for index, block in enumerate(blocks) for walk in block.crosswalks],
        spots=[spot for block in blocks for spot in block.spots],
        phases={index: block.phases for index, block in enumerate(blocks) if block.phases},
        kinds=[block.kind for block in blocks],
    )


def _grouped(pairs: Sequence[tuple[int, int]], count: int) -> list[tuple[int, ...]]:
    """The second numbers of all pairs, by the first."""
    groups: list[list[int]] = [[] for _ in range(count)]
    for key, value in pairs:
        groups[key].append(value)
    return [tuple(group) for group in groups]


def outlet(place: Float[np.ndarray, " 2"], yaw: float, street: Street, *, leaving: int, entering: int) -> Port:
    """The end of the town on a road that goes on: a port of no block, whose slots lead nowhere and come from nowhere.

    Args:
        yaw: into the town, for a port looks out of what it belongs to.
    """
    return Port(place, yaw, street, ((),) * leaving, ((),) * entering)
