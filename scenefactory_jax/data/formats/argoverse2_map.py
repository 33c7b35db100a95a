"""The map of an Argoverse 2 scenario: `log_map_archive_*.json` with lane segments, drivable areas and pedestrian crossings.

A lane's centre is computed as in AV2's own code: both boundaries are resampled evenly and averaged (the file's own `centerline` has no
heights). AV2 lists the lane across the centre line as a neighbour, too; only neighbours of the same direction are kept. The drivable areas
are joined before their outline becomes road edges. Where a lane crosses the outline the map was cut, and there is no edge.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Polyline, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGE_BOUNDARY, LANE_BIKE, LANE_STREET
from scenefactory_jax.data.formats import drivable_outline, file_content, polylines, values
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers
from scenefactory_jax.data.formats.values import AXES, Node

SECTIONS = ("lane_segments", "drivable_areas", "pedestrian_crossings")
LANES = {"VEHICLE": LANE_STREET, "BUS": LANE_STREET, "BIKE": LANE_BIKE}
MARKS: dict[str, int | None] = {  # AV2's LaneMarkType -> WOMD's road line; the nearest that forbids as much where WOMD has none
    "NONE": None, "UNKNOWN": 5, "SOLID_BLUE": 5, "DASHED_WHITE": 6, "DOUBLE_DASH_WHITE": 6, "SOLID_WHITE": 7, "DOUBLE_SOLID_WHITE": 8,
    "SOLID_DASH_WHITE": 8, "DASH_SOLID_WHITE": 8, "DASHED_YELLOW": 9, "DOUBLE_DASH_YELLOW": 10, "SOLID_YELLOW": 11,
    "DOUBLE_SOLID_YELLOW": 12, "SOLID_DASH_YELLOW": 13, "DASH_SOLID_YELLOW": 13,
}  # fmt: skip
SIDES = ("left", "right")
Points = Float[np.ndarray, "_ 3"]  # any number of them


def is_map(document: Mapping[str, Any]) -> bool:
    """Whether a JSON document is such a map."""
    return all(section in document for section in SECTIONS)


def read_roads(
    path: Path, *, point_spacing_m: float, cut_m: float, file_limit_mb: int
) -> tuple[tuple[Polyline, ...], dict[str, list[int]]]:
    """Reads the map's lanes, painted lines, road edges and crosswalks, and lists the lanes on intersections and those for buses.

    The map was cut where an outline comes as near as `cut_m` to a lane's centre; see `formats` for the other numbers.
    """
    document = Node(file_content.load_json(path, file_limit_mb=file_limit_mb), f"{path}: ")
    if not is_map(document.value):
        keys = values.list_keys(document.value)
        raise SceneError(f"{path}: expected a map of Argoverse 2 with {', '.join(SECTIONS)}, got the keys {keys}")
    segments, areas, crossings = (list(document[section].entries(dict).values()) for section in SECTIONS)
    borders = [{side: _line(record[f"{side}_lane_boundary"]) for side in SIDES} for record in segments]
    centres = {
        record["id"].expect(int): centre(border["left"], border["right"], point_spacing_m)
        for record, border in zip(segments, borders, strict=True)
    }
    lanes = [_lane(record, centres) for record in segments]
    crosswalks = [_crossing(record) for record in crossings]
    paved = [_line(record["area_boundary"]) for record in areas]
    outlines = drivable_outline.find_edges(paved, list(centres.values()), OutlineNumbers(cut_m), f"{path}: drivable_areas")
    drawn = [*_marks(segments, borders), *((EDGE_BOUNDARY, xyz) for xyz in outlines)]
    start = max((line.id for line in (*lanes, *crosswalks)), default=0) + 1
    painted = [Polyline(kind, polylines.densify(xyz, point_spacing_m), start + place) for place, (kind, xyz) in enumerate(drawn)]
    groups = {
        "intersection_lanes": [record["id"].value for record in segments if record["is_intersection"].expect(bool)],
        "bus_lanes": [record["id"].value for record in segments if record["lane_type"].value == "BUS"],
    }
    return (*lanes, *painted, *crosswalks), groups


def _line(points: Node) -> Points:
    """A list of points."""
    xyz = points.points()
    values.check_finite(xyz, points.where, keys=AXES)
    if not len(xyz):
        raise SceneError(f"{points.where}: expected points, got none")
    return xyz


def centre(left: Points, right: Points, spacing_m: float) -> Points:
    """The line halfway between two boundaries: both resampled to as many even steps, and averaged (av2's `compute_midpoint_line`)."""
    longest = max(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in (left, right))
    count = max(2, math.ceil(min(longest / spacing_m, polylines.MAX_ADDED_POINTS)) + 1)
    return (polylines.resample(left, count) + polylines.resample(right, count)) / 2


def _lane(record: Node, centres: Mapping[int, Points]) -> Polyline:
    """A lane with its links and the neighbours of its direction."""
    kind, number = _choose(record["lane_type"], LANES), record["id"].value
    values.check_finite(centres[number], f"{record.where}: centre")
    beside = {}
    for side in SIDES:
        other = record.get(f"{side}_neighbor_id", None)
        near = other.value is not None and other.expect(int) in centres and _same_way(centres[number], centres[other.value])
        beside[side] = (other.value,) if near else ()
    entry, following = (tuple(record[key].integers()) for key in ("predecessors", "successors"))
    return Polyline(kind=kind, xyz=centres[number], id=number, entry=entry, exit=following, **beside)


def _choose(name: Node, options: Mapping[str, Any]) -> Any:
    """The option of a name."""
    if name.expect(str) not in options:
        raise SceneError(f"{name.where}: expected {', '.join(options)}, got {name.value!r}")
    return options[name.value]


def _same_way(line: Points, other: Points) -> bool:
    """Whether the other line runs in the direction of this one where it is nearest to its middle."""
    middle = len(line) // 2
    near = int(np.argmin(np.linalg.norm(other[:-1, :2] + other[1:, :2] - 2 * line[middle, :2], axis=1)))
    return float((line[middle] - line[middle - 1])[:2] @ (other[near + 1] - other[near])[:2]) > 0


def _marks(segments: Sequence[Node], borders: Sequence[Mapping[str, Points]]) -> list[tuple[int, Points]]:
    """The painted boundaries with their kinds; a boundary of two lanes, in either direction, once."""
    marks: dict[tuple[tuple[float, ...], ...], tuple[int, Points]] = {}
    for record, border in zip(segments, borders, strict=True):
        for side in SIDES:
            kind, points = _choose(record[f"{side}_lane_mark_type"], MARKS), tuple(map(tuple, border[side].tolist()))
            if kind is not None:
                marks.setdefault(min(points, points[::-1]), (kind, border[side]))
    return list(marks.values())


def _crossing(record: Node) -> Polyline:
    """A crosswalk: its two edges as the outline of an area, whichever way each of them runs."""
    first, second = _line(record["edge1"]), _line(record["edge2"])
    if (first[-1] - first[0]) @ (second[-1] - second[0]) > 0:
        second = second[::-1]
    return Polyline(kind=CROSSWALK, xyz=np.concatenate([first, second]), id=record["id"].expect(int))
