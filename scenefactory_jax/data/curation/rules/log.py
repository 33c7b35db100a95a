"""Rules on the log as a whole: times, recording car, ids, and vehicles that overlap at its start."""

from collections import Counter

import numpy as np
import shapely

from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data.curation.quality_gate import Finding
from scenefactory_jax.data.packing.pack import box_corners


def times(raw: RawScene, *, tolerance_fraction: float) -> list[Finding]:
    """Steps whose length differs from the median step by more than a fraction of it."""
    step = np.diff(raw.times)
    if not len(step):
        return []
    usual = float(np.median(step))
    off = np.abs(step - usual) / usual if usual > 0 else np.full(len(step), np.inf)
    worst = int(np.argmax(off))
    if off[worst] <= tolerance_fraction:
        return []
    message = f"{int((off > tolerance_fraction).sum())} steps of the log are not {usual:.3g} s long; step {worst} is {step[worst]:.3g} s"
    return [Finding(message, float(off[worst]), tolerance_fraction, step=worst)]


def sdc(raw: RawScene, *, without: list[str]) -> list[Finding]:
    """The car that recorded the log is missing, or not valid at the current step.

    Args:
        without: datasets that have no such car.
    """
    if raw.metadata.get("dataset") in without:
        return []
    if raw.sdc is None:
        return [Finding("no track is named as the car that recorded the log", 0.0, 1.0)]
    track = raw.tracks[raw.sdc]
    if track.valid[raw.current]:
        return []
    message = f"the car that recorded the log (id {track.id}) is absent at the current step {raw.current}"
    return [Finding(message, 0.0, 1.0, step=raw.current, objects=(track.id,))]


def track_ids(raw: RawScene) -> list[Finding]:
    """Ids of several tracks: an id must name one object."""
    counts = Counter(track.id for track in raw.tracks)
    return [
        Finding(f"{number} tracks have the id {identity}", float(number), 1.0, objects=(identity,))
        for identity, number in counts.items()
        if number > 1
    ]


def overlapping_starts(raw: RawScene, *, min_overlap_fraction: float) -> list[Finding]:
    """Vehicles whose boxes overlap at the current step, by a fraction of the smaller box."""
    tracks = [track for track in raw.tracks if track.kind == "vehicle" and track.valid[raw.current]]
    now = raw.current
    boxes = np.array([shapely.Polygon(box_corners(t.xyz[now, :2], float(t.yaw[now]), *t.size[:2])) for t in tracks], dtype=object)
    if len(boxes) < 2:
        return []
    one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    one, other = one[one < other], other[one < other]
    area = shapely.area(boxes)
    common = shapely.area(shapely.intersection(boxes[one], boxes[other])) / np.minimum(area[one], area[other])
    found = []
    for first, second, part in zip(one, other, common, strict=True):
        a, b = tracks[first], tracks[second]
        if part > min_overlap_fraction and abs(a.xyz[now, 2] - b.xyz[now, 2]) < (a.size[2] + b.size[2]) / 2:  # in height, too
            ids, place = (a.id, b.id), (a.xyz[now] + b.xyz[now]) / 2
            message = f"vehicles {ids[0]} and {ids[1]} share {100 * part:.0f} % of the smaller box at the current step"
            found.append(Finding(message, float(part), min_overlap_fraction, place, now, ids))
    return found
