"""A Scenario proto of the Waymo Open Motion Dataset (scenario.proto, map.proto) -> RawScene.

The scene has the complete map with the lanes' graph and speed limits, all lights and all tracks. Boundaries of lanes (the line or edge
beside each stretch) and lidar are left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, SPEED_BUMP, STOP_SIGN
from scenefactory_jax.data.formats import values, womd_schema
from scenefactory_jax.data.formats.scene_parts import WOMD_TYPES, check_times, make_light, make_womd_tracks
from scenefactory_jax.data.formats.tfrecord import Record
from scenefactory_jax.data.formats.values import AXES

Message = Any  # protobuf's classes are made at run time: type checkers know none of their fields

MPH = 0.44704  # m/s, exact: the international mile is 1609.344 m
# a map feature's field in the proto -> its map element ids in the order of the field's own enumeration, and where its points are
FEATURES = {
    "lane": (range(0, 4), "polyline"),
    "road_line": (range(5, 14), "polyline"),
    "road_edge": (range(14, 17), "polyline"),
    "crosswalk": (range(CROSSWALK, CROSSWALK + 1), "polygon"),
    "speed_bump": (range(SPEED_BUMP, SPEED_BUMP + 1), "polygon"),
    "driveway": (range(DRIVEWAY, DRIVEWAY + 1), "polygon"),
}
STATE = ("center_x", "center_y", "center_z", "heading", "velocity_x", "velocity_y", "length", "width", "height")  # as scene_parts.STATE
PLANE = 2  # the first columns of AXES and of STATE: protobuf reads a missing number as zero, and positions in a log are not zero


def parse(record: Record) -> Message | None:
    """The Scenario in a record; None if it has none."""
    try:
        message = womd_schema.Scenario.FromString(record.data)
    except DecodeError:
        return None
    return message if message.scenario_id and (message.tracks or message.map_features) else None


def find_name(message: Message) -> str:
    """The scenario's id; bytes that are not UTF-8 are escaped."""
    return message.scenario_id.decode("utf-8", errors="backslashreplace")


def make(message: Message, *, path: Path, record: Record) -> RawScene:
    """The scene of one message."""
    where = f"{record.place}: "
    times = np.array(message.timestamps_seconds, np.float64)
    check_times(times, f"{where}timestamps_seconds")
    _require(message, "current_time_index", where)
    current = values.check_index(message.current_time_index, range(len(times)), "step of the log", f"{where}current_time_index")
    tracks = _tracks(message.tracks, len(times), current, where)
    sdc = message.sdc_track_index if message.HasField("sdc_track_index") else None
    if sdc is not None:
        values.check_index(sdc, tracks, "track", f"{where}sdc_track_index")
    roads = [_polyline(feature, f"{where}map_features[{i}]") for i, feature in enumerate(message.map_features)]
    return RawScene(
        name=find_name(message),
        source=str(path),
        roads=tuple(line for line in roads if line is not None),
        tracks=tracks,
        times=times,
        current=current,
        sdc=sdc,
        lights=_lights(message.dynamic_map_states, len(times), where),
        metadata={"dataset": "WOMD", "format": "womd_scenario", "scenario_id": find_name(message), "record": record.number}
        | _metadata(message, tracks, where)
        | {"unknown_map_features": roads.count(None)},
    )


def _require(message: Message, field: str, where: str) -> None:
    """Refuses a message without the field; `where` ends with a separator."""
    if not message.HasField(field):
        raise SceneError(f"{where}{field}: missing")


def _table(messages: Sequence[Message], fields: Sequence[str], name: Callable[[int], str]) -> Float[np.ndarray, "N D"]:
    """The numbers of many messages of one type, a row each; `name` gives the place of a row in the source."""
    flat = chain.from_iterable(map(attrgetter(*fields), messages))
    table = np.fromiter(flat, np.float64, len(messages) * len(fields)).reshape(-1, len(fields))
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise SceneError(f"{name(row)}.{fields[column]}: expected a finite number, got {table[row, column]}")
    for row, column in np.argwhere(table[:, :PLANE] == 0).tolist():
        _require(messages[row], fields[column], f"{name(row)}.")
    return table


