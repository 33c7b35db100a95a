"""nuScenes: tables as JSON (`v1.0-mini`, `v1.0-trainval`, `v1.0-test`) and its map expansion (`maps/expansion/CITY.json`) beside them.

A scene of 20 s has key frames (`sample`) every 0.5 s, at which objects are annotated; `ego_pose` gives the middle of the rear axle of a
Renault Zoe at each sweep of the lidar, every 0.05 s. Everything is resampled to even steps, as ScenarioNet does: between two key frames
positions and headings are interpolated linearly, and so are the velocities, which are central differences over the key frames. The map
has no heights, and the cars' poses have none: everything stands on a level.
"""

from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, RawScene, Reject, SceneError, Track
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import city_map, file_content, json_rows, nuscenes_map, scene_parts, values
from scenefactory_jax.data.formats.city_map import CityMap, CityNumbers, EgoBox
from scenefactory_jax.data.formats.values import Node

SCENES = "scene.json"
TABLES = (
    "sample",
    "sample_data",
    "ego_pose",
    "calibrated_sensor",
    "sensor",
    "sample_annotation",
    "instance",
    "category",
    "attribute",
    "log",
)
SENSORS = ("CAM_", "LIDAR_", "RADAR_", "MergedPointCloud")  # beginnings of folders with recordings of sensors, as of nuPlan's
RECORDINGS = (".jpg", ".bin", ".pcd")
OTHERS = ("map", "visibility", "lidarseg", "panoptic", "image_annotations")  # of the same folder, which no scene needs
EGO = "ego"
KINDS: dict[str, RoadUser] = {  # beginnings of a category's name; the first that fits
    "vehicle.bicycle": "cyclist", "vehicle.motorcycle": "cyclist", "vehicle.": "vehicle", "human.": "pedestrian"
}  # fmt: skip
WITHOUT_RIDER = "cycle.without_rider"  # an attribute: a parked cycle is no cyclist
ROTATION = ("w", "x", "y", "z")
POSE = ("timestamp", "x", "y", *ROTATION)
BOX = ("x", "y", *ROTATION, "length", "width", "height", "without_rider")


class _Annotations(NamedTuple):
    """The annotations of a scene: the number of the object and of the key frame, and BOX."""

    objects: array
    frames: array
    numbers: array  # ten to an annotation


@dataclass
class _Tables:
    """What the scenes need of the tables."""

    scenes: list[dict[str, str]]
    logs: dict[str, dict[str, Any]]
    times: dict[str, list[int]]  # of the key frames, microseconds, by scene
    poses: dict[str, array]  # of the recording car by scene, POSE
    annotations: dict[str, _Annotations]  # by scene
    objects: list[tuple[str, str]]  # token and category


def read(
    path: Path,
    *,
    step_s: float,
    current: int,
    maps: str | None,
    roads: CityNumbers,
    ego: EgoBox,
    row_limit: int,
    file_limit_mb: int,
) -> Iterator[RawScene | Reject]:
    """Reads the scenes of `scene.json`, named as there; the other tables beside it and the maps are companions.

    Args:
        path, step_s, current: see `formats`.
        maps: the folder of the maps; null: `maps` in a folder above the tables.
        roads, ego: see `nuplan.read`.
        row_limit: tables with more objects are refused.
        file_limit_mb: of a map, see `formats`.
    """
    _check_kind(path)
    tables = _read_tables(path, row_limit)
    cities: dict[str, CityMap | SceneError] = {}
    for scene in tables.scenes:
        place = str(tables.logs.get(scene["log_token"], {}).get("location", ""))
        try:
            if place not in cities:
                cities[place] = _read_city(path, maps, place, roads, file_limit_mb)
            if isinstance(city := cities[place], SceneError):
                raise city
            yield _make_scene(tables, scene, city, place, step_s, current, roads.reach_m, ego, str(path))
        except SceneError as error:
            yield Reject(scene["name"], str(error).removeprefix(f"{path}: "))


