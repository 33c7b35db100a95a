"""Tables of the long trainings: events a year, time to notice ice, targets and cross-play, from numbers whose results are known."""


import argparse

import numpy as np
import pytest
from support.agent_records import records

from experiments.drive import evaluations, events, failures, ice_onset, table
from experiments.drive.evaluations import Asked
from experiments.population import cross_play
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import result_file
from scenefactory_jax.evaluation import protocols
from scenefactory_jax.evaluation.metrics import score_metrics
from scenefactory_jax.evaluation.metrics.agent_metrics import METRICS
from scenefactory_jax.learning import run_paths
from scenefactory_jax.learning.training_loop import YEAR_S, count_years
from scenefactory_jax.loggers import metrics_csv

# ---- events


def test_years_are_seconds_of_active_agents():
    row = {"steps/active": 30 * YEAR_S / 4, "seconds": 1800.0}
    assert count_years(row, 2.0, control_hz=30) == {"years": 2.25, "years_per_hour": 0.5}
    assert count_years({"seconds": 1.0}, 0.0, control_hz=30) == {"years": 0.0, "years_per_hour": 0.0}  # a learner that does not drive


def test_rates_have_the_intervals_of_poisson_counts_and_of_runs():
    """Garwood's interval of 0 and 10 events; of four runs that of the mean logarithm."""
    assert events.estimate_rate(np.array([0.0]), np.array([2.0])) == pytest.approx((0.0, 0.0, 3.689 / 2), abs=1e-3)
    assert events.estimate_rate(np.array([10.0]), np.array([1.0])) == pytest.approx((10.0, 4.795, 18.39), abs=1e-2)
    rate, low, high = events.estimate_rate(np.array([99.5, 199.5, 99.5, 199.5]), np.ones(4))
    half = 3.182 * np.std(np.log([100, 200, 100, 200]), ddof=1) / 2
    assert (rate, low, high) == pytest.approx((149.5, np.sqrt(2e4) * np.exp(-half), np.sqrt(2e4) * np.exp(half)), rel=1e-3)


def written_run(folder, collisions, *, steps=YEAR_S / 10):
    """A run of 30 Hz whose iterations take an hour and drive a 300th of a year each."""
    file = metrics_csv.MetricsFile(folder)
    for count in collisions:
        file.add({"steps/active": steps, "seconds": 3600.0, "count/collision": count, "count/red_light": 1.0, "count/stop_sign": 2.0})
    run_config.write(folder, {"timing": {"control_hz": 30}})
    return str(folder)


