"""Traffic lights: phases that follow one another, and when people may walk."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES
from scenefactory_jax.data.generators.ranges import check_positive, draw
from scenefactory_jax.data.generators.town.road_network import Network

STATE = {name: index for index, name in enumerate(LIGHT_STATES)}
OPEN, CLOSING, CLOSED, SIGN = 0, 1, 2, 3  # what a gate says at a step


class Gates(NamedTuple):
    """What stops and crosswalks say at every step: first the network's stops, then its crosswalks."""

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
    walk_mps: float,
) -> Gates:
    """A cycle for every junction with lights, begun at a random moment.

    Args:
        green_s, yellow_s, clear_s: how long a phase is green and yellow, and how long all is red behind it.
        walk_mps: a crosswalk is open for as long as people at this speed get over it before its road has green again.

    Raises:
        ConfigError: a number that makes no sense, by name.
    """
    check_positive(walk_mps, "generate.signals.walk_mps")
    state = np.full((len(network.stops) + len(network.crosswalks), len(times)), OPEN)
    light = np.full(state.shape, -1)
    for index, stop in enumerate(network.stops):
        if stop.kind == "stop":
            state[index] = SIGN
    for junction, phases in network.phases.items():
        green = np.array([draw(rng, green_s, "signals.green_s", low=1.0) for _ in phases])
        yellow, clear = draw(rng, yellow_s, "signals.yellow_s"), draw(rng, clear_s, "signals.clear_s")
        starts = np.concatenate([[0.0], np.cumsum(green + yellow + clear)])
        now = np.mod(times + rng.uniform(0, starts[-1]), starts[-1])
        phase_of = {arm: p for p, arms in enumerate(phases) for arm in arms}
        for index, stop in enumerate(network.stops):
            if stop.junction == junction:
                since = np.mod(now - starts[phase_of[stop.arm]], starts[-1])
                red = green[phase_of[stop.arm]] + yellow
                shown = np.where(since < red - yellow, OPEN, np.where(since < red, CLOSING, CLOSED))
                state[index], light[index] = shown, _light(shown, arrow=stop.protected)
        for index, walk in enumerate(network.crosswalks, start=len(network.stops)):
            if walk.junction == junction:
                free = _may_walk(now, starts, phase_of[walk.arm], green, walk.ends, walk_mps, yellow + clear)
                state[index] = np.where(free, OPEN, CLOSED)
    return Gates(state, light)


def _light(shown: Int[np.ndarray, " L"], *, arrow: bool) -> Int[np.ndarray, " L"]:
    """WOMD's states of a light."""
    names = ("arrow_go", "arrow_caution", "arrow_stop") if arrow else ("go", "caution", "stop")
    return np.choose(shown, [STATE[name] for name in names])


def _may_walk(
    now: Float[np.ndarray, " L"],
    starts: Float[np.ndarray, " P"],
    own: int,
    green: Float[np.ndarray, " Q"],
    ends: Float[np.ndarray, "2 2"],
    speed: float,
    pause: float,
) -> Bool[np.ndarray, " L"]:
    """Whether there is time to cross a road before its traffic has green again, and it has stopped."""
    need = np.linalg.norm(ends[1] - ends[0]) / speed
    since = np.mod(now - starts[own], starts[-1])
    return (since > green[own] + pause) & (starts[-1] - since > need)
