"""A `RawScene` as one row of an Arrow table, and back: whole, exact, and readable by everything that reads Arrow.

The row is nested (`SCHEMA`): a list of roads, each with its list of points, and so on. Arrow keeps every leaf of it in one buffer, so that
a scene that lies in a memory-mapped file is made of views of the file: no coordinate is copied. Such arrays cannot be written to.

Shards of banks of schema 3 and 4 (`SCHEMA_4`) have no cycles of lights, and name the lanes of stop signs in the metadata.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from scenefactory_jax.core.raw_scene import Light, LightPlan, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import STOP_SIGN

POINT, PLANE, IDS = pa.list_(pa.float64(), 3), pa.list_(pa.float64(), 2), pa.list_(pa.int64())
ROAD_4 = {"id": pa.int64(), "kind": pa.int32(), "xyz": pa.list_(POINT), "entry": IDS, "exit": IDS, "left": IDS, "right": IDS}
ROAD_4 |= {"speed_limit": pa.float64(), "rebuilt": pa.bool_()}
ROAD = pa.struct(ROAD_4 | {"lanes": IDS})
MOTION = pa.struct({"xyz": POINT, "yaw": pa.float64(), "velocity": PLANE, "valid": pa.bool_()})
TRACK = pa.struct({"id": pa.int64(), "kind": pa.string(), "size": POINT, "log": pa.list_(MOTION)})
SIGNAL = pa.struct({"state": pa.int8(), "valid": pa.bool_()})
PHASE = pa.struct({"start_s": pa.float64(), "state": pa.int8()})
LIGHT_4 = {"lane": pa.int64(), "stop": POINT, "log": pa.list_(SIGNAL)}
LIGHT = pa.struct(LIGHT_4 | {"plan": pa.list_(PHASE), "period_s": pa.float64()})  # null: a light without a plan
HEAD = {"name": pa.string(), "source": pa.string(), "times": pa.list_(pa.float64()), "current": pa.int64(), "sdc": pa.int64()}
HEAD |= {"origin": POINT, "metadata": pa.string()}  # JSON
SCHEMA = pa.schema(HEAD | {"roads": pa.list_(ROAD), "tracks": pa.list_(TRACK), "lights": pa.list_(LIGHT)})
SCHEMA_4 = pa.schema(HEAD | {"roads": pa.list_(pa.struct(ROAD_4)), "tracks": pa.list_(TRACK), "lights": pa.list_(pa.struct(LIGHT_4))})
READABLE = (SCHEMA, SCHEMA_4)
LINKS = ("entry", "exit", "left", "right")


def encode(raw: RawScene) -> pa.RecordBatch:
    """The scene as a batch of one row.

    Raises:
        SceneError: a track, light or plan whose columns differ in length, metadata that JSON cannot hold, or a number out of its column's
            range.
    """
    try:
        metadata = json.dumps(raw.metadata, default=_plain)
        one: dict[str, Any] = {"name": raw.name, "source": raw.source, "current": raw.current, "sdc": raw.sdc, "metadata": metadata}
        columns = {name: pa.array([value], SCHEMA.field(name).type) for name, value in one.items()}
        columns["times"] = _list(_floats(raw.times), [len(raw.times)])
        columns["origin"] = _fixed(np.array(raw.origin, np.float64), 3)
        columns["roads"] = _list(_roads(raw.roads), [len(raw.roads)])
        columns["tracks"] = _list(_tracks(raw.tracks), [len(raw.tracks)])
        columns["lights"] = _list(_lights(raw.lights), [len(raw.lights)])
        return pa.RecordBatch.from_arrays([columns[name] for name in SCHEMA.names], schema=SCHEMA)
    except (TypeError, ValueError, OverflowError) as error:  # pyarrow's are among them
        raise SceneError(f"{raw.source}: {raw.name}: no bank can hold it: {error}") from error


def decode(batch: pa.RecordBatch) -> RawScene:
    """The scene of a batch of one row, of one of the READABLE schemas, as views of its buffers."""
    column = {name: batch.column(place) for place, name in enumerate(SCHEMA.names)}
    plain = {name: column[name][0].as_py() for name in ("name", "source", "current", "sdc", "metadata")}
    metadata, roads = json.loads(plain["metadata"]), _read_roads(column["roads"].values)
    if batch.schema.equals(SCHEMA_4):
        roads = _name_lanes(roads, metadata.pop("stop_sign_lanes", {}))
    return RawScene(
        **plain | {"metadata": metadata},
        roads=roads,
        tracks=_read_tracks(column["tracks"].values),
        times=column["times"].values.to_numpy(),
        lights=_read_lights(column["lights"].values),
        origin=tuple(column["origin"].values.to_pylist()),
    )


def _roads(roads: Sequence[Polyline]) -> pa.StructArray:
    links = {name: [getattr(line, name) for line in roads] for name in (*LINKS, "lanes")}
    leaves = {
        "id": pa.array([line.id for line in roads], pa.int64()),
        "kind": pa.array([line.kind for line in roads], pa.int32()),
        "xyz": _list(_fixed(_rows([line.xyz for line in roads], 3), 3), [len(line.xyz) for line in roads]),
        **{name: _list(pa.array([i for some in ids for i in some], pa.int64()), list(map(len, ids))) for name, ids in links.items()},
        "speed_limit": pa.array([line.speed_limit for line in roads], pa.float64()),
        "rebuilt": pa.array([line.rebuilt for line in roads], pa.bool_()),
    }
    return _struct(ROAD, leaves)


def _tracks(tracks: Sequence[Track]) -> pa.StructArray:
    for track in tracks:
        if not len(track.xyz) == len(track.yaw) == len(track.velocity) == len(track.valid):
            raise ValueError(f"track {track.id}: xyz, yaw, velocity and valid differ in length")
    log = {
        "xyz": _fixed(_rows([track.xyz for track in tracks], 3), 3),
        "yaw": _floats(_rows([track.yaw for track in tracks])),
        "velocity": _fixed(_rows([track.velocity for track in tracks], 2), 2),
        "valid": pa.array(_rows([track.valid for track in tracks], dtype=bool)),
    }
    leaves = {
        "id": pa.array([track.id for track in tracks], pa.int64()),
        "kind": pa.array([track.kind for track in tracks], pa.string()),
        "size": _fixed(np.array([track.size for track in tracks], np.float64), 3),
        "log": _list(_struct(MOTION, log), [len(track.valid) for track in tracks]),
    }
    return _struct(TRACK, leaves)


def _lights(lights: Sequence[Light]) -> pa.StructArray:
    for light in lights:
        if len(light.state) != len(light.valid):
            raise ValueError(f"the light of lane {light.lane}: state and valid differ in length")
        if light.plan is not None and len(light.plan.start_s) != len(light.plan.state):
            raise ValueError(f"the light of lane {light.lane}: start_s and state of its plan differ in length")
    missing = np.array([light.stop is None for light in lights], bool)
    stops = np.array([np.zeros(3) if light.stop is None else light.stop for light in lights], np.float64)
    log = {
        "state": pa.array(_rows([light.state for light in lights], dtype=np.int64)).cast(pa.int8()),
        "valid": pa.array(_rows([light.valid for light in lights], dtype=bool)),
    }
    leaves = {
        "lane": pa.array([light.lane for light in lights], pa.int64()),
        "stop": pa.FixedSizeListArray.from_arrays(_floats(stops), 3, mask=pa.array(missing)),
        "log": _list(_struct(SIGNAL, log), [len(light.valid) for light in lights]),
        **_plans([light.plan for light in lights]),
    }
    return _struct(LIGHT, leaves)


def _plans(plans: Sequence[LightPlan | None]) -> dict[str, pa.Array]:
    """Cycles of lights, and their periods."""
    known = [plan for plan in plans if plan is not None]
    phases = {
        "start_s": _floats(_rows([plan.start_s for plan in known])),
        "state": pa.array(_rows([plan.state for plan in known], dtype=np.int64)).cast(pa.int8()),
    }
    counts = [0 if plan is None else len(plan.state) for plan in plans]
    periods = [None if plan is None else float(plan.period_s) for plan in plans]
    return {"plan": _list(_struct(PHASE, phases), counts), "period_s": pa.array(periods, pa.float64())}


def _read_roads(roads: pa.StructArray) -> tuple[Polyline, ...]:
    ids, kinds, limits, rebuilt = (roads.field(name).to_pylist() for name in ("id", "kind", "speed_limit", "rebuilt"))
    points = _fixed_rows(roads.field("xyz").values, 3)
    xyz = [points[span] for span in _spans(roads.field("xyz"))]
    names = [field.name for field in roads.type]
    governed = _links(roads.field("lanes")) if "lanes" in names else [()] * len(roads)
    return tuple(map(Polyline, kinds, xyz, ids, *[_links(roads.field(name)) for name in LINKS], limits, rebuilt, governed))


def _name_lanes(roads: tuple[Polyline, ...], signs: Mapping[str, list[int]] | list[dict[str, Any]]) -> tuple[Polyline, ...]:
    """Stop signs with the lanes that the metadata of an older bank names: by sign, or as a list of records."""
    named = {str(record["sign"]): record["lanes"] for record in signs} if isinstance(signs, list) else signs
    return tuple(
        replace(line, lanes=tuple(named[str(line.id)])) if line.kind == STOP_SIGN and str(line.id) in named else line for line in roads
    )


def _read_tracks(tracks: pa.StructArray) -> tuple[Track, ...]:
    ids, kinds = tracks.field("id").to_pylist(), tracks.field("kind").to_pylist()
    sizes = [tuple(size) for size in _fixed_rows(tracks.field("size"), 3).tolist()]
    steps = tracks.field("log").values
    xyz, velocity = _fixed_rows(steps.field("xyz"), 3), _fixed_rows(steps.field("velocity"), 2)
    yaw, valid = steps.field("yaw").to_numpy(), _flags(steps.field("valid"))
    return tuple(
        Track(id=ids[i], kind=kinds[i], size=sizes[i], xyz=xyz[span], yaw=yaw[span], velocity=velocity[span], valid=valid[span])
        for i, span in enumerate(_spans(tracks.field("log")))
    )


def _read_lights(lights: pa.StructArray) -> tuple[Light, ...]:
    lanes, log, stops = lights.field("lane").to_pylist(), lights.field("log"), lights.field("stop")
    known, points = _flags(stops.is_valid()), _fixed_rows(stops, 3)
    state, valid = log.values.field("state").to_numpy(), _flags(log.values.field("valid"))
    plans = _read_plans(lights)
    return tuple(Light(lanes[i], state[span], valid[span], points[i] if known[i] else None, plans[i]) for i, span in enumerate(_spans(log)))


def _read_plans(lights: pa.StructArray) -> list[LightPlan | None]:
    if "plan" not in [field.name for field in lights.type]:
        return [None] * len(lights)
    phases, periods = lights.field("plan"), lights.field("period_s").to_pylist()
    start, state = (phases.values.field(name).to_numpy() for name in ("start_s", "state"))
    spans = _spans(phases)
    return [None if period is None else LightPlan(start[span], state[span], period) for period, span in zip(periods, spans, strict=True)]


def _struct(kind: pa.StructType, leaves: dict[str, pa.Array]) -> pa.StructArray:
    return pa.StructArray.from_arrays([leaves[field.name] for field in kind], fields=list(kind))


def _list(values: pa.Array, counts: Sequence[int]) -> pa.ListArray:
    """Lists of so many values each, laid end to end."""
    return pa.ListArray.from_arrays(pa.array(np.cumsum([0, *counts]), pa.int32()), values)


def _fixed(rows: np.ndarray, width: int) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(_floats(rows), width)


def _floats(values: np.ndarray) -> pa.DoubleArray:
    return pa.array(np.ascontiguousarray(values, np.float64).reshape(-1))


def _rows(tables: Sequence[np.ndarray], *tail: int, dtype: Any = np.float64) -> np.ndarray:
    """Tables end to end; one without rows where there are none."""
    return np.concatenate(tables).astype(dtype, copy=False) if tables else np.zeros((0, *tail), dtype)


def _spans(lists: pa.ListArray) -> list[slice]:
    """Where each list's values lie."""
    bounds = lists.offsets.to_pylist()
    return list(map(slice, bounds[:-1], bounds[1:]))


def _fixed_rows(array: pa.FixedSizeListArray, width: int) -> np.ndarray:
    return array.values.to_numpy().reshape(-1, width)


def _flags(array: pa.BooleanArray) -> np.ndarray:
    """Arrow packs booleans into bits: these are copies."""
    return array.to_numpy(zero_copy_only=False)


def _links(lists: pa.ListArray) -> list[tuple[int, ...]]:
    ids = lists.values.to_pylist()
    if not ids:
        return [()] * len(lists)
    return [tuple(ids[span]) for span in _spans(lists)]


def _plain(value: Any) -> Any:
    """numpy's values as JSON's."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"metadata holds a {type(value).__name__}; valid are JSON's values")
