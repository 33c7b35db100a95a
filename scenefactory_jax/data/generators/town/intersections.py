"""Builds junctions: intersections of three to five arms, and roundabouts."""

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.schema import Bounds, ConfigError, Fraction, Positive
from scenefactory_jax.core.types import LANE_BIKE
from scenefactory_jax.data.generators.curves import FINE_M, Points, connect, curvature, heading, wrap_angle
from scenefactory_jax.data.generators.town.road_network import SOLID_WHITE, Crosswalk, Lane, Network, Place, Port, Stop, Street

Control = Literal["signal", "all_way_stop", "two_way_stop", "yield"]
CrosswalkRange = Annotated[tuple[float, float], Bounds(min=1, is_range=True)]
STRAIGHT_RAD = np.radians(40.0)  # maximum angle of a turn that goes straight on
OPPOSITE = np.radians(150.0)  # minimum angle between arms that have green together
MAX_GROWTHS, GROWTH_M = 24, 1.5  # of an intersection, until its sharpest turn has the minimum radius
TURN_RANK = {"straight": 4, "right": 3, "left": 2}
RING_RANK = 50
PAVED_M = 0.3  # between the side of a lane and the kerb in a junction
RING_PAVED_M = 0.5  # the same in a roundabout
POST_M = 1.5  # from the kerb to a stop sign
CROSSWALK_GAP_M = 0.8  # from a crosswalk to the stop line


class Arm(NamedTuple):
    """A street that ends at a junction. Looking away from the junction, its entering lanes are on the left."""

    yaw: float  # away from the junction
    street: Street
    leaving: int  # lanes out of the junction
    entering: int
    bay: str = ""  # side of a lane that only turns: "left", "right" or none
    centre: Place = np.zeros(2)  # of the junction
    distance: float = 0.0  # of the end of the arm from the centre, m

    def half_width(self, side: Literal["left", "right"]) -> float:
        """Computes the distance from the middle of the arm to its kerb."""
        slots = self.entering if side == "left" else self.leaving
        return self.street.median / 2 + slots * self.street.width + self.street.bike + PAVED_M

    def at(self, along: float, across: float) -> Place:
        """Place at distances from the centre along the arm and to its left, looking away from the junction."""
        return self.centre + along * heading(self.yaw) + across * heading(self.yaw + np.pi / 2)

    def slot(self, slot: int | float, *, entering: bool) -> Place:
        """Place where a slot meets the junction; slots at half numbers are lines between lanes."""
        beside = self.street.median / 2 + (slot + 0.5) * self.street.width
        return self.at(self.distance, beside if entering else -beside)

    def cycle_lane(self, *, entering: bool) -> Place:
        """Place where the bicycle lane meets the junction."""
        aside = self.street.bike / 2 * heading(self.yaw + np.pi / 2)
        slot = (self.entering if entering else self.leaving) - 0.5
        return self.slot(slot, entering=entering) + (aside if entering else -aside)

    def corners(self, near: float, far: float) -> list[Place]:
        """Corners of the full width of the arm between two distances from the centre."""
        left, right = self.half_width("left"), self.half_width("right")
        return [self.at(x, y) for x, y in ((near, -right), (far, -right), (far, left), (near, left))]

    def crosswalk(self, distance: float, depth: float, index: int, junction: int) -> Crosswalk:
        """Crosswalk before a line at a distance from the centre."""
        near, far = distance - CROSSWALK_GAP_M - depth, distance - CROSSWALK_GAP_M
        ends = [self.at((near + far) / 2, across) for across in (-self.half_width("right"), self.half_width("left"))]
        return Crosswalk(np.stack(self.corners(near, far)), np.stack(ends), index, junction)

    def port(self, *, controlled: bool) -> Port:
        """Port of the arm, without lanes."""
        leaving, entering = ([[] for _ in range(count)] for count in (self.leaving, self.entering))
        return Port(self.at(self.distance, 0.0), self.yaw, self.street, leaving, entering, [], [], self.bay or "right", controlled)


def turn_angle(source: Arm, target: Arm) -> float:
    """Computes the angle of the turn from one arm into another, positive to the left."""
    return wrap_angle(target.yaw - source.yaw - np.pi)


def is_straight(source: Arm, target: Arm) -> bool:
    """Checks whether the way from one arm to another goes straight on."""
    return bool(abs(turn_angle(source, target)) < STRAIGHT_RAD)


