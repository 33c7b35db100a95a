"""Draws the cycles of traffic lights and the times at which pedestrians may cross."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES
from scenefactory_jax.core.schema import Positive
from scenefactory_jax.data.generators.ranges import draw
from scenefactory_jax.data.generators.town.road_network import Network

LIGHTS = {False: ("go", "caution", "stop"), True: ("arrow_go", "arrow_caution", "arrow_stop")}  # by whether it is an arrow
OPEN, CLOSING, CLOSED, SIGN = 0, 1, 2, 3  # states of a gate


class Gates(NamedTuple):
    """States of the stops and then of the crosswalks of a network, at every step."""

    state: Int[np.ndarray, "G L"]  # OPEN, CLOSING, CLOSED or SIGN
    light: Int[np.ndarray, "G L"]  # index into LIGHT_STATES; -1 where there is no light


def draw_gates(
    rng: np.random.Generator,
    network: Network,
    times: Float[np.ndarray, " L"],
    *,
    green_s: list[float],
    yellow_s: list[float],
    clear_s: list[float],
    walk_mps: Positive,
) -> Gates:
    """Draws a cycle for every junction with lights, with a random start.

    Args:
        green_s, yellow_s, clear_s: durations of green, of yellow, and of red for all arms after each phase.
        walk_mps: a crosswalk is open while pedestrians with this speed can cross before its road has green again.

    Raises:
        ConfigError: a number out of range.
    """
    state = np.full((len(network.stops) + len(network.crosswalks), len(times)), OPEN)
    light = np.full(state.shape, -1)
    for index, stop in enumerate(network.stops):
        if stop.kind == "stop":
            state[index] = SIGN
    for junction, phases in network.phases.items():
        green = np.array([draw(rng, green_s, "traffic_lights.green_s", low=1.0) for _ in phases])
        yellow, clear = draw(rng, yellow_s, "traffic_lights.yellow_s"), draw(rng, clear_s, "traffic_lights.clear_s")
        starts = np.concatenate([[0.0], np.cumsum(green + yellow + clear)])
        now = np.mod(times + rng.uniform(0, starts[-1]), starts[-1])
        phase_of = {arm: p for p, arms in enumerate(phases) for arm in arms}
        for index, stop in enumerate(network.stops):
            if stop.junction == junction:
                since = np.mod(now - starts[phase_of[stop.arm]], starts[-1])
                red = green[phase_of[stop.arm]] + yellow
                state[index] = np.where(since < red - yellow, OPEN, np.where(since < red, CLOSING, CLOSED))
                light[index] = np.choose(state[index], [LIGHT_STATES.index(name) for name in LIGHTS[stop.protected]])
        for index, walk in enumerate(network.crosswalks, start=len(network.stops)):
            if walk.junction == junction:
                phase, duration = phase_of[walk.arm], float(np.linalg.norm(walk.ends[1] - walk.ends[0])) / walk_mps
                is_open = _may_walk(now, starts, phase, float(green[phase]) + (yellow + clear), duration)
                state[index] = np.where(is_open, OPEN, CLOSED)
    return Gates(state, light)


def _may_walk(
    now: Float[np.ndarray, " L"], starts: Float[np.ndarray, " P"], phase: int, blocked_s: float, duration_s: float
) -> Bool[np.ndarray, " L"]:
    """Computes when a crossing of the given duration is possible: after the phase of the road and before it starts again."""
    since = np.mod(now - starts[phase], starts[-1])
    return (since > blocked_s) & (starts[-1] - since > duration_s)
