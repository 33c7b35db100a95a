"""A tf.Example of the Waymo Open Motion Dataset (waymo.com/open/data/motion/tfexample) -> RawScene.

The encoding has less than the Scenario proto: at most 128 objects, 16 lights a step and 20,000 or 30,000 map points (`map_full` in the
metadata: no room was left, so the map may be cut), no lane graph, no speed limits, float32 coordinates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Light, Polyline, RawScene, SceneError
from scenefactory_jax.core.types import STOP_SIGN
from scenefactory_jax.data.formats import scene_parts, womd_schema
from scenefactory_jax.data.formats.scene_parts import WOMD_TYPES, check_times, make_light, make_womd_tracks
from scenefactory_jax.data.formats.tfrecord import Record
from scenefactory_jax.data.formats.values import AXES, check_finite

PERIODS = ("past", "current", "future")
STATE = tuple("bbox_yaw" if name == "yaw" else name for name in scene_parts.STATE)
ELEMENTS = (*range(0, 4), *range(5, 21))  # map element ids; without 4
POLYGONS = 17  # stop signs and polygons have this id or a larger one; they are not split at long steps
MICROSECONDS = 1e6


@dataclass(frozen=True)
class Features:
    """The features of a tf.Example by their keys. Every method raises `SceneError` for numbers that it does not expect."""

    entries: Mapping[str, Any]  # key -> tf.train.Feature
    where: str  # of the record, for messages

    @property
    def name(self) -> str | None:
        """The scenario's id."""
        texts = self.entries["scenario/id"].bytes_list.value if "scenario/id" in self.entries else ()
        return texts[0].decode("utf-8", errors="backslashreplace") if texts else None

    def numbers(self, key: str, length: int | None = None) -> np.ndarray:
        """Numbers, float or integer as in the source, finite or not."""
        if key not in self.entries:
            raise SceneError(f"{self.where}{key}: missing")
        floats = self.entries[key].float_list.value
        with np.errstate(invalid="ignore"):  # a signalling NaN warns when it is widened
            numbers = np.array(floats, np.float64) if len(floats) else np.array(self.entries[key].int64_list.value, np.int64)
        if length is not None and len(numbers) != length:
            raise SceneError(f"{self.where}{key}: expected {length} numbers, got {len(numbers)}")
        return numbers

    def integers(self, key: str, length: int | None = None) -> Int[np.ndarray, " N"]:
        """Numbers as integers; ids and types of objects are floats in the format."""
        numbers = self.numbers(key, length)
        if numbers.dtype == np.int64:
            return numbers
        check_finite(numbers, f"{self.where}{key}")
        integers = np.clip(numbers, -(2**53), 2**53).astype(np.int64)  # beyond, not every integer is a float
        self.require(integers == numbers, numbers, key, "a whole number")
        return integers

    def flags(self, key: str, length: int) -> Bool[np.ndarray, " N"]:
        """Ones (yes), and zeros or minus ones (no, and padding)."""
        flags = self.integers(key, length)
        self.require((flags >= -1) & (flags <= 1), flags, key, "1, 0 or, as padding, -1")
        return flags == 1

    def columns(self, prefix: str, names: tuple[str, ...], rows: Bool[np.ndarray, " N"]) -> Float[np.ndarray, "N D"]:
        """Several features as a table, finite in the given rows."""
        columns = [self.numbers(f"{prefix}{name}", len(rows)).astype(np.float64) for name in names]
        for name, column in zip(names, columns, strict=True):
            check_finite(column, f"{self.where}{prefix}{name}", rows=rows)
        return np.stack(columns, axis=-1)

    def require(self, good: Bool[np.ndarray, " N"], numbers: np.ndarray, key: str, expected: str) -> None:
        """Refuses numbers that are not all good, naming the first."""
        if not good.all():
            place = int(np.argmin(good))
            raise SceneError(f"{self.where}{key}[{place}]: expected {expected}, got {numbers[place]}")


def parse(record: Record) -> Features | None:
    """The features of a WOMD tf.Example in a record; None if it has none."""
    try:
        entries = womd_schema.Example.FromString(record.data).features.feature
    except DecodeError:
        return None
    features = {entry.key.decode("utf-8", errors="backslashreplace"): entry.value for entry in entries}
    known = any(key.startswith(("state/", "roadgraph_samples/")) for key in features)
    return Features(features, f"{record.place}: ") if known else None


