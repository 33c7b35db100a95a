"""Rules on the tracks of vehicles: errors of perception. At most one finding a track and rule."""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.raw_scene import RawScene, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.data.curation.quality_gate import Finding

Excess = tuple[Int[np.ndarray, " K"], Float[np.ndarray, " K"]]  # steps, and what was measured there


def speed(raw: RawScene, *, max_speed_m_s: float) -> list[Finding]:
    """Positions of neighbouring steps that imply a higher speed."""

    def measure(track: Track) -> Excess:
        steps = _neighbours(track)
        way = np.linalg.norm(track.xyz[steps + 1, :2] - track.xyz[steps, :2], axis=1)
        return steps + 1, way / np.diff(raw.times)[steps]

    return _worst(raw, measure, max_speed_m_s, "moves at {:.1f} m/s")


def acceleration(raw: RawScene, *, max_acceleration_m_s2: float, over_s: float) -> list[Finding]:
    """Logged speeds that change faster, measured over `over_s` to average the noise of single steps."""
    stride = max(1, round(over_s / (float(np.median(np.diff(raw.times))) if len(raw.times) > 1 else np.inf)))

    def measure(track: Track) -> Excess:
        there = np.flatnonzero(track.valid[stride:] & track.valid[:-stride])
        value = np.linalg.norm(track.velocity, axis=1)
        return there + stride, np.abs(value[there + stride] - value[there]) / (raw.times[there + stride] - raw.times[there])

    return _worst(raw, measure, max_acceleration_m_s2, "changes its speed by {:.1f} m/s²")


def yaw_rate(raw: RawScene, *, max_yaw_rate_rad_s: float) -> list[Finding]:
    """Headings of neighbouring steps that imply a faster turn, such as a reversed box."""

    def measure(track: Track) -> Excess:
        steps = _neighbours(track)
        turn = np.abs(wrap_angles(track.yaw[steps + 1] - track.yaw[steps]))
        return steps + 1, turn / np.diff(raw.times)[steps]

    return _worst(raw, measure, max_yaw_rate_rad_s, "turns at {:.1f} rad/s")


def jumps(raw: RawScene, *, off_m: float, drift_m_s: float) -> list[Finding]:
    """Positions that differ from the one before plus velocity, also across a gap.

    Args:
        off_m: allowed between two steps.
        drift_m_s: allowed on top for every second of a gap.
    """

    def measure(track: Track) -> Excess:
        steps = np.flatnonzero(track.valid)
        before, after = steps[:-1], steps[1:]
        time = raw.times[after] - raw.times[before]
        expected = (track.velocity[before] + track.velocity[after]) / 2 * time[:, None]
        off = np.linalg.norm(track.xyz[after, :2] - track.xyz[before, :2] - expected, axis=1)
        gap = np.where(after - before > 1, time, 0.0)
        return after, off - drift_m_s * gap

    return _worst(raw, measure, off_m, "is {:.1f} m from where its velocity leads")


def frozen(raw: RawScene, *, steps: int, speed_m_s: float) -> list[Finding]:
    """Tracks that keep exactly one position although their velocity is not zero.

    Args:
        steps: allowed in a row.
        speed_m_s: smallest speed that counts as moving.
    """

    def measure(track: Track) -> Excess:
        pairs = _neighbours(track)
        still = np.zeros(len(track.valid), bool)
        moving = np.linalg.norm(track.velocity[pairs + 1], axis=1) > speed_m_s
        still[pairs + 1] = moving & (track.xyz[pairs + 1] == track.xyz[pairs]).all(axis=1)
        total = np.cumsum(still)
        run = total - np.maximum.accumulate(np.where(still, 0, total))
        return np.arange(len(run)), run.astype(float)

    return _worst(raw, measure, float(steps), "stays in place for {:.0f} steps while its velocity moves on")


def flicker(raw: RawScene, *, gaps: int) -> list[Finding]:
    """Tracks with more gaps."""

    def measure(track: Track) -> Excess:
        steps = np.flatnonzero(track.valid)
        returns = steps[1:][np.diff(steps) > 1]
        return returns, np.arange(1.0, len(returns) + 1)

    return _worst(raw, measure, float(gaps), "vanishes and comes back {:.0f} times")


def length(raw: RawScene, *, range_m: list[float]) -> list[Finding]:
    """Vehicles of a length outside of a range."""
    return _sizes(raw, 0, "long", range_m)


def width(raw: RawScene, *, range_m: list[float]) -> list[Finding]:
    """Vehicles of a width outside of a range."""
    return _sizes(raw, 1, "wide", range_m)


def _sizes(raw: RawScene, axis: int, word: str, range_m: list[float]) -> list[Finding]:
    found = []
    for track in _vehicles(raw):
        value, step = track.size[axis], int(np.argmax(track.valid))
        if not range_m[0] <= value <= range_m[1]:
            limit = range_m[0] if value < range_m[0] else range_m[1]
            found.append(Finding(f"vehicle {track.id} is {value:.2f} m {word}", value, limit, track.xyz[step], step, (track.id,)))
    return found


def _worst(raw: RawScene, measure: Callable[[Track], Excess], limit: float, words: str) -> list[Finding]:
    """The step of each vehicle at which the measure exceeds its limit by most."""
    found = []
    for track in _vehicles(raw):
        steps, values = measure(track)
        if len(values) and (value := float(values.max())) > limit:
            step = int(steps[np.argmax(values)])
            more = int((values > limit).sum())
            message = f"vehicle {track.id} {words.format(value)} at step {step}" + (f" ({more} steps in all)" if more > 1 else "")
            found.append(Finding(message, value, limit, track.xyz[step], step, (track.id,)))
    return found


def _vehicles(raw: RawScene) -> Iterator[Track]:
    return (track for track in raw.tracks if track.kind == "vehicle" and track.valid.any())


def _neighbours(track: Track) -> Int[np.ndarray, " K"]:
    """Valid steps that precede a valid step."""
    return np.flatnonzero(track.valid[1:] & track.valid[:-1])
