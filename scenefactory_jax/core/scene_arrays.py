"""The tracks or the polylines of a scene as arrays over all of them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import Polyline, Track

FULL_TURN = 2 * np.pi + 0.01  # largest angle in radians; rounding to a few digits may exceed the turn itself


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


def stack_tracks(tracks: Sequence[Track], steps: int) -> Logs:
    """Stacks the tracks of one log."""
    rows = {name: [getattr(track, name) for track in tracks] for name in Logs._fields}
    tails = {"xyz": (steps, 3), "yaw": (steps,), "velocity": (steps, 2), "valid": (steps,), "size": (3,)}
    types = {name: bool if name == "valid" else np.float64 for name in tails}
    return Logs(**{name: np.array(rows[name], types[name]).reshape(len(tracks), *tail) for name, tail in tails.items()})


def grid(times: Float[np.ndarray, " L"], current: int, *, step_s: float, near: float) -> tuple[Float[np.ndarray, " K"], int]:
    """Computes times at even steps within a log, one of which is the current step's; and the index of that one.

    Args:
        near: fraction of a step by which the grid may reach beyond the log's ends, where it is cut.
    """
    before = int(np.floor((times[current] - times[0]) / step_s + near))
    after = int(np.floor((times[-1] - times[current]) / step_s + near))
    return np.clip(times[current] + step_s * np.arange(-before, after + 1), times[0], times[-1]), before


def sample_tracks(logs: Logs, times: Float[np.ndarray, " L"], samples: Float[np.ndarray, " K"], *, near: float) -> Logs:
    """Interpolates tracks linearly between steps; valid where the steps on both sides are, zeros elsewhere.

    Args:
        times: of the logs' two steps or more, ascending.
        samples: times within these.
        near: fraction of a step; at a time so near to a step that step alone counts.
    """
    before = np.clip(np.searchsorted(times, samples, side="right") - 1, 0, len(times) - 2)
    fraction = (samples - times[before]) / (times[before + 1] - times[before])
    fraction = np.where(fraction <= near, 0.0, np.where(fraction >= 1 - near, 1.0, fraction))
    valid = (logs.valid[:, before] | (fraction == 1)) & (logs.valid[:, before + 1] | (fraction == 0))

    def between(table: Float[np.ndarray, "T L D"], turn: bool = False) -> Float[np.ndarray, "T K D"]:
        known = np.where(logs.valid[..., None], table, 0.0)
        step = known[:, before + 1] - known[:, before]
        return np.where(valid[..., None], known[:, before] + fraction[:, None] * (wrap_angles(step) if turn else step), 0.0)

    yaw = between(logs.yaw[..., None], turn=True)[..., 0]
    return Logs(between(logs.xyz), yaw, between(logs.velocity), valid, logs.size)


def join_lines(lines: Sequence[Polyline]) -> Points:
    """Joins the points of polylines."""
    return join_points([line.xyz for line in lines])


def join_points(xyz: Sequence[Float[np.ndarray, "_ 3"]]) -> Points:
    """Joins the points of lines."""
    return Points(np.concatenate([*xyz, np.zeros((0, 3))]), np.cumsum([0, *map(len, xyz)]))


def wrap_angles(angle: Any) -> Any:
    """Wraps an angle or angles to [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def segment_lengths(delta: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N"]:
    """Computes lengths of planar vectors: the bits of `np.linalg.norm`, in less time."""
    return np.sqrt(delta[..., 0] * delta[..., 0] + delta[..., 1] * delta[..., 1])