def make(features: Features, *, path: Path, record: Record, jump_m: float) -> RawScene:
    """The scene of one tf.Example."""
    where, ids = features.where, features.integers("state/id")
    numbers, valid, times, current = _states(features, len(ids))
    real = ids >= 0  # other rows are padding
    features.require(real | ~valid.any(axis=1), ids, "state/id", "an id, 0 or more, of an object with valid steps")
    kinds = features.integers("state/type", len(ids))
    known = (kinds >= 0) & (kinds < len(WOMD_TYPES))
    features.require(known | ~real, kinds, "state/type", f"a type of object, 0 to {len(WOMD_TYPES) - 1}")
    sdc = np.flatnonzero(features.flags("state/is_sdc", len(ids)) & real)
    if len(sdc) > 1:
        raise SceneError(f"{where}state/is_sdc: expected one recording car at most, got {len(sdc)}")
    lights, moved = _lights(features, times)
    roads, full = _roads(features, jump_m)
    return RawScene(
        name=features.name or f"{Path(path).name}#{record.number}",
        source=str(path),
        roads=roads,
        tracks=make_womd_tracks(
            numbers[real], valid[real], ids=ids[real].tolist(), kinds=kinds[real].tolist(), current=current, where=where
        ),
        times=times,
        current=current,
        sdc=int(real[: sdc[0]].sum()) if len(sdc) else None,
        lights=lights,
        metadata={"dataset": "WOMD", "format": "womd_example", "scenario_id": features.name, "record": record.number}
        | _metadata(features, ids, real)
        | {"map_full": full, "lights_moved": moved},
    )


def _states(features: Features, objects: int) -> tuple[Float[np.ndarray, "A L 9"], Bool[np.ndarray, "A L"], Float[np.ndarray, " L"], int]:
    """States of all objects (columns STATE), which of them are valid, the times (s) and the current step.

    A future without a valid step (hidden in WOMD's test set) is left out.
    """
    where = features.where
    if not objects:
        raise SceneError(f"{where}state/id: expected at least one object, got none")
    periods, current = [], 0
    for period in PERIODS:
        prefix = f"state/{period}/"
        if period != "current" and not any(key.startswith(prefix) for key in features.entries):
            continue
        count = len(features.numbers(f"{prefix}valid"))
        if count % objects or (period == "current" and count != objects):
            expected = f"{objects}" if period == "current" else f"a multiple of {objects}"
            raise SceneError(f"{where}{prefix}valid: expected {expected} numbers, for each of state/id, got {count}")
        flags = features.flags(f"{prefix}valid", count)
        if period == "future" and not flags.any():
            continue
        table = features.columns(prefix, STATE, flags).reshape(objects, -1, len(STATE))
        valid, stamps = (column.reshape(objects, -1) for column in (flags, features.integers(f"{prefix}timestamp_micros", count)))
        clock = np.where(valid.any(axis=0), np.where(valid, stamps, np.iinfo(np.int64).min).max(axis=0), stamps.max(axis=0))
        if not (known := valid.any(axis=0) | (clock >= 0)).all():
            raise SceneError(f"{where}{prefix}valid: no object is valid at step {int(np.argmin(known))}, so its time is not known")
        periods.append((table, valid, clock))
        current += valid.shape[1] if period == "past" else 0
    numbers, valid = (np.concatenate([entry[column] for entry in periods], axis=1) for column in (0, 1))
    times = np.concatenate([stamps for *_, stamps in periods]) / MICROSECONDS
    check_times(times, f"{where}state/{{past,current,future}}/timestamp_micros")
    return numbers, valid, times, current


def _metadata(features: Features, ids: Int[np.ndarray, " A"], real: Bool[np.ndarray, " A"]) -> dict[str, Any]:
    """Lists of objects, by their ids."""
    metadata: dict[str, Any] = {}
    for name in ("objects_of_interest", "tracks_to_predict"):
        if f"state/{name}" in features.entries:
            chosen = features.flags(f"state/{name}", len(ids)) & real
            metadata[name] = ids[chosen].tolist()
            if name == "tracks_to_predict" and "state/difficulty_level" in features.entries:
                metadata["difficulty_levels"] = features.integers("state/difficulty_level", len(ids))[chosen].tolist()
    return metadata


