"""Finds the files below a path, and the reader of each file."""

import os
import re
import stat
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.raw_scene import FormatMismatch, OtherContent, RawScene, Reject, SceneError
from scenefactory_jax.data.formats import file_content

MAX_REASON = 72  # characters of a reader's refusal
BANK_INDEX = "bank.json"  # the file that makes a folder a bank
STARTS = {
    b"\x89HDF": "HDF5",
    b"PK\x03\x04": "a ZIP archive",
    b"BZh": "a file compressed by bzip2",
    b"\x28\xb5\x2f\xfd": "a file compressed by Zstandard",
    b"\x93NUMPY": "an array of NumPy",
    b"#ROSBAG": "a bag of ROS",
    b"\x89MCAP": "MCAP, a bag of ROS 2",
    b"track_id,frame_id,timestamp_ms,": "a recording of INTERACTION (CSV)",
    b"frame,id,x,y,width,height,": "a recording of highD (CSV)",
    b"recordingId,trackId,frame,": "a recording of inD, rounD, uniD or exiD (CSV)",
    b"Vehicle_ID,Frame_ID,": "a recording of NGSIM (CSV)",
}
ROOTS = {
    "OpenDRIVE": "OpenDRIVE",
    "OpenSCENARIO": "OpenSCENARIO",
    "commonRoad": "CommonRoad",
    "osm": "OpenStreetMap XML, such as the Lanelet2 maps of INTERACTION",
    "net": "a network of SUMO",
    "fcd-export": "a recording of SUMO",
    "nodes": "an input of SUMO's netconvert",
    "edges": "an input of SUMO's netconvert",
    "connections": "an input of SUMO's netconvert",
    "routes": "a route file of SUMO",
    "additional": "a file of additional elements of SUMO",
    "configuration": "a configuration, such as SUMO's",
    "sumoConfiguration": "a configuration of SUMO",
}
GIVE = {root: "give the network (.net.xml), or a recording (--fcd-output) beside it" for root in list(ROOTS)[-7:]}
BEFORE_ROOT = re.compile(r"<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>", re.DOTALL)  # declaration, comments and document type
Reader = Callable[[Path], Iterator[RawScene | Reject]]


def make(formats: Mapping[str, Any]) -> dict[str, Reader]:
    """Makes the readers of config entries, in the order in which they are tried.

    Raises:
        ConfigError: an entry that cannot be built, by name.
    """
    return {name: instantiate(entry, builtins=__name__, where=f"formats.{name}") for name, entry in formats.items() if entry is not None}


def find(path: Path | str) -> list[Path]:
    """Finds the file itself, or every file below a folder in sorted order, without hidden files and banks.

    A folder that cannot be listed is in the list: reading it raises the reason.

    Raises:
        SceneError: no such path, a bank, or an empty folder.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise SceneError(f"{path}: no such file or folder; give a scene file or a folder of them")
    if (path / BANK_INDEX).is_file():
        raise SceneError(f"{path}: a bank already; give the files that it was made from")
    files: list[Path] = []
    for folder, folders, names in os.walk(path, onerror=lambda error: files.append(Path(error.filename))):
        folders[:] = [name for name in folders if not name.startswith(".")]
        if BANK_INDEX not in names:
            files.extend(file for name in names if not name.startswith(".") and _is_regular(file := Path(folder, name)))
    if not files:
        raise SceneError(f"{path}: an empty folder; give a scene file or a folder of them")
    return sorted(files)


def _is_regular(path: Path) -> bool:
    """Whether this is not a pipe or a device; a file without access counts as regular, and reading it raises the reason."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return True


def read(path: Path | str, formats: Mapping[str, Reader]) -> Iterator[RawScene | Reject]:
    """Reads the scenes of one file by the first reader of its format, with a `Reject` for each record that could not be read.

    Raises:
        Companion: the file belongs to scenes beside it.
        SceneError: a folder that cannot be listed; an unknown format, by name if possible; or an error of the reader.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"{path}: a folder that cannot be listed; allow it to be read, or give the files beside it")
    with file_content.unpacked_once():
        first, scenes = _find_reader(path, formats)
    yield first
    yield from scenes


def _find_reader(path: Path, formats: Mapping[str, Reader]) -> tuple[RawScene | Reject, Iterator[RawScene | Reject]]:
    """The first scene of the first reader that accepts the file, and the iterator over the others."""
    refusals: dict[str, str] = {}
    for name, reader in formats.items():
        scenes = iter(reader(path))
        try:
            first = next(scenes, None)
        except OtherContent as refusal:
            refusals[name] = textwrap.shorten(f"{name}: {str(refusal).removeprefix(f'{path}: ')}", MAX_REASON)
            continue
        except FormatMismatch:
            continue
        if first is None:
            raise SceneError(f"{path}: the reader {name!r} found no scene")
        return first, scenes
    others = [name for name in formats if name not in refusals]
    raise SceneError(f"{path}: {_explain(path, list(refusals.values()))}; formats: {', '.join(others) or 'none'}")


def _explain(path: Path, refusals: Sequence[str]) -> str:
    """Why no reader accepts a file: its format, or the refusals of readers of the same container, or its first bytes."""
    head = file_content.read_head(path)
    if not head:
        return "an empty file"
    name = next((name for start, name in STARTS.items() if head.startswith(start)), None)
    text = head.decode("utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig", errors="ignore").lstrip()
    root = re.match(r"<(?:\w+:)?([\w.-]+)", BEFORE_ROOT.sub("", text).lstrip()) if text.startswith("<") else None
    if name is None and root is not None:
        name = ROOTS.get(root[1], f"XML of the root element {root[1][:40]!r}")
    if name is None and re.search(r'"type"\s*:\s*"FeatureCollection"', text):
        name = "GeoJSON"
    if name is not None:
        return f"this is {name}: {GIVE.get(root[1], 'it is not read') if root is not None else 'it is not read'}"
    return f"unknown format: {'; '.join(refusals) or f'it begins with {head[:16]!r}'}"
