"""Checks on scenes before they are packed: a scene is repaired where that is possible, and refused by name where it is not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import Logs, Points, grid, join_lines, sample_tracks, segment_lengths, stack_tracks
from scenefactory_jax.core.types import DRIVABLE, STOP_SIGN

DUPLICATE_M = 1e-6  # points closer than this in the plane give no segment
ELEMENTS = (*range(4), *range(5, 21))  # WOMD's map element ids, those of unknown lanes, lines and edges among them
MAX_NAMED = 5  # ids in a line


def check(
    raw: RawScene,
    *,
    track_speed_limit_m_s: float,
    car_size_m: list[float],
    max_coordinate_m: float,
    max_segment_m: float,
    max_lanes_m: float,
    max_size_m: float,
    max_speed_m_s: float,
    max_steps: int,
    step_s: Sequence[float],
    uneven_fraction: Sequence[float],
) -> tuple[RawScene, list[str]]:
    """Checks and repairs a scene, and returns it with one line for each kind of repair or finding.

    The bounds keep the work on a scene in proportion to its file: without them one damaged number adds 10^7 points along a lane.

    Args:
        raw: from a reader or a generator.
        track_speed_limit_m_s: a step between two positions that needs more than this speed is reported as a jump.
        car_size_m: length, width, height given to objects whose logged size is not positive.
        max_coordinate_m: largest coordinate, and largest yaw in radians.
        max_segment_m, max_lanes_m: largest length of a segment, and of all driving lanes together.
        max_size_m, max_speed_m_s: largest side of an object, and velocity along x or y.
        max_steps, step_s: largest number of steps, and shortest and longest step of a log.
        uneven_fraction: logs whose steps differ from the median step by more than the first fraction of it and
            by no more than the second are resampled to even steps; logs that are more uneven stay as they are.

    Raises:
        SceneError: steps that disagree, no driving lane, or a number that is not finite or beyond a bound, naming the file and the element.
    """
    _check_steps(raw, max_steps, step_s)
    points, logs = join_lines(raw.roads), stack_tracks(raw.tracks, len(raw.times))
    _check_map(raw, points, max_coordinate_m, max_segment_m, max_lanes_m)
    _check_tracks(raw, logs, max_coordinate_m, max_speed_m_s, max_size_m)
    lines: list[str] = []
    raw, logs = _resample_uneven(raw, logs, uneven_fraction, lines)
    lengthy = _repair_roads(raw.roads, points, lines)
    roads = tuple(line for line in lengthy if line.kind in ELEMENTS)
    if unknown := [f"{line.id}: {line.kind}" for line in lengthy if line.kind not in ELEMENTS]:
        lines.append(f"roads of unknown map elements dropped: {len(unknown)} (ids and elements {list_ids(unknown)})")
    if not any(line.kind in DRIVABLE for line in roads):
        kinds = ", ".join(map(str, sorted({line.kind for line in lengthy}))) or "none"
        raise SceneError(f"{raw.source}: roads: no driving lane (map elements {DRIVABLE}); the elements there are: {kinds}")
    length, width, height = map(float, car_size_m)
    tracks, sdc = _repair_tracks(raw, logs, (length, width, height), lines)
    _report_jumps(raw, logs, track_speed_limit_m_s, lines)
    return replace(raw, roads=roads, tracks=tracks, sdc=sdc), lines


def _check_steps(raw: RawScene, max_steps: int, step_s: Sequence[float]) -> None:
    """Refuses times that do not rise by steps in `step_s`, a current step outside the log, tracks of other lengths, and damaged lights."""
    steps, span = len(raw.times), np.diff(raw.times)
    if steps > max_steps:
        raise SceneError(f"{raw.source}: times: expected up to {max_steps} steps (scenes.check.max_steps), got {steps}")
    if not np.all(np.isfinite(raw.times)) or np.any(span <= 0):
        raise SceneError(f"{raw.source}: times: expected finite times that rise from step to step")
    if (bad := np.flatnonzero((span < step_s[0]) | (span > step_s[1]))).size:
        expected = f"a step of {step_s[0]:g} to {step_s[1]:g} s (scenes.check.step_s)"
        raise SceneError(f"{raw.source}: times[{bad[0] + 1}]: expected {expected}, got {span[bad[0]]:g} s")
    if not 0 <= raw.current < steps:
        raise SceneError(f"{raw.source}: current: expected a step of the log, 0 to {steps - 1}, got {raw.current}")
    if raw.sdc is not None and not 0 <= raw.sdc < len(raw.tracks):
        raise SceneError(f"{raw.source}: sdc: expected a track, 0 to {len(raw.tracks) - 1}, got {raw.sdc}")
    for index, track in enumerate(raw.tracks):
        if {len(track.valid), len(track.xyz), len(track.yaw), len(track.velocity)} != {steps}:
            raise SceneError(f"{_name_track(raw, index)}: expected {steps} steps, as the log has, got {len(track.valid)}")
    for index, light in enumerate(raw.lights):
        _check_light(light, f"{raw.source}: lights[{index}] (lane {light.lane})", steps)


def _check_light(light: Light, where: str, steps: int) -> None:
    """Refuses a light of another length than the log, unknown states, a stop point that is not finite, and a plan that is no cycle."""
    if {len(light.valid), len(light.state)} != {steps}:
        raise SceneError(f"{where}: expected {steps} steps, as the log has, got {len(light.valid)}")
    if light.stop is not None and not np.isfinite(light.stop).all():
        raise SceneError(f"{where}: stop: expected finite coordinates, got {np.asarray(light.stop).tolist()}")
    states = {"state": np.where(light.valid, light.state, 0)}
    if light.plan is not None:
        start, period, states["plan.state"] = np.asarray(light.plan.start_s), light.plan.period_s, np.asarray(light.plan.state)
        if not len(start) or len(start) != len(states["plan.state"]):
            raise SceneError(f"{where}: plan: expected one state or more, each with its start, got {len(start)} starts")
        if not (np.isfinite(period) and np.isfinite(start).all() and start[0] >= 0 and (np.diff(start) >= 0).all() and start[-1] < period):
            raise SceneError(
                f"{where}: plan: expected starts that rise from 0 on and end before the period, got {start.tolist()}, {period} s"
            )
    for name, codes in states.items():
        if (bad := np.flatnonzero((codes < 0) | (codes >= len(LIGHT_STATES)))).size:
            got = f"{name}[{bad[0]}]: expected an index into LIGHT_STATES, 0 to {len(LIGHT_STATES) - 1}, got {codes[bad[0]]}"
            raise SceneError(f"{where}: {got}")


def _check_map(raw: RawScene, points: Points, max_coordinate_m: float, max_segment_m: float, max_lanes_m: float) -> None:
    """Refuses coordinates that are not finite or too large, and segments and driving lanes that are too long."""

    def place(row: int) -> tuple[str, int]:
        """The polyline of a point, for messages, and the point's number on it."""
        index = int(np.searchsorted(points.bounds, row, side="right")) - 1
        return f"{raw.source}: roads[{index}] (id {raw.roads[index].id})", int(row - points.bounds[index])

    bad = ~(np.abs(points.xyz) <= max_coordinate_m)
    if bad.any():
        row, axis = np.argwhere(bad)[0]
        (where, number), value = place(int(row)), points.xyz[row, axis]
        raise SceneError(f"{where}: xyz[{number}][{axis}]: {_describe_bound(float(value), max_coordinate_m, 'max_coordinate_m')}")
    owner = np.repeat(np.arange(len(raw.roads)), np.diff(points.bounds))
    length = np.linalg.norm(np.diff(points.xyz, axis=0), axis=1) * (owner[1:] == owner[:-1])
    if (bad := np.flatnonzero(length > max_segment_m)).size:
        where, number = place(int(bad[0]))
        raise SceneError(f"{where}: length from xyz[{number}] on: {_describe_bound(length[bad[0]], max_segment_m, 'max_segment_m')}")
    drivable = np.array([line.kind in DRIVABLE for line in raw.roads], bool)
    if (total := length[drivable[owner[1:]]].sum()) > max_lanes_m:
        raise SceneError(f"{raw.source}: roads: length of all driving lanes: {_describe_bound(total, max_lanes_m, 'max_lanes_m')}")


