"""The curves of an OpenDRIVE road: its reference line in the plane, and the cubic polynomials along it (ASAM OpenDRIVE 1.8, 8 and 9).

A line, an arc and a spiral have a curvature that is linear in s, and are integrated with the same formula. `poly3` and `paramPoly3` are
curves (u(p), v(p)) in the frame of their first point; a place along them is found by their arc length.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats.xml_content import Element

Column = Float[np.ndarray, " N"]
Frames = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]  # points, and the headings there
COEFFICIENTS = ("a", "b", "c", "d")
MAX_COEFFICIENT = 1e30  # RoadRunner writes pieces of 1e-6 m, whose cubic coefficients reach 1e19
NODES, WEIGHTS = np.polynomial.legendre.leggauss(5)  # of a piece in which the heading turns little
STEP_M = 1.0  # of integration, and of the table of arc lengths
MAX_STEPS = 100_000  # of one geometry
MAX_TURN = 1e3  # rad, of one geometry: longer spirals than any come from a damaged number


@dataclass(frozen=True)
class Profile:
    """A function of s in pieces, each a cubic polynomial of s from its start on; 0 before the first."""

    start: Column
    coefficients: Float[np.ndarray, "N 4"]

    def __call__(self, s: Column) -> Column:
        if not len(self.start):
            return np.zeros(len(s))
        piece = np.searchsorted(self.start, s, side="right") - 1
        along, (a, b, c, d) = s - self.start[piece], self.coefficients[piece].T
        return np.where(piece < 0, 0.0, a + along * (b + along * (c + along * d)))


def read_profile(records: Sequence[Element], key: str = "s", offset: float = 0.0) -> Profile:
    """Reads the pieces of a profile, whose starts `key` gives from `offset` on; of equal starts the last one counts."""
    rows = {record.number(key) + offset: [record.number(c, 0.0, limit=MAX_COEFFICIENT) for c in COEFFICIENTS] for record in records}
    starts = sorted(rows)
    return Profile(np.array(starts, float), np.array([rows[start] for start in starts], float).reshape(-1, 4))


@dataclass(frozen=True)
class ReferenceLine:
    """The reference line of a road in the plane."""

    start: Column  # s of each geometry
    evaluators: tuple[Callable[[Column], Frames], ...]  # of the distances from its start

    def __call__(self, s: Column) -> Frames:
        """Points and headings at ascending s."""
        piece = np.maximum(np.searchsorted(self.start, s, side="right") - 1, 0)
        points, headings = np.zeros((len(s), 2)), np.zeros(len(s))
        for index in np.unique(piece).tolist():
            rows = piece == index
            points[rows], headings[rows] = self.evaluators[index](s[rows] - self.start[index])
        return points, headings


def read_reference_line(plan: Element) -> ReferenceLine:
    """Reads the geometries of a road's `planView`."""
    geometries = sorted(plan.all("geometry"), key=lambda geometry: geometry.number("s"))
    if not geometries:
        raise SceneError(f"{plan.where}: expected <geometry>, got none")
    return ReferenceLine(np.array([geometry.number("s") for geometry in geometries]), tuple(map(_read_geometry, geometries)))


def _read_geometry(geometry: Element) -> Callable[[Column], Frames]:
    """The points and headings of a geometry as a function of the distance from its start."""
    x, y, heading, length = (geometry.number(name) for name in ("x", "y", "hdg", "length"))
    if not 0 <= length <= MAX_STEPS * STEP_M:
        raise SceneError(f"{geometry.where}: length: expected 0 to {MAX_STEPS * STEP_M:g} m, got {length:g}")
    shape = next((child for child in geometry.children if child.tag in SHAPES), None)
    if shape is None:
        raise SceneError(
            f"{geometry.where}: expected one of {', '.join(SHAPES)}, got {', '.join(c.tag for c in geometry.children) or 'none'}"
        )
    local = SHAPES[shape.tag](shape, length)
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])

    def evaluate(distance: Column) -> Frames:
        points, headings = local(distance)
        return points @ turn + np.array([x, y]), headings + heading

    return evaluate


