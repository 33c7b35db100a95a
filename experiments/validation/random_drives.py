"""Random drives of one car: start speed, friction under each wheel, and controls, as arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.instantiate import check_number, check_numbers

# Wheels (front left, front right, rear left, rear right) that stand on the slippery part of the road
PATTERNS = np.array(
    [
        [0, 0, 0, 0],  # a road of one friction
        [1, 0, 1, 0],
        [0, 1, 0, 1],
        [1, 1, 0, 0],
        [0, 0, 1, 1],
        [1, 0, 0, 0],
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
    ],
    bool,
)
PATTERN_NAMES = ("even", "left", "right", "front", "rear", "front left", "front right", "rear left", "rear right")
EXTREMES = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [1, 1, 0], [1, -1, 0], [0, 1, 1], [0, -1, 1]], np.float64)


class Sequences(NamedTuple):
    """N drives of T control steps."""

    speed: Float[np.ndarray, " N"]  # at the start, m/s
    friction: Float[np.ndarray, " N"]  # of the road
    pattern: Int[np.ndarray, " N"]  # row of PATTERNS
    controls: Float[np.ndarray, "N T 3"]  # throttle, steer, brake in [-1, 1]


def draw(
    seed: int,
    *,
    count: int,
    seconds: float,
    control_hz: float,
    speed_max: float,
    friction_min: float,
    friction_max: float,
    patterned_share: float,
    extreme_share: float,
    hold_min_s: float,
    hold_max_s: float,
) -> Sequences:
    """Drives that do not depend on one another: the first ones stay the same when more are drawn.

    Args:
        speed_max: start speeds are uniform from 0 to here, m/s.
        friction_min: friction is uniform between this and `friction_max`.
        patterned_share: of drives on a road that is slippery under some wheels, each pattern as often.
        extreme_share: of holds with full brake, full throttle or full lock; the others are uniform in all three controls.
        hold_min_s: controls are held for a time uniform between this and `hold_max_s`.

    Raises:
        ConfigError: no drive, or a range whose end is below its start.
    """
    where = "validation.drives.draw"
    check_number(count, where=f"{where}.count", least=1.0)
    check_numbers({"speed_max": speed_max, "friction_min": friction_min}, where=where, least=0.0)
    check_number(friction_max, where=f"{where}.friction_max", least=friction_min)
    check_number(hold_min_s, where=f"{where}.hold_min_s", above=0.0)
    check_number(hold_max_s, where=f"{where}.hold_max_s", least=hold_min_s)
    steps = round(seconds * control_hz)
    rows = []
    for child in np.random.SeedSequence(seed).spawn(count):
        rng = np.random.default_rng(child)
        pattern = int(rng.integers(1, len(PATTERNS))) if rng.random() < patterned_share else 0
        speed, friction = rng.uniform(0.0, speed_max), rng.uniform(friction_min, friction_max)
        holds = rng.uniform(hold_min_s, hold_max_s, int(np.ceil(seconds / hold_min_s)))
        held = np.searchsorted(np.cumsum(holds), np.arange(steps) / control_hz, side="right")
        plain = rng.uniform(-1.0, 1.0, (len(holds), 3))
        extreme = EXTREMES[rng.integers(0, len(EXTREMES), len(holds))]
        levels = np.where(rng.random((len(holds), 1)) < extreme_share, extreme, plain)
        rows.append((speed, friction, pattern, levels[held]))
    speed, friction, pattern, controls = zip(*rows, strict=True)
    # single precision, so that both engines get the same numbers
    start, road, actions = (np.array(column, np.float32) for column in (speed, friction, controls))
    return Sequences(start, road, np.array(pattern, np.int32), actions)


def describe(cases: Sequences, index: int) -> str:
    """One drive in words, for tables of worst cases."""
    pattern = PATTERN_NAMES[cases.pattern[index]]
    return f"sequence {index}: {cases.speed[index]:.1f} m/s, friction {cases.friction[index]:.2f}, {pattern}"
