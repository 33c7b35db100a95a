"""Links between the lanes of an OpenDRIVE map, from those of sections, roads and junctions (ASAM OpenDRIVE 1.8, 10 to 12)."""

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scenefactory_jax.data.formats.opendrive_lanes import CLOSE_M, NO_JUNCTION, Key, Lane, Line, Road
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators.curves import smoothstep

START, END = 0, 1  # of a lane or a road, along s
MAX_SHIFT_M = 5.0  # of the end of a lane to the lane that it belongs to
SHIFT_M = 20.0  # along a lane, over which it is shifted
MAX_INNER = 4  # lanes one after another in a junction
SIDES = (("predecessor", START), ("successor", END))


class Joint(NamedTuple):
    """Two ends of lanes that meet."""

    lane: Key
    end: int
    other: Key
    other_end: int


def find_links(roads: Mapping[str, Road], junctions: Mapping[str, Element], lanes: Mapping[Key, Lane]) -> tuple[list[tuple[Key, Key]], int]:
    """Pairs of lanes, of which one leads into the other, and the number of links between lanes that do not drive the same way.

    Links of roads and lanes that are not on the map are left out, as in a map that was cut out of a larger one.
    """
    joints = [joint for road in roads.values() for joint in _join_sections(road, roads)]
    joints += [joint for junction in junctions.values() for joint in _join_connections(junction, roads)]
    joints += _bridge(joints, roads)
    links: dict[tuple[Key, Key], None] = {}
    opposed = set()
    for lane, end, other, other_end in joints:
        if lane in lanes and other in lanes:
            leaves, enters = lanes[lane].forward == (end == END), lanes[other].forward == (other_end == START)
            if leaves != enters:
                opposed.add(frozenset((lane, other)))
            else:
                links[(lane, other) if leaves else (other, lane)] = None
    return list(links), len(opposed)


def _join_sections(road: Road, roads: Mapping[str, Road]) -> Iterator[Joint]:
    """The joints of lanes with those of the next section, and at the ends of a road with those of the next road."""
    last = len(road.sections) - 1
    for index, section in enumerate(road.sections):
        for record in (lane for side in ("left", "right") for lane in section.walk(side, "lane")):
            lane = (road.id, index, record.integer("id"))
            for name, end in SIDES:
                place = _find_next_section(road, index + (1 if end == END else -1), last, name, roads)
                for link in record.walk("link", name) if place is not None else ():
                    assert place is not None
                    if "id" in link.attributes:  # some tools write empty links where there are none
                        yield Joint(lane, end, (place[0], place[1], link.integer("id")), place[2])


def _bridge(joints: Iterable[Joint], roads: Mapping[str, Road]) -> Iterator[Joint]:
    """The joints of the lanes on both sides of sections that are too short for a lane."""
    ends: dict[tuple[Key, int], dict[tuple[Key, int], None]] = defaultdict(dict)
    for lane, end, other, other_end in joints:
        ends[lane, end][other, other_end] = ends[other, other_end][lane, end] = None
    for lane in [key for key, end in ends if end == START and key[0] in roads and roads[key[0]].is_short(key[1])]:
        for before, after in itertools.product(list(ends[lane, START]), list(ends[lane, END])):
            ends[before][after] = ends[after][before] = None
            yield Joint(*before, *after)


def _find_next_section(road: Road, index: int, last: int, side: str, roads: Mapping[str, Road]) -> tuple[str, int, int] | None:
    """The road, the section and the end at which the lanes go on; None at junctions and at the end of the map."""
    if 0 <= index <= last:
        return road.id, index, START if side == "successor" else END
    link = next(road.record.walk("link", side), None)
    if link is None or link.get("elementType", "road") != "road" or link.get("elementId", "") not in roads:
        return None
    following = roads[link.get("elementId")]
    end = START if link.get("contactPoint", "start") == "start" else END
    return following.id, 0 if end == START else len(following.sections) - 1, end


def _join_connections(junction: Element, roads: Mapping[str, Road]) -> Iterator[Joint]:
    """The joints of the lanes that lead into a junction with those of its connecting roads."""
    for connection in junction.all("connection"):
        incoming, connecting = (
            roads.get(connection.get("incomingRoad", "")),
            roads.get(connection.get("connectingRoad", connection.get("linkedRoad", ""))),
        )
        if incoming is None or connecting is None:
            continue
        end = START if connection.get("contactPoint", "start") == "start" else END
        incoming_end = _find_junction_end(incoming, junction.get("id"), connecting, end)
        sections = [0 if e == START else len(road.sections) - 1 for road, e in ((incoming, incoming_end), (connecting, end))]
        for link in connection.all("laneLink"):
            lane = (incoming.id, sections[0], link.integer("from"))
            yield Joint(lane, incoming_end, (connecting.id, sections[1], link.integer("to")), end)


def _find_junction_end(road: Road, junction: str, connecting: Road, end: int) -> int:
    """The end of a road at a junction; of a road with both ends there, the nearer one to the connecting road."""
    linked = [
        side
        for name, side in SIDES
        for link in road.record.walk("link", name)
        if link.get("elementType", "") == "junction" and link.get("elementId", "") == junction
    ]
    if len(linked) == 1:
        return linked[0]
    target = _end_point(connecting, end)
    return min((START, END), key=lambda side: float(np.hypot(*(_end_point(road, side) - target))))


def _end_point(road: Road, end: int) -> np.ndarray:
    return road.line(np.array([0.0 if end == START else road.length]))[0][0]


def pass_limits(lanes: Mapping[Key, Lane], links: Iterable[tuple[Key, Key]], roads: Mapping[str, Road]) -> dict[Key, Lane]:
    """The lanes; one in a junction without a limit has that of the lanes that lead into it, the lowest."""
    passed, before = dict(lanes), defaultdict(list)
    for lane, following in links:
        if lanes[following].limit is None and roads[following[0]].junction != NO_JUNCTION:
            before[following].append(lane)
    for _ in range(MAX_INNER):
        for key, leading in before.items():
            known = [limit for lane in leading if (limit := passed[lane].limit) is not None]
            passed[key] = replace(lanes[key], limit=min(known, default=None))
    return passed


def close_gaps(lanes: Mapping[Key, Lane], links: Iterable[tuple[Key, Key]]) -> dict[Key, Lane]:
    """The lanes with ends that meet: one that widens from nothing begins beside the lane that leads into it, and is led to its middle."""
    moved = dict(lanes)
    for first, second in links:
        before, after = moved[first], moved[second]
        gap = before.xyz[-1] - after.xyz[0]
        if not CLOSE_M < np.hypot(*gap[:2]) < MAX_SHIFT_M:
            continue
        if after.widths[0] <= before.widths[1]:
            moved[second] = replace(after, xyz=_shift(after.xyz, gap))
        else:
            moved[first] = replace(before, xyz=_shift(before.xyz[::-1], -gap)[::-1])
    return moved


def _shift(xyz: Line, gap: np.ndarray) -> Line:
    """A line with its begin moved by `gap`, and less and less of it along the way."""
    place = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz, axis=0), axis=1))])
    return xyz + gap * (1 - smoothstep(place / min(SHIFT_M, place[-1])))[:, None]
