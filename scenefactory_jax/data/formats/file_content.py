"""The content of files, plain or compressed by gzip or xz, and the JSON object in them."""

import contextlib
import gzip
import json
import lzma
import zlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError

MAGIC = {b"\x1f\x8b": ("gzip", gzip.open), b"\xfd7zXZ\x00": ("xz", lzma.open)}
DAMAGE = (OSError, EOFError, lzma.LZMAError, zlib.error)  # errors of unpacking a damaged file
CHUNK = 2**20  # bytes read at a time: memory follows the content of a file, not the size that it declares
HEAD = 16_384  # bytes that identify a format: files of SUMO begin with a comment of some thousand

_cache: ContextVar[dict[Path, bytes] | None] = ContextVar("cache", default=None)


@contextlib.contextmanager
def unpacked_once() -> Iterator[None]:
    """A context in which `unpack` reads each file once for all readers; the files must not change meanwhile."""
    token = _cache.set({})
    try:
        yield
    finally:
        _cache.reset(token)


def find_stem(path: Path) -> str:
    """A file's name without the endings of its format and of compression."""
    path = Path(path)
    return (path.with_suffix("") if path.suffix in (".gz", ".xz") else path).stem


def load_json(path: Path, *, file_limit_mb: int) -> dict[str, Any]:
    """Reads the JSON object in a file.

    Raises:
        SceneError: unreadable, damaged or truncated, or larger than the limit.
        FormatMismatch: not a JSON object.
    """
    head = read_head(path)
    if not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        raise FormatMismatch(f"{path}: expected a JSON object (plain, gzip or xz), got a file that begins with {head[:16]!r}")
    text = unpack(path, file_limit_mb=file_limit_mb)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not valid JSON, damaged or cut short after {len(text)} bytes: {error}") from error


def read_head(path: Path) -> bytes:
    """Reads the first HEAD bytes of the content."""
    content = (_cache.get() or {}).get(Path(path))
    return _read(path, HEAD) if content is None else content[:HEAD]


def unpack(path: Path, *, file_limit_mb: int) -> bytes:
    """Reads the content; never unpacks more than the limit.

    Raises:
        SceneError: no such file, damaged or truncated, or larger than the limit.
    """
    cache = _cache.get()
    content = None if cache is None else cache.get(Path(path))
    if content is None:
        content = _read(path, file_limit_mb * 10**6 + 1)
    if len(content) > file_limit_mb * 10**6:
        raise SceneError(f"{path}: expected a content of up to {file_limit_mb} MB, got more; see file_limit_mb of its reader")
    if cache is not None:
        cache[Path(path)] = content
    return content


def _read(path: Path, count: int) -> bytes:
    """Reads the first `count` bytes of the content."""
    name = None
    try:
        name, opener = find_compression(path)
        with opener(path, "rb") as stream:
            return read_bytes(stream, count)
    except DAMAGE as error:
        fault = "cannot be read" if name is None else f"begins as {name} but cannot be unpacked, damaged or cut short"
        raise SceneError(f"{path}: {fault}: {getattr(error, 'strerror', None) or error}") from error


def find_compression(path: Path) -> tuple[str | None, Callable[..., Any]]:
    """The name of a file's compression, by its first bytes, and the function that opens its content."""
    with open(path, "rb") as file:
        start = file.read(max(map(len, MAGIC)))
    return next((entry for magic, entry in MAGIC.items() if start.startswith(magic)), (None, open))


def read_bytes(stream: BufferedIOBase, count: int) -> bytes:
    """Reads the next `count` bytes of a stream, or as many as there are."""
    parts = []
    while count > 0 and (part := stream.read(min(count, CHUNK))):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
