"""Builds a motorway through the middle of a town: two carriageways, each with up to two ramps."""

import itertools

import numpy as np
import shapely

from scenefactory_jax.core.schema import Fraction, Positive
from scenefactory_jax.core.types import LANE_FREEWAY
from scenefactory_jax.data.generators.curves import FINE_M, Curve, easing_bend, integrate
from scenefactory_jax.data.generators.ranges import draw, draw_count
from scenefactory_jax.data.generators.town.road_network import DOUBLE_YELLOW, ON_ROAD, Block, Joint, Lane, Network, Port, Street, assemble
from scenefactory_jax.data.generators.town.road_segments import RoadDimensions, build_carriageway, combine, shift_line

RANK = 3  # of the motorway as a street
RAMP_LEAD_M, RAMP_EASING_M = 5.0, 30.0  # of the bend of a ramp


def motorway(
    rng: np.random.Generator,
    *,
    length_m: Positive,
    lanes: list[int],
    lane_width_m: float,
    median_m: list[float],
    speed_limit_mps: list[float],
    bend_radius_m: Positive,
    offset_m: float,
    join_m: list[float],
    leave_m: list[float],
    auxiliary_m: list[float],
    taper_m: float,
    ramp_fraction: Fraction,
    ramp_turn_deg: list[float],
    ramp_radius_m: float,
    ramp_limit_mps: float,
    shoulder_m: float,
) -> Network:
    """Draws two carriageways side by side; a joining ramp adds a lane that drops later, a leaving ramp takes an added lane.

    Args:
        length_m: of both carriageways.
        lanes: range of the lanes of a carriageway.
        bend_radius_m: minimum radius.
        offset_m: maximum distance from the middle of the town, along each axis.
        join_m, leave_m: ranges of the places of the ramps along a carriageway, from the middle of the town.
        auxiliary_m: range of the length of an added lane.
        ramp_fraction: of the possible ramps that exist.
        ramp_turn_deg: range of the angle by which a ramp turns away.
    """
    count = draw_count(rng, lanes)
    limit = draw(rng, speed_limit_mps, "motorway.speed_limit_mps", low=5.0)
    median = draw(rng, median_m, "motorway.median_m")
    street = Street(count, lane_width_m, median, limit, RANK, 0.0, 0.0, DOUBLE_YELLOW, LANE_FREEWAY)
    half = length_m / 2
    yaw, bend = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(-1, 1)) / bend_radius_m
    middle = rng.uniform(-offset_m, offset_m, 2)
    bends = np.full(round(half / FINE_M), bend)
    forward, back = integrate(middle, yaw, bends, FINE_M), integrate(middle, yaw + np.pi, -bends, FINE_M)
    curve = np.concatenate([back[0][:0:-1], forward[0]]), np.concatenate([back[1][:0:-1] - np.pi, forward[1]])
    blocks: list[Block] = []
    joints: list[Joint] = []
    for direction in (curve, (curve[0][::-1], curve[1][::-1] + np.pi)):
        places = [draw(rng, span, f"motorway.{name}", low=-half) for span, name in ((join_m, "join_m"), (leave_m, "leave_m"))]
        added, taken = (draw(rng, auxiliary_m, "motorway.auxiliary_m") for _ in places)
        rows = [round((half + place) / FINE_M) if rng.random() < ramp_fraction else None for place in places]
        numbers = RoadDimensions(
            bay_m=taken, hold_m=added, taper_m=taper_m, solid_m=0.0, shoulder_m=shoulder_m, spot_m=1.0, spot_margin_m=0.0
        )
        main = _carriageway(direction, street, numbers, rows[0], rows[1])
        ramps = [
            _ramp(port, np.radians(draw(rng, ramp_turn_deg, "motorway.ramp_turn_deg")), ramp_radius_m, ramp_limit_mps, shoulder_m, half)
            for port in main.ports
        ]
        joints += [((len(blocks), port), (len(blocks) + 1 + port, 0)) for port in range(len(ramps))]
        blocks += [main, *ramps]
    if median > 2 * shoulder_m + 1.0:
        island = shapely.LineString(curve[0]).simplify(0.02).buffer(median / 2 - shoulder_m, cap_style="flat")
        blocks[0] = blocks[0]._replace(islands=[island])
    return assemble(blocks, joints)


def _carriageway(curve: Curve, street: Street, numbers: RoadDimensions, join: int | None, leave: int | None) -> Block:
    """Builds one direction with its lanes on the right of the curve, and a port for each ramp at the given points of the curve."""
    count, last = street.lanes, len(curve[0]) - 1
    stretches = []  # first point, last point, lanes at the start, lanes at the end
    at = 0
    if join is not None:
        stretches.append((0, join, count, count))
        at = (join + leave) // 2 if leave is not None else last
        stretches.append((join, at, count + 1, count))
    if leave is not None:
        stretches += [(at, leave, count, count + 1), (leave, last, count, count)]
    if not stretches:
        stretches = [(0, last, count, count)]
    ways = [
        build_carriageway((curve[0][a : b + 1], curve[1][a : b + 1]), before, behind, street, numbers, side="right", controlled=False)
        for a, b, before, behind in stretches
    ]
    block = combine("motorway", ways)
    base = list(itertools.accumulate((len(way.lanes) for way in ways), initial=0))
    follows, ports = list(block.follows), []
    for i, (way, following) in enumerate(itertools.pairwise(ways)):
        follows += [(a + base[i], b + base[i + 1]) for a, b in zip(way.end, following.start, strict=False)]
    beside = street.median / 2 + (count + 0.5) * street.width
    for i, (a, b, before, behind) in enumerate(stretches):
        for row, wide, joins in ((a, before, True), (b, behind, False)):
            if wide > count:
                place = shift_line((curve[0][row : row + 1], curve[1][row : row + 1]), beside)[0]
                slot = ((ways[i].start[-1] if joins else ways[i].end[-1]) + base[i],)
                yaw = float(curve[1][row]) + (np.pi if joins else 0.0)
                ports.append(Port(place, yaw, street, () if joins else (slot,), (slot,) if joins else ()))
    return block._replace(follows=follows, ports=ports)


def _ramp(port: Port, turn: float, radius: float, limit: float, shoulder: float, length: float) -> Block:
    """Builds the road that leads to a port of a carriageway, or away from it; both bend to the right of the carriageway."""
    joins = not port.leaving
    bends, step = easing_bend(length, turn if joins else -turn, radius, RAMP_EASING_M, lead=RAMP_LEAD_M)
    points, _ = integrate(port.place, port.yaw, bends, step)
    points = points[::-1] if joins else points
    lane = Lane(points, port.street.width, limit, ON_ROAD, LANE_FREEWAY)
    area = shapely.LineString(points).simplify(0.02).buffer(port.street.width / 2 + shoulder, cap_style="flat")
    end = Port(port.place, port.yaw + np.pi, port.street, ((0,),) if joins else (), () if joins else ((0,),))
    return Block("merge" if joins else "ramp", [lane], areas=[area], ports=[end])
