"""nuPlan's logs: SQLite databases (`nuplan-v1.1/splits/mini/LOG.db`), with maps beside them (`maps/CITY/VERSION/map.gpkg`).

Frames (`lidar_pc`) come every 0.05 s. `ego_pose` gives the middle of the rear axle of a Chrysler Pacifica in UTM, and velocities in the
car's frame; `lidar_box` gives the objects, with velocities in UTM's. Lights are those of lane connectors, estimated from the traffic. The
map has no heights: everything stands on a level.
"""

import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from scenefactory_jax.core.raw_scene import LIGHT_STATES, Companion, Light, OtherContent, RawScene, Reject, SceneError, Track
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import city_map, geopackage, nuplan_map, scene_parts
from scenefactory_jax.data.formats.city_map import CityMap, CityNumbers, EgoBox
from scenefactory_jax.data.formats.geopackage import Database

EGO = "ego"
KINDS: dict[str, RoadUser] = {"vehicle": "vehicle", "bicycle": "cyclist", "pedestrian": "pedestrian"}  # cones, barriers, signs: other
LIGHTS = {"green": "go", "yellow": "caution", "red": "stop", "unknown": "unknown"}
CITIES = {
    "vegas": "us-nv-las-vegas-strip",
    "boston": "us-ma-boston",
    "pittsburgh": "us-pa-pittsburgh-hazelwood",
    "singapore": "sg-one-north",
}
ROTATION = ("qw", "qx", "qy", "qz")
BREAK = 1.5  # steps: between frames that are farther apart the log is broken


class _Frames(NamedTuple):
    """The frames of a log that have a pose, in their order."""

    keys: list[Any]  # tokens as the database has them
    scenes: list[str]
    seconds: Float[np.ndarray, " F"]  # since the first one
    poses: Float[np.ndarray, "F 9"]  # x, y, rotation, velocity in the car's frame, yaw rate; the last three may be NaN


class _Window(NamedTuple):
    """A scene of a log."""

    rows: Int[np.ndarray, " L"]  # of `_Frames`
    name: str


@dataclass(frozen=True)
class _Log:
    """What the scenes of a log share."""

    database: Database
    frames: _Frames
    objects: dict[Any, tuple[RoadUser, tuple[Any, ...]]]  # kind and size by token
    types: dict[Any, set[str]]  # of `scenario_tag`, by frame
    about: dict[str, Any]  # metadata
    city: CityMap
    current: int
    reach_m: float
    ego: EgoBox


def read(
    path: Path,
    *,
    step_s: float,
    steps: int | None,
    current: int,
    tags: list[str] | None,
    maps: str | None,
    roads: CityNumbers,
    ego: EgoBox,
    row_limit: int,
) -> Iterator[RawScene | Reject]:
    """Reads the scenes of a log: one after another, named by the token of their current frame, as nuPlan names its scenarios.

    Args:
        path, step_s, current: see `formats`; the frames nearest to the steps are taken, with their own times.
        steps: of a scene; null: each of nuPlan's own scenes, of up to 20 s, is one, named by its token.
        tags: types of `scenario_tag`: scenes are around the frames that have one of them, apart from each other; null: all along the log.
        maps: the folder of the maps; null: `maps` in a folder above the log.
        roads: numbers of the map.
        ego: the recording car.
        row_limit: larger tables are refused, as are scenes with more boxes.
    """
    if Path(path).match("nuplan-maps-*.json"):
        raise Companion(f"{path}: the list of nuPlan's maps")
    with geopackage.open_database(path, row_limit) as database:
        if "lidar_pc" not in database.columns:
            if geopackage.CONTENTS in database.columns and nuplan_map.PATHS in database.columns:
                raise Companion(f"{path}: a map of nuPlan's logs")
            raise OtherContent(f"{path}: an SQLite database, but no log of nuPlan: no table lidar_pc")
        if steps is not None and not 0 <= current < steps:
            raise SceneError(f"{path}: formats.nuplan.current: expected a step of a scene, 0 to {steps - 1}, got {current}")
        frames, types = _read_frames(database), _read_types(database)
        windows = _cut(frames, types, step_s, steps, current, tags, str(path))
        about, source = _find_map(database, maps)
        driven = np.concatenate([frames.poses[window.rows, :2] for window in windows])
        box = np.concatenate([driven.min(axis=0) - roads.reach_m, driven.max(axis=0) + roads.reach_m])
        city = nuplan_map.read_map(source, box, numbers=roads, row_limit=row_limit)
        log = _Log(database, frames, _read_objects(database), types, about, city, current, roads.reach_m, ego)
        for window in windows:
            try:
                yield _make_scene(log, window)
            except SceneError as error:
                yield Reject(window.name, str(error).removeprefix(f"{path}: "))


