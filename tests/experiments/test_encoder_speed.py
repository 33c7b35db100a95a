"""The benchmark of encoders at the smallest size: rows, rates and the report."""

import json

import pytest
from support.running import quick_compilation

from experiments.benchmarks import encoders


@pytest.mark.slow
def test_each_program_of_an_encoder_is_measured(tmp_path, capsys):
    small = ["observations=vmax_road", "scenes.pack.agents=2", "dynamics=bicycle"]
    with quick_compilation():
        options = ["--encoders", "none", "--batches", "2", "3", "--repeats", "1", "--peak-tflops", "0.5", "--out", str(tmp_path)]
        rows = encoders.main([*options, *small])
    assert [(row["program"], row["batch"]) for row in rows] == [(kind, batch) for kind in ("forward", "gradient") for batch in (2, 3)]
    for row in rows:
        assert row["parameters"] == 442_596 and row["per_s"] == pytest.approx(row["batch"] / row["seconds"])
        assert row["share"] == pytest.approx(row["per_s"] * row["mflop_a_sample"] / 1e6 / 0.5)
    forward, gradient = rows[0]["mflop_a_sample"], rows[2]["mflop_a_sample"]
    weights = 1655 * 256 + 256 * 64 + 64 * 32 + 32 * 4
    assert forward == pytest.approx(2 * weights / 1e6, rel=0.01) and 1.9 < gradient / forward < 3.0
    kept = json.loads((tmp_path / "encoders.json").read_text())["rows"]
    assert [row["per_s"] for row in kept] == pytest.approx([row["per_s"] for row in rows], rel=1e-4)
    assert encoders.format_rows(rows) in capsys.readouterr().out and encoders.format_rows(rows) in (tmp_path / "encoders.md").read_text()


def test_a_batch_beyond_the_memory_has_no_rate():
    row = {"encoder": "lq", "parameters": 5, "program": "forward", "batch": 64, "mflop_a_sample": 1.0, "per_s": None}
    assert encoders.format_rows([row]).splitlines()[-1] == "| lq | 5 | forward | 64 | 1.00 | - | - | - | - | - |"
