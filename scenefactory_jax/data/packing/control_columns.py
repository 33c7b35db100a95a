"""The traffic controls of a scene as columns: lights with their states over time, and stop signs, each on the lane that it governs."""

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import Light, Polyline, RawScene
from scenefactory_jax.core.types import DRIVABLE

UNKNOWN = 0  # index into LIGHT_STATES


def pack_controls(raw: RawScene, origin: Float[np.ndarray, "3"], half: float) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Packs the controls whose stop place lies in the box, and counts those that are left out, by reason.

    A light without a stop place stands at the start of its lane. Lights whose lane is not on the map are left out.
    """
    rows = {line.id: index for index, line in enumerate(raw.roads) if line.kind in DRIVABLE and len(line.xyz) >= 2}
    dropped = {"lane_not_on_map": 0, "outside_box": 0, "always_unknown": 0}
    found: list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], int, list[tuple[float, int]], float]] = []
    times = raw.times - raw.times[raw.current]
    for light in raw.lights:
        if light.lane not in rows:
            dropped["lane_not_on_map"] += 1
            continue
        changes, period = read_changes(light, times)
        if all(state == UNKNOWN for _, state in changes):
            dropped["always_unknown"] += 1
            continue
        index = rows[light.lane]
        place, direction = _find_stop(raw.roads[index], light)
        place = place - origin[:2]
        if np.abs(place).max() > half:
            dropped["outside_box"] += 1
            continue
        found.append((place, direction, index, changes, period))
    most = max((len(changes) for *_, changes, _ in found), default=0)
    count = len(found)
    columns = {
        "controls.position": np.array([place for place, *_ in found]).reshape(count, 2),
        "controls.direction": np.array([direction for _, direction, *_ in found]).reshape(count, 2),
        "controls.lane": np.array([index for _, _, index, *_ in found], int),
        "controls.stop_sign": np.zeros(count, bool),
        "controls.change_s": np.full((count, most), np.inf),
        "controls.state": np.zeros((count, most), int),
        "controls.period_s": np.array([period for *_, period in found], float),
        "controls.valid": np.ones(count, bool),
    }
    for row, (*_, changes, _) in enumerate(found):
        for place, (time, state) in enumerate(changes):
            columns["controls.change_s"][row, place] = time
            columns["controls.state"][row, place] = state
    return columns, dropped


def read_changes(light: Light, times: Float[np.ndarray, " L"]) -> tuple[list[tuple[float, int]], float]:
    """Lists (time, state) of a light at each change of its log, and the period after which the states repeat, inf for a logged light.

    A logged light is unknown at steps that the source says nothing about, and after the end of its log.
    """
    state = np.where(light.valid, light.state, UNKNOWN)
    new = np.concatenate([[True], np.diff(state) != 0])
    changes = [(float(time), int(code)) for time, code in zip(times[new], state[new], strict=True)]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return [*changes, (float(times[-1]) + step, UNKNOWN)], np.inf


def _find_stop(lane: Polyline, light: Light) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The stop place of a light, and the direction of its lane there."""
    line = lane.xyz[:, :2]
    place = line[0] if light.stop is None else light.stop[:2]
    segment = min(int(np.argmin(np.linalg.norm(line - place, axis=1))), len(line) - 2)
    along = line[segment + 1] - line[segment]
    length = float(np.linalg.norm(along))
    return place, along / length if length > 0 else np.array([1.0, 0.0])
