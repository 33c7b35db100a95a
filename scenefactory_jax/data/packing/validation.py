"""Checks on scenes before they are packed: a scene is repaired where that is possible, and refused by name where it is not."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from scenefactory_jax.core.raw_scene import Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import Logs, Points, grid, join_lines, sample_tracks, segment_lengths, stack_tracks
from scenefactory_jax.core.types import DRIVABLE, STOP_SIGN

DUPLICATE_M = 1e-6  # points closer than this in the plane give no segment
ELEMENTS = (*range(4), *range(5, 21))  # WOMD's map element ids, those of unknown lanes, lines and edges among them
NAMED = 5  # how many offenders a line names


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

    The bounds keep the work on a scene in proportion to its file: one damaged number must not ask for 10^7 points along a lane.

    Args:
        raw: as a reader or a generator gave it.
        track_speed_limit_m_s: a track whose positions imply more than that in a step is reported as jumping.
        car_size_m: length, width, height given to objects whose logged size is not positive.
        max_coordinate_m: largest coordinate, and largest yaw in radians.
        max_segment_m: largest distance between neighbouring points of a polyline.
        max_lanes_m: largest length of all driving lanes together.
        max_size_m: largest length, width and height of an object.
        max_speed_m_s: largest velocity along x or y.
        max_steps: most steps of a log.
        step_s: shortest and longest step of a log.
        uneven_fraction: logs whose steps differ from the median step by more than the first fraction of it and
            by no more than the second are resampled to even steps; logs that are more uneven stay as they are.

    Raises:
        SceneError: steps that disagree, no driving lane, or a number that is not finite or beyond a bound, naming the file and the element.
    """
    _require_steps(raw, max_steps, step_s)
    points, logs = join_lines(raw.roads), stack_tracks(raw.tracks, len(raw.times))
    _require_map(raw, points, max_coordinate_m)
    _require_lengths(raw, points, max_segment_m, max_lanes_m)
    coordinate = (max_coordinate_m, "max_coordinate_m")
    _require_tracks(raw, logs, {"xyz": coordinate, "yaw": coordinate, "velocity": (max_speed_m_s, "max_speed_m_s")})
    _require_sizes(raw, logs, max_size_m)
    lines: list[str] = []
    raw, logs = _even_steps(raw, logs, uneven_fraction, lines)
    whole = _repair_roads(raw.roads, points, lines)
    roads = _known(whole, lines)
    if not any(line.kind in DRIVABLE for line in roads):
        found = ", ".join(map(str, sorted({line.kind for line in whole}))) or "none"
        raise SceneError(f"{raw.source}: roads: no driving lane (map elements {DRIVABLE}); the elements there are: {found}")
    tracks, sdc = _repair_tracks(raw, logs, tuple(float(x) for x in car_size_m), lines)  # pyright: ignore[reportArgumentType]
    _report_jumps(raw, logs, track_speed_limit_m_s, lines)
    return replace(raw, roads=roads, tracks=tracks, sdc=sdc), lines


def _require_steps(raw: RawScene, most: float | int, step_s: Sequence[float]) -> None:
    """Times rise by steps that a log can have, the current step is one of them, and every track and light has all of them."""
    steps = len(raw.times)
    if steps > most:
        raise SceneError(f"{raw.source}: times: {steps} steps; valid: up to {most:g} (scenes.check.max_steps)")
    span = np.diff(raw.times)
    if not np.all(np.isfinite(raw.times)) or np.any(span <= 0):
        raise SceneError(f"{raw.source}: times: they must be finite and rise from step to step")
    if (bad := np.flatnonzero((span < step_s[0]) | (span > step_s[1]))).size:
        valid = f"{step_s[0]:g} to {step_s[1]:g} s (scenes.check.step_s)"
        raise SceneError(f"{raw.source}: times[{bad[0] + 1}]: {span[bad[0]]:g} s after the step before; valid: {valid}")
    if not 0 <= raw.current < steps:
        raise SceneError(f"{raw.source}: current: {raw.current} is no step of the log; valid: 0 to {steps - 1}")
    if raw.sdc is not None and not 0 <= raw.sdc < len(raw.tracks):
        raise SceneError(f"{raw.source}: sdc: {raw.sdc} is no track; valid: 0 to {len(raw.tracks) - 1}")
    for index, track in enumerate(raw.tracks):
        if not len(track.valid) == len(track.xyz) == len(track.yaw) == len(track.velocity) == steps:
            raise SceneError(f"{raw.source}: tracks[{index}] (id {track.id}): {len(track.valid)} steps; the log has {steps}")
    for index, light in enumerate(raw.lights):
        if not len(light.valid) == len(light.state) == steps:
            raise SceneError(f"{raw.source}: lights[{index}] (lane {light.lane}): {len(light.valid)} steps; the log has {steps}")


