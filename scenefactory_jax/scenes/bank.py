"""Packed scenes on disk: a folder with `bank.json` and one .npy a column, memory-mapped when it is read.

Ragged columns lie end to end, scene after scene; `sizes.npy` holds each scene's segments, agent slots, steps and others. `lanes` and
`edges` repeat rows of `road` and are not stored. A bank can be moved; it is written beside its place and renamed, so that nobody ever meets
half of one.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from scenefactory_jax.scenes import columns
from scenefactory_jax.scenes.pack import Packed, PackReport
from scenefactory_jax.scenes.raw import SceneError
from scenefactory_jax.scenes.source import BANK_INDEX as INDEX
from scenefactory_jax.scenes.stack import CutReport, stack
from scenefactory_jax.types import Scene

FORMAT = "scenefactory_jax bank"
SCHEMA = 2  # rises whenever a bank of before can no longer be read
SIZES = ("road", "agents", "steps", "others")  # the columns of sizes.npy
STORED = {n: c for n, c in columns.COLUMNS.items() if not n.startswith(("lanes.", "edges.")) and n != "road.valid"}


@dataclass(frozen=True, eq=False)
class Bank:
    """An open bank. Its columns stay on disk until rows of them are read."""

    path: Path
    reports: tuple[PackReport, ...]  # scene by scene: name, source, metadata, agents and segments dropped
    settings: dict[str, Any]  # what it was packed with
    rejects: tuple[dict[str, Any], ...]  # source, scene and reason of everything that could not be packed
    sizes: Int[np.ndarray, "N 4"]
    starts: Mapping[str, Int[np.ndarray, " N1"]]  # of each scene's rows, for columns by their own axes
    leaves: Mapping[str, np.ndarray]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(report.name for report in self.reports)

    def __len__(self) -> int:
        return len(self.reports)


def is_bank(path: Path | str) -> bool:
    """Whether a folder says of itself that it is a bank, of any schema."""
    try:
        return json.loads((Path(path) / INDEX).read_text()).get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        return False


def write(path: Path | str, packed: Iterable[Packed], *, settings: Mapping[str, Any], rejects: Sequence[Mapping[str, Any]] = ()) -> Bank:
    """Write a bank and open it. A bank that is there is replaced once the new one is complete.

    Args:
        path: folder to make.
        packed: scenes, taken one at a time.
        settings: what they were packed with, kept for the record.
        rejects: what could not be packed; looked at after the last scene.

    Raises:
        SceneError: the path exists and is no bank, or there are no scenes.
    """
    path = Path(path).resolve()
    if path.exists() and not is_bank(path) and not (path.is_dir() and not any(path.iterdir())):
        raise SceneError(f"{path}: exists and is no bank; give another path, or remove it")
    path.parent.mkdir(parents=True, exist_ok=True)
    workshop = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        made = workshop / "new"
        made.mkdir()
        _write_columns(made, packed, settings, rejects)
        if path.exists():
            path.rename(workshop / "old")
        made.rename(path)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
    return open(path)


def _write_columns(folder: Path, packed: Iterable[Packed], settings: Mapping[str, Any], rejects: Sequence[Mapping[str, Any]]) -> None:
    """Append scene by scene, so that memory holds one; the headers get their counts at the end."""
    reports, sizes = [], []
    counts = dict.fromkeys(STORED, 0)
    files = {name: (folder / f"{name}.npy").open("wb") for name in STORED}
    try:
        for name, file in files.items():
            _write_header(file, STORED[name], 0)
        for scene, report in packed:
            leaves = columns.flatten(scene)
            valid = leaves["road.valid"]
            sizes.append((int(valid.sum()), *leaves["log.valid"].shape, len(leaves["others.kind"])))
            reports.append(asdict(report))
            for name, file in files.items():
                leaf = leaves[name][valid] if name.startswith("road.") else leaves[name]
                rows = np.ascontiguousarray(leaf, STORED[name].dtype).reshape(-1, *_tail(STORED[name]))
                file.write(rows.tobytes())
                counts[name] += len(rows)
        for name, file in files.items():
            _write_header(file, STORED[name], counts[name])
    finally:
        for file in files.values():
            file.close()
    if not reports:
        reasons = "; ".join(str(reject["reason"]) for reject in list(rejects)[:3])
        raise SceneError(f"no scene to write{f': {len(rejects)} were rejected: {reasons}' if rejects else ''}")
    np.save(folder / "sizes.npy", np.array(sizes, np.int64).reshape(-1, len(SIZES)))
    index = {"format": FORMAT, "schema": SCHEMA, "settings": dict(settings), "rejects": [dict(r) for r in rejects], "scenes": reports}
    (folder / INDEX).write_text(json.dumps(index, default=_plain, indent=1))


def _write_header(file: Any, column: columns.Column, rows: int) -> None:
    """The .npy header; numpy pads it so that the first axis can grow in place."""
    file.seek(0, os.SEEK_SET)
    description = {"descr": np.lib.format.dtype_to_descr(column.dtype), "fortran_order": False, "shape": (rows, *_tail(column))}
    np.lib.format.write_array_header_1_0(file, description)


def _tail(column: columns.Column) -> tuple[int, ...]:
    """A column's fixed axes."""
    return tuple(axis for axis in column.axes if isinstance(axis, int))


