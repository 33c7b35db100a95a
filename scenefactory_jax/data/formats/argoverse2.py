"""Argoverse 2 motion forecasting: `scenario_ID.parquet` with the tracks, and `log_map_archive_ID.json` with the map beside it.

A row of the parquet file is an object at a step of 0.1 s; the first 50 of 110 steps are observed (av2's `scenario_serialization.py`).
There are no sizes and no heights: sizes come from the config by type, heights from the map below the object.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, OtherContent, RawScene, SceneError, Track
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import argoverse2_map, file_content, scene_parts, values

MAGIC = b"PAR1"
MAX_STEPS = 110
SDC = "AV"
SCORED = 2  # of `object_category`: scored tracks; the focal track is above
CONSTANTS = ("scenario_id", "city", "focal_track_id", "num_timestamps", "start_timestamp", "end_timestamp")  # in every row
MOTION = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
COLUMNS = {  # -> what it is converted to
    "observed": pa.bool_(), "track_id": pa.string(), "object_type": pa.string(), "object_category": pa.int64(), "timestep": pa.int64(),
    "scenario_id": pa.string(), "start_timestamp": pa.float64(), "end_timestamp": pa.float64(), "num_timestamps": pa.int64(),
    "focal_track_id": pa.string(), "city": pa.string(), **dict.fromkeys(MOTION, pa.float64()),
}  # fmt: skip
KINDS: dict[str, RoadUser] = {
    "vehicle": "vehicle", "bus": "vehicle", "pedestrian": "pedestrian", "cyclist": "cyclist", "motorcyclist": "cyclist"
}  # fmt: skip
Columns = Mapping[str, np.ndarray]


def read(
    path: Path, *, sizes_m: dict[str, list[float]], point_spacing_m: float, cut_m: float, row_limit: int, file_limit_mb: int
) -> Iterator[RawScene]:
    """Reads the scene of a parquet file and the map beside it. Tracks with other names than integers (the recording car's, "AV") get one.

    Args:
        path, point_spacing_m, file_limit_mb: see `formats`; the map's own path is a companion.
        sizes_m: type -> length, width and height, with an entry `other` for all other types.
        cut_m: the map was cut where an outline of the drivable area comes so near to a lane's centre: there is no road edge.
        row_limit: longer tables are refused unread.
    """
    columns = _read_columns(path, row_limit, file_limit_mb)
    if "other" not in sizes_m or any(len(size) != 3 for size in sizes_m.values()):
        raise SceneError(f"formats.argoverse2.sizes_m: expected type -> [length, width, height], with `other`, got {sizes_m!r}")
    scenario, city, focal, steps, start, end = (_single(columns, key, path) for key in CONSTANTS)
    step = columns["timestep"]
    if not 0 < steps <= MAX_STEPS or step.min() < 0 or step.max() >= steps:
        raise SceneError(f"{path}: num_timestamps: expected at most {MAX_STEPS}, all in range, got {steps}, {step.min()} to {step.max()}")
    if not columns["observed"].any():
        raise SceneError(f"{path}: observed: expected an observed step, the last of which is the current step, got none")
    map_path = _find_map(path, scenario)
    roads, lanes = argoverse2_map.read_roads(map_path, point_spacing_m=point_spacing_m, cut_m=cut_m, file_limit_mb=file_limit_mb)
    names, owner = np.unique(columns["track_id"], return_inverse=True)
    ids = scene_parts.assign_ids(names)
    ground = np.concatenate([line.xyz for line in roads]) if roads else np.zeros((1, 3))
    tree = KDTree(ground[:, :2])
    tracks = []
    for place, name in enumerate(names):
        rows = {key: column[owner == place] for key, column in columns.items()}
        kind = str(rows["object_type"][0])
        size = sizes_m.get(kind, sizes_m["other"])
        plane = np.stack([rows["position_x"], rows["position_y"]], axis=1)
        xyz = np.column_stack([plane, ground[tree.query(plane)[1], 2] + float(size[2]) / 2])  # the box is on the nearest point of the map
        tracks.append(_track(rows, xyz, ids[name], KINDS.get(kind, "other"), size, int(steps), f"{path}: track {name}"))
    scored = names[np.unique(owner[columns["object_category"] >= SCORED])]
    yield RawScene(
        name=scenario,
        source=str(path),
        roads=roads,
        tracks=tuple(tracks),
        times=np.linspace(0.0, (float(end) - float(start)) * 1e-9, steps),
        current=int(step[columns["observed"]].max()),
        sdc=list(names).index(SDC) if SDC in names else None,
        metadata={"dataset": "argoverse2", "format": "argoverse2", "scenario_id": scenario, "city": city, "focal_track": ids.get(focal)}
        | {"tracks_to_predict": [ids[name] for name in scored], "tokens": {"tracks": scene_parts.list_tokens(ids)}}
        | lanes,
    )


def _read_columns(path: Path, row_limit: int, file_limit_mb: int) -> Columns:
    """The parquet file's columns as arrays."""
    start = file_content.read_head(path)
    if start.lstrip()[:1] == b"{" and argoverse2_map.is_map(file_content.load_json(path, file_limit_mb=file_limit_mb)):
        raise Companion(f"{path}: the map of an Argoverse 2 scenario")
    if not start.startswith(MAGIC):
        raise FormatMismatch(f"{path}: expected a parquet file or a map of Argoverse 2, got a file that begins with {start[:16]!r}")
    content = file_content.unpack(path, file_limit_mb=file_limit_mb)
    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(content), page_checksum_verification=True)
        if missing := [name for name in COLUMNS if name not in file.schema_arrow.names]:
            raise OtherContent(f"{path}: a parquet file, but not an Argoverse 2 scenario: no column {missing[0]!r}")
        if file.metadata.num_rows > row_limit:
            raise SceneError(f"{path}: {file.metadata.num_rows} rows; formats.argoverse2.row_limit is {row_limit}")
        unpacked = sum(file.metadata.row_group(group).total_byte_size for group in range(file.metadata.num_row_groups))
        if unpacked > file_limit_mb * 10**6:
            raise SceneError(f"{path}: {unpacked / 1e6:.0f} MB unpacked; formats.argoverse2.file_limit_mb is {file_limit_mb}")
        table = file.read(columns=list(COLUMNS), use_threads=False).select(list(COLUMNS)).cast(pa.schema(list(COLUMNS.items())))
        if not table.num_rows or any(column.null_count for column in table.columns):
            raise SceneError(f"{path}: expected rows with values in all of {', '.join(COLUMNS)}, got {table.num_rows}, some without")
        columns = {name: table[name].to_numpy() for name in COLUMNS}
    except SceneError:
        raise
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise SceneError(f"{path}: not a valid parquet file, damaged or cut short: {error}") from error
    for name in (*MOTION, "start_timestamp", "end_timestamp"):
        values.check_finite(columns[name], f"{path}: {name}")
    return columns


