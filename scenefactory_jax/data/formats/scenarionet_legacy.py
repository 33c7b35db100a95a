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

from collections.abc import Mapping
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats import values


def convert_legacy(document: Mapping[Any, Any], where: str) -> dict[Any, Any]:
    """Converts a scenario into today's layout, with empty sections for those that it lacks."""
    present = {key: value for key, value in document.items() if value is not None}
    metadata = values.get({"metadata": {}} | present, "metadata", dict, where)
    outside = {"ts": present.get("ts"), "sdc_id": present.get("sdc_track_index", present.get("sdc_index"))}
    metadata = {key: value for key, value in outside.items() if value is not None} | metadata
    tracks = values.expect(document["tracks"], dict, f"{where}tracks")
    lights = present.get("dynamic_map_states", {})
    if isinstance(lights, list):
        lights = _by_lane(lights, f"{where}dynamic_map_states")
    values.expect(lights, dict, f"{where}dynamic_map_states")
    return present | {
        "metadata": metadata,
        "tracks": {key: _track(track, f"{where}tracks[{key!r}]") for key, track in tracks.items()},
        "map_features": values.expect(present.get("map_features", present.get("map")), dict, f"{where}map_features"),
        "dynamic_map_states": {key: _light(light, f"{where}dynamic_map_states[{key!r}]") for key, light in lights.items()},
    }


def _track(track: Any, where: str) -> dict[str, Any]:
    """A track with a `state`, and its size as three columns."""
    values.expect(track, dict, where)
    state = values.expect(track.get("state", track), dict, f"{where}.state")
    if "size" in state:
        sizes = values.table(state["size"], f"{where}.state.size", columns=(3,))
        state = state | dict(zip(("length", "width", "height"), sizes.T, strict=True))
    return track | {"state": state}


def _by_lane(steps: list[Any], where: str) -> dict[str, Any]:
    """Lights that are listed step by step, in today's layout."""
    lights: dict[str, Any] = {}
    for step, records in enumerate(steps):
        for record in values.expect(records, list, f"{where}[{step}]"):
            values.expect(record, dict, f"{where}[{step}]")
            lane = values.get(record, "lane", int, f"{where}[{step}]")
            light = lights.setdefault(str(lane), {"lane": lane, "state": {"object_state": {}}, "stop_point": record.get("stop_point")})
            light["state"]["object_state"][step] = record.get("state")
    for light in lights.values():
        states = light["state"]["object_state"]
        light["state"]["object_state"] = [states.get(step) for step in range(len(steps))]
    return lights


def _light(light: Any, where: str) -> dict[str, Any]:
    """A light with one lane and one stop point in place of arrays over the steps."""
    values.expect(light, dict, where)
    state = values.get(light, "state", dict, where)
    if "lane" not in state:
        return light
    states = values.array(state.get("object_state", ()), f"{where}.state.object_state")
    lanes = values.column(state["lane"], f"{where}.state.lane", length=states.size)
    stops = values.table(state.get("stop_point", ()), f"{where}.state.stop_point", columns=(2, 3))
    steps = np.flatnonzero(lanes)
    if states.ndim != 1 or len(stops) not in (0, len(states)):
        raise SceneError(f"{where}.state: expected a state and a stop point for each step, got {states.shape} and {len(stops)}")
    codes = [int(code) if lane else None for code, lane in zip(states, lanes, strict=True)]
    first = int(steps[0]) if len(steps) else 0
    modern = {"state": {"object_state": codes}, "stop_point": stops[first] if len(stops) else None}
    return light | modern | ({"lane": int(lanes[first])} if len(steps) else {})
