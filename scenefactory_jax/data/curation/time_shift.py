"""Scenes in which all others, and the lights, are where they were a moment earlier or later: the same streets with other encounters."""

from dataclasses import replace

import numpy as np
from jaxtyping import Shaped

from scenefactory_jax.core.raw_scene import Light, LightPlan, RawScene, Track


def shift_others(raw: RawScene, seconds: float) -> RawScene:
    """Copy of a scene in which the recording car meets the others as they were so many seconds later, named NAME-later1.5s.

    Below 0: earlier, NAME-earlier1.5s. Where the log says nothing of them, at its end or start, they are not valid. The shift is rounded to
    steps of the log.
    """
    steps = round(seconds / float(np.median(np.diff(raw.times))))
    tracks = tuple(track if index == raw.sdc else _shift_track(track, steps) for index, track in enumerate(raw.tracks))
    return replace(
        raw,
        name=f"{raw.name}-{'later' if seconds > 0.0 else 'earlier'}{abs(seconds):g}s",
        tracks=tracks,
        lights=tuple(_shift_light(light, steps, seconds) for light in raw.lights),
        metadata={**raw.metadata, "others_shifted_s": seconds},
    )


def _shift_track(track: Track, steps: int) -> Track:
    return replace(track, **{name: _shift(getattr(track, name), steps) for name in ("xyz", "yaw", "velocity", "valid")})


def _shift_light(light: Light, steps: int, seconds: float) -> Light:
    plan = light.plan
    if plan is not None:
        start = (plan.start_s - seconds) % plan.period_s
        order = np.argsort(start, kind="stable")
        plan = LightPlan(start[order], plan.state[order], plan.period_s)
    return replace(light, state=_shift(light.state, steps), valid=_shift(light.valid, steps), plan=plan)


def _shift(rows: Shaped[np.ndarray, "L *D"], steps: int) -> Shaped[np.ndarray, "L *D"]:
    """Rows so many steps later in the log; zeros beyond it."""
    shifted = np.zeros_like(rows)
    kept = max(len(rows) - abs(steps), 0)
    first = max(-steps, 0)
    shifted[first : first + kept] = rows[max(steps, 0) :][:kept]
    return shifted
