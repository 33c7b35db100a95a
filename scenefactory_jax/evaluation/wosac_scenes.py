"""Reads what WOSAC's scores need of a scene from its source: all objects of the current step with heights and sizes, the evaluated ones,
and road edges, lanes and lights in space.

Packed scenes are flat and cut to a square; so this reads the checked scene (`PackReport.raw`) beside it. Positions are relative to the
packed scene's centre, as simulated ones are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from scenefactory_jax.core.raw_scene import Polyline, RawScene
from scenefactory_jax.core.scene_arrays import stack_tracks
from scenefactory_jax.core.types import EDGES, LANE_STREET
from scenefactory_jax.data.packing.pack import PackReport
from scenefactory_jax.evaluation.metrics.wosac_features import DT_S, HISTORY_STEPS, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import Lights, Lines, RoadMap
from scenefactory_jax.evaluation.metrics.wosac_submission import STEPS

EVEN_S = 1e-3  # by which the step of a log may differ from DT_S
NONE = -1  # slot of an object that the simulation lacks


class Points(NamedTuple):
    """Points of polylines, as `Lines`, without padding."""

    position: Float[np.ndarray, "P 3"]
    line: Int[np.ndarray, " P"]  # index into `RawScene.roads`


class LoggedLights(NamedTuple):
    """Lights, as `Lights`."""

    lane: Int[np.ndarray, " L"]
    state: Int[np.ndarray, "T L"]
    stop: Float[np.ndarray, "L 3"]


class LoggedScene(NamedTuple):
    """A scene as WOSAC sees it, on the host: O objects that are valid at the current step, in the order of their tracks."""

    name: str
    object_id: Int[np.ndarray, " O"]
    state: Float[np.ndarray, "O T 4"]  # history and future, 91 steps; as in `Objects`, relative to `origin`
    valid: Bool[np.ndarray, "O T"]
    size: Float[np.ndarray, "O 3"]
    vehicle: Bool[np.ndarray, " O"]
    evaluated: Int[np.ndarray, " E"]  # rows of the recording car and of the tracks to predict
    missing: int  # tracks to predict that are not valid at the current step: they are not evaluated
    slot: Int[np.ndarray, " O"]  # among the agents, then the traffic, of the packed scene; or NONE
    edges: Points
    lanes: Points  # of surface streets
    lights: LoggedLights  # that have a stop point
    origin: Float[np.ndarray, "3"]  # in the source's coordinates


def read_scene(report: PackReport, *, agents: int, traffic: int) -> LoggedScene | str:
    """Reads a scene, or returns the reason why it has no such scores.

    Args:
        report: with the checked scene, `raw`.
        agents: slots of the simulation.
        traffic: its rows of background traffic; 0: it has none.
    """
    raw = report.raw
    assert raw is not None
    if (reason := _find_fault(raw)) is not None:
        return reason
    rows = [row for row, track in enumerate(raw.tracks) if track.valid[raw.current]]
    tracks, origin = [raw.tracks[row] for row in rows], np.array(report.centre)
    ids = [track.id for track in tracks]
    if len(set(ids)) < len(ids):
        return "two objects of one id"
    places = {name: agents + row for row, name in enumerate(report.traffic_ids[:traffic])} | _number(report.track_ids[:agents])
    recording = [] if raw.sdc is None else [raw.tracks[raw.sdc].id]
    chosen: dict[int, None] = dict.fromkeys([*recording, *raw.metadata.get("tracks_to_predict", ())])  # each once, in this order
    number = _number(ids)
    state, valid, size = _read_log(raw, rows, origin)
    return LoggedScene(
        name=raw.name,
        object_id=np.array(ids, np.int64),
        state=state,
        valid=valid,
        size=size,
        vehicle=np.array([track.kind == "vehicle" for track in tracks], bool),
        evaluated=np.array([number[name] for name in chosen if name in number], np.int32),
        missing=sum(name not in number for name in chosen),
        slot=np.array([places.get(name, NONE) for name in ids], np.int32),
        edges=_join_lines(raw.roads, EDGES, origin),
        lanes=_join_lines(raw.roads, (LANE_STREET,), origin),
        lights=_read_lights(raw, origin),
        origin=origin,
    )


def _find_fault(raw: RawScene) -> str | None:
    step = float(np.median(np.diff(raw.times))) if len(raw.times) > 1 else np.nan
    if raw.current != HISTORY_STEPS - 1:
        return f"the current step is {raw.current}, not {HISTORY_STEPS - 1}"
    if not abs(step - DT_S) < EVEN_S:
        return f"the log's step is {step:g} s, not {DT_S:g} s"
    if not any(track.valid[raw.current] for track in raw.tracks):
        return "no object at the current step"
    return None


def _number(names: Sequence[int]) -> dict[int, int]:
    return {name: row for row, name in enumerate(names)}


def _read_log(raw: RawScene, rows: list[int], origin: Float[np.ndarray, "3"]) -> tuple[np.ndarray, ...]:
    """States of the tracks over 91 steps, which of them are valid, and sizes; steps behind the log's end are not valid."""
    logs, length = stack_tracks([raw.tracks[row] for row in rows], len(raw.times)), HISTORY_STEPS + STEPS
    state = np.concatenate([logs.xyz - origin, logs.yaw[..., None]], axis=-1)
    state = np.where(logs.valid[..., None], state, 0.0)[:, :length]
    behind = [(0, 0), (0, length - state.shape[1])]
    return np.pad(state, [*behind, (0, 0)]).astype(np.float32), np.pad(logs.valid[:, :length], behind), logs.size.astype(np.float32)


