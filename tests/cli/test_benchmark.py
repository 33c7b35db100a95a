"""`benchmark`: scopes, phases that add up, variants, suites."""

import re
from pathlib import Path

import jax
import pytest
from support.running import quick_compilation

from scenefactory_jax.cli import benchmark as command
from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.cli import schema
from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import result_file
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.schema import read
from scenefactory_jax.data.loading.stream import StreamConfig
from scenefactory_jax.learning import phase_timing
from scenefactory_jax.visualization.report import throughput_report as report

pytestmark = pytest.mark.ci

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("experiment=smoke", "dynamics=bicycle", "worlds=4", "warmup=0", "repeats=1")
SMALL += ("~observations.road", "~observations.neighbours")  # less to compile
VARIANTS = {scope: {"scope": scope, "phases": False} for scope in ("training", "environment", "physics")}
VARIANTS["physics"]["worlds"] = 2
ROW = {
    "scope": "training", "worlds": 4, "slots": 4, "devices": 1, "horizon": 8, "step_s": 0.1, "ms_a_control_step": 1.0, "per_s": 17.532e6,
    "per_s_range": [1.0, 3.0], "slots_per_s": 2.0, "spawned_share": 0.5, "active_share": 0.5, "phases_ms": {}, "memory_gib": 2.0,
    "compile_s": 2.0, "repeats": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Every scope once."""
    folder = tmp_path_factory.mktemp("benchmark")
    with quick_compilation():
        return folder, command.benchmark({**load_config("benchmark", *SMALL, f"out={folder}"), "variants": VARIANTS})


def test_every_scope_is_measured(made):
    rows = {row["name"]: row for row in made[1]["rows"]}
    assert list(rows) == list(VARIANTS) and [(row["worlds"], row["slots"]) for row in rows.values()] == [(4, 4), (4, 4), (2, 4)]
    for row in rows.values():
        low, high = row["per_s_range"]
        assert 0 < low <= row["per_s"] <= high and row["compile_s"] > 0 and row["memory_gib"] > 0
        assert row["per_s"] == pytest.approx(row["slots_per_s"] * row["spawned_share"], rel=1e-4) and 0 < row["spawned_share"] <= 1
        assert row["ms_a_control_step"] == pytest.approx(1e3 * row["worlds"] * row["slots"] / row["slots_per_s"], rel=1e-4)
    assert rows["training"]["active_share"] > 0.5 and rows["physics"]["active_share"] is None


@pytest.mark.slow  # each phase is a program
def test_phases_add_up_to_the_whole(made, tmp_path):
    assert not any(row["phases_ms"] for row in made[1]["rows"])
    with quick_compilation():
        result = command.benchmark({**load_config("benchmark", *SMALL, f"out={tmp_path}"), "variants": {"training": {}}})
    (row,) = result["rows"]
    assert list(row["phases_ms"]) == [*phase_timing.ACTING, "policy", "update"]
    parts = list(row["phases_ms"].values())  # written with six digits each; on a busy machine a part may be below zero
    assert sum(parts) == pytest.approx(row["ms_a_control_step"], abs=1e-5 * sum(map(abs, parts)))
    assert "## training: where the time goes" in (tmp_path / "throughput.md").read_text()
    assert phase_timing.time_phases({"a": 1.0, "b": 3.0, "c": 2.5}) == {"a": 1.0, "b": 2.0, "c": -0.5}


def test_the_report_is_made_of_the_json(made, tmp_path):
    folder, result = made
    read = result_file.read(folder / "bench.json")
    assert report.write(tmp_path, read).read_text() == (folder / "throughput.md").read_text()
    text = (folder / "throughput.md").read_text()
    assert f"| physics | physics | 2 x 4 | 1 | 8 | {result['rows'][2]['per_s']:,.0f} (" in text


def test_a_stopped_bench_goes_on(made, monkeypatch, capsys):
    folder, before = made
    config = {**load_config("benchmark", *SMALL, f"out={folder}", "resume=true"), "variants": VARIANTS | {"new": {"seed": 1}}}
    asked, measured = [], {key: before["rows"][0][key] for key in before["rows"][0] if key not in ("name", "changes", "settings")}
    monkeypatch.setattr(command, "measure", lambda task, worlds, mesh: asked.append(task["seed"]) or measured | {"per_s": 7.0})
    after = command.benchmark(config)
    assert asked == [1] and after["rows"][:3] == before["rows"] and after["rows"][3]["per_s"] == 7.0
    assert result_file.read(folder / "bench.json")["rows"][3]["name"] == "new"
    result_file.write(folder / "bench.json", before, digits=None)  # for whoever comes next
    report.write(folder, before)


def test_the_whole_configuration_comes_first():
    """The loops in Python are compared with the first row."""
    config = load_config("benchmark", "experiment=paper", "suite=throughput")
    name, changes = next(iter(config["variants"].items()))
    assert (name, changes) == ("256 x 16", {"phases": True})
    full = config["variants"]["bicycle environment 4096 x 16, no empty slots"]
    assert full["dynamics"]["_target_"].endswith("bicycle.make") and full["spawning"]["sampler"]["_target_"] == "random_pairs"
    (first, memory), *streams = load_config("benchmark", "suite=streaming")["variants"].items()
    assert first == "in memory" and memory["stream"] is None
    swapped = {name: read(changes["stream"], StreamConfig).swap_fraction for name, changes in streams}
    assert swapped["fixed sizes"] == 0.0 and swapped["shuffled 1 of 4"] == 0.25


def test_there_must_be_something_to_resume(tmp_path):
    for out in ("null", str(tmp_path)):
        with pytest.raises(ConfigError, match=r"resume=true: out=.*no bench\.json to go on with"):
            command.benchmark(load_config("benchmark", *SMALL, f"out={out}", "resume=true"))


def test_the_readme_shows_what_was_measured():
    result = result_file.read(ROOT / "experiments" / "throughput" / "bench.json")
    text = (ROOT / "README.md").read_text()
    assert report.compare_with_published(result).count("\n") >= 2 and report.compare_with_published(result) in text
    shares, said = re.findall(r"[\d,]+ steps/s|[\d.]+ times", report.split_ratios(result)), " ".join(text.split())
    assert len(shares) == 3 and all(share in said for share in shares)
    devices = report.compare_devices(result_file.read(ROOT / "experiments" / "devices" / "bench.json"))
    assert f"{devices.splitlines()[-1].split(' | ')[-2]} times the slots" in said


def test_only_the_whole_configuration_stands_beside_published_figures():
    row = {"worlds": 256, "slots": 16, "scope": "training", "devices": 1, "changes": {}, "per_s": 38500.0, "fits": True}
    row["per_s_range"] = [38400.0, 38600.0]
    others = [{"changes": {"policy": {"dtype": "bfloat16"}}}, {"scope": "environment"}, {"devices": 2}, {"worlds": 255}]
    one = {**row, "worlds": 4096, "slots": 1, "changes": {"worlds": 4096, "scenes": {"pack": {"agents": 1}}, "phases": False}}
    table = report.compare_with_published({"rows": [row, *({**row, **other} for other in others), one], "versions": {"device": "a GPU"}})
    assert table.splitlines()[2:] == [
        "| 256 x 16 | 38,500 (38,400 to 38,600) | 19,250 | 2.0 |",
        "| 4,096 x 1 | 38,500 (38,400 to 38,600) | 41,742 | 0.9 |",
    ]
    assert report.compare_with_published({"rows": [{**row, **others[0]}], "versions": {"device": "a GPU"}}) == ""


def test_the_ratio_is_split_into_plain_jax_and_kernels():
    row = {"worlds": 256, "slots": 16, "scope": "training", "devices": 1, "horizon": 8, "fits": True}
    row |= {"changes": {"phases": True}, "per_s": 77000.0}
    plain = {**row, "changes": {"policy": {"kernels": False}, "step_metrics": {"kernels": False}}, "per_s": 38500.0}
    assert report.split_ratios({"rows": [row, plain]}) == (
        "At 256 x 16 plain JAX alone makes 38,500 steps/s, 2.0 times the published figure; the kernels make that 2.0 times faster."
    )
    for other in ({"changes": {"phases": False}}, {"worlds": 255}, {"changes": {"step_metrics": {"kernels": False}, "seed": 0}}):
        assert report.split_ratios({"rows": [row, {**plain, **other}]}) == ""


def test_devices_are_compared_by_slots_with_one_that_has_as_many_worlds():
    """Steps count spawned slots, whose share differs between worlds."""
    one = {"name": "one", "devices": 1, "worlds": 8, "scope": "training", "fits": True, "slots_per_s": 100.0, "per_s": 40.0}
    large = {**one, "name": "large", "worlds": 16, "slots_per_s": 120.0}
    two = {**one, "name": "two", "devices": 2, "worlds": 16, "slots_per_s": 194.0, "per_s": 100.0}
    four = {**two, "name": "four", "devices": 4, "worlds": 64, "slots_per_s": 420.0}
    assert report.compare_devices({"rows": [one, large, two, four]}).splitlines()[2:] == [
        "| two | 2 | 194 | one | 1.94 | 97 % |",
        "| four | 4 | 420 | large | 3.50 | 88 % |",
    ]
    assert report.compare_devices({"rows": [one]}) == report.compare_devices({"rows": [two]}) == ""


def test_rows_for_more_devices_than_there_are_are_left_out(monkeypatch, capsys):
    monkeypatch.setattr(command, "measure", lambda task, worlds, mesh: ROW)
    config = load_config("benchmark", *SMALL)
    result = command.benchmark({**config, "variants": {"one": {"devices": 1}, "more": {"devices": 999}}})
    printed = capsys.readouterr().out
    assert [row["name"] for row in result["rows"]] == ["one"] and "more: left out; 999 devices, there are" in printed
    assert "| 100 | 50 %" in printed  # years of driving in an hour
    with pytest.raises(ConfigError, match="devices: 999"):
        command.benchmark({**config, "devices": 999})


@pytest.mark.parametrize("stream", [None, "shuffled"])
def test_products_have_the_precision_that_is_asked_for(stream, monkeypatch):
    asked, full = [], {**ROW, "stream": None}
    measure = lambda *_, mesh: asked.append(jax.config.jax_default_matmul_precision) or full  # noqa: E731
    monkeypatch.setattr(command, "measure", measure)
    config = load_config("benchmark", *SMALL, *([f"stream={stream}"] if stream else []))
    for precision in (None, "highest"):
        command.benchmark({**config, "matmul_precision": precision}, measure_stream=measure)
    assert asked == [None, "highest"] and jax.config.jax_default_matmul_precision is None


def test_what_does_not_fit_is_a_row(monkeypatch, tmp_path, capsys):
    def measure(task, worlds, mesh):
        if task["worlds"] == 4:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate")
        if task["worlds"] == 3:
            raise jax.errors.JaxRuntimeError("INTERNAL: something else")
        numbers = dict.fromkeys(("per_s", "slots_per_s", "memory_gib", "compile_s"), 2.0) | {"spawned_share": 0.5, "active_share": None}
        size = {"scope": "training", "worlds": task["worlds"], "slots": 4, "devices": 1, "horizon": 8}
        return size | numbers | {"per_s_range": [1.0, 3.0], "ms_a_control_step": task["worlds"] / 2, "phases_ms": {}, "repeats": 1}

    monkeypatch.setattr(command, "measure", measure)
    config = {**load_config("benchmark", *SMALL, f"out={tmp_path}"), "variants": {str(n): {"worlds": n} for n in (1, 2, 5, 4)}}
    rows = command.benchmark(config)["rows"]
    assert [row["fits"] for row in rows] == [True, True, True, False] and rows[3]["slots"] == 4
    text = (tmp_path / "throughput.md").read_text()
    assert "| 4 | training | 4 x 4 | 1 | 8 | does not fit into the device's memory |" in text
    assert "| 5 x 4 | 2.50 | 500.0 | 2.0 | 409.6 |" in text and "4 x 4 (training) does not fit" in text
    assert (tmp_path / "scaling.png").stat().st_size > 5_000 and "4: does not fit" in capsys.readouterr().out
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        command.benchmark({**config, "out": None, "variants": {"3": {"worlds": 3}}})


def test_variants_change_values_and_replace_entries():
    config = load_config("benchmark", "experiment=smoke")
    changes = {"ppo": {"horizon": 5}, "dynamics": {"_target_": "mine", "mass": 1.0}, "worlds": 3}
    found = command.change(config, changes, where="variants.mine")
    assert found["ppo"] == {**config["ppo"], "horizon": 5} and found["worlds"] == 3
    assert found["dynamics"] == {"_target_": "mine", "mass": 1.0}
    assert config["worlds"] == 4 and config["ppo"]["horizon"] == 8  # the config itself stays
    with pytest.raises(ConfigError, match=r"variants\.mine\.ppo\.horizont: unknown; valid: horizon, "):
        command.change(config, {"ppo": {"horizont": 5}}, where="variants.mine")
    with pytest.raises(ConfigError, match=r"scope: expected one of training, environment, physics, got 'driving'"):
        command.benchmark({**config, "variants": {"mine": {"scope": "driving"}}})


@pytest.mark.parametrize("suite", sorted(path.stem for path in (configs.find_conf() / "suite").glob("*.yaml")))
def test_every_variant_of_a_suite_is_a_config(suite):
    experiment = "drive" if suite == "driving" else "paper"
    config = load_config("benchmark", f"experiment={experiment}", f"suite={suite}")
    for name, changes in config["variants"].items():
        schema.check(command.change(config, changes, where=name), schema.Benchmark)


def test_the_loop_stands_beside_the_first_configuration():
    phases_ms = {"policy": 1.25, "physics": 2.0, "whole": 3.25}
    loop = {"agent_steps_per_s": 500.0, "agent_steps_per_s_range": [490.0, 510.0], "phase_ms_a_control_step": phases_ms, "cars": 16.0,
            "steps": 60, "repeats": 3}  # fmt: skip
    text = report.compare_with_baseline({"baseline": loop, "rows": [{"name": "256 x 16", "scope": "training", "per_s": 250_000.0}]})
    assert "500 agent steps/s (490 to 510, 3 repeats of 60 steps, 16 cars a world)" in text and "policy 1.2, physics 2.0." in text
    assert text.endswith("`256 x 16` (training) makes 500 times as many.")
