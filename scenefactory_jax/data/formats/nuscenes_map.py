"""nuScenes' map expansion: `maps/expansion/CITY.json`, in metres from the corner of the city's map.

Lanes are chains of circular arcs and straight pieces, three to a path (`arcline_path_3`), with links in `connectivity`. There are no
limits, no neighbours and no states of lights. Painted lines have no direction.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from scenefactory_jax.core.raw_scene import Polyline, SceneError
from scenefactory_jax.core.types import CROSSWALK, LANE_BIKE, LANE_STREET
from scenefactory_jax.data.formats import city_map, file_content, polylines, scene_parts, values
from scenefactory_jax.data.formats.city_map import CityMap, CityNumbers, Plane, Sign
from scenefactory_jax.data.formats.values import Node

CITIES = ("boston-seaport", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown")
KEYS = (b'"exterior_node_tokens"', b'"node_tokens"', b'"canvas_edge"', b'"arcline_path_3"')  # of such a map
AREAS = ("drivable_area", "road_segment", "lane", "carpark_area")
TURNS = {"L": 1.0, "S": 0.0, "R": -1.0}  # letters of `shape`
ROAD_DIVIDER = 11  # WOMD's solid yellow line
BROKEN, UNKNOWN = 6, 5
MARKS: dict[str, int | None] = {  # `segment_type` -> WOMD's road line; the nearest that forbids as much where WOMD has none
    "NIL": None, "DOUBLE_DASHED_WHITE": 6, "SINGLE_SOLID_WHITE": 7, "SINGLE_ZIGZAG_WHITE": 7, "DOUBLE_SOLID_WHITE": 8,
    "SINGLE_SOLID_YELLOW": 11,
}  # fmt: skip
JOINT_M = 1e-3  # nearer points are one
STOP_SIGN_LINE = "STOP_SIGN"  # `stop_line_type`


def read_map(path: Path, *, numbers: CityNumbers, file_limit_mb: int) -> CityMap:
    """Reads the map of a city; layers that are missing are empty, but `node`, `arcline_path_3` and `lane`.

    Raises:
        SceneError: a value that is missing or of a wrong type, naming its place.
    """
    document = Node(file_content.load_json(path, file_limit_mb=file_limit_mb), f"{path}: ")
    shapes = _Shapes(document)
    paths = document["arcline_path_3"].entries(dict)
    lanes, connectors = _list_rows(document, "lane"), _list_rows(document, "lane_connector")
    centres = {token: _follow(path, numbers.point_spacing_m) for token, path in paths.items()}
    centres = {token: line for token, line in centres.items() if len(line) > 1}
    if not centres:
        raise SceneError(f"{path}: arcline_path_3: expected the paths of lanes, got none")
    ids = scene_parts.assign_ids(centres)
    areas = [polygon for name in AREAS for record in _list_rows(document, name).values() for polygon in shapes.list_polygons(record)]
    crossings = [p for record in _list_rows(document, "ped_crossing").values() for p in shapes.list_polygons(record)]
    stops = [row for row in _list_rows(document, "stop_line").values() if row.get("stop_line_type", "").value == STOP_SIGN_LINE]
    junctions = [row for row in _list_rows(document, "road_segment").values() if row.get("is_intersection", False).value]
    return city_map.make_city_map(
        [_make_lane(lanes.get(token), token, line, ids, document) for token, line in centres.items()],
        _list_marks(document, shapes),
        [(CROSSWALK, shapely.get_coordinates(polygon.exterior)[:-1]) for polygon in crossings],
        _list_signs([polygon for stop in stops for polygon in shapes.list_polygons(stop)], centres, lanes, ids),
        _find_inside(centres, connectors, [p for row in junctions for p in shapes.list_polygons(row)], ids),
        areas,
        numbers,
        f"{path}: drivable_area",
    )


def _list_rows(document: Node, name: str) -> dict[str, Node]:
    """The records of a layer by their tokens."""
    return {str(record["token"].expect(str)): record for record in document.get(name, []).entries(list).values()}


class _Shapes:
    """The nodes, lines and polygons of a map, by their tokens."""

    def __init__(self, document: Node):
        nodes = document["node"]
        self.xy = nodes.points(("x", "y"))
        values.check_finite(self.xy, nodes.where, keys=("x", "y"))
        self.node = {str(node["token"]): place for place, node in enumerate(nodes.value) if "token" in node}
        self.line, self.polygon = _list_rows(document, "line"), _list_rows(document, "polygon")

    def list_points(self, tokens: Node) -> Plane:
        """The points of nodes."""
        names = tokens.expect(list)
        if missing := [name for name in names if not isinstance(name, str) or name not in self.node]:
            raise SceneError(f"{tokens.where}: expected the token of a node, got {missing[0]!r:.60}")
        return self.xy[[self.node[name] for name in names]]

    def list_line_nodes(self, record: Node) -> list[str]:
        """The nodes of a record's line; none if it has no line."""
        token = str(record.get("line_token", "").value)
        return list(map(str, self.line[token]["node_tokens"].expect(list))) if token in self.line else []

    def list_line(self, record: Node) -> Plane:
        """The points of a record's line."""
        return self.list_points(Node(self.list_line_nodes(record), f"{record.where}: line"))

    def list_polygons(self, record: Node) -> list[shapely.Polygon]:
        """The polygons of a record, with their holes; those with less than three points are left out."""
        tokens = [record.get("polygon_token", None).value, *record.get("polygon_tokens", []).expect(list)]
        polygons = []
        for entry in (self.polygon[token] for token in tokens if isinstance(token, str) and token in self.polygon):
            outer = self.list_points(entry["exterior_node_tokens"])
            holes = [self.list_points(hole["node_tokens"]) for hole in entry.get("holes", []).entries(list).values()]
            if len(outer) > 2:
                polygons.append(shapely.Polygon(outer, [hole for hole in holes if len(hole) > 2]))
        return polygons