def _check_tracks(raw: RawScene, logs: Logs, max_coordinate_m: float, max_speed_m_s: float, max_size_m: float) -> None:
    """Refuses numbers that are too large, and at valid steps those that are not finite; sizes that are not finite are repaired later."""
    faults = []
    bounds = {"xyz": (max_coordinate_m, "max_coordinate_m"), "yaw": (max_coordinate_m, "max_coordinate_m")}
    for name, (bound, key) in (bounds | {"velocity": (max_speed_m_s, "max_speed_m_s")}).items():
        table = getattr(logs, name).reshape(*logs.valid.shape, -1)
        bad = ~(np.abs(table) <= bound) & logs.valid[..., None]
        if bad.any():
            index, step, axis = np.argwhere(bad)[0]
            faults.append((int(index), f"{name}[{step}]: {_describe_bound(float(table[index, step, axis]), bound, key)}"))
    for index, axis in np.argwhere(np.isfinite(logs.size) & (logs.size > max_size_m))[:1]:
        faults.append((int(index), f"size[{axis}]: {_describe_bound(float(logs.size[index, axis]), max_size_m, 'max_size_m')}"))
    if faults:
        index, fault = min(faults, key=lambda fault: fault[0])
        raise SceneError(f"{_name_track(raw, index)}: {fault}")


def _name_track(raw: RawScene, index: int) -> str:
    return f"{raw.source}: tracks[{index}] (id {raw.tracks[index].id})"


def _describe_bound(value: float, bound: float, key: str) -> str:
    return f"expected {'up to ' if np.isfinite(value) else 'a finite number up to '}{bound:g} (scenes.check.{key}), got {value:g}"


