"""Reference lines of OpenDRIVE roads from lines of points: straight pieces, and cubic curves with `paramPoly3`."""

import numpy as np
from jaxtyping import Float

from scenefactory_jax.data.formats.opendrive_curves import NODES, WEIGHTS

Line = Float[np.ndarray, "_ 2"]
STRAIGHT_M, NEAR_M = 2e-3, 5e-3  # of the points from a straight piece, and from a curve


def tangents(line: Line) -> Line:
    """Unit directions at the points of a line, from parabolas through three of them."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    along = np.gradient(line, arc, axis=0, edge_order=2 if len(line) > 2 else 1)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def fit(line: Line) -> tuple[np.ndarray, float, str]:
    """Fits curves through points, as long ones as keep near them.

    Returns:
        s of the points, the length, and the geometries as XML.
    """
    along, s, geometries = tangents(line), np.zeros(len(line)), []
    pieces = [(0, len(line) - 1)]
    while pieces:
        first, last = pieces.pop()
        part = line[first : last + 1]
        chord = np.linalg.norm(part[-1] - part[0])
        direction = (part[-1] - part[0]) / max(chord, 1e-12)
        aside = np.abs((part - part[0]) @ np.array([-direction[1], direction[0]])).max()
        ends = along[[first, last]] @ direction
        straight = aside <= STRAIGHT_M and ends.min() > 1 - 1e-6
        controls = _control(part, along[first], along[last])
        u = _locate(controls, part)
        if not straight and last - first > 1 and np.linalg.norm(_evaluate(controls, u) - part, axis=1).max() > NEAR_M:
            middle = (first + last) // 2
            pieces += [(middle, last), (first, middle)]
            continue
        start, heading = s[first], float(np.arctan2(*(direction if straight else along[first])[::-1]))
        if straight:
            length, shape, places = chord, "<line/>", (part - part[0]) @ direction
        else:
            length, places = _measure(controls, 1.0), np.array([_measure(controls, end) for end in u])
            shape = _write(controls, heading)
        s[first : last + 1] = start + places
        head = f's="{start:.12g}" x="{part[0, 0]:.12g}" y="{part[0, 1]:.12g}" hdg="{heading:.12g}" length="{length:.12g}"'
        geometries.append(f"<geometry {head}>{shape}</geometry>")
        s[last] = start + length
    return s, float(s[-1]), "".join(geometries)


def _control(part: Line, start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "4 2"]:
    """The coefficients of the cubic curve over [0, 1] between the ends of a line, along both directions."""
    length = np.linalg.norm(np.diff(part, axis=0), axis=1).sum()
    a, b = part[0], length * start
    gap, slope = part[-1] - a, length * end
    return np.stack([a, b, 3 * gap - 2 * b - slope, b + slope - 2 * gap])


def _evaluate(controls: Float[np.ndarray, "4 2"], u: np.ndarray) -> Line:
    return np.stack([u**0, u, u**2, u**3], axis=1) @ controls


def _locate(controls: Float[np.ndarray, "4 2"], part: Line) -> np.ndarray:
    """The parameters of the places on a curve nearest to points, by Newton's method from their fractions of the length."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(part, axis=0), axis=1))])
    u = arc / arc[-1]
    for _ in range(3):
        slope = np.stack([0 * u, u**0, 2 * u, 3 * u**2], axis=1) @ controls
        step = np.sum((part - _evaluate(controls, u)) * slope, axis=1) / np.maximum(np.sum(slope * slope, axis=1), 1e-12)
        u = np.clip(u + step, 0.0, 1.0)
    u[[0, -1]] = 0.0, 1.0
    return u


def _measure(controls: Float[np.ndarray, "4 2"], end: float, pieces: int = 8) -> float:
    """The length of a curve up to a parameter, by Gauss and Legendre's rule."""
    half = end / pieces / 2
    u = (2 * half * np.arange(pieces)[:, None] + half * (1 + NODES)).ravel()
    slope = np.stack([0 * u, u**0, 2 * u, 3 * u**2], axis=1) @ controls
    return float(half * np.linalg.norm(slope, axis=1) @ np.tile(WEIGHTS, pieces))


def _write(controls: Float[np.ndarray, "4 2"], heading: float) -> str:
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    local = np.concatenate([np.zeros((1, 2)), controls[1:] @ turn])
    names = " ".join(f'{name}{axis}="{local[row, column]:.12g}"' for column, axis in enumerate("UV") for row, name in enumerate("abcd"))
    return f'<paramPoly3 pRange="normalized" {names}/>'