def _check_kind(path: Path) -> None:
    """Raises for any file but `scene.json`: whether it belongs to it."""
    if Path(path).suffix in RECORDINGS and Path(path).parent.name.startswith(SENSORS):
        raise Companion(f"{path}: a recording of a sensor")
    start, name = file_content.read_head(path).removeprefix(b"\xef\xbb\xbf").lstrip(), Path(path).name
    if start.startswith(b"{") and any(key in start for key in nuscenes_map.KEYS):
        raise Companion(f"{path}: a map of nuScenes")
    if not start.startswith(b"[") or name.removesuffix(".json") not in ("scene", *TABLES, *OTHERS):
        raise FormatMismatch(f"{path}: expected nuScenes' table {SCENES}, got a file that begins with {start[:16]!r}")
    if name != SCENES:
        if not Path(path).with_name(SCENES).is_file():
            raise FormatMismatch(f"{path}: expected nuScenes' table {SCENES} beside it")
        raise Companion(f"{path}: a table of nuScenes")


def _read_city(path: Path, maps: str | None, place: str, numbers: CityNumbers, file_limit_mb: int) -> CityMap | SceneError:
    """The map of a city, or why there is none."""
    try:
        if place not in nuscenes_map.CITIES:
            return SceneError(f"{path}: log: location: expected {', '.join(nuscenes_map.CITIES)}, got {place!r:.40}")
        found = city_map.find_file(path, maps, "formats.nuscenes.maps", (f"expansion/{place}.json", f"{place}.json"))
        return nuscenes_map.read_map(found, numbers=numbers, file_limit_mb=file_limit_mb)
    except SceneError as error:
        return error


class _Folder(NamedTuple):
    """The tables of a folder."""

    path: Path
    row_limit: int

    def rows(self, name: str) -> Iterator[Node]:
        """The rows of a table, one after another."""
        file = self.path / f"{name}.json"
        for place, row in enumerate(json_rows.read_rows(file, row_limit=self.row_limit)):
            yield Node(row, f"{file}: [{place}]")

    def pairs(self, name: str, value: str) -> dict[str, str]:
        """A text of each row by its token."""
        return {row["token"].expect(str): row[value].expect(str) for row in self.rows(name)}


def _read_tables(path: Path, row_limit: int) -> _Tables:
    """Reads the tables, of which the largest are sifted row by row."""
    folder = _Folder(Path(path).parent, row_limit)
    if missing := [name for name in TABLES if not (folder.path / f"{name}.json").is_file()]:
        raise SceneError(f"{path}: its table is missing: {folder.path / missing[0]}.json")
    scenes = [{key: row[key].expect(str) for key in ("token", "log_token", "name")} for row in folder.rows("scene")]
    samples = {row["token"].expect(str): (row["scene_token"].expect(str), row["timestamp"].expect(int)) for row in folder.rows("sample")}
    times = defaultdict(list)
    for scene, time in samples.values():
        times[scene].append(time)
    times = {scene: sorted(set(stamps)) for scene, stamps in times.items()}
    names = folder.pairs("category", "name")
    objects = [(token, names.get(kind, "")) for token, kind in folder.pairs("instance", "category_token").items()]
    return _Tables(
        scenes=scenes,
        logs={row["token"].expect(str): row.value for row in folder.rows("log")},
        times=times,
        poses=_read_poses(folder, samples),
        annotations=_read_annotations(folder, samples, times, {token: place for place, (token, _) in enumerate(objects)}),
        objects=objects,
    )


