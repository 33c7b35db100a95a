"""Writes scenes as ScenarioNet's pickles, for MetaDrive and all other readers of a ScenarioNet database.

Files have only texts, numbers, containers and numpy arrays, under module names of both numpy 1 and 2. The format has no mark of inferred
lane links, no origin and no metadata of other formats. A neighbour is an id without the stretch of lane; a light without a stop point gets
its lane's first point, which MetaDrive requires. MetaDrive needs a recording car to simulate.
"""

import pickle
import pickletools
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.safe_names import to_file_name
from scenefactory_jax.core.types import LINES, POLYGONS, STOP_SIGN
from scenefactory_jax.data.export import files
from scenefactory_jax.data.formats.scenarionet import DATASETS, ELEMENTS, LANES, MAPPING, SUMMARY, TEXTS, UNITS

VERSION = "MetaDrive v0.3.0.1"  # of the format, as WOMD's converter writes it
NAMES = {element: name for name, element in ELEMENTS.items()}
MOVES_M = 1.0  # distance above which MetaDrive counts an object as moving
PROTOCOL = 3  # the last protocol with module names as lines of text, not in frames of a known length


def write(raw: RawScene, path: Path | str) -> dict[str, Any]:
    """Writes one scene to a pickle and returns its metadata. MetaDrive reads only files named `sd_*.pkl`.

    Raises:
        SceneError: a map element that the format does not have, or a file that cannot be written.
    """
    _, content, metadata = _encode(raw)
    files.write(path, content)
    return metadata


def write_all(scenes: Iterable[RawScene], folder: Path | str, refused: list[str]) -> int:
    """Writes a database: a pickle for each scene (see `files.write_scenes`), then summary and mapping; returns the number of scenes."""
    summary = files.write_scenes(scenes, folder, refused, _encode)
    files.write(Path(folder) / SUMMARY, _pickled(summary))
    files.write(Path(folder) / MAPPING, _pickled(dict.fromkeys(summary, "")))
    return len(summary)


def _encode(raw: RawScene) -> tuple[str, bytes, dict[str, Any]]:
    """The name that ScenarioNet gives a scenario's file, its content, and the scenario's metadata."""
    document = scenario(raw)
    return to_file_name(f"sd_{_dataset(raw)}_{_scenario_id(raw)}.pkl"), _pickled(document), document["metadata"]


def scenario(raw: RawScene) -> dict[str, Any]:
    """The document of a scene (ScenarioNet, "Scenario Description").

    Raises:
        SceneError: a map element that the format does not have.
    """
    tokens = raw.metadata.get("tokens", {})
    names = _names([track.id for track in raw.tracks], tokens.get("tracks", {}))
    keys = _names([line.id for line in raw.roads], tokens.get("features", {}))
    lanes = {line.id: key for line, key in zip(raw.roads, keys, strict=True)}
    roads = {line.id: line for line in raw.roads}
    lights = {}
    for light in raw.lights:
        key = lanes.get(light.lane, str(light.lane))
        lights[key] = _light(light, key, roads.get(light.lane), _dataset(raw))
    tracks = {name: _track(track, name, _dataset(raw)) for name, track in zip(names, raw.tracks, strict=True)}
    signs = _sign_lanes(raw.metadata.get("stop_sign_lanes", {}))
    features = {key: _feature(line, lanes, signs, raw.source) for key, line in zip(keys, raw.roads, strict=True)}
    return {
        "id": _scenario_id(raw),
        "version": VERSION,
        "length": len(raw.times),
        "metadata": _metadata(raw, names, tracks, lights, features),
        "tracks": tracks,
        "dynamic_map_states": lights,
        "map_features": features,
    }


def _dataset(raw: RawScene) -> str:
    name = str(raw.metadata.get("dataset", "unknown"))
    return next((theirs for theirs, ours in DATASETS.items() if ours == name), name)


def _scenario_id(raw: RawScene) -> str:
    return str(raw.metadata.get("scenario_id", raw.name))


def _sign_lanes(found: Mapping[str, list[int]] | list[Mapping[str, Any]]) -> Mapping[str, list[int]]:
    """The lanes of each stop sign by its id; older banks of WOMD's protos have a list of records."""
    return {str(record["sign"]): record["lanes"] for record in found} if isinstance(found, list) else found


def _names(ids: list[int], tokens: Mapping[str, int]) -> list[str]:
    """Keys for ids: the texts of the source, or the numbers; an id that occurs again gets a suffix."""
    texts = {number: text for text, number in tokens.items()}
    count: Counter[str] = Counter()
    names = []
    for number in ids:
        name = texts.get(number, str(number))
        names.append(f"{name}_{count[name]}" if count[name] else name)
        count[name] += 1
    return names


def _track(track: Track, name: str, dataset: str) -> dict[str, Any]:
    """An object's states, with zeros at invalid steps, also of its size."""
    length, width, height = (np.where(track.valid, side, 0.0) for side in track.size)
    kind, steps = track.kind.upper(), len(track.valid)
    state = {"position": track.xyz, "length": length, "width": width, "height": height, "heading": track.yaw}
    state |= {"velocity": track.velocity, "valid": track.valid}
    return {
        "type": kind,
        "state": {key: np.ascontiguousarray(table) for key, table in state.items()},
        "metadata": {"track_length": steps, "type": kind, "object_id": name, "dataset": dataset},
    }


