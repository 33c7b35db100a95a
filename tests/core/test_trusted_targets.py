"""A folder that holds a run or a policy runs no code of its own: its config may name parts of the package, and others only with `trust`."""

import shutil

import pytest
import yaml

import scenefactory_jax as sf
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.compare import _read
from scenefactory_jax.cli.evaluate import evaluate
from scenefactory_jax.cli.export import export
from scenefactory_jax.cli.view import load_run_config, replay
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import trusted_targets
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.learning import run_folder, run_paths
from scenefactory_jax.visualization.report import policy_card

PLANTED = (
    "from pathlib import Path\nPath(__file__).with_name('ran').touch()\nfrom scenefactory_jax.learning.networks.late_fusion import make\n"
)
FOREIGN = [
    "planted.make",
    "os.system",
    "runpy.run_path",
    "scenefactory_jax.core.config.subprocess.run",
    "scenefactory_jax.core.instantiate.find",
]
FOREIGN += ["scenefactory_jax.learning.checkpoint.strip", "scenefactory_jax.core.atomic_file.replaced"]
FOREIGN += ["scenefactory_jax_evil.rewards.event", ".planted.make", 7]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The package's policy in a folder with a module beside it, importable from where the command is called."""
    shutil.copytree(run_paths.SHIPPED / "town", tmp_path / "theirs")
    (tmp_path / "theirs" / "planted.py").write_text(PLANTED)
    monkeypatch.chdir(tmp_path / "theirs")
    monkeypatch.syspath_prepend(tmp_path / "theirs")
    return tmp_path / "theirs"


def change(folder, edit):
    own = yaml.safe_load((folder / "config.yaml").read_text())
    edit(own)
    (folder / "config.yaml").write_text(yaml.safe_dump(own))


@pytest.mark.parametrize("experiment", sorted(file.stem for file in (hydra_config.find_conf() / "experiment").glob("*.yaml")))
def test_runs_of_the_experiments_name_parts_of_the_package_alone(experiment):
    assert not trusted_targets.find_outside_targets(hydra_config.load_config("train", f"experiment={experiment}"))


@pytest.mark.parametrize("target", FOREIGN, ids=str)
def test_a_run_names_parts_of_the_package_alone(folder, target):
    change(folder, lambda own: own["reward"]["goal"].update(_target_=target))
    with pytest.raises(ConfigError) as caught:
        sf.load_policy(folder)
    told = str(caught.value)
    assert told.startswith(f"{folder / 'config.yaml'}: reward.goal._target_: {target!r}: outside of scenefactory_jax")
    assert "trust=true" in told and "\n" not in told and not (folder / "ran").exists()


@pytest.mark.parametrize(
    "door",
    [
        lambda run, out: sf.load_policy(run),
        lambda run, out: export(hydra_config.load_config("export", f"run={run}", f"out={out}")),
        lambda run, out: evaluate(hydra_config.load_config("evaluate", f"run={run}", f"out={out}")),
        lambda run, out: replay(hydra_config.load_config("view", f"run={run}", f"out={out}.html")),
        lambda run, out: load_run_config(hydra_config.load_config("view", f"run={run}")),
    ],
    ids=["load_policy", "export", "evaluate", "replay", "run config"],
)
def test_every_command_checks_targets(folder, tmp_path, door):
    change(folder, lambda own: own["scenes"]["formats"].update(mine={"_target_": "planted.make", "more": [{"_target_": "os.system"}]}))
    named = r"scenes\.formats\.mine\._target_: 'planted\.make'; scenes\.formats\.mine\.more\.0\._target_: 'os\.system'"
    with pytest.raises(ConfigError, match=named):
        door(folder, tmp_path / "out")
    assert not (folder / "ran").exists() and not (tmp_path / "out").exists()


def test_trusted_targets_are_named_and_run(folder, tmp_path, capsys):
    change(folder, lambda own: own["policy"].update(_target_="planted.make"))
    trained = sf.load_policy(folder, trust=True)
    assert (folder / "ran").exists() and trained.config["policy"]["_target_"] == "planted.make"
    assert capsys.readouterr().out == ""  # commands print it
    kept = export(hydra_config.load_config("export", f"run={folder}", f"out={tmp_path / 'mine'}", "trust=true"))
    assert f"{folder / 'config.yaml'}: trusted, and runs planted.make (policy._target_)\n" in capsys.readouterr().out
    assert "names functions outside of scenefactory_jax: `planted.make`." in (kept / "README.md").read_text()
    with pytest.raises(ConfigError, match=r"policy\._target_: 'planted\.make'"):
        sf.load_policy(kept)


def test_a_policy_of_the_package_needs_no_trust(capsys):
    assert trusted_targets.find_outside_targets(sf.load_policy("town").config) == {} and capsys.readouterr().out == ""
    assert policy_card._describe_code(()) in (run_paths.SHIPPED / "town" / "README.md").read_text()


def test_all_targets_of_the_configs_are_inside():
    whole = hydra_config.load_config("train")
    groups = [group for group in whole if (hydra_config.find_conf() / group).is_dir()]
    files = [file for group in groups for file in (hydra_config.find_conf() / group).rglob("*.yaml")]
    assert {"dynamics", "reward", "observations", "scenes", "policy", "loggers", "weather"} <= set(groups) and len(files) > 40
    for name in [*files, hydra_config.find_conf() / "formats/base.yaml"]:
        assert trusted_targets.find_outside_targets(yaml.safe_load(name.read_text()) or {}) == {}, name


def test_yaml_that_names_itself_is_read_once(tmp_path):
    (tmp_path / "config.yaml").write_text('a: &a [*a, {_target_: os.system}]\n"\\e[2J": {_target_: x.y}\n')
    with pytest.raises(ConfigError) as caught:
        hydra_config.read(tmp_path)
    assert "a.1._target_: 'os.system'" in str(caught.value) and "\x1b" not in str(caught.value)


def test_a_run_resumes_with_the_parts_of_the_command(tmp_path, capsys):
    mine = "+reward.mine={_target_: planted.make, weight: 1.0}"
    before = hydra_config.load_config("train", mine, f"out={tmp_path}")
    run_config.write(tmp_path, before)
    with run_folder.open_run_folder(before | {"resume": True}) as (
        folder,
        resume,
    ):  # what is built is the command's config, never the folder's
        assert folder == tmp_path and not resume
    assert capsys.readouterr().out == f"{tmp_path} has no checkpoint to go on from: the run begins anew\n"
    other = hydra_config.load_config("train", f"out={tmp_path}", "resume=true")
    with pytest.raises(ConfigError, match=r"reward\.mine=None"), run_folder.open_run_folder(other):
        pass


def test_runs_are_compared_without_trust(tmp_path):
    run_config.write(tmp_path, hydra_config.load_config("train", "+reward.mine={_target_: planted.make, weight: 1.0}"))
    (tmp_path / "metrics.csv").write_text("iteration,steps/total\n1,8\n")
    assert _read(tmp_path, []).settings["reward.mine._target_"] == "planted.make"
