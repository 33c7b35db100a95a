"""Lanes and road edges of maps of lanelets, which have a left and a right border: CommonRoad and Lanelet2."""

import dataclasses
import re
from collections.abc import Container, Mapping, Sequence

import numpy as np

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.core.types import EDGE_BOUNDARY
from scenefactory_jax.data.formats import drivable_outline, line_loops, polylines
from scenefactory_jax.data.formats.argoverse2_map import centre
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers, Points
from scenefactory_jax.data.formats.scene_parts import SPEED_UNITS

SPEED = re.compile(r"(?:de274-)?(\d+(?:\.\d*)?)\s*(mph|km/h|kmh|kph|m/s|mps)?", re.IGNORECASE)  # 50, 30 mph, and de274-60 of Germany


@dataclasses.dataclass(frozen=True, eq=False)
class Lanelet:
    """A lanelet in driving direction."""

    id: int
    kind: int | None  # map element of its lane; None: paved, but no lane
    left: Points
    right: Points
    entry: tuple[int, ...] = ()
    exit: tuple[int, ...] = ()
    beside_left: tuple[int, ...] = ()  # into which a car may change
    beside_right: tuple[int, ...] = ()
    limit: float | None = None  # m/s
    marks: tuple[tuple[int, Points], ...] = ()  # painted lines: kind, points


def make_roads(
    lanelets: Sequence[Lanelet],
    features: Sequence[tuple[int, Points]],
    spacing_m: float,
    outline: OutlineNumbers,
    where: str,
    unbounded: Sequence[Points] = (),
) -> tuple[Polyline, ...]:
    """Lanes, which keep their ids, then painted lines (each once), edges, and other features: (kind, points).

    Args:
        spacing_m: maximum between the points of lanes and lines.
        unbounded: borders beside which the road goes on.
    """
    lanelets = [dataclasses.replace(lanelet, left=_run_ahead(lanelet.left), right=_run_ahead(lanelet.right)) for lanelet in lanelets]
    lanes = {lanelet.id: lanelet for lanelet in lanelets if lanelet.kind is not None}
    centres = {number: centre(lanelet.left, lanelet.right, spacing_m) for number, lanelet in lanes.items()}
    areas = [np.concatenate([lanelet.left, lanelet.right[::-1]]) for lanelet in lanelets]
    marks: dict[tuple[tuple[float, ...], ...], tuple[int, Points]] = {}
    for kind, points in (mark for lanelet in lanelets for mark in lanelet.marks):
        rows = tuple(map(tuple, points.tolist()))
        marks.setdefault(min(rows, rows[::-1]), (kind, polylines.densify(points, spacing_m)))
    edges = drivable_outline.find_edges(areas, [*centres.values(), *unbounded], outline, where, spacing_m=spacing_m)
    keep = lambda ids: tuple(dict.fromkeys(number for number in ids if number in lanes))  # noqa: E731
    roads = [
        Polyline(
            kind=lanelet.kind or 0,
            xyz=centres[number],
            id=number,
            entry=keep(lanelet.entry),
            exit=keep(lanelet.exit),
            left=keep(lanelet.beside_left),
            right=keep(lanelet.beside_right),
            speed_limit=lanelet.limit,
        )
        for number, lanelet in lanes.items()
    ]
    start = max(lanes, default=0) + 1
    others = [*marks.values(), *((EDGE_BOUNDARY, xyz) for xyz in edges), *features]
    return (*roads, *(Polyline(kind, xyz, start + place) for place, (kind, xyz) in enumerate(others)))


def _run_ahead(border: Points) -> Points:
    """A border without the parts that run back."""
    return line_loops.remove_loops(border, line_loops.find_reversals(border))


def parse_speed(text: str, usual: str | None) -> float | None:
    """A speed above 0 in m/s, in the unit `usual` where the text names none; None for other texts."""
    match = SPEED.fullmatch(text.strip())
    unit = usual if match is None or match[2] is None else match[2].lower()
    value = 0.0 if match is None or unit is None else float(match[1]) * SPEED_UNITS[unit]
    return value if value > 0 else None


def find_junction_lanes(lanelets: Mapping[int, Lanelet], start: int, inside: Container[int]) -> list[int]:
    """The lanes that a light or sign at the end of lanelet `start` governs: those of the junction behind it, or itself if there is none."""
    if start in inside:
        return [start]
    following = [number for number in lanelets[start].exit if number in lanelets]
    return [number for number in following if number in inside] or (following if len(following) > 1 else [start])
