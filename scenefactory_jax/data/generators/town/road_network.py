"""Road network of a town: lanes with their links, and the ports at which blocks and roads meet.

Coordinates are metres on flat ground around the middle of the town, with right-hand traffic.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_STREET
from scenefactory_jax.data.generators.curves import Points, heading

Place = Float[np.ndarray, " 2"]
Pose = tuple[Place, float]  # place, yaw
Slots = Sequence[Sequence[int]]  # lanes at each slot of a port; slots are counted from the middle of the road outward
BROKEN_WHITE, SOLID_WHITE, BROKEN_YELLOW, SOLID_YELLOW, DOUBLE_YELLOW = 6, 7, 9, 11, 12  # WOMD map element ids
OPEN_M = 8.0  # behind the end of a road, more than a car reaches out of its lane
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
    centre_line: int | None  # map element; None: not painted
    kind: int = LANE_STREET

    def half_width(self) -> float:
        """Computes the distance from the middle of the road to the outer side of all lanes and parked cars."""
        return self.median / 2 + self.lanes * self.width + self.bike + self.parking


class Lane(NamedTuple):
    """Centre line of a lane in driving direction."""

    points: Points
    width: float
    limit: float
    rank: int  # right of way where lanes meet
    kind: int = LANE_STREET
    control: int | None = None  # index into the stops: cars wait at the start of the lane


class Stop(NamedTuple):
    """A light or a sign at the start of the lanes whose `control` is its index."""

    kind: str  # "signal", "stop"
    arm: int  # of its junction
    post: Place  # of the sign, beside the road
    junction: int
    protected: bool = False  # a turn without oncoming traffic: its light is an arrow


class Crosswalk(NamedTuple):
    """Outline of a crosswalk, and the middles of its two ends at the kerbs."""

    outline: Float[np.ndarray, "4 2"]
    ends: Float[np.ndarray, "2 2"]
    arm: int  # of its junction that it crosses
    junction: int


class Port(NamedTuple):
    """End of a block, from which a road leads on."""

    place: Place  # middle of the road
    yaw: float  # out of the block
    street: Street
    leaving: list[list[int]]  # lanes of the block that end at each slot
    entering: list[list[int]]  # lanes of the block that begin at each slot
    cycles_leaving: list[int]
    cycles_entering: list[int]
    side: str = "right"  # on which a road to this port gains a lane
    controlled: bool = False  # traffic stops or gives way before it enters


@dataclass
class Network:
    """Road network that its blocks are added to. A lane without entry or exit ends where the road leaves the town."""

    lanes: list[Lane] = field(default_factory=list)
    entries: list[list[int]] = field(default_factory=list)  # the lanes that lead into each lane
    exits: list[list[int]] = field(default_factory=list)
    left: list[list[int]] = field(default_factory=list)  # the lanes into which a car may change from each lane
    right: list[list[int]] = field(default_factory=list)
    lines: list[tuple[int, Points]] = field(default_factory=list)  # painted: kind, points
    areas: list[shapely.Geometry] = field(default_factory=list)  # paved
    islands: list[shapely.Polygon] = field(default_factory=list)  # not paved, within the areas
    stops: list[Stop] = field(default_factory=list)
    crosswalks: list[Crosswalk] = field(default_factory=list)
    spots: list[Pose] = field(default_factory=list)  # of parked cars
    phases: dict[int, list[frozenset[int]]] = field(default_factory=dict)  # junction with lights -> arms that have green together
    blocks: list[str] = field(default_factory=list)  # kinds of all blocks
    open_ends: list[shapely.Polygon] = field(default_factory=list)  # ground behind the ends of roads within the town: no kerbs there

    def add_block(self, kind: str) -> int:
        """Adds a block and returns its index."""
        self.blocks.append(kind)
        return len(self.blocks) - 1

    def add_lane(self, lane: Lane) -> int:
        """Adds a lane and returns its index."""
        self.lanes.append(lane)
        for links in (self.entries, self.exits, self.left, self.right):
            links.append([])
        return len(self.lanes) - 1

    def leave_open(self, place: Place, yaw: float, half_width: float) -> None:
        """Paves the ground behind the end of a road, so that cars leave it without meeting a kerb."""
        ahead, left = heading(yaw), heading(yaw + np.pi / 2)
        for ground, far, half in ((self.areas, OPEN_M, half_width), (self.open_ends, OPEN_M + 1.0, half_width + 3.0)):
            corners = ((0.0, -half), (far, -half), (far, half), (0.0, half))
            ground.append(shapely.Polygon([place + x * ahead + y * left for x, y in corners]))

    def link(self, lane: int, follower: int) -> None:
        """Leads a lane into another."""
        self.exits[lane].append(follower)
        self.entries[follower].append(lane)

    def link_slots(self, lanes: Slots, followers: Slots) -> None:
        """Leads the lanes at every slot into those that begin there."""
        for slot, next_slot in zip(lanes, followers, strict=True):
            for lane in slot:
                for follower in next_slot:
                    self.link(lane, follower)

    def put_side_by_side(self, lanes: Sequence[int]) -> None:
        """Makes lanes neighbours, from left to right; cars may change between them."""
        for left, right in itertools.pairwise(lanes):
            self.right[left].append(right)
            self.left[right].append(left)
