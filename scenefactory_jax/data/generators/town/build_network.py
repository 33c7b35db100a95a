"""Builds the network of a street plan: a block for every node, a road for every edge."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.schema import ConfigError, Fraction
from scenefactory_jax.data.generators.curves import heading, wrap_angle
from scenefactory_jax.data.generators.town.intersections import OPPOSITE, Arm, Control
from scenefactory_jax.data.generators.town.road_network import Block, Joint, Network, Port, assemble
from scenefactory_jax.data.generators.town.road_segments import Pose, RoadDimensions, connect_ports
from scenefactory_jax.data.generators.town.street_plan import Edge, Plan

MIN_ROAD_M = 10.0
CORNER_M = 30.0  # from a corner of a street to the start of its bend


class BlockMakers(NamedTuple):
    """Functions that build the blocks of nodes, bound to their numbers."""

    intersection: Callable[..., Block]
    driveway: Callable[..., Block]
    roundabout: Callable[..., Block]
    parking_lot: Callable[..., Block]


@dataclass(frozen=True)
class JunctionNumbers:
    """Numbers of the config from which junctions are drawn."""

    roundabout_fraction: Fraction  # of junctions that can be one
    signal_fraction: list[Fraction]  # by the rank of the second street at a junction
    all_way_fraction: Fraction  # of junctions without lights that have stop signs on all arms
    bay_fraction: Fraction  # of arms at lights that gain a lane on the way in
    drop_fraction: Fraction  # of arms at lights that drop a lane on the way out
    bay_room_m: float  # length of street that a gained lane needs
    skew_deg: float  # maximum angle between an arm and the straight way to the next junction

    def __post_init__(self) -> None:
        if not self.signal_fraction:
            raise ConfigError("signal_fraction: expected one number or more, got []")


def build_network(
    rng: np.random.Generator, plan: Plan, makers: BlockMakers, dimensions: RoadDimensions, numbers: JunctionNumbers
) -> Network | None:
    """Builds a plan; None if two nodes are too close for their blocks, or a street would have to change two lanes."""
    blocks: list[Block] = []
    ends: dict[tuple[int, int], tuple[int, int] | Port] = {}  # (node, edge) -> (block, port), or a port where the road leaves the town
    for index, node in enumerate(plan.nodes):
        edges = sorted(plan.edges_at(index), key=lambda edge: _yaw(plan, edge, index) % (2 * np.pi))
        street, yaw = plan.edges[edges[0]].street, _yaw(plan, edges[0], index)
        if node.kind == "outlet":
            no_lanes = ((),) * street.lanes
            ends[index, edges[0]] = Port(node.place, yaw, street, no_lanes, no_lanes)
            continue
        block = (
            makers.parking_lot(rng, node.place, yaw, street) if node.kind == "lot" else _junction(rng, plan, index, edges, makers, numbers)
        )
        ends |= {(index, edge): (len(blocks), port) for port, edge in enumerate(edges)}
        blocks.append(block)
    joints: list[Joint] = []
    for number, edge in enumerate(plan.edges):
        near, far = (ends[node, number] for node in (edge.a, edge.b))
        first, second = (end if isinstance(end, Port) else blocks[end[0]].ports[end[1]] for end in (near, far))
        corners = _corners(first, second, edge)
        changes = [abs(len(a.leaving) - len(b.entering)) for a, b in ((first, second), (second, first))]
        if corners is None or max(changes) > 1:
            return None
        joints += [(end, (len(blocks), port)) for port, end in enumerate((near, far)) if not isinstance(end, Port)]
        blocks.append(connect_ports(first, second, corners, dimensions))
    return assemble(blocks, joints)


def _yaw(plan: Plan, edge: int, node: int) -> float:
    """Direction in which an edge leaves a node."""
    places = plan.edges[edge].places(plan.nodes)
    if plan.edges[edge].b == node:
        places = places[::-1]
    ahead = places[1] - places[0]
    return float(np.arctan2(ahead[1], ahead[0]))


def _junction(rng: np.random.Generator, plan: Plan, index: int, edges: list[int], makers: BlockMakers, numbers: JunctionNumbers) -> Block:
    """Builds the block of a node where streets meet."""
    node, skew = plan.nodes[index], float(np.radians(numbers.skew_deg))
    arms = []
    for edge in edges:
        street, turn = plan.edges[edge].street, rng.uniform(-skew, skew)
        arms.append(Arm(_yaw(plan, edge, index) + turn, street, street.lanes, street.lanes))
    if node.kind == "driveway":
        return makers.driveway(rng, node.place, arms, "yield")
    narrow = max(arm.leaving for arm in arms) <= 2 and max(arm.street.rank for arm in arms) > 0
    if node.kind == "roundabout" or (narrow and rng.random() < numbers.roundabout_fraction):
        return makers.roundabout(rng, node.place, [arm._replace(leaving=1, entering=1) for arm in arms], "yield")
    control = _draw_control(rng, arms, numbers)
    if control == "signal":
        lengths = [plan.edges[edge].length(plan.nodes) for edge in edges]
        arms = [_add_lanes(rng, arms, a, length, numbers) for a, length in enumerate(lengths)]
    return makers.intersection(rng, node.place, arms, control)


def _draw_control(rng: np.random.Generator, arms: list[Arm], numbers: JunctionNumbers) -> Control:
    """Draws lights or stop signs: lights are likelier where large streets meet; equal streets have stop signs on all arms."""
    ranks = sorted(arm.street.rank for arm in arms)
    second = ranks[-2] if len(arms) < 4 else ranks[1]
    if rng.random() < numbers.signal_fraction[min(second, len(numbers.signal_fraction) - 1)]:
        return "signal"
    return "all_way_stop" if ranks[0] == ranks[-1] or rng.random() < numbers.all_way_fraction else "two_way_stop"


def _add_lanes(rng: np.random.Generator, arms: list[Arm], index: int, length: float, numbers: JunctionNumbers) -> Arm:
    """Draws a turning lane on the way in and an additional lane on the way out for an arm that is long enough.

    A turning lane needs an arm on its side and an arm straight ahead.
    """
    arm = arms[index]
    has_bay, drops = rng.random() < numbers.bay_fraction, rng.random() < numbers.drop_fraction
    if length < numbers.bay_room_m:
        return arm
    arm = arm._replace(leaving=arm.leaving + int(drops))
    turns = [wrap_angle(other.yaw - arm.yaw - np.pi) for i, other in enumerate(arms) if i != index]
    sides = [side for side, sign in (("left", 1.0), ("right", -1.0)) if any(sign * turn > np.pi - OPPOSITE + 0.2 for turn in turns)]
    if not has_bay or not sides or min(abs(turn) for turn in turns) > 0.5:
        return arm
    return arm._replace(entering=arm.entering + 1, bay=str(rng.choice(sides)))


def _corners(first: Port, second: Port, edge: Edge) -> list[Pose] | None:
    """Poses where the bends of an edge begin and end; None if there is no room for the road."""
    places = [first.place, *edge.via, second.place]
    steps = [b - a for a, b in itertools.pairwise(places)]
    lengths = [float(np.linalg.norm(step)) for step in steps]
    if not edge.via:
        return [] if steps[0] @ heading(first.yaw) > MIN_ROAD_M else None
    if min(lengths) < 2 * MIN_ROAD_M:
        return None
    poses = []
    for place, before, after, a, b in zip(edge.via, steps[:-1], steps[1:], lengths[:-1], lengths[1:], strict=True):
        reach = min(CORNER_M, 0.45 * a, 0.45 * b)
        yaws = [float(np.arctan2(step[1], step[0])) for step in (before, after)]
        poses += [(place - reach * before / a, yaws[0]), (place + reach * after / b, yaws[1])]
    return poses
