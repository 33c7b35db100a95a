"""Builds roads between ports: straight or curved, with lanes gained before a junction and dropped behind one."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.types import LANE_BIKE, LANE_STREET
from scenefactory_jax.data.generators import curves
from scenefactory_jax.data.generators.curves import FINE_M, Curve, Points, smoothstep, wrap_angle
from scenefactory_jax.data.generators.town import road_network
from scenefactory_jax.data.generators.town.road_network import BROKEN_WHITE, SOLID_WHITE, SOLID_YELLOW, Lane, Network, Port, Pose, Street

CURVE_RAD = np.radians(20.0)  # a road with a larger range of yaw is a curve
MIN_LANE_M = 6.0  # length of a lane before and behind a taper
MIN_PARKING_ROAD_M = 40.0  # length of a road with parking spaces


@dataclass(frozen=True)
class RoadDimensions:
    """Dimensions of all roads of a town."""

    bay_m: float  # length of a gained lane before a junction
    hold_m: float  # length of a lane behind a junction before it drops
    taper_m: float
    solid_m: float  # length of the solid lines before a stop
    shoulder_m: float
    spot_m: float  # length of a kerbside parking space
    spot_margin_m: float  # between the first parking space and the end of the road


class Carriageway(NamedTuple):
    """Lanes at the slots of the start and of the end of one direction of a road, and its bicycle lane."""

    start: list[int]
    end: list[int]
    cycles: list[int]


def connect_ports(
    network: Network,
    first: Port,
    second: Port,
    via: list[Pose],
    dimensions: RoadDimensions,
    build_forward: Callable[..., Carriageway] | None = None,
) -> tuple[Carriageway, Carriageway]:
    """Builds the road between two ports and returns its two directions, that from the first port to the second before the other.

    Args:
        via: poses of the middle line where bends begin and end, in the order from the first port to the second.
        build_forward: in place of `build_carriageway` for the direction from the first port to the second.
    """
    street, (points, yaw) = first.street, _middle_line(first, second, via)
    changes = [len(b.entering) - len(a.leaving) for a, b in ((first, second), (second, first))]
    kind = "curve" if np.ptp(yaw) > CURVE_RAD else "straight"
    network.add_block("lane_drop" if min(changes) < 0 else "lane_gain" if max(changes) > 0 else kind)
    ways = []
    builders = (build_forward or build_carriageway, build_carriageway)
    curves_of_both = ((points, yaw), (points[::-1], yaw[::-1] + np.pi))
    for build, curve, a, b in zip(builders, curves_of_both, (first, second), (second, first), strict=True):
        way = build(network, curve, len(a.leaving), len(b.entering), street, dimensions, side=b.side, controlled=b.controlled)
        ways.append(way)
        network.link_slots([*a.leaving, a.cycles_leaving], [*([lane] for lane in way.start), way.cycles])
        network.link_slots([*([lane] for lane in way.end), way.cycles], [*b.entering, b.cycles_entering])
    if street.median == 0 and street.centre_line is not None:
        network.lines.append((street.centre_line, points))
    if street.median > 2 * dimensions.shoulder_m + 0.5:
        half = street.median / 2 - dimensions.shoulder_m
        trim = max(2, round((half + 1.0) / FINE_M))
        network.islands.append(shapely.LineString(points[trim:-trim]).simplify(0.02).buffer(half, quad_segs=4))
    return ways[0], ways[1]


def _middle_line(first: Port, second: Port, via: list[Pose]) -> Curve:
    """Computes the middle line of the road and its yaw: smooth between the two ports and through every corner."""
    poses = [(first.place, first.yaw), *via, (second.place, second.yaw + np.pi)]
    points = curves.join([curves.connect(a, a_yaw, b, b_yaw) for (a, a_yaw), (b, b_yaw) in itertools.pairwise(poses)])
    yaw = curves.tangents(points)
    yaw[0] += wrap_angle(first.yaw - float(yaw[0]))
    yaw[-1] += wrap_angle(second.yaw + np.pi - float(yaw[-1]))
    return points, yaw


def shift_line(curve: Curve, right: float | Float[np.ndarray, " N"]) -> Points:
    """Shifts a curve to its right by a distance that may vary along it."""
    points, yaw = curve
    return points + np.stack([np.sin(yaw), -np.cos(yaw)], axis=-1) * np.broadcast_to(right, len(points))[:, None]


def build_carriageway(
    network: Network, curve: Curve, before: int, behind: int, street: Street, dimensions: RoadDimensions, *, side: str, controlled: bool
) -> Carriageway:
    """Builds one direction of a road on the right of a curve.

    Args:
        before, behind: lanes at the start and at the end, which differ by one or less.
        side: on which a lane is gained; lanes are dropped on the right.
        controlled: solid lines before the end.
    """
    place = curves.arc_length(curve[0])
    i, j = (int(np.searchsorted(place, at)) for at in _taper(before, behind, float(place[-1]), dimensions))
    ease = smoothstep((place - place[i]) / (place[j] - place[i]))
    offset = lambda slot: street.median / 2 + (slot + 0.5) * street.width  # noqa: E731

    def add(rows: slice, right: np.ndarray | float, rank: int = road_network.ON_ROAD) -> int:
        points = shift_line((curve[0][rows], curve[1][rows]), np.broadcast_to(right, place.shape)[rows])
        return network.add_lane(Lane(points, street.width, street.limit, rank, street.kind))

    if before == behind:
        sections = [(slice(None), before)]
        start = end = [add(slice(None), offset(slot)) for slot in range(before)]
    else:
        sections = [(slice(0, i + 1), before), (slice(j, None), behind)]
        start, end = ([add(rows, offset(slot)) for slot in range(count)] for rows, count in sections)
        for a, b in _pair_slots(before, behind, side):
            rank = road_network.MERGING if behind < before and a == before - 1 else road_network.ON_ROAD
            lane = add(slice(i, j + 1), offset(a) + (offset(b) - offset(a)) * ease, rank)
            network.link(start[a], lane)
            network.link(lane, end[b])
        network.put_side_by_side(end)
    network.put_side_by_side(start)
    outer = street.median / 2 + street.width * (before + (behind - before) * ease)
    cycles = []
    if street.bike:
        points = shift_line(curve, outer + street.bike / 2)
        cycles.append(network.add_lane(Lane(points, street.bike, street.limit, road_network.ON_ROAD, LANE_BIKE)))
    parking = _parking_width(place, street, dimensions)
    network.areas.append(_paved_area(curve, outer + street.bike + parking + dimensions.shoulder_m))
    if parking.any():
        network.spots += _parking_spaces(curve, place, outer + street.bike + parking / 2, dimensions)
    solid = place[-1] - (dimensions.solid_m if controlled else 0.0)
    for rows, count in sections:
        for slot in range(1, count):
            points = shift_line((curve[0][rows], curve[1][rows]), street.median / 2 + slot * street.width)
            split = int(np.searchsorted(place[rows], solid))
            parts = ((BROKEN_WHITE, points[: split + 1]), (SOLID_WHITE, points[split:]))
            network.lines += [(kind, part) for kind, part in parts if len(part) > 4]
    if street.median:
        network.lines.append((SOLID_YELLOW, shift_line(curve, street.median / 2)))
    if street.bike or street.kind != LANE_STREET:
        network.lines.append((SOLID_WHITE, shift_line(curve, outer)))
    return Carriageway(start, end, cycles)


def _taper(before: int, behind: int, length: float, dimensions: RoadDimensions) -> tuple[float, float]:
    """Computes where a taper begins and ends: near the end of the road for a gained lane, near its start for a dropped one."""
    room = max(length - 2 * MIN_LANE_M, 2.0)
    taper = min(dimensions.taper_m, 0.8 * room)
    begin = length - dimensions.bay_m - taper if behind > before else dimensions.hold_m
    begin = float(np.clip(begin, MIN_LANE_M, max(MIN_LANE_M, length - MIN_LANE_M - taper)))
    return begin, begin + taper


def _pair_slots(before: int, behind: int, side: str) -> list[tuple[int, int]]:
    """Lists the slots that the lanes of a taper lead from and to."""
    if behind < before:
        return [*((slot, slot) for slot in range(behind)), (before - 1, behind - 1)]
    if side == "left":
        return [(0, 0), *((slot, slot + 1) for slot in range(before))]
    return [*((slot, slot) for slot in range(before)), (before - 1, before)]


def _parking_width(place: Float[np.ndarray, " N"], street: Street, dimensions: RoadDimensions) -> Float[np.ndarray, " N"]:
    """Computes the width of the parking strip along the road, zero near its ends."""
    if not street.parking or place[-1] <= MIN_PARKING_ROAD_M:
        return np.zeros_like(place)
    near = np.minimum(place, place[-1] - place)
    return street.parking * np.clip((near - dimensions.spot_margin_m + 3.0) / 3.0, 0.0, 1.0)


def _paved_area(curve: Curve, outer: Float[np.ndarray, " N"]) -> shapely.Polygon:
    """Computes the paved surface from the middle of the road to the kerb."""
    rows = np.unique(np.append(np.arange(0, len(outer), 4), len(outer) - 1))
    thinned = curve[0][rows], curve[1][rows]
    inner = shift_line(thinned, -0.05)  # so that the areas of both directions overlap
    return shapely.Polygon(np.concatenate([inner, shift_line(thinned, outer[rows])[::-1]]))


def _parking_spaces(
    curve: Curve, place: Float[np.ndarray, " N"], beside: Float[np.ndarray, " N"], dimensions: RoadDimensions
) -> list[Pose]:
    """Lists kerbside parking spaces in a row."""
    margin = dimensions.spot_margin_m + dimensions.spot_m / 2
    at = np.arange(margin, place[-1] - dimensions.spot_margin_m - dimensions.spot_m / 2, dimensions.spot_m)
    places = curves.interpolate(at, place, shift_line(curve, beside))
    return [(spot, float(yaw)) for spot, yaw in zip(places, np.interp(at, place, curve[1]), strict=True)]
