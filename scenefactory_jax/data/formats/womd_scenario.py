"""A Scenario proto of the Waymo Open Motion Dataset (scenario.proto, map.proto) -> RawScene.

Kept is everything that RawScene has a place for: the whole map with the lanes' graph and speed limits, lights, all tracks. The source's
boundaries of lanes (which line or edge lies beside which stretch) and lidar are not.
"""

from collections.abc import Callable, Sequence
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import CROSSWALK, DRIVEWAY, SPEED_BUMP, STOP_SIGN
from scenefactory_jax.data.formats import womd_schema
from scenefactory_jax.data.formats.tfrecord import Record
from scenefactory_jax.data.formats.womd_common import OBJECT_TYPES, check_member, check_times, make_tracks

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
POINT = ("x", "y", "z")
STATE = ("center_x", "center_y", "center_z", "heading", "velocity_x", "velocity_y", "length", "width", "height")  # as womd_values.STATE
PLANE = 2  # the first columns of POINT and of STATE: zero by protobuf's rules if they are not there, which no position in a log is


def parse(data: bytes) -> Message | None:
    """The Scenario in a record; nothing if it holds none."""
    try:
        message = womd_schema.Scenario.FromString(data)
    except DecodeError:
        return None
    return message if message.scenario_id and (message.tracks or message.map_features) else None


def find_name(message: Message) -> str:
    """The scenario's id; bytes that are no UTF-8 stay readable."""
    return message.scenario_id.decode("utf-8", errors="backslashreplace")


def make(message: Message, *, path: Path, record: Record) -> RawScene:
    """The scene of one message.

    Raises:
        SceneError: a value that is missing, not finite or refers to nothing, naming the record and the field.
    """
    where = f"{record.place}: "
    times = np.array(message.timestamps_seconds, np.float64)
    check_times(times, f"{where}timestamps_seconds")
    if not message.HasField("current_time_index"):
        raise SceneError(f"{where}current_time_index: missing")
    current = check_member(message.current_time_index, range(len(times)), "step of the log", f"{where}current_time_index")
    tracks = _tracks(message.tracks, len(times), current, where)
    sdc = message.sdc_track_index if message.HasField("sdc_track_index") else None
    if sdc is not None:
        check_member(sdc, tracks, "track", f"{where}sdc_track_index")
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


def _table(messages: Sequence[Message], fields: Sequence[str], name: Callable[[int], str]) -> Float[np.ndarray, "N D"]:
    """The numbers of many messages of one sort, a row each; `name` tells where in the source a row stands."""
    flat = chain.from_iterable(map(attrgetter(*fields), messages))
    table = np.fromiter(flat, np.float64, len(messages) * len(fields)).reshape(-1, len(fields))
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise SceneError(f"{name(row)}.{fields[column]}: {table[row, column]} is not finite")
    if not table[:, :PLANE].all():
        for row, column in np.argwhere(table[:, :PLANE] == 0):
            if not messages[row].HasField(fields[column]):
                raise SceneError(f"{name(row)}.{fields[column]}: missing")
    return table


def _tracks(messages: Sequence[Message], steps: int, current: int, where: str) -> tuple[Track, ...]:
    """The objects. At invalid steps the source may hold anything."""
    for place, message in enumerate(messages):
        if len(message.states) != steps:
            found = f"{len(message.states)} entries; there must be {steps}, one for each of timestamps_seconds"
            raise SceneError(f"{where}tracks[{place}].states: {found}")
        if not message.HasField("id"):
            raise SceneError(f"{where}tracks[{place}].id: missing")
        check_member(message.object_type, OBJECT_TYPES, "type of object", f"{where}tracks[{place}].object_type")
    states = enumerate(chain.from_iterable(message.states for message in messages))
    seen = {row: state for row, state in states if state.valid}
    rows = list(seen)
    numbers, valid = np.zeros((len(messages) * steps, len(STATE))), np.zeros(len(messages) * steps, bool)
    numbers[rows] = _table(list(seen.values()), STATE, lambda row: f"{where}tracks[{rows[row] // steps}].states[{rows[row] % steps}]")
    valid[rows] = True
    return make_tracks(
        numbers.reshape(len(messages), steps, len(STATE)),
        valid.reshape(len(messages), steps),
        ids=[message.id for message in messages],
        kinds=[message.object_type for message in messages],
        current=current,
    )


