"""A tf.Example of the Waymo Open Motion Dataset (waymo.com/open/data/motion/tfexample) -> RawScene.

The encoding has less than the Scenario proto: at most 128 objects, 16 lights a step and 20,000 or 30,000 map points (`map_full` in the
metadata: no room was left, so the map may be cut), no lane graph, no speed limits, float32 coordinates.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError
from scenefactory_jax.core.types import STOP_SIGN
from scenefactory_jax.data.formats import values, womd_common, womd_schema
from scenefactory_jax.data.formats.scene_parts import AXES, make_light
from scenefactory_jax.data.formats.tfrecord import Record
from scenefactory_jax.data.formats.womd_common import OBJECT_TYPES, check_times, make_tracks

Features = Mapping[str, Any]  # key -> tf.train.Feature

PERIODS = ("past", "current", "future")
STATE = tuple("bbox_yaw" if name == "yaw" else name for name in womd_common.STATE)
ELEMENTS = (*range(0, 4), *range(5, 21))  # map element ids; without 4
POLYGONS = 17  # stop signs and polygons have this id or a larger one; they are not split at long steps
MICROSECONDS = 1e6


class _States(NamedTuple):
    """The objects over the log, a row each, with padding."""

    numbers: Float[np.ndarray, "A L 9"]  # columns as in STATE
    valid: Bool[np.ndarray, "A L"]
    times: Float[np.ndarray, " L"]  # s
    current: int


class _Signals(NamedTuple):
    """The lights over past, current and future: `S` places in a row; the place of a lane may differ between rows."""

    times: Float[np.ndarray, " R"]  # s; infinite: missing
    lanes: Int[np.ndarray, "R S"]
    state: Int[np.ndarray, "R S"]
    valid: Bool[np.ndarray, "R S"]
    stop: Float[np.ndarray, "R S 3"]


def parse(data: bytes) -> Features | None:
    """The features of a WOMD tf.Example in a record, by their keys; None if it has none."""
    try:
        entries = womd_schema.Example.FromString(data).features.feature
    except DecodeError:
        return None
    features = {entry.key.decode("utf-8", errors="backslashreplace"): entry.value for entry in entries}
    return features if any(key.startswith(("state/", "roadgraph_samples/")) for key in features) else None


def find_name(features: Features) -> str | None:
    """The scenario's id, or None."""
    texts = features["scenario/id"].bytes_list.value if "scenario/id" in features else ()
    return texts[0].decode("utf-8", errors="backslashreplace") if texts else None


def make(features: Features, *, path: Path, record: Record, jump_m: float) -> RawScene:
    """The scene of one tf.Example."""
    where = f"{record.place}: "
    ids = _integers(features, "state/id", where)
    states = _states(features, len(ids), where)
    real = ids >= 0  # other rows are padding
    _require(real | ~states.valid.any(axis=1), ids, f"{where}state/id", "an id, 0 or more, of an object with valid steps")
    kinds = _integers(features, "state/type", where, length=len(ids))
    known = (kinds >= 0) & (kinds < len(OBJECT_TYPES))
    _require(known | ~real, kinds, f"{where}state/type", f"a type of object, 0 to {len(OBJECT_TYPES) - 1}")
    tracks = make_tracks(
        states.numbers[real], states.valid[real], ids=ids[real].tolist(), kinds=kinds[real].tolist(), current=states.current
    )
    chosen = np.flatnonzero(_flags(features, "state/is_sdc", where, len(ids)) & real)
    if len(chosen) > 1:
        raise SceneError(f"{where}state/is_sdc: expected one recording car at most, got {len(chosen)}")
    lights, moved = _lights(features, states.times, where)
    roads, full = _roads(features, jump_m, where)
    name = find_name(features)
    return RawScene(
        name=name or f"{Path(path).name}#{record.number}",
        source=str(path),
        roads=roads,
        tracks=tracks,
        times=states.times,
        current=states.current,
        sdc=int(real[: chosen[0]].sum()) if len(chosen) else None,
        lights=lights,
        metadata={"dataset": "WOMD", "format": "womd_example", "scenario_id": name, "record": record.number}
        | _metadata(features, ids, real, where)
        | {"map_full": full, "lights_moved": moved},
    )


def _numbers(features: Features, key: str, where: str, *, length: int | None = None) -> np.ndarray:
    """A feature's numbers, float or integer as in the source, finite or not."""
    if key not in features:
        raise SceneError(f"{where}{key}: missing")
    feature = features[key]
    floats = feature.float_list.value
    with np.errstate(invalid="ignore"):  # a signalling NaN warns when it is widened
        found = np.array(floats, np.float64) if len(floats) else np.array(feature.int64_list.value, np.int64)
    if length is not None and len(found) != length:
        raise SceneError(f"{where}{key}: expected {length} numbers, got {len(found)}")
    return found


