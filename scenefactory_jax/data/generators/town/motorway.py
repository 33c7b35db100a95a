"""A motorway through the town's middle: two carriageways, each with a ramp that joins and one that leaves."""

import itertools

import numpy as np
import shapely

from scenefactory_jax.core.types import LANE_FREEWAY
from scenefactory_jax.data.generators.curves import FINE_M, Curve, easing_bend, integrate
from scenefactory_jax.data.generators.ranges import draw
from scenefactory_jax.data.generators.town.road_network import DOUBLE_YELLOW, ON_ROAD, Block, Joint, Lane, Network, Port, Street, assemble
from scenefactory_jax.data.generators.town.road_segments import RoadDimensions, lay_road, shift_line, stack_lines


def motorway(
    rng: np.random.Generator,
    *,
    length_m: float,
    lanes: list[int],
    lane_width_m: float,
    median_m: list[float],
    speed_limit_mps: list[float],
    bend_radius_m: float,
    offset_m: float,
    join_m: list[float],
    leave_m: list[float],
    auxiliary_m: list[float],
    taper_m: float,
    ramp_share: float,
    ramp_turn_deg: list[float],
    ramp_radius_m: float,
    ramp_limit_mps: float,
    shoulder_m: float,
) -> Network:
    """Two carriageways side by side; a joining ramp adds a lane that drops further on, a leaving one takes a lane that was added.

    Args:
        length_m: of both carriageways; fast cars that reach the town within the log start far outside.
        lanes: fewest and most of a carriageway.
        bend_radius_m: the sharpest.
        offset_m: how far the motorway may pass from the town's middle.
        join_m, leave_m: place of the ramps' noses along a carriageway, from the town's middle.
        auxiliary_m: length of an added lane.
        ramp_share: how many of the possible ramps are there.
        ramp_turn_deg: how far a ramp turns away.
    """
    count = int(rng.integers(lanes[0], lanes[1] + 1))
    limit = draw(rng, speed_limit_mps, "motorway.speed_limit_mps", low=5.0)
    street = Street(count, count, lane_width_m, draw(rng, median_m, "motorway.median_m"), limit, 3, 0.0, 0.0, DOUBLE_YELLOW, LANE_FREEWAY)
    half = length_m / 2
    steps = round(half / FINE_M)
    yaw, bend = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(-1, 1)) / bend_radius_m
    middle = rng.uniform(-offset_m, offset_m, 2)
    forward, back = (integrate(middle, yaw + turn, np.full(steps, sign * bend), FINE_M) for turn, sign in ((0.0, 1.0), (np.pi, -1.0)))
    curve = np.concatenate([back[0][:0:-1], forward[0]]), np.concatenate([back[1][:0:-1] - np.pi, forward[1]])
    blocks: list[Block] = []
    joints: list[Joint] = []
    for carriageway in (curve, (curve[0][::-1], curve[1][::-1] + np.pi)):
        places = [draw(rng, span, f"motorway.{name}", low=-half) for span, name in ((join_m, "join_m"), (leave_m, "leave_m"))]
        added, taken = (draw(rng, auxiliary_m, "motorway.auxiliary_m") for _ in places)
        rows = [round((half + place) / FINE_M) if rng.random() < ramp_share else None for place in places]
        numbers = RoadDimensions(bay=taken, hold=added, taper=taper_m, solid=0.0, shoulder=shoulder_m, spot=1.0, spot_margin=0.0)
        main = _carriageway(carriageway, street, numbers, rows[0], rows[1])
        ramps = [
            _ramp(port, np.radians(draw(rng, ramp_turn_deg, "motorway.ramp_turn_deg")), ramp_radius_m, ramp_limit_mps, shoulder_m, half)
            for port in main.ports
        ]
        joints += [((len(blocks), port), (len(blocks) + 1 + port, 0)) for port in range(len(ramps))]
        blocks += [main, *ramps]
    if street.median > 2 * shoulder_m + 1.0:
        island = shapely.LineString(curve[0]).simplify(0.02).buffer(street.median / 2 - shoulder_m, cap_style="flat")
        blocks[0] = blocks[0]._replace(islands=[island])
    return assemble(blocks, joints)


def _carriageway(curve: Curve, street: Street, numbers: RoadDimensions, join: int | None, leave: int | None) -> Block:
    """One direction, its lanes on the right of the curve, with a port for each ramp at the given points of the curve."""
    count, last = street.forward, len(curve[0]) - 1
    stretches = []  # from point, to point, lanes at its start, lanes at its end
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
        lay_road((curve[0][a : b + 1], curve[1][a : b + 1]), first, then, street, numbers, side="right", controlled=False)
        for a, b, first, then in stretches
    ]
    block = stack_lines("motorway", ways)
    base = np.concatenate([[0], np.cumsum([len(way.lanes) for way in ways])]).tolist()
    follows, ports = list(block.follows), []
    for i, (way, following) in enumerate(itertools.pairwise(ways)):
        follows += [(a + base[i], b + base[i + 1]) for a, b in zip(way.end, following.start, strict=False)]
    beside = street.median / 2 + (count + 0.5) * street.width
    for i, (a, b, first, then) in enumerate(stretches):
        for row, wide, joins in ((a, first, True), (b, then, False)):
            if wide > count:
                place = shift_line((curve[0][row : row + 1], curve[1][row : row + 1]), beside)[0]
                slot = ((ways[i].start[-1] if joins else ways[i].end[-1]) + base[i],)
                yaw = float(curve[1][row]) + (np.pi if joins else 0.0)
                ports.append(Port(place, yaw, street, () if joins else (slot,), (slot,) if joins else ()))
    return block._replace(follows=follows, ports=ports)


def _ramp(port: Port, turn: float, radius: float, limit: float, shoulder: float, length: float) -> Block:
    """The road that leads to a carriageway's port, or away from it: both bend to the carriageway's right."""
    joins = not port.leaving
    bends, step = easing_bend(length, turn if joins else -turn, radius, 30.0, lead=5.0)
    points, _ = integrate(port.place, port.yaw, bends, step)
    points = points[::-1] if joins else points
    lane = Lane(points, port.street.width, limit, ON_ROAD, LANE_FREEWAY)
    area = shapely.LineString(points).simplify(0.02).buffer(port.street.width / 2 + shoulder, cap_style="flat")
    own = Port(port.place, port.yaw + np.pi, port.street, ((0,),) if joins else (), () if joins else ((0,),))
    return Block("merge" if joins else "ramp", [lane], areas=[area], ports=[own])
