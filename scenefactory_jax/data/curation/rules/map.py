"""Rules on the map: several levels, lanes that no car can follow, and missing maps."""

from collections.abc import Iterator

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import DRIVABLE, EDGES
from scenefactory_jax.data.curation.quality_gate import Finding


def levels(raw: RawScene, *, rise_m: float) -> list[Finding]:
    """Lanes that cross other lanes or road edges in the plane, but at another height: bridges and tunnels."""
    lines = [line for line in raw.roads if line.kind in DRIVABLE + EDGES and len(line.xyz) > 1]
    if not lines:
        return []
    top, bottom = (np.array([pick(line.xyz[:, 2]) for line in lines]) for pick in (np.max, np.min))
    if top.max() - bottom.min() <= rise_m:
        return []
    shapes = np.array([shapely.LineString(line.xyz[:, :2]) for line in lines], dtype=object)
    drivable = np.array([line.kind in DRIVABLE for line in lines])
    one, other = shapely.STRtree(shapes).query(shapes[drivable], predicate="intersects")
    one = np.flatnonzero(drivable)[one]
    apart = np.maximum(top[one] - bottom[other], top[other] - bottom[one]) > rise_m
    chosen = apart & ((one < other) | ~drivable[other])
    found = []
    for first, second in zip(one[chosen], other[chosen], strict=True):
        for place in shapely.get_coordinates(shapely.intersection(shapes[first], shapes[second])):
            high, low = (_height(lines[index].xyz, place) for index in (first, second))
            if abs(high - low) > rise_m:
                ids = (lines[first].id, lines[second].id)
                what = "lane" if drivable[second] else "road edge"
                message = f"lane {ids[0]} crosses {what} {ids[1]} {abs(high - low):.1f} m apart in height"
                point = (float(place[0]), float(place[1]), float(max(high, low)))
                found.append(Finding(message, abs(high - low), rise_m, point, roads=ids))
                break
    return found


def _height(xyz: Float[np.ndarray, "N 3"], place: Float[np.ndarray, "2"]) -> float:
    """Height of a line at a point of the plane."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1))])
    return float(np.interp(shapely.line_locate_point(shapely.LineString(xyz[:, :2]), shapely.Point(place)), arc, xyz[:, 2]))


def short_lanes(raw: RawScene, *, min_length_m: float) -> list[Finding]:
    """Driving lanes that are shorter, down to single points."""
    found = []
    for line in raw.roads:
        if line.kind in DRIVABLE:
            length = float(np.linalg.norm(np.diff(line.xyz[:, :2], axis=0), axis=1).sum())
            if length < min_length_m:
                place = line.xyz[0] if len(line.xyz) else None
                found.append(Finding(f"lane {line.id} is {length:.2f} m long", length, min_length_m, place, roads=(line.id,)))
    return found


def kinks(raw: RawScene, *, turn_deg: float, min_step_m: float) -> list[Finding]:
    """Lanes whose direction changes by more than `turn_deg` at a point; steps shorter than `min_step_m` are ignored."""
    found = []
    for line in _long(raw):
        step = np.diff(line.xyz[:, :2], axis=0)
        long = np.flatnonzero(np.hypot(step[:, 0], step[:, 1]) >= min_step_m)
        turn = np.rad2deg(_turns(step[long]))
        if len(turn) and (value := float(turn.max())) > turn_deg:
            place = line.xyz[long[int(np.argmax(turn)) + 1]]
            found.append(Finding(f"lane {line.id} turns by {value:.0f} degrees at a point", value, turn_deg, place, roads=(line.id,)))
    return found


def tight_turns(raw: RawScene, *, radius_m: float, piece_m: float) -> list[Finding]:
    """Lanes that turn with a smaller radius, measured on pieces of `piece_m`, so that single points do not count."""
    found = []
    for line in _long(raw):
        step = np.linalg.norm(np.diff(line.xyz[:, :2], axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(step)])
        count = int(arc[-1] // piece_m)
        if count < 2:
            continue
        places = np.linspace(0.0, arc[-1], count + 1)
        points = np.stack([np.interp(places, arc, line.xyz[:, axis]) for axis in range(3)], axis=1)
        chord = np.diff(points[:, :2], axis=0)
        # equal chords of a circle turn by twice the angle whose sine is half a chord over the radius
        sine = np.sin(_turns(chord) / 2)
        length = np.linalg.norm(chord[1:], axis=1)
        radius = np.divide(length, 2 * sine, out=np.full(len(sine), np.inf), where=sine > 0)
        if (value := float(radius.min())) < radius_m:
            place = points[int(np.argmin(radius)) + 1]
            found.append(Finding(f"lane {line.id} turns with a radius of {value:.1f} m", value, radius_m, place, roads=(line.id,)))
    return found


def self_crossings(raw: RawScene) -> list[Finding]:
    """Lanes that cross themselves."""
    lines = list(_long(raw))
    shapes = np.array([shapely.LineString(line.xyz[:, :2]) for line in lines], dtype=object)
    found = []
    for index in np.flatnonzero(~shapely.is_simple(shapes)):
        # the crossing is where the line, cut up at all its crossings, has a point that is no vertex of an end
        pieces = shapely.get_parts(shapely.unary_union(shapes[index]))
        joint = shapely.get_coordinates(pieces[0])[-1]
        line = lines[index]
        place = (float(joint[0]), float(joint[1]), _height(line.xyz, joint))
        found.append(Finding(f"lane {line.id} crosses itself", 1.0, 0.0, place, roads=(line.id,)))
    return found


def missing_map(raw: RawScene, *, lanes: int, edges: int) -> list[Finding]:
    """Fewer driving lanes, or fewer road edges."""
    found = []
    for name, kinds, least in (("lanes for cars", DRIVABLE, lanes), ("road edges", EDGES, edges)):
        count = sum(line.kind in kinds and len(line.xyz) > 1 for line in raw.roads)
        if count < least:
            found.append(Finding(f"the map has {count} {name}", float(count), float(least)))
    return found


def small_map(raw: RawScene, *, beyond_m: float) -> list[Finding]:
    """Vehicles whose logged positions are farther outside of the map's hull."""
    points = [line.xyz[:, :2] for line in raw.roads if len(line.xyz)]
    tracks = [track for track in raw.tracks if track.kind == "vehicle" and track.valid.any()]
    if not points or not tracks:
        return []
    hull = shapely.convex_hull(shapely.LineString(np.concatenate([*points, points[0][:1]])))
    near = shapely.buffer(hull, beyond_m)
    shapely.prepare(near)
    found = []
    for track in tracks:
        steps = np.flatnonzero(track.valid)
        if shapely.contains_xy(near, track.xyz[steps, 0], track.xyz[steps, 1]).all():
            continue
        away = shapely.distance(hull, shapely.points(track.xyz[steps, :2]))
        value, step = float(away.max()), int(steps[np.argmax(away)])
        message = f"vehicle {track.id} is {value:.0f} m beyond the map at step {step}"
        found.append(Finding(message, value, beyond_m, track.xyz[step], step, (track.id,)))
    return found


def _long(raw: RawScene) -> Iterator[Polyline]:
    """Driving lanes with two points or more."""
    return (line for line in raw.roads if line.kind in DRIVABLE and len(line.xyz) > 1)


def _turns(step: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " M"]:
    """Changes of direction from each step to the next, radians."""
    yaw = np.arctan2(step[:, 1], step[:, 0])
    return np.abs(wrap_angles(np.diff(yaw)))
