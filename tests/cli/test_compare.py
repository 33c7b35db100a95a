"""`compare`: which runs belong together, what their curves and evaluations are."""

import csv
import json

import numpy as np
import pytest
import yaml

from scenefactory_jax.cli.compare import compare
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.records import COLUMNS, write_records

METRICS = ("events/goal_reached", "reward")


def run(folder, *, seed, dtype="float32", goal_reached=(0.0, 0.2, 0.4, 0.6), agents=None):
    """A run's folder as `train` leaves it, with 100 agent steps an iteration."""
    folder.mkdir(parents=True)
    config = {"name": "mine", "seed": seed, "out": str(folder), "policy": {"dtype": dtype, "trunk": [64, 64]}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["iteration", "minutes", "steps/total", "casps", *METRICS])
        writer.writeheader()
        for i, share in enumerate(goal_reached, start=1):
            row = {"iteration": i, "minutes": 0.5 * i, "steps/total": 100 * i, "casps": 1000.0 + seed}
            writer.writerow(row | {"events/goal_reached": share, "reward": seed})
    if agents is not None:
        write_records(folder / "agents-strict.csv", agents, metadata={})
    return folder


def settings(*runs, **numbers):
    config = load_config("compare", f"runs=[{','.join(map(str, runs))}]")
    return config | {"metrics": list(METRICS), "window": 2, "last": 0.5, "bootstrap": 100} | numbers


def test_seeds_of_one_setting_are_one_group(tmp_path, capsys):
    for seed in (0, 1):
        run(tmp_path / f"plain-{seed}", seed=seed)
    run(tmp_path / "half", seed=0, dtype="bfloat16", goal_reached=(0.5, 0.5))
    result = compare(settings(tmp_path / "plain-*", tmp_path / "half", out=str(tmp_path / "out")))
    assert list(result["groups"]) == ["policy.dtype=float32", "policy.dtype=bfloat16"]
    group = result["groups"]["policy.dtype=float32"]
    assert group["runs"] == ["plain-0", "plain-1"] and group["seeds"] == [0, 1] and group["steps"] == [100, 200, 300, 400]
    np.testing.assert_allclose(group["curves"]["events/goal_reached"][0], [0.0, 0.1, 0.3, 0.5])  # running means of two
    np.testing.assert_allclose(group["last"]["events/goal_reached"], [0.5, 0.5])  # of the last two of four
    assert group["last"]["reward"] == [0.0, 1.0] and group["casps"] == [1000.0, 1001.0] and group["minutes"] == [2.0, 2.0]
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "| policy.dtype=float32 | 2 | 4 | 0.0 M | 2.0 [2.0, 2.0] | 1,000 [1,000, 1,001] | 0.5 [0.5, 0.5] | 0.5 [0, 1] |" in text
    assert "| policy.dtype=bfloat16 | 1 | 2 | 0.0 M | 1.0 | 1,000 | 0.5 | 0 |" in text
    assert json.loads((tmp_path / "out" / "compare.json").read_text()) == json.loads(json.dumps(result))
    assert (tmp_path / "out" / "compare.png").stat().st_size > 10_000 and str(tmp_path / "out" / "compare.md") in capsys.readouterr().out


def test_a_shorter_seed_cuts_its_group(tmp_path):
    runs = [run(tmp_path / "a", seed=0), run(tmp_path / "b", seed=1, goal_reached=(0.1, 0.3, 0.5))]
    [group] = compare(settings(*runs, out=str(tmp_path / "out")))["groups"].values()
    assert group["iterations"] == 3 and [len(curve) for curve in group["curves"]["reward"]] == [3, 3]


def test_evaluations_of_all_seeds_are_pooled(tmp_path, records):
    first, second = records(goal_reached=3, missed=1), records(goal_reached=1, missed=3)
    runs = [run(tmp_path / "a", seed=0, agents=first), run(tmp_path / "b", seed=1, agents=second)]
    [group] = compare(settings(*runs, out=str(tmp_path / "out")))["groups"].values()
    found = group["evaluated"]["strict"]["success_rate"]
    assert (found["value"], found["count"], found["method"]) == (0.5, 8, statistics.LEVELS)
    by_seed = statistics.summarise_runs({0: first, 1: second}, bootstrap=100, seed=0)["success_rate"]
    assert (found["low"], found["high"]) == pytest.approx((by_seed.low, by_seed.high), rel=1e-5)
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "## Evaluation at the end, strict" in text and "| Success rate | 50.0 %" in text


@pytest.fixture
def records():
    """Agents of an evaluation: some reached their goal, some ran out of time."""

    def made(*, goal_reached, missed):
        count = goal_reached + missed
        good = np.arange(count) < goal_reached
        columns = {name: np.zeros(count, dtype) for name, dtype in COLUMNS.items()}
        columns |= {"scene": np.array([f"s{i % 2}" for i in range(count)]), "agent": np.arange(count), "goal_reached": good, "clean": good}
        return columns

    return made


def test_what_cannot_be_compared_is_named(tmp_path):
    one = run(tmp_path / "a", seed=0)
    with pytest.raises(ConfigError, match=r"nothing matches '.*none-\*'"):
        compare(settings(tmp_path / "none-*"))
    with pytest.raises(ConfigError, match=r"config\.yaml not found in"):
        compare(settings(tmp_path))
    with pytest.raises(ConfigError, match=r"metrics\.csv has no column 'speed'; there are: iteration, minutes"):
        compare(settings(one, metrics=["speed"]))
    with pytest.raises(ConfigError, match="metrics: none; give columns"):
        compare(settings(one, metrics=[]))
    with pytest.raises(ConfigError, match=r"names \S+/a once more; every run counts once"):
        compare(settings(one, tmp_path / "b" / ".." / "a"))
    with pytest.raises(ConfigError, match=r"/a and \S+/copy have one setting and one seed, 0"):
        compare(settings(one, run(tmp_path / "copy", seed=0)))
    (one / "metrics.csv").write_text("iteration\n")
    with pytest.raises(ConfigError, match=r"metrics\.csv: no row"):
        compare(settings(one))
