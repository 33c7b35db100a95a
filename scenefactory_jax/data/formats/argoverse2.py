"""Argoverse 2 motion forecasting: `scenario_ID.parquet` with the tracks, and `log_map_archive_ID.json` with the map beside it.

A row of the parquet file is an object at a step of 0.1 s; of 110 steps the first 50 are observed (av2's `scenario_serialization.py`). There
are no sizes and no heights: sizes come from the config by type, heights from the map below the object.
"""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from jaxtyping import Float
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, OtherContent, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.scene_arrays import wrap_angles
from scenefactory_jax.core.types import RoadUser
from scenefactory_jax.data.formats import argoverse2_map, integer_ids, json_documents

MAGIC = b"PAR1"
STEPS = 110
SDC = "AV"
SCORED = 2  # of `object_category`: scored tracks, and the focal one above them
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
    path: Path,
    *,
    sizes_m: dict[str, list[float]],
    point_spacing_m: float,
    cut_m: float,
    row_limit: int,
    file_limit_mb: int = json_documents.FILE_LIMIT_MB,
) -> Iterator[RawScene]:
    """The one scene of a parquet file and the map beside it. Tracks whose names are no numbers (the recording car's, "AV") get one.

    Args:
        path: the parquet file; the map's own path is a companion.
        sizes_m: type -> length, width and height, with an entry `other` for types that have none of their own.
        point_spacing_m: between the points of the map's lines, at most.
        cut_m: an outline of the drivable area that comes so near to a lane's centre was cut there, and is no road edge.
        row_limit: longer tables are refused unread.
        file_limit_mb: files that hold more, unpacked if they are compressed, are refused; the configs of older runs do not say it.

    Raises:
        FormatMismatch: no parquet file of such columns, and no such map.
        Companion: the map.
        SceneError: the map is missing, or a value is missing, of a wrong type or not finite, naming its column or key.
    """
    columns = _columns(path, sizes_m, row_limit, file_limit_mb)
    where = f"{path}: "
    steps, step = int(_only(columns, "num_timestamps", where)), columns["timestep"]
    if not 0 < steps <= STEPS or step.min() < 0 or step.max() >= steps:
        raise SceneError(f"{where}num_timestamps: {steps}, with steps from {step.min()} to {step.max()}; there are at most {STEPS}")
    scenario, city = (str(_only(columns, key, where)) for key in ("scenario_id", "city"))
    seconds = (float(_only(columns, "end_timestamp", where)) - float(_only(columns, "start_timestamp", where))) * 1e-9
    if not columns["observed"].any():
        raise SceneError(f"{where}observed: no step is; the last one that is would be the current step")
    beside = _map_beside(path, scenario)
    roads, groups = argoverse2_map.roads(beside, point_spacing_m=point_spacing_m, cut_m=cut_m, file_limit_mb=file_limit_mb)
    names, owner = np.unique(columns["track_id"], return_inverse=True)
    ids = integer_ids.assign_ids(names)
    ground = _ground(roads)
    tracks = tuple(
        _track({key: columns[key][owner == place] for key in COLUMNS}, ids[str(name)], steps, ground, sizes_m, f"{where}track {name}")
        for place, name in enumerate(names)
    )
    focal = str(_only(columns, "focal_track_id", where))
    scored = names[np.unique(owner[columns["object_category"] >= SCORED])]
    yield RawScene(
        name=scenario,
        source=str(path),
        roads=roads,
        tracks=tracks,
        times=np.linspace(0.0, seconds, steps),
        current=int(step[columns["observed"]].max()),
        sdc=list(names).index(SDC) if SDC in names else None,
        metadata={"dataset": "argoverse2", "format": "argoverse2", "scenario_id": scenario, "city": city, "focal_track": ids.get(focal)}
        | {"tracks_to_predict": [ids[str(name)] for name in scored], "tokens": {"tracks": integer_ids.list_tokens(ids)}}
        | groups,
    )


