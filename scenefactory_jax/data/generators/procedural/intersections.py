"""Blocks where roads cross: T and 4-way intersections. Every movement between two arms but the U-turn is a lane of its own."""

from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import FINE_M, connect, curvature, heading, integrate, wrap_angle
from scenefactory_jax.data.generators.procedural.road_layout import (
    Lane,
    Layout,
    Line,
    Style,
    carriageway,
    check_positive,
    count_lanes,
    draw,
)

STRAIGHT_ON = np.radians(45.0)  # a movement that turns by less goes straight on
GROWTHS = 20  # steps at most
GROW_M = 1.0  # step by which an intersection grows until its sharpest turn can be driven


class Arm(NamedTuple):
    """A road that ends at a junction; lane points, innermost first."""

    yaw: float  # away from the junction
    incoming: list[np.ndarray]
    outgoing: list[np.ndarray]
    lines: list[Line]


class Movement(NamedTuple):
    """A way through a junction: from an incoming lane of one arm to an outgoing lane of another."""

    source: tuple[int, int]  # arm, lane
    target: tuple[int, int]


def t_intersection(
    rng: np.random.Generator,
    style: Style,
    *,
    arm_length_m: list[float],
    bend_radius_m: float,
    skew_deg: float,
    corner_radius_m: list[float],
    turn_radius_m: float,
) -> Layout:
    """A through road and one that ends at it, right angles skewed by up to `skew_deg`."""
    skew = np.radians(rng.uniform(-skew_deg, skew_deg, 2))
    yaws = [0.0, np.pi / 2 + skew[0], np.pi + skew[1]]
    ahead, back, into, out = (count_lanes(rng, style) for _ in range(4))
    counts = [(back, ahead), (into, out), (ahead, back)]  # incoming, outgoing
    check_positive(bend_radius_m, "t_intersection.bend_radius_m")
    corner = draw(rng, corner_radius_m, "t_intersection.corner_radius_m")
    lengths = [draw(rng, arm_length_m, "t_intersection.arm_length_m", low=1.0) for _ in yaws]
    return _junction(rng, style, yaws, counts, lengths, corner=corner, turn_radius=turn_radius_m, bend_radius=bend_radius_m)


def intersection(
    rng: np.random.Generator,
    style: Style,
    *,
    arm_length_m: list[float],
    bend_radius_m: float,
    skew_deg: float,
    corner_radius_m: list[float],
    turn_radius_m: float,
) -> Layout:
    """Two crossing roads, right angles skewed by up to `skew_deg`."""
    skew = np.radians(rng.uniform(-skew_deg, skew_deg, 3))
    yaws = [0.0, np.pi / 2 + skew[0], np.pi + skew[1], 3 * np.pi / 2 + skew[2]]
    ahead, back, across, counter = (count_lanes(rng, style) for _ in range(4))
    counts = [(back, ahead), (across, counter), (ahead, back), (counter, across)]
    check_positive(bend_radius_m, "intersection.bend_radius_m")
    corner = draw(rng, corner_radius_m, "intersection.corner_radius_m")
    lengths = [draw(rng, arm_length_m, "intersection.arm_length_m", low=1.0) for _ in yaws]
    return _junction(rng, style, yaws, counts, lengths, corner=corner, turn_radius=turn_radius_m, bend_radius=bend_radius_m)


def build_arm(yaw: float, mouth: float, length: float, bend: float, incoming: int, outgoing: int, style: Style) -> Arm:
    """A road that leaves a junction at `mouth` metres from its centre along `yaw`, its curvature growing from 0 to `bend` 1/m."""
    count = max(4, round(length / FINE_M))
    bends = bend * (np.arange(count) + 0.5) / count
    way = carriageway(integrate(mouth * heading(yaw), yaw, bends, length / count), outgoing, incoming, style)
    return Arm(yaw, way.backward, way.forward, way.lines)


