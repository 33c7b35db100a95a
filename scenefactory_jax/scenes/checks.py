"""What a scene must be before it is packed: refused by name where nothing can be done, repaired and counted where something can."""

from dataclasses import replace

import numpy as np

from scenefactory_jax.scenes.raw import Polyline, RawScene, SceneError, Track
from scenefactory_jax.types import DRIVABLE, STOP_SIGN

DUPLICATE_M = 1e-6  # points closer than this in the plane give no segment
NAMED = 5  # how many offenders a line names


def check(raw: RawScene, *, track_speed_limit_m_s: float, car_size_m: list[float]) -> tuple[RawScene, list[str]]:
    """A scene that can be packed, and one line for each kind of repair or finding.

    Args:
        raw: as a reader or a generator gave it.
        track_speed_limit_m_s: a track whose positions imply more than that in a step is reported as jumping.
        car_size_m: length, width, height given to objects whose logged size is not positive.

    Raises:
        SceneError: steps that disagree, no driving lane, or a number that is not finite, naming the file and the element.
    """
    _require_steps(raw)
    _require_finite(raw)
    lines: list[str] = []
    roads = _repair_roads(raw.roads, lines)
    if not any(line.kind in DRIVABLE for line in roads):
        found = ", ".join(map(str, sorted({line.kind for line in roads}))) or "none"
        raise SceneError(f"{raw.source}: roads: no driving lane (map elements {DRIVABLE}); the elements there are: {found}")
    tracks, sdc = _repair_tracks(raw, tuple(float(x) for x in car_size_m), lines)  # pyright: ignore[reportArgumentType]
    repaired = replace(raw, roads=roads, tracks=tracks, sdc=sdc)
    _report_jumps(repaired, track_speed_limit_m_s, lines)
    return repaired, lines


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


def _require_finite(raw: RawScene) -> None:
    """No NaN or infinity on the map, nor in a track's valid steps."""
    for index, line in enumerate(raw.roads):
        if not np.isfinite(line.xyz).all():
            point, axis = np.argwhere(~np.isfinite(line.xyz))[0]
            place = f"roads[{index}] (id {line.id}): xyz[{point}][{axis}]"
            raise SceneError(f"{raw.source}: {place}: {line.xyz[point, axis]} is not finite")
    for index, track in enumerate(raw.tracks):
        for name in ("xyz", "yaw", "velocity"):
            table = getattr(track, name).reshape(len(track.valid), -1)
            bad = ~np.isfinite(table) & track.valid[:, None]
            if bad.any():
                step, axis = np.argwhere(bad)[0]
                place = f"tracks[{index}] (id {track.id}): {name}[{step}]"
                raise SceneError(f"{raw.source}: {place}: {table[step, axis]} is not finite at a valid step")


def _repair_roads(roads: tuple[Polyline, ...], lines: list[str]) -> tuple[Polyline, ...]:
    """Without duplicate points, and without lines of fewer than two points, stop signs excepted."""
    kept, short, duplicates = [], 0, 0
    for line in roads:
        step = np.linalg.norm(np.diff(line.xyz[:, :2], axis=0), axis=1)
        different = np.concatenate([np.ones(min(len(line.xyz), 1), bool), step > DUPLICATE_M])
        duplicates += int((~different).sum())
        if different.sum() < (1 if line.kind == STOP_SIGN else 2):
            short += 1
            continue
        kept.append(line if different.all() else replace(line, xyz=line.xyz[different]))
    if duplicates:
        lines.append(f"duplicate points removed: {duplicates}")
    if short:
        lines.append(f"polylines of fewer than two points dropped: {short}")
    return tuple(kept)


def _repair_tracks(
    raw: RawScene, car_size: tuple[float, float, float], lines: list[str]
) -> tuple[tuple[Track, ...], int | None]:
    """Without tracks that are nowhere valid, with positive sizes, and zeros at invalid steps; the SDC's new index."""
    kept, sdc, empty, sizes, stale = [], None, 0, [], 0
    for index, track in enumerate(raw.tracks):
        if not track.valid.any():
            empty += 1
            continue
        if index == raw.sdc:
            sdc = len(kept)
        if not (np.all(np.isfinite(track.size)) and min(track.size) > 0):
            sizes.append(track.id)
            track = replace(track, size=car_size)
        hidden = ~track.valid
        if any(np.any(table[hidden] != 0) for table in (track.xyz, track.yaw, track.velocity)):
            stale += 1
            mask = track.valid[:, None]
            xyz, velocity = np.where(mask, track.xyz, 0.0), np.where(mask, track.velocity, 0.0)
            track = replace(track, xyz=xyz, yaw=np.where(track.valid, track.yaw, 0.0), velocity=velocity)
        kept.append(track)
    if empty:
        lines.append(f"tracks without a valid step dropped: {empty}")
    if sizes:
        lines.append(f"sizes that are not positive replaced by {car_size}: {len(sizes)} (ids {_some(sizes)})")
    if stale:
        lines.append(f"tracks with values at invalid steps zeroed there: {stale}")
    return tuple(kept), sdc


def _report_jumps(raw: RawScene, limit_m_s: float, lines: list[str]) -> None:
    """Tracks whose positions imply more than the limit between two neighbouring valid steps."""
    steps, ids = 0, []
    for track in raw.tracks:
        pairs = track.valid[1:] & track.valid[:-1]
        speed = np.linalg.norm(np.diff(track.xyz[:, :2], axis=0), axis=1) / np.diff(raw.times)
        if jumps := int((pairs & (speed > limit_m_s)).sum()):
            steps += jumps
            ids.append(track.id)
    if ids:
        lines.append(f"track jumps above {limit_m_s:g} m/s: {steps} steps (ids {_some(ids)})")


def _some(ids: list[int]) -> str:
    return ", ".join(map(str, ids[:NAMED])) + (", ..." if len(ids) > NAMED else "")
