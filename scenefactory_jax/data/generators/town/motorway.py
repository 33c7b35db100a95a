"""Builds a motorway through the middle of a town: two carriageways, each with up to two ramps."""

import itertools
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import shapely

from scenefactory_jax.core.schema import Bounds, Fraction, Positive, Range
from scenefactory_jax.core.types import LANE_FREEWAY
from scenefactory_jax.data.generators.curves import FINE_M, Curve, easing_bend, integrate
from scenefactory_jax.data.generators.town.road_network import DOUBLE_YELLOW, ON_ROAD, Lane, Network, Place, Street
from scenefactory_jax.data.generators.town.road_segments import Carriageway, RoadDimensions, build_carriageway, shift_line

PlaceRange = Annotated[tuple[float, float], Bounds(is_range=True)]
RANK = 3  # of the motorway as a street
RAMP_LEAD_M, RAMP_EASING_M = 5.0, 30.0  # of the bend of a ramp


def motorway(
    rng: np.random.Generator,
    *,
    length_m: Positive,
    lanes: Annotated[tuple[int, int], Bounds(min=1, is_range=True)],
    lane_width_m: Positive,
    median_m: Range,
    speed_limit_mps: Annotated[tuple[float, float], Bounds(min=5, is_range=True)],
    bend_radius_m: Positive,
    offset_m: float,
    join_m: PlaceRange,
    leave_m: PlaceRange,
    auxiliary_m: Range,
    taper_m: float,
    ramp_fraction: Fraction,
    ramp_turn_deg: Range,
    ramp_radius_m: float,
    ramp_limit_mps: float,
    shoulder_m: float,
) -> Network:
    """Builds two carriageways side by side; a joining ramp adds a lane that drops later, a leaving ramp takes an added lane."""
    count = int(rng.integers(*lanes, endpoint=True))
    limit, median = rng.uniform(*speed_limit_mps), rng.uniform(*median_m)
    street = Street(count, lane_width_m, median, limit, RANK, 0.0, 0.0, DOUBLE_YELLOW, LANE_FREEWAY)
    half = length_m / 2
    yaw, bend = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(-1, 1)) / bend_radius_m
    middle = rng.uniform(-offset_m, offset_m, 2)
    bends = np.full(round(half / FINE_M), bend)
    forward, back = integrate(middle, yaw, bends, FINE_M), integrate(middle, yaw + np.pi, -bends, FINE_M)
    curve = np.concatenate([back[0][:0:-1], forward[0]]), np.concatenate([back[1][:0:-1] - np.pi, forward[1]])
    network = Network()
    for direction in (curve, (curve[0][::-1], curve[1][::-1] + np.pi)):
        places = [rng.uniform(*span) for span in (join_m, leave_m)]
        added, taken = (rng.uniform(*auxiliary_m) for _ in places)
        join, leave = (round((half + place) / FINE_M) if rng.random() < ramp_fraction else None for place in places)
        dimensions = RoadDimensions(
            bay_m=taken, hold_m=added, taper_m=taper_m, solid_m=0.0, shoulder_m=shoulder_m, spot_m=1.0, spot_margin_m=0.0
        )
        network.add_block("motorway")
        for meeting in _build_carriageway(network, direction, street, dimensions, join, leave)[1]:
            turn = np.radians(rng.uniform(*ramp_turn_deg))
            add_ramp(network, meeting, street, dimensions, length=half, turn=turn, radius=ramp_radius_m, limit=ramp_limit_mps)
    if median > 2 * shoulder_m + 1.0:
        network.islands.append(shapely.LineString(curve[0]).simplify(0.02).buffer(median / 2 - shoulder_m, cap_style="flat"))
    return network


class Meeting(NamedTuple):
    """Where a ramp meets a carriageway."""

    lane: int
    place: Place
    yaw: float  # out of the carriageway
    joins: bool


def add_ramp(
    network: Network,
    meeting: Meeting,
    street: Street,
    dimensions: RoadDimensions,
    *,
    length: float,
    turn: float,  # away from the carriageway
    radius: float,
    limit: float,
) -> Curve:
    """Builds the lane of a ramp and returns its curve from the carriageway outward; both kinds bend to the right of the carriageway."""
    lane, place, out, joins = meeting
    bends, step = easing_bend(length, turn if joins else -turn, radius, RAMP_EASING_M, lead=RAMP_LEAD_M)
    points, yaw = integrate(place, out, bends, step)
    network.add_block("merge" if joins else "ramp")
    ramp = network.add_lane(Lane(points[::-1] if joins else points, street.width, limit, ON_ROAD, street.kind))
    network.link(*((ramp, lane) if joins else (lane, ramp)))
    line = shapely.LineString(network.lanes[ramp].points).simplify(0.02)
    network.areas.append(line.buffer(street.width / 2 + dimensions.shoulder_m, cap_style="flat"))
    return points, yaw


def build_with_ramp(
    network: Network,
    curve: Curve,
    before: int,
    behind: int,
    street: Street,
    dimensions: RoadDimensions,
    *,
    side: str,  # as of `build_carriageway`; a ramp is on the right
    controlled: bool,
    joins: bool,
    auxiliary: float,
    **ramp: float,
) -> Carriageway:
    """Builds one direction of a road with a ramp at its middle, whose other end stays open; `ramp`: see `add_ramp`."""
    lengths, meet = replace(dimensions, bay_m=auxiliary, hold_m=auxiliary), len(curve[0]) // 2
    ways, (meeting,) = _build_carriageway(
        network, curve, street._replace(lanes=before), lengths, meet if joins else None, None if joins else meet
    )
    points, yaw = add_ramp(network, meeting, street, dimensions, limit=street.limit, **ramp)
    network.leave_open(points[-1], float(yaw[-1]), street.width / 2 + dimensions.shoulder_m)
    return Carriageway(ways[0].start, ways[-1].end, [])


def _build_carriageway(
    network: Network, curve: Curve, street: Street, dimensions: RoadDimensions, join: int | None, leave: int | None
) -> tuple[list[Carriageway], list[Meeting]]:
    """Builds the stretches of one direction with its lanes on the right of the curve; ramps meet it at the given points of the curve."""
    count, last = street.lanes, len(curve[0]) - 1
    stretches = []  # first point, last point, lanes at the start, lanes at the end
    at = 0
    if join is not None:
        at = (join + leave) // 2 if leave is not None else last
        stretches += [(0, join, count, count), (join, at, count + 1, count)]
    if leave is not None:
        stretches += [(at, leave, count, count + 1), (leave, last, count, count)]
    ways = [
        build_carriageway(
            network, (curve[0][a : b + 1], curve[1][a : b + 1]), before, behind, street, dimensions, side="right", controlled=False
        )
        for a, b, before, behind in stretches or [(0, last, count, count)]
    ]
    for way, following in itertools.pairwise(ways):
        for lane, follower in zip(way.end, following.start, strict=False):
            network.link(lane, follower)
    ramps = []
    beside = street.median / 2 + (count + 0.5) * street.width
    for way, (a, b, before, behind) in zip(ways, stretches, strict=False):
        for lane, row, wide, joins in ((way.start[-1], a, before, True), (way.end[-1], b, behind, False)):
            if wide > count:
                place = shift_line((curve[0][row : row + 1], curve[1][row : row + 1]), beside)[0]
                ramps.append(Meeting(lane, place, float(curve[1][row]) + (np.pi if joins else 0.0), joins))
    return ways, ramps
