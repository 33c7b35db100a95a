"""The traffic controls of a scene as columns: lights with their states over time, and stop signs, each on the lane that it governs."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Light, LightPlan, Polyline, RawScene
from scenefactory_jax.core.schema import Bounds, NonNegative, Positive
from scenefactory_jax.core.types import DRIVABLE, LANE_BIKE, STOP_SIGN
from scenefactory_jax.roadgraph import stop_signs

UNKNOWN = 0  # index into LIGHT_STATES
LANE_UNKNOWN = 0  # map element
CONTROL_DROPS: tuple[str, ...] = (
    "lane_not_on_map", "lane_not_for_cars", "sign_without_lane", "second_sign_of_lane", "always_unknown", "outside_box",
)  # fmt: skip
SignedRange = Annotated[tuple[float, float], Bounds(is_range=True)]
Place = Float[np.ndarray, "2"]
Changes = list[tuple[float, int]]  # (time, state) at each change


@dataclass(frozen=True)
class SignRules:
    """Which lanes a stop sign governs whose source names none; see `roadgraph.stop_signs.infer_sign_lanes`."""

    ahead_m: SignedRange
    right_m: SignedRange
    above_m: SignedRange
    joint_m: NonNegative
    approach_width_m: Positive
    approach_turn_deg: Positive


@dataclass(frozen=True)
class ControlsConfig:
    """The key `controls` of `scenes.pack`."""

    max_stop_distance_m: Positive  # of a light's stop point from its lane; for a farther one, cars stop at the lane's start
    max_stop_turn_deg: Positive  # of a lane between its end beside a stop sign and the place where cars stop
    signs: SignRules


class PackedControls(NamedTuple):
    """Columns of `Scene.controls`, and counts."""

    columns: dict[str, np.ndarray]
    dropped: dict[str, int]  # reason of CONTROL_DROPS -> lights, stop signs, or lanes of stop signs
    inferred: int  # stop signs whose lanes were inferred


class _Row(NamedTuple):
    """A control on one lane."""

    place: Place  # in the source's coordinates
    direction: Place
    lane: int  # index into RawScene.roads
    sign: bool
    changes: Changes
    period: float


def pack_controls(raw: RawScene, origin: Float[np.ndarray, "3"], half: float, config: ControlsConfig) -> PackedControls:
    """Packs the controls whose stop place lies in the box, and counts those that are left out, by reason.

    Lights come first. A light without a stop place stands at the start of its lane. A stop sign is a row for each of its lanes; of two
    signs for one lane the first one counts. Controls whose lane is not on the map are left out.
    """
    dropped = dict.fromkeys(CONTROL_DROPS, 0)
    roads, inferred = stop_signs.infer_sign_lanes(raw.roads, **asdict(config.signs))
    lanes = _find_rows(roads)
    rows = [*_find_lights(raw, lanes, config, dropped), *_find_signs(roads, lanes, config, dropped)]
    inside = [row for row in rows if np.abs(row.place - origin[:2]).max() <= half]
    dropped["outside_box"] = len(rows) - len(inside)
    count, most = len(inside), max((len(row.changes) for row in inside), default=0)
    change_s, state = np.full((count, most), np.inf), np.zeros((count, most), int)
    for index, row in enumerate(inside):
        for place, change in enumerate(row.changes):
            change_s[index, place], state[index, place] = change
    columns = {
        "controls.position": np.array([row.place - origin[:2] for row in inside]).reshape(count, 2),
        "controls.direction": np.array([row.direction for row in inside]).reshape(count, 2),
        "controls.lane": np.array([row.lane for row in inside], int),
        "controls.stop_sign": np.array([row.sign for row in inside], bool),
        "controls.change_s": change_s,
        "controls.state": state,
        "controls.period_s": np.array([row.period for row in inside], float),
        "controls.valid": np.ones(count, bool),
    }
    return PackedControls(columns, dropped, inferred)


def _find_rows(roads: Sequence[Polyline]) -> dict[int, int | None]:
    """Rows in `roads` of the lanes by id; None for a lane that is not for cars."""
    kinds = (*DRIVABLE, LANE_UNKNOWN, LANE_BIKE)
    lanes = [(index, line) for index, line in enumerate(roads) if line.kind in kinds and len(line.xyz) >= 2]
    return {line.id: index if line.kind in DRIVABLE else None for index, line in lanes}


def _find_row(lane: int, lanes: Mapping[int, int | None], dropped: dict[str, int]) -> int | None:
    """The row of a lane for cars; None, counted, for any other."""
    if lanes.get(lane) is None:
        dropped["lane_not_for_cars" if lane in lanes else "lane_not_on_map"] += 1
    return lanes.get(lane)


def _find_lights(raw: RawScene, lanes: Mapping[int, int | None], config: ControlsConfig, dropped: dict[str, int]) -> list[_Row]:
    """The lights that are known at some time."""
    rows = []
    for light in raw.lights:
        if (row := _find_row(light.lane, lanes, dropped)) is None:
            continue
        changes, period = read_changes(light, raw.times, raw.current)
        if all(state == UNKNOWN for _, state in changes):
            dropped["always_unknown"] += 1
            continue
        place, direction = find_light_stop(raw.roads[row], light, config.max_stop_distance_m)
        rows.append(_Row(place, direction, row, False, changes, period))
    return rows


def _find_signs(roads: Sequence[Polyline], lanes: Mapping[int, int | None], config: ControlsConfig, dropped: dict[str, int]) -> list[_Row]:
    """The stop signs, once for each of their lanes."""
    rows: dict[int, _Row] = {}
    for sign in (line for line in roads if line.kind == STOP_SIGN and len(line.xyz)):
        dropped["sign_without_lane"] += not sign.lanes
        for lane in sign.lanes:
            if (row := _find_row(lane, lanes, dropped)) is None:
                continue
            if row in rows:
                dropped["second_sign_of_lane"] += 1
                continue
            stop = stop_signs.find_stop_place(roads[row].xyz[:, :2], sign.xyz[0, :2], max_turn_deg=config.max_stop_turn_deg)
            rows[row] = _Row(*stop, row, True, [], np.inf)
    return list(rows.values())


def read_changes(light: Light, times: Float[np.ndarray, " L"], current: int) -> tuple[Changes, float]:
    """Lists (time since the current step, state) of a light at each change, and the period after which the states repeat.

    A light with a plan repeats it for ever, and its first change is at 0. Other lights have the states of their log: unknown at steps that
    the source says nothing about and after the end, with the period inf.
    """
    if light.plan is not None:
        return _read_plan(light.plan, float(times[current])), float(light.plan.period_s)
    since = times - times[current]
    state = np.where(light.valid, light.state, UNKNOWN)
    new = np.concatenate([[True], np.diff(state) != 0])
    changes = [(float(time), int(code)) for time, code in zip(since[new], state[new], strict=True)]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    end = [] if state[-1] == UNKNOWN else [(float(since[-1]) + step, UNKNOWN)]
    return changes + end, np.inf


def _read_plan(plan: LightPlan, start: float) -> Changes:
    """The changes of a plan over one period from a time on; the first one gives the state at that time."""
    since = np.mod(np.asarray(plan.start_s, float) - start, plan.period_s)
    order = np.argsort(since, kind="stable")
    first: Changes = [] if since[order[0]] == 0 else [(0.0, int(plan.state[order[-1]]))]
    return first + [(float(since[place]), int(plan.state[place])) for place in order]


def find_light_stop(lane: Polyline, light: Light, max_distance_m: float) -> tuple[Place, Place]:
    """Finds where cars stop for a light, and the direction of its lane there.

    In the Waymo Open Motion Dataset the stop point is the start of the lane, inside of the junction: a car passes it when it leaves the
    lane before. The lane's start also takes the place of a stop point that is missing or farther than `max_distance_m` from the lane.
    """
    line = lane.xyz[:, :2]
    steps = np.diff(line, axis=0)
    length = np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
    if light.stop is not None:
        fraction = np.clip(np.sum((light.stop[:2] - line[:-1]) * steps, axis=1) / length**2, 0.0, 1.0)
        distance = np.linalg.norm(line[:-1] + fraction[:, None] * steps - light.stop[:2], axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] <= max_distance_m:
            return light.stop[:2], steps[nearest] / length[nearest]
    return line[0], steps[0] / length[0]
