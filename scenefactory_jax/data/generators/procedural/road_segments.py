"""Blocks without a junction: a straight road and a bend."""

import numpy as np

from scenefactory_jax.data.generators.curves import easing_bend, integrate
from scenefactory_jax.data.generators.procedural.road_layout import Lane, Layout, Style, carriageway, count_lanes, draw


def straight(rng: np.random.Generator, style: Style, *, length_m: list[float]) -> Layout:
    """A straight two-way road."""
    length = draw(rng, length_m, "straight.length_m", low=1.0)
    return _road(rng, style, length=length, turn=0.0, radius=1.0, easing=0.0)


def curve(
    rng: np.random.Generator,
    style: Style,
    *,
    length_m: list[float],
    radius_m: list[float],
    turn_deg: list[float],
    easing_m: float,
    lead_m: float,
) -> Layout:
    """A two-way road that bends to the left or to the right: clothoid, arc, clothoid, at least `lead` of straight road at both ends.

    The turn is cut where the road is too short for it. The radius is the centre line's.
    """
    length = draw(rng, length_m, "curve.length_m", low=1.0)
    radius = draw(rng, radius_m, "curve.radius_m", low=(style.lanes[1] + 1) * style.width)
    turn = np.radians(draw(rng, turn_deg, "curve.turn_deg"))
    turn = min(turn, max(0.0, length - 2 * lead_m - easing_m) / radius) * rng.choice([-1.0, 1.0])
    return _road(rng, style, length=length, turn=turn, radius=radius, easing=easing_m)


def _road(rng: np.random.Generator, style: Style, *, length: float, turn: float, radius: float, easing: float) -> Layout:
    """A road whose bend lies in its middle."""
    easing = min(easing, abs(turn) * radius)
    bends, step = easing_bend(length, turn, radius, easing, lead=(length - abs(turn) * radius - easing) / 2)
    way = carriageway(integrate(np.zeros(2), 0.0, bends, step), count_lanes(rng, style), count_lanes(rng, style), style)
    return Layout([Lane(points, style.width, style.limit) for points in way.forward + way.backward], way.lines)
