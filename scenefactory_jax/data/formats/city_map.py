"""The map of a city, or of a part of it, of which scenes are cut: nuPlan and nuScenes. Both are level, as their cars' poses are."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline, SceneError, Track
from scenefactory_jax.core.types import EDGE_BOUNDARY, STOP_SIGN, RoadUser
from scenefactory_jax.data.formats import drivable_outline, polylines, scene_parts
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers

ACROSS = 0.8  # cosine of the angle between an edge and a lane that it runs across
Plane = Float[np.ndarray, "_ 2"]  # any number of points


@dataclass(frozen=True)
class CityNumbers:
    """Numbers of maps, and of the scenes that are cut of them."""

    reach_m: float  # of a scene's map around the recording car's path
    point_spacing_m: float  # maximum, of lanes, lines and edges
    lane_width_m: float  # that is drivable around every lane's centre
    end_gap_m: float  # no edge runs across a lane so near to its end that leads nowhere
    seam_m: float  # narrower gaps between areas are closed
    hole_m2: float  # smaller holes in them are closed


@dataclass(frozen=True)
class EgoBox:
    """The recording car, which its poses give by the middle of its rear axle."""

    size_m: tuple[float, float, float]  # length, width, height
    centre_m: float  # of the box before the rear axle


class Sign(NamedTuple):
    """A stop sign."""

    place: Plane  # one point
    lanes: tuple[int, ...]


class CityMap(NamedTuple):
    """What scenes are cut of."""

    lanes: Sequence[Polyline]
    lines: Sequence[tuple[int, Plane]]  # painted lines and road edges, which a scene has pieces of
    shapes: Sequence[tuple[int, Plane]]  # outlines of crosswalks, which it has whole
    signs: Sequence[Sign]
    inside: frozenset[int]  # lanes in junctions
    points: Plane  # of all lanes, lines and shapes
    starts: Int[np.ndarray, " _"]  # of each of them in `points`


def make_city_map(
    lanes: Sequence[Polyline],
    marks: Sequence[tuple[int, Plane]],
    shapes: Sequence[tuple[int, Plane]],
    signs: Sequence[Sign],
    inside: Sequence[int],
    areas: Sequence[shapely.Polygon],
    numbers: CityNumbers,
    where: str,
) -> CityMap:
    """A map whose road edges are the outline of the areas and the lanes together, except where a lane leaves the map."""
    ways = shapely.buffer([shapely.LineString(lane.xyz[:, :2]) for lane in lanes], numbers.lane_width_m / 2, cap_style="flat")
    outline = OutlineNumbers(cut_m=0.0, seam_m=numbers.seam_m, hole_m2=numbers.hole_m2)
    paved = [*areas, *(way for way in shapely.get_parts(ways) if not way.is_empty)]
    edges = [edge[:, :2] for edge in drivable_outline.find_edges(paved, [], outline, where, spacing_m=numbers.point_spacing_m)]
    ends = [lane.xyz[rows, :2] for lane in lanes for rows, links in (([0, 1], lane.entry), ([-1, -2], lane.exit)) if not links]
    if ends:
        edges = [piece for edge in edges for piece in _cut_line(edge, ~_find_exits(edge, np.stack(ends), numbers.end_gap_m))]
    lines = [(kind, polylines.densify(line, numbers.point_spacing_m)) for kind, line in marks if len(line) > 1]
    lines += [(EDGE_BOUNDARY, edge) for edge in edges]
    every = [*(lane.xyz[:, :2] for lane in lanes), *(line for _, line in (*lines, *shapes))]
    starts = np.cumsum([0, *(len(line) for line in every[:-1])])
    return CityMap(lanes, lines, shapes, signs, frozenset(inside), np.concatenate(every), starts)


def cut_roads(city: CityMap, path: Plane, reach_m: float) -> tuple[Polyline, ...]:
    """The roads within `reach_m` of a path: lanes, crosswalks and signs whole, of lines and edges the pieces there.

    Lanes keep their ids, and their links to lanes that are left out.
    """
    near = np.asarray(((city.points >= path.min(axis=0) - reach_m) & (city.points <= path.max(axis=0) + reach_m)).all(axis=1))
    near[near] = KDTree(path).query(city.points[near])[0] <= reach_m
    rows = np.flatnonzero(np.add.reduceat(near, city.starts, dtype=int)).tolist()
    lanes = [city.lanes[row] for row in rows if row < len(city.lanes)]
    drawn: list[tuple[int, Plane]] = []
    for row in rows[len(lanes) :]:
        place, start = row - len(city.lanes), city.starts[row]
        if place < len(city.lines):
            kind, line = city.lines[place]
            drawn += [(kind, piece) for piece in _cut_line(line, near[start : start + len(line)])]
        else:
            drawn.append(city.shapes[place - len(city.lines)])
    start = max((lane.id for lane in city.lanes), default=0) + 1
    others = [Polyline(kind, to_level(line), start + place) for place, (kind, line) in enumerate(drawn)]
    there, start = {lane.id for lane in lanes}, start + len(drawn)
    signs = [sign for sign in city.signs if there.intersection(sign.lanes)]
    stops = [Polyline(STOP_SIGN, to_level(sign.place), start + place, lanes=sign.lanes) for place, sign in enumerate(signs)]
    return (*lanes, *others, *stops)


def _find_exits(edge: Plane, ends: Float[np.ndarray, "N 2 2"], gap_m: float) -> Bool[np.ndarray, " _"]:
    """Where an edge runs across a lane's end nearby; `ends` are the last points of lanes and those before them."""
    apart, nearest = KDTree(ends[:, 0]).query(edge)
    along, tangent = (ends[:, 1] - ends[:, 0])[nearest], np.gradient(edge, axis=0)
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(tangent, axis=1)
    return np.asarray((apart <= gap_m) & (np.abs(np.sum(along * tangent, axis=1)) < ACROSS * lengths))


