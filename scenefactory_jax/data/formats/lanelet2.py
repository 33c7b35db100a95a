"""Lanelet2 maps (`.osm`): lanelets by their two borders, regulatory elements, and positions as latitude and longitude.

Links and neighbours follow from shared points and borders, also from different ones at the same place (Poggenhans et al., "Lanelet2: A
high-definition map framework", 2018). Positions are projected by the transverse Mercator projection of UTM (Krüger's series, to 1 mm),
relative to (0, 0) for maps around it, as INTERACTION's, and to the first point for others; `local_x` and `local_y` of a point go before.
Maps in left-handed axes are mirrored.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Companion, Polyline, RawScene, Reject, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGE_BOUNDARY, LANE_BIKE, LANE_FREEWAY, LANE_STREET, STOP_SIGN
from scenefactory_jax.data.formats import file_content, lanelet_map, polylines, projection, xml_content
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers, Points
from scenefactory_jax.data.formats.lanelet_map import Lanelet
from scenefactory_jax.data.formats.opendrive_signals import Signal, group_lights
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators import map_traffic

ROOT = "osm"
KINDS: dict[str, int | None] = {"highway": LANE_FREEWAY, "bicycle_lane": LANE_BIKE, "road_shoulder": None, "emergency_lane": None}
UNPAVED = ("walkway", "stairs", "crosswalk", "shared_walkway")
MARKS = {  # subtype of a line -> WOMD's white and yellow road line
    "dashed": (6, 9), "solid": (7, 11), "solid_solid": (8, 12), "dashed_solid": (8, 13), "solid_dashed": (8, 13)
}  # fmt: skip
PHYSICAL = ("curbstone", "road_border", "guard_rail", "wall", "fence", "jersey_barrier")  # lines that bound the road
LINES = ("line_thin", "line_thick")
STOP_SIGNS = ("usR1-1", "de206", "stop_sign")  # the last one of Autoware
AROUND_ZERO_DEG = 0.5  # a map nearer to (0, 0) is in local metres
SAME_M, CELL_M = 0.05, 0.01  # points that are nearer to each other are one, to within a cell
OVERLAP_M2 = 1.0  # lanelets that share more area meet in a junction


class Map(NamedTuple):
    """A map, without road users."""

    roads: tuple[Polyline, ...]
    phases: list[list[list[int]]]  # lanes with lights, as of `map_traffic.draw`
    inside: list[int]  # lanes of junctions
    origin: tuple[float, float, float]  # of the coordinates, in UTM


class _Way(NamedTuple):
    """A line: its points' ids, its points, and its tags."""

    ids: tuple[str, ...]  # one for all points at a place
    xyz: Points
    tags: dict[str, str]


def read(
    path: Path, *, point_spacing_m: float, outline: OutlineNumbers, element_limit: int, file_limit_mb: int, traffic: dict[str, Any] | None
) -> Iterator[RawScene | Reject]:
    """Reads a map, and draws scenes with traffic on it; the map of recordings beside it (INTERACTION) is a companion.

    Args: see `commonroad.read`.
    """
    numbers = {"point_spacing_m": point_spacing_m, "outline": outline, "element_limit": element_limit, "file_limit_mb": file_limit_mb}
    found = read_map(path, **numbers)
    if (Path(path).parent.parent / "recorded_trackfiles" / Path(path).stem).is_dir():
        raise Companion(f"{path}: the map of recordings of INTERACTION")
    scene = RawScene(
        name=file_content.find_stem(path),
        source=str(path),
        roads=found.roads,
        tracks=(),
        times=np.zeros(1),
        current=0,
        origin=found.origin,
        metadata={"dataset": "lanelet2", "format": "lanelet2", "intersection_lanes": found.inside},
    )
    yield from map_traffic.draw(scene, found.phases, traffic)


