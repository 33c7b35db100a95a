"""Whether the recorded drive of the SDC leaves the road or overlaps others: where it does, it is no yardstick for a policy."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.core.types import EDGES
from scenefactory_jax.data.packing.pack import box_corners, overlaps

HEIGHT_SCALE = 2.0  # by which Waymax stretches heights in its search for the nearest edge


def measure_recorded_drive(raw: RawScene, level_m: float) -> dict[str, float | int | None]:
    """The columns `sdc_off_road_m` and `sdc_overlap_steps`, over the steps at which the SDC is valid.

    Args:
        level_m: boxes farther apart in height do not meet.
    """
    track = None if raw.sdc is None else raw.tracks[raw.sdc]
    if track is None or not track.valid.any():
        return {"sdc_off_road_m": None, "sdc_overlap_steps": None}
    others = [other for other in raw.tracks if other is not track and other.valid.any()]
    edges = [line for line in raw.roads if line.kind in EDGES and len(line.xyz) > 1]
    return {
        "sdc_off_road_m": _measure_off_road(track, edges) if edges else None,
        "sdc_overlap_steps": _count_overlaps(track, others, level_m) if others else 0,
    }


def _place_boxes(track: Track) -> Float[np.ndarray, "L 4 2"]:
    return box_corners(track.xyz[:, :2], track.yaw, float(track.size[0]), float(track.size[1]))


def _measure_off_road(track: Track, edges: list[Polyline]) -> float:
    """Largest signed distance of a corner to the nearest point of an edge, as Waymax's off-road rule takes it: positive to its right."""
    points = np.concatenate([line.xyz[:-1] for line in edges])
    ahead = np.concatenate([np.diff(line.xyz[:, :2], axis=0) for line in edges])
    first = np.cumsum([0] + [len(line.xyz) - 1 for line in edges[:-1]])
    before = np.maximum(np.arange(len(points)) - 1, 0)
    before[first] = first
    corners = _place_boxes(track)[track.valid]
    height = np.broadcast_to(track.xyz[track.valid, None, 2:], (*corners.shape[:2], 1))
    scale = [1.0, 1.0, HEIGHT_SCALE]
    _, nearest = KDTree(points * scale).query(np.concatenate([corners, height], axis=2) * scale)
    apart = corners - points[nearest, :2]
    side, side_before = (ahead[rows, 1] * apart[..., 0] - ahead[rows, 0] * apart[..., 1] for rows in (nearest, before[nearest]))
    return float((np.sign(np.minimum(side, side_before)) * np.linalg.norm(apart, axis=-1)).max())


def _count_overlaps(track: Track, others: list[Track], level_m: float) -> int:
    """Steps at which the track's box shares ground with another one."""
    own, met = _place_boxes(track), np.zeros(len(track.valid), bool)
    for other in others:
        reach = (np.hypot(*track.size[:2]) + np.hypot(*other.size[:2])) / 2
        near = track.valid & other.valid & (np.abs(track.xyz[:, 2] - other.xyz[:, 2]) < level_m)
        near &= np.linalg.norm(track.xyz[:, :2] - other.xyz[:, :2], axis=1) < reach
        if near.any():
            met[near] |= overlaps(own[near], _place_boxes(other)[near])
    return int(met.sum())