class Turn(NamedTuple):
    """A connection through a junction from an entering slot of one arm to a leaving slot of another."""

    source: tuple[int, int]  # arm, slot
    target: tuple[int, int]
    kind: str  # "straight", "left", "right"


def intersection(
    rng: np.random.Generator,
    network: Network,
    centre: Place,
    arms: Sequence[Arm],
    control: Control,
    *,
    corner_radius_m: Annotated[tuple[float, float], Bounds(min=0, is_range=True)],
    turn_radius_m: Positive,
    crosswalk_m: CrosswalkRange,
    crosswalk_fraction: Fraction,
) -> list[Port]:
    """Builds an intersection of arms, counter-clockwise, large enough for turns with a minimum radius; returns the ports of the arms.

    Raises:
        ConfigError: no size is large enough.
    """
    corner, depth = rng.uniform(*corner_radius_m), rng.uniform(*crosswalk_m)
    has_crosswalk = [control == "signal" or bool(rng.random() < crosswalk_fraction) for _ in arms]
    distances = _compute_distances(arms, corner) + np.where(has_crosswalk, depth + 1.0, 0.0)
    turns = find_turns(arms)
    for _ in range(MAX_GROWTHS):
        arms = [arm._replace(centre=centre, distance=float(distance)) for arm, distance in zip(arms, distances, strict=True)]
        paths = _build_turns(arms, turns, 1 / turn_radius_m)
        if paths is not None:
            break
        distances = distances + GROWTH_M
    else:
        raise ConfigError(f"intersection.turn_radius_m: expected a radius that fits {len(arms)} arms, got {turn_radius_m:g}")
    junction = network.add_block(f"{len(arms)}_arms")
    stops = _add_stops(network, arms, junction, control)
    ports = [arm.port(controlled=(a, False) in stops) for a, arm in enumerate(arms)]
    network.lines += [
        (SOLID_WHITE, np.stack([arm.slot(at, entering=True) for at in (-0.5, arm.entering - 0.5)]))
        for arm, port in zip(arms, ports, strict=True)
        if port.controlled
    ]
    for turn, path in zip(turns, paths, strict=True):
        (a, slot), (b, target) = turn.source, turn.target
        stop = stops.get((a, turn.kind == "left"), stops.get((a, False)))
        street = arms[a].street
        lane = Lane(path, street.width, street.limit, _rank(street, turn.kind, control), street.kind, stop)
        network.areas.append(compute_paved_area(lane, PAVED_M))
        ports[a].entering[slot].append(number := network.add_lane(lane))
        ports[b].leaving[target].append(number)
    for a, source in enumerate(arms):
        for b, target in enumerate(arms):
            if is_straight(source, target) and min(source.street.bike, target.street.bike, source.entering, target.leaving) > 0:
                street = source.street
                path = connect(source.cycle_lane(entering=True), source.yaw + np.pi, target.cycle_lane(entering=False), target.yaw)
                rank = _rank(street, "right", control)
                lane = network.add_lane(Lane(path, street.bike, street.limit, rank, LANE_BIKE, stops.get((a, False))))
                ports[a].cycles_entering.append(lane)
                ports[b].cycles_leaving.append(lane)
    network.areas += _middle(arms, depth + 1.0)
    network.crosswalks += [arm.crosswalk(arm.distance, depth, a, junction) for a, arm in enumerate(arms) if has_crosswalk[a]]
    return ports


def _compute_distances(arms: Sequence[Arm], corner: float) -> Float[np.ndarray, " A"]:
    """Computes the distance of each arm from the centre, so that no two arms overlap and a corner of the given radius fits between them."""
    distances = np.full(len(arms), 6.0)
    for i, arm in enumerate(arms):
        j = (i + 1) % len(arms)
        between = np.mod(arms[j].yaw - arm.yaw, 2 * np.pi)
        left, right = arm.half_width("left"), arms[j].half_width("right")
        if between < OPPOSITE:
            rounding = corner / np.tan(between / 2)
            distances[i] = max(distances[i], (right + left * np.cos(between)) / np.sin(between) + rounding)
            distances[j] = max(distances[j], (left + right * np.cos(between)) / np.sin(between) + rounding)
    return distances


