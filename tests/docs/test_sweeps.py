"""The sweeps of docs/sweeps.md, at toy size."""

import contextlib
import re

import pytest
from support.running import QUICKLY, ROOT, shell

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.learning import run_folder
from scenefactory_jax.loggers import metrics_csv

PAGE = (ROOT / "docs" / "sweeps.md").read_text()
TOY = ["experiment=smoke", "evaluation.enable=false", "progress=false", "iterations=1"]
SMALLER = {'"experiment=demo", "minutes=2"': ", ".join(f'"{one}"' for one in TOY), "n_trials=20": "n_trials=2"}

pytestmark = pytest.mark.usefixtures("quickly")


def sweep(folder, *arguments):
    """The command line in a folder; the runs that it leaves."""
    done = shell(folder, "train", "-m", *arguments, *TOY, **QUICKLY)
    assert done.returncode == 0, done.stderr[-2000:]
    return [hydra_config.read(run) for run in sorted((folder / "runs").iterdir()) if len(metrics_csv.read(run)) == 1]


def test_the_first_job_of_a_sweep_and_what_varies():
    assert hydra_config.sweep(["seed=0,1", "weather=wet"]) == (["weather=wet", "seed=0"], {"seed"})


@pytest.mark.slow
def test_values_that_commas_divide_are_runs_of_their_own(tmp_path):
    found = sweep(tmp_path, "seed=0,1", "weather=wet")
    assert sorted(run["seed"] for run in found) == [0, 1] and len({run["name"] for run in found}) == 1


@pytest.mark.slow
def test_joblib_runs_them_at_a_time(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs hydra-joblib-launcher: pip install scenefactory_jax[sweeps]")
    found = sweep(tmp_path, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1")
    assert sorted(run["seed"] for run in found) == [0, 1]


def test_runs_that_begin_in_one_second_do_not_share_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = hydra_config.load_config("train", *TOY)
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(run_folder.open_run_folder(settings))[0] for _ in range(4)]
        assert len(set(folders)) == 4 and all(folder.is_dir() for folder in folders)


@pytest.mark.slow
def test_the_optuna_loop_of_the_page(tmp_path, monkeypatch, capsys):
    pytest.importorskip("optuna", reason="needs Optuna: pip install scenefactory_jax[sweeps]")
    code = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL).group(1)
    assert all(code.count(long) == 1 for long in SMALLER)
    for long, short in SMALLER.items():
        code = code.replace(long, short)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "sweeps.md", "exec"), {})
    assert "gamma" in capsys.readouterr().out and (tmp_path / "sweep.db").is_file()
    assert len(list((tmp_path / "runs").glob("optuna-*"))) == 2
