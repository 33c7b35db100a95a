"""JSON documents: unpacking, and reading values out of them with messages that name the file and the key."""

import contextlib
import gzip
import json
import lzma
import operator
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from io import BufferedIOBase, BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError

MAGIC = {b"\x1f\x8b": ("gzip", gzip.open), b"\xfd7zXZ\x00": ("xz", lzma.open)}
DAMAGE = (OSError, EOFError, lzma.LZMAError, zlib.error)  # what unpacking says of a damaged file
CHUNK = 2**20  # bytes read at a time: memory follows what a file holds, not what it declares
HEAD = 4096  # bytes by which a format is told
FILE_LIMIT_MB = 32  # of readers whose config is older than the limit
NAMES = {dict: "an object", list: "a list", str: "a text", int: "an integer", float: "a number", bool: "true or false"}


_kept: ContextVar[dict[Path, bytes] | None] = ContextVar("kept", default=None)


@contextlib.contextmanager
def unpacked_once() -> Iterator[None]:
    """Within it, `unpack` reads each file once, however many readers ask for its content; the files must not change meanwhile."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def load(path: Path, *, file_limit_mb: int) -> dict[str, Any]:
    """The JSON object in a file: plain, gzip or xz, told apart by their first bytes and not by the suffix.

    Raises:
        SceneError: unreadable, damaged or truncated, or larger than the limit.
        FormatMismatch: no JSON object at all.
    """
    start = read_head(path)
    if not start.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        raise FormatMismatch(f"{path}: no JSON object (plain, gzip or xz); it begins with {start[:16]!r}")
    text = unpack(path, file_limit_mb=file_limit_mb)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: no valid JSON, damaged or cut short after {len(text)} bytes: {error}") from error


def read_head(path: Path) -> bytes:
    """The first HEAD bytes of what a file holds, without its compression.

    Raises:
        SceneError: no such file, or a compressed file that is damaged or truncated.
    """
    kept = (_kept.get() or {}).get(Path(path))
    return _read(path, HEAD) if kept is None else kept[:HEAD]


def unpack(path: Path, *, file_limit_mb: int) -> bytes:
    """What a file holds, without its compression. No more than the limit is ever unpacked.

    Raises:
        SceneError: no such file, a compressed file that is damaged or truncated, or one that holds more than the limit.
    """
    kept = _kept.get()
    content = None if kept is None else kept.get(Path(path))
    if content is None:
        content = _read(path, file_limit_mb * 10**6 + 1)
    if len(content) > file_limit_mb * 10**6:
        limit = f"more than {file_limit_mb} MB, unpacked if it is compressed"
        raise SceneError(f"{path}: holds {limit}; file_limit_mb of its reader sets the limit")
    if kept is not None:
        kept[Path(path)] = content
    return content


def _read(path: Path, count: int) -> bytes:
    """The first `count` bytes of what a file holds, unpacked as they are read."""
    name = None
    try:
        with open(path, "rb") as stream:
            name, opener = _packing(stream)
            with opener(stream) as unpacked:
                return take_key(unpacked, count)
    except DAMAGE as error:
        unread = f"cannot be read: {getattr(error, 'strerror', None) or error}"
        damaged = f"begins as {name} but cannot be unpacked, damaged or cut short: {error}"
        raise SceneError(f"{path}: {unread if name is None else damaged}") from error


def _packing(stream: BufferedReader) -> tuple[str | None, Callable[[Any], Any]]:
    """How a file is compressed, by its first bytes, and what opens it."""
    start = stream.peek(max(map(len, MAGIC)))
    found = (entry for magic, entry in MAGIC.items() if start.startswith(magic))
    return next(found, (None, contextlib.nullcontext))


def take_key(stream: BufferedIOBase, count: int) -> bytes:
    """The next `count` bytes of a stream, or as many as there are."""
    parts = []
    while count > 0 and (part := stream.read(min(count, CHUNK))):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def is_number(value: Any) -> bool:
    """A JSON number; true and false are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def expect(value: Any, kind: type, where: str) -> Any:
    """`value`, if it is of that JSON type; an integer that a float can hold passes for a number.

    Raises:
        SceneError: naming `where` and the value.
    """
    fits = is_number(value) if kind is float else isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if not fits:
        text = repr(value)
        raise SceneError(f"{where}: {text if len(text) < 80 else text[:77] + '...'} is not {NAMES[kind]}")
    if kind is float and isinstance(value, int) and abs(value) > sys.float_info.max:
        raise SceneError(f"{where}: an integer of {value.bit_length()} bits is larger than any number of 64 bits")
    return value


def get(record: dict[str, Any], key: str, kind: type, where: str) -> Any:
    """`record[key]`, if it is there and of that JSON type.

    Raises:
        SceneError: naming the key, and those that are there.
    """
    place = where + ("" if where.endswith(": ") else ".") + key
    if key not in record:
        raise SceneError(f"{place}: missing; there are: {', '.join(map(str, record)) or 'none'}")
    return expect(record[key], kind, place)


def numbers(values: Any, where: str, *, length: int | None = None) -> Float[np.ndarray, " N"]:
    """A list of numbers as an array; whether they are finite is another question (`require_finite`).

    Raises:
        SceneError: no list, another length, or an entry that is no number, named.
    """
    expect(values, list, where)
    if length is not None and len(values) != length:
        raise SceneError(f"{where}: {len(values)} entries; there must be {length}, one for each step")
    with contextlib.suppress(OverflowError):  # of an integer, which is named below
        if set(map(type, values)) <= {int, float}:
            return np.asarray(values, np.float64)
    return np.array([expect(value, float, f"{where}[{place}]") for place, value in enumerate(values)], np.float64)


def points(rows: Any, keys: Sequence[str], where: str, *, length: int | None = None) -> Float[np.ndarray, "N D"]:
    """A list of objects such as `{"x": 1.0, "y": 2.0}` as an array with a column for each key.

    Raises:
        SceneError: no list, another length, or a coordinate that is missing or no number, named as in `objects[3].position[10].x`.
    """
    expect(rows, list, where)
    if length is not None and len(rows) != length:
        raise SceneError(f"{where}: {len(rows)} entries; there must be {length}, one for each step")
    with contextlib.suppress(KeyError, TypeError, IndexError, OverflowError):  # what is wrong is named below
        columns = [list(map(operator.itemgetter(key), rows)) for key in keys]
        if all(set(map(type, column)) <= {int, float} for column in columns):
            return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)
    places = [(expect(row, dict, f"{where}[{place}]"), f"{where}[{place}]") for place, row in enumerate(rows)]
    return np.array([[get(row, key, float, place) for key in keys] for row, place in places], np.float64)


def check_finite(
    table: Float[np.ndarray, "N ..."], where: str, *, rows: Bool[np.ndarray, " N"] | None = None, keys: Sequence[str] = ()
) -> None:
    """Refuse NaN and infinity in the given rows.

    Raises:
        SceneError: naming the first such number.
    """
    bad = ~np.isfinite(table)
    if rows is not None:
        bad &= rows.reshape((-1,) + (1,) * (table.ndim - 1))
    if bad.any():
        row, *column = np.argwhere(bad)[0]
        key = f".{keys[column[0]]}" if keys and column else "".join(f"[{c}]" for c in column)
        raise SceneError(f"{where}[{row}]{key}: {table[(row, *column)]} is not finite")
