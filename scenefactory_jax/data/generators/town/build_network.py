"""Draws the road network of a town: a motorway, or streets with a block for every node of a plan and a road for every edge."""

import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Fraction
from scenefactory_jax.data.generators.curves import heading
from scenefactory_jax.data.generators.town.block_sequence import ChainNumbers, draw_chain
from scenefactory_jax.data.generators.town.intersections import OPPOSITE, Arm, Control, turn_angle
from scenefactory_jax.data.generators.town.motorway import build_with_ramp
from scenefactory_jax.data.generators.town.road_network import BROKEN_YELLOW, Network, Port, Pose, Street
from scenefactory_jax.data.generators.town.road_segments import Carriageway, RoadDimensions, connect_ports
from scenefactory_jax.data.generators.town.street_plan import Edge, Plan, StreetClass

PACKAGE = "scenefactory_jax.data.generators.town"
WHERE = "generate.network"
MIN_ROAD_M = 10.0
CORNER_M = 30.0  # from a corner of a street to the start of its bend


@dataclass(frozen=True)
class Blocks:
    """Entries of the blocks at the nodes of a plan."""

    intersection: Mapping[str, Any]  # (rng, network, centre, arms, control) -> ports
    driveway: Mapping[str, Any]  # as intersection
    roundabout: Mapping[str, Any]  # as intersection
    parking_lot: Mapping[str, Any]  # (rng, network, place, yaw, street) -> ports


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


def draw_network(
    rng: np.random.Generator,
    reach: float,
    kind: str | None,
    sequence: str | None = None,
    *,
    plans: dict[str, Mapping[str, Any] | None],
    motorway: Mapping[str, Any],
    motorway_fraction: Fraction,
    streets: dict[str, StreetClass | None],
    driveway: dict[str, float],
    lots: Mapping[str, Any],
    roads: RoadDimensions,
    junctions: JunctionNumbers,
    blocks: Blocks,
    chain: ChainNumbers | None = None,  # runs of before have none
) -> tuple[str, Network] | None:
    """Draws a network and returns its kind with it; None if the drawn plan cannot be built.

    Args:
        kind: name of a plan, or "motorway"; None: drawn.
        sequence: letters of the blocks of a road, which is then drawn in place of a plan; the kind is the sequence.
        plans: entries of `(rng, reach, classes) -> Plan`, or None.
        motorway: entry of `(rng) -> Network`.
        lots: entry of `(rng, plan, reach, street) -> Plan`.
    """
    names = [name for name, entry in plans.items() if entry is not None]
    classes = {rank: street_class for rank, street_class in enumerate(streets.values(), start=1) if street_class is not None}
    for key, entries in (("plans", names), ("streets", classes)):
        if not entries:
            raise ConfigError(f"{WHERE}.{key}: expected one entry or more, got none")
    if kind is not None and kind not in (*names, "motorway"):
        raise ConfigError(f"generate.kinds: expected names among {', '.join((*names, 'motorway'))}, got {kind!r}")
    make = lambda entry, module, key: instantiate(entry, builtins=f"{PACKAGE}.{module}", where=f"{WHERE}.{key}")  # noqa: E731
    layouts = {name: make(plans[name], "street_plan", f"plans.{name}") for name in names}
    builders = {
        name: make(entry, "parking_lot" if name == "parking_lot" else "intersections", f"blocks.{name}")
        for name, entry in vars(blocks).items()
    }
    add_lots, build_motorway = make(lots, "street_plan", "lots"), make(motorway, "motorway", "motorway")
    lane = Street(1, driveway["lane_width_m"], 0.0, driveway["speed_limit_mps"], 0, 0.0, 0.0, BROKEN_YELLOW)
    if sequence is not None:
        if chain is None:
            raise ConfigError(f"{WHERE}.chain: missing; generate.blocks={sequence} needs it")
        plain = replace(junctions, roundabout_fraction=0.0, bay_fraction=0.0, drop_fraction=0.0)  # each block as its letter says
        plan = draw_chain(rng, sequence, classes, lane, chain)
        network = build_network(rng, plan, builders, roads, plain, functools.partial(_draw_ramp, chain))
        return None if network is None else (sequence, network)
    if kind == "motorway" or (kind is None and rng.random() < motorway_fraction):
        return "motorway", build_motorway(rng)
    kind = kind or str(rng.choice(names))
    plan = layouts[kind](rng, reach, classes)
    network = None if plan is None else build_network(rng, add_lots(rng, plan, reach, lane), builders, roads, junctions)
    return None if network is None else (kind, network)


def _draw_ramp(numbers: ChainNumbers, rng: np.random.Generator, way: str) -> Callable[..., Carriageway]:
    """Draws the dimensions of a ramp and returns the builder of a direction of a road with it."""
    length, auxiliary, turn = (float(rng.uniform(*span)) for span in (numbers.ramp_m, numbers.auxiliary_m, numbers.ramp_turn_deg))
    dimensions = {"length": length, "auxiliary": auxiliary, "turn": float(np.radians(turn)), "radius": numbers.ramp_radius_m}
    return functools.partial(build_with_ramp, joins=way == "joins", **dimensions)


