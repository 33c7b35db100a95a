"""Roads between ports: straight or curved, with lanes gained before a junction and dropped behind one."""

import itertools
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_BIKE, LANE_STREET
from scenefactory_jax.data.generators.curves import Curve, Points, arc_length, connect, tangents, wrap_angle
from scenefactory_jax.data.generators.town.road_network import (
    BROKEN_WHITE,
    MERGING,
    ON_ROAD,
    SOLID_WHITE,
    SOLID_YELLOW,
    Block,
    Lane,
    Line,
    Port,
    Spot,
    Street,
)

CURVED = np.radians(20.0)  # a road that turns by more is called a curve
SHORTEST_M = 6.0  # of a lane before and behind a taper


Pose = tuple[Float[np.ndarray, " 2"], float]


class RoadDimensions(NamedTuple):
    """Measures that all roads of a town share, m."""

    bay: float  # length of a gained lane before the junction
    hold: float  # length of a lane behind the junction before it drops
    taper: float
    solid: float  # of the white lines before a stop
    shoulder: float
    spot: float  # length of a kerbside parking space
    spot_margin: float  # between the first space and the road's end


def make_dimensions(
    *, bay_m: float, hold_m: float, taper_m: float, solid_m: float, shoulder_m: float, spot_m: float, spot_margin_m: float
) -> RoadDimensions:
    """`Numbers` from a config entry."""
    return RoadDimensions(bay_m, hold_m, taper_m, solid_m, shoulder_m, spot_m, spot_margin_m)


class RoadAxis(NamedTuple):
    """One direction of a road. `start` and `end` are the lanes at each slot of its two ends."""

    lanes: list[Lane]
    follows: list[tuple[int, int]]
    beside: list[tuple[int, int]]
    lines: list[Line]
    area: shapely.Polygon
    spots: list[Spot]
    start: list[int]
    end: list[int]
    cycles: tuple[int, ...]


def link(one: Port, other: Port, via: list[Pose], numbers: RoadDimensions) -> Block:
    """The road from a port to another: port 0 meets the first, port 1 the second.

    Args:
        via: places and yaws of the middle line on the way, from the first port on: where corners begin and end.
    """
    reference = _reference(one, other, via)
    street = one.street
    points, yaw = reference
    back = (points[::-1], yaw[::-1] + np.pi)
    ways = [
        lay_road(curve, len(first.leaving), len(second.entering), street, numbers, side=second.side, controlled=second.controlled)
        for curve, first, second in ((reference, one, other), (back, other, one))
        if first.leaving
    ]
    both = len(one.leaving) > 0 and len(other.leaving) > 0
    lines = [Line(street.centre_line, points)] if both and street.median == 0 else []
    kind = "curve" if np.ptp(yaw) > CURVED else "straight"
    changed = [len(b.entering) - len(a.leaving) for a, b in ((one, other), (other, one))]
    kind = "lane_drop" if min(changed) < 0 else "lane_gain" if max(changed) > 0 else kind
    block = stack_lines(kind, ways)
    islands = [_median(points, street, numbers)] if both and street.median > 2 * numbers.shoulder + 0.5 else []
    return block._replace(lines=[*block.lines, *lines], islands=islands, ports=_ports(one, other, ways))


def stack_lines(kind: str, ways: list[RoadAxis]) -> Block:
    """Ways as one block, without ports."""
    base, lanes, follows, beside = 0, [], [], []
    for way in ways:
        follows += [(a + base, b + base) for a, b in way.follows]
        beside += [(a + base, b + base) for a, b in way.beside]
        lanes += way.lanes
        base += len(way.lanes)
    lines = [line for way in ways for line in way.lines]
    return Block(kind, lanes, follows, beside, lines, [way.area for way in ways], spots=[spot for way in ways for spot in way.spots])


