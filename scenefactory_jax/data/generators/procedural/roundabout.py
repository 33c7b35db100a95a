"""A one-lane roundabout, driven counter-clockwise."""

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.generators.curves import FINE_M, connect, heading
from scenefactory_jax.data.generators.procedural.intersections import Arm, build_arm
from scenefactory_jax.data.generators.procedural.road_layout import Lane, Layout, Style, check_positive, check_range, draw

WIDEST_SPLIT = np.radians(35.0)  # between an arm and the points where its cars leave and join the ring
SPLIT_SHARE = 0.4  # of the angle to the next arm


def roundabout(
    rng: np.random.Generator,
    style: Style,
    *,
    arms: list[int],
    ring_radius_m: list[float],
    ring_width_m: list[float],
    arm_length_m: list[float],
    bend_radius_m: float,
    skew_deg: float,
) -> Layout:
    """A ring with two arms or more of one lane a direction. `ring_radius_m` is that of the ring's lane centre.

    Raises:
        ConfigError: too many arms for the ring.
    """
    check_range(arms, "roundabout.arms", low=2.0)
    check_positive(bend_radius_m, "roundabout.bend_radius_m")
    count = int(rng.integers(arms[0], arms[1] + 1))
    radius = draw(rng, ring_radius_m, "roundabout.ring_radius_m", low=5.0)
    width = draw(rng, ring_width_m, "roundabout.ring_width_m", low=1.0)
    skew = np.radians(rng.uniform(-skew_deg, skew_deg, count))
    yaws = 2 * np.pi / count * np.arange(count) + skew
    narrowest = np.min(np.mod(np.roll(yaws, -1) - yaws, 2 * np.pi))
    split = min(WIDEST_SPLIT, SPLIT_SHARE * narrowest)
    if (gap := radius * np.sin(split) - style.width / 2) < 2.0:
        raise ConfigError(f"roundabout.ring_radius_m: {radius:.1f} m is too small for {count} arms: entry and exit lie {gap:.1f} m apart")
    # entry and exit are arcs where the mouth lies at this distance: the chord then makes half the turn's angle with the arm
    mouth = radius * np.cos(split) + (radius * np.sin(split) - style.width / 2) / np.tan((np.pi / 2 - split) / 2)
    ways = [
        build_arm(yaw, mouth, draw(rng, arm_length_m, "roundabout.arm_length_m", low=1.0), rng.uniform(-1, 1) / bend_radius_m, 1, 1, style)
        for yaw in yaws
    ]
    return _assemble(ways, radius, width, split, style)


def _assemble(arms: list[Arm], radius: float, width: float, split: float, style: Style) -> Layout:
    """Six lanes an arm: incoming, outgoing, entry, exit, the ring before the arm and the ring from this arm to the next."""
    lanes: list[Lane] = []
    for index, arm in enumerate(arms):
        base, following = 6 * index, 6 * ((index + 1) % len(arms))
        leave, join = arm.yaw - split, arm.yaw + split
        next_leave = arms[(index + 1) % len(arms)].yaw - split
        before, after = _ring(radius, leave, join), _ring(radius, join, join + np.mod(next_leave - join, 2 * np.pi))
        entry = connect(arm.incoming[0][-1], arm.yaw + np.pi, after[0], join + np.pi / 2)
        leaving = connect(before[0], leave + np.pi / 2, arm.outgoing[0][0], arm.yaw)
        lanes += [
            Lane(arm.incoming[0], style.width, style.limit, (base + 2,)),
            Lane(arm.outgoing[0], style.width, style.limit),
            Lane(entry, style.width, style.limit, (base + 5,)),
            Lane(leaving, style.width, style.limit, (base + 1,)),
            Lane(before, width, style.limit, (base + 5,)),
            Lane(after, width, style.limit, (following + 3, following + 4)),
        ]
    return Layout(lanes, [line for arm in arms for line in arm.lines])


def _ring(radius: float, start: float, end: float) -> np.ndarray:
    """A piece of the ring, counter-clockwise."""
    angle = np.linspace(start, end, max(3, round(radius * (end - start) / FINE_M)))
    return radius * heading(angle)
