"""The whole, from a config to a report: training, going on after a stop, evaluation, conversion, and the other commands."""

import csv
import json
import re
import shlex
import shutil
import signal
import sys
from pathlib import Path

import imageio.v3 as imageio
import jax
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf
from support import running
from support.scene_documents import document, thing, written

import scenefactory_jax
from scenefactory_jax import __main__ as command_line
from scenefactory_jax.cli import hydra_config, schema
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.cli.evaluate import evaluate, format_rerun_command
from scenefactory_jax.cli.export import export, format_name
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.cli.train import train
from scenefactory_jax.cli.view import replay
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core import folder_lock
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import circumstances, failures, statistics
from scenefactory_jax.evaluation.records import begin_folder, read_records, read_settings
from scenefactory_jax.learning import checkpoint, interrupt, policy_io, run_folder, run_paths
from scenefactory_jax.learning.training_loop import make_policy, make_trainer, prepare
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import evaluation_files, tables

pytestmark = pytest.mark.usefixtures("quickly")

CLOCK = {"seconds", "casps", "minutes", "years_per_hour"}  # columns that no two runs share


def smoke(out, *overrides):
    """Without the grid of the road: its size differs between scenes, and programs with it."""
    return running.smoke(out, "scenes.road_grid.radius_m=null", *overrides)


@pytest.fixture(scope="module")
def capacity():
    """The smoke run's own shapes, so that what is trained on other scenes is compiled already."""
    scene = scene_source.load_training_scenes(smoke(None)["scenes"]).scene
    rows = {"road": scene.road, "lanes": scene.lanes, "edges": scene.edges, "agents": scene.agents, "controls": scene.controls}
    sizes = {name: len(jax.tree.leaves(part)[0][0]) for name, part in rows.items()}
    sizes |= {"traffic": scene.traffic_log.valid.shape[1], "steps": scene.log.valid.shape[2]}
    return [f"scenes.capacity.{name}={size}" for name, size in sizes.items()]


@pytest.fixture(scope="module")
def prepared():
    """Environment, policy and trainer of the smoke run: its programs compile once."""
    return prepare(smoke(None))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, prepared):
    """Four unbroken iterations and the report."""
    config = smoke(tmp_path_factory.mktemp("runs") / "whole", "iterations=4", "checkpoint_every=2", "evaluation.every=2")
    return train(config, prepared=prepared)


def same_numbers(folder: Path, other: Path) -> None:
    rows, others = metrics_csv.read(folder), metrics_csv.read(other)
    assert len(rows) == len(others) and list(rows[0]) == list(others[0])
    for row, expected in zip(rows, others, strict=True):
        assert {name: row[name] for name in row if name not in CLOCK} == {name: expected[name] for name in row if name not in CLOCK}


# ---- train


def test_a_run_folder_holds_what_it_promises(whole):
    kept = hydra_config.read(whole.folder)
    assert kept == whole.config and kept["name"] == "smoke" and kept["iterations"] == 4
    versions = yaml.safe_load((whole.folder / "versions.yaml").read_text())
    assert versions["commit"] and versions["jax"] == jax.__version__ and versions["platform"] == "cpu"
    assert checkpoint.latest(whole.folder / "checkpoints") == 4
    for trained, stored in zip(
        jax.tree.leaves(whole.state.parameters), jax.tree.leaves(checkpoint.restore_parameters(whole.folder / "checkpoints")), strict=True
    ):
        np.testing.assert_array_equal(trained, stored)


def test_the_untrained_policy_is_the_one_that_training_began_with(whole):
    scenes, trainer = scene_source.load_training_scenes(whole.config["scenes"]), make_trainer(whole.config, whole.env, whole.policy)
    worlds, _ = scene_source.assign_scenes(scenes, whole.config["worlds"], seed=whole.config["seed"])
    begun = trainer.init(jax.random.key(whole.config["seed"]), worlds).parameters
    jax.tree.map(np.testing.assert_array_equal, policy_io.draw_untrained(whole.config, scenes[0]), begun)


