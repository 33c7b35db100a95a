"""Writes scenes as ScenarioNet's pickles, for MetaDrive and all other readers of a ScenarioNet database.

Files have only texts, numbers, containers and numpy arrays, under module names of both numpy 1 and 2. The format has no mark of inferred
lane links, no cycles of lights beyond the log, no origin and no metadata of other formats. A neighbour is an id without the stretch of
lane; a light without a stop point gets its lane's first point, which MetaDrive requires. MetaDrive needs a recording car to simulate.
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
    document = scenario(raw)
    files.write(path, _pickle(document))
    return document["metadata"]


def write_all(scenes: Iterable[RawScene], folder: Path | str, refused: list[str]) -> int:
    """Writes a database: a pickle for each scene (see `files.write_scenes`), then summary and mapping; returns the number of scenes."""

    def encode(raw: RawScene) -> tuple[str, bytes, dict[str, Any]]:
        document = scenario(raw)
        metadata = document["metadata"]
        return to_file_name(f"sd_{metadata['dataset']}_{metadata['id']}.pkl"), _pickle(document), metadata

    summary = files.write_scenes(scenes, folder, refused, encode)
    files.write(Path(folder) / SUMMARY, _pickle(summary))
    files.write(Path(folder) / MAPPING, _pickle(dict.fromkeys(summary, "")))
    return len(summary)


def scenario(raw: RawScene) -> dict[str, Any]:
    """The document of a scene (ScenarioNet, "Scenario Description").

    Raises:
        SceneError: a map element that the format does not have.
    """
    dataset, tokens = str(raw.metadata.get("dataset", "unknown")), raw.metadata.get("tokens", {})
    dataset = next((name for name, known in DATASETS.items() if known == dataset), dataset)
    names = _make_keys([track.id for track in raw.tracks], tokens.get("tracks", {}))
    keys = _make_keys([line.id for line in raw.roads], tokens.get("features", {}))
    lanes = {line.id: key for line, key in zip(raw.roads, keys, strict=True)}
    roads = {line.id: line for line in raw.roads}
    light_keys = [lanes.get(light.lane, str(light.lane)) for light in raw.lights]
    lights = {key: _light(light, key, roads.get(light.lane), dataset) for key, light in zip(light_keys, raw.lights, strict=True)}
    tracks = {name: _track(track, name, dataset) for name, track in zip(names, raw.tracks, strict=True)}
    features = {key: _feature(line, lanes, raw.source) for key, line in zip(keys, raw.roads, strict=True)}
    metadata = _metadata(raw, dataset, names, tracks) | {"number_summary": _count(tracks, lights, features)}
    return {
        "id": metadata["id"],
        "version": VERSION,
        "length": len(raw.times),
        "metadata": metadata,
        "tracks": tracks,
        "dynamic_map_states": lights,
        "map_features": features,
    }


def _make_keys(ids: list[int], tokens: Mapping[str, int]) -> list[str]:
    """Keys for ids: the texts of the source, or the numbers; an id that occurs again gets a suffix."""
    texts = {number: text for text, number in tokens.items()}
    count: Counter[str] = Counter()
    keys = []
    for number in ids:
        key = texts.get(number, str(number))
        keys.append(f"{key}_{count[key]}" if count[key] else key)
        count[key] += 1
    return keys


def _track(track: Track, name: str, dataset: str) -> dict[str, Any]:
    """An object's states, with zeros at invalid steps, also of its size."""
    length, width, height = (np.where(track.valid, side, 0.0) for side in track.size)
    state = {"position": track.xyz, "length": length, "width": width, "height": height, "heading": track.yaw}
    state |= {"velocity": track.velocity, "valid": track.valid}
    kind = track.kind.upper()
    metadata = {"track_length": len(track.valid), "type": kind, "object_id": name, "dataset": dataset}
    return {"type": kind, "state": {key: np.ascontiguousarray(table) for key, table in state.items()}, "metadata": metadata}


def _feature(line: Polyline, lanes: Mapping[int, str], source: str) -> dict[str, Any]:
    """One feature of the map; lanes are referred to by their keys."""
    if line.kind not in NAMES:
        raise SceneError(f"{source}: road {line.id}: MetaDrive has no type for the map element {line.kind}; expected {sorted(NAMES)}")
    keys = lambda ids: [lanes.get(lane, str(lane)) for lane in ids]  # noqa: E731
    feature: dict[str, Any] = {"type": NAMES[line.kind]}
    xyz = np.ascontiguousarray(line.xyz)
    if line.kind == STOP_SIGN:
        return feature | {"position": xyz[0] if len(xyz) else np.zeros(3), "lane": keys(line.lanes)}
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


def _metadata(raw: RawScene, dataset: str, names: list[str], tracks: Mapping[str, Any]) -> dict[str, Any]:
    """Metadata for MetaDrive and ScenarioNet's filters, which do not read the rest."""
    by_id = {track.id: name for track, name in zip(raw.tracks, names, strict=True)}
    chosen = {key: [by_id[i] for i in raw.metadata.get(key, ()) if i in by_id] for key in ("objects_of_interest", "tracks_to_predict")}
    texts = {key: raw.metadata[key] for key in TEXTS if isinstance(raw.metadata.get(key), str)}
    sdc = {} if raw.sdc is None else {"sdc_id": names[raw.sdc], "sdc_track_index": raw.sdc}
    number = str(raw.metadata.get("scenario_id", raw.name))
    return texts | sdc | {
        "id": number,
        "scenario_id": number,
        "dataset": dataset,
        "coordinate": "right-handed",
        "metadrive_processed": False,
        "ts": np.ascontiguousarray(raw.times),
        "track_length": len(raw.times),
        "current_time_index": int(raw.current),
        "objects_of_interest": chosen["objects_of_interest"],
        "tracks_to_predict": {
            name: {"track_index": names.index(name), "track_id": name, "difficulty": 0, "object_type": tracks[name]["type"]}
            for name in chosen["tracks_to_predict"]
        },
        "object_summary": {name: _summarize(name, track) for name, track in tracks.items()},
    }  # fmt: skip


def _summarize(name: str, track: Mapping[str, Any]) -> dict[str, Any]:
    """One object in the summary: valid steps and distance."""
    valid = track["state"]["valid"]
    first_valid = valid[int(np.argmax(valid)) :]
    return {
        "type": track["type"],
        "object_id": name,
        "track_length": len(valid),
        "moving_distance": _distance(track),
        "valid_length": int(valid.sum()),
        "continuous_valid_length": int(np.argmin(first_valid)) if valid.any() and not first_valid.all() else int(valid.sum()),
    }


def _distance(track: Mapping[str, Any]) -> float:
    """Length of the path over the valid steps (m)."""
    path = track["state"]["position"][track["state"]["valid"], :2]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _count(tracks: Mapping[str, Any], lights: Mapping[str, Any], features: Mapping[str, Any]) -> dict[str, Any]:
    """Counts over the scenario, with ScenarioNet's names."""
    kinds = Counter(track["type"] for track in tracks.values())
    moving = Counter(track["type"] for track in tracks.values() if _distance(track) > MOVES_M)
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


def _pickle(value: Any) -> bytes:
    """The pickle with numpy 1's module names, which both numpy 1 and 2 read."""
    content = pickle.dumps(value, protocol=PROTOCOL)
    pieces, done = [], 0
    for opcode, argument, place in pickletools.genops(content):
        if opcode.name == "GLOBAL" and place is not None and str(argument).startswith("numpy._core."):
            pieces += [content[done:place], b"cnumpy.core."]
            done = place + len(b"cnumpy._core.")
    return b"".join([*pieces, content[done:]])
