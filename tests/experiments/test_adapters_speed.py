"""Each adapter beside the package's own functions, at the smallest size: rows, rates and the report."""

import importlib.util
import json

import pytest
from support.running import quick_compilation

from experiments.benchmarks.adapters import adapters
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core.instantiate import ConfigError


@pytest.mark.slow
def test_every_adapter_that_is_installed_is_measured_beside_the_packages_own(tmp_path, capsys):
    lean = ["experiment=smoke", "scenes.pack.agents=1", "~observations.road", "~observations.neighbours"]  # less to compile
    with quick_compilation():
        sizes = ("worlds=3", "ppo.horizon=2", "repeats=2", "warmup=0")
        rows = adapters(hydra_config.load_config("benchmark", *lean, *sizes, f"out={tmp_path}"))
    wanted = {("own", 3, 1), ("own", 1, 1), ("Brax", 3, 1)}
    if importlib.util.find_spec("gymnasium"):
        wanted |= {("Gymnasium", 1, 1), ("Gymnasium, vector, numpy", 3, 1), ("Gymnasium, vector, jax", 3, 1)}
    if importlib.util.find_spec("pettingzoo"):
        wanted |= {("PettingZoo", 1, 1)}
    if importlib.util.find_spec("jaxmarl"):
        wanted |= {("JaxMARL", 3, 1)}
    assert {(row["name"], row["worlds"], row["slots"]) for row in rows} == wanted
    for row in rows:
        low, high = row["per_s_range"]
        assert 0 < low <= row["per_s"] <= high
        [own] = [one for one in rows if one["name"] == "own" and all(one[key] == row[key] for key in ("worlds", "slots", "way"))]
        assert row["share"] == pytest.approx(row["per_s"] / own["per_s"])
    kept = json.loads((tmp_path / "adapters.json").read_text())["rows"]
    assert [row["name"] for row in kept] == [row["name"] for row in rows]
    assert f"| Brax | 3 x 1 | scanned | {rows[[row['name'] for row in rows].index('Brax')]['per_s']:,.0f} (" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="repeats: expected an integer >= 1, got 0"):
        adapters(hydra_config.load_config("benchmark", *lean, "repeats=0"))
