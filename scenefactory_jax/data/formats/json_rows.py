"""JSON files that hold a list of objects, read one object at a time: those of nuScenes have gigabytes."""

import codecs
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.formats import file_content

MAX_ROW = 2**20  # characters of one object


def read_rows(path: Path, *, row_limit: int) -> Iterator[dict[str, Any]]:
    """Reads the objects of a list, plain or compressed.

    Raises:
        SceneError: unreadable, damaged or cut short, no list of objects, or more than `row_limit` of them.
    """
    try:
        with file_content.find_compression(path)[1](path, "rb") as file:
            yield from _decode(codecs.getreader("utf-8-sig")(file), path, row_limit)
    except (*file_content.DAMAGE, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read, damaged or cut short: {getattr(error, 'strerror', None) or error}") from error


def _decode(stream: Any, path: Path, row_limit: int) -> Iterator[dict[str, Any]]:
    """The objects of a stream of text."""
    decoder, count = json.JSONDecoder(), 0
    text = stream.read(file_content.CHUNK).lstrip()
    if not text.startswith("["):
        raise SceneError(f"{path}: expected a list in JSON, got a file that begins with {text[:16]!r}")
    place, separators = 1, " \t\r\n,"
    while True:
        while place < len(text) and text[place] in separators:
            place += 1
        if text[place : place + 1] == "]":
            return
        try:
            row, place = decoder.raw_decode(text, place)
        except (ValueError, RecursionError) as error:
            more = stream.read(file_content.CHUNK) if len(text) - place <= MAX_ROW else ""
            if not more:
                raise SceneError(f"{path}: not valid JSON, damaged or cut short behind row {count}: {str(error)[:80]}") from error
            text, place = text[place:] + more, 0
            continue
        count += 1
        if not isinstance(row, dict) or count > row_limit:
            got = f"got {type(row).__name__}" if not isinstance(row, dict) else "got more"
            raise SceneError(f"{path}: expected up to {row_limit} objects (row_limit of its reader), {got}")
        yield row
