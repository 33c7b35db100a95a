"""Ways through a network: along connected lanes, from lane to lane, over crosswalks and along pavements."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.generators.curves import Points, arc_length
from scenefactory_jax.data.generators.ranges import draw
from scenefactory_jax.data.generators.town.road_network import CHANGING, WALKING, Network

STEP_M = 0.5  # between the points of a path
SMOOTH = 5  # points over which curvature is averaged


class Path(NamedTuple):
    """The way of one road user, its points STEP_M apart."""

    points: Float[np.ndarray, "N 2"]
    yaw: Float[np.ndarray, " N"]
    cap: Float[np.ndarray, " N"]  # speed, m/s
    rank: Float[np.ndarray, " N"]  # right of way
    gates: tuple[tuple[float, int], ...]  # (place, gate) where it may have to wait
    lanes: tuple[int, ...]

    @property
    def length(self) -> float:
        """Metres."""
        return (len(self.points) - 1) * STEP_M


class PathPiece(NamedTuple):
    """Part of a way, with one limit and one right of way."""

    points: Points
    limit: float
    rank: int
    gate: int | None
    lane: int


def make_path(pieces: list[PathPiece], *, eager: float, lateral: float, braking: float) -> Path:
    """Pieces that follow one another as one path, with a speed for every bend that is braked for in time.

    Args:
        eager: share of the limits that this driver goes.
        lateral, braking: most that he allows himself, m/s^2.
    """
    points = np.concatenate([pieces[0].points, *(piece.points[1:] for piece in pieces[1:])])
    lengths = np.array([arc_length(piece.points)[-1] for piece in pieces])
    ends = np.cumsum(lengths)
    place = arc_length(points)
    at = np.arange(int(place[-1] / STEP_M) + 1) * STEP_M
    points = np.stack([np.interp(at, place, points[:, 0]), np.interp(at, place, points[:, 1])], axis=-1)
    step = np.diff(points, axis=0)
    headings = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    yaw = np.interp(np.arange(len(points)), np.arange(len(headings)) + 0.5, headings)
    bend = np.abs(np.convolve(np.pad(np.gradient(yaw, STEP_M), SMOOTH // 2, mode="edge"), np.ones(SMOOTH) / SMOOTH, mode="valid"))
    owner = np.minimum(np.searchsorted(ends, at, side="right"), len(pieces) - 1)
    limit = eager * np.array([piece.limit for piece in pieces])[owner]
    squared = np.minimum(limit**2, lateral / np.maximum(bend, 1e-4))
    shed = 2 * braking * at
    cap = np.sqrt(np.minimum.accumulate((squared + shed)[::-1])[::-1] - shed)
    rank = np.array([piece.rank for piece in pieces], float)[owner]
    starts = zip((ends - lengths).tolist(), pieces, strict=True)
    gates = tuple((start, piece.gate) for start, piece in starts if piece.gate is not None)
    return Path(points, yaw, cap, rank, gates, tuple(piece.lane for piece in pieces))


def draw_path(
    rng: np.random.Generator, network: Network, lane: int, begin: float, length: float, *, change_share: float, change_m: list[float]
) -> list[PathPiece]:
    """A random way from a place on a lane: which exit at every fork, and now and then another lane.

    Args:
        change_share: how likely a car changes lanes on a lane that is long enough.
        change_m: shortest and longest way over which it does.
    """
    pieces: list[PathPiece] = []
    left = length
    control: int | None = None
    while True:
        own = network.lanes[lane]
        place = arc_length(own.points)
        beside = [*network.left[lane], *network.right[lane]]
        room = float(place[-1]) - begin - 4.0
        if beside and room > change_m[0] and rng.random() < change_share:
            target = int(rng.choice(beside))
            over = min(draw(rng, change_m, "traffic.change_m"), room)
            start = begin + float(rng.uniform(0.0, room - over))
            found, begin = _change(network, lane, target, begin, start, start + over, control)
            pieces += found
            left -= start + over - (place[-1] - room - 4.0)
            lane, control = target, None
            own, place = network.lanes[lane], arc_length(network.lanes[lane].points)
        if not pieces or place[-1] - begin > STEP_M / 10:
            pieces.append(PathPiece(_part(own.points, place, begin, float(place[-1])), own.limit, own.rank, control, lane))
        left -= float(place[-1]) - begin
        if left <= 0 or not network.exits[lane]:
            return pieces
        lane, begin = int(rng.choice(network.exits[lane])), 0.0
        control = network.lanes[lane].control


def _change(
    network: Network, lane: int, target: int, begin: float, start: float, end: float, control: int | None
) -> tuple[list[PathPiece], float]:
    """The way to `start` on a lane and from there over to its neighbour; and the place on it where the way arrives."""
    own, other = network.lanes[lane], network.lanes[target]
    place, beside = arc_length(own.points), arc_length(other.points)
    scale = float(beside[-1] / place[-1])
    at = np.linspace(start, end, max(8, int((end - start) / STEP_M)))
    share = (at - start) / (end - start)
    share = (share * share * (3 - 2 * share))[:, None]
    mine = np.stack([np.interp(at, place, own.points[:, i]) for i in (0, 1)], axis=-1)
    theirs = np.stack([np.interp(at * scale, beside, other.points[:, i]) for i in (0, 1)], axis=-1)
    over = PathPiece((1 - share) * mine + share * theirs, own.limit, CHANGING, None, lane)
    if start - begin < STEP_M:
        return [over._replace(gate=control)], end * scale
    return [PathPiece(_part(own.points, place, begin, start), own.limit, own.rank, control, lane), over], end * scale


def _part(points: Points, place: Float[np.ndarray, " N"], begin: float, end: float) -> Points:
    """A polyline between two places along it."""
    inside = (place > begin + 1e-6) & (place < end - 1e-6)
    ends = np.stack([np.interp([begin, end], place, points[:, i]) for i in (0, 1)], axis=-1)
    return np.concatenate([ends[:1], points[inside], ends[1:]])


def change_to_right(points: Points) -> Points:
    """Unit vectors to the right of a polyline at its points."""
    step = np.gradient(points, axis=0)
    return np.stack([step[:, 1], -step[:, 0]], axis=-1) / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)


def offset_path(pieces: list[PathPiece], right: float) -> list[PathPiece]:
    """The same way at a distance to its right, for those who keep to the side."""
    whole = np.concatenate([pieces[0].points, *(piece.points[1:] for piece in pieces[1:])])
    moved = whole + right * change_to_right(whole)
    found, at = [], 0
    for piece in pieces:
        found.append(piece._replace(points=moved[at : at + len(piece.points)]))
        at += len(piece.points) - 1
    return found


def walk(points: Points, speed: float, *, crosswalk: tuple[float, int] | None) -> Path:
    """A way on foot, with the place and the gate of a crosswalk on it."""
    path = make_path([PathPiece(points, speed, WALKING, None, -1)], eager=1.0, lateral=np.inf, braking=1.0)
    return path._replace(gates=() if crosswalk is None else (crosswalk,))
