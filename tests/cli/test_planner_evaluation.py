"""`evaluate` with planners alone: the table of planners x metrics, tables of agents, the page of failures, and the same bits every time."""

import csv
import io
import json
import re

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.running import quick_compilation

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.compare import compare
from scenefactory_jax.cli.evaluate import ALONE, evaluate, load_terminations
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import episode_records, scoring
from scenefactory_jax.evaluation.metrics.step_failures import COMPLIANCE, EVENTS
from scenefactory_jax.evaluation.settings import ScoreSettings
from scenefactory_jax.evaluation.statistics import Estimate
from scenefactory_jax.visualization.report import planner_table

pytestmark = pytest.mark.ci

SMALL = ["scenes=streets", "scenes.heldout.count=3", "dynamics=bicycle_waymax", "timing=waymax", "actions=acceleration"]
SMALL += ["timing.episode_s=2", "scenes.pack.traffic=8", "step_metrics.kernels=false"]
PLANNERS = ["random"]


def asked(out, *words, protocol="vmax"):
    quiet = ["video.enable=false", "failures.pictures.enable=false", "bootstrap=50", "chunk_steps=20", "replay_worlds=2"]
    return hydra_config.load_config("evaluate", f"protocol={protocol}", f"overrides=[{','.join(SMALL)}]", f"out={out}", *quiet, *words)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Without a run; drawing is left to the tests of figures."""
    with quick_compilation():
        yield evaluate(asked(tmp_path_factory.mktemp("plain"), f"planners=[{','.join(PLANNERS)}]"))


def test_planners_need_no_run(plain):
    assert list(plain.records) == ["whole, random"]
    text = plain.report.read_text()
    assert "evaluate protocol=vmax" in text and "run=" not in text.split("evaluate protocol=vmax")[1].split("```")[0]
    assert "**whole**: nothing but time ends an agent" in text
    with pytest.raises(ConfigError, match=r"run: missing; give run=\.\.\., or planners="):
        evaluate(asked("nowhere"))
    with pytest.raises(ConfigError, match=r"untrained: expected false without a run"):
        evaluate(asked("nowhere", "planners=[random]", "untrained=true"))


@pytest.mark.slow  # a program a planner
def test_the_first_planner_is_compared_with_the_others(plain, tmp_path):
    with quick_compilation():
        both = evaluate(asked(tmp_path, "planners=[log,random]"))
    assert list(both.records) == ["whole, log", "whole, random"]
    assert_same_bits(both.records["whole, random"], plain.records["whole, random"])
    text = both.report.read_text()
    assert "| Difference to | random |" in text and "The planner log less each other policy" in text


def test_the_table_has_every_metric_with_its_episodes(plain):
    with (plain.folder / "planners.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["policy"] for row in rows] == PLANNERS
    for row, (label, records) in zip(rows, plain.records.items(), strict=True):
        assert int(row["episodes"]) == len(records["scene"]) == 3
        for name in planner_table.SCORED:
            values = np.asarray(records[name], float)
            assert int(row[f"{name}_episodes"]) == np.isfinite(values).sum()
            if np.isfinite(values).any():
                assert float(row[name]) == pytest.approx(np.nanmean(values), abs=1e-6)
                assert float(row[f"{name}_low"] or row[name]) <= float(row[name]) <= float(row[f"{name}_high"] or row[name])
        assert row["red_light_run"] == "" and row["red_light_run_episodes"] == "0", "streets have no lights"
        assert plain.summary[label]["vmax_score"].count == 3
    table = (plain.folder / "planners.md").read_text()
    assert table.count("absent (n = 0)") == len(PLANNERS) and (plain.folder / "planners.png").stat().st_size > 5000


def test_tables_of_agents_are_parquet_too(plain):
    for label, records in plain.records.items():
        planner = label.partition(", ")[2]
        table = pq.read_table(plain.folder / f"agents-whole-{planner}.parquet")
        assert table.num_rows == 3 and table.column_names == list(records)
        for name, column in records.items():
            absent = np.isnan(column) if column.dtype.kind == "f" else np.zeros(len(column), bool)
            assert table[name].is_null().to_pylist() == absent.tolist(), name
            assert [value for value in table[name].to_pylist() if value is not None] == column[~absent].tolist(), name
        assert table["red_light_run"].null_count == 3
        said = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
        assert (said["protocol"], said["termination"], said["policy"]) == ("vmax", "whole", planner)
        assert re.fullmatch(r"[0-9a-f]{16}", said["config_digest"]) and json.loads(said["versions"])["jax"] == jax.__version__
    digests = {pq.read_schema(file).metadata[b"config_digest"] for file in plain.folder.glob("*.parquet")}
    assert len(digests) == len(PLANNERS)


def test_the_page_marks_where_metrics_fail(plain):
    """What fails has a span within the states that count, what does not has none, what is absent is null."""
    marked = 0
    for label, records in plain.records.items():
        page = (plain.folder / f"replay-{label.replace(', ', '-')}.html").read_text()
        head = json.loads(re.search(r'<script type="application/json" id="head">(.*?)</script>', page, re.DOTALL).group(1))
        assert len(head["worlds"]) == 2 and head["metrics"] == EVENTS | COMPLIANCE
        for row, world in enumerate(head["worlds"]):
            (found,) = world["metrics"].values()
            ((first, last),) = found[scoring.COUNTED]
            assert first == 0 and (last == world["steps"] - 1) == (records["accuracy"][row] == 1)
            for name in head["metrics"]:
                value = records[name][row]
                fails = value > 0 if name in EVENTS else value < 1
                assert (found[name] is None) == np.isnan(value) and bool(found[name]) == fails, (label, row, name)
                assert all(first <= begin <= end and begin <= last for begin, end in found[name] or []), name
                marked += len(found[name] or [])
    assert marked > 2


@pytest.mark.slow  # test_noisy_start has the starts, test_compare the comparison
def test_falls_of_a_noisy_start(plain, tmp_path, capsys):
    """Paired with the evaluation without noise."""
    with quick_compilation():
        noisy = evaluate(asked(tmp_path / "noisy", "planners=[random]", protocol="vmax_noise"))
    assert "Second before the start" in noisy.report.read_text()
    before, after = plain.records["whole, random"], noisy.records["whole, random"]
    assert (before["scene"] == after["scene"]).all() and (before["mean_speed"] != after["mean_speed"]).all()
    found = compare(hydra_config.load_config("compare", f"evaluations=[{plain.folder},{noisy.folder}]", f"out={tmp_path}", "bootstrap=50"))
    text = found["report"].read_text()
    assert text in capsys.readouterr().out and f"| {plain.folder.name} less noisy | whole, random |" in text
    fall = np.mean(before["vmax_score"]) - np.mean(after["vmax_score"])
    assert re.search(rf"\| V-Max score \| {re.escape(f'{fall + 0.0:+.2f}')} \[", text)
    for words, message in {
        f"[{plain.folder}]": r"evaluations: expected two folders and no runs, got 1 and 0 runs",
        f"[{plain.folder},{tmp_path}]": r"evaluations: \S+ holds no records of agents",
    }.items():
        with pytest.raises(ConfigError, match=message):
            compare(hydra_config.load_config("compare", f"evaluations={words}", f"out={tmp_path}"))


@pytest.mark.slow  # the digests hold bits of an evaluation
def test_the_same_seed_gives_the_same_bits(plain, tmp_path):
    with quick_compilation():
        again = evaluate(asked(tmp_path, "planners=[random]")).records["whole, random"]
    assert_same_bits(again, plain.records["whole, random"])


def assert_same_bits(records, expected):
    assert list(records) == list(expected)
    for name, column in expected.items():
        assert np.asarray(records[name]).tobytes() == np.asarray(column).tobytes(), name


@pytest.mark.slow  # the digests hold bits of an evaluation that each machine compiles anew
def test_another_compilation_gives_the_same_bits(plain):
    """Two runs of an evaluation that is compiled anew, not read from a cache."""
    config = asked("nowhere")
    task = hydra_config.load_config("train", *ALONE, *hydra_config.list_overrides(config["protocol"]["settings"]), *SMALL)
    task = hydra_config.apply_overrides(task, config["planner_overrides"]["random"])
    task["termination"] = load_terminations(["whole"])["whole"]
    scenes = scene_source.load_heldout_scenes(task["scenes"], path=None)
    scores = schema.read(config["protocol"]["scores"], ScoreSettings)
    cached = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    scoring.make_program.cache_clear()
    try:
        with quick_compilation():
            run = episode_records.make_episode_runner(task, scenes, settings=config, worlds=0, scores=scores)
            twice = [run({})[0] for _ in range(2)]
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)
    expected = plain.records["whole, random"]
    assert expected["vmax_score"].dtype == np.float32 and len(np.unique(expected["log_divergence_m"])) == 3
    for records in twice:
        assert_same_bits(records, expected)


def test_metrics_below_zero_have_their_place():
    """Stopping margins on ice: an axis that began at 0 had no width."""
    estimate = Estimate(-30.0, -50.0, -10.0, 64, "m", "")
    figure = planner_table.draw_panels(["a", "b"], [{"stopping_margin_m": estimate}, {}], ["stopping_margin_m"])
    low, high = figure.axes[0].get_xlim()
    assert low < -50.0 and 0.0 < high < 50.0 and all(text.get_position()[0] < high for text in figure.axes[0].texts)
    figure.savefig(io.BytesIO())