def _read_poses(folder: _Folder, samples: Mapping[str, tuple[str, int]]) -> dict[str, array]:
    """The recording car's poses at the sweeps of the lidar, by scene."""
    kinds = folder.pairs("sensor", "modality")
    lidars = {token for token, sensor in folder.pairs("calibrated_sensor", "sensor_token").items() if kinds.get(sensor) == "lidar"}
    owner = {}
    for row in folder.rows("sample_data"):
        if str(row.value.get("calibrated_sensor_token")) in lidars and (sample := row["sample_token"].expect(str)) in samples:
            owner[row["ego_pose_token"].expect(str)] = samples[sample][0]
    poses = defaultdict(lambda: array("d"))
    for row in folder.rows("ego_pose"):
        if (scene := owner.get(str(row.value.get("token")))) is not None:
            x, y, _ = row["translation"].numbers(length=3)
            poses[scene].extend((row["timestamp"].expect(int), x, y, *row["rotation"].numbers(length=4)))
    return dict(poses)


def _read_annotations(
    folder: _Folder, samples: Mapping[str, tuple[str, int]], times: Mapping[str, list[int]], objects: Mapping[str, int]
) -> dict[str, _Annotations]:
    """The annotations by scene."""
    parked = {token for token, name in folder.pairs("attribute", "name").items() if name == WITHOUT_RIDER}
    step = {scene: {time: place for place, time in enumerate(stamps)} for scene, stamps in times.items()}
    found = defaultdict(lambda: _Annotations(array("q"), array("q"), array("d")))
    for row in folder.rows("sample_annotation"):
        token, name = row["sample_token"].expect(str), row["instance_token"].expect(str)
        if token not in samples or name not in objects:
            continue
        scene, time = samples[token]
        x, y, _ = row["translation"].numbers(length=3)
        width, length, height = row["size"].numbers(length=3)
        rotation = row["rotation"].numbers(length=4)
        stands = not parked.isdisjoint(str(name) for name in row.get("attribute_tokens", []).expect(list))
        found[scene].objects.append(objects[name])
        found[scene].frames.append(step[scene][time])
        found[scene].numbers.extend((x, y, *rotation, length, width, height, stands))
    return dict(found)


def _make_scene(
    tables: _Tables,
    scene: Mapping[str, str],
    city: CityMap,
    place: str,
    step_s: float,
    current: int,
    reach_m: float,
    ego: EgoBox,
    where: str,
) -> RawScene:
    """One scene."""
    token = scene["token"]
    stamps = np.array(tables.times.get(token, []), np.int64)
    poses = np.array(tables.poses.get(token, [])).reshape(-1, len(POSE))
    if len(stamps) < 2 or not len(poses):
        raise SceneError(f"{where}: {scene['name']}: expected two key frames or more and poses, got {len(stamps)} and {len(poses)}")
    values.check_finite(poses, f"{where}: {scene['name']}: ego_pose", keys=POSE)
    frames = (stamps - stamps[0]) * 1e-6
    times = step_s * np.arange(int(frames[-1] / step_s + 1e-6) + 1)
    if not 0 <= current < len(times):
        raise SceneError(f"{where}: formats.nuscenes.current: expected a step of a scene, 0 to {len(times) - 1}, got {current}")
    names = [tables.objects[number][0] for number in sorted(set(tables.annotations[token].objects))] if token in tables.annotations else []
    ids = scene_parts.assign_ids([EGO, *names])
    tracks = [_make_ego(poses, int(stamps[0]), times, ego, ids[EGO], f"{where}: {scene['name']}: ego_pose")]
    tracks += _make_tracks(tables, token, frames, times, ids, f"{where}: {scene['name']}")
    roads = city_map.cut_roads(city, tracks[0].xyz[:, :2], reach_m)
    there = {lane.id for lane in city.lanes} & {line.id for line in roads}
    if not there:
        raise SceneError(f"{where}: {scene['name']}: expected lanes of {place} within {reach_m:g} m of the recording car, got none")
    log = tables.logs[scene["log_token"]]
    return RawScene(
        name=scene["name"],
        source=where,
        roads=roads,
        tracks=tuple(tracks),
        times=times,
        current=current,
        sdc=0,
        metadata={
            "dataset": "nuScenes",
            "format": "nuscenes",
            "scene_token": token,
            "log": str(log.get("logfile", "")),
            "map": place,
            "date": str(log.get("date_captured", "")),
            "intersection_lanes": sorted(city.inside & there),
            "tokens": {"tracks": scene_parts.list_tokens(ids)},
        },
    )