def test_events_of_runs_against_years(tmp_path, monkeypatch, undrawn_figures):
    """Collisions halve in the second part of both runs; the table has the last part."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    folders = [written_run(tmp_path / name, [8.0] * 6 + [4.0] * 6) for name in ("a", "b")]
    monkeypatch.setattr("sys.argv", ["events", "--runs", f"ours={','.join(folders)}", "--bins", "4", "--out", str(tmp_path / "out")])
    events.main()
    curve = result_file.read(tmp_path / "out" / "events.json")["curves"]["ours"]
    np.testing.assert_allclose(curve["collision"]["rate"], [2400.0, 2400.0, 1200.0, 1200.0], rtol=1e-4)
    np.testing.assert_allclose(curve["red light or stop sign"]["rate"], 900.0, rtol=1e-4)
    np.testing.assert_allclose(curve["collision"]["years"], [0.01, 0.02, 0.03, 0.04], rtol=1e-4)
    text = (tmp_path / "out" / "events.md").read_text()
    assert "| ours | 0.04 | 0.00333 | 1,200 [" in text and "Years are those of active agents" in text
    joined = events.read_run([tmp_path / name for name in ("a", "b")])
    np.testing.assert_allclose(joined["years"].sum(), 0.08, rtol=1e-4)
    np.testing.assert_array_equal(joined["collision"], np.tile([8.0] * 6 + [4.0] * 6, 2))


# ---- ice


def test_time_to_notice_counts_from_the_first_wheel_on_the_strip():
    """Two worlds of two agents at 10 Hz, ice from step 5 on: noticed 3 steps after, 2 before, never; the last one is never on it."""
    active, steps = np.ones((2, 12, 2), bool), np.arange(12)
    mu, pedal = np.ones((2, 12, 2)), np.full((2, 12, 2), 0.4)
    dry = ice_onset.Drive(active, pedal, mu)
    slippery, other = mu.copy(), pedal.copy()
    slippery[0, 5:], slippery[1, 5:, 0] = 0.8, 0.3
    other[0, 8:, 0], other[0, 3:, 1], other[1, 6:, 0] = 0.2, 0.55, 0.35
    other[1, :, 1] = np.where(steps > 2, -1.0, 0.4)
    found = ice_onset.measure_notice(ice_onset.Drive(active, other, slippery), dry, change=0.1, control_hz=10.0)
    assert found["world"].tolist() == [0, 0, 1]
    np.testing.assert_allclose(found["notice_s"], [0.3, -0.2, np.nan])
    row = ice_onset.summarise([found, found], bootstrap=200, seed=0)
    assert (row["agents"], row["runs"]) == (6, 2) and row["noticed"]["value"] == pytest.approx(2 / 3)
    assert row["median_s"]["value"] == pytest.approx(0.05) and row["noticed"]["low"] == 0.0 and row["noticed"]["high"] == 1.0


def test_drives_end_where_one_of_the_two_ends():
    """An agent that has ended on the dry road before the other is on the ice does not count."""
    mu, pedal, active = np.ones((1, 6, 1)), np.zeros((1, 6, 1)), np.ones((1, 6, 1), bool)
    ended, slippery = active.copy(), mu.copy()
    ended[0, 3:], slippery[0, 4:] = False, 0.2
    ice, dry = ice_onset.Drive(active, pedal, slippery), ice_onset.Drive(ended, pedal, mu)
    found = ice_onset.measure_notice(ice, dry, change=0.1, control_hz=10.0)
    assert len(found["world"]) == 0


def test_the_two_roads_differ_in_the_strip_alone():
    asked = Asked(("drive",), None, ("protocol=ice_onset", "protocol.mu=0.3"), (), None)
    ice, dry = (evaluations.compose(asked._replace(overrides=road))[0] for road in (ice_onset.ICE, ice_onset.DRY))
    assert (ice["weather"]["patches"]["routes"].pop("surface"), dry["weather"]["patches"]["routes"].pop("surface")) == ("ICE", "AC")
    assert ice == dry and ice["scenes"]["pack"]["starts"]["mu"] == ice["weather"]["friction"]["surfaces"]["ICE"]["mu"] == 0.3


# ---- targets


@pytest.mark.parametrize("name", list(table.ROWS))
def test_every_row_asks_for_episodes_that_there_are(name):
    row = table.ROWS[name]
    config, found = evaluations.compose(Asked(("drive",), None, row.protocol, row.overrides, None))
    assert bool(found["protocol"].get("scores")) == any(number.metric in score_metrics.METRICS for number in row.numbers)
    assert config["traffic"]["_target_"] == ("log_traffic" if name == "among" else config["traffic"]["_target_"])
    assert {number.metric for number in row.numbers} <= set(METRICS)
    planned, _ = evaluations.compose(Asked((), "idm_route", row.protocol, (*row.overrides, *row.of_planners, *table.TOWNS), None))
    assert planned["scenes"]["pack"]["routes"], "a planner without a route does not move"
    assert planned["policy"]["_target_"].endswith("idm_route.make") and planned["scenes"]["heldout"]["count"] == 64


def test_runs_and_planners_are_judged_in_the_same_towns():
    """A recipe may train in others: `generalist_finetune` has more motorways, in which fewer starts have room."""
    given = argparse.Namespace(overrides=[])
    run, planner = (table.ask(table.ROWS["route100"], *who, "null", given) for who in ((("drive",), None), ((), "idm_route")))
    generators = [evaluations.compose(asked)[0]["scenes"]["generate"] for asked in (run, planner)]
    assert generators[0] == generators[1]
    assert hydra_config.read(run_paths.find("drive"))["scenes"]["generate"] != generators[0]


def test_failures_are_counted_by_kind():
    kinds = np.array(["none", "struck", "at_fault", "stuck"])
    events_of = np.array(["none", "collision", "collision", "none"])
    run = {"failure": kinds, "first_event": events_of, "event_mps": np.array([0.0, 0.1, 3.0, 0.0])}
    found = failures.count_kinds({0: run, 1: run})
    assert found["agents"] == "8" and found["collision, struck"] == found["stuck"] == "25.0 %" and "road edge" not in found
    assert found["of collisions: slower than 0.5 m/s"] == "50 %"


def test_the_table_has_what_was_measured_once(tmp_path, monkeypatch):
    """Two runs and a planner: rates, events of any kind, u = 0.8 alone; again nothing is evaluated, and other rows keep these."""
    calls = []

    def make_evaluator(config, scenes, **settings):
        calls.append(config["policy"]["_target_"])
        clean = np.arange(20).reshape(10, 2) < 15
        columns = {"collision": np.arange(20) == 19, "road_edge_contact": np.arange(20) == 18, "has_route": np.ones(20, bool)}
        columns |= {"friction_use": np.tile([0.6, 0.8], 10), "clean_completion": np.tile([False, True], 10)}
        columns |= {"route_completion": np.ones(20)}
        return lambda parameters: records(clean, **columns)

    monkeypatch.setattr(protocols, "make_evaluator", make_evaluator)
    monkeypatch.setattr(evaluations.scene_source, "load_heldout_scenes", lambda *_, **__: None)
    words = ["--runs", "ours=drive,town", "--scenes", "towns=null", "--planners", "log", "--rows", "strict", "grip_0.3"]
    monkeypatch.setattr("sys.argv", ["table", *words, "--bootstrap", "50", "--kept", str(tmp_path / "kept"), "--out", str(tmp_path)])
    table.main()
    assert len(calls) == 3  # no recorded drivers on the drawn routes of the suite grip
    found = result_file.read(tmp_path / "table.json")["sets"]["towns"]
    assert found["ours"]["`strict`: goal without any event"]["value"] == 0.75
    assert found["ours"]["of agents whose recorded driver does so"]["value"] == 1.0
    assert found["log"]["events in all (collision, edge, tip-over)"]["value"] == 0.1
    assert found["ours"]["`grip`: clean at u = 0.8, mu 0.3"]["value"] == 1.0
    text = (tmp_path / "table.md").read_text()
    assert "| aim | log | ours (2 runs) |" in text and "| `grip`: clean at u = 0.8, mu 0.3 | >= 80 % |  | 100.0 %" in text
    table.main()
    assert len(calls) == 3
    arguments = ["table", "--scenes", "towns=null", "--planners", "idm_route", "--rows", "paper", "--bootstrap", "50"]
    monkeypatch.setattr("sys.argv", [*arguments, "--kept", str(tmp_path / "kept"), "--out", str(tmp_path)])
    table.main()
    assert len(calls) == 4
    assert result_file.read(tmp_path / "table.json")["sets"]["towns"]["ours"] == found["ours"]
    assert "| aim | log | idm_route | ours (2 runs) |" in (tmp_path / "table.md").read_text()


# ---- cross-play


def test_each_run_meets_its_own_traffic():
    own = cross_play.find_traffic("itself", "drive", ["drive", "town"], None)
    others = cross_play.find_traffic(cross_play.SEEDS, "drive", ["drive", "town"], None)
    assert own is not None and own[1].endswith("pretrained/drive") and others is not None and others[1].endswith("pretrained/town]")
    assert cross_play.find_traffic(cross_play.SEEDS, "drive", ["drive"], None) is None
    assert cross_play.find_traffic(cross_play.CONDITIONED, "drive", ["drive"], None) is None
    for background in cross_play.BACKGROUNDS:
        words = cross_play.find_traffic(background, "drive", ["drive", "town"], "town")
        assert words is not None
        evaluations.compose(Asked(("drive",), None, ("protocol=recorded_routes",), (*cross_play.FEW, *words), None))


def test_a_loss_is_what_the_reference_has_more(tmp_path, monkeypatch):
    """15 of 20 clean as recorded, 10 among IDM: a loss of 25 points; kinds without runs have no column."""

    def evaluate(asked, kept):
        clean = np.arange(20).reshape(10, 2) % 4 < (2 if "traffic=idm" in asked.overrides else 3)
        return dict.fromkeys(range(len(asked.runs)), records(clean))

    monkeypatch.setattr(evaluations, "evaluate", evaluate)
    words = ["--egos", "ours=drive,town", "--backgrounds", "idm", "conditioned", "--name", "made", "--bootstrap", "50"]
    monkeypatch.setattr("sys.argv", ["cross_play", *words, "--out", str(tmp_path)])
    cross_play.main()
    row = result_file.read(tmp_path / "cross_play-made.json")["rows"]["ours"]
    assert list(row["values"]) == ["played_back", "idm"] and row["losses"]["idm"]["value"] == pytest.approx(0.25)
    text = (tmp_path / "cross_play-made.md").read_text()
    assert "Largest loss of `ours`: 25.0 [" in text and "| ours | clean | 75.0 [" in text


def test_runs_are_named():
    assert evaluations.parse_runs(["ours=a,b", "other=c"]) == {"ours": ["a", "b"], "other": ["c"]}
    with pytest.raises(SystemExit, match=r"expected NAME=FOLDER,FOLDER\.\.\., got 'runs/a'"):
        evaluations.parse_runs(["runs/a"])