def read_map(path: Path, *, point_spacing_m: float, outline: OutlineNumbers, element_limit: int, file_limit_mb: int) -> Map:
    """Reads the roads of a map; see `read`."""
    document = xml_content.load(path, ROOT, file_limit_mb=file_limit_mb, element_limit=element_limit)
    points, origin = _read_points(document)
    names = _name_places(points)
    ways = {record.get("id"): _read_way(record, points, names) for record in _list_records(document, "way")}
    relations = {record.get("id"): record for record in _list_records(document, "relation")}
    if _is_mirrored(relations.values(), ways):
        ways = {number: way._replace(xyz=way.xyz * [1.0, -1.0, 1.0]) for number, way in ways.items()}
    shapes: dict[str, tuple[_Way, _Way]] = {}
    crossings = []
    for number, record in relations.items():
        tags = _read_tags(record)
        if tags.get("type") == "lanelet":
            borders = _read_borders(record, ways)
            if tags.get("subtype") == "crosswalk":
                crossings.append((CROSSWALK, np.concatenate([borders[0].xyz, borders[1].xyz[::-1]])))
            elif tags.get("subtype") not in UNPAVED:
                shapes[number] = borders
    if not shapes:
        plain = "" if crossings else ", as plain OpenStreetMap has; SUMO's netconvert makes a network (.net.xml) of it"
        raise SceneError(f"{path}: expected relations of the type lanelet for cars, got {len(relations)} others{plain}")
    ids = {number: place for place, number in enumerate(shapes)}
    lanelets = _make_lanelets(shapes, ids, relations, ways)
    inside = _find_junctions(lanelets)
    bounds = {frozenset(way.ids) for borders in shapes.values() for way in borders}
    lines = [way for way in ways.values() if len(way.ids) > 1]
    physical = any(way.tags.get("type") in PHYSICAL for way in lines)  # a map that has kerbs has edges at them alone
    unbounded = [way.xyz for way in lines if way.tags.get("type") not in PHYSICAL] if physical else []
    kerbs = [way.xyz for way in lines if way.tags.get("type") in PHYSICAL and frozenset(way.ids) not in bounds]
    edges = [(EDGE_BOUNDARY, xyz) for xyz in _turn_to_road(kerbs, lanelets, point_spacing_m)]
    where = f"{path}: lanelets"
    roads = lanelet_map.make_roads(list(lanelets.values()), [*crossings, *edges], point_spacing_m, outline, where, unbounded)
    signs = _find_stop_signs(relations, ways, ids, lanelets, inside, max(line.id for line in roads) + 1)
    return Map((*roads, *signs), _find_phases(relations, ids, lanelets, inside), sorted(inside), origin)


def _list_records(document: Element, tag: str) -> list[Element]:
    """The elements of a kind, without those that were deleted in JOSM, which keeps them in its files."""
    return [record for record in document.all(tag) if record.get("action", "") != "delete"]


def _read_tags(record: Element) -> dict[str, str]:
    return {tag.get("k"): tag.get("v") for tag in record.all("tag")}


def _read_points(document: Element) -> tuple[dict[str, Float[np.ndarray, "3"]], tuple[float, float, float]]:
    """The points by their ids, and the origin of their coordinates."""
    nodes = _list_records(document, "node")
    if not nodes:
        raise SceneError(f"{document.where}: expected <node>, got none")
    tagged = [{tag.get("k"): tag for tag in node.all("tag")} for node in nodes]
    local = ["local_x" in tags and "local_y" in tags for tags in tagged]
    known = [not (placed and node.get("lat", "") == "") for node, placed in zip(nodes, local, strict=True)]  # Autoware leaves them empty
    degrees = np.array([[n.number("lat"), n.number("lon")] if given else [0.0] * 2 for n, given in zip(nodes, known, strict=True)])
    if (bad := np.flatnonzero(np.abs(degrees).max(axis=1) > [180.0])).size or np.abs(degrees[:, 0]).max() >= 90:
        node = nodes[int(bad[0]) if bad.size else int(np.argmax(np.abs(degrees[:, 0])))]
        raise SceneError(f"{node.where}: expected degrees of latitude and longitude, got {node.get('lat')}, {node.get('lon')}")
    middle = degrees[0] * (np.abs(degrees[0]).max() > AROUND_ZERO_DEG)
    meridian = 6.0 * np.floor(middle[1] / 6.0) + 3.0
    origin = projection.project(middle[0], middle[1], meridian)
    plane = np.stack(projection.project(degrees[:, 0], degrees[:, 1], meridian), axis=1) - origin
    points = {}
    for node, tags, placed, place in zip(nodes, tagged, local, plane, strict=True):
        if placed:
            place = [tags[key].number("v") for key in ("local_x", "local_y")]
        points[node.get("id")] = np.array([*place, tags["ele"].number("v") if "ele" in tags else 0.0])
    return points, (float(origin[0]), float(origin[1]), 0.0)


