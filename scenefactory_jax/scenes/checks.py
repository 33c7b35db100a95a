"""What a scene must be before it is packed: refused by name where nothing can be done, repaired and counted where something can."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scenefactory_jax.scenes.logs import Logs, Points, joined, lengths, stacked
from scenefactory_jax.scenes.raw import Polyline, RawScene, SceneError, Track
from scenefactory_jax.types import DRIVABLE, STOP_SIGN

DUPLICATE_M = 1e-6  # points closer than this in the plane give no segment
ELEMENTS = (*range(4), *range(5, 21))  # WOMD's map element ids, those of unknown lanes, lines and edges among them
NAMED = 5  # how many offenders a line names


def check(
    raw: RawScene, *, track_speed_limit_m_s: float, car_size_m: list[float], most_m: float = 1e7
) -> tuple[RawScene, list[str]]:
    """A scene that can be packed, and one line for each kind of repair or finding.

    Args:
        raw: as a reader or a generator gave it.
        track_speed_limit_m_s: a track whose positions imply more than that in a step is reported as jumping.
        car_size_m: length, width, height given to objects whose logged size is not positive.
        most_m: no coordinate, size or speed is larger; the configs of older runs do not say it.

    Raises:
        SceneError: steps that disagree, no driving lane, or a number that is not finite or too large, naming the file and the element.
    """
    _require_steps(raw)
    points, logs = joined(raw.roads), stacked(raw.tracks, len(raw.times))
    _require_map(raw, points, most_m)
    _require_tracks(raw, logs, most_m)
    lines: list[str] = []
    whole = _repair_roads(raw.roads, points, lines)
    roads = _known(whole, lines)
    if not any(line.kind in DRIVABLE for line in roads):
        found = ", ".join(map(str, sorted({line.kind for line in whole}))) or "none"
        raise SceneError(f"{raw.source}: roads: no driving lane (map elements {DRIVABLE}); the elements there are: {found}")
    tracks, sdc = _repair_tracks(raw, logs, tuple(float(x) for x in car_size_m), lines)  # pyright: ignore[reportArgumentType]
    _report_jumps(raw, logs, track_speed_limit_m_s, lines)
    return replace(raw, roads=roads, tracks=tracks, sdc=sdc), lines


def _require_steps(raw: RawScene) -> None:
    """Times rise, the current step is one of them, and every track has all of them."""
    steps = len(raw.times)
    if not np.all(np.isfinite(raw.times)) or np.any(np.diff(raw.times) <= 0):
        raise SceneError(f"{raw.source}: times: they must be finite and rise from step to step")
    if not 0 <= raw.current < steps:
        raise SceneError(f"{raw.source}: current: {raw.current} is no step of the log; valid: 0 to {steps - 1}")
    if raw.sdc is not None and not 0 <= raw.sdc < len(raw.tracks):
        raise SceneError(f"{raw.source}: sdc: {raw.sdc} is no track; valid: 0 to {len(raw.tracks) - 1}")
    for index, track in enumerate(raw.tracks):
        if not len(track.valid) == len(track.xyz) == len(track.yaw) == len(track.velocity) == steps:
            raise SceneError(f"{raw.source}: tracks[{index}] (id {track.id}): {len(track.valid)} steps; the log has {steps}")


def _require_map(raw: RawScene, points: Points, most: float) -> None:
    """No NaN, infinity or absurd number on the map."""
    bad = ~(np.abs(points.xyz) <= most)
    if bad.any():
        row, axis = np.argwhere(bad)[0]
        index = int(np.searchsorted(points.bounds, row, side="right")) - 1
        place = f"roads[{index}] (id {raw.roads[index].id}): xyz[{row - points.bounds[index]}][{axis}]"
        raise SceneError(f"{raw.source}: {place}: {_fault(float(points.xyz[row, axis]), most)}")


def _require_tracks(raw: RawScene, logs: Logs, most: float) -> None:
    """No NaN, infinity or absurd number in a track's valid steps, and no absurd size."""
    found = []
    for name in ("xyz", "yaw", "velocity"):
        table = getattr(logs, name).reshape(*logs.valid.shape, -1)
        bad = ~(np.abs(table) <= most) & logs.valid[..., None]
        if bad.any():
            index, step, axis = np.argwhere(bad)[0]
            found.append((int(index), f"{name}[{step}]: {_fault(float(table[index, step, axis]), most)}"))
    huge = np.isfinite(logs.size) & (logs.size > most)  # what is not finite is repaired
    found += [(int(index), f"size[{axis}]: {_fault(float(logs.size[index, axis]), most)}") for index, axis in np.argwhere(huge)[:1]]
    if found:
        index, place = min(found, key=lambda one: one[0])
        raise SceneError(f"{raw.source}: tracks[{index}] (id {raw.tracks[index].id}): {place}")


def _fault(value: float, most: float) -> str:
    """What is wrong with a number."""
    if not np.isfinite(value):
        return f"{value} is not finite"
    return f"{value:g} is more than any map has; valid: up to {most:g} (scenes.check.most_m)"


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
    different[1:] = lengths(np.diff(points.xyz[:, :2], axis=0)) > DUPLICATE_M
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
        speed = lengths(np.diff(logs.xyz[..., :2], axis=1)) / np.diff(raw.times)
    jumps = (pairs & (speed > limit_m_s)).sum(axis=1)
    if jumps.any():
        ids = [raw.tracks[index].id for index in np.flatnonzero(jumps)]
        lines.append(f"track jumps above {limit_m_s:g} m/s: {jumps.sum()} steps (ids {_some(ids)})")


def _some(ids: Sequence[int | str]) -> str:
    return ", ".join(map(str, ids[:NAMED])) + (", ..." if len(ids) > NAMED else "")
