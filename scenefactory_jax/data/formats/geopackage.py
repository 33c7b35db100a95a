"""SQLite databases, and the layers of GeoPackages (OGC 12-128r19), which are tables of shapes: a header, then well-known binary."""

import contextlib
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from scenefactory_jax.core.raw_scene import FormatMismatch, SceneError
from scenefactory_jax.data.formats import file_content

MAGIC = b"SQLite format 3\0"
ENVELOPES = (0, 32, 48, 48, 64)  # bytes of the bounds behind a shape's header, by their kind
MAX_ARGUMENTS = 500  # of one query
CONTENTS = "gpkg_contents"  # the table that makes a database a GeoPackage


@dataclass(frozen=True)
class Database:
    """A database that is open to read."""

    path: Path
    connection: sqlite3.Connection
    columns: dict[str, tuple[str, ...]]  # by table
    row_limit: int

    def select(
        self, table: str, names: Sequence[str], *, optional: Sequence[str] = (), among: tuple[str, Sequence[Any]] | None = None
    ) -> list[tuple[Any, ...]]:
        """The rows of a table with these columns, then the optional ones, which are None where the table has none.

        Args:
            among: a column and the values of which it must have one; None: all rows.

        Raises:
            SceneError: no such table or column, or more rows than `row_limit`.
        """
        there = self.columns.get(table, ())
        if missing := [name for name in names if name not in there]:
            got = f"the columns {', '.join(there)}" if there else f"the tables {', '.join(self.columns) or 'none'}"
            raise SceneError(f"{self.path}: expected a table {table} with a column {missing[0]}, got {got}")
        chosen = ", ".join(f'"{name}"' if name in there else "NULL" for name in (*names, *optional))
        parts: list[Sequence[Any]] = [()]
        if among is not None:
            values = among[1]
            parts = [values[first : first + MAX_ARGUMENTS] for first in range(0, len(values), MAX_ARGUMENTS)]
        rows: list[tuple[Any, ...]] = []
        for part in parts:
            which = "" if among is None else f' WHERE "{among[0]}" IN ({", ".join("?" * len(part))})'
            rows += self.connection.execute(f'SELECT {chosen} FROM "{table}"{which} LIMIT {self.row_limit + 1 - len(rows)}', part)
            if len(rows) > self.row_limit:
                raise SceneError(f"{self.path}: {table}: expected up to {self.row_limit} rows at once (row_limit of its reader), got more")
        return rows


@dataclass(frozen=True)
class Layer:
    """The shapes of a layer, flat, and their attributes; rows without a shape are left out."""

    shapes: Any  # [N] of shapely
    reference: tuple[int, ...]  # coordinate reference system of each shape, `srs_id`
    fids: tuple[int, ...]  # primary keys
    rows: tuple[tuple[Any, ...], ...]


@contextlib.contextmanager
def open_database(path: Path, row_limit: int) -> Iterator[Database]:
    """Opens a database, whose faults become a SceneError.

    Raises:
        FormatMismatch: no SQLite database.
    """
    start = file_content.read_head(path)
    if not start.startswith(MAGIC):
        raise FormatMismatch(f"{path}: expected an SQLite database, got a file that begins with {start[:16]!r}")
    if file_content.find_compression(path)[0] is not None:
        raise SceneError(f"{path}: a compressed SQLite database; unpack it before")
    try:
        with contextlib.closing(sqlite3.connect(f"{Path(path).absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as connection:
            connection.text_factory = lambda text: text.decode(errors="replace")
            plain = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
            names = [name for (name,) in connection.execute(plain)]
            listed = "SELECT name FROM pragma_table_info(?)"
            columns = {name: tuple(column for (column,) in connection.execute(listed, (name,))) for name in names}
            yield Database(Path(path), connection, columns, row_limit)
    except (sqlite3.Error, MemoryError, OverflowError) as error:
        raise SceneError(f"{path}: not a valid SQLite database, damaged or cut short: {error}") from error


def read_layer(database: Database, name: str, attributes: Sequence[str] = ()) -> Layer:
    """Reads a layer; one that is missing is empty, and attributes that are missing are None."""
    if name not in database.columns:
        return Layer(np.zeros(0, object), (), (), ())
    columns, where = database.columns[name], f"{database.path}: {name}"
    key, shape = (next((c for c in options if c in columns), options[0]) for options in (("fid", "id", "ogc_fid"), ("geom", "geometry")))
    found = [row for row in database.select(name, (key, shape), optional=attributes) if row[1] is not None]
    parsed = [_split(row[1], f"{where}: {key} {row[0]!r}") for row in found]
    try:
        shapes = shapely.force_2d(shapely.from_wkb(np.array([binary for _, binary in parsed], object)))
    except shapely.errors.ShapelyError as error:
        raise SceneError(f"{where}: expected shapes in well-known binary: {str(error)[:200]}") from error
    kept = np.flatnonzero(~(shapely.is_missing(shapes) | shapely.is_empty(shapes)))
    if (bad := [found[row][0] for row in kept if not isinstance(found[row][0], int)])[:1]:
        raise SceneError(f"{where}: {key}: expected an integer, got {bad[0]!r:.40}")
    if not np.isfinite(shapely.bounds(shapes[kept])).all():
        raise SceneError(f"{where}: expected finite coordinates, got others")
    return Layer(
        shapes[kept], tuple(parsed[row][0] for row in kept), tuple(found[row][0] for row in kept), tuple(found[row][2:] for row in kept)
    )


def _split(blob: Any, where: str) -> tuple[int, bytes | None]:
    """The reference system of a shape, and its well-known binary; None of an empty shape."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP" or (flags := blob[3]) >> 1 & 7 >= len(ENVELOPES):
        raise SceneError(f"{where}: expected a shape with the header of a GeoPackage, got {blob!r:.40}")
    (reference,) = struct.unpack_from("<i" if flags & 1 else ">i", blob, 4)
    return reference, None if flags & 16 else blob[8 + ENVELOPES[flags >> 1 & 7] :]


def list_lines(shape: Any) -> Float[np.ndarray, "N 2"]:
    """The points of a line; of several, those of the longest, after joining those that meet."""
    if shape.geom_type == "MultiLineString":
        merged = shapely.get_parts(shapely.line_merge(shape))
        shape = merged[int(np.argmax(shapely.length(merged)))]
    return shapely.get_coordinates(shape)


def list_polygons(shapes: Any) -> list[shapely.Polygon]:
    """The polygons of shapes; other shapes are left out."""
    return [part for part in shapely.get_parts(shapes) if part.geom_type == "Polygon" and not part.is_empty]