def _name_places(points: Mapping[str, np.ndarray]) -> dict[str, str]:
    """One id for all points at a place, by their ids: tools write the corner of two lanelets twice, and links follow from shared points."""
    ids, xyz = list(points), np.array(list(points.values()))
    cells, cell = np.unique(np.round(xyz / CELL_M), axis=0, return_inverse=True)  # a file may have any number of points at a place
    near = KDTree(cells * CELL_M).query_pairs(SAME_M, output_type="ndarray")
    components = connected_components(coo_array((np.ones(len(near)), near.T), shape=(len(cells), len(cells))), directed=False)[1]
    groups = components[cell.reshape(-1)]
    first = np.unique(groups, return_index=True)[1]
    return {name: ids[first[group]] for name, group in zip(ids, groups, strict=True)}


def _read_way(record: Element, points: Mapping[str, np.ndarray], names: Mapping[str, str]) -> _Way:
    ids = tuple(node.get("ref") for node in record.all("nd"))
    if missing := [name for name in ids if name not in points]:
        raise SceneError(f"{record.where}: nd: expected the id of a node, got {missing[0][:20]!r}")
    return _Way(tuple(names[name] for name in ids), np.array([points[name] for name in ids]).reshape(-1, 3), _read_tags(record))


def _is_mirrored(relations: Iterable[Element], ways: Mapping[str, _Way]) -> bool:
    """Whether most lanelets that have a centre line run against it: the axes are left-handed then, as CARLA's own."""
    against = []
    for record in relations:
        names = [member.get("ref") for member in record.all("member") if member.get("role", "") == "centerline"]
        if names and _read_tags(record).get("type") == "lanelet" and names[0] in ways and len(ways[names[0]].ids) > 1:
            along, (left, _) = ways[names[0]].xyz, _read_borders(record, ways)
            against.append(float((along[-1] - along[0]) @ (left.xyz[-1] - left.xyz[0])) < 0)
    return 2 * sum(against) > len(against)


def _read_borders(record: Element, ways: Mapping[str, _Way]) -> tuple[_Way, _Way]:
    """The left and the right border, both in driving direction."""
    sides = []
    for role in ("left", "right"):
        names = [member.get("ref") for member in record.all("member") if member.get("role", "") == role]
        parts = [ways[name] for name in names if name in ways and len(ways[name].ids) > 1]
        if not parts or len(parts) != len(names):
            raise SceneError(f"{record.where}: member: expected ways of the role {role} with two points or more, got {names[:5]}")
        sides.append(_join(parts))
    left, right = sides
    apart = [np.linalg.norm(left.xyz[0] - right.xyz[end]) + np.linalg.norm(left.xyz[-1] - right.xyz[-1 - end]) for end in (0, -1)]
    right = right if apart[0] <= apart[1] else _turn(right)
    ring = np.concatenate([right.xyz, left.xyz[::-1]])[:, :2]
    area = np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1))
    return (left, right) if area >= 0 else (_turn(left), _turn(right))