def _make_scene(log: _Log, window: _Window) -> RawScene:
    """One scene."""
    frames, path = log.frames, str(log.database.path)
    keys = [frames.keys[row] for row in window.rows]
    times = frames.seconds[window.rows] - frames.seconds[window.rows[0]]
    boxes, ids = _read_boxes(log.database, keys)
    ego = _make_ego(frames.poses[window.rows], times, log.ego, ids[EGO], f"{path}: ego_pose")
    tracks = [_make_track(log, token, rows, times, ids[_name(token)]) for token, rows in boxes.items()]
    roads = city_map.cut_roads(log.city, ego.xyz[:, :2], log.reach_m)
    lanes = {lane.id for lane in log.city.lanes} & {line.id for line in roads}
    if not lanes:
        raise SceneError(f"{path}: {window.name}: expected lanes within {log.reach_m:g} m of the recording car, got none")
    return RawScene(
        name=f"{log.about['log']}-{window.name}",
        source=path,
        roads=roads,
        tracks=(ego, *(track for track in tracks if track is not None)),
        times=times,
        current=log.current,
        sdc=0,
        lights=_read_lights(log.database, keys, lanes),
        metadata=log.about
        | {
            "scene_token": frames.scenes[window.rows[log.current]],
            "scenario_token": _name(keys[log.current]),
            "scenario_types": sorted(set().union(*(log.types.get(key, ()) for key in frames.keys[window.rows[0] : window.rows[-1] + 1]))),
            "intersection_lanes": sorted(log.city.inside & lanes),
            "left_out": dict(Counter("object without a size" for track in tracks if track is None)),
            "tokens": {"tracks": scene_parts.list_tokens(ids)},
        },
    )


def _name(token: Any) -> str:
    """A token as nuPlan writes it."""
    return token.hex() if isinstance(token, bytes) else str(token)


def _to_numbers(rows: Sequence[Sequence[Any]], width: int, where: str) -> Float[np.ndarray, "N D"]:
    """A table of numbers; NaN in place of NULL."""
    try:
        return np.array([[np.nan if value is None else float(value) for value in row] for row in rows], float).reshape(-1, width)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{where}: expected numbers: {str(error)[:100]}") from error


def _read_frames(database: Database) -> _Frames:
    """The frames that have a pose; of several at one time the first."""
    where = f"{database.path}: ego_pose"
    found = database.select("ego_pose", ("token", "x", "y", *ROTATION), optional=("vx", "vy", "angular_rate_z"))
    table = _to_numbers([row[1:] for row in found], 9, where)
    places = {row[0]: place for place, row in enumerate(found) if np.isfinite(table[place, :6]).all()}
    rows = database.select("lidar_pc", ("token", "ego_pose_token", "timestamp"), optional=("scene_token",))
    rows = sorted((row for row in rows if row[1] in places and isinstance(row[2], int)), key=lambda row: row[2])
    rows = [row for place, row in enumerate(rows) if place == 0 or row[2] > rows[place - 1][2]]
    if not rows:
        raise SceneError(f"{where}: expected the poses of frames (lidar_pc), got {len(places)} poses of none")
    seconds = np.array([(row[2] - rows[0][2]) * 1e-6 for row in rows])
    return _Frames([row[0] for row in rows], [_name(row[3]) for row in rows], seconds, table[[places[row[1]] for row in rows]])


def _read_types(database: Database) -> dict[Any, set[str]]:
    """The types of scenarios at each frame, by its token."""
    types = defaultdict(set)
    rows = database.select("scenario_tag", ("lidar_pc_token", "type")) if "scenario_tag" in database.columns else []
    for token, kind in rows:
        types[token].add(str(kind))
    return dict(types)


