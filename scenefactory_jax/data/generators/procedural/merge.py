"""A ramp that merges from the right into the outermost lane of a main road."""

import numpy as np

from scenefactory_jax.data.generators.curves import FINE_M, cut, easing_bend, integrate, tangents
from scenefactory_jax.data.generators.procedural.road_layout import Lane, Layout, Style, carriageway, check_positive, count_lanes, draw


def merge(
    rng: np.random.Generator,
    style: Style,
    *,
    length_m: list[float],
    bend_radius_m: float,
    merge_share: list[float],
    ramp_length_m: list[float],
    ramp_radius_m: list[float],
    ramp_turn_deg: list[float],
    easing_m: float,
) -> Layout:
    """A main road, slightly bent, with oncoming lanes or without, and a ramp that joins it at `merge_share` of its length."""
    check_positive(bend_radius_m, "merge.bend_radius_m")
    length = draw(rng, length_m, "merge.length_m", low=1.0)
    bend = rng.uniform(-1, 1) / bend_radius_m
    count = round(length / FINE_M)
    oncoming = int(rng.integers(0, style.lanes[1] + 1))
    way = carriageway(integrate(np.zeros(2), 0.0, np.full(count, bend), length / count), count_lanes(rng, style), oncoming, style)

    before, after = cut(way.forward[-1], length * draw(rng, merge_share, "merge.merge_share"))
    # the ramp is laid backwards from the point where it ends, on top of the main road's own curvature, which changes sign that way
    radius = draw(rng, ramp_radius_m, "merge.ramp_radius_m", low=1.0)
    turn = np.radians(draw(rng, ramp_turn_deg, "merge.ramp_turn_deg"))
    ramp_bends, ramp_step = easing_bend(draw(rng, ramp_length_m, "merge.ramp_length_m", low=1.0), turn, radius, easing_m, lead=0.0)
    ramp, _ = integrate(after[0], float(tangents(after)[0]) + np.pi, ramp_bends - bend, ramp_step)

    others = way.forward[:-1] + way.backward
    lanes = [
        Lane(before, style.width, style.limit, (1,)),
        Lane(after, style.width, style.limit),
        Lane(ramp[::-1], style.width, style.limit, (1,)),
        *(Lane(points, style.width, style.limit) for points in others),
    ]
    return Layout(lanes, way.lines)
