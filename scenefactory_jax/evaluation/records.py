"""Records of an evaluation: one row for every spawned agent and episode, in memory and as files."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenefactory_jax.core import column_table, result_file

Records = Mapping[str, np.ndarray]  # column -> one value for every agent
RESULT = "evaluation.json"  # settings of the evaluation, beside the records
FILES = (RESULT, "agents-*.csv", "agents-*.parquet", "comparison-*.png", "failures.json", "failures-*", "learning.png", "outcomes.png")
FILES += ("planners.*", "replay-*.html", "rollouts-*/*.npz", "safety.png", "scores.csv", "trajectories.png", "video.gif", "video.mp4")
FILES += ("report.md",)  # of an evaluation's folder
ROUTE_EVENTS = ("red_light", "stop_sign", "off_route")  # records of before routes lack them: no agent had such an event
EVENTS = ("numerical_error", "goal_reached", "collision", "out_of_bounds", "road_edge_contact", *ROUTE_EVENTS)
COLUMNS: dict[str, type] = {  # further columns are kept and may serve a breakdown
    "scene": str, "world": int, "seed": int, "agent": int, **dict.fromkeys(EVENTS, bool), "clean": bool,
    "time_s": float, "route_m": float, "start_distance_m": float, "end_distance_m": float,
    "max_drac": float, "min_ttc_s": float, "mean_ttc_s": float, "has_ttc": bool, "mean_speed": float, "max_contact_force_n": float,
    "yaw_acceleration": float, "film_mm": float, "surface": str, "friction": float, "friction_utilization": float,
    "stopping_margin_m": float,
}  # fmt: skip


class RecordsError(ValueError):
    """Records that no table can be made of; the message names the column or file and what would be valid."""


def check_records(records: Records) -> None:
    """Raises a RecordsError for records without rows, without a column of `COLUMNS`, or with columns of different lengths."""
    for name in COLUMNS:
        if name not in records:
            raise RecordsError(f"records.{name}: column missing; expected {', '.join(COLUMNS)}")
    rows = len(records["scene"])
    for name, column in records.items():
        if len(column) != rows:
            raise RecordsError(f"records.{name}: expected {rows} rows, as records.scene has, got {len(column)}")
    if rows == 0:
        raise RecordsError("records: expected one or more rows, got 0; the evaluation spawned no agent")


def select_rows(records: Records, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the rows that a boolean mask or an index array selects."""
    return {name: np.asarray(column)[rows] for name, column in records.items()}


def write_records(path: Path, records: Records, *, metadata: Mapping[str, Any]) -> None:
    """Writes records as `column_table.write` does, one row for every agent.

    Args:
        metadata: protocol, digest of the config and versions, or what else says how the records came about.
    """
    check_records(records)
    column_table.write(path, {name: np.asarray(column) for name, column in records.items()}, metadata=metadata)


def read_records(path: Path) -> dict[str, np.ndarray]:
    """Reads the CSV that `write_records` wrote. Columns outside `COLUMNS` become int, float, bool or str: the first that fits all cells; an
    empty cell of floats is NaN.

    Raises:
        RecordsError: no such file, no rows, a ragged row, or a cell that does not fit its column.
    """
    if not path.is_file():
        raise RecordsError(f"{path}: file not found; expected the CSV of an evaluation")
    with column_table.open_csv(path, "rt", compressed=path.suffix == ".xz") as file:
        names, *rows = list(csv.reader(file)) or [[]]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise RecordsError(f"{path}:{number}: expected {len(names)} cells, as in the header, got {len(row)}")
    records = {}
    for index, name in enumerate(names):
        cells = [row[index] for row in rows]
        types = [COLUMNS[name]] if name in COLUMNS else [int, float, bool, str]
        column = next((c for c in (_parse(cells, kind) for kind in types) if c is not None), None)
        if column is None:
            raise RecordsError(f"{path}: column {name!r}: expected cells of type {types[0].__name__}")
        records[name] = column
    records |= {name: np.zeros(len(rows), bool) for name in ROUTE_EVENTS if name not in records}
    check_records(records)
    return records


def _parse(cells: list[str], kind: type) -> np.ndarray | None:
    """The cells as one type; None: one does not fit."""
    if kind is bool:
        return np.array([cell == "True" for cell in cells]) if all(cell in ("True", "False") for cell in cells) else None
    try:
        return np.array([kind(cell or np.nan) if kind is float else kind(cell) for cell in cells], dtype=kind)
    except ValueError:
        return None


def begin_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Writes the settings of an evaluation, and removes the files of an earlier one from the folder."""
    for file in [file for pattern in FILES for file in folder.glob(pattern)]:
        file.unlink()
    result_file.write(folder / RESULT, settings, digits=None)


def read_settings(folder: Path) -> dict[str, Any]:
    """Reads the settings that `begin_folder` wrote; of a folder without an evaluation, no scenes and no overrides."""
    return result_file.read(folder / RESULT) if (folder / RESULT).is_file() else {"scenes": None, "overrides": []}


def name_file(label: str) -> str:
    """Returns the name of the CSV of a label: "strict", or "strict, untrained" of another policy than the trained one."""
    return f"agents-{label.replace(', ', '-')}.csv"


def read_all(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads the records of all policies from an evaluation's folder, by label; empty: it has none."""
    return {path.stem.removeprefix("agents-").replace("-", ", "): read_records(path) for path in sorted(folder.glob("agents-*.csv"))}


def read_folder(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads the records of the trained policy from an evaluation's folder, by protocol; empty: it has none."""
    paths = (path for path in sorted(folder.glob("agents-*.csv")) if path.stem.count("-") == 1)
    return {path.stem.removeprefix("agents-"): read_records(path) for path in paths}
