"""Compares sets of scenes: distributions of map elements and of the motion of traffic."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import RawScene, Track
from scenefactory_jax.core.types import CROSSWALK, DRIVABLE, DRIVEWAY, EDGES, LINES, STOP_SIGN

CURVE_M = 3.0  # step of lane curvature: logged points are rounded to centimetres
ACCELERATION_STEPS = 5  # over which changes of speed and heading are measured, for the same reason
MOVING_M = 3.0  # smallest distance that a moving vehicle travels in the log
STANDING_MPS = 0.5  # slower vehicles have no yaw rate
Samples = dict[str, Float[np.ndarray, " N"]]


class Quantity(NamedTuple):
    """A compared quantity: axis label, and the unit of one sample."""

    label: str
    each: str


QUANTITIES: dict[str, Quantity] = {
    "lane_m": Quantity("lanes in the box, m", "scene"),
    "edge_m": Quantity("road edges in the box, m", "scene"),
    "line_m": Quantity("painted lines in the box, m", "scene"),
    "points": Quantity("road points in the box", "scene"),
    "segment_m": Quantity("segment of a road element, m", "segment"),
    "lane_length_m": Quantity("length of a lane, m", "lane"),
    "curvature_1_m": Quantity("curvature of lanes, 1/m", "3 m of lane"),
    "crosswalks": Quantity("crosswalks", "scene"),
    "stop_signs": Quantity("stop signs", "scene"),
    "driveways": Quantity("driveways", "scene"),
    "lights": Quantity("lanes with a light", "scene"),
    "vehicles": Quantity("vehicles in the box", "scene"),
    "moving": Quantity("moving vehicles in the box", "scene"),
    "pedestrians": Quantity("pedestrians in the box", "scene"),
    "cyclists": Quantity("cyclists in the box", "scene"),
    "speed_mps": Quantity("speed of moving vehicles, m/s", "vehicle"),
    "acceleration_mps2": Quantity("acceleration of moving vehicles, m/s²", "vehicle and half second"),
    "yaw_rate": Quantity("yaw rate of moving vehicles, rad/s", "vehicle and half second"),
    "travel_m": Quantity("distance of moving vehicles in the log, m", "vehicle"),
    "recorded": Quantity("fraction of the log in which a vehicle is valid", "vehicle"),
    "nearest_m": Quantity("from a moving vehicle to the next vehicle, m", "vehicle"),
}


class Difference(NamedTuple):
    """Two distributions of one quantity."""

    ks: float  # Kolmogorov-Smirnov statistic: largest difference between the two distribution functions, 0 to 1
    wasserstein: float  # earth mover's distance over the standard deviation of both together


def measure(raw: RawScene, *, scene_size_m: float) -> Samples:
    """Samples of every quantity in one scene.

    Args:
        scene_size_m: side of the box, around the recording car at the current step, or the mean road point.
    """
    centre = _centre(raw)
    inside = lambda points: np.abs(points[:, :2] - centre).max(axis=1) <= scene_size_m / 2  # noqa: E731
    roads = [(road.kind, road.xyz[:, :2], inside(road.xyz)) for road in raw.roads]
    long = [(kind, points, near) for kind, points, near in roads if len(points) >= 2 and near.any()]
    count = lambda kind: np.array([sum(near.any() for own, _, near in roads if own == kind)], float)  # noqa: E731
    lanes = [(points, near) for kind, points, near in long if kind in DRIVABLE]
    samples: Samples = {
        "lane_m": np.array([_metres(long, DRIVABLE)]),
        "edge_m": np.array([_metres(long, EDGES)]),
        "line_m": np.array([_metres(long, LINES)]),
        "points": np.array([sum(near.sum() for _, _, near in long)], float),
        "segment_m": _joined([_steps(points)[near[1:] & near[:-1]] for _, points, near in long]),
        "lane_length_m": np.array([_steps(points).sum() for points, _ in lanes]),
        "curvature_1_m": _joined([_curvature(points[near]) for points, near in lanes]),
        "crosswalks": count(CROSSWALK),
        "stop_signs": count(STOP_SIGN),
        "driveways": count(DRIVEWAY),
        "lights": np.array([len({light.lane for light in raw.lights})], float),
    }
    return samples | _measure_traffic(raw, centre, scene_size_m / 2)


def _measure_traffic(raw: RawScene, centre: Float[np.ndarray, "2"], half: float) -> Samples:
    """Samples of the road users in the box at the current step, and of their motion."""
    now, dt = raw.current, float(np.median(np.diff(raw.times)))
    here = [track for track in raw.tracks if track.valid[now] and np.abs(track.xyz[now, :2] - centre).max() <= half]
    number = lambda kind: np.array([sum(track.kind == kind for track in here)], float)  # noqa: E731
    vehicles = [track for track in here if track.kind == "vehicle"]
    distances = [_measure_travel(track) for track in vehicles]
    moving = [track for track, distance in zip(vehicles, distances, strict=True) if distance > MOVING_M]
    places = np.array([track.xyz[now, :2] for track in vehicles]).reshape(-1, 2)
    positions = np.array([track.xyz[now, :2] for track in moving]).reshape(-1, 2)
    nearest = KDTree(places).query(positions, k=2)[0][:, 1] if len(places) > 1 and len(positions) else np.zeros(0)
    changes = [_changes(track, dt) for track in moving]
    return {
        "vehicles": number("vehicle"),
        "moving": np.array([len(moving)], float),
        "pedestrians": number("pedestrian"),
        "cyclists": number("cyclist"),
        "speed_mps": np.array([float(np.hypot(*track.velocity[now])) for track in moving]),
        "acceleration_mps2": _joined([change[0] for change in changes]),
        "yaw_rate": _joined([change[1] for change in changes]),
        "travel_m": np.array([distance for distance in distances if distance > MOVING_M]),
        "recorded": np.array([track.valid.mean() for track in vehicles]),
        "nearest_m": nearest,
    }


def _centre(raw: RawScene) -> Float[np.ndarray, "2"]:
    """The recording car at the current step, or else the mean of the road points."""
    if raw.sdc is not None and raw.tracks[raw.sdc].valid[raw.current]:
        return raw.tracks[raw.sdc].xyz[raw.current, :2]
    return np.concatenate([road.xyz[:, :2] for road in raw.roads if len(road.xyz) >= 2]).mean(axis=0)


def _steps(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " M"]:
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def _joined(parts: Sequence[np.ndarray]) -> Float[np.ndarray, " N"]:
    return np.concatenate([np.zeros(0), *parts])


def _metres(roads: Sequence[tuple[int, np.ndarray, Bool[np.ndarray, "_"]]], kinds: Sequence[int]) -> float:
    """Length of the roads of some kinds within the box."""
    return float(sum(_steps(points)[near[1:] & near[:-1]].sum() for kind, points, near in roads if kind in kinds))


def _curvature(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " M"]:
    """Absolute curvature along a lane, a value every CURVE_M."""
    place = np.concatenate([[0.0], np.cumsum(_steps(points))])
    if place[-1] < 3 * CURVE_M:
        return np.zeros(0)
    at = np.arange(0.0, place[-1], CURVE_M)
    coarse = np.stack([np.interp(at, place, points[:, axis]) for axis in (0, 1)], axis=-1)
    ahead = np.diff(coarse, axis=0)
    turn = np.diff(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.abs(np.mod(turn + np.pi, 2 * np.pi) - np.pi) / CURVE_M


def _measure_travel(track: Track) -> float:
    """From the first to the last valid position, m."""
    rows = np.flatnonzero(track.valid)
    return float(np.linalg.norm(track.xyz[rows[-1], :2] - track.xyz[rows[0], :2]))


def _changes(track: Track, dt: float) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " M"]]:
    """Acceleration along the path and yaw rate, over half seconds without an invalid step."""
    speed = np.hypot(*track.velocity.T)
    first = np.arange(0, len(speed) - ACCELERATION_STEPS, ACCELERATION_STEPS)
    last = first + ACCELERATION_STEPS
    valid = np.array([track.valid[a : b + 1].all() for a, b in zip(first, last, strict=True)], bool)
    turned = np.mod(track.yaw[last] - track.yaw[first] + np.pi, 2 * np.pi) - np.pi
    driven = valid & (speed[first] > STANDING_MPS)
    span = ACCELERATION_STEPS * dt
    return ((speed[last] - speed[first]) / span)[valid], (turned / span)[driven]


def collect(scenes: Iterable[RawScene], *, scene_size_m: float) -> Samples:
    """The samples of many scenes, pooled."""
    found = [measure(raw, scene_size_m=scene_size_m) for raw in scenes]
    return {name: _joined([one[name] for one in found]) for name in QUANTITIES}


def compare(one: Samples, other: Samples) -> dict[str, Difference | None]:
    """Distances between two sets by quantity; None where a set has no sample, as lights in a format without them."""
    return {name: _difference(one[name], other[name], counted=name == "lights") for name in QUANTITIES}


def _difference(one: Float[np.ndarray, " N"], other: Float[np.ndarray, " M"], *, counted: bool) -> Difference | None:
    if not len(one) or not len(other) or (counted and not (one.any() and other.any())):
        return None
    spread = float(np.std(np.concatenate([one - one.mean(), other - other.mean()]))) or 1.0
    result = stats.ks_2samp(one, other, method="asymp")
    return Difference(
        ks=float(result.statistic),  # pyright: ignore[reportAttributeAccessIssue]
        wasserstein=float(stats.wasserstein_distance(one, other)) / spread,
    )


def mean_distance(differences: Mapping[str, Difference | None]) -> float:
    """Mean of the Kolmogorov-Smirnov statistics of the quantities that both sets have."""
    return float(np.mean([one.ks for one in differences.values() if one is not None]))