def _require_map(raw: RawScene, points: Points, most: float) -> None:
    """No NaN, infinity or absurd number on the map."""
    bad = ~(np.abs(points.xyz) <= most)
    if bad.any():
        row, axis = np.argwhere(bad)[0]
        place, number = _polyline(raw, points, int(row))
        raise SceneError(f"{raw.source}: {place}: xyz[{number}][{axis}]: {_fault(float(points.xyz[row, axis]), most, 'max_coordinate_m')}")


def _require_lengths(raw: RawScene, points: Points, segment_most: float, lanes_most: float) -> None:
    """No segment, and no sum of driving lanes, so long that a damaged coordinate is the likely cause."""
    owner = np.repeat(np.arange(len(raw.roads)), np.diff(points.bounds))
    length = np.linalg.norm(np.diff(points.xyz, axis=0), axis=1) * (owner[1:] == owner[:-1])
    if (bad := np.flatnonzero(length > segment_most)).size:
        place, number = _polyline(raw, points, int(bad[0]))
        fault = f"{length[bad[0]]:g} m long; valid: up to {segment_most:g} (scenes.check.max_segment_m)"
        raise SceneError(f"{raw.source}: {place}: the segment from xyz[{number}] is {fault}")
    drivable = np.array([line.kind in DRIVABLE for line in raw.roads], bool)
    if (total := float(length[drivable[owner[1:]]].sum())) > lanes_most:
        raise SceneError(f"{raw.source}: roads: {total:g} m of driving lanes; valid: up to {lanes_most:g} (scenes.check.max_lanes_m)")


def _polyline(raw: RawScene, points: Points, row: int) -> tuple[str, int]:
    """The polyline that a point belongs to, in words, and the point's number on it."""
    index = int(np.searchsorted(points.bounds, row, side="right")) - 1
    return f"roads[{index}] (id {raw.roads[index].id})", int(row - points.bounds[index])


def _require_tracks(raw: RawScene, logs: Logs, most: Mapping[str, tuple[float, str]]) -> None:
    """No NaN, infinity or absurd number in a track's valid steps.

    Args:
        most: column of the log -> the largest number in it, and the bound's name in the config.
    """
    found = []
    for name, (bound, key) in most.items():
        table = getattr(logs, name).reshape(*logs.valid.shape, -1)
        bad = ~(np.abs(table) <= bound) & logs.valid[..., None]
        if bad.any():
            index, step, axis = np.argwhere(bad)[0]
            found.append((int(index), f"{name}[{step}]: {_fault(float(table[index, step, axis]), bound, key)}"))
    if found:
        index, place = min(found, key=lambda one: one[0])
        raise SceneError(f"{raw.source}: tracks[{index}] (id {raw.tracks[index].id}): {place}")


def _require_sizes(raw: RawScene, logs: Logs, most: float) -> None:
    """No absurd size; what is not finite is repaired."""
    huge = np.argwhere(np.isfinite(logs.size) & (logs.size > most))
    if len(huge):
        index, axis = huge[0]
        fault = _fault(float(logs.size[index, axis]), most, "max_size_m")
        raise SceneError(f"{raw.source}: tracks[{index}] (id {raw.tracks[index].id}): size[{axis}]: {fault}")


def _fault(value: float, most: float, key: str) -> str:
    """What is wrong with a number."""
    if not np.isfinite(value):
        return f"{value} is not finite"
    return f"{value:g} is too large; valid: up to {most:g} (scenes.check.{key})"


def _even_steps(raw: RawScene, logs: Logs, share: Sequence[float], lines: list[str]) -> tuple[RawScene, Logs]:
    """A log whose steps are somewhat uneven, at even steps; any other as it is."""
    span = np.diff(raw.times)
    usual = float(np.median(span)) if len(span) else 1.0
    off = np.abs(span - usual) / usual
    if not share[0] < off.max(initial=0.0) <= share[1]:
        return raw, logs
    times, current = grid(raw.times, raw.current, step_s=usual, near=share[0])
    even = sample_tracks(logs, raw.times, times, near=share[0])
    tracks = tuple(
        replace(track, xyz=even.xyz[row], yaw=even.yaw[row], velocity=even.velocity[row], valid=even.valid[row])
        for row, track in enumerate(raw.tracks)
    )
    last = np.searchsorted(raw.times, times + share[0] * usual, side="right") - 1  # a light holds from one step to the next
    lights = tuple(replace(light, state=light.state[last], valid=light.valid[last]) for light in raw.lights)
    count, worst = int((off > share[0]).sum()), 1e3 * usual * off.max()
    lines.append(f"logs of uneven steps resampled: {count} of {len(span)} steps are not {usual:.3g} s long, by up to {worst:.3g} ms")
    return replace(raw, times=times, current=current, tracks=tracks, lights=lights), even


