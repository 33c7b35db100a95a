"""The tracks or the polylines of a scene as arrays over all of them: what is done to each is then done to all at once."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.scenes.raw import Polyline, Track

FULL_TURN = 2 * np.pi + 0.01  # more is no angle in radians; rounding to a few digits may exceed the turn itself


class Logs(NamedTuple):
    """Tracks that all have the steps of the log."""

    xyz: Float[np.ndarray, "T L 3"]
    yaw: Float[np.ndarray, "T L"]
    velocity: Float[np.ndarray, "T L 2"]
    valid: Bool[np.ndarray, "T L"]
    size: Float[np.ndarray, "T 3"]


class Points(NamedTuple):
    """Polylines end to end: the points of number i are `xyz[bounds[i] : bounds[i + 1]]`."""

    xyz: Float[np.ndarray, "N 3"]
    bounds: Int[np.ndarray, " R1"]


def stacked(tracks: Sequence[Track], steps: int) -> Logs:
    """The tracks of one log."""
    rows = {name: [getattr(track, name) for track in tracks] for name in Logs._fields}
    tails = {"xyz": (steps, 3), "yaw": (steps,), "velocity": (steps, 2), "valid": (steps,), "size": (3,)}
    types = {name: bool if name == "valid" else np.float64 for name in tails}
    return Logs(**{name: np.array(rows[name], types[name]).reshape(len(tracks), *tail) for name, tail in tails.items()})


def joined(lines: Sequence[Polyline]) -> Points:
    """The points of polylines, and where each begins."""
    xyz = [line.xyz for line in lines]
    bounds = np.cumsum([0, *map(len, xyz)])
    return Points(np.concatenate(xyz) if xyz else np.zeros((0, 3)), bounds)


def wrapped(angle: Any) -> Any:
    """The same angles, or angle, in [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def lengths(delta: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N"]:
    """Of vectors in the plane: the bits of `np.linalg.norm`, without its detours."""
    return np.sqrt(delta[..., 0] * delta[..., 0] + delta[..., 1] * delta[..., 1])
