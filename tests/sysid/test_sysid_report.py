"""sysid.md from results that were made up."""

import numpy as np
import pytest
import yaml

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import result_file
from scenefactory_jax.visualization.report import sysid_report as report

COMMITTED = configs.find_conf().parent / "experiments" / "sysid"
TARGETS = {"end_share": 0.05, "yaw_rate_nrmse": 0.15, "stop_share": 0.05, "minutes": 15.0}
NAN = float("nan")


def suites(end, yaw, stop):
    """Three held-out manoeuvres of two families, and one of the fit."""
    columns = {"end_share": end, "yaw_rate_nrmse": yaw, "stop_share": stop}
    held = {"name": ["a", "b", "c"], "family": ["circle", "circle", "stop"], **columns}
    return {"heldout": held, "training": {name: column[:1] for name, column in held.items()}}


def trace(frames):
    time = np.arange(frames) / 10.0
    return {"time_s": time, "position": np.stack([time, time**2], 1), "speed": time, "yaw_rate": np.sin(time)}


@pytest.fixture
def result(tmp_path):
    names = ("drive_torque", "friction_dry")
    best = np.array([600.0, 1.4])
    stage = {"name": "longitudinal", "start_loss": 2.0, "loss": 0.5, "evaluations": 40, "seconds": 8.0,
             "history": [[1.0, 1.0, 3.0], [0.5, 0.5, 2.0]]}  # fmt: skip
    refined = {"best": best, "loss": 0.25, "start_loss": 0.5, "evaluations": 9, "deviation": np.array([2.0, NAN]),
               "correlation": np.array([[1.0, -0.3], [-0.3, 1.0]]), "at_bound": np.array([False, True]), "seconds": 4.0}  # fmt: skip
    cars = {
        "fitted": suites([0.01, -0.02, 0.30], [0.1, 0.2, NAN], [NAN, NAN, -0.03]),
        "default": suites([0.1, 0.2, 0.3], [0.4, 0.5, NAN], [NAN, NAN, 0.3]),
    }
    content = {
        "command": "sysid(config)", "versions": {"device": "1 x abacus", "jax": "0", "mujoco": "0"},
        "manoeuvres": {"training": 1, "heldout": 3}, "stages": [stage], "refined": refined, "cars": cars, "seconds": 12.0,
        "space": {"names": names, "low": np.array([300.0, 0.6]), "high": np.array([1400.0, 1.4]), "start": np.array([567.0, 1.0])},
        "slices": {"place": np.tile([0.2, 0.3, 0.4], (2, 1)), "loss": np.array([[0.5, 0.25, 0.5], [0.3, 0.25, NAN]])},
        "samples": {"a": {"teacher": trace(30), "fitted": trace(30), "default": trace(30)}},
    }  # fmt: skip
    result_file.write(tmp_path / "result.json", content, digits=7)
    return result_file.read(tmp_path / "result.json")


def test_verdicts_are_medians_of_magnitudes_and_name_the_bound(result):
    end, yaw, stop, bound, time = report.verdicts(result, TARGETS)
    assert (end.measured, end.met) == ("2 %", True) and (yaw.measured, yaw.met) == ("15 %", False) and "median of 2" in yaw.what
    assert (stop.measured, stop.met) == ("3 %", True) and "median of 1" in stop.what
    assert (bound.measured, bound.met) == ("friction_dry", False) and (time.measured, time.met) == ("0.2 min", True)


def test_the_report_is_written_from_its_results(tmp_path, result):
    text = report.write(tmp_path, result, TARGETS).read_text()
    assert "49 candidates in 0.2 minutes" in text and "| longitudinal | 2 | 0.5 | 40 | 8 | 5 | 5.2937 | 97 |" in text
    assert "| drive_torque | 300 to 1400 | 567 | 600 | 2 | friction_dry -0.30 |  |" in text
    assert "| friction_dry | 0.6 to 1.4 | 1 | 1.4 | nan | drive_torque -0.30 | **yes** |" in text
    assert "| circle | 2 | 1.5 % | 15.0 % | 15.0 % | 45.0 % |  |  |" in text and "| all | 3 | 2.0 % | 20.0 % |" in text
    for name in ("search", "slices", "heldout", "paths"):
        assert f"({name}.png)" in text and (tmp_path / f"{name}.png").stat().st_size > 5_000


@pytest.mark.usefixtures("undrawn_figures")
def test_families_that_miss_a_target_are_named_with_their_medians(tmp_path, result):
    text = report.write(tmp_path, result, TARGETS).read_text()
    misses = next(line for line in text.splitlines() if line.startswith("Families whose own median"))
    assert "circle (yaw rate, NRMSE, 15.0 %), stop (final position / path, 30.0 %)." in misses and "stopping distance, " not in misses
    loose = {name: 9.0 for name in TARGETS}
    assert "No family's own median misses a target." in report.write(tmp_path, result, loose).read_text()


@pytest.mark.usefixtures("undrawn_figures")
def test_the_committed_report_is_made_of_its_results(tmp_path):
    result = result_file.read(COMMITTED / "result.json")
    written = report.write(tmp_path, result, load_config("sysid", "sysid=full")["sysid"]["targets"])
    assert written.read_text() == (COMMITTED / "sysid.md").read_text()
    assert {path.name for path in tmp_path.glob("*.png")} == {path.name for path in COMMITTED.glob("*.png")}


def test_the_shipped_car_is_the_one_that_was_fitted():
    result = result_file.read(COMMITTED / "result.json")
    found = dict(zip(result["space"]["names"], result["refined"]["best"], strict=True))
    written = yaml.safe_load((COMMITTED / "fitted.yaml").read_text())
    car = load_config("sysid")["dynamics"]["car"]
    assert set(written["car"]) == {
        name for name in load_config("sysid", "sysid=full")["sysid"]["space"] if not name.startswith("friction_")
    }
    for name, value in written["car"].items():
        assert car[name] == value == pytest.approx(found[name], rel=1e-4)