def _build_turns(arms: Sequence[Arm], turns: Sequence[Turn], max_curvature: float) -> list[Points] | None:
    """Computes the centre lines of connecting lanes; None if one of them bends more sharply."""
    paths = []
    for turn in turns:
        paths.append(path := _turn_path(arms, turn))
        if np.abs(curvature(path)[2:-2]).max() > max_curvature:
            return None
    return paths


def _turn_path(arms: Sequence[Arm], turn: Turn) -> Points:
    """Computes the centre line of a connecting lane."""
    source, target = arms[turn.source[0]], arms[turn.target[0]]
    start, end = source.slot(turn.source[1], entering=True), target.slot(turn.target[1], entering=False)
    return connect(start, source.yaw + np.pi, end, target.yaw)


def find_turns(arms: Sequence[Arm]) -> list[Turn]:
    """Lists left turns from the innermost lane, right turns from the outermost, and straight connections of all lanes but bays.

    A lane without a connection is connected to the nearest slot of the arm that is closest to straight ahead.
    """
    turns: list[Turn] = []
    for a, arm in enumerate(arms):
        for b, other in enumerate(arms):
            if a == b or not arm.entering or not other.leaving:
                continue
            kind = _turn_kind(arm, other)
            if kind == "straight":
                first, last = int(arm.bay == "left"), arm.entering - int(arm.bay == "right")
                turns += [Turn((a, slot), (b, slot - first), kind) for slot in range(first, last) if slot - first < other.leaving]
            else:
                slot, target = (0, 0) if kind == "left" else (arm.entering - 1, other.leaving - 1)
                turns.append(Turn((a, slot), (b, target), kind))
    sources, targets = {turn.source for turn in turns}, {turn.target for turn in turns}
    for a, arm in enumerate(arms):
        for i in range(arm.entering):
            if (a, i) not in sources:
                b = min((b for b, o in enumerate(arms) if b != a and o.leaving), key=lambda b: abs(turn_angle(arm, arms[b])))
                turns.append(Turn((a, i), (b, min(i, arms[b].leaving - 1)), _turn_kind(arm, arms[b])))
        for j in range(arm.leaving):
            if (a, j) not in targets:
                b = min((b for b, o in enumerate(arms) if b != a and o.entering), key=lambda b: abs(turn_angle(arms[b], arm)))
                turns.append(Turn((b, min(j, arms[b].entering - 1)), (a, j), _turn_kind(arms[b], arm)))
    return turns


def _turn_kind(source: Arm, target: Arm) -> str:
    return "straight" if is_straight(source, target) else "left" if turn_angle(source, target) > 0 else "right"


def compute_paved_area(lane: Lane, beside: float) -> shapely.Polygon:
    """Computes the surface of a lane, with a width beside it."""
    return shapely.LineString(lane.points).simplify(0.03).buffer(lane.width / 2 + beside, cap_style="flat")


def _rank(street: Street, kind: str, control: Control) -> int:
    """Computes the right of way of a turn: straight before right before left; before that, without lights or stops for all, by street."""
    return TURN_RANK[kind] + (0 if control in ("signal", "all_way_stop") else 5 * street.rank)


def _add_stops(network: Network, arms: Sequence[Arm], junction: int, control: Control) -> dict[tuple[int, bool], int]:
    """Adds the lights with their phases, or the signs; returns the stop of every arm that has one, and that of its protected left turn.

    Opposite arms have green together, the others alone; a left turn without oncoming traffic has an arrow.
    """
    phases: list[frozenset[int]] = []
    if control == "signal":
        pending = list(range(len(arms)))
        while pending:
            arm = pending.pop(0)
            facing = [other for other in pending if abs(wrap_angle(arms[other].yaw - arms[arm].yaw)) > OPPOSITE][:1]
            pending = [other for other in pending if other not in facing]
            phases.append(frozenset([arm, *facing]))
        network.phases[junction] = phases
    highest = max(arm.street.rank for arm in arms)
    stops = {}
    for a, arm in enumerate(arms):
        if not arm.entering or control == "yield" or (control == "two_way_stop" and arm.street.rank == highest):
            continue
        post = arm.slot(arm.entering - 0.5, entering=True) + (arm.street.bike + PAVED_M + POST_M) * heading(arm.yaw + np.pi / 2)
        for protected in (False, True) if frozenset([a]) in phases else (False,):
            stops[a, protected] = len(network.stops)
            network.stops.append(Stop("signal" if control == "signal" else "stop", a, post, junction, protected))
    return stops


