"""From a plan to a network: a block for every node, a road for every edge."""

import itertools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import heading, wrap_angle
from scenefactory_jax.data.generators.town import road_segments
from scenefactory_jax.data.generators.town.intersections import OPPOSITE, Arm, Control
from scenefactory_jax.data.generators.town.road_network import Block, Joint, Network, Port, assemble, outlet
from scenefactory_jax.data.generators.town.street_plan import Edge, Plan

SHORTEST_LINK_M = 10.0
CORNER_M = 30.0  # from a street's corner to where it begins to turn


class Choice(NamedTuple):
    """How nodes become blocks: the parts of the config that `realise` needs."""

    intersection: Callable[..., Block]
    driveway: Callable[..., Block]
    roundabout: Callable[..., Block]
    parking_lot: Callable[..., Block]
    links: road_segments.RoadDimensions
    roundabout_share: float  # of junctions that can be one
    signal_share: tuple[float, ...]  # by the rank of the second street at a junction
    all_way_share: float  # of junctions without lights whose streets are equal
    bay_share: float  # of arms at lights that gain a lane on the way in
    drop_share: float  # of arms at lights that drop one on the way out
    bay_room: float  # m of street that a gained lane needs
    skew: float  # most that an arm turns from the straight way to the next junction


def make_choice(
    blocks: Mapping[str, Callable[..., Block]],
    roads: road_segments.RoadDimensions,
    *,
    roundabout_share: float,
    signal_share: list[float],
    all_way_share: float,
    bay_share: float,
    drop_share: float,
    bay_room_m: float,
    skew_deg: float,
) -> Choice:
    """`Choice` from a config entry; see there.

    Raises:
        ConfigError: `signal_share` is empty, or has a number that is no share.
    """
    if not signal_share or not all(0 <= share <= 1 for share in signal_share):
        raise ConfigError(f"generate.network.junctions.signal_share: {signal_share}; wanted are one or more numbers from 0 to 1")
    return Choice(
        intersection=blocks["intersection"],
        driveway=blocks["driveway"],
        roundabout=blocks["roundabout"],
        parking_lot=blocks["parking_lot"],
        links=roads,
        roundabout_share=roundabout_share,
        signal_share=tuple(signal_share),
        all_way_share=all_way_share,
        bay_share=bay_share,
        drop_share=drop_share,
        bay_room=bay_room_m,
        skew=float(np.radians(skew_deg)),
    )


def build_network(rng: np.random.Generator, plan: Plan, choice: Choice) -> Network | None:
    """Build a plan; None where two nodes are too close to one another for what stands on them, or a street cannot change its lanes."""
    blocks: list[Block] = []
    ends: dict[tuple[int, int], tuple[int, int] | Port] = {}  # (node, edge) -> (block, port), or the end of the town
    for node, place in enumerate(plan.nodes):
        edges = sorted(plan.at(node), key=lambda edge: _yaw(plan, edge, node) % (2 * np.pi))
        if place.kind == "outlet":
            street = plan.edges[edges[0]].street
            ends[node, edges[0]] = outlet(place.place, _yaw(plan, edges[0], node), street, leaving=street.forward, entering=street.forward)
            continue
        if place.kind == "lot":
            edge = plan.edges[edges[0]]
            block = choice.parking_lot(rng, place.place, _yaw(plan, edges[0], node), edge.street)
        else:
            block = _junction(rng, plan, node, edges, choice)
        ends |= {(node, edge): (len(blocks), port) for port, edge in enumerate(edges)}
        blocks.append(block)
    joints: list[Joint] = []
    for number, edge in enumerate(plan.edges):
        near, far = (ends[node, number] for node in (edge.a, edge.b))
        one, other = (end if isinstance(end, Port) else blocks[end[0]].ports[end[1]] for end in (near, far))
        via = _corners(one, other, edge)
        if via is None or max(abs(len(a.leaving) - len(b.entering)) for a, b in ((one, other), (other, one))) > 1:
            return None
        joints += [(end, (len(blocks), port)) for port, end in enumerate((near, far)) if not isinstance(end, Port)]
        blocks.append(road_segments.link(one, other, via, choice.links))
    return assemble(blocks, joints)


