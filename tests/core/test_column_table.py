"""Tables as CSV and as Parquet beside it: kinds of columns, what is absent, and what the files say of themselves."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from scenefactory_jax.core import column_table

COLUMNS = {
    "scene": np.array(["a", "b, c", "d"]),
    "agent": np.arange(3),
    "clean": np.array([True, False, True]),
    "score": np.array([0.1, np.nan, np.inf], np.float32),
    "none": np.full(3, np.nan),
    "turn": [None, 1.5, 2.5],
    "along_lanes": [True, None, False],
}


@pytest.mark.parametrize("name", ["table.csv", "table.csv.xz"])
def test_both_files_hold_the_same(tmp_path, name):
    path = column_table.write(tmp_path / name, COLUMNS, metadata={"protocol": "vmax", "versions": {"jax": "1"}})
    assert path == tmp_path / "table.parquet" and {file.name for file in tmp_path.iterdir()} == {name, "table.parquet"}
    table = pq.read_table(path)
    kinds = [pa.string(), pa.int64(), pa.bool_(), pa.float32(), pa.float64(), pa.float64(), pa.bool_()]
    assert table.schema.types == kinds and table.column_names == list(COLUMNS)
    assert [table[name].null_count for name in COLUMNS] == [0, 0, 0, 1, 3, 1, 1]
    assert table["score"].to_pylist() == [np.float32(0.1), None, np.inf]
    assert table.schema.metadata[b"protocol"] == b"vmax" and json.loads(table.schema.metadata[b"versions"]) == {"jax": "1"}
    with column_table.open_csv(tmp_path / name, "rt", compressed=name.endswith("xz")) as file:
        lines = file.read().split("\r\n")
    assert lines[1:4] == [f"a,0,True,{float(np.float32(0.1))},,,True", '"b, c",1,False,,,1.5,', "d,2,True,inf,,2.5,False"]


def test_a_table_without_rows(tmp_path):
    assert pq.read_table(column_table.write(tmp_path / "table.csv", {"scene": [], "agent": []}, metadata={})).num_rows == 0
