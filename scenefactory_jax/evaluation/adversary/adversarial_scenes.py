"""Adversarial scenes as scenes: the recorded tracks of adversaries are replaced by those of an attack."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from scenefactory_jax.core.raw_scene import RawScene, Track
from scenefactory_jax.data.packing.pack import PackReport
from scenefactory_jax.evaluation.adversary.search import Attack

SUFFIX = "-adversarial"


def make_scene(report: PackReport, attack: Attack, *, ego: str, solvers: Iterable[str], step_s: float) -> RawScene:
    """Makes the scene of a successful attack; its road, lights and other tracks are those of the attacked one.

    Args:
        report: of the packed scene, with its source.
        attack: of this world, on the host.
        ego: name of the planner that was attacked.
        solvers: names of those that avoid the collision.
        step_s: of the log.
    """
    raw, tracks = report.raw, {}
    assert raw is not None
    number = {track.id: index for index, track in enumerate(raw.tracks)}
    for slot in np.flatnonzero(attack.chosen.eligible).tolist():
        index = number[report.traffic_ids[int(attack.chosen.row[slot])]]
        tracks[index] = replace_track(raw.tracks[index], attack, slot, start=raw.current, centre=np.array(report.centre))
    hit = number[report.traffic_ids[int(attack.outcome.contact.row)]]
    metadata = {
        **raw.metadata,
        "adversarial_of": raw.name,
        "attacked": ego,
        "avoided_by": sorted(solvers),
        "adversary": raw.tracks[hit].id,
        "collision_s": float(attack.outcome.contact.step) * step_s,
    }
    changed = tuple(tracks.get(index, track) for index, track in enumerate(raw.tracks))
    return replace(raw, name=f"{raw.name}{SUFFIX}", tracks=changed, metadata=metadata)


def replace_track(track: Track, attack: Attack, slot: int, *, start: int, centre: np.ndarray) -> Track:
    """Replaces the states of a track from the start on, and ends it with the attack; heights stay, and are held where the log has none."""
    count = min(attack.track.yaw.shape[1], len(track.valid) - start)
    rows = slice(start, start + count)
    present = np.asarray(attack.chosen.present[slot, :count])
    xyz, yaw, velocity, valid = track.xyz.copy(), track.yaw.copy(), track.velocity.copy(), track.valid.copy()
    known = np.maximum.accumulate(np.where(track.valid[rows], np.arange(count), 0))
    height = track.xyz[rows, 2][known]
    place = np.asarray(attack.track.position[slot, :count], float) + centre[:2]
    xyz[rows] = np.where(present[:, None], np.column_stack([place, height]), 0.0)
    yaw[rows] = np.where(present, np.asarray(attack.track.yaw[slot, :count], float), 0.0)
    velocity[rows] = np.where(present[:, None], np.asarray(attack.track.velocity[slot, :count], float), 0.0)
    valid[rows] = present
    valid[start + count :] = False  # else it jumps back to its log
    return replace(track, xyz=xyz, yaw=yaw, velocity=velocity, valid=valid)