def _single(columns: Columns, name: str, path: Path) -> Any:
    """The value that a column repeats in every row."""
    distinct = np.unique(columns[name])
    if len(distinct) != 1:
        raise SceneError(f"{path}: {name}: expected one value in all rows, got {distinct[0]!r} and {distinct[1]!r}")
    return distinct[0]


def _find_map(path: Path, scenario: str) -> Path:
    """The path of the scenario's map, by its id or, beside a file that was renamed, by the file's name."""
    names = (scenario, Path(path).stem.removeprefix("scenario_"))
    paths = [Path(path).with_name(f"log_map_archive_{name}.json") for name in names]
    existing = next((candidate for candidate in paths if candidate.is_file()), None)
    if existing is None:
        raise SceneError(f"{path}: its map is missing: {paths[0]}")
    return existing


def _track(rows: Columns, position: np.ndarray, number: int, kind: RoadUser, size: Sequence[float], steps: int, where: str) -> Track:
    """One object."""
    step = rows["timestep"]
    if len(np.unique(step)) != len(step):
        raise SceneError(f"{where}: expected one row per timestep, got two")
    xyz, yaw, velocity, valid = np.zeros((steps, 3)), np.zeros(steps), np.zeros((steps, 2)), np.zeros(steps, bool)
    xyz[step], yaw[step], valid[step] = position, rows["heading"], True
    velocity[step] = np.stack([rows["velocity_x"], rows["velocity_y"]], axis=1)
    return scene_parts.make_track(where, id=number, kind=kind, size=size, position=xyz, heading=yaw, velocity=velocity, valid=valid)