def test_metrics_have_a_row_an_iteration_and_a_column_a_term(whole):
    with open(whole.folder / "metrics.csv", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert rows == whole.metrics and [row["iteration"] for row in rows] == [1, 2, 3, 4]
    minutes = np.cumsum([0.0] + [row["seconds"] / 60 for row in rows[1:]])  # not the first, which compiles
    np.testing.assert_allclose([row["minutes"] for row in rows], minutes, rtol=1e-9)
    terms = {f"reward/{name}" for name in whole.config["reward"]}
    assert terms == {name for name in rows[0] if name.startswith("reward/")} and len(terms) == 10
    for row in rows:
        assert row["reward"] == pytest.approx(sum(row[name] for name in terms), abs=1e-5)
        assert row["casps"] == pytest.approx(row["steps/spawned"] / row["seconds"])
    spawned = int(np.asarray(whole.state.worlds.state.agents.present).sum()) * whole.config["ppo"]["horizon"]
    assert [row["steps/total"] for row in rows] == [spawned * n for n in (1, 2, 3, 4)]
    judged = metrics_csv.read(whole.folder, metrics_csv.EVALUATIONS)
    assert [row["iteration"] for row in judged] == [2, 4] and all(0 <= row["strict/success_rate/value"] <= 1 for row in judged)


def test_the_report_compares_and_its_files_are_there(whole):
    text, settings = (whole.folder / "report.md").read_text(), told(whole.folder / "report.md")
    assert settings["run"] == str(whole.folder) and settings["protocol"]["termination"] == ["strict"]
    # every report says how its episodes began and in what weather
    shown = "| Starts | as recorded, at the recorded speed |\n| Weather | AC 0 mm |\n| Background traffic | none |\n| Dynamics | `"
    assert f"| Protocol | `trained` |\n{shown}" in text
    assert {name: settings[name] for name in settings if name in whole.config["evaluation"]}.items() <= whole.config["evaluation"].items()
    assert "| Metric | strict, untrained | strict | difference |" in text
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert {"video.gif", "learning.png", "comparison-strict.png", "agents-strict.csv", "metrics.csv"} <= set(links)
    assert all((whole.folder / link).is_file() for link in links if "://" not in link and not link.startswith("#"))
    assert len(list(imageio.imiter(whole.folder / "video.gif"))) > 1


def test_the_report_shows_the_worst_of_every_kind_of_failure(whole):
    ranked = failures.rank_failures(read_records(whole.folder / "agents-strict.csv"))
    told = json.loads((whole.folder / "failures.json").read_text())
    assert set(told) == {"strict", "strict, untrained"}
    assert {kind: len(found) for kind, found in ranked.items()} == {k: entry["agents"] for k, entry in told["strict"]["types"].items()}
    assert ranked and sum(map(len, ranked.values())) == told["strict"]["agents"] - told["strict"]["clean"]
    text = (whole.folder / "report.md").read_text()
    for kind, entry in told["strict"]["types"].items():
        picture = f"failures-strict-{kind}.png"
        assert entry["picture"] == picture and f"]({picture})" in text and (whole.folder / picture).is_file()
        label = failures.FAILURE_TYPES[kind].label
        assert f"| {label} | {entry['agents']} |" in text and f"- **{label}**: " in text


def test_every_spawned_agent_has_a_record(whole):
    heldout = scene_source.load_heldout_scenes(whole.config["scenes"], path=None)
    present = np.asarray(heldout.scene.agents.present)
    for name in ("strict", "strict-untrained"):
        records = read_records(whole.folder / f"agents-{name}.csv")
        assert len(records["scene"]) == present.sum()
        assert list(zip(records["world"], records["agent"], strict=True)) == list(zip(*np.nonzero(present), strict=True))
        assert set(records["scene"]) == set(heldout.names)
    observed = scene_source.load_training_scenes(whole.config["scenes"]).scene.agents.position
    assert not any(np.array_equal(one, other) for one in observed for other in heldout.scene.agents.position)


def test_a_killed_and_resumed_run_is_the_unbroken_one(whole, prepared, tmp_path):
    again = lambda *changes: smoke(tmp_path / "run", "checkpoint_every=2", "evaluation.enable=false", *changes)  # noqa: E731
    train(again("iterations=2"), prepared=prepared)
    with pytest.raises(ConfigError, match="holds a run already; add resume=true"):
        train(again("iterations=4"))

    def killed(state, row):
        if row["iteration"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(again("iterations=4", "resume=true"), on_iteration=killed, prepared=prepared)
    assert (
        len(metrics_csv.read(tmp_path / "run")) == 3 and checkpoint.latest(tmp_path / "run" / "checkpoints") == 2
    )  # a row past the checkpoint
    observed = []
    note = lambda state, row: observed.append(row["iteration"])  # noqa: E731
    resumed = train(again("iterations=4", "resume=true"), on_iteration=note, prepared=prepared)
    assert observed == [3, 4]
    same_numbers(resumed.folder, whole.folder)
    jax.tree.map(np.testing.assert_array_equal, resumed.state.parameters, whole.state.parameters)


def test_a_run_starts_from_the_networks_of_another(whole, prepared, tmp_path):
    trained = checkpoint.restore_parameters(whole.folder / "checkpoints")
    seen = []

    def iterate(state, scenes):
        seen.append(jax.device_get(state.parameters))
        return prepared.trainer.train_iteration(state, scenes)

    settings = smoke(tmp_path / "tuned", "iterations=1", "evaluation.enable=false", f"start_from={whole.folder}")
    train(settings, prepared=prepared._replace(trainer=prepared.trainer._replace(train_iteration=iterate)))
    jax.tree.map(np.testing.assert_array_equal, seen, [trained])
    with pytest.raises(ConfigError, match=r"^start_from: config.yaml not found in nowhere; expected a folder that"):
        train(smoke(tmp_path / "refused", "start_from=nowhere"), prepared=prepared)
    assert not (tmp_path / "refused").exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_does_not_go_on_changes_nothing(whole, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "run")
    before = contents(tmp_path / "run")
    for overrides, message in {
        ("resume=true", "policy.trunk=[32]"): r"policy\.trunk=\[32\] \(the run has \[16\]\)",
        ("resume=true", "seed=5"): r"; seed=5 \(the run has 0\): .* keeps its settings",
        ("seed=5",): "holds a run already",
    }.items():
        with pytest.raises(ConfigError, match=message):
            train(smoke(tmp_path / "run", "iterations=9", *overrides))
        assert contents(tmp_path / "run") == before
    (tmp_path / "run" / "checkpoints").rename(tmp_path / "aside")
    with pytest.raises(ConfigError, match="holds a run already; add resume=true"):  # it never came to its first checkpoint
        train(smoke(tmp_path / "run"))
    (tmp_path / "aside").rename(tmp_path / "run" / "checkpoints")
    free = ["iterations=9", "checkpoint_every=3", "loggers=[]", "evaluation.seed=3", "scenes.heldout.count=2", "scenes.workers=2", "name=b"]
    with run_folder.open_run_folder(smoke(tmp_path / "run", "resume=true", *free)) as (_, goes_on):
        assert goes_on


def test_one_command_at_a_time_trains_in_a_folder(tmp_path):
    settings = smoke(tmp_path / "a" / "run")
    refused = pytest.raises(folder_lock.Busy, match="another command writes there now")
    with run_folder.open_run_folder(settings), refused, run_folder.open_run_folder(settings):
        pass
    (tmp_path / "a" / "run").rmdir()  # no lock is left


def test_a_training_that_cannot_begin_removes_what_it_made_and_nothing_else(tmp_path):
    (tmp_path / "mine" / "empty").mkdir(parents=True)
    for place in ("mine/empty", "mine/new/run"):
        with pytest.raises(KeyError), run_folder.open_run_folder(smoke(tmp_path / place)):
            raise KeyError
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["empty", "mine"]
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"out=\S+file: is a file"), run_folder.open_run_folder(smoke(tmp_path / "file")):
        pass


@pytest.fixture
def interruptible():
    """As at a terminal: a script's background commands are born to ignore interrupts, those of `nohup` to ignore SIGHUP."""
    own = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {one: signal.signal(one, handler) for one, handler in own.items()}
    yield own
    for one, handler in before.items():
        signal.signal(one, handler)


def test_a_signal_to_stop_keeps_the_iteration_that_it_falls_into(whole, prepared, interruptible, tmp_path, capsys):
    again = lambda *changes: smoke(tmp_path / "run", "evaluation.enable=false", "iterations=4", *changes)  # noqa: E731

    for iteration, number in enumerate((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), start=1):

        def stopped(state, row, number=number):
            signal.raise_signal(number)
            if number != signal.SIGINT:
                signal.raise_signal(number)  # `timeout` sends it twice

        with pytest.raises(KeyboardInterrupt) as caught:
            train(again(*["resume=true"] * (iteration > 1)), on_iteration=stopped, prepared=prepared)
        assert caught.value.args == (number,) and checkpoint.latest(tmp_path / "run" / "checkpoints") == iteration
        told = f"stopped at iteration {iteration}; goes on with the same settings and out={tmp_path / 'run'} resume=true"
        assert told in capsys.readouterr().out
        assert {one: signal.getsignal(one) for one in interruptible} == interruptible
    same_numbers(train(again("resume=true"), prepared=prepared).folder, whole.folder)


def test_a_second_interrupt_ends_at_once_and_what_is_ignored_stays_so(interruptible):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under `nohup`
    with interrupt.defer_interrupt() as asked:
        signal.raise_signal(signal.SIGHUP)
        assert asked() is None
        signal.raise_signal(signal.SIGTERM)
        assert asked() == signal.SIGTERM
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_held_out_scenes_are_refused_before_anything_is_read(tmp_path):
    place = tmp_path / "scenes"
    place.mkdir()
    for overrides, message in {
        ("scenes.heldout.path=/nowhere",): r"scenes\.heldout\.path: /nowhere: no such file or folder",
        ("scenes.seed=7", "scenes.heldout.seed=7"): r"scenes\.heldout\.seed: expected another seed than scenes.seed, got 7",
        ("scenes=womd", f"scenes.path={place}", f"scenes.heldout.path={place}/."): "expected other scenes than scenes.path",
    }.items():
        with pytest.raises(ConfigError, match=message):
            train(smoke(tmp_path / "run", *overrides))
    assert not (tmp_path / "run").exists()


# ---- evaluate


def asked(run, out, *overrides):
    return hydra_config.load_config("evaluate", f"run={run.folder}", f"out={out}", "chunk_steps=30", "bootstrap=100", *overrides)


def judged(run, out, *overrides):
    return evaluate(asked(run, out, *overrides))


def told(report: Path):
    """The config of the command with which a report says that its numbers are made again."""
    [line] = re.findall(r"^python -m scenefactory_jax evaluate (.*)$", report.read_text(), re.MULTILINE)
    return hydra_config.load_config("evaluate", *shlex.split(line))


@pytest.mark.ci
def test_both_protocols_and_the_same_records_twice(whole, tmp_path, undrawn_figures):
    result = judged(whole, tmp_path, "video.enable=false")
    assert set(result.records) == {"strict", "goal_only"} and result.report.is_file()
    assert (tmp_path / "agents-strict.csv").read_bytes() == (whole.folder / "agents-strict.csv").read_bytes()  # what training wrote
    strict, goal_only = (result.records[name] for name in ("strict", "goal_only"))
    ended = strict["collision"] | strict["out_of_bounds"] | strict["road_edge_contact"]
    assert ended.any() and (goal_only["time_s"] >= strict["time_s"]).all()
    noted = read_settings(tmp_path)
    assert sorted(noted["protocols"]) == ["goal_only", "strict"] and noted["seed"] == 1000
    kept = [file.name for file in sorted(tmp_path.glob("agents-*.csv"))]
    begin_folder(tmp_path, {"scenes": None})  # as the next evaluation does
    assert kept == ["agents-goal_only.csv", "agents-strict.csv"] and [file.name for file in tmp_path.iterdir()] == ["evaluation.json"]


@pytest.mark.slow  # tests of planners and policies evaluate with overrides
def test_other_settings_of_a_run(whole, tmp_path):
    short = "overrides=[timing.episode_s=1, weather.friction.mode=dynamic]"
    small = ["video.seconds=0.5", "video.panel=120", "video.worlds=1"]
    changed = judged(whole, tmp_path / "short", *small, "protocol.termination=[goal_only]", short)
    assert set(changed.records) == {"goal_only"} and changed.records["goal_only"]["time_s"].max() <= 1.0
    assert told(changed.report) == {**asked(whole, None, *small, "protocol.termination=[goal_only]", short), "out": None}
    assert changed.report.read_text().startswith("# smoke: evaluation on scenes not seen in training\n")
    assert (tmp_path / "short" / "video.gif").is_file()
    assert hydra_config.read(whole.folder)["timing"]["episode_s"] == 2


def test_wrong_overrides_of_a_run_are_named(whole, tmp_path):
    for override, message in {
        "overrides=[timing.episode=1]": "timing.episode: the run has no 'episode' there; valid: control_hz, episode_s, physics_hz",
        "overrides=[wether=wet]": "the run has no 'wether' there; valid: .*weather",
        "overrides=[weather=foggy]": "Could not find 'weather/foggy' Available options in 'weather': all base .* dry .* mixed .* wet",
        "protocol.termination=[perhaps]": r"protocol\.termination: expected one or more of goal_only, .*, got \['perhaps'\]",
    }.items():
        with pytest.raises(ConfigError, match=message):
            judged(whole, tmp_path / "bad", override)
    with pytest.raises(ConfigError, match=r"config\.yaml not found in"):
        evaluate(hydra_config.load_config("evaluate", f"run={tmp_path}"))


@pytest.mark.ci
def test_an_exported_policy_stands_for_its_run(whole, tmp_path, monkeypatch, undrawn_figures):
    """Judged alike, also by name as one of the package's own, and without a word about where scenes lay."""
    told = ["card.about='For tests.'", f"card.judged={{unseen roads: {whole.folder}}}"]
    kept = export(hydra_config.load_config("export", f"run={whole.folder}", f"out={tmp_path / 'pretrained' / 'handy'}", *told))
    files = ["README.md", "checkpoints/policy.npz", "config.yaml", "versions.yaml"]
    assert sorted(str(one.relative_to(kept)) for one in kept.rglob("*.*")) == files
    card, last = (kept / "README.md").read_text(), metrics_csv.read(whole.folder)[-1]
    strict = statistics.summarise(read_records(whole.folder / "agents-strict.csv"), bootstrap=2000, seed=1000)
    scored = [strict["success_rate"].count, *(tables.format_estimate(strict[name]) for name in ("success_rate", "clean_success_rate"))]
    assert card.startswith("# handy\n\nFor tests.\n") and f"| agent steps | {last['steps/total']:,.0f} |" in card
    assert "| unseen roads | strict | {} | {} | {} |".format(*scored) in card
    assert "- **unseen roads**: starts: as recorded, at the recorded speed; weather: AC 0 mm; background traffic: none; dynamics: `" in card
    assert (kept / "versions.yaml").read_text() == (whole.folder / "versions.yaml").read_text()
    assert hydra_config.read(kept)["scenes"]["heldout"]["path"] is None and str(tmp_path.parent) not in (kept / "config.yaml").read_text()
    monkeypatch.setattr(run_paths, "SHIPPED", tmp_path / "pretrained")
    monkeypatch.chdir(tmp_path)
    trained = scenefactory_jax.load_policy("handy")
    assert trained.folder == kept and trained.config["observations"] == whole.config["observations"]
    jax.tree.map(np.testing.assert_array_equal, trained.parameters, jax.device_get(whole.state.parameters))
    as_in_training = ["chunk_steps=30", "video.enable=false", "failures.pictures.enable=false"]  # the program of its evaluations
    again = evaluate(hydra_config.load_config("evaluate", "run=handy", "protocol.termination=[strict]", *as_in_training))
    assert again.folder == Path("runs/handy/evaluation")
    again_records, records = (read_records(folder / "agents-strict.csv") for folder in (again.folder, whole.folder))
    for name, column in records.items():  # a program without pictures may round otherwise
        close = np.testing.assert_allclose if column.dtype.kind == "f" else np.testing.assert_array_equal
        close(again_records[name], column, **({"rtol": 1e-5} if column.dtype.kind == "f" else {}), err_msg=name)
    with pytest.raises(ConfigError, match=r"not found in hand; .*, or a bundled policy: handy"):
        scenefactory_jax.load_policy("hand")
    with pytest.raises(ConfigError, match=r"card\.judged\.nothing: \S+ holds no records of agents; give a folder that `evaluate` wrote"):
        export(hydra_config.load_config("export", "run=handy", f"out={tmp_path / 'other'}", f"card.judged={{nothing: {tmp_path}}}"))
    with pytest.raises(ConfigError, match="holds something already; give a new folder"):
        export(hydra_config.load_config("export", "run=handy", f"out={whole.folder}"))


def test_scores_and_titles_name_other_scenes(whole, tmp_path):
    asked = {"run": "mine", "scenes": "/data/towns.bank", "overrides": ["dynamics=bicycle"], "protocol": "recorded", "trust": True}
    asked["protocols"] = ["goal_only", "strict"]
    begin_folder(tmp_path, asked)
    assert format_name("unseen", tmp_path) == "unseen (towns.bank, protocol=recorded, dynamics=bicycle)"
    assert format_name("unseen", whole.folder) == "unseen"
    assert evaluation_files.format_title("mine", asked) == "mine: evaluation on towns.bank"
    assert format_rerun_command(asked, hydra_config.load_config("evaluate", "run=mine", "protocol=recorded", "seed=7")) == (
        "python -m scenefactory_jax evaluate run=mine protocol=recorded trust=true scenes.path=/data/towns.bank"
        " 'overrides=[\"dynamics=bicycle\"]' seed=7"
    )


def test_a_damaged_config_is_named(tmp_path):
    expected = "expected the config of a run, got "
    for content, message in {"": expected, "- 1": f"{expected}list", "a: [1": "damaged: while parsing"}.items():
        (tmp_path / "config.yaml").write_text(content)
        with pytest.raises(ConfigError, match=message):
            evaluate(hydra_config.load_config("evaluate", f"run={tmp_path}"))


@pytest.mark.ci
def test_a_replay_shows_what_the_evaluation_counted(whole, tmp_path):
    page = replay(hydra_config.load_config("view", f"run={whole.folder}", "worlds=3", f"out={tmp_path / 'page.html'}")).read_text()
    head = json.loads(re.search(r'id="head">(.*?)</script>', page, re.DOTALL).group(1))
    records = read_records(whole.folder / "agents-strict.csv")
    assert head["title"] == whole.folder.name and [one["name"] for one in head["worlds"]] == list(dict.fromkeys(records["scene"]))
    for index, shown in enumerate(head["worlds"]):
        rows = {int(agent): row for row, agent in enumerate(records["agent"]) if records["world"][row] == index}
        assert {car["slot"] for car in shown["cars"]} == set(rows)
        for car in shown["cars"]:
            steps = sum(last - first + 1 for first, last in car["spans"])
            assert steps == round(records["time_s"][rows[car["slot"]]] * 30)
        assert all(records[event["name"]][rows[event["car"]]] for event in shown["events"])
        assert sum(event["name"] == "goal_reached" for event in shown["events"]) == sum(
            records["goal_reached"][row] for row in rows.values()
        )
    with pytest.raises(ConfigError, match=r"dynamics: decided by the run .*; to change it: overrides='\[dynamics=\.\.\.\]'"):
        replay(hydra_config.load_config("view", f"run={whole.folder}", "dynamics=articulated"))


# ---- convert -> bank -> train


def trained_on_bank(source, folder, prepared, capacity):
    """Convert, train on the bank, and hand back the conversion's summary and the run."""
    summary = convert(
        hydra_config.load_config("convert", f"source={source}", f"out={folder / 'bank'}", "progress=false", "scenes.pack.agents=4")
    )
    run = train(smoke(folder / "run", "scenes=womd", f"scenes.path={folder / 'bank'}", *capacity), prepared=prepared)
    assert len(bank_reader.open(folder / "bank")) == summary.scenes == 2
    assert len(run.metrics) == 2 and all(np.isfinite(value) for row in run.metrics for value in row.values())
    return summary, run


def test_files_become_a_bank_and_a_policy(prepared, capacity, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    for name, offset in (("one", 0), ("two", 8)):
        objects = [thing(0, id=7, speed=40), thing(-30 + offset, id=8, speed=40)]
        written(tmp_path / "in", document(name=name, objects=objects), f"{name}.json")
    summary, run = trained_on_bank(tmp_path / "in", tmp_path, prepared, capacity)
    assert summary.agents_kept == 4 and run.metrics[0]["steps/spawned"] == 4 / 2 * 4 * run.config["ppo"]["horizon"]
    printed = capsys.readouterr().out
    assert "2 scenes with 4 agents from 2 files, 0 rejected" in printed and "4 worlds of 2 scenes, 2 to 2 worlds a scene" in printed
    assert "no report: scenes.heldout.path is null" in printed and not (run.folder / "report.md").exists()


@pytest.mark.slow  # repeats what files show, on real scenes
def test_real_scenes_become_a_bank_and_a_policy(prepared, capacity, tmp_path, shared_data):
    (tmp_path / "in").mkdir()
    for path in sorted((shared_data / "womd" / "train").iterdir())[:2]:
        (tmp_path / "in" / path.name).symlink_to(path)
    summary, run = trained_on_bank(tmp_path / "in", tmp_path, prepared, capacity)
    assert summary.agents_kept > 2 and run.metrics[0]["steps/active"] > 0


# ---- the other commands


def test_compiled_programs_are_kept_where_the_environment_says(monkeypatch, tmp_path):
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    monkeypatch.setenv(scene_source.CACHE, str(tmp_path / "mine"))
    try:
        jax.config.update(names[0], str(tmp_path / "jax"))
        scene_source.use_compilation_cache()
        assert jax.config.values[names[0]] == str(tmp_path / "jax")  # JAX's own setting is left alone
        jax.config.update(names[0], None)
        scene_source.use_compilation_cache()
        assert [jax.config.values[name] for name in names] == [str(tmp_path / "mine"), 2.0]
        monkeypatch.setenv(scene_source.CACHE, "")
        jax.config.update(names[0], None)
        scene_source.use_compilation_cache()
        assert jax.config.values[names[0]] is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_scenes_lists_and_draws(tmp_path, capsys):
    loaded = scenes(hydra_config.load_config("scenes", "op=check", "scenes.count=3", "check.max_pictures=2", f"out={tmp_path}"))
    printed = capsys.readouterr().out
    assert len(loaded) == 3 and all(name in printed for name in loaded.names) and "generated scenes of seed 0" in printed
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == sorted([*loaded.names[:2], "sheet"])
    with pytest.raises(ConfigError, match="op: 'draw'; valid: check, quality"):
        scenes(hydra_config.load_config("scenes", "op=draw"))


def test_view_writes_a_model_that_steps(tmp_path):
    import mujoco

    xml = replay(hydra_config.load_config("view", "scenes.count=1", f"out={tmp_path / 'world.xml'}"))
    model = mujoco.MjModel.from_xml_path(str(xml))  # pyright: ignore[reportAttributeAccessIssue]
    assert model.nu >= 0 and model.nbody > 10


# ---- command line


def test_help_lists_the_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["scenefactory_jax", "--help"])
    with pytest.raises(SystemExit) as stopped:
        command_line.main()
    printed = capsys.readouterr().out
    assert stopped.value.code == 0 and all(f"\n  {name} " in printed for name in command_line.COMMANDS)


def test_an_interrupted_command_ends_as_shells_expect(monkeypatch, interruptible, tmp_path):
    ways = {130: lambda: signal.raise_signal(signal.SIGINT), 143: lambda: interrupt.end(tmp_path, 1, signal.SIGTERM)}
    for code, end in ways.items():
        monkeypatch.setattr(sys, "argv", ["scenefactory_jax", "train"])
        monkeypatch.setattr("scenefactory_jax.cli.train.train", lambda config, end=end: end())
        with pytest.raises(SystemExit) as stopped:
            command_line.main()
        assert stopped.value.code == code


def test_only_our_own_command_line_counts_as_a_command(monkeypatch):
    called = {"/lib/scenefactory_jax/__main__.py train": "python -m scenefactory_jax train a=1", "/home/me/train.py": "train(config)"}
    for program, command in called.items():
        monkeypatch.setattr(sys, "argv", [program, "a=1", "out=x"])
        assert run_config.format_command("train") == command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "ppo.horizn=3"], "error: ppo.horizn: unknown key 'horizn'; ppo has: advantage_fraction, clip_eps, "),
        (["train", "worlds=many"], "error: worlds: expected an integer >= 1, got 'many'"),
        (["train", "scenes.path=/nowhere", "experiment=smoke"], "error: /nowhere: no such file or folder"),
        (["evaluate"], "error: run: missing; give run=..., or planners=[...] alone, as `evaluate --help` describes it"),
        (["train", "seed"], "error: seed: expected seed=VALUE, or ~seed to remove it"),
        (["train", "reward={}"], "error: reward={}: mappings are merged, so an empty one changes nothing; to empty it: ~reward +reward={}"),
        (["train", "--foo"], "error: unrecognized arguments: --foo; --hydra-help describes the flags"),
        (["train", "--cfg", "jobs"], "error: argument --cfg/-c: invalid choice: 'jobs'"),
        (["train", "--resolve"], "error: --resolve: expected --cfg job beside it"),
        (
            ["evaluate", "run=/nowhere", "overrides=[dynamics=bicycle,weather=wet]"],  # a list that Hydra alone would not read
            "error: run: config.yaml not found in /nowhere; expected a folder that `train` or `export` wrote, or a bundled policy: drive,",
        ),
        (["convert", "source=/nowhere"], "error: out: missing"),
        (["convert", "source=/nowhere", "out=x"], "error: /nowhere: no such file or folder"),
        (["train", "experiment=smoke", f"out={'x' * 300}"], "xxx: File name too long"),
        (["train", "loggers=[tensorbord]"], "error: loggers: unknown option 'tensorbord'; valid: mlflow, tensorboard, wandb"),
        (["train", "-m", "ppo.horizn=3,4", "seed=interval(0,1)"], "error: ppo.horizn: unknown key 'horizn'; ppo has: "),
        (["evaluate", "-m", "run=runs/mine", "seed=1,2"], "error: out: expected a folder for each job of this sweep"),
        (["drive-away"], "error: command: expected one of train, record, evaluate"),
    ],
)
def test_what_a_user_can_mend_is_one_line(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["scenefactory_jax", *arguments])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        command_line.main()
    printed = capsys.readouterr()
    text = printed.err or str(stopped.value)
    assert message in text and len(text.splitlines()) == 1 and stopped.value.code == 2
    assert arguments[0] == "convert" or not printed.out  # it names its source first
    assert not list(tmp_path.iterdir())