def _feature(line: Polyline, lanes: Mapping[int, str], signs: Mapping[str, list[int]], source: str) -> dict[str, Any]:
    """One feature of the map; lanes are referred to by their keys."""
    if line.kind not in NAMES:
        raise SceneError(f"{source}: road {line.id}: MetaDrive has no type for the map element {line.kind}; expected {sorted(NAMES)}")
    keys = lambda ids: [lanes.get(lane, str(lane)) for lane in ids]  # noqa: E731
    feature: dict[str, Any] = {"type": NAMES[line.kind]}
    xyz = np.ascontiguousarray(line.xyz)
    if line.kind == STOP_SIGN:
        return feature | {"position": xyz[0] if len(xyz) else np.zeros(3), "lane": keys(signs.get(str(line.id), ()))}
    if line.kind in POLYGONS:
        return feature | {"polygon": xyz}
    feature["polyline"] = xyz
    if line.kind in LANES:
        feature |= {"entry_lanes": keys(line.entry), "exit_lanes": keys(line.exit), "left_boundaries": [], "right_boundaries": []}
        feature |= {f"{side}_neighbor": [{"feature_id": key} for key in keys(getattr(line, side))] for side in ("left", "right")}
        if line.speed_limit is not None:
            feature |= {key: line.speed_limit / unit for key, unit in UNITS.items()}
    return feature


def _light(light: Light, key: str, lane: Polyline | None, dataset: str) -> dict[str, Any]:
    """A light over the log, under the key of its lane."""
    states = [f"LANE_STATE_{LIGHT_STATES[code].upper()}" if valid else None for code, valid in zip(light.state, light.valid, strict=True)]
    stop = light.stop if light.stop is not None else lane.xyz[0] if lane is not None and len(lane.xyz) else np.zeros(3)
    metadata = {"track_length": len(states), "type": "TRAFFIC_LIGHT", "object_id": key, "dataset": dataset}
    return {"type": "TRAFFIC_LIGHT", "state": {"object_state": states}, "lane": key, "stop_point": np.array(stop), "metadata": metadata}


def _metadata(raw: RawScene, names: list[str], tracks: dict[str, Any], lights: dict[str, Any], features: dict[str, Any]) -> dict[str, Any]:
    """Metadata for MetaDrive and ScenarioNet's filters, which do not read the rest."""
    by_id = {track.id: name for track, name in zip(raw.tracks, names, strict=True)}
    chosen = {key: [by_id[i] for i in raw.metadata.get(key, ()) if i in by_id] for key in ("objects_of_interest", "tracks_to_predict")}
    index = {name: place for place, name in enumerate(names)}
    texts = {key: raw.metadata[key] for key in TEXTS if isinstance(raw.metadata.get(key), str)}
    sdc = {} if raw.sdc is None else {"sdc_id": names[raw.sdc], "sdc_track_index": raw.sdc}
    summary = {name: _summary(name, track) for name, track in tracks.items()}
    return texts | sdc | {
        "id": _scenario_id(raw),
        "scenario_id": _scenario_id(raw),
        "dataset": _dataset(raw),
        "coordinate": "right-handed",
        "metadrive_processed": False,
        "ts": np.ascontiguousarray(raw.times),
        "track_length": len(raw.times),
        "current_time_index": int(raw.current),
        "objects_of_interest": chosen["objects_of_interest"],
        "tracks_to_predict": {
            name: {"track_index": index[name], "track_id": name, "difficulty": 0, "object_type": tracks[name]["type"]}
            for name in chosen["tracks_to_predict"]
        },
        "object_summary": summary,
        "number_summary": _numbers(summary, lights, features),
    }  # fmt: skip


def _summary(name: str, track: Mapping[str, Any]) -> dict[str, Any]:
    """One object in the summary: valid steps and distance."""
    valid = track["state"]["valid"]
    path = track["state"]["position"][valid, :2]
    start = int(np.argmax(valid))
    return {
        "type": track["type"],
        "object_id": name,
        "track_length": len(valid),
        "moving_distance": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        "valid_length": int(valid.sum()),
        "continuous_valid_length": int(np.argmin(valid[start:])) if valid.any() and not valid[start:].all() else int(valid.sum()),
    }


def _numbers(summary: Mapping[str, Any], lights: Mapping[str, Any], features: Mapping[str, Any]) -> dict[str, Any]:
    """Counts over the scenario, with ScenarioNet's names."""
    kinds = Counter(entry["type"] for entry in summary.values())
    moving = Counter(entry["type"] for entry in summary.values() if entry["moving_distance"] > MOVES_M)
    states = Counter(state for light in lights.values() for state in light["state"]["object_state"] if state is not None)
    lines = tuple(NAMES[kind] for kind in (5, *LINES))
    heights = [feature["polyline"][:, 2] for feature in features.values() if feature["type"] in lines and len(feature["polyline"])]
    return {
        "num_objects": kinds.total(),
        "object_types": set(kinds),
        "num_objects_each_type": dict(kinds),
        "num_moving_objects": moving.total(),
        "num_moving_objects_each_type": dict(moving),
        "num_traffic_lights": len(lights),
        "num_traffic_light_types": set(states),
        "num_traffic_light_each_step": dict(states),
        "num_map_features": len(features),
        "map_height_diff": float(np.ptp(np.concatenate(heights))) if heights else 0.0,
    }


def _pickled(value: Any) -> bytes:
    """The pickle with numpy 1's module names, which both numpy 1 and 2 read."""
    content = pickle.dumps(value, protocol=PROTOCOL)
    pieces, done = [], 0
    for opcode, argument, place in pickletools.genops(content):
        if opcode.name == "GLOBAL" and place is not None and str(argument).startswith("numpy._core."):
            pieces += [content[done:place], b"cnumpy.core."]
            done = place + len(b"cnumpy._core.")
    return b"".join([*pieces, content[done:]])
