"""Computes numbers that describe a scene: metadata columns to filter by, to stratify by and to compare data sets with.

Together with the columns of every bank they hold the counts of ScenarioNet (Li et al. 2023, arXiv 2306.12241; MetaDrive's
`get_number_summary`: objects by kind, moving ones, lights, map features, relief, the SDC's distance), and more of roads and motion.
A value that the source does not hold is None, never zero.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import DRIVABLE, DRIVEWAY, EDGES, LANE_BIKE, LINES, SPEED_BUMP
from scenefactory_jax.data.curation import geographic_split
from scenefactory_jax.data.curation.recorded_drive import measure_recorded_drive
from scenefactory_jax.data.packing.pack import box_corners, overlaps

LEVEL_M = 3.0  # lanes farther apart in height do not cross
CROSSING_M = 2.0  # side of the cells on which crossings are looked for: narrower than a lane, so that neighbours do not share one

COLUMNS: dict[str, str] = {
    "duration_s": "Time from the log's first step to its last.",
    "objects": "Objects of all kinds that are valid at some step.",
    "moving_objects": "Objects that come farther than `moving_m` from their first position.",
    "moving_vehicles": "Moving vehicles.",
    "moving_pedestrians": "Moving pedestrians.",
    "moving_cyclists": "Moving cyclists.",
    "parked_vehicles": "Vehicles that do not move.",
    "present_objects": "Objects that are valid at the current step.",
    "overlaps": "Pairs of boxes that share ground at the current step: errors of the log, or of its labels.",
    "distance_m": "Distance travelled by all moving objects.",
    "mean_speed_m_s": "Mean speed of the moving vehicles over their valid steps; null without any.",
    "top_speed_m_s": "Largest speed of a vehicle.",
    "sdc_distance_m": "Distance travelled by the SDC; this and the next five are null without an SDC.",
    "sdc_mean_speed_m_s": "The SDC's mean speed.",
    "sdc_top_speed_m_s": "The SDC's largest speed.",
    "sdc_turn_deg": "Turn of the SDC's heading from first to last step, left is positive.",
    "sdc_off_road_m": "Farthest that a corner of the SDC is off the road, by V-Max's rule (negative: never); null without edges.",
    "sdc_overlap_steps": "Steps at which the SDC's box shares ground with another one.",
    "map_features": "Polylines, polygons and points of the map.",
    "lane_m": "Length of all driving lanes.",
    "bike_lane_m": "Length of all bike lanes.",
    "edge_m": "Length of all road edges.",
    "line_m": "Length of all painted lines.",
    "extent_x_m": "Width of the driving lanes' bounding box, west to east.",
    "extent_y_m": "Its depth, south to north.",
    "relief_m": "Height between the lowest and the highest point of a driving lane.",
    "curvature_rad_m": "Mean absolute curvature of the driving lanes, over their length.",
    "curved_fraction": "Fraction of the driving lanes' length with a radius below `curve_radius_m`.",
    "intersections": "Places where driving lanes cross at more than `crossing_deg`; places within `junction_m` count once.",
    "branches": "Driving lanes with more than one exit; null if the source has no exits.",
    "speed_bumps": "Speed bumps.",
    "driveways": "Driveways.",
    "streets": "Hashes of some places of the lanes: scenes that share them show the same streets (`geographic_split`).",
}


def features(
    raw: RawScene,
    *,
    moving_m: float,
    chord_m: float,
    curve_radius_m: float,
    crossing_deg: float,
    junction_m: float,
    streets: Mapping[str, Any],
) -> dict[str, Any]:
    """The columns of `COLUMNS`, in their order.

    Args:
        moving_m: an object that comes farther from its first position moves.
        chord_m: length over which curvature is measured.
        curve_radius_m: largest radius of a curve.
        crossing_deg: smallest angle of lanes that cross.
        junction_m: crossings that are nearer to each other are one intersection.
        streets: numbers of `geographic_split.find_streets`.
    """
    seen = [track for track in raw.tracks if track.valid.any()]
    found: dict[str, Any] = {"duration_s": float(raw.times[-1] - raw.times[0]) if len(raw.times) else 0.0}
    found |= _traffic(seen, moving_m)
    present = [track for track in seen if track.valid[raw.current]]
    found |= {"present_objects": len(present), "overlaps": _overlaps(present, raw.current)}
    found |= _recorder(None if raw.sdc is None else raw.tracks[raw.sdc]) | measure_recorded_drive(raw, LEVEL_M)
    found |= _map(raw.roads)
    lanes = [line for line in raw.roads if line.kind in DRIVABLE]
    found |= _bends(lanes, chord_m, curve_radius_m)
    found["intersections"] = _intersections(lanes, crossing_deg, junction_m)
    found["streets"] = geographic_split.find_streets(raw, **streets).tolist()
    return {name: found[name] for name in COLUMNS}


def _traffic(tracks: Sequence[Track], moving_m: float) -> dict[str, Any]:
    """Counts by kind, distances and speeds."""
    kind = np.array([track.kind for track in tracks], dtype=str)
    valid, xy, velocity = _stacked(tracks)
    first = xy[np.arange(len(tracks)), valid.argmax(axis=1)]
    away = xy - first[:, None]
    moving = (valid & (np.hypot(away[..., 0], away[..., 1]) > moving_m)).any(axis=1)
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    vehicle = kind == "vehicle"
    driving, standing = (moving & vehicle)[:, None] & valid, valid & vehicle[:, None]
    found: dict[str, Any] = {"objects": len(tracks), "moving_objects": int(moving.sum()), "parked_vehicles": int((vehicle & ~moving).sum())}
    found |= {f"moving_{name}s": int((moving & (kind == name)).sum()) for name in ("vehicle", "pedestrian", "cyclist")}
    found["distance_m"] = float(geographic_split.lengths([xy[i][valid[i]] for i in np.flatnonzero(moving)]).sum())
    found["mean_speed_m_s"] = float(speed[driving].mean()) if driving.any() else None
    found["top_speed_m_s"] = float(speed[standing].max()) if standing.any() else None
    return found


def _stacked(tracks: Sequence[Track]) -> tuple[Bool[np.ndarray, "O L"], Float[np.ndarray, "O L 2"], Float[np.ndarray, "O L 2"]]:
    """Validity, positions and velocities of all tracks."""
    if not tracks:
        return np.zeros((0, 1), bool), np.zeros((0, 1, 2)), np.zeros((0, 1, 2))
    valid, xyz, velocity = (np.stack([getattr(track, name) for track in tracks]) for name in ("valid", "xyz", "velocity"))
    return valid, xyz[..., :2], velocity


def _recorder(track: Track | None) -> dict[str, float | None]:
    """Motion of the recording car."""
    if track is None or not track.valid.any():
        return dict.fromkeys(("sdc_distance_m", "sdc_mean_speed_m_s", "sdc_top_speed_m_s", "sdc_turn_deg"))
    speed = np.linalg.norm(track.velocity[track.valid], axis=1)
    heading = np.unwrap(track.yaw[track.valid])
    return {
        "sdc_distance_m": float(geographic_split.lengths([track.xyz[track.valid]])[0]),
        "sdc_mean_speed_m_s": float(speed.mean()),
        "sdc_top_speed_m_s": float(speed.max()),
        "sdc_turn_deg": float(np.degrees(heading[-1] - heading[0])),
    }


def _overlaps(tracks: Sequence[Track], step: int) -> int:
    """Pairs of boxes of one level that overlap at a step."""
    if len(tracks) < 2:
        return 0
    place = np.array([track.xyz[step] for track in tracks])
    size = np.array([track.size[:2] for track in tracks])
    pairs = KDTree(place[:, :2]).query_pairs(float(np.hypot(*size.T).max()), output_type="ndarray")
    apart = np.linalg.norm(np.diff(place[pairs, :2], axis=1)[:, 0], axis=1)
    near = apart < np.hypot(*size.T)[pairs].sum(axis=1) / 2
    level = np.abs(place[pairs[:, 0], 2] - place[pairs[:, 1], 2]) < LEVEL_M
    pairs = pairs[near & level]
    boxes = {i: box_corners(place[i, :2], float(tracks[i].yaw[step]), *size[i]) for i in np.unique(pairs).tolist()}
    others = {i: pairs[pairs[:, 0] == i, 1].tolist() for i in np.unique(pairs[:, 0]).tolist()}
    return sum(int(overlaps(boxes[i], np.stack([boxes[j] for j in beside])).sum()) for i, beside in others.items())


def _map(roads: Sequence[Polyline]) -> dict[str, Any]:
    """Counts, lengths and extents of the map."""
    kind = np.array([line.kind for line in roads], int)
    length = geographic_split.lengths([line.xyz for line in roads])
    metres = {"lane_m": DRIVABLE, "bike_lane_m": (LANE_BIKE,), "edge_m": EDGES, "line_m": LINES}
    found: dict[str, Any] = {name: float(length[np.isin(kind, wanted)].sum()) for name, wanted in metres.items()}
    found |= {"speed_bumps": int((kind == SPEED_BUMP).sum()), "driveways": int((kind == DRIVEWAY).sum())}
    lanes = [line for line in roads if line.kind in DRIVABLE]
    extent = np.ptp(np.concatenate([line.xyz for line in lanes]), axis=0) if lanes else np.zeros(3)
    found |= dict(zip(("extent_x_m", "extent_y_m", "relief_m"), extent.tolist(), strict=True))
    known = any(line.exit for line in lanes)
    return found | {"map_features": len(roads), "branches": sum(len(line.exit) > 1 for line in lanes) if known else None}


def _bends(lanes: Sequence[Polyline], chord_m: float, curve_radius_m: float) -> dict[str, float]:
    """Curvature of driving lanes from chord to chord; the ends of a lane count as the rest of it."""
    samples = geographic_split.sample_along(lanes, spacing_m=chord_m, min_points=4)
    way = samples.xyz[1:, :2] - samples.xyz[:-1, :2]
    heading = np.arctan2(way[:, 1], way[:, 0])
    turn = np.abs(wrap_angles(heading[1:] - heading[:-1]))
    line, step = samples.line[1:-1], samples.step[1:-1]
    bends = (samples.line[2:] == line) & (samples.line[:-2] == line) & (step > chord_m / 4)  # shorter lanes are shorter than a chord
    turn, line, step = turn[bends], line[bends], step[bends]
    if not len(turn):
        return {"curvature_rad_m": 0.0, "curved_fraction": 0.0}
    steps = np.bincount(line)[line]
    length = step * (steps + 2) / steps
    return {
        "curvature_rad_m": float((turn / step * length).sum() / length.sum()),
        "curved_fraction": float(length[turn / step > 1 / curve_radius_m].sum() / length.sum()),
    }


def _intersections(lanes: Sequence[Polyline], crossing_deg: float, junction_m: float) -> int:
    """Groups of places where two driving lanes cross, found on a grid."""
    samples = geographic_split.sample_along(lanes, spacing_m=CROSSING_M / 2)
    if not len(samples.xyz):
        return 0
    cell = np.floor(samples.xyz / np.array([CROSSING_M, CROSSING_M, LEVEL_M])).astype(np.int64)
    cell -= cell.min(axis=0)
    side = cell.max(axis=0) + 1
    key = (cell[:, 2] * side[1] + cell[:, 1]) * side[0] + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.concatenate([[True], np.diff(key[order]) > 0])
    owner = order[first][np.cumsum(first) - 1]  # of every sample, the first one in its cell
    turn = samples.heading[order] - samples.heading[owner]
    angle = np.abs(np.remainder(turn + np.pi / 2, np.pi) - np.pi / 2)  # between two lines, whichever way they are driven
    crossed = samples.xyz[np.unique(owner[angle > np.radians(crossing_deg)])]
    if not len(crossed):
        return 0
    pairs = KDTree(crossed[:, :2]).query_pairs(junction_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(crossed), len(crossed)))
    return int(connected_components(links, directed=False)[0])
