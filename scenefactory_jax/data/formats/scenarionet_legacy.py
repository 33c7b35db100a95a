"""The layouts that MetaDrive's scenario pickles had in 2022 and 2023, brought into today's.

| what | then | today |
|---|---|---|
| map | `map` | `map_features` |
| times, recording car | `ts`, `sdc_index` or `sdc_track_index` (an id) beside the tracks | `metadata.ts`, `metadata.sdc_id` |
| track | values in the track itself; `size[L, 3]` | `state{}`; `length[L]`, `width[L]`, `height[L]` |
| lights | for each step a list of `{lane, state, stop_point}` | by lane: `{state{object_state[L]}, lane, stop_point}` |
| | by lane, arrays over the steps: `state{object_state[L], lane[L], stop_point[L, 3]}`, lane 0: no state | |

(MetaDrive's `waymo_utils.py` of those years.)
"""

from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats.values import Node

MAX_STATES = 1_000_000  # of all lights over all steps; 20 s of 100 lights have 20,000


def convert_legacy(document: Node) -> Node:
    """Converts a scenario into today's layout, with empty sections for those that it lacks."""
    outside = {"ts": document.get("ts", None).value, "sdc_id": document.get("sdc_track_index", document.value.get("sdc_index")).value}
    tracks, lights = document["tracks"].entries(dict), document.get("dynamic_map_states", {})
    if isinstance(lights.value, list):
        lights = Node(_group_by_lane(lights), lights.where)
    sections = {
        "metadata": {key: value for key, value in outside.items() if value is not None} | document.get("metadata", {}).expect(dict),
        "tracks": {key: _track(track) for key, track in tracks.items()},
        "map_features": document.get("map_features", document.value.get("map")).expect(dict),
        "dynamic_map_states": {key: _light(light) for key, light in lights.entries(dict).items()},
    }
    return Node(document.value | sections, document.where)


def _track(track: Node) -> dict[str, Any]:
    """A track with a `state`, and its size as three columns."""
    state = track.get("state", track.value)
    columns = {}
    if "size" in state:
        columns = dict(zip(("length", "width", "height"), state["size"].table(3).T, strict=True))
    return track.value | {"state": state.value | columns}


def _group_by_lane(steps: Node) -> dict[str, Any]:
    """Lights that are listed step by step, in today's layout."""
    lights: dict[str, Any] = {}
    for step, records in steps.entries(list).items():
        for record in records.entries(list).values():
            lane = record["lane"].expect(int)
            if str(lane) not in lights:
                stop, states = record.get("stop_point", None).value, [None] * len(steps.value)
                lights[str(lane)] = {"lane": lane, "state": {"object_state": states}, "stop_point": stop}
            if len(lights) * len(steps.value) > MAX_STATES:
                raise SceneError(f"{record.where}: expected at most {MAX_STATES} states of all lights, got more")
            lights[str(lane)]["state"]["object_state"][step] = record.get("state", None).value
    return lights


def _light(light: Node) -> dict[str, Any]:
    """A light with one lane and one stop point in place of arrays over the steps."""
    state = light["state"]
    if "lane" not in state:
        return light.value
    states = state.get("object_state", ()).array()
    lanes = state["lane"].column(states.size)
    stops = state.get("stop_point", ()).table(2, 3)
    if states.ndim != 1 or len(stops) not in (0, len(states)):
        raise SceneError(f"{state.where}: expected a state and a stop point for each step, got {states.shape} and {len(stops)}")
    codes = [int(code) if lane else None for code, lane in zip(states, lanes, strict=True)]
    steps = np.flatnonzero(lanes)
    first = int(steps[0]) if len(steps) else 0
    lane = {"lane": int(lanes[first])} if len(steps) else {}
    return light.value | lane | {"state": {"object_state": codes}, "stop_point": stops[first] if len(stops) else None}
