"""What a block builds: lanes that lead into one another and painted lines, before edges and traffic."""

from typing import NamedTuple

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import Curve, Points, heading, offset

BROKEN_WHITE, SOLID_YELLOW, DOUBLE_YELLOW = 6, 11, 12  # WOMD map element ids


class Style(NamedTuple):
    """What all roads of one scene share."""

    width: float  # of a lane, m
    limit: float  # m/s
    lanes: tuple[int, int]  # fewest and most lanes a direction
    centre_line: int  # kind of the line between the directions


class Lane(NamedTuple):
    """Centre line of a lane in driving direction; its id is its place in the layout."""

    points: Points
    width: float
    limit: float
    exits: tuple[int, ...] = ()


class Line(NamedTuple):
    """A painted line."""

    kind: int
    points: Points


class Layout(NamedTuple):
    """Lanes and lines of one scene, in metres around the block's own origin. A lane without entries or exits ends at an open road end."""

    lanes: list[Lane]
    lines: list[Line]


class Carriageway(NamedTuple):
    """Lane centre lines on both sides of a reference curve, innermost first, each in its driving direction."""

    forward: list[Points]
    backward: list[Points]
    lines: list[Line]


def carriageway(curve: Curve, forward: int, backward: int, style: Style) -> Carriageway:
    """A road along a curve: `forward` lanes on its right, `backward` lanes on its left (right-hand traffic), lines between them."""
    width = style.width
    ahead = [offset(curve, -(i + 0.5) * width) for i in range(forward)]
    behind = [offset(curve, (i + 0.5) * width)[::-1] for i in range(backward)]
    lines = [Line(style.centre_line, curve[0])] if forward and backward else []
    lines += [Line(BROKEN_WHITE, offset(curve, -i * width)) for i in range(1, forward)]
    lines += [Line(BROKEN_WHITE, offset(curve, i * width)[::-1]) for i in range(1, backward)]
    return Carriageway(ahead, behind, lines)


def turned(layout: Layout, angle: float) -> Layout:
    """The layout turned about its origin."""
    ahead, left = heading(angle), heading(angle + np.pi / 2)
    matrix = np.stack([ahead, left])
    lanes = [lane._replace(points=lane.points @ matrix) for lane in layout.lanes]
    return Layout(lanes, [line._replace(points=line.points @ matrix) for line in layout.lines])


def entries(lanes: list[Lane]) -> list[tuple[int, ...]]:
    """The lanes that lead into each lane."""
    return [tuple(i for i, lane in enumerate(lanes) if own in lane.exits) for own in range(len(lanes))]


def count_lanes(rng: np.random.Generator, style: Style) -> int:
    """A number of lanes for one direction of one road."""
    return int(rng.integers(style.lanes[0], style.lanes[1] + 1))


def draw(rng: np.random.Generator, span: list[float], name: str, *, low: float = 0.0) -> float:
    """A number from a range of the config.

    Raises:
        ConfigError: the range is not two numbers in ascending order, or begins below `low`.
    """
    check_range(span, name, low=low)
    return float(rng.uniform(span[0], span[1]))


def check_range(span: list[float] | list[int], name: str, *, low: float) -> None:
    """Refuse a range that is empty or begins below `low`.

    Raises:
        ConfigError: naming the range and what would be valid.
    """
    if len(span) != 2 or not low <= span[0] <= span[1]:
        raise ConfigError(f"{name}: {list(span)!r} is no range; write [least, most] with {low:g} <= least <= most")


def check_positive(value: float, name: str) -> None:
    """Refuse a number that is not above zero.

    Raises:
        ConfigError: naming the number.
    """
    if not value > 0:
        raise ConfigError(f"{name}: {value!r} must be above 0")