def _integers(features: Features, key: str, where: str, *, length: int | None = None) -> Int[np.ndarray, " N"]:
    """A feature's numbers as integers; ids and types of objects are floats in the format."""
    found = _numbers(features, key, where, length=length)
    if found.dtype == np.int64:
        return found
    values.check_finite(found, f"{where}{key}")
    integers = np.clip(found, -(2**53), 2**53).astype(np.int64)  # beyond, not every integer is a float
    _require(integers == found, found, f"{where}{key}", "a whole number")
    return integers


def _floats(features: Features, key: str, where: str, *, length: int) -> Float[np.ndarray, " N"]:
    """A feature's numbers as float64."""
    return _numbers(features, key, where, length=length).astype(np.float64)


def _flags(features: Features, key: str, where: str, length: int) -> Bool[np.ndarray, " N"]:
    """A feature of ones (yes) and zeros or minus ones (no, and padding)."""
    found = _integers(features, key, where, length=length)
    _require((found >= -1) & (found <= 1), found, f"{where}{key}", "1, 0 or, as padding, -1")
    return found == 1


def _require(good: Bool[np.ndarray, " N"], found: np.ndarray, where: str, expected: str) -> None:
    """Refuses numbers that are not all good, naming the first."""
    if not good.all():
        place = int(np.argmin(good))
        raise SceneError(f"{where}[{place}]: expected {expected}, got {found[place]}")


def _states(features: Features, objects: int, where: str) -> _States:
    """The objects over past, current and future; a future without a valid step (hidden in WOMD's test set) is left out."""
    if not objects:
        raise SceneError(f"{where}state/id: expected at least one object, got none")
    periods = []
    for period in PERIODS:
        prefix = f"state/{period}/"
        if period != "current" and not any(key.startswith(prefix) for key in features):
            continue
        count = len(_numbers(features, f"{prefix}valid", where))
        if count % objects or (period == "current" and count != objects):
            expected = f"{objects}" if period == "current" else f"a multiple of {objects}"
            raise SceneError(f"{where}{prefix}valid: expected {expected} numbers, for each of state/id, got {count}")
        valid = _flags(features, f"{prefix}valid", where, count).reshape(objects, -1)
        if period == "future" and not valid.any():
            continue
        columns = [_floats(features, f"{prefix}{name}", where, length=count) for name in STATE]
        for name, column in zip(STATE, columns, strict=True):
            values.check_finite(column, f"{where}{prefix}{name}", rows=valid.ravel())
        stamps = _integers(features, f"{prefix}timestamp_micros", where, length=count).reshape(objects, -1)
        table = np.stack(columns, axis=-1).reshape(objects, -1, len(STATE))
        if not (known := valid.any(axis=0)).all():
            raise SceneError(f"{where}{prefix}valid: no object is valid at step {int(np.argmin(known))}, so its time is not known")
        periods.append((period, table, valid, np.where(valid, stamps, np.iinfo(np.int64).min).max(axis=0)))
    current = sum(table.shape[1] for period, table, _, _ in periods if period == "past")
    times = np.concatenate([stamps for *_, stamps in periods]) / MICROSECONDS
    check_times(times, f"{where}state/{{past,current,future}}/timestamp_micros")
    numbers, valid = (np.concatenate([entry[column] for entry in periods], axis=1) for column in (1, 2))
    return _States(numbers, valid, times, current)


def _metadata(features: Features, ids: Int[np.ndarray, " A"], real: Bool[np.ndarray, " A"], where: str) -> dict[str, Any]:
    """Lists of objects, by their ids."""
    found: dict[str, Any] = {}
    for name in ("objects_of_interest", "tracks_to_predict"):
        if f"state/{name}" in features:
            found[name] = ids[_flags(features, f"state/{name}", where, len(ids)) & real].tolist()
    if "tracks_to_predict" in found and "state/difficulty_level" in features:
        levels = _integers(features, "state/difficulty_level", where, length=len(ids))
        found["difficulty_levels"] = levels[_flags(features, "state/tracks_to_predict", where, len(ids)) & real].tolist()
    return found


