"""Random encounters of two cars: rear-end, head-on, side, glancing, and near misses, as arrays.

Two boxes that do not turn and move at constant velocity meet exactly if their miss distance, across the relative velocity, is below
the sum of their half widths in that direction. So every kind of encounter is a range of headings and a range of that ratio, 1 being the
border between a hit and a miss. Braking and sliding move cars off these straight lines: the kind is what the encounter was meant to be.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.instantiate import check_number, check_numbers

KINDS = ("rear_end", "head_on", "side", "glancing", "near_miss")
RATIOS = {"rear_end": (0.0, 0.85), "head_on": (0.0, 0.85), "side": (0.0, 0.9), "glancing": (0.85, 0.995), "near_miss": (1.005, 1.1)}
HEADINGS = {"rear_end": (0.0, 0.2), "head_on": (np.pi, 0.3), "side": (np.pi / 2, 0.6)}  # of the second car: centre, half range, rad


class Encounters(NamedTuple):
    """N encounters of two cars over T control steps."""

    kind: Int[np.ndarray, " N"]  # index into KINDS
    position: Float[np.ndarray, "N 2 2"]
    yaw: Float[np.ndarray, "N 2"]
    speed: Float[np.ndarray, "N 2"]  # m/s
    friction: Float[np.ndarray, " N"]  # of the road, the same under all wheels
    controls: Float[np.ndarray, "N T 2 3"]


def draw(
    seed: int,
    *,
    count: int,
    seconds: float,
    control_hz: float,
    size: tuple[float, float] | list[float],
    speed_max: float,
    closing_min: float,
    friction_min: float,
    friction_max: float,
    parked_share: float,
    braking_share: float,
    lead_min_s: float,
    lead_max_s: float,
) -> Encounters:
    """Encounters in turn of every kind, independent of one another: the first ones stay the same when more are drawn.

    Args:
        size: length and width of both cars, m.
        speed_max: of either car, m/s.
        closing_min: smallest relative speed, m/s.
        parked_share: of encounters with the second car at rest.
        braking_share: of cars that brake, at a fifth to the whole of their brakes.
        lead_min_s: the cars meet (or pass) between this and `lead_max_s` after the start, at constant velocity.

    Raises:
        ConfigError: no encounter, ranges without an end above their start, or a relative speed that no two cars have.
    """
    where = "validation.encounters.draw"
    check_number(count, where=f"{where}.count", least=1.0)
    check_numbers({"closing_min": closing_min, "friction_min": friction_min, "lead_min_s": lead_min_s}, where=where, least=0.0)
    check_number(speed_max, where=f"{where}.speed_max", above=closing_min)
    check_number(friction_max, where=f"{where}.friction_max", least=friction_min)
    check_number(lead_max_s, where=f"{where}.lead_max_s", least=lead_min_s)
    steps = round(seconds * control_hz)
    rows = []
    for index, child in enumerate(np.random.SeedSequence(seed).spawn(count)):
        rng = np.random.default_rng(child)
        kind = KINDS[index % len(KINDS)]
        yaw, speed = _approach(rng, kind, speed_max=speed_max, closing_min=closing_min, parked_share=parked_share)
        ratio = rng.uniform(*RATIOS[kind]) * rng.choice([-1.0, 1.0])
        position = _starts(np.asarray(size, float) / 2.0, yaw, speed, ratio, rng.uniform(lead_min_s, lead_max_s))
        turn = rng.uniform(-np.pi, np.pi)
        c, s = np.cos(turn), np.sin(turn)
        position = position @ np.array([[c, s], [-s, c]])
        brake = np.where(rng.random(2) < braking_share, rng.uniform(0.2, 1.0, 2), 0.0)
        controls = np.zeros((steps, 2, 3))
        controls[:, :, 2] = brake
        heading = (yaw + turn + np.pi) % (2 * np.pi) - np.pi
        rows.append((KINDS.index(kind), position, heading, speed, rng.uniform(friction_min, friction_max), controls))
    kind, *columns = zip(*rows, strict=True)
    # single precision, so that both engines get the same numbers
    return Encounters(np.array(kind, np.int32), *(np.array(column, np.float32) for column in columns))


def _approach(
    rng: np.random.Generator, kind: str, *, speed_max: float, closing_min: float, parked_share: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Headings, the first along +x, and speeds."""
    family = kind if kind in HEADINGS else str(rng.choice(list(HEADINGS)))
    centre, around = HEADINGS[family]
    heading = (centre + rng.uniform(-around, around)) * rng.choice([-1.0, 1.0])
    parked = rng.random() < parked_share
    while True:
        first, second = rng.uniform(0.0, speed_max), 0.0 if parked else rng.uniform(0.0, speed_max)
        if family == "rear_end" and first < second:
            continue
        if np.hypot(first - second * np.cos(heading), second * np.sin(heading)) >= closing_min:
            return np.array([0.0, heading]), np.array([first, second])


def _starts(
    half: Float[np.ndarray, "2"], yaw: Float[np.ndarray, "2"], speed: Float[np.ndarray, "2"], ratio: float, lead_s: float
) -> Float[np.ndarray, "2 2"]:
    """Where the cars start, so that they meet after `lead_s`, or pass at their nearest after it."""
    axes = np.stack([np.cos(yaw), np.sin(yaw), -np.sin(yaw), np.cos(yaw)], -1).reshape(2, 2, 2)  # car, along and across, xy
    velocity = speed[:, None] * axes[:, 0]
    relative = velocity[1] - velocity[0]
    ahead = relative / np.linalg.norm(relative)
    across = np.array([-ahead[1], ahead[0]])
    miss = ratio * _reach(half, axes, across)
    every = axes.reshape(4, 2)
    reach = np.array([_reach(half, axes, axis) for axis in every])
    rate, offset = every @ relative, every @ (miss * across)
    # the second car's way in the first one's frame enters the slab |along axis| < reach at this time, 0 being the nearest point
    parallel = np.abs(rate) < 1e-9
    enter = np.where(parallel, -np.inf, (-np.sign(rate) * reach - offset) / np.where(parallel, 1.0, rate))
    begin = enter.max() if abs(ratio) < 1.0 else 0.0
    apart = miss * across + (begin - lead_s) * relative
    middle = -lead_s * velocity.mean(0)  # they meet around the origin
    return np.stack([middle - apart / 2, middle + apart / 2])


def _reach(half: Float[np.ndarray, "2"], axes: Float[np.ndarray, "2 2 2"], direction: Float[np.ndarray, "2"]) -> float:
    """Sum of the boxes' half extents along a unit vector."""
    return float((np.abs(axes @ direction) @ half).sum())


def describe(cases: Encounters, index: int) -> str:
    """One encounter in words, for tables of worst cases."""
    one, two = cases.speed[index]
    brake = cases.controls[index, 0, :, 2]
    angle = np.rad2deg((cases.yaw[index, 1] - cases.yaw[index, 0] + np.pi) % (2 * np.pi) - np.pi)
    name = KINDS[cases.kind[index]]
    return (
        f"encounter {index}: {name}, {one:.1f} and {two:.1f} m/s at {angle:.0f} deg, "
        f"friction {cases.friction[index]:.2f}, brakes {brake[0]:.1f} {brake[1]:.1f}"
    )