def _make_ego(poses: Float[np.ndarray, "N 7"], start: int, times: Float[np.ndarray, " L"], ego: EgoBox, number: int, where: str) -> Track:
    """The recording car."""
    poses = poses[np.unique(poses[:, 0], return_index=True)[1]]
    seconds = (poses[:, 0] - start) * 1e-6
    yaw, valid = np.interp(times, seconds, np.unwrap(city_map.find_yaw(poses[:, 3:]))), np.ones(len(times), bool)
    path = np.stack([np.interp(times, seconds, poses[:, axis]) for axis in (1, 2)], axis=1)
    centre = city_map.place_ego(path, yaw, ego)
    return city_map.make_track(where, number, "vehicle", ego.size_m, centre, yaw, np.full_like(centre, np.nan), valid, times)


def _make_tracks(
    tables: _Tables, scene: str, frames: Float[np.ndarray, " K"], times: Float[np.ndarray, " L"], ids: Mapping[str, int], where: str
) -> list[Track]:
    """The annotated objects."""
    if scene not in tables.annotations:
        return []
    objects, steps, numbers = (np.array(column) for column in tables.annotations[scene])
    numbers = numbers.reshape(-1, len(BOX))
    tracks = []
    for number in sorted(set(objects.tolist())):
        rows = np.flatnonzero(objects == number)
        rows = rows[np.unique(steps[rows], return_index=True)[1]]
        token, name = tables.objects[number]
        values.check_finite(numbers[rows], f"{where}: sample_annotation: {token}", keys=BOX)
        kinds: list[RoadUser] = [kind for start, kind in KINDS.items() if name.startswith(start)]
        kind: RoadUser = "other" if not kinds or (kinds[0] == "cyclist" and numbers[rows, -1].all()) else kinds[0]
        path, yaw, velocity, valid = _resample(numbers[rows, :2], city_map.find_yaw(numbers[rows, 2:6]), steps[rows], frames, times)
        size = numbers[rows[0], 6:9].tolist()  # annotated once for an object
        tracks.append(city_map.make_track(f"{where}: {token}", ids[token], kind, size, path, yaw, velocity, valid, times))
    return tracks


def _resample(
    path: Float[np.ndarray, "K 2"],
    yaw: Float[np.ndarray, " K"],
    steps: Any,
    frames: Float[np.ndarray, " _"],
    times: Float[np.ndarray, " L"],
) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, " L"], Float[np.ndarray, "L 2"], Bool[np.ndarray, " L"]]:
    """Position, heading, velocity and validity at even steps of an object that is annotated at some key frames.

    It is there between two key frames in a row with an annotation, and at the step next to a key frame with one.
    """
    seconds = frames[steps]
    rates, apart = np.zeros((len(steps), 2)), np.flatnonzero(np.diff(steps) > 1) + 1
    for part in np.split(np.arange(len(steps)), apart):
        rates[part] = city_map.differentiate(path[part], seconds[part], np.ones(len(part), bool))
    columns = np.column_stack([path, np.unwrap(yaw), rates])
    x, y, turn, vx, vy = (np.interp(times, seconds, column) for column in columns.T)
    after = np.searchsorted(seconds, times)
    inside = (after > 0) & (after < len(steps))
    joined = np.concatenate([[False], np.diff(steps) == 1, [False]])
    valid = inside & joined[np.clip(after, 0, len(steps))]
    half = (times[1] - times[0]) / 2 if len(times) > 1 else 0.0
    nearest = np.minimum(np.searchsorted(times, seconds - half), len(times) - 1)
    valid[nearest[np.abs(times[nearest] - seconds) <= half + 1e-9]] = True
    return np.stack([x, y], axis=1), turn, np.stack([vx, vy], axis=1), valid