def _signals(features: Features, prefix: str) -> tuple[np.ndarray, ...]:
    """The lights of one period: times [R] (s, infinite: missing); lanes, states and valid flags [R, S]; stop points [R, S, 3].

    A row has S places; the place of a lane may differ between rows.
    """
    stamps, lanes = (features.integers(f"{prefix}{name}") for name in ("timestamp_micros", "id"))
    if not len(stamps) or len(lanes) % len(stamps):
        raise SceneError(f"{features.where}{prefix}id: expected a multiple of {len(stamps)} numbers, for each timestamp, got {len(lanes)}")
    state, valid = features.integers(f"{prefix}state", len(lanes)), features.flags(f"{prefix}valid", len(lanes))
    known = (state >= 0) & (state < len(LIGHT_STATES))
    features.require(known | ~valid, state, f"{prefix}state", f"a state of a light, 0 to {len(LIGHT_STATES) - 1}")
    times, stop = np.where(stamps < 0, np.inf, stamps / MICROSECONDS), features.columns(prefix, AXES, valid)
    lanes, state, valid = (column.reshape(len(stamps), -1) for column in (lanes, state, valid))
    return times, lanes, state, valid, stop.reshape(*valid.shape, 3)


def _lights(features: Features, times: Float[np.ndarray, " L"]) -> tuple[tuple[Light, ...], bool]:
    """One light for each lane, and whether rows of lights were moved.

    Rows are assigned to steps by their own timestamps, not by their order: in some files the lights lag by a step or more
    (github.com/waymo-research/waymax, issue 60 and pull request 93). A step without a row within half a step of it has no light.
    """
    prefixes = [f"traffic_light_state/{period}/" for period in PERIODS]
    periods = [_signals(features, prefix) for prefix in prefixes if f"{prefix}timestamp_micros" in features.entries]
    if not any(valid.any() for *_, valid, _ in periods):
        return (), False
    if len(slots := {lanes.shape[1] for _, lanes, *_ in periods}) > 1:
        where = f"{features.where}traffic_light_state/*/id"
        raise SceneError(f"{where}: expected one number of lights a step in all periods, got {sorted(slots)}")
    row_times, lanes, state, valid, stop = (np.concatenate(columns) for columns in zip(*periods, strict=True))
    apart = np.abs(times[:, None] - row_times)
    row_of = np.argmin(apart, axis=1)
    near = apart.min(axis=1) <= (np.median(np.diff(times)) / 2 if len(times) > 1 else 0.0)
    lights = []
    for lane in np.unique(lanes[valid]).tolist():
        of_lane = valid & (lanes == lane)
        row, slot = (int(place[0]) for place in np.nonzero(of_lane))
        codes = np.max(np.where(of_lane, state, -1), axis=1)[row_of]  # a lane has one place in a row
        lights.append(make_light(lane, np.where(near, codes, -1), stop[row, slot]))
    return tuple(lights), not np.array_equal(row_of[near], np.flatnonzero(near))


def _roads(features: Features, jump_m: float) -> tuple[tuple[Polyline, ...], bool]:
    """Polylines of the map samples with one id, in their order, and whether the map is full.

    A polyline ends where the id or the type changes and, unless it is a polygon, at a long step. Each sample of a stop sign is a polyline.
    """
    prefix = "roadgraph_samples/"
    ids = features.integers(f"{prefix}id")
    kinds, valid = features.integers(f"{prefix}type", len(ids)), features.flags(f"{prefix}valid", len(ids))
    xyz = features.numbers(f"{prefix}xyz", 3 * len(ids)).astype(np.float64).reshape(-1, 3)
    check_finite(xyz, f"{features.where}{prefix}xyz", rows=valid, keys=AXES)
    features.require(np.isin(kinds, ELEMENTS) | ~valid, kinds, f"{prefix}type", "a map element, 0 to 20 without 4")
    rows = np.flatnonzero(valid)
    if not len(rows):
        return (), False
    rows = rows[np.argsort(ids[rows], kind="stable")]
    ids, kinds, xyz = ids[rows], kinds[rows], xyz[rows]
    step = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    ends = (np.diff(ids) != 0) | (np.diff(kinds) != 0) | ((step > jump_m) & (kinds[1:] < POLYGONS)) | (kinds[1:] == STOP_SIGN)
    starts = np.concatenate([[0], np.flatnonzero(ends) + 1])
    lines = zip(kinds[starts].tolist(), np.split(xyz, starts[1:]), ids[starts].tolist(), strict=True)
    return tuple(Polyline(kind=kind, xyz=part, id=number) for kind, part, number in lines), bool(valid.all())
