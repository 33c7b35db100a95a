"""INTERACTION recordings: `recorded_trackfiles/SITE/vehicle_tracks_NNN.csv`, with the Lanelet2 map `maps/SITE.osm` (Zhan et al., 2019).

A row is an object at a step of 0.1 s. Recordings last minutes and are cut into scenes. People and cyclists, in `pedestrian_tracks_NNN.csv`
beside, have neither sizes nor headings: sizes come from the config, headings from their velocities.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from scenefactory_jax.core.raw_scene import Companion, FormatMismatch, Polyline, RawScene, SceneError, Track
from scenefactory_jax.core.types import DRIVABLE, RoadUser
from scenefactory_jax.data.formats import file_content, lanelet2, scene_parts
from scenefactory_jax.data.formats.drivable_outline import OutlineNumbers

COLUMNS = ("track_id", "frame_id", "timestamp_ms", "agent_type", "x", "y", "vx", "vy")
BOXES = ("psi_rad", "length", "width")  # further columns, of vehicles
STEP_MS = 100
KINDS: dict[str, RoadUser] = {"car": "vehicle", "pedestrian/bicycle": "pedestrian", "bicycle": "cyclist"}


def read(
    path: Path,
    *,
    steps: int,
    current: int,
    person_size_m: list[float],
    height_m: float,
    point_spacing_m: float,
    outline: OutlineNumbers,
    row_limit: int,
    element_limit: int,
    file_limit_mb: int,
) -> Iterator[RawScene]:
    """Reads the scenes of a recording; in each the vehicle that drives farthest, of those present all along, is the `sdc`.

    Args:
        path, current, point_spacing_m, file_limit_mb: see `formats`.
        steps: of a scene; what is left at the end of a recording makes none.
        person_size_m: length and width of people.
        height_m: of all: the format has none.
        outline, element_limit: of the map, see `lanelet2.read`.
        row_limit: longer tables are refused.
    """
    rows = _read_rows(path, row_limit, file_limit_mb)
    if not 0 <= current < steps:
        raise SceneError(f"{path}: formats.interaction.current: expected a step of a scene, 0 to {steps - 1}, got {current}")
    name = Path(path).name
    if name.startswith("pedestrian_tracks") and Path(path).with_name(name.replace("pedestrian", "vehicle")).is_file():
        raise Companion(f"{path}: the people of a recording of INTERACTION")
    people = Path(path).with_name(name.replace("vehicle", "pedestrian"))
    if name.startswith("vehicle_tracks") and people.is_file():
        rows += _read_rows(people, row_limit, file_limit_mb)
    source = _find_map(path)
    roads = lanelet2.read_map(
        source, point_spacing_m=point_spacing_m, outline=outline, element_limit=element_limit, file_limit_mb=file_limit_mb
    )
    ids = scene_parts.assign_ids(row["track_id"] for row in rows)
    tracks = _make_tracks(rows, ids, roads.roads, (*person_size_m, height_m), str(path))
    length = len(tracks[0].valid)
    for number, first in enumerate(range(0, length - steps + 1, steps)):
        part = scene_parts.cut_tracks(tracks, slice(first, first + steps))
        if not part:
            continue
        yield RawScene(
            name=f"{source.stem}-{Path(path).stem}-{number}",
            source=str(path),
            roads=roads.roads,
            tracks=tuple(part),
            times=STEP_MS / 1000 * np.arange(steps),
            current=current,
            sdc=scene_parts.choose_recording_car(part),
            metadata={
                "dataset": "interaction",
                "format": "interaction",
                "map": source.stem,
                "first_step": first,
                "intersection_lanes": roads.inside,
                "tokens": {"tracks": scene_parts.list_tokens(ids)},
            },
        )


def _read_rows(path: Path, row_limit: int, file_limit_mb: int) -> list[dict[str, str]]:
    """The rows of a table, with their line as `line`."""
    if not file_content.read_head(path).removeprefix(b"\xef\xbb\xbf").startswith(",".join(COLUMNS).encode()):
        raise FormatMismatch(f"{path}: expected a table that begins with {','.join(COLUMNS)}")
    text = file_content.unpack(path, file_limit_mb=file_limit_mb).decode("utf-8-sig", errors="replace")
    rows = []
    try:
        for row in csv.DictReader(text.splitlines(), strict=True):
            if len(rows) == row_limit:
                raise SceneError(f"{path}: expected up to {row_limit} rows (formats.interaction.row_limit), got more")
            rows.append({**row, "line": str(len(rows) + 2)})
    except csv.Error as error:
        raise SceneError(f"{path}: not a valid table, damaged: {error}") from error
    if not rows:
        raise SceneError(f"{path}: expected rows, got none")
    return rows


def _find_map(path: Path) -> Path:
    """The map of the recording's folder, or one beside the recording."""
    site = Path(path).absolute().parent.name
    candidates = (Path(path).absolute().parents[min(2, len(Path(path).absolute().parents) - 1)] / "maps" / f"{site}.osm",)
    candidates += (Path(path).with_name(f"{site}.osm"), Path(path).with_suffix(".osm"))
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        raise SceneError(f"{path}: its map is missing: {candidates[0]}")
    return found


def _number(row: Mapping[str, str], key: str, where: str) -> float:
    """A finite number of a row."""
    try:
        value = float(row.get(key) or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise SceneError(f"{where}: line {row['line']}: {key}: expected a finite number, got {str(row.get(key))[:20]!r}")
    return value


def _make_tracks(
    rows: Sequence[Mapping[str, str]], ids: Mapping[str, int], roads: Sequence[Polyline], person: tuple[float, ...], where: str
) -> list[Track]:
    """The tracks over the whole recording, on the ground."""
    frames = np.array([_number(row, "timestamp_ms", where) for row in rows])
    place = np.round((frames - frames.min()) / STEP_MS).astype(int)
    length = int(place.max()) + 1
    if length > len(rows):
        raise SceneError(f"{where}: timestamp_ms: expected a row for each {STEP_MS} ms or more, got {len(rows)} over {length} steps")
    ground = np.concatenate([line.xyz for line in roads if line.kind in DRIVABLE])
    tree = KDTree(ground[:, :2])
    owned: dict[str, list[int]] = {}
    for index, row in enumerate(rows):
        owned.setdefault(row["track_id"], []).append(index)
    tracks = []
    for name, own in owned.items():
        table = np.array([[_number(rows[index], key, where) for key in COLUMNS[4:]] for index in own])
        first, step = rows[own[0]], place[own]
        boxed = all(first.get(key) for key in BOXES)
        size = [_number(first, key, where) for key in BOXES[1:]] if boxed else person[:2]
        yaw = np.array([_number(rows[index], BOXES[0], where) for index in own]) if boxed else np.arctan2(table[:, 3], table[:, 2])
        xyz, heading, velocity, valid = np.zeros((length, 3)), np.zeros(length), np.zeros((length, 2)), np.zeros(length, bool)
        xyz[step] = np.column_stack([table[:, :2], ground[tree.query(table[:, :2])[1], 2] + person[2] / 2])
        heading[step], velocity[step], valid[step] = yaw, table[:, 2:], True
        kind = KINDS.get(first["agent_type"] or "", "vehicle" if boxed else "other")
        entries = {"position": xyz, "heading": heading, "velocity": velocity, "valid": valid}
        tracks.append(
            scene_parts.make_track(f"{where}: track {name[:20]}", id=ids[name], kind=kind, size=(*map(float, size), person[2]), **entries)
        )
    return tracks