# ---- every option composes and builds


PLANNERS = tuple(f"policy={name}" for name in ("pure_pursuit", "route_pursuit", "idm_route", "pdm_closed", "expert", "constant", "random"))
FOR_PLANNERS = ("observations=planning", "observations=log", "observations=noise")
RATES = ("actions=rates_10hz", "actions=rates_10hz_reverse", "actions=generalist_finetune")


PARTS = ("base", "cloning")  # files of options that are none


def option_sets():
    """Sets of options, one of each group, which together have every option of every group once or more."""
    others = ("command", "hydra_settings", "task", "experiment", "protocol", "spread", "study", "suite", "sysid", "tracker", "validation")
    folders = [folder for folder in sorted(hydra_config.find_conf().iterdir()) if folder.is_dir() and folder.name not in others]
    groups = [[f"{folder.name}={path.stem}" for path in sorted(folder.glob("*.yaml")) if path.stem not in PARTS] for folder in folders]
    apart = (*PLANNERS, *FOR_PLANNERS, *RATES, "timing=waymax")  # not trained, or not with every learner or action repeat; see below
    groups = [[option for option in options if option not in apart] for options in groups]
    return [[options[i % len(options)] for options in groups if options] for i in range(max(map(len, groups)))]


def builds(whole_config):
    env, policy = environment.make_env(whole_config), make_policy(whole_config)
    assert make_trainer(whole_config, env, policy).train_iteration
    assert {"gpudrive", "scenefactory"} <= set(whole_config["scenes"]["formats"])
    if scene_source.has_heldout(whole_config["scenes"]):
        instantiate(
            whole_config["scenes"]["generate"],
            builtins="scenefactory_jax.data.generators.town.town_scene",
            where="scenes.generate",
        )


