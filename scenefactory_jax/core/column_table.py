"""Writes tables of columns as CSV, and beside it as Parquet: the tables of agents of all commands."""

import csv
import json
import lzma
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scenefactory_jax.core import atomic_file


def write(path: Path, columns: Mapping[str, Sequence[Any] | np.ndarray], *, metadata: Mapping[str, Any]) -> Path:
    """Writes a table as CSV (`.csv` or `.csv.xz`), each number so that it reads back to the same value, and as Parquet of the same stem.

    NaN and None are absent: an empty cell, a null. The CSV is complete last.

    Args:
        columns: name -> values of one kind, as many in each column.
        metadata: of the Parquet file's schema; what is no text is written as JSON.

    Returns:
        The path of the Parquet file.
    """
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    texts = {name: value if isinstance(value, str) else json.dumps(value, sort_keys=True) for name, value in metadata.items()}
    parquet = path.with_name(f"{path.name.partition('.csv')[0]}.parquet")
    with atomic_file.write_atomically(parquet) as temporary:
        pq.write_table(table.replace_schema_metadata(texts), temporary, compression="zstd")
    with atomic_file.write_atomically(path) as temporary, open_csv(temporary, "wt", compressed=path.suffix == ".xz") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*map(_format_cells, columns.values()), strict=True))
    return parquet


def open_csv(path: Path, mode: str, *, compressed: bool) -> Any:
    """Opens a text file with line ends as they are written; the same content is always compressed to the same bytes."""
    return (lzma.open if compressed else open)(path, mode, newline="", encoding="utf-8")


def _format_cells(values: Sequence[Any] | np.ndarray) -> list[Any]:
    """Values in Python's own types; empty where absent."""
    values = values.tolist() if isinstance(values, np.ndarray) else values
    return ["" if value is None or value != value else value for value in values]