def _follow(paths: Node, spacing_m: float) -> Plane:
    """Points along a chain of paths, each of three pieces (`shape` says how they turn) of one radius, from its first pose on."""
    points: list[Plane] = []
    for path in paths.entries(list).values():
        (x, y, yaw), lengths = (path[key].numbers(length=3) for key in ("start_pose", "segment_length"))
        radius, shape = path["radius"].expect(float), path["shape"].expect(str)
        table = np.array([x, y, yaw, *lengths, radius])
        if len(shape) != 3 or not set(shape) <= set(TURNS) or not np.isfinite(table).all() or radius <= 0 or lengths.min() < 0:
            raise SceneError(f"{path.where}: expected a shape of L, S and R, lengths and a radius, got {shape!r}, {table.tolist()}")
        points.append(np.array([[x, y]]))
        for letter, length in zip(shape, lengths, strict=True):
            curvature = TURNS[letter] / radius
            count = int(np.clip(np.ceil(length / spacing_m), 1, polylines.MAX_ADDED_POINTS))
            along = length * np.arange(1, count + 1) / count
            middle = yaw + curvature * along / 2  # a chord has the direction in the middle of its arc
            chord = along * np.sinc(curvature * along / (2 * np.pi))
            points.append(points[-1][-1] + chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1))
            yaw += curvature * length
    line = np.concatenate(points) if points else np.zeros((0, 2))
    return line[np.linalg.norm(np.diff(line, axis=0, prepend=np.inf), axis=1) > JOINT_M] if len(line) else line


def _make_lane(record: Node | None, token: str, line: Plane, ids: Mapping[str, int], document: Node) -> Polyline:
    """A lane with its links to lanes there."""
    links = document.get("connectivity", {}).get(token, {})
    entry, following = (tuple(ids[t] for t in map(str, links.get(key, []).expect(list)) if t in ids) for key in ("incoming", "outgoing"))
    name = "CAR" if record is None else str(record.get("lane_type", "CAR").value).upper()
    kind = LANE_BIKE if name.startswith("BI") else LANE_STREET
    return Polyline(kind, city_map.to_level(line), ids[token], entry=entry, exit=following)


def _list_marks(document: Node, shapes: _Shapes) -> list[tuple[int, Plane]]:
    """Dividers of lanes, in pieces of one type, and of roads."""
    marks = [(ROAD_DIVIDER, shapes.list_line(record)) for record in _list_rows(document, "road_divider").values()]
    for record in _list_rows(document, "lane_divider").values():
        segments = record.get("lane_divider_segments", []).entries(list).values()  # in no order
        types = {str(segment["node_token"].value): str(segment.get("segment_type", "NIL").value) for segment in segments}
        names, points = shapes.list_line_nodes(record), shapes.list_line(record)
        kinds = [MARKS.get(types[name], UNKNOWN) if name in types else BROKEN for name in names[:-1]]
        starts = [0, *(place for place in range(1, len(kinds)) if kinds[place] != kinds[place - 1]), len(kinds)]
        marks += [(kind, points[a : b + 1]) for a, b in itertools.pairwise(starts) if a < b and (kind := kinds[a]) is not None]
    return marks


def _list_signs(
    polygons: Sequence[shapely.Polygon], centres: Mapping[str, Plane], lanes: Mapping[str, Any], ids: Mapping[str, int]
) -> list[Sign]:
    """Stop signs at stop lines: for the lanes that a line crosses or, if there are none, for the connectors."""
    tokens, tree = list(centres), shapely.STRtree([shapely.LineString(line) for line in centres.values()])
    signs = []
    for polygon in polygons:
        crossed = [tokens[place] for place in sorted(tree.query(shapely.make_valid(polygon), predicate="intersects"))]
        if chosen := [token for token in crossed if token in lanes] or crossed:
            signs.append(Sign(shapely.get_coordinates(polygon.centroid), tuple(ids[token] for token in chosen)))
    return signs


def _find_inside(
    centres: Mapping[str, Plane], connectors: Iterable[str], junctions: Sequence[shapely.Polygon], ids: Mapping[str, int]
) -> list[int]:
    """The connectors whose middles lie in a junction."""
    tokens = [token for token in connectors if token in centres]
    area = shapely.union_all([shapely.make_valid(polygon) for polygon in junctions])
    shapely.prepare(area)
    return [ids[t] for t in tokens if shapely.contains_xy(area, *centres[t][len(centres[t]) // 2])]