@pytest.mark.parametrize("options", option_sets(), ids=lambda options: options[-1])
def test_every_option_builds(options):
    builds(hydra_config.load_config("train", *options))


@pytest.mark.parametrize("actions", RATES)
def test_actions_that_are_rates_build(actions):
    builds(hydra_config.load_config("train", actions, "observations=drive_bends"))


def test_the_task_of_v_max_builds():
    kinematics = ["dynamics=bicycle_waymax", "timing=waymax", "actions=acceleration"]
    builds(hydra_config.load_config("train", *kinematics, "observations=vmax_road", "reward=vmax_navigation", "scenes/pack/routes=lanes"))


@pytest.mark.parametrize("planner", PLANNERS)
def test_a_policy_that_does_not_learn_replaces_the_trained_one(planner):
    builds(hydra_config.apply_overrides(hydra_config.load_config("train", "dynamics=bicycle"), ["observations=drive", planner]))


def test_an_override_of_a_group_in_the_scenes_sets_what_the_option_sets():
    config = hydra_config.load_config("train", "scenes/pack/starts=route100")
    changed = hydra_config.apply_overrides(config, ["scenes/pack/starts=conflict", "scenes/pack/routes=route100"])["scenes"]["pack"]
    assert changed["starts"] is None and changed["conflicts"]["distance_m"] == 2.5
    assert changed["routes"]["attempts"] == 1500
    assert hydra_config.apply_overrides(config, ["scenes/pack/routes=none"])["scenes"]["pack"]["routes"] is None
    assert config["scenes"]["pack"]["starts"]["_target_"] == "route100"