def _ports(one: Port, other: Port, ways: list[RoadAxis]) -> list[Port]:
    """The road's own ends, facing those it was laid between."""
    ahead = ways[0] if one.leaving else None
    back = ways[-1] if other.leaving else None
    base = len(ahead.lanes) if ahead is not None else 0
    first = lambda way, at: tuple((i + at,) for i in way.start) if way else ()  # noqa: E731
    last = lambda way, at: tuple((i + at,) for i in way.end) if way else ()  # noqa: E731
    cycles = lambda way, at: tuple(i + at for i in way.cycles) if way else ()  # noqa: E731
    turn = np.pi
    near = Port(one.place, one.yaw + turn, one.street, last(back, base), first(ahead, 0), cycles(back, base), cycles(ahead, 0))
    far = Port(other.place, other.yaw + turn, one.street, last(ahead, 0), first(back, base), cycles(ahead, 0), cycles(back, base))
    return [near, far]


def _reference(one: Port, other: Port, via: list[Pose]) -> Curve:
    """Middle line of the road, and its yaw: smooth between the two ports and through every corner."""
    poses = [(one.place, one.yaw), *via, (other.place, other.yaw + np.pi)]
    pieces = [connect(a, a_yaw, b, b_yaw) for (a, a_yaw), (b, b_yaw) in itertools.pairwise(poses)]
    points = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
    yaw = tangents(points)
    yaw[0] += wrap_angle(one.yaw - float(yaw[0]))
    yaw[-1] += wrap_angle(other.yaw + np.pi - float(yaw[-1]))
    return points, yaw


def shift_line(curve: Curve, right: float | Float[np.ndarray, " N"]) -> Points:
    """The curve at a distance to its right, which may vary along it."""
    points, yaw = curve
    return points + np.stack([np.sin(yaw), -np.cos(yaw)], axis=-1) * np.broadcast_to(right, len(points))[:, None]


def _median(points: Points, street: Street, numbers: RoadDimensions) -> shapely.Polygon:
    """The strip between the directions, rounded at its ends."""
    half = street.median / 2 - numbers.shoulder
    trim = max(2, round((half + 1.0) / 0.25))
    return shapely.LineString(points[trim:-trim]).simplify(0.02).buffer(half, quad_segs=4)


def lay_road(curve: Curve, before: int, behind: int, street: Street, numbers: RoadDimensions, *, side: str, controlled: bool) -> RoadAxis:
    """One direction along a curve, its lanes on its right: `before` at the start, `behind` at the end, one more or less at most.

    Args:
        side: at which the lane is gained; lanes are dropped on the right.
        controlled: solid lines before the end.
    """
    place = arc_length(curve[0])
    length = float(place[-1])
    i, j = (int(np.searchsorted(place, at)) for at in _taper(before, behind, length, numbers))
    begin, end = place[i], place[j]
    share = np.clip((place - begin) / (end - begin), 0.0, 1.0)
    ease = share * share * (3 - 2 * share)
    count = before + (behind - before) * ease  # lanes, with parts of one in the taper
    middle = lambda slot: street.median / 2 + (slot + 0.5) * street.width  # noqa: E731
    lanes: list[Lane] = []
    follows: list[tuple[int, int]] = []

    def lay(rows: slice, right: np.ndarray | float, rank: int = ON_ROAD) -> int:
        points = shift_line((curve[0][rows], curve[1][rows]), np.broadcast_to(right, place.shape)[rows])
        lanes.append(Lane(points, street.width, street.limit, rank, street.kind))
        return len(lanes) - 1

    whole = slice(None)
    if before == behind:
        start = finish = [lay(whole, middle(slot)) for slot in range(before)]
        sections = [(whole, before)]
        beside = [*itertools.pairwise(start)]
    else:
        sections = [(slice(0, i + 1), before), (slice(j, None), behind)]
        start = [lay(sections[0][0], middle(slot)) for slot in range(before)]
        finish = [lay(sections[1][0], middle(slot)) for slot in range(behind)]
        for a, b in _strands(before, behind, side):
            rank = MERGING if behind < before and a == before - 1 else ON_ROAD
            own = lay(slice(i, j + 1), middle(a) + (middle(b) - middle(a)) * ease, rank)
            follows += [(start[a], own), (own, finish[b])]
        beside = [*itertools.pairwise(start), *itertools.pairwise(finish)]
    outer = street.median / 2 + street.width * count
    cycles = (len(lanes),) if street.bike else ()
    if street.bike:
        lanes.append(Lane(shift_line(curve, outer + street.bike / 2), street.bike, street.limit, ON_ROAD, LANE_BIKE))
    room = _room(place, street, numbers)
    area = _area(curve, street, outer + street.bike + room + numbers.shoulder, numbers.shoulder)
    spots = _spots(curve, place, outer + street.bike + room / 2, numbers) if street.parking and length > 40.0 else []
    lines = _lines(curve, place, sections, outer, street, numbers, controlled=controlled)
    return RoadAxis(lanes, follows, beside, lines, area, spots, start, finish, cycles)