def _pick_runs(seconds: Float[np.ndarray, " F"], step_s: float) -> list[Int[np.ndarray, " _"]]:
    """Rows of the frames nearest to even steps, in runs without a break."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(seconds) > BREAK * step_s) + 1, [len(seconds)]])
    runs = []
    for first, stop in itertools.pairwise(starts):
        part = seconds[first:stop]
        steps = part[0] + step_s * np.arange(round((part[-1] - part[0]) / step_s) + 1)
        after = np.clip(np.searchsorted(part, steps), 1, max(len(part) - 1, 1))
        near = first + np.where(steps - part[after - 1] <= part[np.minimum(after, len(part) - 1)] - steps, after - 1, after)
        runs.append(np.unique(np.minimum(near, stop - 1)))
    return runs


def _cut(
    frames: _Frames, types: dict[Any, set[str]], step_s: float, steps: int | None, current: int, tags: list[str] | None, where: str
) -> list[_Window]:
    """The scenes of a log; see `read`."""
    runs = _pick_runs(frames.seconds, step_s)
    tagged = [[row for row, key in enumerate(frames.keys) if tag in types.get(key, ())] for tag in tags or ()]
    windows: list[_Window] = []
    for run in runs:
        if steps is None:
            names = np.array([frames.scenes[row] for row in run])
            parts = np.split(run, np.flatnonzero(names[1:] != names[:-1]) + 1)
            if tags is not None:
                parts = [part for part in parts if any(part[0] <= row <= part[-1] for rows in tagged for row in rows)]
        elif tags is None:
            parts = [run[first : first + steps] for first in range(0, len(run), steps)]
        else:
            firsts = {first for rows in tagged for first in _place_apart(run, rows, current, steps)}
            parts = [run[first : first + steps] for first in sorted(firsts)]
        for rows in parts:
            if len(rows) > current and len(rows) == (steps or len(rows)):
                windows.append(_Window(rows, frames.scenes[rows[current]] if steps is None else _name(frames.keys[rows[current]])))
    if not windows:
        wanted = f"{steps or current + 1} steps of {step_s:g} s without a break" + (f" around a tag of {', '.join(tags)}" if tags else "")
        raise SceneError(f"{where}: lidar_pc: expected {wanted}, got up to {max(map(len, runs))} steps and no such scene")
    return windows


def _place_apart(run: Int[np.ndarray, " _"], rows: Sequence[int], current: int, steps: int) -> list[int]:
    """First steps, in a run, of scenes whose current steps are at these frames, without those that overlap the one before."""
    firsts, end = [], 0
    for row in rows:
        first = int(np.searchsorted(run, row)) - current
        if run[0] <= row <= run[-1] and end <= first:
            firsts.append(first)
            end = first + steps
    return firsts


def _find_map(database: Database, maps: str | None) -> tuple[dict[str, Any], Path]:
    """Metadata of the log, and its map: in the folder of its city, in that of its version if it names one."""
    rows = database.select("log", ("map_version",), optional=("logfile", "location", "date"))
    version, name, location, date = (str(value or "") for value in (*rows, (None,) * 4)[0])
    cities = [city for word, city in CITIES.items() if word in f"{location} {version}".lower()]
    folders = [text for text in (version.removesuffix(".gpkg"), *cities, location) if re.fullmatch(r"[\w][\w.-]*", text)]
    named = [f"{city}/{version}/map.gpkg" for city in folders if re.fullmatch(r"[\d.]*\d", version)]
    patterns = [*named, *(f"{city}/*/map.gpkg" for city in folders if city != version or not named), *(f"{city}.gpkg" for city in folders)]
    source = city_map.find_file(database.path, maps, "formats.nuplan.maps", list(dict.fromkeys(patterns)) or ["CITY/*/map.gpkg"])
    city = source.parent.parent.name if source.name == "map.gpkg" else source.stem
    return {"dataset": "nuPlan", "format": "nuplan", "log": name or database.path.stem, "map": city, "date": date}, source


def _read_objects(database: Database) -> dict[Any, tuple[RoadUser, tuple[Any, ...]]]:
    """Kind and size (length, width, height) of the objects, by their tokens."""
    names = dict(database.select("category", ("token", "name")))
    rows = database.select("track", ("token", "category_token"), optional=("length", "width", "height"))
    return {row[0]: (KINDS.get(str(names.get(row[1])), "other"), row[2:]) for row in rows}


def _read_boxes(database: Database, keys: Sequence[Any]) -> tuple[dict[Any, Float[np.ndarray, "L 8"]], dict[str, int]]:
    """Tables of objects by their tokens, over the frames `keys` (x, y, yaw, velocity, size; NaN: no box), and the ids of all."""
    columns = ("lidar_pc_token", "track_token", "x", "y", "yaw")
    found = database.select("lidar_box", columns, optional=("vx", "vy", "length", "width", "height"), among=("lidar_pc_token", keys))
    rows = [row for row in found if row[1] is not None]
    table = _to_numbers([row[2:] for row in rows], 8, f"{database.path}: lidar_box")
    step = {key: place for place, key in enumerate(keys)}
    boxes: dict[Any, Float[np.ndarray, "L 8"]] = {}
    for row, numbers in zip(rows, table, strict=True):
        boxes.setdefault(row[1], np.full((len(keys), 8), np.nan))[step[row[0]]] = numbers
    return boxes, scene_parts.assign_ids([EGO, *sorted(map(_name, boxes))])


def _make_ego(poses: Float[np.ndarray, "L 9"], times: Float[np.ndarray, " L"], ego: EgoBox, number: int, where: str) -> Track:
    """The recording car. Velocities that are missing follow from the positions."""
    yaw, valid = city_map.find_yaw(poses[:, 2:6]), np.ones(len(poses), bool)
    centre = city_map.place_ego(poses[:, :2], yaw, ego)
    rate = np.where(np.isfinite(poses[:, 8]), poses[:, 8], city_map.differentiate(np.unwrap(yaw)[:, None], times, valid)[:, 0])
    ahead, left = poses[:, 6], poses[:, 7] + ego.centre_m * rate
    cosine, sine = np.cos(yaw), np.sin(yaw)
    velocity = np.stack([cosine * ahead - sine * left, sine * ahead + cosine * left], axis=1)
    return city_map.make_track(where, number, "vehicle", ego.size_m, centre, yaw, velocity, valid, times)


def _make_track(log: _Log, token: Any, table: Float[np.ndarray, "L 8"], times: Float[np.ndarray, " L"], number: int) -> Track | None:
    """An object with the size of its box at the current step or at its first one; None if it has none."""
    valid = np.asarray(np.isfinite(table[:, :3]).all(axis=1))
    kind, named = log.objects.get(token, ("other", (None,) * 3))
    where = f"{log.database.path}: track {_name(token)}"
    sizes = np.concatenate([table[[log.current], 5:], table[:, 5:], _to_numbers([named], 3, where)])
    known = np.flatnonzero(np.isfinite(sizes).all(axis=1))
    if not len(known):
        return None
    return city_map.make_track(where, number, kind, sizes[known[0]].tolist(), table[:, :2], table[:, 2], table[:, 3:5], valid, times)


def _read_lights(database: Database, keys: Sequence[Any], lanes: set[int]) -> tuple[Light, ...]:
    """The lights of the lanes there."""
    table = "traffic_light_status"
    columns = ("lidar_pc_token", "lane_connector_id", "status")
    rows = database.select(table, columns, among=("lidar_pc_token", keys)) if table in database.columns else []
    step = {key: place for place, key in enumerate(keys)}
    codes: dict[int, Int[np.ndarray, " L"]] = {}
    for key, lane, status in rows:
        if lane not in lanes:
            continue
        if str(status).lower() not in LIGHTS:
            raise SceneError(f"{database.path}: {table}: status: expected {', '.join(LIGHTS)}, got {status!r:.40}")
        codes.setdefault(int(lane), np.full(len(keys), -1))[step[key]] = LIGHT_STATES.index(LIGHTS[str(status).lower()])
    return tuple(scene_parts.make_light(lane, states, None) for lane, states in codes.items())