def _polyline(message: Message, where: str) -> Polyline | None:
    """One map feature; none if it is of a sort that map.proto did not have when this was written."""
    sort = message.WhichOneof(womd_schema.CHOICE)
    if sort is None:
        return None
    if not message.HasField("id"):
        raise SceneError(f"{where}.id: missing")
    feature, where = getattr(message, sort), f"{where}.{sort}"
    if sort == "stop_sign":
        if not feature.HasField("position"):
            raise SceneError(f"{where}.position: missing")
        return Polyline(kind=STOP_SIGN, xyz=_table([feature.position], POINT, lambda _: f"{where}.position"), id=message.id)
    elements, points = FEATURES[sort]
    kind = elements[check_member(getattr(feature, "type", 0), elements, f"type of {sort}", f"{where}.type")]
    xyz = _table(getattr(feature, points), POINT, lambda row: f"{where}.{points}[{row}]")
    line = Polyline(kind=kind, xyz=xyz, id=message.id)
    return line if sort != "lane" else _with_graph(line, feature, where)


def _with_graph(line: Polyline, lane: Message, where: str) -> Polyline:
    """A lane with the lanes around it and its speed limit, of which 0 says that there is none known."""
    limit = lane.speed_limit_mph
    if not (np.isfinite(limit) and limit >= 0):
        raise SceneError(f"{where}.speed_limit_mph: {limit} is no speed limit; valid: 0 (unknown) or more")
    return Polyline(
        kind=line.kind,
        xyz=line.xyz,
        id=line.id,
        entry=tuple(lane.entry_lanes),
        exit=tuple(lane.exit_lanes),
        left=tuple(dict.fromkeys(neighbour.feature_id for neighbour in lane.left_neighbors)),  # one for each stretch
        right=tuple(dict.fromkeys(neighbour.feature_id for neighbour in lane.right_neighbors)),
        speed_limit=limit * MPH if limit else None,
    )


def _lights(moments: Sequence[Message], steps: int, where: str) -> tuple[Light, ...]:
    """One light for each lane that the source names at any step, in the order in which they appear."""
    if len(moments) > steps:
        raise SceneError(f"{where}dynamic_map_states: {len(moments)} entries; there are only {steps} timestamps_seconds")
    lights: dict[int, Light] = {}
    for step, moment in enumerate(moments):
        for i, signal in enumerate(moment.lane_states):
            place = f"{where}dynamic_map_states[{step}].lane_states[{i}]"
            if not signal.HasField("lane"):
                raise SceneError(f"{place}.lane: missing")
            state = check_member(signal.state, LIGHT_STATES, "state of a light", f"{place}.state")
            light = lights.get(signal.lane)
            if light is None:
                light = lights[signal.lane] = Light(signal.lane, np.zeros(steps, np.int64), np.zeros(steps, bool), _stop(signal, place))
            light.state[step], light.valid[step] = state, True
    return tuple(lights.values())


def _stop(signal: Message, where: str) -> Float[np.ndarray, "3"] | None:
    """Where cars stop for a light, if the source says so."""
    return _table([signal.stop_point], POINT, lambda _: f"{where}.stop_point")[0] if signal.HasField("stop_point") else None


def _metadata(message: Message, tracks: Sequence[Track], where: str) -> dict[str, Any]:
    """What the source says of tracks, by their ids (an index would not survive dropped tracks), and the lanes of stop signs."""
    chosen = message.tracks_to_predict
    for place, entry in enumerate(chosen):
        check_member(entry.track_index, tracks, "track", f"{where}tracks_to_predict[{place}].track_index")
    signs = [feature for feature in message.map_features if feature.WhichOneof(womd_schema.CHOICE) == "stop_sign"]
    return {
        "objects_of_interest": list(message.objects_of_interest),
        "tracks_to_predict": [tracks[entry.track_index].id for entry in chosen],
        "difficulty_levels": [entry.difficulty for entry in chosen],  # of tracks_to_predict: 0 none, 1, 2
        "stop_sign_lanes": {str(feature.id): list(feature.stop_sign.lane) for feature in signs},
    }