def build_network(
    rng: np.random.Generator,
    plan: Plan,
    builders: dict[str, Callable[..., list[Port]]],
    roads: RoadDimensions,
    junctions: JunctionNumbers,
    ramps: Callable[[np.random.Generator, str], Callable[..., Carriageway]] | None = None,
) -> Network | None:
    """Builds a plan; None if two nodes are too close for their blocks, or a street would have to change two lanes.

    Args:
        ramps: draws the builder of a direction with a ramp; of plans that have any.
    """
    network = Network()
    ports: dict[tuple[int, int], Port] = {}  # by node and edge
    for index, node in enumerate(plan.nodes):
        edges = sorted(plan.edges_at(index), key=lambda edge: plan.yaw(edge, index) % (2 * np.pi))
        street, yaw = plan.edges[edges[0]].street, plan.yaw(edges[0], index)
        if node.kind in ("outlet", "end", "joint"):
            no_lanes = [[]] * plan.edges[max(edges)].street.lanes
            ends = [Port(node.place, plan.yaw(edge, index), plan.edges[edge].street, no_lanes, no_lanes, [], []) for edge in edges]
        elif node.kind == "lot":
            ends = builders["parking_lot"](rng, network, node.place, yaw, street)
        else:
            ends = _build_junction(rng, network, plan, index, edges, builders, junctions)
        if node.kind == "end":
            network.leave_open(node.place, yaw + np.pi, street.half_width() - street.parking + roads.shoulder_m)
        ports |= {(index, edge): port for edge, port in zip(edges, ends, strict=True)}
    for number, edge in enumerate(plan.edges):
        first, second = ports[edge.a, number], ports[edge.b, number]
        build = None if ramps is None or not edge.ramp else ramps(rng, edge.ramp)
        corners = _corners(first, second, edge)
        changes = [abs(len(a.leaving) - len(b.entering)) for a, b in ((first, second), (second, first))]
        if corners is None or max(changes) > 1:
            return None
        forward, backward = connect_ports(network, first, second, corners, roads, build)
        if plan.nodes[edge.b].kind == "joint":  # the road after it goes on from the lanes of this one
            following = max(plan.edges_at(edge.b))
            leaving, entering = ([[lane] for lane in lanes] for lanes in (forward.end, backward.start))
            port = ports[edge.b, following]._replace(leaving=leaving, entering=entering)
            ports[edge.b, following] = port._replace(cycles_leaving=forward.cycles, cycles_entering=backward.cycles)
    return network


def _build_junction(
    rng: np.random.Generator,
    network: Network,
    plan: Plan,
    index: int,
    edges: list[int],
    builders: dict[str, Callable[..., list[Port]]],
    junctions: JunctionNumbers,
) -> list[Port]:
    """Builds the block of a node where streets meet."""
    node, skew = plan.nodes[index], float(np.radians(junctions.skew_deg))
    arms = []
    for edge in edges:
        street, turn = plan.edges[edge].street, rng.uniform(-skew, skew)
        arms.append(Arm(plan.yaw(edge, index) + turn, street, street.lanes, street.lanes))
    if node.kind == "driveway":
        return builders["driveway"](rng, network, node.place, arms, "yield")
    narrow = max(arm.leaving for arm in arms) <= 2 and max(arm.street.rank for arm in arms) > 0
    if node.kind == "roundabout" or (narrow and rng.random() < junctions.roundabout_fraction):
        arms = [arm._replace(leaving=1, entering=1) for arm in arms]
        return builders["roundabout"](rng, network, node.place, arms, "yield")
    control = _draw_control(rng, arms, junctions)
    if control == "signal":
        lengths = [plan.edges[edge].length(plan.nodes) for edge in edges]
        arms = [_add_lanes(rng, arms, a, length, junctions) for a, length in enumerate(lengths)]
    return builders["intersection"](rng, network, node.place, arms, control)


def _draw_control(rng: np.random.Generator, arms: list[Arm], junctions: JunctionNumbers) -> Control:
    """Draws lights or stop signs: lights are likelier where large streets meet; equal streets have stop signs on all arms."""
    ranks = sorted(arm.street.rank for arm in arms)
    second = ranks[-2] if len(arms) < 4 else ranks[1]
    if rng.random() < junctions.signal_fraction[min(second, len(junctions.signal_fraction) - 1)]:
        return "signal"
    return "all_way_stop" if ranks[0] == ranks[-1] or rng.random() < junctions.all_way_fraction else "two_way_stop"


def _add_lanes(rng: np.random.Generator, arms: list[Arm], index: int, length: float, junctions: JunctionNumbers) -> Arm:
    """Draws a turning lane on the way in and an additional lane on the way out for an arm that is long enough.

    A turning lane needs an arm on its side and an arm straight ahead.
    """
    arm = arms[index]
    has_bay, drops = rng.random() < junctions.bay_fraction, rng.random() < junctions.drop_fraction
    if length < junctions.bay_room_m:
        return arm
    arm = arm._replace(leaving=arm.leaving + int(drops))
    turns = [turn_angle(arm, other) for i, other in enumerate(arms) if i != index]
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
