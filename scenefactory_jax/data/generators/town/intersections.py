"""Builds junctions: intersections of three to five arms, and roundabouts."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.schema import ConfigError, Fraction, Positive
from scenefactory_jax.core.types import LANE_BIKE
from scenefactory_jax.data.generators.curves import FINE_M, Points, connect, curvature, heading, wrap_angle
from scenefactory_jax.data.generators.ranges import check_range, draw
from scenefactory_jax.data.generators.town.road_network import SOLID_WHITE, Block, Crosswalk, Lane, Line, Port, Stop, Street

Place = Float[np.ndarray, " 2"]
Control = Literal["signal", "all_way_stop", "two_way_stop", "yield"]
STRAIGHT_RAD = np.radians(40.0)  # maximum angle of a turn that goes straight on
OPPOSITE = np.radians(150.0)  # minimum angle between arms that have green together
MAX_GROWTHS, GROWTH_M = 24, 1.5  # of an intersection, until its sharpest turn has the minimum radius
TURN_RANK = {"straight": 4, "right": 3, "left": 2}
RING_RANK = 50
PAVED_M = 0.3  # between the side of a lane and the kerb in a junction
RING_PAVED_M = 0.5  # the same in a roundabout
POST_M = 1.5  # from the kerb to a stop sign


class Arm(NamedTuple):
    """A street that ends at a junction."""

    yaw: float  # away from the junction
    street: Street
    leaving: int  # lanes out of the junction
    entering: int
    bay: str = ""  # side of a lane that only turns: "left", "right" or none


class Mouth(NamedTuple):
    """End of an arm at a junction."""

    arm: Arm
    index: int  # of the arm
    centre: Place  # of the junction
    distance: float  # from the centre, m

    def at(self, along: float, across: float) -> Place:
        """Place at distances from the centre along the arm and to its left, looking away from the junction."""
        return self.centre + along * heading(self.arm.yaw) + across * heading(self.arm.yaw + np.pi / 2)

    def slot(self, slot: int | float, *, entering: bool) -> Place:
        """Place where a slot meets the junction; slots at half numbers are lines between lanes."""
        beside = self.arm.street.median / 2 + (slot + 0.5) * self.arm.street.width
        return self.at(self.distance, beside if entering else -beside)

    def cycle_lane(self, *, entering: bool) -> Place:
        """Place where the bicycle lane meets the junction."""
        slots = self.arm.entering if entering else self.arm.leaving
        aside = self.arm.street.bike / 2 * heading(self.arm.yaw + np.pi / 2)
        return self.slot(slots - 0.5, entering=entering) + (aside if entering else -aside)

    def corners(self, near: float, far: float) -> list[Place]:
        """Corners of the whole width of the arm between two distances from the centre."""
        left, right = half_width(self.arm, "left"), half_width(self.arm, "right")
        return [self.at(x, y) for x, y in ((near, -right), (far, -right), (far, left), (near, left))]


class Turn(NamedTuple):
    """A connection through a junction from an entering slot of one arm to a leaving slot of another."""

    source: tuple[int, int]  # arm, slot
    target: tuple[int, int]
    kind: str  # "straight", "left", "right"


def intersection(
    rng: np.random.Generator,
    centre: Place,
    arms: Sequence[Arm],
    control: Control,
    *,
    corner_radius_m: list[float],
    turn_radius_m: Positive,
    crosswalk_m: list[float],
    crosswalk_fraction: Fraction,
) -> Block:
    """Builds an intersection, large enough for turns with a minimum radius.

    Args:
        arms: counter-clockwise.
        corner_radius_m: range of the radius of the corners.
        turn_radius_m: minimum radius of the connecting lanes.
        crosswalk_m: range of the depth of the crosswalks.
        crosswalk_fraction: of the arms that have a crosswalk; at lights all have one.

    Raises:
        ConfigError: no size is large enough.
    """
    corner = draw(rng, corner_radius_m, "intersection.corner_radius_m")
    depth = draw(rng, crosswalk_m, "intersection.crosswalk_m", low=1.0)
    has_crosswalk = [control == "signal" or bool(rng.random() < crosswalk_fraction) for _ in arms]
    distances = _compute_distances(arms, corner) + np.where(has_crosswalk, depth + 1.0, 0.0)
    turns = find_turns(arms)
    for _ in range(MAX_GROWTHS):
        mouths = [Mouth(arm, a, centre, float(distances[a])) for a, arm in enumerate(arms)]
        paths = [_turn_path(mouths, turn) for turn in turns]
        if max(np.abs(curvature(path)[2:-2]).max() for path in paths) <= 1 / turn_radius_m:
            return _assemble(mouths, turns, paths, control, has_crosswalk, depth)
        distances = distances + GROWTH_M
    raise ConfigError(f"intersection.turn_radius_m: expected a radius that fits {len(arms)} arms, got {turn_radius_m:g}")


def half_width(arm: Arm, side: Literal["left", "right"]) -> float:
    """Computes the distance from the middle of an arm to its kerb, looking away from the junction: entering lanes are on the left."""
    slots = arm.entering if side == "left" else arm.leaving
    return arm.street.median / 2 + slots * arm.street.width + arm.street.bike + PAVED_M


def _compute_distances(arms: Sequence[Arm], corner: float) -> Float[np.ndarray, " A"]:
    """Computes the distance of each arm from the centre, so that no two arms overlap and a corner of the given radius fits between them."""
    distances = np.full(len(arms), 6.0)
    for i, arm in enumerate(arms):
        j = (i + 1) % len(arms)
        between = np.mod(arms[j].yaw - arm.yaw, 2 * np.pi)
        left, right = half_width(arm, "left"), half_width(arms[j], "right")
        if between < OPPOSITE:
            rounding = corner / np.tan(between / 2)
            distances[i] = max(distances[i], (right + left * np.cos(between)) / np.sin(between) + rounding)
            distances[j] = max(distances[j], (left + right * np.cos(between)) / np.sin(between) + rounding)
    return distances


def _turn_path(mouths: Sequence[Mouth], turn: Turn) -> Points:
    """Computes the centre line of a connecting lane."""
    source, target = mouths[turn.source[0]], mouths[turn.target[0]]
    start, end = source.slot(turn.source[1], entering=True), target.slot(turn.target[1], entering=False)
    return connect(start, source.arm.yaw + np.pi, end, target.arm.yaw)


def find_turns(arms: Sequence[Arm]) -> list[Turn]:
    """Lists left turns from the innermost lane, right turns from the outermost, and straight connections of all lanes but bays.

    A lane without a connection is connected to the nearest slot of the arm that is closest to straight ahead.
    """
    turns: list[Turn] = []
    for a, arm in enumerate(arms):
        for b, other in enumerate(arms):
            if a == b or not arm.entering or not other.leaving:
                continue
            angle = wrap_angle(other.yaw - arm.yaw - np.pi)
            if abs(angle) < STRAIGHT_RAD:
                first, last = int(arm.bay == "left"), arm.entering - int(arm.bay == "right")
                turns += [Turn((a, slot), (b, slot - first), "straight") for slot in range(first, last) if slot - first < other.leaving]
            elif angle > 0:
                turns.append(Turn((a, 0), (b, 0), "left"))
            else:
                turns.append(Turn((a, arm.entering - 1), (b, other.leaving - 1), "right"))
    return turns + _connect_loose_ends(arms, turns)


def _connect_loose_ends(arms: Sequence[Arm], turns: Sequence[Turn]) -> list[Turn]:
    """Lists turns for the slots without one."""
    extra = []
    angle = lambda a, b: wrap_angle(arms[b].yaw - arms[a].yaw - np.pi)  # noqa: E731
    kind = lambda a, b: "straight" if abs(angle(a, b)) < STRAIGHT_RAD else "left" if angle(a, b) > 0 else "right"  # noqa: E731
    sources, targets = {turn.source for turn in turns}, {turn.target for turn in turns}
    for a, arm in enumerate(arms):
        for i in range(arm.entering):
            if (a, i) not in sources:
                b = min((b for b in range(len(arms)) if b != a and arms[b].leaving), key=lambda b: abs(angle(a, b)))
                extra.append(Turn((a, i), (b, min(i, arms[b].leaving - 1)), kind(a, b)))
        for j in range(arm.leaving):
            if (a, j) not in targets:
                b = min((b for b in range(len(arms)) if b != a and arms[b].entering), key=lambda b: abs(angle(b, a)))
                extra.append(Turn((b, min(j, arms[b].entering - 1)), (a, j), kind(b, a)))
    return extra


def _assemble(
    mouths: Sequence[Mouth], turns: Sequence[Turn], paths: Sequence[Points], control: Control, has_crosswalk: Sequence[bool], depth: float
) -> Block:
    """Builds lanes with their right of way, stops, crosswalks and ports, and bicycle lanes straight on."""
    arms = [mouth.arm for mouth in mouths]
    phases = _phases(arms) if control == "signal" else []
    highest = max(arm.street.rank for arm in arms)
    stops = [stop for mouth in mouths for stop in _stops(mouth, control, phases, highest)]
    stop_of = {(stop.arm, stop.protected): index for index, stop in enumerate(stops)}
    cycles = [(a, b) for a in range(len(arms)) for b in range(len(arms)) if _has_cycle_lane(arms[a], arms[b])]
    lanes = []
    for turn, path in zip(turns, paths, strict=True):
        street = arms[turn.source[0]].street
        stop = stop_of.get((turn.source[0], turn.kind == "left"), stop_of.get((turn.source[0], False)))
        lanes.append(Lane(path, street.width, street.limit, _rank(street, turn.kind, control), street.kind, stop))
    for a, b in cycles:
        street = arms[a].street
        path = connect(mouths[a].cycle_lane(entering=True), arms[a].yaw + np.pi, mouths[b].cycle_lane(entering=False), arms[b].yaw)
        lanes.append(Lane(path, street.bike, street.limit, _rank(street, "right", control), LANE_BIKE, stop_of.get((a, False))))
    stopping = {stop.arm for stop in stops}
    lines = [
        np.stack([mouth.slot(at, entering=True) for at in (-0.5, mouth.arm.entering - 0.5)]) for mouth in mouths if mouth.index in stopping
    ]
    return Block(
        kind=f"{len(arms)}_arms",
        lanes=lanes,
        lines=[Line(SOLID_WHITE, line) for line in lines],
        areas=[*(compute_paved_area(lane, PAVED_M) for lane in lanes[: len(turns)]), *_middle(mouths, depth + 1.0)],
        stops=stops,
        crosswalks=[_crosswalk(mouth, mouth.distance, depth) for mouth in mouths if has_crosswalk[mouth.index]],
        ports=[_port(mouth, turns, cycles, mouth.index in stopping) for mouth in mouths],
        phases=phases,
    )


def compute_paved_area(lane: Lane, beside: float) -> shapely.Polygon:
    """Computes the surface of a lane, with a width beside it."""
    return shapely.LineString(lane.points).simplify(0.03).buffer(lane.width / 2 + beside, cap_style="flat")


def _rank(street: Street, kind: str, control: Control) -> int:
    """Computes the right of way of a turn: straight before right before left; before that, without lights or stops for all, by street."""
    return TURN_RANK[kind] + (0 if control in ("signal", "all_way_stop") else 5 * street.rank)


def _phases(arms: Sequence[Arm]) -> list[frozenset[int]]:
    """Lists the arms that have green together: opposite ones in pairs, the others alone."""
    pending, phases = list(range(len(arms))), []
    while pending:
        arm = pending.pop(0)
        facing = [other for other in pending if abs(wrap_angle(arms[other].yaw - arms[arm].yaw)) > OPPOSITE]
        if facing:
            pending.remove(facing[0])
        phases.append(frozenset([arm, *facing[:1]]))
    return phases


def _stops(mouth: Mouth, control: Control, phases: Sequence[frozenset[int]], highest: int) -> list[Stop]:
    """Lists the lights or the sign of an arm; a left turn without oncoming traffic has an arrow.

    Args:
        highest: rank of the streets at the junction.
    """
    arm, index = mouth.arm, mouth.index
    if not arm.entering:
        return []
    post = mouth.slot(arm.entering - 0.5, entering=True) + (arm.street.bike + PAVED_M + POST_M) * heading(arm.yaw + np.pi / 2)
    if control == "signal":
        alone = frozenset([index]) in phases
        return [Stop("signal", index, post), *([Stop("signal", index, post, protected=True)] if alone else [])]
    if control == "all_way_stop" or (control == "two_way_stop" and arm.street.rank < highest):
        return [Stop("stop", index, post)]
    return []


def _is_straight(source: Arm, target: Arm) -> bool:
    """Checks whether the way from one arm to another goes straight on."""
    return bool(abs(wrap_angle(target.yaw - source.yaw - np.pi)) < STRAIGHT_RAD)


def _has_cycle_lane(source: Arm, target: Arm) -> bool:
    """Checks whether a bicycle lane leads straight on from one arm to another."""
    return _is_straight(source, target) and min(source.street.bike, target.street.bike, source.entering, target.leaving) > 0


def _middle(mouths: Sequence[Mouth], depth: float) -> Sequence[shapely.Geometry]:
    """Computes the paved surface between the arms: between two opposite arms, else from the centre to the port of the arm."""
    surface = lambda mouth, near: shapely.Polygon(mouth.corners(near, mouth.distance + 0.05))  # noqa: E731
    near = [surface(mouth, max(0.0, mouth.distance - depth)) for mouth in mouths]
    pairs = [(a, b) for a in range(len(mouths)) for b in range(a) if _is_straight(mouths[b].arm, mouths[a].arm)]
    joined = [shapely.convex_hull(shapely.union(near[a], near[b])) for a, b in pairs]
    return [*joined, *(surface(mouth, 0.0) for mouth in mouths if not any(mouth.index in pair for pair in pairs))]


def _crosswalk(mouth: Mouth, distance: float, depth: float) -> Crosswalk:
    """Computes the crosswalk across an arm whose stop line is at a distance from the centre."""
    near, far = distance - 0.8 - depth, distance - 0.8
    left, right = half_width(mouth.arm, "left"), half_width(mouth.arm, "right")
    ends = np.stack([mouth.at((near + far) / 2, across) for across in (-right, left)])
    return Crosswalk(np.stack(mouth.corners(near, far)), ends, mouth.index)


def _port(mouth: Mouth, turns: Sequence[Turn], cycles: Sequence[tuple[int, int]], controlled: bool) -> Port:
    """Computes the port of an arm; bicycle lanes are numbered after the turns."""
    arm, index = mouth.arm, mouth.index
    leaving = tuple(tuple(t for t, turn in enumerate(turns) if turn.target == (index, slot)) for slot in range(arm.leaving))
    entering = tuple(tuple(t for t, turn in enumerate(turns) if turn.source == (index, slot)) for slot in range(arm.entering))
    out = tuple(len(turns) + c for c, (_, b) in enumerate(cycles) if b == index)
    into = tuple(len(turns) + c for c, (a, _) in enumerate(cycles) if a == index)
    return Port(mouth.at(mouth.distance, 0.0), arm.yaw, arm.street, leaving, entering, out, into, arm.bay or "right", controlled)


def roundabout(
    rng: np.random.Generator,
    centre: Place,
    arms: Sequence[Arm],
    control: Control,
    *,
    ring_radius_m: list[float],
    ring_width_m: list[float],
    split_deg: float,
    crosswalk_m: list[float],
    crosswalk_fraction: Fraction,
) -> Block:
    """Builds a ring with one lane, driven counter-clockwise; traffic on the ring goes first.

    Args:
        arms: counter-clockwise, with one slot in each direction.
        ring_radius_m: range of the radius of the lane's centre.
        split_deg: maximum angle between an arm and the points where its traffic leaves and joins the ring.

    Raises:
        ConfigError: numbers out of range.
    """
    check_range(ring_radius_m, "roundabout.ring_radius_m", low=8.0)
    radius, width = draw(rng, ring_radius_m, "roundabout.ring_radius_m"), draw(rng, ring_width_m, "roundabout.ring_width_m", low=3.0)
    depth = draw(rng, crosswalk_m, "roundabout.crosswalk_m", low=1.0)
    yaws = np.array([arm.yaw for arm in arms])
    split = min(np.radians(split_deg), 0.42 * float(np.min(np.mod(np.roll(yaws, -1) - yaws, 2 * np.pi))))
    beside = max(arm.street.median / 2 + arm.street.width / 2 for arm in arms)
    # entry and exit are arcs where the mouth lies at this distance: the angle between chord and arm is half the turn
    distance = radius * np.cos(split) + max(radius * np.sin(split) - beside, 1.0) / np.tan((np.pi / 2 - split) / 2) + 2.0
    lanes: list[Lane] = []
    follows, ports, walks = [], [], []
    for index, arm in enumerate(arms):
        base, following = 4 * index, 4 * ((index + 1) % len(arms))
        leave, join = arm.yaw - split, arm.yaw + split
        next_leave = join + np.mod(arms[(index + 1) % len(arms)].yaw - split - join, 2 * np.pi)
        before, after = _ring(centre, radius, leave, join), _ring(centre, radius, join, next_leave)
        end = Mouth(arm, index, centre, distance)
        limit = min(arm.street.limit, 10.0)
        entry = connect(end.slot(0, entering=True), arm.yaw + np.pi, after[0], join + np.pi / 2)
        leaving = connect(before[0], leave + np.pi / 2, end.slot(0, entering=False), arm.yaw)
        lanes += [Lane(entry, arm.street.width, limit, TURN_RANK["right"]), Lane(leaving, arm.street.width, limit, RING_RANK)]
        lanes += [Lane(before, width, limit, RING_RANK), Lane(after, width, limit, RING_RANK)]
        follows += [(base, base + 3), (base + 2, base + 3), (base + 3, following + 1), (base + 3, following + 2)]
        if rng.random() < crosswalk_fraction:
            walks.append(_crosswalk(end, distance + depth + 0.8, depth))
        ports.append(Port(end.at(distance, 0.0), arm.yaw, arm.street, ((base + 1,),), ((base,),), controlled=True))
    return Block(
        "roundabout", lanes, follows, areas=[compute_paved_area(lane, RING_PAVED_M) for lane in lanes], crosswalks=walks, ports=ports
    )


def _ring(centre: Place, radius: float, start: float, end: float) -> Points:
    """Computes a piece of the ring, counter-clockwise."""
    return centre + radius * heading(np.linspace(start, end, max(3, round(radius * (end - start) / FINE_M))))