def _turn(way: _Way) -> _Way:
    return way._replace(ids=way.ids[::-1], xyz=way.xyz[::-1])


def _join(parts: list[_Way]) -> _Way:
    """Ways one after another as one; the next one begins where the last one ends, whichever way it was drawn."""
    line = parts[0]
    for part in parts[1:]:
        if line.ids[-1] not in (part.ids[0], part.ids[-1]):
            line = _turn(line)
        part = part if part.ids[0] == line.ids[-1] else _turn(part)
        line = _Way(line.ids + part.ids[1:], np.concatenate([line.xyz, part.xyz[1:]]), line.tags)
    return line


def _turn_to_road(lines: list[Points], lanelets: Mapping[int, Lanelet], spacing_m: float) -> list[Points]:
    """Lines with the nearest lanelet on their left."""
    tree = KDTree(np.concatenate([(np.concatenate([p.left, p.right]))[:, :2] for p in lanelets.values()]))
    turned = []
    for line in (polylines.densify(line, spacing_m) for line in lines):
        offset = tree.data[tree.query(line[:-1, :2])[1]] - line[:-1, :2]
        along = np.diff(line[:, :2], axis=0)
        turned.append(line if np.sum(along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]) >= 0 else line[::-1])
    return turned


def _make_lanelets(
    shapes: Mapping[str, tuple[_Way, _Way]], ids: Mapping[str, int], relations: Mapping[str, Element], ways: Mapping[str, _Way]
) -> dict[int, Lanelet]:
    """The lanelets with links by shared ends, and neighbours by shared borders that may be crossed."""
    begins, ends, lefts, rights = (defaultdict(list) for _ in range(4))
    for number, (left, right) in shapes.items():
        begins[left.ids[0], right.ids[0]].append(ids[number])
        ends[left.ids[-1], right.ids[-1]].append(ids[number])
        lefts[left.ids].append(ids[number])
        rights[right.ids].append(ids[number])
    lanelets = {}
    for number, (left, right) in shapes.items():
        tags = _read_tags(relations[number])
        lanelets[ids[number]] = Lanelet(
            id=ids[number],
            kind=KINDS.get(tags.get("subtype", ""), LANE_STREET),
            left=left.xyz,
            right=right.xyz,
            entry=tuple(ends[left.ids[0], right.ids[0]]),
            exit=tuple(begins[left.ids[-1], right.ids[-1]]),
            beside_left=tuple(rights[left.ids]) if _is_crossed(left, "right") else (),
            beside_right=tuple(lefts[right.ids]) if _is_crossed(right, "left") else (),
            limit=_find_limit(relations[number], tags, relations, ways),
            marks=tuple(mark for way in (left, right) if (mark := _find_mark(way)) is not None),
        )
    return lanelets


def _is_crossed(way: _Way, side: str) -> bool:
    """Whether a border may be crossed from one of its sides: the words of its subtype are those of its left and its right line."""
    if (change := way.tags.get("lane_change")) in ("yes", "no"):
        return change == "yes"
    words = way.tags.get("subtype", "").split("_")
    return way.tags.get("type") in LINES and words[0 if side == "left" else -1] == "dashed"


def _find_mark(way: _Way) -> tuple[int, Points] | None:
    """The painted line on a border."""
    kinds = MARKS.get(way.tags.get("subtype", "")) if way.tags.get("type") in LINES else None
    return None if kinds is None else (kinds[way.tags.get("color") == "yellow"], way.xyz)


def _list_elements(record: Element, relations: Mapping[str, Element], subtype: str) -> list[tuple[Element, dict[str, str]]]:
    """The regulatory elements of a lanelet of one subtype, with their tags."""
    found = (relations.get(member.get("ref")) for member in record.all("member") if member.get("role", "") == "regulatory_element")
    return [(element, tags) for element in found if element is not None and (tags := _read_tags(element)).get("subtype") == subtype]