def _taper(before: int, behind: int, length: float, numbers: RoadDimensions) -> tuple[float, float]:
    """Where a taper begins and ends: a lane is gained just before the road's end and dropped soon after its start."""
    room = max(length - 2 * SHORTEST_M, 2.0)
    taper = min(numbers.taper, 0.8 * room)
    begin = length - numbers.bay - taper if behind > before else numbers.hold
    begin = float(np.clip(begin, SHORTEST_M, max(SHORTEST_M, length - SHORTEST_M - taper)))
    return begin, begin + taper


def _strands(before: int, behind: int, side: str) -> list[tuple[int, int]]:
    """The slots that a taper's lanes lead from and to."""
    if behind < before:
        return [*((slot, slot) for slot in range(behind)), (before - 1, behind - 1)]
    if side == "left":
        return [(0, 0), *((slot, slot + 1) for slot in range(before))]
    return [*((slot, slot) for slot in range(before)), (before - 1, before)]


def _room(place: Float[np.ndarray, " N"], street: Street, numbers: RoadDimensions) -> Float[np.ndarray, " N"]:
    """Width of the parking strip along the road: none near its ends."""
    if not street.parking or place[-1] <= 40.0:
        return np.zeros_like(place)
    near = np.minimum(place, place[-1] - place)
    return street.parking * np.clip((near - numbers.spot_margin + 3.0) / 3.0, 0.0, 1.0)


def _area(curve: Curve, street: Street, outer: Float[np.ndarray, " N"], shoulder: float) -> shapely.Polygon:
    """Paved surface from the middle of the road to the kerb."""
    step = slice(None, None, 4)
    rows = np.unique(np.concatenate([np.arange(len(outer))[step], [len(outer) - 1]]))
    thinned = curve[0][rows], curve[1][rows]
    kerb = shift_line(thinned, outer[rows])
    # a hair over the middle, so that the two directions share area and become one surface
    inner = shift_line(thinned, -0.05 if street.forward and street.backward else -shoulder)
    return shapely.Polygon(np.concatenate([inner, kerb[::-1]]))


def _spots(curve: Curve, place: Float[np.ndarray, " N"], beside: Float[np.ndarray, " N"], numbers: RoadDimensions) -> list[Spot]:
    """Kerbside parking spaces, one behind the other."""
    at = np.arange(numbers.spot_margin + numbers.spot / 2, place[-1] - numbers.spot_margin - numbers.spot / 2, numbers.spot)
    points, yaw = shift_line(curve, beside), curve[1]
    places = np.stack([np.interp(at, place, points[:, 0]), np.interp(at, place, points[:, 1])], axis=-1)
    return [Spot(spot, float(turn)) for spot, turn in zip(places, np.interp(at, place, yaw), strict=True)]


def _lines(
    curve: Curve,
    place: Float[np.ndarray, " N"],
    sections: list[tuple[slice, int]],
    outer: Float[np.ndarray, " N"],
    street: Street,
    numbers: RoadDimensions,
    *,
    controlled: bool,
) -> list[Line]:
    """Broken lines between lanes, solid before a stop; a solid one beside a median and beside the bicycle lane."""
    lines = []
    solid = place[-1] - (numbers.solid if controlled else 0.0)
    for rows, count in sections:
        for slot in range(1, count):
            points = shift_line((curve[0][rows], curve[1][rows]), street.median / 2 + slot * street.width)
            split = int(np.searchsorted(place[rows], solid))
            parts = ((BROKEN_WHITE, points[: split + 1]), (SOLID_WHITE, points[split:]))
            lines += [Line(kind, part) for kind, part in parts if len(part) > 4]
    if street.median:
        lines.append(Line(SOLID_YELLOW, shift_line(curve, street.median / 2)))
    if street.bike or street.kind != LANE_STREET:
        lines.append(Line(SOLID_WHITE, shift_line(curve, outer)))
    return lines
