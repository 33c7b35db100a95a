"""The lanes that stop signs govern, inferred from geometry where the source names none, and where cars stop on them.

In the Waymo Open Motion Dataset (WOMD) a sign governs the lanes inside a junction that begin beside it: all lanes from one approach, which
begin at a joint where lanes diverge, or end at one where lanes merge. Lanes that lead out of a junction begin beside signs of other
approaches, too, but where several lanes meet.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Polyline
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import DRIVABLE, STOP_SIGN


def infer_sign_lanes(
    roads: tuple[Polyline, ...],
    *,
    ahead_m: tuple[float, float],
    right_m: tuple[float, float],
    above_m: tuple[float, float],
    joint_m: NonNegative,
    approach_width_m: Positive,
    approach_turn_deg: Positive,
) -> tuple[tuple[Polyline, ...], int]:
    """Names the lanes of stop signs that have none, and returns the roads and the number of signs that got one.

    A lane for cars may belong to a sign if the sign lies in `ahead_m`, `right_m` and `above_m` of the lane's start, if exactly one lane
    ends at its start, and if other lanes begin at its start or end at its end. Of these lanes the one whose start is nearest to the sign
    belongs to it, and so do those that begin near that one in the same direction. The numbers are described in `conf/scenes/base.yaml`.

    Args:
        ahead_m, right_m, above_m: [min, max] of the sign's place seen from the lane's start in the lane's direction there.
        joint_m: ends of lanes that are closer are one place.
        approach_width_m, approach_turn_deg: distance of two starts, and angle between their directions, of lanes from one approach.
    """
    nameless = [place for place, line in enumerate(roads) if line.kind == STOP_SIGN and not line.lanes and len(line.xyz)]
    lanes = [line for line in roads if line.kind in DRIVABLE and len(line.xyz) >= 2]
    if not nameless or not lanes:
        return roads, 0
    start, end = (np.stack([lane.xyz[place] for lane in lanes]) for place in (0, -1))
    along = np.stack([_find_direction(lane.xyz[:, :2], 0) for lane in lanes])
    entering = _find_entering(start, end, joint_m)
    found, named = list(roads), 0
    for place in nameless:
        sign = roads[place].xyz[0]
        apart = sign - start
        ahead = np.sum(apart[:, :2] * along, axis=1)
        right = along[:, 1] * apart[:, 0] - along[:, 0] * apart[:, 1]
        fits = entering & (ahead >= ahead_m[0]) & (ahead <= ahead_m[1]) & (right >= right_m[0]) & (right <= right_m[1])
        rows = np.flatnonzero(fits & (apart[:, 2] >= above_m[0]) & (apart[:, 2] <= above_m[1]))
        if len(rows):
            nearest = rows[np.argmin(np.linalg.norm(apart[rows, :2], axis=1))]
            near = np.linalg.norm(start[rows, :2] - start[nearest, :2], axis=1) <= approach_width_m
            rows = rows[near & (along[rows] @ along[nearest] >= np.cos(np.deg2rad(approach_turn_deg)))]
            found[place] = replace(roads[place], lanes=tuple(lanes[row].id for row in rows))
            named += 1
    return tuple(found), named


def _find_entering(start: Float[np.ndarray, "N 3"], end: Float[np.ndarray, "N 3"], joint_m: float) -> np.ndarray:
    """Mask of the lanes at whose start one lane ends, and at whose start others begin or at whose end others end."""
    starts, ends = KDTree(start), KDTree(end)
    count = lambda tree, points: np.array([len(near) for near in tree.query_ball_point(points, joint_m)])  # noqa: E731
    return (count(ends, start) == 1) & ((count(starts, start) > 1) | (count(ends, end) > 1))


def find_stop_place(
    lane: Float[np.ndarray, "N 2"], sign: Float[np.ndarray, "2"], *, max_turn_deg: Positive
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Finds where cars stop on a lane for a sign beside it, and the lane's direction there.

    It is the lane's point nearest to the sign, among those at which the lane has turned by at most `max_turn_deg` from its direction at
    the end that is nearer to the sign: a lane that turns around the corner with the sign is left at its start.
    """
    steps = np.diff(lane, axis=0)
    length = np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
    direction = steps / length[:, None]
    from_start = bool(np.linalg.norm(sign - lane[0]) <= np.linalg.norm(sign - lane[-1]))
    facing = direction @ direction[0 if from_start else -1]
    straight: Int[np.ndarray, " S"] = np.flatnonzero(facing < np.cos(np.deg2rad(max_turn_deg)))
    rows = slice(0, straight[0] if len(straight) else None) if from_start else slice(straight[-1] + 1 if len(straight) else 0, None)
    begin, along = lane[:-1][rows], steps[rows]
    fraction = np.clip(np.sum((sign - begin) * along, axis=1) / length[rows] ** 2, 0.0, 1.0)
    places = begin + fraction[:, None] * along
    nearest = int(np.argmin(np.linalg.norm(places - sign, axis=1)))
    return places[nearest], direction[rows][nearest]


def _find_direction(line: Float[np.ndarray, "N 2"], segment: int) -> Float[np.ndarray, "2"]:
    """Unit direction of a line's segment; zeros where it has no length."""
    step = line[segment + 1] - line[segment]
    return step / max(float(np.linalg.norm(step)), 1e-9)