def _read_lights(raw: RawScene, origin: Float[np.ndarray, "3"]) -> LoggedLights:
    number = {line.id: row for row, line in enumerate(raw.roads) if line.kind == LANE_STREET}
    lights = [light for light in raw.lights if light.stop is not None and light.lane in number]
    length = HISTORY_STEPS + STEPS
    states = np.zeros((length, len(lights)), np.int32)
    for column, light in enumerate(lights):
        shown = np.where(light.valid, light.state, 0)[:length]
        states[: len(shown), column] = shown
    stop = np.array([light.stop for light in lights], np.float64).reshape(-1, 3) - origin
    return LoggedLights(np.array([number[light.lane] for light in lights], np.int32), states, stop.astype(np.float32))


def _join_lines(roads: Sequence[Polyline], kinds: tuple[int, ...], origin: Float[np.ndarray, "3"]) -> Points:
    rows = [row for row, line in enumerate(roads) if line.kind in kinds]
    xyz = np.concatenate([np.zeros((0, 3)), *(roads[row].xyz for row in rows)]) - origin
    line = np.repeat(rows, [len(roads[row].xyz) for row in rows]).astype(np.int32)
    return Points(xyz.astype(np.float32), line)


def pad_scenes(scenes: Sequence[LoggedScene]) -> tuple[list[tuple], int]:
    """Pads scenes to common sizes, so that one program scores them all, and puts them onto the device.

    Returns:
        For each scene the log, the rows of evaluated objects, which of these are no padding, which objects are vehicles, and the road; and
        the number of objects.
    """
    count = lambda of: max(1, *(of(scene) for scene in scenes))  # noqa: E731
    objects, evaluated = count(lambda scene: len(scene.object_id)), count(lambda scene: len(scene.evaluated))
    edges, lanes = count(lambda scene: len(scene.edges.line)), count(lambda scene: len(scene.lanes.line))
    lights = count(lambda scene: len(scene.lights.lane))
    put = lambda *arguments, **axis: jax.device_put(pad(*arguments, **axis))  # noqa: E731
    put_lines = lambda points, size: Lines(*(put(leaf, size) for leaf in (*points, np.ones(len(points.line), bool))))  # noqa: E731
    operands = []
    for scene in scenes:
        log = Objects(*(put(leaf, objects) for leaf in (scene.state, scene.valid, scene.size)))
        lane, state, stop = scene.lights
        road = RoadMap(
            put_lines(scene.edges, edges),
            put_lines(scene.lanes, lanes),
            Lights(put(lane, lights), put(state, lights, axis=1), put(stop, lights)),
        )
        kept = jax.device_put(np.arange(evaluated) < len(scene.evaluated))
        operands.append((log, put(scene.evaluated, evaluated), kept, put(scene.vehicle, objects), road))
    return operands, objects


def pad(values: np.ndarray, size: int, *, axis: int = 0) -> np.ndarray:
    """Pads an axis with zeros at its end."""
    return np.pad(values, [(0, size - values.shape[axis] if place == axis else 0) for place in range(values.ndim)])
