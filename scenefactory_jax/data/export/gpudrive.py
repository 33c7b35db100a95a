"""Writes scenes as GPUDrive's JSON, for GPUDrive, PufferDrive's converter and all other readers of it.

Links and limits of lanes and the lanes of stop signs are further keys, under WOMD's names, which other readers pass over. The format has no
cycles of lights beyond the log, dataset name, origin, current step and times: its readers expect WOMD's 10 Hz and step 10, and GPUDrive
itself 91 steps.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.safe_names import to_file_name
from scenefactory_jax.data.export import files
from scenefactory_jax.data.formats.gpudrive import LINKS, MPH, SIGN_LANES, SPEED_LIMIT

NOWHERE = -10000.0  # every value at an invalid step
TYPES = (  # map elements -> the type's name
    (range(0, 5), "lane"), (range(5, 14), "road_line"), (range(14, 17), "road_edge"), ((17,), "stop_sign"), ((18,), "crosswalk"),
    ((19,), "speed_bump"), ((20,), "driveway"),
)  # fmt: skip


def write(raw: RawScene, path: Path | str) -> None:
    """Writes one scene to a JSON file; raises `SceneError` if it cannot be encoded or written."""
    files.write(path, encode_json(raw))


def write_all(scenes: Iterable[RawScene], folder: Path | str, refused: list[str]) -> int:
    """Writes a JSON file for each scene, see `files.write_scenes`; returns the number of files."""
    return len(files.write_scenes(scenes, folder, refused, lambda raw: (f"{to_file_name(raw.name)}.json", encode_json(raw), None)))


def encode_json(raw: RawScene) -> bytes:
    """The content of a scene's file.

    Raises:
        SceneError: a map element that the format does not have, or a number that is not finite.
    """
    experts, chosen = (set(raw.metadata.get(key, ())) for key in ("experts", "tracks_to_predict"))
    predicted = [{"track_index": index, "difficulty": 0} for index, track in enumerate(raw.tracks) if track.id in chosen]
    document = {
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
    try:
        return json.dumps(document, allow_nan=False).encode()
    except ValueError as error:
        raise SceneError(f"{raw.source}: scene {raw.name!r}: a number that is not finite, which JSON does not have: {error}") from error


def _rows(table: np.ndarray, axes: str) -> list[dict[str, float]]:
    return [dict(zip(axes, row, strict=True)) for row in table.tolist()]


def _object(track: Track, expert: bool) -> dict[str, Any]:
    """One track; its goal is its last valid position."""
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
        raise SceneError(f"{source}: road {line.id}: GPUDrive has no type for the map element {line.kind}; expected 0 to 20")
    road = {"geometry": _rows(line.xyz, "xyz"), "type": name, "map_element_id": line.kind, "id": line.id}
    if name == "lane":
        road |= {key: list(getattr(line, field)) for field, key in LINKS.items()}
        road |= {} if line.speed_limit is None else {SPEED_LIMIT: line.speed_limit / MPH}
    return road | ({SIGN_LANES: list(line.lanes)} if line.lanes else {})


def _light(light: Light) -> dict[str, list[Any]]:
    """A light at its valid steps; each repeats its stop point."""
    steps = np.flatnonzero(light.valid).tolist()
    place = {} if light.stop is None else {axis: [value] * len(steps) for axis, value in zip("xyz", light.stop.tolist(), strict=True)}
    return {"state": [LIGHT_STATES[light.state[step]] for step in steps], **place, "time_index": steps}