def _curve(start: float, end: float, length: float, where: str) -> Callable[[Column], Frames]:
    """The curve whose curvature goes from `start` to `end` linearly over `length`, along +x from 0."""
    rate = (end - start) / length if length > 0 else 0.0
    if max(abs(start), abs(end)) * length > MAX_TURN:
        raise SceneError(
            f"{where}: expected a curve that turns by up to {MAX_TURN:g} rad, got curvatures {start:g}, {end:g} over {length:g} m"
        )
    turn = lambda s: s * (start + 0.5 * rate * s)  # noqa: E731
    step = min(STEP_M, 0.25 / max(abs(start), abs(end), 1e-9))
    nodes = np.linspace(0.0, length, max(1, int(np.ceil(length / max(step, length / MAX_STEPS, 1e-9)))) + 1)

    def integrate(a: Column, b: Column) -> Float[np.ndarray, "N 2"]:
        """The way between distances, by Gauss and Legendre's rule."""
        half = (b - a) / 2
        headings = turn(a[:, None] + half[:, None] * (1 + NODES))
        return half[:, None] * np.stack([np.cos(headings) @ WEIGHTS, np.sin(headings) @ WEIGHTS], axis=1)

    points = np.concatenate([np.zeros((1, 2)), np.cumsum(integrate(nodes[:-1], nodes[1:]), axis=0)])

    def evaluate(distance: Column) -> Frames:
        node = np.clip(np.searchsorted(nodes, distance, side="right") - 1, 0, len(nodes) - 1)
        return points[node] + integrate(nodes[node], distance), turn(distance)

    return evaluate


def _polynomial(u: Sequence[float], v: Sequence[float], end: float, length: float, where: str) -> Callable[[Column], Frames]:
    """The curve (u(p), v(p)), p from 0 to `end`, by the distance along it; the whole of it counts as `length`."""
    table = np.linspace(0.0, end, min(MAX_STEPS, 64 + int(4 * length / STEP_M)))
    slopes = [np.polynomial.polynomial.polyder(curve) for curve in (u, v)]
    value = np.polynomial.polynomial.polyval
    half = np.diff(table)[:, None] / 2
    inside = table[:-1, None] + half * (1 + NODES)
    arc = np.concatenate([[0.0], np.cumsum((half * np.hypot(*(value(inside, slope) for slope in slopes))) @ WEIGHTS)])
    if not np.isfinite(arc[-1]) or arc[-1] <= 0 < length:
        raise SceneError(f"{where}: expected a curve with a length, got coefficients u {list(u)}, v {list(v)}")
    scale = arc[-1] / length if length > 0 else 1.0

    def evaluate(distance: Column) -> Frames:
        p = np.interp(distance * scale, arc, table)
        return np.stack([value(p, u), value(p, v)], axis=1), np.arctan2(value(p, slopes[1]), value(p, slopes[0]))

    return evaluate


def _read_poly3(shape: Element, length: float) -> Callable[[Column], Frames]:
    """v(u) as a curve with p = u; its arc length at p is not below p, so that the end lies within `length`."""
    v = [shape.number(name) for name in COEFFICIENTS]
    table = np.linspace(0.0, length, 1000)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(table), np.diff(np.polynomial.polynomial.polyval(table, v))))])
    return _polynomial([0.0, 1.0, 0.0, 0.0], v, float(np.interp(length, arc, table)), length, shape.where)


def _read_param_poly3(shape: Element, length: float) -> Callable[[Column], Frames]:
    u, v = ([shape.number(f"{name}{axis}") for name in COEFFICIENTS] for axis in "UV")
    span = shape.get("pRange", "normalized")
    if span not in ("normalized", "arcLength"):
        raise SceneError(f"{shape.where}: pRange: expected normalized or arcLength, got {span[:20]!r}")
    return _polynomial(u, v, 1.0 if span == "normalized" else length, length, shape.where)


SHAPES: dict[str, Callable[[Element, float], Callable[[Column], Frames]]] = {
    "line": lambda shape, length: _curve(0.0, 0.0, length, shape.where),
    "arc": lambda shape, length: _curve(shape.number("curvature"), shape.number("curvature"), length, shape.where),
    "spiral": lambda shape, length: _curve(shape.number("curvStart"), shape.number("curvEnd"), length, shape.where),
    "poly3": _read_poly3,
    "paramPoly3": _read_param_poly3,
}
