"""The command line around Hydra: its flags reach it, `--help` keeps the comments of conf/, a sweep's folders say what differs."""

import re
import subprocess
import sys

import pytest
import yaml
from rich.console import Console
from support.running import ROOT

from scenefactory_jax import __main__ as command_line
from scenefactory_jax.__main__ import COMMANDS
from scenefactory_jax.cli import annotated_config, hydra_config
from scenefactory_jax.learning import run_folder
from scenefactory_jax.loggers import metrics_csv


@pytest.fixture
def called(monkeypatch):
    """Calls the command line up to Hydra; what Hydra reads of `sys.argv`, or None where it is not reached."""

    def call(*words):
        found = []
        monkeypatch.setattr(sys, "argv", ["scenefactory_jax", *words])
        monkeypatch.setattr("hydra.main", lambda **_: lambda job: lambda: found.append(sys.argv[1:]))
        command_line.main()
        return found[0] if found else None

    return call


@pytest.mark.parametrize("words", [
    ["-sc", "install=bash"], ["--shell-completion", "query=fish"], ["--hydra-help"], ["--info", "searchpath"], ["-i"],
    ["--cfg", "job", "-p", "timing"], ["--cfg", "job", "--resolve"], ["--config-dir", str(ROOT / "conf"), "seed=1"],
    ["--multirun", "seed=1,2"], ["hydra.verbose=true", "seed=1"],
])  # fmt: skip
def test_flags_of_hydra_reach_it(called, words):
    assert called("train", *words) == words


def test_a_config_needs_nothing_to_be_shown(called):
    assert called("evaluate", "--cfg", "job") == ["--cfg", "job"]


def test_options_of_a_folder_of_ones_own_are_found(called, tmp_path):
    (tmp_path / "weather").mkdir()
    (tmp_path / "weather" / "mine.yaml").write_text("defaults: [dry]\n")
    assert called("train", "--config-dir", str(tmp_path), "weather=mine")


def test_a_reader_that_closes_its_end_stops_the_command_silently():
    call = f"{sys.executable} -m scenefactory_jax train --help | head -1"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {call}"], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.startswith("train: Train a policy") and not done.stderr and done.returncode in (0, 141)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_a_command_is_for(called, capsys, command):
    assert called(command, "--help") is None
    assert re.match(rf"{command}: [A-Z].+\. \S+=", capsys.readouterr().out)


def test_help_is_the_config_with_its_comments():
    text = annotated_config.annotate("train", "weather=ice", "worlds=7")
    assert yaml.safe_load(text) == hydra_config.load_config("train", "weather=ice", "worlds=7")
    told = {"devices: null # that share the worlds; null: all there are", "worlds: 7", "# weather=ice; or "}
    assert all(any(line.startswith(one) for line in text.splitlines()) for one in told)
    assert max(map(len, text.splitlines())) <= annotated_config.WIDTH
    assert "run: null # folder that `train` or `export` wrote" in annotated_config.annotate("evaluate")


def test_an_empty_mapping_empties_what_is_removed_first():
    assert hydra_config.load_config("task", "~reward", "+reward={}")["reward"] == {}
    assert hydra_config.load_config("task", "reward.idle=null")["reward"]["idle"] is None


def test_the_folder_of_a_sweeps_run_says_what_differs():
    name = run_folder.make_folder_name("wet", ["weather=dry", "ppo.gamma=0.97", "scenes.path=/a b/c", "+dynamics/randomization=sizes"]).name
    assert re.fullmatch(r"wet-weather_dry-gamma_0\.97-path_a_b_c-dynamics_randomization_sizes-\d{8}-\d{6}", name)
    long = [run_folder.make_folder_name("a", [f"scenes.path={'x' * 200}{end}"]).name for end in "12"]
    assert len(set(long)) == 2 and max(map(len, long)) <= len("a--20261125-010203") + run_folder.MAX_LETTERS
    assert re.fullmatch(r"a-\d{8}-\d{6}", run_folder.make_folder_name("a").name)


def test_the_bar_is_readable_in_80_columns():
    console = Console(width=80, force_terminal=True, record=True)
    text = "goal 100% collision 100% edge 100% crash 100% | 1,331,000 steps/s"
    with metrics_csv.progress(10_000, enable=True, console=console) as show:
        show(9_999, text)
    *_, bar, below = [line.rstrip() for line in console.export_text().splitlines() if line.strip()]
    assert below == text and re.search(r" 9999/10000 \d:\d\d:\d\d left \S+$", bar)
