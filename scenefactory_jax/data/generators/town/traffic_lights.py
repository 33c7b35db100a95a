"""Draws the cycles of traffic lights and the times at which pedestrians may cross."""

from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES, LightPlan
from scenefactory_jax.core.schema import Bounds, Positive, Range
from scenefactory_jax.data.generators.town.road_network import Network

LIGHTS = {False: ("go", "caution", "stop"), True: ("arrow_go", "arrow_caution", "arrow_stop")}  # by whether it is an arrow
OPEN, CLOSING, CLOSED, SIGN = 0, 1, 2, 3  # states of a gate


class Gates(NamedTuple):
    """States of the stops and then of the crosswalks of a network, at every step."""

    state: Int[np.ndarray, "G L"]  # OPEN, CLOSING, CLOSED or SIGN
    light: Int[np.ndarray, "G L"]  # index into LIGHT_STATES; -1 where there is no light
    plans: dict[int, LightPlan]  # of the stops with a light


def draw_gates(
    rng: np.random.Generator,
    network: Network,
    times: Float[np.ndarray, " L"],
    *,
    green_s: Annotated[tuple[float, float], Bounds(min=1, is_range=True)],
    yellow_s: Range,
    clear_s: Range,
    walk_mps: Positive,
) -> Gates:
    """Draws a cycle for every junction with lights, with a random start."""
    state = np.full((len(network.stops) + len(network.crosswalks), len(times)), OPEN)
    light = np.full(state.shape, -1)
    plans: dict[int, LightPlan] = {}
    state[[index for index, stop in enumerate(network.stops) if stop.kind == "stop"]] = SIGN
    for junction, phases in network.phases.items():
        green = np.array([rng.uniform(*green_s) for _ in phases])
        yellow, clear = rng.uniform(*yellow_s), rng.uniform(*clear_s)
        starts = np.concatenate([[0.0], np.cumsum(green + yellow + clear)])
        cycle = float(starts[-1])
        offset = rng.uniform(0, cycle)
        now = np.mod(times + offset, cycle)
        phase_of = {arm: p for p, arms in enumerate(phases) for arm in arms}
        for index, stop in enumerate(network.stops):
            if stop.junction == junction:
                phase = phase_of[stop.arm]
                since, red = np.mod(now - starts[phase], cycle), green[phase] + yellow
                state[index] = np.where(since < red - yellow, OPEN, np.where(since < red, CLOSING, CLOSED))
                codes = np.array([LIGHT_STATES.index(name) for name in LIGHTS[stop.protected]])
                light[index] = codes[state[index]]
                begin = np.mod(starts[phase] + np.array([0.0, green[phase], red]) - offset, cycle)
                order = np.argsort(begin, kind="stable")
                plans[index] = LightPlan(begin[order], codes[[OPEN, CLOSING, CLOSED]][order], cycle)
        for index, crosswalk in enumerate(network.crosswalks, start=len(network.stops)):
            if crosswalk.junction == junction:
                phase = phase_of[crosswalk.arm]
                since = np.mod(now - starts[phase], cycle)
                crossing_s = float(np.linalg.norm(crosswalk.ends[1] - crosswalk.ends[0])) / walk_mps
                # after the phase of the road that it crosses, and early enough before the next one
                is_open = (since > float(green[phase]) + (yellow + clear)) & (cycle - since > crossing_s)
                state[index] = np.where(is_open, OPEN, CLOSED)
    return Gates(state, light, plans)