def _cut_line(line: Plane, near: Bool[np.ndarray, " _"]) -> list[Plane]:
    """The pieces of a line of two points or more that are near."""
    if not near.any():
        return []
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]])))
    return [line[first:stop] for first, stop in bounds.reshape(-1, 2) if stop - first > 1]


def to_level(line: Plane) -> Float[np.ndarray, "_ 3"]:
    """Points of height 0."""
    return np.pad(line, ((0, 0), (0, 1)))


def place_ego(path: Float[np.ndarray, "L 2"], yaw: Float[np.ndarray, " L"], ego: EgoBox) -> Float[np.ndarray, "L 2"]:
    """The middles of the recording car's box, from the middles of its rear axle."""
    return path + ego.centre_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)


def differentiate(
    values: Float[np.ndarray, "L D"], times: Float[np.ndarray, " L"], valid: Bool[np.ndarray, " L"]
) -> Float[np.ndarray, "L D"]:
    """Central differences over the valid steps; zeros at a single one."""
    rates = np.zeros_like(values)
    if valid.sum() > 1:
        rates[valid] = np.gradient(values[valid], times[valid], axis=0)
    return rates


def make_track(
    where: str,
    number: int,
    kind: RoadUser,
    size: Sequence[float],
    path: Float[np.ndarray, "L 2"],
    yaw: Float[np.ndarray, " L"],
    velocity: Float[np.ndarray, "L 2"],
    valid: Bool[np.ndarray, " L"],
    times: Float[np.ndarray, " L"],
) -> Track:
    """A track on the level; velocities that are not finite follow from the positions."""
    velocity = np.where(np.isfinite(velocity).all(axis=1, keepdims=True), velocity, differentiate(path, times, valid))
    position = np.column_stack([path, np.full(len(path), float(size[2]) / 2)])
    return scene_parts.make_track(where, id=number, kind=kind, size=size, position=position, heading=yaw, velocity=velocity, valid=valid)


def find_yaw(rotation: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, " N"]:
    """The yaw of quaternions (w, x, y, z)."""
    w, x, y, z = rotation.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def find_file(path: Path, folder: str | None, key: str, patterns: Sequence[str]) -> Path:
    """The map of a log: a file of one of the patterns, in order, in `folder` or, if that is null, in `maps` in a folder above the log.

    Of several the one in the folder of the highest version is taken. `key` is that of `folder` in the config, for messages.
    """
    above = Path(path).absolute().parents
    tops = [Path(folder)] if folder is not None else above
    for root in (place for top in tops for place in (top / "maps", top)):
        for pattern in patterns:
            if found := [file for file in root.glob(pattern) if file.is_file()]:
                return max(found, key=lambda file: [int(part) for part in re.findall(r"\d+", file.parent.name)])
    where = f"in {folder}" if folder is not None else f"in {above[0] / 'maps'} or in maps of a folder above that one"
    raise SceneError(f"{path}: its map is missing: expected {' or '.join(patterns)} {where} (scenes.{key} names another)")
