"""The map of nuPlan's logs: `maps/CITY/VERSION/map.gpkg`, a GeoPackage of longitudes and latitudes, which is projected as its table `meta`
says, into the zone of UTM in which the logs are.

A lane connector leads over a junction, from the lane `exit_lane_fid` to the lane `entry_lane_fid`. Lanes of a group are numbered from left
to right. The colours of painted lines are unknown: all are white.
"""

import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Polyline, SceneError
from scenefactory_jax.core.types import CROSSWALK, LANE_BIKE, LANE_STREET, SPEED_BUMP
from scenefactory_jax.data.formats import city_map, geopackage, polylines, projection
from scenefactory_jax.data.formats.city_map import CityMap, CityNumbers, Sign
from scenefactory_jax.data.formats.geopackage import Database, Layer

PATHS, LANES, CONNECTORS = "baseline_paths", "lanes_polygons", "lane_connectors"
AREAS = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas", LANES)  # nuPlan's drivable area, car parks, lanes
SHAPES = {"crosswalks": CROSSWALK, "speed_bumps": SPEED_BUMP}
BIKE_LANE = 1  # `lane_type_fid`
MARKS = {0: 6, 2: 7}  # `boundary_type_fid` -> WOMD's broken and solid white line; 1 and 3 are not painted
STOP_SIGN_POLYGON = 1  # `stop_polygon_type_fid`
PASSES = (3, 4, 5)  # `intersection_type_fid` where lanes branch, merge or go on: no junction
DEGREES = 4326  # EPSG code of longitude and latitude
UTM = re.compile(r"(?:epsg:)?32([67])(0[1-9]|[1-5]\d|60)", re.IGNORECASE)
Box = Float[np.ndarray, "4"]  # least x and y, largest x and y


def read_map(path: Path, box: Box, *, numbers: CityNumbers, row_limit: int) -> CityMap:
    """Reads what meets a box, in metres of UTM.

    Raises:
        SceneError: not nuPlan's map, an unknown reference system, or no lane in the box.
    """
    with geopackage.open_database(path, row_limit) as database:
        read = _make_reader(database, box)
        paths, polygons, connectors = (
            read(PATHS, "lane_fid", "lane_connector_fid"),
            read(LANES, "lane_fid", "lane_group_fid", "lane_index", "lane_type_fid", "speed_limit_mps"),
            read(CONNECTORS, "exit_lane_fid", "entry_lane_fid", "intersection_fid", "speed_limit_mps"),
        )
        if not len(polygons.shapes):
            raise SceneError(f"{path}: {LANES}: expected lanes within {np.round(box).tolist()} (m, of the log's poses), got none")
        junctions, marks, stops = (
            read("intersections", "intersection_type_fid"),
            read("boundaries", "boundary_type_fid"),
            read("stop_polygons", "stop_polygon_type_fid", "lane_connector_fids", "lane_fids"),
        )
        shapes = [(kind, shape) for name, kind in SHAPES.items() for shape in geopackage.list_polygons(read(name).shapes)]
        areas = [polygon for name in AREAS for polygon in geopackage.list_polygons(read(name).shapes)]
    lanes, ids = _make_lanes(paths, polygons, connectors, numbers.point_spacing_m, str(path))
    passes = {fid for fid, (kind,) in zip(junctions.fids, junctions.rows, strict=True) if kind in PASSES}
    crossing = {fid: _to_id(row[2]) for fid, row in zip(connectors.fids, connectors.rows, strict=True)}
    return city_map.make_city_map(
        lanes,
        [(MARKS[kind], geopackage.list_lines(s)) for s, (kind,) in zip(marks.shapes, marks.rows, strict=True) if kind in MARKS],
        [(kind, shapely.get_coordinates(shape.exterior)[:-1]) for kind, shape in shapes],
        [sign for shape, row in zip(stops.shapes, stops.rows, strict=True) for sign in _list_signs(shape, row, ids)],
        [ids[CONNECTORS, fid] for fid, place in crossing.items() if (CONNECTORS, fid) in ids and place not in (None, *passes)],
        areas,
        numbers,
        str(path),
    )