def names(group):
    return sorted(path.stem for path in (hydra_config.find_conf() / group).glob("*.yaml"))


@pytest.mark.parametrize("name", names("spread"))
def test_every_way_to_spread_work_builds(name):
    instantiate(
        hydra_config.load_config("convert", f"spread={name}")["spread"], builtins="scenefactory_jax.core.parallel.task_map", where="spread"
    )


@pytest.mark.parametrize("name", names("suite"))
def test_what_a_suite_says_counts(name):
    said = OmegaConf.to_container(OmegaConf.load(hydra_config.find_conf() / "suite" / f"{name}.yaml"))
    found = hydra_config.load_config("benchmark", f"suite={name}")
    assert said["variants"].keys() <= found["variants"].keys()
    for key in said.keys() - {"variants", "defaults"}:
        assert found[key] == said[key] or {**found[key], **said[key]} == found[key], key


RUNS = (
    ["experiment=quick", "scenes=womd"],
    ["experiment=paper", "dynamics=bicycle", "weather=ice", "traffic=log_playback", "spawning=mixed"],
)


SUITES = ("recorded_routes", "route100", "conflict", "conflict_reactive", "grip", "grip_hidden", "grip_stops", "ice_onset")  # with routes
SUITES += ("vmax", "vmax_noise", "nuplan", "nuplan_reactive", "wosac", "scenarionet")


