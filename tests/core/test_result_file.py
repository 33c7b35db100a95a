"""Results come back from their files as they were."""

import json
from typing import NamedTuple

import numpy as np
import pytest

from scenefactory_jax.core import result_file
from scenefactory_jax.loggers import metrics_csv


class Row(NamedTuple):
    name: str
    error: np.ndarray


def test_results_come_back(tmp_path):
    path = tmp_path / "a.json"
    content = {"row": Row("b", np.array([1.0, np.nan, np.inf])), "refused": None, 3: (np.float32(0.5), True, np.int64(7)), "all": 12345678}
    result_file.write(path, content, digits=None)
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]
    found = result_file.read(path)
    np.testing.assert_array_equal(found["row"]["error"], [1.0, np.nan, np.nan])
    assert found["refused"] is None and found["3"] == [0.5, True, 7] and found["all"] == 12345678
    json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def test_digits_and_digests(tmp_path):
    result_file.write(tmp_path / "a.json", {"x": [1.23456789, 1e-9 / 3.0]}, digits=5)
    assert (tmp_path / "a.json").read_text() == '{"x":[1.2346,3.3333e-10]}\n'
    one, other = result_file.digest({"a": 1, "b": [2.0]}), result_file.digest({"b": [2.0], "a": 1})
    assert one == other != result_file.digest({"a": 1, "b": [2.1]}) and len(one) == 16


def test_an_incomplete_last_row_of_metrics_is_left_out(tmp_path, monkeypatch):
    file = tmp_path / metrics_csv.FILE
    file.write_text("iteration,reward\r\n1,0.5\r\n2,\r\n3,0.1")  # of 0.125, perhaps
    first, second = metrics_csv.read(tmp_path)
    assert first == {"iteration": 1.0, "reward": 0.5} and second["iteration"] == 2.0 and np.isnan(second["reward"])
    before = file.read_bytes()
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(metrics_csv.csv.DictWriter, "writerows", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        metrics_csv.MetricsFile(tmp_path, resume_at=2)
    assert file.read_bytes() == before
    metrics_csv.MetricsFile(tmp_path, resume_at=1).add({"iteration": 2, "reward": 0.25})
    assert metrics_csv.read(tmp_path) == [first, {"iteration": 2.0, "reward": 0.25}] and sorted(tmp_path.iterdir()) == [file]