def _columns(path: Path, sizes_m: Mapping[str, list[float]], row_limit: int, file_limit_mb: int) -> Columns:
    """The parquet file's columns as arrays."""
    start = json_documents.read_head(path)
    if start.lstrip()[:1] == b"{" and argoverse2_map.is_map(json_documents.load(path, file_limit_mb=file_limit_mb)):
        raise Companion(f"{path}: the map of an Argoverse 2 scenario")
    if not start.startswith(MAGIC):
        raise FormatMismatch(f"{path}: no parquet file and no map of Argoverse 2; it begins with {start[:16]!r}")
    content = json_documents.unpack(path, file_limit_mb=file_limit_mb)
    if "other" not in sizes_m or any(len(size) != 3 for size in sizes_m.values()):
        raise SceneError(f"formats.argoverse2.sizes_m: {sizes_m!r} is no mapping of types, with `other`, to [length, width, height]")
    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(content), page_checksum_verification=True)
        if missing := [name for name in COLUMNS if name not in file.schema_arrow.names]:
            raise OtherContent(f"{path}: a parquet file, but no Argoverse 2 scenario: no column {missing[0]!r}")
        if file.metadata.num_rows > row_limit:
            raise SceneError(f"{path}: {file.metadata.num_rows} rows; formats.argoverse2.row_limit is {row_limit}")
        unpacked = sum(file.metadata.row_group(group).total_byte_size for group in range(file.metadata.num_row_groups))
        if unpacked > file_limit_mb * 10**6:
            raise SceneError(f"{path}: {unpacked / 1e6:.0f} MB unpacked; formats.argoverse2.file_limit_mb is {file_limit_mb}")
        table = file.read(columns=list(COLUMNS), use_threads=False).select(list(COLUMNS)).cast(pa.schema(list(COLUMNS.items())))
        if not table.num_rows or any(column.null_count for column in table.columns):
            raise SceneError(f"{path}: {table.num_rows} rows, or some without a value; every row must have all of {', '.join(COLUMNS)}")
        columns = {name: table[name].to_numpy() for name in COLUMNS}
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{path}: no valid parquet file, damaged or cut short: {error}") from error
    for name in (*MOTION, "start_timestamp", "end_timestamp"):
        json_documents.check_finite(columns[name], f"{path}: {name}")
    return columns


def _only(columns: Columns, name: str, where: str) -> Any:
    """The one value that a column repeats in every row."""
    values = np.unique(columns[name])
    if len(values) != 1:
        raise SceneError(f"{where}{name}: {len(values)} values, such as {values[0]!r} and {values[1]!r}; every row must have the same")
    return values[0]


def _map_beside(path: Path, scenario: str) -> Path:
    """The scenario's map, found by its id or, in a file that was renamed, by the file's name."""
    wanted = Path(path).with_name(f"log_map_archive_{scenario}.json")
    renamed = Path(path).with_name(f"log_map_archive_{Path(path).stem.removeprefix('scenario_')}.json")
    for candidate in (wanted, renamed):
        if candidate.is_file():
            return candidate
    raise SceneError(f"{path}: its map is missing: {wanted}")


def _ground(roads: tuple[Polyline, ...]) -> tuple[KDTree, Float[np.ndarray, " N"]]:
    """The map's points in the plane, to be searched, and their heights."""
    points = np.concatenate([line.xyz for line in roads]) if roads else np.zeros((1, 3))
    return KDTree(points[:, :2]), points[:, 2]


def _track(
    rows: Columns, identity: int, steps: int, ground: tuple[KDTree, np.ndarray], sizes_m: Mapping[str, list[float]], where: str
) -> Track:
    """One object; its box stands on the nearest point of the map."""
    step = rows["timestep"]
    if len(np.unique(step)) != len(step):
        raise SceneError(f"{where}: two rows of one timestep")
    name = str(rows["object_type"][0])
    length, width, height = map(float, sizes_m.get(name, sizes_m["other"]))
    plane = np.stack([rows["position_x"], rows["position_y"]], axis=1)
    tree, heights = ground
    xyz, yaw, velocity, valid = np.zeros((steps, 3)), np.zeros(steps), np.zeros((steps, 2)), np.zeros(steps, bool)
    xyz[step] = np.column_stack([plane, heights[tree.query(plane)[1]] + height / 2])
    yaw[step] = wrap_angles(rows["heading"])
    velocity[step] = np.stack([rows["velocity_x"], rows["velocity_y"]], axis=1)
    valid[step] = True
    return Track(id=identity, kind=KINDS.get(name, "other"), size=(length, width, height), xyz=xyz, yaw=yaw, velocity=velocity, valid=valid)