def _plain(value: Any) -> Any:
    """What JSON has no word for, in its words."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def open(path: Path | str) -> Bank:
    """Open a bank; its columns are mapped, not read.

    Raises:
        SceneError: no bank, a bank of another schema, or a column that is missing, damaged or cut short, by name.
    """
    path = Path(path)
    index = _read_index(path)
    known = {entry.name for entry in fields(PackReport)}
    try:
        reports = tuple(PackReport(**_as_tuples(record)) for record in index["scenes"])
        settings, rejects = index["settings"], tuple(index["rejects"])
    except (KeyError, TypeError) as error:
        raise SceneError(f"{path / INDEX}: damaged: {error}; a scene's record has {', '.join(sorted(known))}") from error
    sizes = _read_column(path, "sizes", np.dtype(np.int64), (len(SIZES),))
    if len(sizes) != len(reports) or (sizes < 0).any():
        raise SceneError(f"{path / 'sizes.npy'}: {len(sizes)} scenes; {INDEX} has {len(reports)}")
    sizes = np.asarray(sizes)
    road, agents, steps, others = sizes.T
    rows = {"road": road, "agents": agents, "log": agents * steps, "others": others, "tracks": others * steps}
    rows["one"] = np.ones(len(sizes), np.int64)
    starts = {axis: np.concatenate([[0], np.cumsum(count)]).astype(np.int64) for axis, count in rows.items()}
    leaves = {}
    for name, column in STORED.items():
        leaves[name] = _read_column(path, name, column.dtype, _tail(column))
        wanted = int(starts[_layout(column)][-1])
        if len(leaves[name]) != wanted:
            raise SceneError(f"{path / name}.npy: {len(leaves[name])} rows; the scenes' sizes make {wanted}")
    return Bank(path, reports, settings, rejects, sizes, starts, leaves)


def _read_index(path: Path) -> dict[str, Any]:
    """`bank.json`, if this version can read the bank."""
    if not is_bank(path):
        what = "no such folder" if not path.exists() else f"no bank: it has no {INDEX} of this format"
        raise SceneError(f"{path}: {what}; make one with `convert source=FILES out={path}`")
    index = json.loads((path / INDEX).read_text())
    if index.get("schema") != SCHEMA:
        raise SceneError(f"{path}: a bank of schema {index.get('schema')!r}; this version reads {SCHEMA}: convert its source again")
    return index


def _as_tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    """A report's lists as the tuples that they were."""
    return {key: tuple(value) if key in ("centre", "track_ids", "repairs") else value for key, value in record.items()}


def _read_column(path: Path, name: str, dtype: np.dtype, tail: tuple[int, ...]) -> np.ndarray:
    """One memory-mapped column of the right kind."""
    file = path / f"{name}.npy"
    if not file.is_file():
        raise SceneError(f"{file}: missing column; the bank is incomplete: copy or convert it again")
    try:
        leaf = np.load(file, mmap_mode="r")
    except (OSError, ValueError, EOFError) as error:
        raise SceneError(f"{file}: damaged or cut short: {error}") from error
    if leaf.dtype != dtype or leaf.shape[1:] != tail:
        raise SceneError(f"{file}: {leaf.dtype} {leaf.shape}; there must be {dtype} {('N', *tail)}")
    return leaf


def _layout(column: columns.Column) -> str:
    """By what a column's rows are counted."""
    if not column.axes:
        return "one"
    logs = {"agents": "log", "others": "tracks"}
    return logs[str(column.axes[0])] if "steps" in column.axes else str(column.axes[0])


def scene(bank: Bank, index: int) -> Packed:
    """One scene of its own size and its account: for viewing, and for writing another bank.

    Raises:
        SceneError: no such scene.
    """
    count = len(bank)
    if not -count <= index < count:
        raise SceneError(f"{bank.path}: no scene {index}; valid: 0 to {count - 1}")
    index = index % count
    road, agents, steps, others = (int(size) for size in bank.sizes[index])
    shapes = {"road": (road,), "agents": (agents,), "log": (agents, steps), "others": (others,), "tracks": (others, steps), "one": ()}
    leaves: dict[str, np.ndarray] = {"road.valid": np.ones(road, bool)}
    for name, column in STORED.items():
        layout = _layout(column)
        begin, end = bank.starts[layout][index : index + 2]
        leaves[name] = np.array(bank.leaves[name][begin:end]).reshape((*shapes[layout], *_tail(column)))
    return Packed(columns.assemble(Scene, columns.with_subsets(leaves)), bank.reports[index])


def load(bank: Bank, indices: Sequence[int] | np.ndarray, *, capacity: Mapping[str, int | None]) -> tuple[Scene, CutReport]:
    """Worlds of the given scenes, stacked and padded; an index may occur many times. See `stack`.

    Raises:
        SceneError: no such scene, no indices, or a capacity that is none.
    """
    wanted = [int(index) for index in indices]
    distinct = sorted(set(wanted))
    stacked, report = stack([scene(bank, index).scene for index in distinct], capacity=capacity)
    if distinct == wanted:
        return stacked, report
    place = {index: row for row, index in enumerate(distinct)}
    rows = np.array([place[index] for index in wanted])
    leaves = {name: leaf[rows] for name, leaf in columns.flatten(stacked).items()}
    cuts = tuple(replace(cut, world=int(world)) for cut in report.cuts for world in np.flatnonzero(rows == cut.world))
    return columns.assemble(Scene, leaves), CutReport(len(wanted), report.capacity, cuts)
