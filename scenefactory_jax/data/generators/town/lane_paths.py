"""Paths of road users: along connected lanes, across lane changes, over crosswalks."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import Points, arc_length, cut, interpolate, join, right_normals, smoothstep
from scenefactory_jax.data.generators.town.road_network import CHANGING, WALKING, Network

STEP_M = 0.5  # between the points of a path
SMOOTH = 5  # points over which curvature is averaged
LANE_END_M = 4.0  # length of lane after a lane change


class Path(NamedTuple):
    """Path of one road user, with points STEP_M apart."""

    points: Float[np.ndarray, "N 2"]
    yaw: Float[np.ndarray, " N"]
    speed: Float[np.ndarray, " N"]  # maximum, m/s
    rank: Float[np.ndarray, " N"]  # right of way
    gates: tuple[tuple[float, int], ...]  # (place, gate): where a light, a sign or a crosswalk can stop the road user
    lanes: tuple[int, ...]  # of the network, in driving order

    @property
    def length(self) -> float:
        """Length, m."""
        return (len(self.points) - 1) * STEP_M


class PathPiece(NamedTuple):
    """Part of a path with one speed limit and one right of way."""

    points: Points
    limit: float
    rank: int
    gate: int | None
    lane: int


def make_path(pieces: list[PathPiece], *, limit_fraction: float, lateral: float, braking: float) -> Path:
    """Joins pieces to a path and computes the maximum speed at its points, with braking before bends.

    Args:
        limit_fraction: fraction of the speed limits that the driver keeps to.
        lateral, braking: maximum accelerations, m/s^2.
    """
    points = join([piece.points for piece in pieces])
    lengths = np.array([arc_length(piece.points)[-1] for piece in pieces])
    ends = np.cumsum(lengths)
    place = arc_length(points)
    at = np.arange(int(place[-1] / STEP_M) + 1) * STEP_M
    points = interpolate(at, place, points)
    step = np.diff(points, axis=0)
    headings = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    yaw = np.interp(np.arange(len(points)), np.arange(len(headings)) + 0.5, headings)
    bend = np.abs(np.convolve(np.pad(np.gradient(yaw, STEP_M), SMOOTH // 2, mode="edge"), np.ones(SMOOTH) / SMOOTH, mode="valid"))
    piece_of = np.minimum(np.searchsorted(ends, at, side="right"), len(pieces) - 1)
    limit = limit_fraction * np.array([piece.limit for piece in pieces])[piece_of]
    squared = np.minimum(limit**2, lateral / np.maximum(bend, 1e-4))
    braked = 2 * braking * at
    speed = np.sqrt(np.minimum.accumulate((squared + braked)[::-1])[::-1] - braked)
    rank = np.array([piece.rank for piece in pieces], float)[piece_of]
    starts = zip((ends - lengths).tolist(), pieces, strict=True)
    gates = tuple((start, piece.gate) for start, piece in starts if piece.gate is not None)
    return Path(points, yaw, speed, rank, gates, tuple(piece.lane for piece in pieces))


def draw_path(
    rng: np.random.Generator,
    network: Network,
    lane: int,
    begin: float,
    length: float,
    *,
    lane_change_fraction: float,
    lane_change_m: tuple[float, float],
) -> list[PathPiece]:
    """Draws a path of a length from a place on a lane: an exit at every fork, and lane changes of a length within a range.

    `lane_change_fraction` is the probability of a lane change on a lane that is long enough.
    """
    pieces: list[PathPiece] = []
    left, control = length, None
    while True:
        current = network.lanes[lane]
        place = arc_length(current.points)
        beside = [*network.left[lane], *network.right[lane]]
        room = float(place[-1]) - begin - LANE_END_M
        if beside and room > lane_change_m[0] and rng.random() < lane_change_fraction:
            target = int(rng.choice(beside))
            over = min(rng.uniform(*lane_change_m), room)
            start = begin + float(rng.uniform(0.0, room - over))
            change, begin = _change_lane(network, lane, target, begin, start, start + over, control)
            pieces += change
            left -= start + over - (place[-1] - room - LANE_END_M)
            lane, control = target, None
            current, place = network.lanes[lane], arc_length(network.lanes[lane].points)
        if not pieces or place[-1] - begin > STEP_M / 10:
            pieces.append(PathPiece(cut(current.points, place, begin, float(place[-1])), current.limit, current.rank, control, lane))
        left -= float(place[-1]) - begin
        if left <= 0 or not network.exits[lane]:
            return pieces
        lane, begin = int(rng.choice(network.exits[lane])), 0.0
        control = network.lanes[lane].control


def _change_lane(
    network: Network, lane: int, target: int, begin: float, start: float, end: float, control: int | None
) -> tuple[list[PathPiece], float]:
    """Computes the path along a lane to `start` and over to its neighbour, and the place on the neighbour where it ends."""
    current, other = network.lanes[lane], network.lanes[target]
    place, other_place = arc_length(current.points), arc_length(other.points)
    scale = float(other_place[-1] / place[-1])
    at = np.linspace(start, end, max(8, int((end - start) / STEP_M)))
    weight = smoothstep((at - start) / (end - start))[:, None]
    points = (1 - weight) * interpolate(at, place, current.points) + weight * interpolate(at * scale, other_place, other.points)
    change = PathPiece(points, current.limit, CHANGING, None, lane)
    if start - begin < STEP_M:
        return [change._replace(gate=control)], end * scale
    return [PathPiece(cut(current.points, place, begin, start), current.limit, current.rank, control, lane), change], end * scale


def offset_path(pieces: list[PathPiece], right: float) -> list[PathPiece]:
    """Shifts a path to its right."""
    points = join([piece.points for piece in pieces])
    shifted = points + right * right_normals(points)
    ends = np.cumsum([len(piece.points) - 1 for piece in pieces])
    return [piece._replace(points=shifted[end + 1 - len(piece.points) : end + 1]) for piece, end in zip(pieces, ends, strict=True)]


def walk(points: Points, speed: float, *, crosswalk: tuple[float, int] | None) -> Path:
    """Makes the path of a pedestrian; `crosswalk` is the place and the gate of a crosswalk on it."""
    path = make_path([PathPiece(points, speed, WALKING, None, -1)], limit_fraction=1.0, lateral=np.inf, braking=1.0)
    return path._replace(gates=() if crosswalk is None else (crosswalk,))
