"""A generator for tests of streams: streets whose length and number of cars depend on the index, and scenes that fail on request."""

import os
import time

import numpy as np

from scenefactory_jax.core.raw_scene import Polyline, RawScene, SceneError, Track

STEPS = 12


def street(seed, index, *, unusable: list[int], broken: list[int], deadly: list[int], endless: list[int]) -> RawScene:
    """Makes street `index`: unusable scenes are refused, broken ones raise, deadly ones end the process, endless ones never return."""
    if index in unusable:
        raise SceneError(f"street {index}: nobody drives here")
    if index in broken:
        raise ZeroDivisionError("a bug")
    if index in deadly:
        os._exit(1)
    if index in endless:
        time.sleep(3600.0)
    x = np.arange(0.0, 60.0 + 4.0 * (index % 8), 1.0)
    line = lambda y: np.stack([x, np.full_like(x, y), 0 * x], axis=1)  # noqa: E731
    roads = [Polyline(2, line(0.0), 1), Polyline(15, line(4.0), 2), Polyline(15, line(-4.0), 3)]
    return RawScene(f"street {index}", "test", tuple(roads), tuple(map(_car, range(1 + index % 3))), 0.1 * np.arange(STEPS), 1)


def _car(number: int) -> Track:
    ahead = np.arange(STEPS, dtype=float)
    xyz = np.stack([2.0 + 9.0 * number + 0.5 * ahead, 0 * ahead, 0 * ahead], axis=1)
    velocity = np.tile([5.0, 0.0], (STEPS, 1))
    return Track(number, "vehicle", (4.0, 2.0, 1.5), xyz, 0 * ahead, velocity, np.ones(STEPS, bool))
