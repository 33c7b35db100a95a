# pyright: reportAttributeAccessIssue=false
# (the compiled parts of mujoco carry no types)
"""Builds the surfaces of a road for pictures: asphalt under the lanes, paint, kerbs, and patches of the weather."""

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely import ops

from scenefactory_jax.core.types import Road, Scene, Weather
from scenefactory_jax.visualization.birds_eye import patch_overlay
from scenefactory_jax.visualization.birds_eye.drawing import rgb
from scenefactory_jax.visualization.road_levels import RoadLevel, list_levels, measure_level
from scenefactory_jax.visualization.road_lines import LAYERS, STRAIGHT_M, WHITE, YELLOW, join_segments

LANE_M, CLOSING_M = 2.0, 1.5  # half the width of a lane, and of a gap between lanes that is filled
DASH_M, GAP_M = 3.0, 4.5  # of broken lines
Colour = tuple[float, float, float, float]


class Surface(NamedTuple):
    """Prisms of one colour on the ground."""

    name: str
    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "M 3"]
    colour: Colour


class LayerLook(NamedTuple):
    """Shape and colour of the surface of a layer's lines."""

    half_m: float  # half the width of the line
    height_m: float
    colour: Colour
    broken: bool = False
    area: bool = False  # closed lines are filled


LOOKS = {  # of layers; lanes are the asphalt
    "driveway": LayerLook(0.1, 0.012, (0.30, 0.30, 0.32, 1.0), area=True),
    "bike": LayerLook(0.9, 0.016, (0.24, 0.33, 0.27, 1.0)),
    "crosswalk": LayerLook(0.1, 0.020, (0.62, 0.62, 0.60, 1.0), area=True),
    "bump": LayerLook(0.2, 0.05, (0.80, 0.55, 0.20, 1.0), area=True),
    "white": LayerLook(0.07, 0.03, WHITE),
    "white-broken": LayerLook(0.07, 0.03, WHITE, broken=True),
    "yellow": LayerLook(0.07, 0.03, YELLOW),
    "yellow-broken": LayerLook(0.07, 0.03, YELLOW, broken=True),
    "edge": LayerLook(0.10, 0.14, (0.66, 0.65, 0.62, 1.0)),
}
CELL_M, GRID_M, RIM_M, BELOW_M = 6.0, 3.0, 20.0, 0.06  # of surfaces on hills; the ground's, beyond the road and below it
GROUND = (0.44, 0.47, 0.41, 1.0)
ASPHALT, ASPHALT_M, PATCH_M = (0.20, 0.21, 0.23, 1.0), 0.008, 0.014


def find_surfaces(scene: Scene) -> list[Surface]:
    """Surfaces of one world on the host, at the heights of its roads."""
    surfaces = [surface for level in list_levels(scene) for surface in _find_level(scene, level)]
    patches, ground = find_patches(scene.weather), []
    if scene.elevation is not None:
        patches, ground = find_patches(scene.weather, cut_to_cells), [_make_ground(scene)]
        patches = [drape(patch, lambda places: measure_level(scene, places, 0)) for patch in patches]
    return [surface for surface in (*ground, *surfaces, *patches) if len(surface.faces)]


def _find_level(scene: Scene, level: RoadLevel) -> list[Surface]:
    """Surfaces of one level of the road."""
    lines = [(shapely.LineString(points), kind) for points, kind in join_segments(level.road)]
    lanes = [line.buffer(LANE_M, quad_segs=4) for line, kind in lines if kind in (*LAYERS["lane"], *LAYERS["bike"])]
    asphalt = shapely.union_all(lanes).buffer(CLOSING_M, quad_segs=3).buffer(-CLOSING_M, quad_segs=3)
    flat: list[tuple[str, shapely.Geometry, float, Colour]] = [("asphalt", shapely.simplify(asphalt, STRAIGHT_M), ASPHALT_M, ASPHALT)]
    for name, look in LOOKS.items():
        shapes = [_shape(line, look) for line, kind in lines if kind in LAYERS[name]]
        flat.append((name, shapely.union_all(shapes), look.height_m, look.colour))
    if level.number is None:
        return [prism(*surface) for surface in flat]
    cut = [prism(f"{name}{level.number or ''}", cut_to_cells(shape), height, colour) for name, shape, height, colour in flat]
    return [drape(surface, lambda places: measure_level(scene, places, level.number)) for surface in cut]


def cut_to_cells(shape: shapely.Geometry) -> shapely.Geometry:
    """Cuts polygons at the lines of a grid of CELL_M, so that their parts may follow a road that is not plane."""
    if shape.is_empty:
        return shape
    (left, low), (right, high) = CELL_M * np.floor(np.reshape(shape.bounds, (2, 2)) / CELL_M) + [[0.0, 0.0], [CELL_M, CELL_M]]
    pieces: list[shapely.Geometry] = []
    for x in np.arange(left, right, CELL_M):
        column = shapely.clip_by_rect(shape, x, low, x + CELL_M, high)
        rows = [] if column.is_empty else np.arange(low, high, CELL_M)
        pieces += [shapely.clip_by_rect(column, x, y, x + CELL_M, y + CELL_M) for y in rows]
    parts = [part for piece in pieces for part in shapely.get_parts(piece)]
    return shapely.GeometryCollection([part for part in parts if part.geom_type == "Polygon"])


