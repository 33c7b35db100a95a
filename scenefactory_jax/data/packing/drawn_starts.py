"""Starts and goals of the suites, in place of those of the log: functions that give the agents of a packed scene.

Every track of the log is background traffic then. The suites draw from the scene's own routes, which depend on its name alone, so that the
same scene always gives the same agents.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.core.scene_arrays import Logs, wrap_angles
from scenefactory_jax.core.schema import ConfigError, Fraction, NonNegative, Positive, Range
from scenefactory_jax.core.types import ROAD_USERS, ROUTE_SPACING_M
from scenefactory_jax.roadgraph import route_sets


class Starts(NamedTuple):
    """Agents on drawn routes, a row for each."""

    route: Int[np.ndarray, " K"]  # row of `routes`
    start: Float[np.ndarray, " K"]  # arc length on it
    end: Float[np.ndarray, " K"]
    speed: Float[np.ndarray, " K"]


def route100(
    columns: Mapping[str, np.ndarray],
    *,
    slots: int,
    length_m: Range,
    start_gap_m: NonNegative,
    winding_fraction: Fraction,
    standing_m: NonNegative,
    clearance_m: NonNegative,
) -> Starts:
    """Chooses drawn routes of a length, from rest, with a part or more that turns, starts apart from each other and from road users.

    Routes that a standing vehicle blocks are left out: within the gates of the suite nobody could pass it.

    Args:
        columns: of the scene: its routes, its traffic, and `row`, the row of its log at the start.
        length_m: shortest route, and where longer ones end.
        start_gap_m: between starts; the outlines of road users are half of it away, or more.
        standing_m: a vehicle that moves less in its log stands.
        clearance_m: between the line of a route and the outline of a standing vehicle: half a car and a margin.
        winding_fraction: smallest part of routes that turn by 45 degrees or are 1.15 times longer than their chord.
    """
    rows = np.flatnonzero(columns["routes.drawn"] & (columns["routes.length"] >= length_m[0]))
    length = np.minimum(columns["routes.length"][rows], length_m[1])
    lines = [columns["routes.position"][row, : int(end / ROUTE_SPACING_M) + 1] for row, end in zip(rows, length, strict=True)]
    free = [place for place, line in enumerate(lines) if not _is_blocked(line, columns, standing_m, clearance_m)]
    rows, length, lines = rows[free], length[free], [lines[place] for place in free]
    winding = np.array([route_sets.is_winding(line) for line in lines], bool)
    chosen: list[int] = []
    # winding routes first, and then straight ones as far as the fraction allows
    for place in [*np.flatnonzero(winding).tolist(), *np.flatnonzero(~winding).tolist()]:
        straight = sum(not winding[other] for other in chosen) + (not winding[place])
        enough = straight <= (1 - winding_fraction) * (len(chosen) + 1)
        if len(chosen) < slots and enough and _is_free(lines[place][0], [lines[other][0] for other in chosen], columns, start_gap_m):
            chosen.append(place)
    zero = np.zeros(len(chosen))
    return Starts(rows[chosen], zero, length[chosen], zero)


def _is_free(
    start: Float[np.ndarray, "2"], others: list[Float[np.ndarray, "2"]], columns: Mapping[str, np.ndarray], gap_m: float
) -> bool:
    """Whether a start is far enough from the chosen ones and from the outlines of road users at the current step."""
    if any(np.hypot(*(start - other)) < gap_m for other in others):
        return False
    present = columns["traffic_log.valid"][:, int(columns["row"])]
    return not bool((_measure_distances(start[None], columns, present) < gap_m / 2).any())


def _is_blocked(line: Float[np.ndarray, "N 2"], columns: Mapping[str, np.ndarray], standing_m: float, clearance_m: float) -> bool:
    """Whether a vehicle that stands for the whole log is in the way of a route."""
    row, valid, position = int(columns["row"]), columns["traffic_log.valid"], columns["traffic_log.position"]
    first = position[np.arange(len(valid)), np.argmax(valid, axis=1)]
    moved = np.where(valid, np.hypot(*(position - first[:, None]).transpose(2, 0, 1)), 0.0).max(axis=1, initial=0.0)
    stands = valid[:, row] & (columns["traffic_log.kind"] == ROAD_USERS.index("vehicle")) & (moved < standing_m)
    return bool((_measure_distances(line, columns, stands) < clearance_m).any())


def _measure_distances(points: Float[np.ndarray, "N 2"], columns: Mapping[str, np.ndarray], users: np.ndarray) -> Float[np.ndarray, "N K"]:
    """Distances of points from the outlines of road users at the start; 0 inside."""
    row = int(columns["row"])
    offset = points[:, None] - columns["traffic_log.position"][users, row]
    yaw = columns["traffic_log.yaw"][users, row]
    along = np.cos(yaw) * offset[..., 0] + np.sin(yaw) * offset[..., 1]
    across = -np.sin(yaw) * offset[..., 0] + np.cos(yaw) * offset[..., 1]
    beyond = np.maximum(np.abs(np.stack([along, across], axis=-1)) - columns["traffic_log.size"][users] / 2, 0.0)
    return np.hypot(beyond[..., 0], beyond[..., 1])


def draw_agents(
    columns: Mapping[str, np.ndarray], entry: Mapping[str, Any], *, row: int, slots: int, car_size_m: list[float] | None
) -> dict[str, np.ndarray]:
    """Draws the columns of `agents` by the entry `scenes.pack.starts`; slots without a start are absent.

    Args:
        row: of the log at the start.

    Raises:
        ConfigError: no drawn routes to start on, or no size for the cars.
    """
    if not columns["routes.drawn"].size:
        raise ConfigError("scenes.pack.starts: needs drawn routes; give scenes/pack/routes=route100 or another with `drawn` above 0")
    if car_size_m is None:
        raise ConfigError("scenes.pack.car_size_m: null; drawn agents have no log to take their size from; give [length, width]")
    choose = instantiate(entry, builtins=__name__, where="scenes.pack.starts", slots=slots)
    return _make_agents(columns, choose({**columns, "row": np.array(row)}), slots=slots, car_size_m=car_size_m)


def _make_agents(columns: Mapping[str, np.ndarray], starts: Starts, *, slots: int, car_size_m: list[float]) -> dict[str, np.ndarray]:
    """The columns of `agents` for these starts."""
    count = len(starts.route)
    rows = {name: np.zeros((slots, 2)) for name in ("position", "goal")}
    rows |= {name: np.zeros(slots) for name in ("yaw", "speed", "route_length", "route_start", "route_end")}
    rows["size"], rows["route"] = np.tile(np.asarray(car_size_m, float), (slots, 1)), np.zeros(slots, int)
    for slot in range(count):
        line = columns["routes.position"][starts.route[slot]]
        rows["position"][slot], rows["yaw"][slot] = _point_at(line, starts.start[slot])
        rows["goal"][slot] = _point_at(line, starts.end[slot])[0]
    rows["speed"][:count], rows["route"][:count] = starts.speed, starts.route
    rows["route_start"][:count], rows["route_end"][:count] = starts.start, starts.end
    rows["route_length"][:count] = starts.end - starts.start
    return {f"agents.{name}": leaf for name, leaf in (rows | {"present": np.arange(slots) < count}).items()}


def _point_at(line: Float[np.ndarray, "N 2"], arc: float) -> tuple[Float[np.ndarray, "2"], float]:
    """Point and yaw at a length along a route."""
    row = min(int(arc / ROUTE_SPACING_M), len(line) - 2)
    along = line[row + 1] - line[row]
    length = max(float(np.hypot(*along)), 1e-9)
    return line[row] + (arc - ROUTE_SPACING_M * row) / length * along, float(wrap_angles(np.arctan2(along[1], along[0])))


@dataclass(frozen=True)
class Conflicts:
    """What a conflict of two recorded ways is: the key `conflicts` of `scenes.pack`."""

    distance_m: Positive
    angle_deg: Positive
    within_s: NonNegative


def find_conflicts(raw: RawScene, logs: Logs, config: Conflicts) -> Bool[np.ndarray, " T"]:
    """Finds the vehicles whose recorded way, from the current step on, crosses another road user's (suite `conflict`).

    Two ways cross where they come within `distance_m` of each other, at an angle of more than `angle_deg` in both directions of travel,
    at times that are at most `within_s` apart.
    """
    now = raw.current
    xy, yaw, valid = logs.xyz[:, now:, :2], logs.yaw[:, now:], logs.valid[:, now:]
    times = raw.times[now:]
    moving = np.array([_travel(path[mask]) > config.distance_m for path, mask in zip(xy, valid, strict=True)], bool)
    crossing = np.zeros(len(xy), bool)
    near_in_time = np.abs(times[:, None] - times) <= config.within_s
    angle = np.deg2rad(config.angle_deg)
    for one in np.flatnonzero(moving & np.array([track.kind == "vehicle" for track in raw.tracks], bool)):
        for other in np.flatnonzero(moving):
            if other == one:
                continue
            apart = np.hypot(*(xy[one][:, None] - xy[other]).transpose(2, 0, 1))
            turn = np.abs(wrap_angles(yaw[one][:, None] - yaw[other]))
            angled = (turn > angle) & (turn < np.pi - angle)
            if (valid[one][:, None] & valid[other] & near_in_time & angled & (apart <= config.distance_m)).any():
                crossing[one] = True
                break
    return crossing


def _travel(path: Float[np.ndarray, "L 2"]) -> float:
    """Largest distance of a path from its start."""
    return float(np.hypot(*(path - path[:1]).T).max(initial=0.0))
