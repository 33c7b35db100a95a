"""A scene as GPUDrive's JSON, for GPUDrive, PufferDrive's converter and everything else that reads it.

What the format cannot hold: the lanes' connections, neighbours and speed limits, the dataset's name, the origin, the current step, and
times: its readers take WOMD, 10 Hz and step 10, and GPUDrive itself expects 91 steps.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.data.export import files

NOWHERE = -10000.0  # every value at an invalid step
TYPES = (  # map elements -> the type's name
    (range(0, 5), "lane"), (range(5, 14), "road_line"), (range(14, 17), "road_edge"), ((17,), "stop_sign"), ((18,), "crosswalk"),
    ((19,), "speed_bump"), ((20,), "driveway"),
)  # fmt: skip


def write(raw: RawScene, path: Path | str) -> None:
    """Write one scene to a JSON file.

    Raises:
        SceneError: a map element that the format does not know, a number that is not finite, or a file that cannot be written.
    """
    files.write(path, encode_json(raw))


def encode_json(raw: RawScene) -> bytes:
    """The content of a scene's file.

    Raises:
        SceneError: a map element that the format does not know, or a number that is not finite.
    """
    whole = document(raw)
    try:
        return json.dumps(whole, allow_nan=False).encode()
    except ValueError as error:
        raise SceneError(f"{raw.source}: scene {raw.name!r}: a number that is not finite, which JSON cannot hold: {error}") from error


def document(raw: RawScene) -> dict[str, Any]:
    """The JSON document of a scene.

    Raises:
        SceneError: a map element that the format does not know.
    """
    experts, chosen = (set(raw.metadata.get(key, ())) for key in ("experts", "tracks_to_predict"))
    predicted = [{"track_index": index, "difficulty": 0} for index, track in enumerate(raw.tracks) if track.id in chosen]
    return {
        "name": raw.name,
        "scenario_id": str(raw.metadata.get("scenario_id", raw.name)),
        "objects": [_object(track, track.id in experts) for track in raw.tracks],
        "roads": [_road(line, raw.source) for line in raw.roads],
        "tl_states": {str(light.lane): _light(light) for light in raw.lights},
        "metadata": {
            "sdc_track_index": -1 if raw.sdc is None else raw.sdc,
            "tracks_to_predict": predicted,
            "objects_of_interest": list(raw.metadata.get("objects_of_interest", ())),
        },
    }


def _rows(table: np.ndarray, axes: str) -> list[dict[str, float]]:
    return [dict(zip(axes, row, strict=True)) for row in table.tolist()]


def _object(track: Track, expert: bool) -> dict[str, Any]:
    """One track; its goal is where it was seen last."""
    length, width, height = track.size
    last = np.flatnonzero(track.valid)[-1] if track.valid.any() else -1
    hidden = ~track.valid[:, None]
    return {
        "position": _rows(np.where(hidden, NOWHERE, track.xyz), "xyz"),
        "width": width,
        "length": length,
        "height": height,
        "heading": np.where(track.valid, track.yaw, NOWHERE).tolist(),
        "velocity": _rows(np.where(hidden, NOWHERE, track.velocity), "xy"),
        "valid": track.valid.tolist(),
        "goalPosition": _rows(track.xyz[[last]], "xyz")[0],
        "type": track.kind,
        "id": track.id,
        "mark_as_expert": expert,
    }


def _road(line: Polyline, source: str) -> dict[str, Any]:
    """One feature of the map."""
    name = next((name for kinds, name in TYPES if line.kind in kinds), None)
    if name is None:
        raise SceneError(f"{source}: road {line.id}: GPUDrive has no type for the map element {line.kind}; valid: 0 to 20")
    return {"geometry": _rows(line.xyz, "xyz"), "type": name, "map_element_id": line.kind, "id": line.id}


def _light(light: Light) -> dict[str, list[Any]]:
    """A light at the steps at which anything is said of it; its stop point is repeated at each."""
    steps = np.flatnonzero(light.valid).tolist()
    place = {} if light.stop is None else {axis: [value] * len(steps) for axis, value in zip("xyz", light.stop.tolist(), strict=True)}
    return {"state": [LIGHT_STATES[light.state[step]] for step in steps], **place, "time_index": steps}