def _junction(
    rng: np.random.Generator,
    style: Style,
    yaws: list[float],
    counts: list[tuple[int, int]],
    lengths: list[float],
    *,
    corner: float,
    turn_radius: float,
    bend_radius: float,
) -> Layout:
    """Arms around a centre, set back until no connecting lane turns sharper than `turn_radius`.

    Raises:
        ConfigError: no set-back is large enough.
    """
    bends = rng.uniform(-1.0, 1.0, len(yaws)) / bend_radius
    mouth = _setback(yaws, counts, style, corner=corner)
    for _ in range(GROWTHS):
        arms = [
            build_arm(yaw, mouth, length, bend, *count, style)
            for yaw, length, bend, count in zip(yaws, lengths, bends, counts, strict=True)
        ]
        movements = find_movements(arms)
        paths = [_path(arms, movement) for movement in movements]
        if max(np.abs(curvature(path)).max() for path in paths) <= 1 / turn_radius:
            return assemble(arms, movements, paths, style)
        mouth += GROW_M
    raise ConfigError(f"turn_radius_m: {turn_radius:g} m does not fit this junction; ask for less, or for less skew_deg")


def _setback(yaws: list[float], counts: list[tuple[int, int]], style: Style, *, corner: float) -> float:
    """Distance from the centre at which no two arms overlap and a corner of the given radius fits between any two."""
    furthest = 0.0
    for i, (yaw, count) in enumerate(zip(yaws, counts, strict=True)):
        j = (i + 1) % len(yaws)
        between = np.mod(yaws[j] - yaw, 2 * np.pi)
        own, other = count[0] * style.width, counts[j][1] * style.width  # incoming lanes lie on the arm's left, outgoing on its right
        if between < np.radians(150):
            reach = max(other + own * np.cos(between), own + other * np.cos(between)) / np.sin(between)
            furthest = max(furthest, reach + corner / np.tan(between / 2))
    return furthest


def find_movements(arms: list[Arm]) -> list[Movement]:
    """Left turns from the innermost lane to the innermost, right turns from the outermost to the outermost, straight on lane by lane.

    A lane that would lead nowhere, or that nothing would lead into, is joined to the straightest neighbour's outermost lane.
    """
    movements = []
    for a, arm in enumerate(arms):
        for b, other in enumerate(arms):
            if a == b:
                continue
            turn = wrap_angle(other.yaw - arm.yaw - np.pi)
            if abs(turn) < STRAIGHT_ON:
                pairs = [(lane, lane) for lane in range(min(len(arm.incoming), len(other.outgoing)))]
            else:
                pairs = [(0, 0)] if turn > 0 else [(len(arm.incoming) - 1, len(other.outgoing) - 1)]
            movements += [Movement((a, i), (b, j)) for i, j in pairs]
    for a, arm in enumerate(arms):
        b = min((b for b in range(len(arms)) if b != a), key=lambda b: abs(wrap_angle(arms[b].yaw - arm.yaw - np.pi)))
        leads, led = {m.source for m in movements}, {m.target for m in movements}
        movements += [Movement((a, i), (b, len(arms[b].outgoing) - 1)) for i in range(len(arm.incoming)) if (a, i) not in leads]
        movements += [Movement((b, len(arms[b].incoming) - 1), (a, j)) for j in range(len(arm.outgoing)) if (a, j) not in led]
    return movements


def _path(arms: list[Arm], movement: Movement) -> np.ndarray:
    """Centre line of a connecting lane."""
    source, target = arms[movement.source[0]], arms[movement.target[0]]
    start, end = source.incoming[movement.source[1]], target.outgoing[movement.target[1]]
    return connect(start[-1], source.yaw + np.pi, end[0], target.yaw)


def assemble(arms: list[Arm], movements: list[Movement], paths: list[np.ndarray], style: Style) -> Layout:
    """Number the lanes: arm by arm incoming then outgoing, then one for every movement."""
    ids: dict[tuple[str, tuple[int, int]], int] = {}
    points = []
    for a, arm in enumerate(arms):
        for side, group in (("in", arm.incoming), ("out", arm.outgoing)):
            for i, lane in enumerate(group):
                ids[side, (a, i)] = len(points)
                points.append(lane)
    exits: list[list[int]] = [[] for _ in range(len(points) + len(movements))]
    for index, movement in enumerate(movements, start=len(points)):
        exits[ids["in", movement.source]].append(index)
        exits[index].append(ids["out", movement.target])
    lanes = [Lane(p, style.width, style.limit, tuple(e)) for p, e in zip(points + paths, exits, strict=True)]
    return Layout(lanes, [line for arm in arms for line in arm.lines])
