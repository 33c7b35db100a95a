"""Writes the map of a scene as OpenDRIVE 1.8: towns, and any other scene whose lanes are linked.

Lanes side by side from end to end become a road, whose reference line is the centre of the left one; any other lane is a road of its own.
Where roads part and meet over short roads, these are the connecting roads of a junction; elsewhere roads part and meet in direct junctions
(`opendrive_junctions`). The format has no cycles of lights: those that show the same belong to one controller. Kerbs are not written:
readers find the edge of the road at the lanes' borders. Neighbours with other begins or ends than a lane's own are lost and counted.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene, SceneError
from scenefactory_jax.core.safe_names import to_file_name
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, EDGES, LANE_BIKE, LANE_FREEWAY, LINES, STOP_SIGN
from scenefactory_jax.data.export import files, opendrive_curves
from scenefactory_jax.data.export.opendrive_junctions import NONE, Joints, find_joints

KINDS = {LANE_BIKE: "biking"}  # of lanes; the others are driven
WIDTH_M, WIDTHS_M = 3.5, (2.0, 4.0)  # of a lane in a junction, and bounds of those beside kerbs and other lanes
SPACING_M = (2.0, 5.5)  # between the centres of lanes side by side
SQUARE_M = 0.05  # by which their ends may be off the cross-section
NEAR_M = 0.4  # of a painted line from the border that it marks
MARKS = {  # map element of a painted line -> type and colour of the mark
    6: ("broken", "white"), 7: ("solid", "white"), 8: ("solid solid", "white"), 9: ("broken", "yellow"), 10: ("broken broken", "yellow"),
    11: ("solid", "yellow"), 12: ("solid solid", "yellow"), 13: ("solid broken", "yellow"),
}  # fmt: skip
LIGHT, STOP = "1000001", "206"
Line = Float[np.ndarray, "_ 2"]


class Road(NamedTuple):
    """Lanes side by side."""

    lanes: list[Polyline]  # from left to right; the first one's centre is the reference line
    offsets: list[np.ndarray]  # t of the centre of each lane at the points of the reference line
    s: np.ndarray  # of these points
    length: float
    plan: str  # XML

    @property
    def kind(self) -> int:
        """The map element of all lanes."""
        return self.lanes[0].kind


def write_all(scenes: Iterable[RawScene], folder: Path | str, refused: list[str]) -> int:
    """Writes a map for each scene, see `files.write_scenes`; returns the number of files."""
    return len(files.write_scenes(scenes, folder, refused, lambda raw: (f"{to_file_name(raw.name)}.xodr", encode(raw), None)))


def encode(raw: RawScene) -> bytes:
    """The map of a scene.

    Raises:
        SceneError: no lane with two points or more.
    """
    lanes = {line.id: line for line in raw.roads if line.kind in (*DRIVABLE, LANE_BIKE) and len(line.xyz) > 1}
    if not lanes:
        raise SceneError(f"{raw.source}: scene {raw.name!r}: expected lanes with two points or more, got none")
    roads = [_make_road(group) for group in _group(lanes)]
    place = {lane.id: (number, -1 - index) for number, road in enumerate(roads) for index, lane in enumerate(road.lanes)}
    links = [(place[lane.id], place[other]) for lane in lanes.values() for other in lane.exit if other in place]
    joints = find_joints(links, [road.length for road in roads])
    marks = [line for line in raw.roads if line.kind in LINES and len(line.xyz) > 1]
    tree = shapely.STRtree([shapely.LineString(line.xyz[:, :2]) for line in marks])
    signals, controllers = _write_signals(raw, roads, place, lanes, joints)
    crosswalks = _write_crosswalks(raw.roads, roads)
    widths = _measure_widths(roads, joints, [line for line in raw.roads if line.kind in EDGES and len(line.xyz) > 1])
    find_mark = lambda border: _find_mark(border, marks, tree)  # noqa: E731
    shown = [
        _write_road(number, road, joints, widths[number], (signals[number], crosswalks[number]), find_mark)
        for number, road in enumerate(roads)
    ]
    lost = sum(other in place and place[other][0] != place[lane.id][0] for lane in lanes.values() for other in lane.left + lane.right)
    x, y, z = raw.origin
    head = f'<header revMajor="1" revMinor="8" name={quoteattr(raw.name)} vendor="scenefactory_jax">'
    head += f'<offset x="{x:.9g}" y="{y:.9g}" z="{z:.9g}" hdg="0"/><userData code="neighbours_lost" value="{lost}"/></header>'
    parts = ['<?xml version="1.0" encoding="UTF-8"?>', "<OpenDRIVE>", head, *shown, *controllers, *joints.write(), "</OpenDRIVE>", ""]
    return "\n".join(parts).encode()


# ---- roads


def _group(lanes: Mapping[int, Polyline]) -> Iterator[list[Polyline]]:
    """The lanes of each road, from left to right."""
    right = {lane.id: _find_right(lane, lanes) for lane in lanes.values()}
    behind = set(right.values())
    for lane in lanes.values():
        if lane.id in behind:
            continue
        group, current = [lane], right[lane.id]
        while current is not None and lanes[current] not in group:
            group.append(lanes[current])
            current = right[current]
        yield group


def _find_right(lane: Polyline, lanes: Mapping[int, Polyline]) -> int | None:
    """The lane to the right that runs beside a lane from its begin to its end, and beside no other."""
    known = [lanes[number] for number in dict.fromkeys(lane.right) if number in lanes]
    if len(known) != 1 or known[0].kind != lane.kind or [n for n in known[0].left if n in lanes] != [lane.id]:
        return None
    other = known[0]
    for end, inner in ((0, 1), (-1, -2)):
        along = lane.xyz[inner, :2] - lane.xyz[end, :2]
        if abs(np.dot(other.xyz[end, :2] - lane.xyz[end, :2], along / np.linalg.norm(along))) > SQUARE_M:
            return None
    offset = _measure_offsets(lane.xyz[:, :2], other.xyz[:, :2])
    return other.id if SPACING_M[0] < -offset.max() and -offset.min() < SPACING_M[1] else None


def _measure_offsets(line: Line, other: Line) -> np.ndarray:
    """The signed distance from the points of a line to another line beside it, positive to the left."""
    shape = shapely.LineString(other)
    foot = shapely.get_coordinates(shapely.line_interpolate_point(shape, shapely.line_locate_point(shape, shapely.points(line))))
    along = opendrive_curves.tangents(line)
    step = foot - line
    side = along[:, 0] * step[:, 1] - along[:, 1] * step[:, 0]
    return np.sign(side) * np.linalg.norm(step, axis=1)


def _make_road(lanes: list[Polyline]) -> Road:
    """The road of lanes side by side."""
    line = lanes[0].xyz[:, :2]
    s, length, plan = opendrive_curves.fit(line)
    return Road(lanes, [np.zeros(len(line)), *(_measure_offsets(line, lane.xyz[:, :2]) for lane in lanes[1:])], s, length, plan)


def _write_road(number: int, road: Road, joints: Joints, width: float, extras: tuple[str, str], find_mark: Any) -> str:
    signals, crosswalks = extras
    height = _write_profile("elevation", "s", road.s, road.lanes[0].xyz[:, 2])
    bank = _measure_bank(road)
    slope = 1.0 / np.cos(bank)  # lengths across the road are along its slope
    lateral = f"<lateralProfile>{_write_profile('superelevation', 's', road.s, bank)}</lateralProfile>" if bank.any() else ""
    borders = [np.full(len(road.s), width / 2)]
    for offset in road.offsets:
        borders.append(2 * offset - borders[-1])
    normal = opendrive_curves.tangents(road.lanes[0].xyz[:, :2]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    edge = lambda t: road.lanes[0].xyz[:, :2] + t[:, None] * normal  # noqa: E731
    kind, town = KINDS.get(road.kind, "driving"), "motorway" if road.kind == LANE_FREEWAY else "town"
    lanes = "".join(
        f'<lane id="{-1 - index}" type="{kind}"><link>{joints.write_lane_links(number, -1 - index)}</link>'
        f"{_write_profile('width', 'sOffset', road.s, slope * (borders[index] - borders[index + 1]))}"
        f"{_write_mark(find_mark(edge(borders[index + 1])), _find_changes(road, index))}"
        + ("" if lane.speed_limit is None else f'<speed sOffset="0" max="{lane.speed_limit:.9g}" unit="m/s"/>')
        + "</lane>"
        for index, lane in enumerate(road.lanes)
    )
    middle = _write_mark(find_mark(edge(borders[0])), "none")
    return (
        f'<road name="" id="{number}" length="{road.length:.9g}" junction="{joints.junction(number)}" rule="RHT">'
        f'<link>{joints.write_road_links(number)}</link><type s="0" type="{town}"/><planView>{road.plan}</planView>'
        f"<elevationProfile>{height}</elevationProfile>{lateral}<lanes>{_write_profile('laneOffset', 's', road.s, slope * borders[0])}"
        f'<laneSection s="0"><center><lane id="0" type="none">{middle}</lane></center>'
        f"<right>{lanes}</right></laneSection></lanes>{crosswalks}{signals}</road>"
    )


def _measure_bank(road: Road) -> Float[np.ndarray, " S"]:
    """The angle of the cross-section along a road, rad: the plane through its reference line that is nearest to its lanes."""
    across, along, sums = np.stack(road.offsets[1:] or [np.zeros(len(road.s))]), road.lanes[0].xyz, np.zeros((2, len(road.s)))
    for offset, lane in zip(across, road.lanes[1:], strict=False):
        shape = shapely.LineString(lane.xyz[:, :2])
        way = shapely.line_locate_point(shape, shapely.points(along[:, :2]))
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(lane.xyz[:, :2], axis=0), axis=1)))
        rise = np.interp(way, arc, lane.xyz[:, 2]) - along[:, 2]
        sums += offset * rise, offset**2
    return np.arctan(sums[0] / np.maximum(sums[1], 1e-9))


def _measure_widths(roads: Sequence[Road], joints: Joints, edges: Sequence[Polyline]) -> list[float]:
    """The width of the left lane of each road: up to its neighbour, or else to an edge, or half way to another lane."""
    shapes = np.array([shapely.LineString(lane.xyz[:, :2]) for road in roads for lane in road.lanes], object)
    owners = np.array([number for number, road in enumerate(roads) for _ in road.lanes])
    lanes = shapely.STRtree(shapes)
    kerbs = shapely.STRtree([shapely.LineString(line.xyz[:, :2]) for line in edges])
    widths = []
    for number, road in enumerate(roads):
        if len(road.lanes) > 1 or joints.junction(number) != NONE:
            widths.append(float(-np.median(road.offsets[1])) if len(road.lanes) > 1 else WIDTH_M)
            continue
        points = np.asarray(shapely.points(road.lanes[0].xyz[:, :2]), object)
        row, other = lanes.query(points, predicate="dwithin", distance=WIDTHS_M[1])
        row, other = row[owners[other] != number], other[owners[other] != number]
        room = np.full(len(points), WIDTH_M / 2)
        np.minimum.at(room, row, shapely.distance(points[row], shapes[other]) / 2)
        row, edge = kerbs.query(points, predicate="dwithin", distance=WIDTH_M / 2)
        np.minimum.at(room, row, shapely.distance(points[row], kerbs.geometries[edge]))
        widths.append(float(np.clip(2 * np.median(room), *WIDTHS_M)))
    return widths


def _find_changes(road: Road, index: int) -> str:
    """The directions, of ids, in which cars may cross the right border of a lane."""
    if index + 1 == len(road.lanes):
        return "none"
    lane, other = road.lanes[index : index + 2]
    return {(True, True): "both", (True, False): "decrease", (False, True): "increase"}.get(
        (other.id in lane.right, lane.id in other.left), "none"
    )


def _write_profile(tag: str, key: str, s: np.ndarray, value: np.ndarray) -> str:
    """A profile in straight pieces between points, as few as keep it within a millimetre."""
    kept = np.asarray(shapely.LineString(np.column_stack([s, value])).simplify(1e-3, preserve_topology=False).coords)
    slope = np.append(np.diff(kept[:, 1]) / np.diff(kept[:, 0]), 0.0)
    rows = [(a, b, m) for a, b, m in zip(kept[:, 0], kept[:, 1], slope, strict=True)][: max(len(kept) - 1, 1)]
    return "".join(f'<{tag} {key}="{a:.9g}" a="{b:.9g}" b="{m:.9g}" c="0" d="0"/>' for a, b, m in rows)


def _find_mark(border: Line, marks: Sequence[Polyline], tree: shapely.STRtree) -> tuple[str, str]:
    """The painted line along a border."""
    if not marks:
        return "none", "white"
    middle = shapely.points(border[len(border) // 4 : max(3 * len(border) // 4, len(border) // 4 + 1)])
    index, distance = tree.query_nearest(middle, return_distance=True, all_matches=False)
    if np.median(distance) > NEAR_M:
        return "none", "white"
    return MARKS[marks[int(np.bincount(index[1]).argmax())].kind]


def _write_mark(mark: tuple[str, str], change: str) -> str:
    return f'<roadMark sOffset="0" type="{mark[0]}" weight="standard" color="{mark[1]}" width="0.15" laneChange="{change}"/>'


# ---- signals and crosswalks


def _write_signals(
    raw: RawScene, roads: Sequence[Road], place: Mapping[int, tuple[int, int]], lanes: Mapping[int, Polyline], joints: Joints
) -> tuple[list[str], list[str]]:
    """The lights and stop signs of each road, and the controllers of lights.

    They stand at the end of a lane all of whose successors, connecting roads, they govern alike, and else at the starts of those.
    """
    shown: dict[int, list[str]] = defaultdict(list)
    phases: dict[Any, list[int]] = defaultdict(list)
    lights = {light.lane: _describe(light) for light in raw.lights if light.lane in place}
    signs = {lane: sign.id for sign in raw.roads if sign.kind == STOP_SIGN for lane in sign.lanes if lane in place}
    count = 0
    for governed, kind in ((lights, f'dynamic="yes" type="{LIGHT}"'), (signs, f'dynamic="no" type="{STOP}"')):
        for (road, at_end, what), numbers in _find_posts(governed, place, lanes, joints).items():
            width = float(roads[road].offsets[-1][-1 if at_end else 0]) - WIDTH_M
            head = f'<signal id="{count}" name="" s="{roads[road].length * at_end:.9g}" t="{width:.6g}" {kind} orientation="+" zOffset="3"'
            ranges = "".join(f'<validity fromLane="{number}" toLane="{number}"/>' for number in numbers)
            shown[road].append(f'{head} country="OpenDRIVE" subtype="-1" hOffset="0" value="-1" height="1" width="0.5">{ranges}</signal>')
            if governed is lights:
                phases[what].append(count)
            count += 1
    controlled = ("".join(f'<control signalId="{number}" type=""/>' for number in numbers) for numbers in phases.values())
    controllers = [f'<controller id="{number}" name="">{inner}</controller>' for number, inner in enumerate(controlled)]
    return [f"<signals>{''.join(shown[number])}</signals>" if shown[number] else "" for number in range(len(roads))], controllers


def _find_posts(
    governed: Mapping[int, Any], place: Mapping[int, tuple[int, int]], lanes: Mapping[int, Polyline], joints: Joints
) -> dict[tuple[int, bool, Any], list[int]]:
    """Where signals stand: road, whether at its end, and what they show -> lanes of the road for which they are valid."""
    posts: dict[tuple[int, bool, Any], list[int]] = defaultdict(list)
    done: set[int] = set()
    for lane in lanes.values():
        behind = [other for other in lane.exit if other in place]
        alike = {governed.get(other) for other in behind}
        if len(alike) == 1 and None not in alike and all(joints.junction(place[other][0]) != NONE for other in behind):
            posts[place[lane.id][0], True, alike.pop()].append(place[lane.id][1])
            done.update(behind)
    for lane, what in governed.items():
        if lane not in done:
            posts[place[lane][0], False, what].append(place[lane][1])
    return posts


def _describe(light: Light) -> Any:
    """What a light shows, as a key: its cycle, or else its states over the log."""
    if light.plan is not None:
        return tuple(np.round(light.plan.start_s, 6).tolist()), tuple(np.asarray(light.plan.state).tolist()), light.plan.period_s
    return np.where(light.valid, light.state, -1).tobytes()


def _write_crosswalks(lines: Sequence[Polyline], roads: Sequence[Road]) -> list[str]:
    """The crosswalks on each road, by their corners in its frame at the nearest place."""
    shapes = shapely.STRtree([shapely.LineString(road.lanes[0].xyz[:, :2]) for road in roads])
    shown: dict[int, list[str]] = defaultdict(list)
    for number, walk in enumerate(line for line in lines if line.kind == CROSSWALK and len(line.xyz) > 2):
        middle = walk.xyz[:, :2].mean(axis=0)
        road = int(shapes.nearest(shapely.Point(middle)))
        line = roads[road].lanes[0].xyz[:, :2]
        row = int(np.argmin(np.linalg.norm(line - middle, axis=1)))
        x, y = opendrive_curves.tangents(line)[row]
        frame = np.array([[x, -y], [y, x]])
        corners = (walk.xyz[:, :2] - line[row]) @ frame
        outline = "".join(f'<cornerLocal u="{u:.6g}" v="{v:.6g}" z="0" height="0"/>' for u, v in corners)
        entry = f'<object id="{number}" name="" type="crosswalk" s="{roads[road].s[row]:.9g}" t="0" zOffset="0" hdg="0" orientation="none"'
        shown[road].append(f'{entry}><outlines><outline id="0">{outline}</outline></outlines></object>')
    return [f"<objects>{''.join(shown[number])}</objects>" if shown[number] else "" for number in range(len(roads))]
