"""Traffic lights, stop signs and crosswalks of an OpenDRIVE map (ASAM OpenDRIVE 1.8, 13 and 14).

The file says where lights stand and which of them belong together (`controller`), not when they are red.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from scenefactory_jax.data.formats.opendrive_lanes import NO_JUNCTION, Key, Lane, Line, Road
from scenefactory_jax.data.formats.xml_content import Element

LIGHTS = ("1000001", "1000008", "1000009", "1000010", "1000011", "1000012")  # of ASAM's types, those for cars
STOP_SIGNS = ("206", "R1-1")  # of Germany, and those that took its numbers; of the United States
APPROACH_M = 40.0  # a signal farther before a junction stops cars on its own lane
SAME_WAY_DEG = 45.0  # approaches of lights without controllers, along one axis, are green together


class Signal(NamedTuple):
    """A light or a stop sign for cars."""

    id: str
    light: bool
    place: Line  # one point
    lanes: tuple[Key, ...]  # that it governs, from their start on
    junction: str
    heading: float  # of the road in the direction for which it stands


def read_signals(roads: Mapping[str, Road], lanes: Mapping[Key, Lane], exits: Mapping[Key, list[Key]]) -> list[Signal]:
    """Reads the lights and stop signs that govern a lane."""
    records = {record.get("id"): record for road in roads.values() for record in road.record.walk("signals", "signal")}
    found = []
    for road in roads.values():
        for entry in (child for group in road.record.all("signals") for child in group.all("signal", "signalReference")):
            record = records.get(entry.get("id"))
            kind = "" if record is None else record.get("type", "")
            light = record is not None and record.get("dynamic", "no") == "yes" and kind in LIGHTS
            if not light and kind not in STOP_SIGNS:
                continue
            s, t = entry.number("s"), entry.number("t", 0.0)
            governed = list(
                dict.fromkeys(key for lane in _find_lanes(road, entry, s, lanes) for key in _follow(lane, s, lanes, exits, roads))
            )
            if governed:
                point, heading = road.place(np.array([s]), np.array([t])), float(road.line(np.array([s]))[1][0])
                turned = heading + (np.pi if entry.get("orientation", "none") == "-" else 0.0)
                junction = next((j for j in (roads[key[0]].junction for key in governed) if j != NO_JUNCTION), NO_JUNCTION)
                found.append(Signal(entry.get("id"), light, point, tuple(governed), junction, turned))
    return found


def _find_lanes(road: Road, entry: Element, s: float, lanes: Mapping[Key, Lane]) -> list[Lane]:
    """The lanes beside a signal for which it is valid: those that it names, against its orientation if need be, as RoadRunner writes it."""
    section, way = road.find_section(s), entry.get("orientation", "none")
    ranges = [sorted((limit.integer("fromLane"), limit.integer("toLane"))) for limit in entry.all("validity")]
    beside = [lane for key, lane in lanes.items() if key[:2] == (road.id, section)]
    named = [lane for lane in beside if not ranges or any(a <= lane.key[2] <= b for a, b in ranges)]
    fitting = [lane for lane in named if way not in ("+", "-") or lane.forward == (way == "+")]
    return fitting or (named if ranges else [])


def _follow(lane: Lane, s: float, lanes: Mapping[Key, Lane], exits: Mapping[Key, list[Key]], roads: Mapping[str, Road]) -> list[Key]:
    """The lanes that a signal beside `lane` governs: those of the junction ahead if it is near, and else the lane itself."""
    if roads[lane.key[0]].junction != NO_JUNCTION:
        return [lane.key]
    begin, end = lane.span
    left, current = end - s if lane.forward else s - begin, lane
    while left <= APPROACH_M:
        following = exits.get(current.key, [])
        inside = [key for key in following if roads[key[0]].junction != NO_JUNCTION]
        if inside:
            return inside
        if len(following) != 1:
            break
        current = lanes[following[0]]
        left += max(current.span[1] - current.span[0], 1e-3)
    return [lane.key]


def group_lights(signals: list[Signal], controllers: list[Element]) -> dict[str, list[list[Key]]]:
    """The lanes with lights of each junction, in groups that are green together: by controllers, or else by the axis of the approach.

    A controller of lights for crossing directions is that of a whole junction, as netconvert writes it, and groups nothing.
    """
    controlled = {control.get("signalId"): record.get("id") for record in controllers for control in record.all("control")}
    headings: dict[tuple[str, str], list[float]] = defaultdict(list)
    for signal in signals:
        if signal.light and signal.id in controlled:
            headings[signal.junction, controlled[signal.id]].append(signal.heading)
    crossing = {key for key, found in headings.items() if not all(_is_same_axis(found[0], heading) for heading in found)}
    groups: dict[str, dict[str, list[Key]]] = {}
    axes: dict[str, list[float]] = {}
    taken: set[Key] = set()
    for signal in (signal for signal in signals if signal.light):
        name = controlled.get(signal.id)
        if name is None or (signal.junction, name) in crossing:
            known = axes.setdefault(signal.junction, [])
            near = (i for i, axis in enumerate(known) if _is_same_axis(axis, signal.heading))
            index = next(near, len(known))
            if index == len(known):
                known.append(signal.heading)
            name = f"axis {index}"
        keys = [key for key in signal.lanes if key not in taken]
        taken.update(keys)
        if keys:
            groups.setdefault(signal.junction, {}).setdefault(name, []).extend(keys)
    return {junction: list(phases.values()) for junction, phases in groups.items()}


def _is_same_axis(heading: float, other: float) -> bool:
    return abs(float(np.sin(heading - other))) < float(np.sin(np.deg2rad(SAME_WAY_DEG)))


def read_crosswalks(road: Road) -> Iterator[Line]:
    """The outlines of the crosswalks on a road: drawn by corners, or boxes."""
    for record in road.record.walk("objects", "object"):
        if record.get("type", "") != "crosswalk":
            continue
        s, t, turn = record.number("s"), record.number("t", 0.0), record.number("hdg", 0.0)
        outline = next(iter([*record.walk("outlines", "outline"), *record.all("outline")]), None)
        corners = [] if outline is None else outline.all("cornerRoad", "cornerLocal")
        if corners and corners[0].tag == "cornerRoad":
            st = np.array([[corner.number("s"), corner.number("t")] for corner in corners])
            yield np.concatenate([road.place(np.array([a]), np.array([b])) for a, b in st])
            continue
        half = np.array([record.number("length", 0.0), record.number("width", 0.0)]) / 2
        local = np.array([[c.number("u"), c.number("v")] for c in corners]) if corners else half * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
        if np.ptp(local, axis=0).min() <= 0:
            continue
        (origin,), (heading,) = road.place(np.array([s]), np.array([t])), road.line(np.array([s]))[1] + turn
        rotation = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        yield np.column_stack([local @ rotation + origin[:2], np.full(len(local), origin[2])])
