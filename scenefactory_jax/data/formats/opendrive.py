"""OpenDRIVE maps (`.xodr`, ASAM OpenDRIVE 1.4 to 1.8): roads, lanes, junctions, signals, crosswalks and heights.

A lane of a section becomes a lane with its links, limit and neighbours; the outline of all that is paved becomes the road's edge. The
format has no traffic: it is drawn (`generators.map_traffic`), and so are the cycles of lights.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scenefactory_jax.core.raw_scene import Polyline, RawScene, Reject, SceneError
from scenefactory_jax.core.types import CROSSWALK, EDGE_BOUNDARY, STOP_SIGN
from scenefactory_jax.data.formats import drivable_outline, file_content, opendrive_links, opendrive_signals, xml_content
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers
from scenefactory_jax.data.formats.opendrive_lanes import DRIVEN, NO_JUNCTION, Key, Lane, Line, Road
from scenefactory_jax.data.formats.xml_content import Element
from scenefactory_jax.data.generators import map_traffic

ROOT = "OpenDRIVE"


class _Shapes(NamedTuple):
    """What is read from the sections of all roads."""

    lanes: dict[Key, Lane]
    marks: list[tuple[int, Line]]
    areas: list[Line]
    lost: int  # lanes without any width


def read(
    path: Path,
    *,
    point_spacing_m: float,
    outline: OutlineNumbers,
    lane_limit_m: float,
    element_limit: int,
    file_limit_mb: int,
    traffic: dict[str, Any] | None,
) -> Iterator[RawScene | Reject]:
    """Reads a map, and draws scenes with traffic on it.

    Args:
        path, point_spacing_m, file_limit_mb: see `formats`.
        outline: of the road edges.
        lane_limit_m: longer maps, by the lanes of their roads, are refused.
        element_limit: files of more elements are refused.
        traffic: entry of `map_traffic.draw_scenes`; None: one scene without road users.
    """
    document = xml_content.load(path, ROOT, file_limit_mb=file_limit_mb, element_limit=element_limit)
    roads = _read_roads(document, lane_limit_m)
    shapes = _read_shapes(roads, point_spacing_m)
    if not shapes.lanes:
        raise SceneError(f"{path}: expected lanes of the types {', '.join(DRIVEN)}, got none")
    junctions = {record.get("id"): record for record in document.all("junction")}
    links, opposed = opendrive_links.find_links(roads, junctions, shapes.lanes)
    shapes = shapes._replace(lanes=opendrive_links.close_gaps(opendrive_links.pass_limits(shapes.lanes, links, roads), links))
    exits: dict[Key, list[Key]] = defaultdict(list)
    for lane, following in links:
        exits[lane].append(following)
    signals = opendrive_signals.read_signals(roads, shapes.lanes, exits)
    ids = {key: number for number, key in enumerate(shapes.lanes)}
    centres = [lane.xyz for lane in shapes.lanes.values()]
    outlines = drivable_outline.find_edges(shapes.areas, centres, outline, f"{path}: lanes", spacing_m=point_spacing_m)
    crosswalks = [area for road in roads.values() for area in opendrive_signals.read_crosswalks(road)]
    features = [*shapes.marks, *((EDGE_BOUNDARY, xyz) for xyz in outlines)]
    features += [(CROSSWALK, area) for area in crosswalks]
    lines = [Polyline(kind, xyz, len(ids) + place) for place, (kind, xyz) in enumerate(features)]
    signs = [
        Polyline(STOP_SIGN, sign.place, len(ids) + len(lines) + place, lanes=tuple(ids[key] for key in sign.lanes))
        for place, sign in enumerate(signal for signal in signals if not signal.light)
    ]
    groups = opendrive_signals.group_lights(signals, document.all("controller"))
    scene = RawScene(
        name=file_content.find_stem(path),
        source=str(path),
        roads=(*_make_lanes(shapes.lanes, ids, links), *lines, *signs),
        tracks=(),
        times=np.zeros(1),
        current=0,
        origin=_read_origin(document),
        metadata={
            "dataset": "opendrive",
            "format": "opendrive",
            "intersection_lanes": [ids[key] for key in ids if roads[key[0]].junction != NO_JUNCTION],
            "left_out": {"lanes_without_width": shapes.lost, "links_of_opposed_lanes": opposed},
            "tokens": {"features": {".".join(map(str, key)): number for key, number in ids.items()}},
        },
    )
    phases = [[[ids[key] for key in phase] for phase in junction] for junction in groups.values()]
    yield from map_traffic.draw(scene, phases, traffic)


def _read_roads(document: Element, lane_limit_m: float) -> dict[str, Road]:
    """The roads by their ids."""
    roads: dict[str, Road] = {}
    total = 0.0
    for record in document.all("road"):
        length = max(record.number("length"), sum(geometry.number("length") for geometry in record.walk("planView", "geometry")))
        lanes = [sum(len(side.children) for side in section.children) for section in record.walk("lanes", "laneSection")]
        total += length * max([1, *lanes])
        if not record.number("length") >= 0 or total > lane_limit_m:
            bound = f"lanes of 0 to {lane_limit_m:g} m together (formats.opendrive.lane_limit_m)"
            raise SceneError(f"{record.where}: length: expected {bound}, got {total:g} up to this road")
        road = Road(record)
        if road.id in roads:
            raise SceneError(f"{record.where}: id: expected another id than that of an earlier road, got {road.id[:40]!r}")
        roads[road.id] = road
    return roads


def _read_shapes(roads: Mapping[str, Road], spacing_m: float) -> _Shapes:
    """The lanes, painted lines and paved areas of all sections."""
    shapes, lost = _Shapes({}, [], [], 0), 0
    for road in roads.values():
        for section in road.read_sections(spacing_m):
            shapes.lanes.update((lane.key, lane) for lane in section.lanes)
            shapes.marks.extend(section.marks)
            shapes.areas.extend(section.areas)
            lost += section.lost
    return shapes._replace(lost=lost)


def _make_lanes(lanes: Mapping[Key, Lane], ids: Mapping[Key, int], links: Sequence[tuple[Key, Key]]) -> list[Polyline]:
    """The lanes with their links."""
    entry, following = defaultdict(list), defaultdict(list)
    for lane, other in links:
        following[lane].append(ids[other])
        entry[other].append(ids[lane])
    beside = lambda key: () if key is None or key not in ids else (ids[key],)  # noqa: E731
    return [
        Polyline(
            kind=lane.kind,
            xyz=lane.xyz,
            id=ids[key],
            entry=tuple(entry[key]),
            exit=tuple(following[key]),
            left=beside(lane.left),
            right=beside(lane.right),
            speed_limit=lane.limit,
        )
        for key, lane in lanes.items()
    ]


def _read_origin(document: Element) -> tuple[float, float, float]:
    """The offset of the map in the coordinates of its projection."""
    offset = next(document.walk("header", "offset"), None)
    return (0.0, 0.0, 0.0) if offset is None else (offset.number("x"), offset.number("y"), offset.number("z", 0.0))
