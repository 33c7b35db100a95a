"""Writes the map of a town as recorders do: long lanes in several pieces, points rounded."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.schema import Bounds, NonNegative
from scenefactory_jax.core.types import DRIVABLE, EDGES, LANE_BIKE, LINES
from scenefactory_jax.data.generators.curves import resample

PositiveRange = Annotated[tuple[float, float], Bounds(above=0, is_range=True)]


@dataclass(frozen=True)
class MapRecording:
    """The key `recording` of `scenes.generate`; traffic and lights are the same with and without it."""

    lane_m: PositiveRange  # of a piece of a lane, drawn evenly in its logarithm
    spacing_m: PositiveRange  # between the points of a lane, a line or an edge, drawn for each
    round_m: NonNegative  # of the coordinates of all points of the map; 0: not rounded


def record_map(raw: RawScene, rng: np.random.Generator, recording: MapRecording) -> RawScene:
    """Cuts the lanes of a scene, spaces points and rounds them; lanes side by side are cut at the same fractions of their lengths."""
    lanes = {road.id: road for road in raw.roads if road.kind in (*DRIVABLE, LANE_BIKE)}
    cuts: dict[int, Float[np.ndarray, " K"]] = {}  # fractions of the length at which a lane begins and ends
    for number in lanes:
        if number not in cuts:
            cuts |= dict.fromkeys(_find_abreast(lanes, number), _draw_cuts(rng, lanes[number].xyz, recording.lane_m))
    first = dict(zip(cuts, np.cumsum([0, *(len(at) - 1 for at in cuts.values())]).tolist(), strict=False))
    last = {number: first[number] + len(at) - 2 for number, at in cuts.items()}
    pieces: list[Polyline] = []
    for number, at in cuts.items():
        lane, count = lanes[number], len(at) - 1
        rows = np.round(at * (len(lane.xyz) - 1)).astype(int)
        for k in range(count):
            here = first[number] + k
            entry = tuple(last[i] for i in lane.entry) if k == 0 else (here - 1,)
            out = tuple(first[i] for i in lane.exit) if k == count - 1 else (here + 1,)
            left, right = (tuple(first[i] + k for i in beside) for beside in (lane.left, lane.right))
            xyz = lane.xyz[rows[k] : rows[k + 1] + 1]
            pieces.append(replace(lane, xyz=xyz, id=here, entry=entry, exit=out, left=left, right=right))
    rest = [road for road in raw.roads if road.id not in lanes]
    rest = [replace(road, id=len(pieces) + i, lanes=tuple(first[lane] for lane in road.lanes)) for i, road in enumerate(rest)]
    lights = tuple(replace(light, lane=first[light.lane]) for light in raw.lights)
    return replace(raw, roads=tuple(_record_points(rng, road, recording) for road in (*pieces, *rest)), lights=lights)


def _record_points(rng: np.random.Generator, road: Polyline, recording: MapRecording) -> Polyline:
    """Spaces the points of a lane, a line or an edge anew, and rounds those of any element, which lies on flat ground."""
    xy, unit = road.xyz[:, :2], recording.round_m
    if road.kind in (*DRIVABLE, LANE_BIKE, *LINES, *EDGES):
        xy = resample(xy, float(rng.uniform(*recording.spacing_m)))
    return replace(road, xyz=np.pad(np.round(xy / unit) * unit if unit else xy, ((0, 0), (0, 1))))


def _find_abreast(lanes: dict[int, Polyline], start: int) -> list[int]:
    """Lists the lanes between which a car can change, by any number of changes, `start` first."""
    found, pending = [], [start]
    while pending:
        number = pending.pop()
        if number not in found:
            found.append(number)
            pending += [*lanes[number].left, *lanes[number].right]
    return found


def _draw_cuts(rng: np.random.Generator, points: Float[np.ndarray, "N 3"], lane_m: tuple[float, float]) -> Float[np.ndarray, " K"]:
    """Draws where a lane is cut; a remainder shorter than the shortest piece stays with the piece before it."""
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    at = [0.0]
    while (step := float(np.exp(rng.uniform(*np.log(lane_m))))) < length - at[-1] - lane_m[0]:
        at.append(at[-1] + step)
    return np.array([*at, length]) / length
