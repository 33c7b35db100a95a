"""The map of an Argoverse 2 scenario: `log_map_archive_*.json` with lane segments, drivable areas and pedestrian crossings.

A lane's centre is worked out as AV2's own code does it: both boundaries are resampled evenly and averaged (the file's own `centerline` has
no heights). AV2 calls the lane across the centre line a neighbour too; only those of the same direction are lanes that a car may change to.
The drivable areas are joined before their outline becomes road edges, and where a lane runs through the outline the map was cut, not the
road: there is no edge.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGE_BOUNDARY, LANE_BIKE, LANE_STREET
from scenefactory_jax.data.formats import json_documents, polylines

SECTIONS = ("lane_segments", "drivable_areas", "pedestrian_crossings")
LANES = {"VEHICLE": LANE_STREET, "BUS": LANE_STREET, "BIKE": LANE_BIKE}
MARKS: dict[str, int | None] = {  # AV2's LaneMarkType -> WOMD's road line; what WOMD does not know becomes the nearest that forbids as much
    "NONE": None, "UNKNOWN": 5, "SOLID_BLUE": 5, "DASHED_WHITE": 6, "DOUBLE_DASH_WHITE": 6, "SOLID_WHITE": 7, "DOUBLE_SOLID_WHITE": 8,
    "SOLID_DASH_WHITE": 8, "DASH_SOLID_WHITE": 8, "DASHED_YELLOW": 9, "DOUBLE_DASH_YELLOW": 10, "SOLID_YELLOW": 11,
    "DOUBLE_SOLID_YELLOW": 12, "SOLID_DASH_YELLOW": 13, "DASH_SOLID_YELLOW": 13,
}  # fmt: skip
AXES = ("x", "y", "z")
SIDES = ("left", "right")
Points = Float[np.ndarray, "_ 3"]  # any number of them


def is_map(document: Mapping[str, Any]) -> bool:
    """Whether a JSON document is such a map."""
    return all(section in document for section in SECTIONS)


def roads(
    path: Path, *, point_spacing_m: float, cut_m: float, file_limit_mb: int
) -> tuple[tuple[Polyline, ...], dict[str, list[int]]]:
    """The map's lanes, painted lines, road edges and crosswalks; and which lanes lie on an intersection, and which are for buses.

    Args:
        path: of the JSON file.
        point_spacing_m: between the points of a lane, line or edge, at most; the file has little more than corners.
        cut_m: an outline that comes so near to a lane's centre was cut there.
        file_limit_mb: larger files are refused.

    Raises:
        SceneError: no such file, no such map, or a value that is missing, of a wrong type or not finite, naming its key.
    """
    document = json_documents.load(path, file_limit_mb=file_limit_mb)
    if not is_map(document):
        raise SceneError(f"{path}: no map of Argoverse 2: it has {', '.join(document) or 'nothing'}, not all of {', '.join(SECTIONS)}")
    tables = {section: json_documents.get(document, section, dict, f"{path}: ") for section in SECTIONS}
    places = {section: [(r, f"{path}: {section}[{k!r}]") for k, r in table.items()] for section, table in tables.items()}
    segments = [(json_documents.expect(record, dict, where), where) for record, where in places["lane_segments"]]
    borders = [{side: _line(record, f"{side}_lane_boundary", where) for side in SIDES} for record, where in segments]
    lane_ids = [_id(record, where) for record, where in segments]
    centres = {lane: centre(border["left"], border["right"], point_spacing_m) for lane, border in zip(lane_ids, borders, strict=True)}
    for lane, (_, where) in zip(lane_ids, segments, strict=True):
        json_documents.check_finite(centres[lane], f"{where}: centre")
    lanes = [_lane(record, centres, where) for record, where in segments]
    crossings = [_crossing(json_documents.expect(record, dict, where), where) for record, where in places["pedestrian_crossings"]]
    areas = [_line(json_documents.expect(record, dict, where), "area_boundary", where) for record, where in places["drivable_areas"]]
    ids = [line.id for line in (*lanes, *crossings)]
    drawn = [*_marks(segments, borders), *((EDGE_BOUNDARY, xyz) for xyz in edges(areas, list(centres.values()), cut_m, f"{path}: "))]
    painted = [Polyline(kind=kind, xyz=xyz, id=max(ids, default=0) + 1 + place) for place, (kind, xyz) in enumerate(drawn)]
    dense = [replace(line, xyz=polylines.densify(line.xyz, point_spacing_m)) for line in painted]
    crossed = [json_documents.get(record, "is_intersection", bool, where) for record, where in segments]
    groups = {
        "intersection_lanes": [lane for lane, inside in zip(lane_ids, crossed, strict=True) if inside],
        "bus_lanes": [lane for lane, (record, _) in zip(lane_ids, segments, strict=True) if record["lane_type"] == "BUS"],
    }
    return (*lanes, *dense, *crossings), groups


def _id(record: Mapping[str, Any], where: str) -> int:
    return json_documents.get(record, "id", int, where)  # pyright: ignore[reportArgumentType]


def _line(record: dict[str, Any], key: str, where: str) -> Points:
    """A list of points."""
    xyz = json_documents.points(json_documents.get(record, key, list, where), AXES, f"{where}.{key}")
    json_documents.check_finite(xyz, f"{where}.{key}", keys=AXES)
    if not len(xyz):
        raise SceneError(f"{where}.{key}: no points")
    return xyz


def centre(left: Points, right: Points, spacing_m: float) -> Points:
    """The line halfway between two boundaries: both resampled to as many even steps, and averaged (av2's `compute_midpoint_line`)."""
    longest = max(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in (left, right))
    count = max(2, math.ceil(min(longest / spacing_m, polylines.MOST)) + 1)
    return (polylines.resample(left, count) + polylines.resample(right, count)) / 2


def _lane(record: dict[str, Any], centres: Mapping[int, Points], where: str) -> Polyline:
    """A lane segment, with the neighbours that run its way."""
    name = json_documents.get(record, "lane_type", str, where)
    if name not in LANES:
        raise SceneError(f"{where}.lane_type: {name!r}; valid: {', '.join(LANES)}")
    identity = _id(record, where)
    linked = {key: json_documents.get(record, key, list, where) for key in ("predecessors", "successors")}
    chains = {key: tuple(json_documents.expect(lane, int, f"{where}.{key}") for lane in lanes) for key, lanes in linked.items()}
    named = {side: record.get(f"{side}_neighbor_id") for side in SIDES}
    lanes = {side: json_documents.expect(lane, int, f"{where}.{side}_neighbor_id") for side, lane in named.items() if lane is not None}
    beside = {side: (lane,) for side, lane in lanes.items() if lane in centres and _same_way(centres[identity], centres[lane])}
    return Polyline(
        kind=LANES[name],
        xyz=centres[identity],
        id=identity,
        entry=chains["predecessors"],
        exit=chains["successors"],
        left=beside.get("left", ()),
        right=beside.get("right", ()),
    )


def _same_way(line: Points, other: Points) -> bool:
    """Whether the other line runs in the direction of this one where it is nearest to its middle."""
    middle = len(line) // 2
    near = int(np.argmin(np.linalg.norm(other[:-1, :2] + other[1:, :2] - 2 * line[middle, :2], axis=1)))
    return float((line[middle] - line[middle - 1])[:2] @ (other[near + 1] - other[near])[:2]) > 0


def _marks(
    segments: list[tuple[dict[str, Any], str]], borders: list[dict[str, Points]]
) -> list[tuple[int, Points]]:
    """The painted boundaries with their kinds; one that two lanes share, in either direction, once."""
    found: dict[tuple[tuple[float, ...], ...], tuple[int, Points]] = {}
    for (record, where), border in zip(segments, borders, strict=True):
        for side in SIDES:
            mark = json_documents.get(record, f"{side}_lane_mark_type", str, where)
            if mark not in MARKS:
                raise SceneError(f"{where}.{side}_lane_mark_type: {mark!r}; valid: {', '.join(MARKS)}")
            kind, points = MARKS[mark], tuple(map(tuple, border[side].tolist()))
            if kind is not None:
                found.setdefault(min(points, points[::-1]), (kind, border[side]))
    return list(found.values())


def _crossing(record: dict[str, Any], where: str) -> Polyline:
    """A crosswalk: its two edges as the outline of an area, whichever way each of them runs."""
    first, second = (_line(record, key, where) for key in ("edge1", "edge2"))
    if (first[-1] - first[0]) @ (second[-1] - second[0]) > 0:
        second = second[::-1]
    return Polyline(kind=CROSSWALK, xyz=np.concatenate([first, second]), id=_id(record, where))


def edges(
    areas: list[Points], centres: list[Points], cut_m: float, where: str
) -> list[Points]:
    """The outline of all drivable areas together, without the pieces at which a lane leaves the map; heights from the areas' corners."""
    try:
        return _outline(areas, centres, cut_m)
    except (shapely.errors.ShapelyError, ValueError) as error:
        raise SceneError(f"{where}drivable_areas: no outline can be drawn around them: {error}") from error


def _outline(
    areas: list[Points], centres: list[Points], cut_m: float
) -> list[Points]:
    """The edges, with shapely's own errors."""
    outlines = [shapely.Polygon(xyz[:, :2]) for xyz in areas if len(xyz) > 2]
    if not outlines:
        return []
    whole = shapely.union_all([shapely.make_valid(outline) for outline in outlines])
    rings = [np.asarray(ring.coords) for ring in shapely.get_rings(shapely.get_parts(whole))]
    lanes = shapely.union_all([shapely.LineString(xyz[:, :2]) for xyz in centres])
    corners = np.concatenate(areas)
    tree = KDTree(corners[:, :2])
    pieces = []
    for ring in rings:
        cut = np.asarray(shapely.distance(shapely.linestrings(np.stack([ring[:-1], ring[1:]], axis=1)), lanes)) < cut_m
        for piece in _pieces(ring, cut):
            pieces.append(np.column_stack([piece, corners[tree.query(piece)[1], 2]]))
    return pieces


def _pieces(ring: Float[np.ndarray, "N 2"], cut: np.ndarray) -> list[Float[np.ndarray, "K 2"]]:
    """What is left of a closed ring without the segments that are cut."""
    if not cut.any():
        return [ring]
    first = int(np.flatnonzero(cut)[0])
    points, gone = np.roll(ring[:-1], -first - 1, axis=0), np.roll(cut, -first - 1)  # begins behind a gap and ends with it
    starts = np.concatenate([[0], np.flatnonzero(gone[:-1]) + 1])
    return [points[start : stop + 1] for start, stop in zip(starts, np.flatnonzero(gone), strict=True) if stop > start]