@pytest.mark.parametrize("name", names("protocol"))
def test_a_protocol_decides_all_of_an_episode_but_what_the_policy_sees_and_does(name):
    """Two runs with nothing in common are judged alike; `trained` leaves each as it is."""
    settings = hydra_config.load_config("evaluate", "run=x", f"protocol={name}")
    schema.check_evaluate(settings)
    runs = [hydra_config.load_config("train", *words) for words in RUNS]
    judged = [hydra_config.apply_overrides(run, hydra_config.list_overrides(settings["protocol"]["settings"])) for run in runs]
    assert settings["protocol"]["name"] == name and (settings["seed"], settings["repeats"]) == (1000, 32 if name == "wosac" else 1)
    if name == "trained":
        assert judged == runs
        return
    own = ("observations", "actions", "reward", "termination")  # what the policy learnt to see, to do and to want; `protocol.termination`
    for group in set(environment.GROUPS) - set(own):
        assert judged[0][group] == judged[1][group], group
    assert judged[0]["scenes"]["pack"] == judged[1]["scenes"]["pack"]
    if name in SUITES:
        assert judged[0]["scenes"]["pack"]["routes"]
        assert name != "grip_hidden" or judged[1]["weather"]["hidden"]
        return
    assert judged[0]["scenes"]["pack"] == judged[1]["scenes"]["pack"] == hydra_config.load_config("train", "scenes=womd")["scenes"]["pack"]
    told = circumstances.describe(judged[0])
    assert told["Starts"] == ("as recorded, from rest" if name == "paper" else "as recorded, at the recorded speed")
    assert (told["Weather"], told["Background traffic"]) == ("AC 0 mm", "none") and told["Dynamics"].startswith("`articulated")