def _make_reader(database: Database, box: Box) -> Callable[..., Layer]:
    """A function that reads a layer, in metres, and keeps what meets the box."""
    where = database.path
    if PATHS not in database.columns:
        raise SceneError(f"{where}: expected a map of nuPlan with the layer {PATHS}, got {', '.join(database.columns) or 'no table'}")
    meta = dict(database.select("meta", ("key", "value"))) if "meta" in database.columns else {}
    code = str(meta.get("projectedCoordSystem", ""))
    zone = UTM.fullmatch(code)
    if zone is None:
        raise SceneError(f"{where}: meta: projectedCoordSystem: expected a zone of UTM, epsg:32601 to epsg:32760, got {code[:40]!r}")
    systems = database.select("gpkg_spatial_ref_sys", ("srs_id", "organization_coordsys_id"))
    codes = dict(systems) | {-1: 0, 0: 0}  # undefined: taken for metres
    metres = (0, int(zone[0].lower().removeprefix("epsg:")))

    def project(degrees: np.ndarray) -> np.ndarray:
        return projection.project_utm(degrees, zone=int(zone[2]), south=zone[1] == "7")

    def read(name: str, *attributes: str) -> Layer:
        layer = geopackage.read_layer(database, name, attributes)
        references = np.array([codes.get(number, number) for number in layer.reference], int)
        if not np.isin(references, (DEGREES, *metres)).all():
            raise SceneError(f"{where}: {name}: expected shapes in EPSG 4326 or {metres[1]}, got {sorted(set(references.tolist()))}")
        shapes, turned = layer.shapes.copy(), references == DEGREES
        if turned.any():
            if np.abs(shapely.bounds(shapes[turned])).max(initial=0.0) > 180.0:
                raise SceneError(f"{where}: {name}: expected degrees of longitude and latitude, got more than 180")
            shapes[turned] = shapely.transform(shapes[turned], project)
        low_x, low_y, high_x, high_y = shapely.bounds(shapes).reshape(-1, 4).T
        kept = np.flatnonzero((low_x <= box[2]) & (high_x >= box[0]) & (low_y <= box[3]) & (high_y >= box[1]))
        rows = tuple(layer.rows[row] for row in kept)
        return Layer(shapes[kept], tuple(references[kept].tolist()), tuple(layer.fids[row] for row in kept), rows)

    return read


def _to_id(value: Any) -> int | None:
    """A reference to a row of another layer: an integer, which GeoPackages also hold as a number or a text."""
    try:
        return None if value is None else int(value)
    except (ValueError, OverflowError):
        return None


def _make_lanes(
    paths: Layer, polygons: Layer, connectors: Layer, spacing_m: float, where: str
) -> tuple[list[Polyline], dict[tuple[str, int], int]]:
    """Lanes and connectors, and their ids by layer and key: the key itself, unless a lane has that of a connector, which lights name."""
    lines: dict[tuple[str, int], Any] = {(CONNECTORS, fid): shape for fid, shape in zip(connectors.fids, connectors.shapes, strict=True)}
    for shape, row in zip(paths.shapes, paths.rows, strict=True):
        lines |= {(layer, fid): shape for layer, value in zip((LANES, CONNECTORS), row, strict=True) if (fid := _to_id(value)) is not None}
    rows = {(CONNECTORS, fid): row for fid, row in zip(connectors.fids, connectors.rows, strict=True)}
    rows |= {(LANES, _to_id(row[0]) or fid): row for fid, row in zip(polygons.fids, polygons.rows, strict=True)}
    rows = {key: row for key, row in rows.items() if key in lines and shapely.length(lines[key]) > 0}
    start = max((fid for _, fid in rows), default=0) + 1
    ids = {(layer, fid): fid + start * (layer == LANES and (CONNECTORS, fid) in rows) for layer, fid in rows}
    entry, following = defaultdict(list), defaultdict(list)
    for key, row in rows.items():
        for links, back, value in ((entry, following, row[0]), (following, entry, row[1])) if key[0] == CONNECTORS else ():
            if (lane := (LANES, _to_id(value) or 0)) in ids:
                links[key].append(ids[lane])
                back[lane].append(ids[key])
    beside = {(row[1], row[2]): ids[key] for key, row in rows.items() if key[0] == LANES and None not in row[1:3]}
    lanes = []
    for key, row in rows.items():
        xyz = city_map.to_level(polylines.densify(geopackage.list_lines(lines[key]), spacing_m))
        limit = row[-1] if isinstance(row[-1], float | int) and 0 < row[-1] < np.inf else None
        is_lane = key[0] == LANES
        kind = LANE_BIKE if is_lane and row[3] == BIKE_LANE else LANE_STREET
        near = [beside.get((row[1], row[2] + step)) if is_lane and isinstance(row[2], int) else None for step in (-1, 1)]
        left, right = (() if lane is None else (lane,) for lane in near)
        lanes.append(Polyline(kind, xyz, ids[key], tuple(entry[key]), tuple(following[key]), left, right, limit))
    if not lanes:
        raise SceneError(f"{where}: {PATHS}: expected the centre of a lane, got none")
    return lanes, ids


def _list_signs(shape: Any, row: tuple[Any, ...], ids: dict[tuple[str, int], int]) -> list[Sign]:
    """The stop sign of a stop polygon, if it is one: for the connectors behind it or, if none is named, for its lanes."""
    if row[0] != STOP_SIGN_POLYGON:
        return []
    for layer, value in zip((CONNECTORS, LANES), row[1:], strict=True):
        fids = map(int, re.findall(r"\d{1,18}", str(value)))  # of a text such as `12,13`, or of none
        if lanes := [ids[layer, fid] for fid in fids if (layer, fid) in ids]:
            return [Sign(shapely.get_coordinates(shape.centroid), tuple(lanes))]
    return []