def drape(surface: Surface, measure_height: Callable[[Float[np.ndarray, "N 2"]], Float[np.ndarray, " N"]]) -> Surface:
    """Lifts a surface by the heights of the road under it."""
    lifted = surface.vertices.copy()
    lifted[:, 2] += measure_height(lifted[:, :2])
    return surface._replace(vertices=lifted)


def _make_ground(scene: Scene) -> Surface:
    """The ground beside the lowest level, a little below it."""
    middle, half = extent(scene.road)
    axis = np.arange(-half - RIM_M, half + RIM_M + GRID_M, GRID_M)
    places = middle + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    corner = (np.arange(len(axis) - 1)[:, None] * len(axis) + np.arange(len(axis) - 1)).reshape(-1, 1)
    faces = np.concatenate([corner + np.array(steps) for steps in ((0, 1, len(axis) + 1), (0, len(axis) + 1, len(axis)))])
    return Surface("hills", np.column_stack([places, measure_level(scene, places, 0) - BELOW_M]), faces, GROUND)


def find_patches(weather: Weather, cut: Callable[[shapely.Geometry], shapely.Geometry] = lambda shape: shape) -> list[Surface]:
    """Surfaces `patch{number}` of the present patches of one world, later ones higher; one without area has no faces."""
    surfaces = []
    for number, area in enumerate(patch_overlay.areas(weather)):
        shape = shapely.union_all([shapely.Polygon(piece).buffer(0) for piece in area.pieces])
        surfaces.append(prism(f"patch{number}", cut(shape), PATCH_M + 0.001 * number, (*rgb(area.colour), 0.75)))
    return surfaces


def add_mesh(model: mujoco.MjSpec, surface: Surface) -> mujoco.MjsGeom:
    """Adds a surface without contacts."""
    mesh = model.add_mesh(name=surface.name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = surface.vertices.ravel().astype(np.float32), surface.faces.ravel().astype(np.int32)
    look = {"name": surface.name, "type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": surface.name, "rgba": list(surface.colour)}
    return model.worldbody.add_geom(contype=0, conaffinity=0, **look)


def _shape(line: shapely.LineString, look: LayerLook) -> shapely.Geometry:
    if look.area and len(line.coords) > 3 and shapely.get_point(line, 0).distance(shapely.get_point(line, -1)) < 0.1:
        return shapely.Polygon(line).buffer(0)
    if not look.broken:
        return line.buffer(look.half_m, cap_style="flat", join_style="mitre")
    begins = np.arange(0.0, line.length, DASH_M + GAP_M)
    dashes = [ops.substring(line, begin, begin + DASH_M) for begin in begins]
    return shapely.union_all([dash.buffer(look.half_m, cap_style="flat") for dash in dashes])


def prism(name: str, shape: shapely.Geometry, height_m: float, colour: Colour) -> Surface:
    """Extrudes polygons from the ground: tops face up, walls face outwards, no bottoms."""
    vertices: list[Float[np.ndarray, "n 3"]] = [np.zeros((0, 3))]
    faces: list[Int[np.ndarray, "n 3"]] = [np.zeros((0, 3), int)]
    count = 0
    for polygon in shapely.get_parts(shape):
        if polygon.geom_type != "Polygon" or polygon.area < 1e-4:
            continue
        polygon = shapely.orient_polygons(polygon)  # exterior counter-clockwise, holes clockwise
        triangles = shapely.orient_polygons(shapely.constrained_delaunay_triangles(polygon))
        corners = np.concatenate([shapely.get_coordinates(triangle)[:3] for triangle in triangles.geoms])
        vertices.append(np.c_[corners, np.full(len(corners), height_m)])
        faces.append(count + np.arange(len(corners)).reshape(-1, 3))
        count += len(corners)
        for ring in (polygon.exterior, *polygon.interiors):
            points = np.asarray(ring.coords)
            here, there = points[:-1], points[1:]
            low, high = np.zeros(len(here)), np.full(len(here), height_m)
            vertices.append(np.concatenate([np.c_[here, low], np.c_[there, low], np.c_[there, high], np.c_[here, high]]))
            corner = count + np.arange(len(here))[:, None] + len(here) * np.array([0, 1, 2, 0, 2, 3])
            faces.append(corner.reshape(-1, 3))
            count += 4 * len(here)
    return Surface(name, np.concatenate(vertices), np.concatenate(faces), colour)


def extent(road: Road) -> tuple[Float[np.ndarray, "2"], float]:
    """Centre of a road's bounding box, and half its longer side."""
    places = np.asarray(road.midpoint, float)[np.asarray(road.valid, bool)]
    low, high = places.min(axis=0), places.max(axis=0)
    return (low + high) / 2, float((high - low).max() / 2)