def _yaw(plan: Plan, edge: int, node: int) -> float:
    """Direction in which an edge leaves a node."""
    ways = plan.edges[edge].ways(plan.nodes)
    if plan.edges[edge].b == node:
        ways = ways[::-1]
    ahead = ways[1] - ways[0]
    return float(np.arctan2(ahead[1], ahead[0]))


def _junction(rng: np.random.Generator, plan: Plan, node: int, edges: list[int], choice: Choice) -> Block:
    """The block of a node where streets meet."""
    place = plan.nodes[node]
    arms = []
    for edge in edges:
        street, skew = plan.edges[edge].street, rng.uniform(-choice.skew, choice.skew)
        arms.append(Arm(_yaw(plan, edge, node) + skew, street, street.forward, street.forward))
    if place.kind == "driveway":
        return choice.driveway(rng, place.place, arms, "yield")
    narrow = max(arm.leaving for arm in arms) <= 2 and max(arm.street.rank for arm in arms) > 0
    if place.kind == "roundabout" or (narrow and rng.random() < choice.roundabout_share):
        return choice.roundabout(rng, place.place, [arm._replace(leaving=1, entering=1) for arm in arms], "yield")
    control = _control(rng, arms, choice)
    if control == "signal":
        lengths = [_length(plan, edge) for edge in edges]
        arms = [_with_more(rng, arms, a, length, choice) for a, length in enumerate(lengths)]
    return choice.intersection(rng, place.place, arms, control)


def _control(rng: np.random.Generator, arms: list[Arm], choice: Choice) -> Control:
    """Lights where large streets meet; stop signs for all where equal ones do, for the smaller street else."""
    ranks = sorted(arm.street.rank for arm in arms)
    second = ranks[-2] if len(arms) < 4 else ranks[1]
    if rng.random() < choice.signal_share[min(second, len(choice.signal_share) - 1)]:
        return "signal"
    return "all_way_stop" if ranks[0] == ranks[-1] or rng.random() < choice.all_way_share else "two_way_stop"


def _with_more(rng: np.random.Generator, arms: list[Arm], own: int, length: float, choice: Choice) -> Arm:
    """The arm, perhaps with a lane more for those who turn in, where an arm lies on that side and one straight ahead; and one more out."""
    arm = arms[own]
    wanted, dropped = rng.random() < choice.bay_share, rng.random() < choice.drop_share
    if length < choice.bay_room:
        return arm
    arm = arm._replace(leaving=arm.leaving + int(dropped))
    if not wanted:
        return arm
    turns = [wrap_angle(other.yaw - arm.yaw - np.pi) for i, other in enumerate(arms) if i != own]
    sides = [side for side, sign in (("left", 1.0), ("right", -1.0)) if any(sign * turn > np.pi - OPPOSITE + 0.2 for turn in turns)]
    if not sides or min(abs(turn) for turn in turns) > 0.5:
        return arm
    return arm._replace(entering=arm.entering + 1, bay=str(rng.choice(sides)))


def _length(plan: Plan, edge: int) -> float:
    ways = plan.edges[edge].ways(plan.nodes)
    return float(sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(ways)))


def _corners(one: Port, other: Port, edge: Edge) -> list[road_segments.Pose] | None:
    """Where the corners of an edge begin and end; None where there is no room for the road."""
    places = [one.place, *edge.via, other.place]
    steps = [b - a for a, b in itertools.pairwise(places)]
    lengths = [float(np.linalg.norm(step)) for step in steps]
    if not edge.via:
        ahead = heading(one.yaw)
        return [] if steps[0] @ ahead > SHORTEST_LINK_M else None
    if min(lengths) < 2 * SHORTEST_LINK_M:
        return None
    found = []
    for place, before, after, a, b in zip(edge.via, steps[:-1], steps[1:], lengths[:-1], lengths[1:], strict=True):
        reach = min(CORNER_M, 0.45 * a, 0.45 * b)
        yaws = [float(np.arctan2(step[1], step[0])) for step in (before, after)]
        found += [(place - reach * before / a, yaws[0]), (place + reach * after / b, yaws[1])]
    return found