def _signals(features: Features, period: str, where: str) -> _Signals | None:
    """The lights of one period; None if it has none."""
    prefix = f"traffic_light_state/{period}/"
    if f"{prefix}timestamp_micros" not in features:
        return None
    stamps = _integers(features, f"{prefix}timestamp_micros", where)
    lanes = _integers(features, f"{prefix}id", where)
    if not len(stamps) or len(lanes) % len(stamps):
        raise SceneError(f"{where}{prefix}id: expected a multiple of {len(stamps)} numbers, for each timestamp, got {len(lanes)}")
    state = _integers(features, f"{prefix}state", where, length=len(lanes))
    valid = _flags(features, f"{prefix}valid", where, len(lanes))
    known = (state >= 0) & (state < len(LIGHT_STATES))
    _require(known | ~valid, state, f"{where}{prefix}state", f"a state of a light, 0 to {len(LIGHT_STATES) - 1}")
    axes = {axis: _floats(features, f"{prefix}{axis}", where, length=len(lanes)) for axis in AXES}
    for axis, column in axes.items():
        values.check_finite(column, f"{where}{prefix}{axis}", rows=valid)
    times = np.where(stamps < 0, np.inf, stamps / MICROSECONDS)
    lanes, state, valid = (column.reshape(len(stamps), -1) for column in (lanes, state, valid))
    return _Signals(times, lanes, state, valid, np.stack(list(axes.values()), axis=-1).reshape(*valid.shape, 3))


def _lights(features: Features, times: Float[np.ndarray, " L"], where: str) -> tuple[tuple[Light, ...], bool]:
    """One light for each lane, and whether rows of lights were moved.

    Rows are assigned to steps by their own timestamps, not by their order: in some files the lights lag by a step or more
    (github.com/waymo-research/waymax, issue 60 and pull request 93). A step without a row within half a step of it has no light.
    """
    periods = [signals for period in PERIODS if (signals := _signals(features, period, where))]
    if not any(signals.valid.any() for signals in periods):
        return (), False
    if len(slots := {signals.lanes.shape[1] for signals in periods}) > 1:
        raise SceneError(f"{where}traffic_light_state/*/id: expected one number of lights a step in all periods, got {sorted(slots)}")
    signals = _Signals(*(np.concatenate(columns) for columns in zip(*periods, strict=True)))
    row_of, near = _align(times, signals.times)
    moved = not np.array_equal(row_of[near], np.flatnonzero(near))
    lights = []
    for lane in np.unique(signals.lanes[signals.valid]).tolist():
        of_lane = signals.valid & (signals.lanes == lane)
        row, slot = (int(place[0]) for place in np.nonzero(of_lane))
        codes = np.max(np.where(of_lane, signals.state, -1), axis=1)[row_of]  # a lane has one place in a row
        lights.append(make_light(lane, np.where(near, codes, -1), signals.stop[row, slot]))
    return tuple(lights), moved


def _align(times: Float[np.ndarray, " L"], rows: Float[np.ndarray, " R"]) -> tuple[Int[np.ndarray, " L"], Bool[np.ndarray, " L"]]:
    """For each step the row that is nearest in time, and a mask of those within half a step."""
    apart = np.abs(times[:, None] - rows)
    nearest = np.argmin(apart, axis=1)
    half = np.median(np.diff(times)) / 2 if len(times) > 1 else 0.0
    return nearest, apart[np.arange(len(times)), nearest] <= half


def _roads(features: Features, jump_m: float, where: str) -> tuple[tuple[Polyline, ...], bool]:
    """Polylines of the map samples with one id, in their order, and whether the map is full.

    A polyline ends where the id or the type changes and, unless it is a polygon, at a long step. Each sample of a stop sign is a polyline.
    """
    prefix = "roadgraph_samples/"
    ids = _integers(features, f"{prefix}id", where)
    kinds = _integers(features, f"{prefix}type", where, length=len(ids))
    valid = _flags(features, f"{prefix}valid", where, len(ids))
    xyz = _floats(features, f"{prefix}xyz", where, length=3 * len(ids)).reshape(-1, 3)
    values.check_finite(xyz, f"{where}{prefix}xyz", rows=valid, keys=AXES)
    _require(np.isin(kinds, ELEMENTS) | ~valid, kinds, f"{where}{prefix}type", "a map element, 0 to 20 without 4")
    rows = np.flatnonzero(valid)
    if not len(rows):
        return (), False
    rows = rows[np.argsort(ids[rows], kind="stable")]
    ids, kinds, xyz = ids[rows], kinds[rows], xyz[rows]
    step = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    ends = (np.diff(ids) != 0) | (np.diff(kinds) != 0) | ((step > jump_m) & (kinds[1:] < POLYGONS)) | (kinds[1:] == STOP_SIGN)
    starts = np.concatenate([[0], np.flatnonzero(ends) + 1])
    parts = np.split(xyz, starts[1:])
    lines = zip(kinds[starts].tolist(), parts, ids[starts].tolist(), strict=True)
    return tuple(Polyline(kind=kind, xyz=part, id=number) for kind, part, number in lines), bool(valid.all())