def _resample_uneven(raw: RawScene, logs: Logs, fraction: Sequence[float], lines: list[str]) -> tuple[RawScene, Logs]:
    """A log whose steps are somewhat uneven, at even steps; any other as it is."""
    span = np.diff(raw.times)
    usual = float(np.median(span)) if len(span) else 1.0
    off = np.abs(span - usual) / usual
    if not fraction[0] < off.max(initial=0.0) <= fraction[1]:
        return raw, logs
    times, current = grid(raw.times, raw.current, step_s=usual, near=fraction[0])
    even = sample_tracks(logs, raw.times, times, near=fraction[0])
    tracks = tuple(
        replace(track, xyz=even.xyz[row], yaw=even.yaw[row], velocity=even.velocity[row], valid=even.valid[row])
        for row, track in enumerate(raw.tracks)
    )
    last = np.searchsorted(raw.times, times + fraction[0] * usual, side="right") - 1  # a light holds from one step to the next
    lights = tuple(replace(light, state=light.state[last], valid=light.valid[last]) for light in raw.lights)
    count, worst = int((off > fraction[0]).sum()), 1e3 * usual * off.max()
    lines.append(f"logs of uneven steps resampled: {count} of {len(span)} steps are not {usual:.3g} s long, by up to {worst:.3g} ms")
    return replace(raw, times=times, current=current, tracks=tracks, lights=lights), even


def _repair_roads(roads: tuple[Polyline, ...], points: Points, lines: list[str]) -> tuple[Polyline, ...]:
    """The roads without duplicate points, and without lines of fewer than two points, stop signs excepted."""
    bounds = points.bounds
    different = np.ones(len(points.xyz), bool)
    different[1:] = segment_lengths(np.diff(points.xyz[:, :2], axis=0)) > DUPLICATE_M
    different[bounds[:-1][np.diff(bounds) > 0]] = True  # each line's first point
    kept = []
    for line, start, stop in zip(roads, bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        mask = different[start:stop]
        count = int(np.count_nonzero(mask))
        if count >= (1 if line.kind == STOP_SIGN else 2):
            kept.append(line if count == stop - start else replace(line, xyz=line.xyz[mask]))
    if duplicates := int((~different).sum()):
        lines.append(f"duplicate points removed: {duplicates}")
    if short := len(roads) - len(kept):
        lines.append(f"polylines of fewer than two points dropped: {short}")
    return tuple(kept)


def _repair_tracks(
    raw: RawScene, logs: Logs, car_size: tuple[float, float, float], lines: list[str]
) -> tuple[tuple[Track, ...], int | None]:
    """The tracks with a valid step, with positive sizes and zeros at invalid steps; and the new index of the recording car."""
    present, hidden = np.asarray(logs.valid.any(axis=1)), ~logs.valid
    sized = np.logical_and.reduce(np.isfinite(logs.size) & (logs.size > 0), axis=1)
    non_zero = [(getattr(logs, name) != 0).reshape(*hidden.shape, -1).any(axis=2) for name in ("xyz", "yaw", "velocity")]
    stale = (np.logical_or.reduce(non_zero) & hidden).any(axis=1)
    kept = []
    for index in np.flatnonzero(present).tolist():
        track = raw.tracks[index]
        if not sized[index]:
            track = replace(track, size=car_size)
        if stale[index]:
            mask = track.valid[:, None]
            xyz, velocity = np.where(mask, track.xyz, 0.0), np.where(mask, track.velocity, 0.0)
            track = replace(track, xyz=xyz, yaw=np.where(track.valid, track.yaw, 0.0), velocity=velocity)
        kept.append(track)
    if empty := int((~present).sum()):
        lines.append(f"tracks without a valid step dropped: {empty}")
    if resized := [raw.tracks[index].id for index in np.flatnonzero(present & ~sized)]:
        lines.append(f"sizes that are not positive replaced by {car_size}: {len(resized)} (ids {list_ids(resized)})")
    if count := int((stale & present).sum()):
        lines.append(f"tracks with values at invalid steps zeroed there: {count}")
    sdc = None if raw.sdc is None or not present[raw.sdc] else int(present[: raw.sdc].sum())
    return tuple(kept), sdc


def _report_jumps(raw: RawScene, logs: Logs, limit_m_s: float, lines: list[str]) -> None:
    """Reports tracks whose positions need more than the limit between two neighbouring valid steps."""
    pairs = logs.valid[:, 1:] & logs.valid[:, :-1]
    with np.errstate(invalid="ignore", over="ignore"):  # of values at invalid steps
        speed = segment_lengths(np.diff(logs.xyz[..., :2], axis=1)) / np.diff(raw.times)
    jumps = (pairs & (speed > limit_m_s)).sum(axis=1)
    if jumps.any():
        ids = [raw.tracks[index].id for index in np.flatnonzero(jumps)]
        lines.append(f"track jumps above {limit_m_s:g} m/s: {jumps.sum()} steps (ids {list_ids(ids)})")


def list_ids(ids: Sequence[int | str]) -> str:
    """The first ids of a list, for a message."""
    return ", ".join(map(str, ids[:MAX_NAMED])) + (", ..." if len(ids) > MAX_NAMED else "")