def _middle(arms: Sequence[Arm], depth: float) -> Sequence[shapely.Geometry]:
    """Computes the paved surface between the arms: between two opposite arms, else from the centre to the port of the arm."""
    surface = lambda arm, near: shapely.Polygon(arm.corners(near, arm.distance + 0.05))  # noqa: E731
    near = [surface(arm, max(0.0, arm.distance - depth)) for arm in arms]
    pairs = [(a, b) for a in range(len(arms)) for b in range(a) if is_straight(arms[b], arms[a])]
    joined = [shapely.convex_hull(shapely.union(near[a], near[b])) for a, b in pairs]
    return [*joined, *(surface(arm, 0.0) for a, arm in enumerate(arms) if not any(a in pair for pair in pairs))]


def roundabout(
    rng: np.random.Generator,
    network: Network,
    centre: Place,
    arms: Sequence[Arm],
    control: Control,
    *,
    ring_radius_m: Annotated[tuple[float, float], Bounds(min=8, is_range=True)],
    ring_width_m: Annotated[tuple[float, float], Bounds(min=3, is_range=True)],
    split_deg: float,
    crosswalk_m: CrosswalkRange,
    crosswalk_fraction: Fraction,
) -> list[Port]:
    """Builds a ring with one lane, driven counter-clockwise; traffic on the ring goes first. Returns the ports of the arms.

    `arms` are counter-clockwise, with one slot in each direction.
    """
    radius, width, depth = rng.uniform(*ring_radius_m), rng.uniform(*ring_width_m), rng.uniform(*crosswalk_m)
    yaws = np.array([arm.yaw for arm in arms])
    split = min(np.radians(split_deg), 0.42 * float(np.min(np.mod(np.roll(yaws, -1) - yaws, 2 * np.pi))))
    beside = max(arm.street.median / 2 + arm.street.width / 2 for arm in arms)
    # entry and exit are arcs where the arm ends at this distance: the angle between chord and arm is half the turn
    distance = radius * np.cos(split) + max(radius * np.sin(split) - beside, 1.0) / np.tan((np.pi / 2 - split) / 2) + 2.0
    arms = [arm._replace(centre=centre, distance=distance) for arm in arms]
    junction = network.add_block("roundabout")
    ports, ring = [], []
    for a, arm in enumerate(arms):
        leave, join = arm.yaw - split, arm.yaw + split
        next_leave = join + np.mod(arms[(a + 1) % len(arms)].yaw - split - join, 2 * np.pi)
        before, after = _arc(centre, radius, leave, join), _arc(centre, radius, join, next_leave)
        limit = min(arm.street.limit, 10.0)
        entry = connect(arm.slot(0, entering=True), arm.yaw + np.pi, after[0], join + np.pi / 2)
        leaving = connect(before[0], leave + np.pi / 2, arm.slot(0, entering=False), arm.yaw)
        lanes = [
            Lane(entry, arm.street.width, limit, TURN_RANK["right"]),
            Lane(leaving, arm.street.width, limit, RING_RANK),
            Lane(before, width, limit, RING_RANK),
            Lane(after, width, limit, RING_RANK),
        ]
        network.areas += [compute_paved_area(lane, RING_PAVED_M) for lane in lanes]
        ring.append([network.add_lane(lane) for lane in lanes])
        ports.append(arm.port(controlled=True))
        ports[-1].entering[0].append(ring[-1][0])
        ports[-1].leaving[0].append(ring[-1][1])
        if rng.random() < crosswalk_fraction:
            network.crosswalks.append(arm.crosswalk(distance + depth + CROSSWALK_GAP_M, depth, a, junction))
    for (entry, _, before, after), (_, next_leaving, next_before, _) in zip(ring, [*ring[1:], ring[0]], strict=True):
        for lane, follower in ((entry, after), (before, after), (after, next_leaving), (after, next_before)):
            network.link(lane, follower)
    return ports


def _arc(centre: Place, radius: float, start: float, end: float) -> Points:
    """Computes a piece of the ring, counter-clockwise."""
    return centre + radius * heading(np.linspace(start, end, max(3, round(radius * (end - start) / FINE_M))))