def _known(roads: tuple[Polyline, ...], lines: list[str]) -> tuple[Polyline, ...]:
    """Without roads of which nobody knows what they are."""
    if unknown := [line for line in roads if line.kind not in ELEMENTS]:
        named = _some([f"{line.id}: {line.kind}" for line in unknown])
        lines.append(f"roads of unknown map elements dropped: {len(unknown)} (ids and elements {named})")
    return tuple(line for line in roads if line.kind in ELEMENTS)


def _repair_roads(roads: tuple[Polyline, ...], points: Points, lines: list[str]) -> tuple[Polyline, ...]:
    """Without duplicate points, and without lines of fewer than two points, stop signs excepted."""
    bounds = points.bounds
    different = np.ones(len(points.xyz), bool)
    different[1:] = segment_lengths(np.diff(points.xyz[:, :2], axis=0)) > DUPLICATE_M
    different[bounds[:-1][np.diff(bounds) > 0]] = True  # each line's first point
    running = np.concatenate([[0], np.cumsum(different)])
    counts = np.diff(running[bounds])
    wanted = np.array([1 if line.kind == STOP_SIGN else 2 for line in roads], int)
    enough, whole = (counts >= wanted).tolist(), (counts == np.diff(bounds)).tolist()
    kept = [
        line if whole[i] else replace(line, xyz=line.xyz[different[bounds[i] : bounds[i + 1]]]) for i, line in enumerate(roads) if enough[i]
    ]
    if duplicates := int((~different).sum()):
        lines.append(f"duplicate points removed: {duplicates}")
    if short := len(roads) - len(kept):
        lines.append(f"polylines of fewer than two points dropped: {short}")
    return tuple(kept)


def _repair_tracks(
    raw: RawScene, logs: Logs, car_size: tuple[float, float, float], lines: list[str]
) -> tuple[tuple[Track, ...], int | None]:
    """Without tracks that are nowhere valid, with positive sizes, and zeros at invalid steps; the SDC's new index."""
    seen, hidden = logs.valid.any(axis=1), ~logs.valid
    sized = np.logical_and.reduce(np.isfinite(logs.size) & (logs.size > 0), axis=1)
    values = [(getattr(logs, name) != 0).reshape(*hidden.shape, -1).any(axis=2) for name in ("xyz", "yaw", "velocity")]
    stale = (np.logical_or.reduce(values) & hidden).any(axis=1)
    sizes = [raw.tracks[index].id for index in np.flatnonzero(seen & ~sized)]
    kept, sdc = [], None
    for index in np.flatnonzero(seen).tolist():
        track = raw.tracks[index]
        if index == raw.sdc:
            sdc = len(kept)
        if not sized[index]:
            track = replace(track, size=car_size)
        if stale[index]:
            mask = track.valid[:, None]
            xyz, velocity = np.where(mask, track.xyz, 0.0), np.where(mask, track.velocity, 0.0)
            track = replace(track, xyz=xyz, yaw=np.where(track.valid, track.yaw, 0.0), velocity=velocity)
        kept.append(track)
    if empty := int((~seen).sum()):
        lines.append(f"tracks without a valid step dropped: {empty}")
    if sizes:
        lines.append(f"sizes that are not positive replaced by {car_size}: {len(sizes)} (ids {_some(sizes)})")
    if count := int((stale & seen).sum()):
        lines.append(f"tracks with values at invalid steps zeroed there: {count}")
    return tuple(kept), sdc


def _report_jumps(raw: RawScene, logs: Logs, limit_m_s: float, lines: list[str]) -> None:
    """Tracks whose positions imply more than the limit between two neighbouring valid steps."""
    pairs = logs.valid[:, 1:] & logs.valid[:, :-1]
    with np.errstate(invalid="ignore", over="ignore"):  # of values at invalid steps
        speed = segment_lengths(np.diff(logs.xyz[..., :2], axis=1)) / np.diff(raw.times)
    jumps = (pairs & (speed > limit_m_s)).sum(axis=1)
    if jumps.any():
        ids = [raw.tracks[index].id for index in np.flatnonzero(jumps)]
        lines.append(f"track jumps above {limit_m_s:g} m/s: {jumps.sum()} steps (ids {_some(ids)})")


def _some(ids: Sequence[int | str]) -> str:
    return ", ".join(map(str, ids[:NAMED])) + (", ..." if len(ids) > NAMED else "")