def _find_limit(record: Element, tags: Mapping[str, str], relations: Mapping[str, Element], ways: Mapping[str, _Way]) -> float | None:
    """The speed limit of a lanelet, m/s: its own, or that of a rule or of the rule's sign; numbers without a unit are km/h."""
    texts = [tags.get("speed_limit", "")]
    for element, named in _list_elements(record, relations, "speed_limit"):
        signs = [ways[member.get("ref")] for member in element.all("member") if member.get("ref") in ways]
        texts += [named.get("sign_type", ""), *(sign.tags.get("subtype", "") for sign in signs)]
    return next((speed for text in texts if (speed := lanelet_map.parse_speed(text, "km/h")) is not None), None)


def _find_junctions(lanelets: Mapping[int, Lanelet]) -> dict[int, int]:
    """The lanes that share area with others, as they do where they meet or part, with the numbers of their junctions."""
    numbers = list(lanelets)
    areas = shapely.make_valid([shapely.Polygon(np.concatenate([p.left, p.right[::-1]])[:, :2]) for p in lanelets.values()])
    first, second = shapely.STRtree(areas).query(areas, predicate="intersects")
    shared = shapely.area(shapely.intersection(areas[first], areas[second])) > OVERLAP_M2
    first, second = first[shared & (first != second)], second[shared & (first != second)]
    _, junction = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(len(numbers), len(numbers))))
    return {numbers[row]: int(junction[row]) for row in first.tolist()}


def _find_stop_signs(
    relations: Mapping[str, Element],
    ways: Mapping[str, _Way],
    ids: Mapping[str, int],
    lanelets: Mapping[int, Lanelet],
    inside: Mapping[int, int],
    start: int,
) -> Iterator[Polyline]:
    """The stop signs of rights of way or, as in Autoware's maps, of lanelets, with the lanes that have to stop; rules may share a sign."""
    governed: dict[str, dict[int, None]] = defaultdict(dict)
    users: dict[str, list[str]] = defaultdict(list)
    for number in ids:
        for element, _ in _list_elements(relations[number], relations, "traffic_sign"):
            users[element.get("id")].append(number)
    for number, record in relations.items():
        if number in users or _read_tags(record).get("subtype") in ("right_of_way", "all_way_stop"):
            members = [(member.get("role", ""), member.get("ref")) for member in record.all("member")]
            members += [("yield", user) for user in users[number]]
            yielding = [ids[ref] for role, ref in members if role == "yield" and ref in ids]
            lanes = [lane for number in yielding for lane in lanelet_map.find_junction_lanes(lanelets, number, inside)]
            for post in (ref for role, ref in members if role == "refers" and ref in ways):
                if ways[post].tags.get("subtype") in STOP_SIGNS and len(ways[post].xyz):
                    governed[post] |= dict.fromkeys(lanes)
    for place, (post, lanes) in enumerate(governed.items()):
        yield Polyline(STOP_SIGN, ways[post].xyz.mean(axis=0)[None], start + place, lanes=tuple(lanes))


def _find_phases(
    relations: Mapping[str, Element], ids: Mapping[str, int], lanelets: Mapping[int, Lanelet], inside: Mapping[int, int]
) -> list[list[list[int]]]:
    """The lanes with lights of each junction, in groups that are green together: those of one axis."""
    signals = []
    for number, place in ids.items():
        if _list_elements(relations[number], relations, "traffic_light"):
            lanelet = lanelets[place]
            along = lanelet.left[-1] - lanelet.left[-2]
            lanes = [("", 0, lane) for lane in lanelet_map.find_junction_lanes(lanelets, place, inside)]
            junction = str(inside.get(lanes[0][2], "none"))
            signals.append(Signal(number, True, lanelet.left[-1:], tuple(lanes), junction, float(np.arctan2(along[1], along[0]))))
    return [[[key[2] for key in group] for group in groups] for groups in group_lights(signals, []).values()]