ALIKE = ("bicycle", "generalist_finetune", "laptop", "vmax")  # of the parts of others


def test_episodes_are_described():
    tell = lambda *words: circumstances.describe(hydra_config.load_config("train", *words))  # noqa: E731
    found = tell("spawning=mixture", "weather=storm", "traffic=log_playback", "dynamics=bicycle", "scenes=town")
    along = "40% somewhere on the recorded way; 40% random, start and goal along lanes"
    assert found["Starts"] == f"20% as recorded, from rest; {along}" and found["Dynamics"] == "`bicycle`"
    assert found["Weather"].startswith("40% AC 0 mm, 15% AC 0.3 mm, ") and found["Weather"].endswith("; patches: puddles; rain: `onset`")
    assert found["Background traffic"] == "as recorded, it does not react" and found["Longest episode"] == "50 s"
    assert found["Scenes"] == "up to 16 agents in 200 m x 200 m, centre sdc"
    assert circumstances.describe({"seed": 3}) == {}


OTHERS = ("traffic=none", "spawning=logged", "reward=paper", "policy=actor_critic", "actions=pedals_with_reverse", "stream=none")


@pytest.mark.parametrize("name", ["drive", "generalist_finetune", "scenarionet"])
def test_an_experiment_takes_other_options(name):
    """What only one option of a group has is in that option and not in the experiment, where it would stay."""
    found = hydra_config.load_config("train", f"experiment={name}", *OTHERS)
    builds(found)
    assert found["stream"] is None and found["traffic"].keys() == {"_target_"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in ALIKE else []) for n in names("experiment")])
def test_every_experiment_builds(name):
    builds(hydra_config.load_config("train", f"experiment={name}"))
    measured, recorded, trained = (hydra_config.load_config(command, f"experiment={name}") for command in ("benchmark", "record", "train"))
    assert measured["ppo"] == trained["ppo"]
    schema.check(measured, schema.Benchmark)
    schema.check(recorded, schema.Record)