def _tracks(messages: Sequence[Message], steps: int, current: int, where: str) -> tuple[Track, ...]:
    """The objects."""
    for place, message in enumerate(messages):
        values.check_length(message.states, steps, f"{where}tracks[{place}].states")
        _require(message, "id", f"{where}tracks[{place}].")
        values.check_index(message.object_type, WOMD_TYPES, "type of object", f"{where}tracks[{place}].object_type")
    states = enumerate(chain.from_iterable(message.states for message in messages))
    by_row = {row: state for row, state in states if state.valid}
    rows = list(by_row)
    numbers, valid = np.zeros((len(messages) * steps, len(STATE))), np.zeros(len(messages) * steps, bool)
    numbers[rows] = _table(list(by_row.values()), STATE, lambda row: f"{where}tracks[{rows[row] // steps}].states[{rows[row] % steps}]")
    valid[rows] = True
    numbers, valid = numbers.reshape(len(messages), steps, len(STATE)), valid.reshape(len(messages), steps)
    ids, kinds = [message.id for message in messages], [message.object_type for message in messages]
    return make_womd_tracks(numbers, valid, ids=ids, kinds=kinds, current=current, where=where)


def _polyline(message: Message, where: str) -> Polyline | None:
    """One map feature; None if its kind is newer than this reader. A speed limit of 0 means unknown."""
    name = message.WhichOneof(womd_schema.CHOICE)
    if name is None:
        return None
    _require(message, "id", f"{where}.")
    feature, where = getattr(message, name), f"{where}.{name}"
    if name == "stop_sign":
        _require(feature, "position", f"{where}.")
        xyz = _table([feature.position], AXES, lambda _: f"{where}.position")
        return Polyline(kind=STOP_SIGN, xyz=xyz, id=message.id, lanes=tuple(feature.lane))
    elements, points = FEATURES[name]
    kind = elements[values.check_index(getattr(feature, "type", 0), elements, f"type of {name}", f"{where}.type")]
    line = Polyline(kind=kind, xyz=_table(getattr(feature, points), AXES, lambda row: f"{where}.{points}[{row}]"), id=message.id)
    if name != "lane":
        return line
    limit = feature.speed_limit_mph
    if not (np.isfinite(limit) and limit >= 0):
        raise SceneError(f"{where}.speed_limit_mph: expected 0 (unknown) or more, got {limit}")
    left, right = (  # the file has a neighbour once per stretch
        tuple(dict.fromkeys(neighbour.feature_id for neighbour in side)) for side in (feature.left_neighbors, feature.right_neighbors)
    )
    entry, following = tuple(feature.entry_lanes), tuple(feature.exit_lanes)
    return replace(line, entry=entry, exit=following, left=left, right=right, speed_limit=limit * MPH if limit else None)


def _lights(moments: Sequence[Message], steps: int, where: str) -> tuple[Light, ...]:
    """The light of each lane that has one at any step, in the order in which they appear."""
    if len(moments) > steps:
        raise SceneError(f"{where}dynamic_map_states: expected at most {steps} entries, as timestamps_seconds has, got {len(moments)}")
    codes: dict[int, np.ndarray] = {}
    stops: dict[int, np.ndarray | None] = {}
    for step, moment in enumerate(moments):
        for i, signal in enumerate(moment.lane_states):
            place = f"{where}dynamic_map_states[{step}].lane_states[{i}]."
            _require(signal, "lane", place)
            if signal.lane not in codes:
                codes[signal.lane] = np.full(steps, -1)
                points = [signal.stop_point] if signal.HasField("stop_point") else []
                stops[signal.lane] = next(iter(_table(points, AXES, lambda _, place=place: f"{place}stop_point")), None)
            codes[signal.lane][step] = values.check_index(signal.state, LIGHT_STATES, "state of a light", f"{place}state")
    return tuple(make_light(lane, column, stops[lane]) for lane, column in codes.items())


def _metadata(message: Message, tracks: Sequence[Track], where: str) -> dict[str, Any]:
    """Lists of tracks, by their ids (indices change when tracks are dropped)."""
    chosen = message.tracks_to_predict
    for place, entry in enumerate(chosen):
        values.check_index(entry.track_index, tracks, "track", f"{where}tracks_to_predict[{place}].track_index")
    return {
        "objects_of_interest": list(message.objects_of_interest),
        "tracks_to_predict": [tracks[entry.track_index].id for entry in chosen],
        "difficulty_levels": [entry.difficulty for entry in chosen],  # of tracks_to_predict: 0 none, 1, 2
    }
