"""The layouts that MetaDrive's scenario pickles had in 2022 and 2023, brought into today's.

| what | then | today |
|---|---|---|
| map | `map` | `map_features` |
| times, recording car | `ts`, `sdc_index` or `sdc_track_index` (an id) beside the tracks | `metadata.ts`, `metadata.sdc_id` |
| track | values in the track itself; `size[L, 3]` | `state{}`; `length[L]`, `width[L]`, `height[L]` |
| lights | for each step a list of `{lane, state, stop_point}` | by lane: `{state{object_state[L]}, lane, stop_point}` |
| | by lane, arrays over the steps: `state{object_state[L], lane[L], stop_point[L, 3]}`, lane 0 where unseen | |

(MetaDrive's `waymo_utils.py` of those years.)
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats import json_documents, safe_pickle


def convert_legacy(document: Mapping[Any, Any], where: str) -> dict[Any, Any]:
    """A scenario in today's layout; one that is in it already comes back as it is, but for the sections that it lacks.

    Raises:
        SceneError: a section that is no dict, or lights that are not as long as the log.
    """
    given = {key: value for key, value in document.items() if value is not None}
    metadata = json_documents.get({"metadata": {}} | given, "metadata", dict, where)
    outside = {"ts": given.get("ts"), "sdc_id": given.get("sdc_track_index", given.get("sdc_index"))}
    metadata = {key: value for key, value in outside.items() if value is not None} | metadata
    tracks = json_documents.expect(document["tracks"], dict, f"{where}tracks")
    lights = given.get("dynamic_map_states", {})
    if isinstance(lights, list):
        lights = _by_lane(lights, f"{where}dynamic_map_states")
    json_documents.expect(lights, dict, f"{where}dynamic_map_states")
    return given | {
        "metadata": metadata,
        "tracks": {key: _track(track, f"{where}tracks[{key!r}]") for key, track in tracks.items()},
        "map_features": json_documents.expect(given.get("map_features", given.get("map")), dict, f"{where}map_features"),
        "dynamic_map_states": {key: _light(light, f"{where}dynamic_map_states[{key!r}]") for key, light in lights.items()},
    }


def _track(track: Any, where: str) -> dict[str, Any]:
    """A track with a `state`, and its size as three columns."""
    json_documents.expect(track, dict, where)
    state = json_documents.expect(track.get("state", track), dict, f"{where}.state")
    if "size" in state:
        sizes = safe_pickle.table(state["size"], f"{where}.state.size", columns=(3,))
        state = state | dict(zip(("length", "width", "height"), sizes.T, strict=True))
    return track | {"state": state}


def _by_lane(steps: list[Any], where: str) -> dict[str, Any]:
    """Lights that are listed step by step, in today's layout."""
    lights: dict[str, Any] = {}
    for step, seen in enumerate(steps):
        for record in json_documents.expect(seen, list, f"{where}[{step}]"):
            json_documents.expect(record, dict, f"{where}[{step}]")
            lane = json_documents.get(record, "lane", int, f"{where}[{step}]")
            light = lights.setdefault(str(lane), {"lane": lane, "state": {"object_state": {}}, "stop_point": record.get("stop_point")})
            light["state"]["object_state"][step] = record.get("state")
    for light in lights.values():
        states = light["state"]["object_state"]
        light["state"]["object_state"] = [states.get(step) for step in range(len(steps))]
    return lights


def _light(light: Any, where: str) -> dict[str, Any]:
    """A light whose lane and stop point do not change."""
    json_documents.expect(light, dict, where)
    state = json_documents.get(light, "state", dict, where)
    if "lane" not in state:
        return light
    states = safe_pickle.numeric(state.get("object_state", ()), f"{where}.state.object_state")
    lanes = safe_pickle.column(state["lane"], f"{where}.state.lane", length=states.size)
    stops = safe_pickle.table(state.get("stop_point", ()), f"{where}.state.stop_point", columns=(2, 3))
    steps = np.flatnonzero(lanes)
    if states.ndim != 1 or len(stops) not in (0, len(states)):
        raise SceneError(f"{where}.state: {states.shape} states and {len(stops)} stop points; there must be one for each step")
    seen = [int(code) if lane else None for code, lane in zip(states, lanes, strict=True)]
    first = int(steps[0]) if len(steps) else 0
    modern = {"state": {"object_state": seen}, "stop_point": stops[first] if len(stops) else None}
    return light | modern | ({"lane": int(lanes[first])} if len(steps) else {})
