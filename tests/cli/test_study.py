"""Studies at the smallest size: they end, continue where they were stopped, do nothing twice, compile once, report what they rest on."""

import json
import math
import os
import re
import shutil

import jax
import pytest
from support import study_parts

from scenefactory_jax.cli import hydra_config, schema, study_plan, study_results
from scenefactory_jax.cli import study as command
from scenefactory_jax.cli.study import study
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import statistics
from scenefactory_jax.evaluation.metrics import agent_metrics
from scenefactory_jax.evaluation.records import read_records, select_rows
from scenefactory_jax.learning import run_folder, training_loop
from scenefactory_jax.visualization.report import plots, study_report

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

STUDIES = sorted(path.stem for path in (hydra_config.find_conf() / "study").glob("*.yaml") if path.stem != "base")
BASE = ["experiment=smoke", "worlds=2", "scenes.count=2", "scenes.heldout.count=2"]
BASE += ["~observations.road", "~observations.neighbours"]  # less to compile
TOY = {
    "base": [*BASE, "observations.ego._target_=support.study_parts.ego"],
    "common": ["evaluation.every=1"],
    "evaluation_overrides": ["timing.episode_s=1", "spawning=logged", "weather=dry", "traffic=none", "reward=paper"],
    "trainings": {"all scenes": [], "one scene": ["scenes.take.count=1"]},
    "conditions": {"dry": [], "at random": ["spawning=random_pairs", "weather=snow"]},
    "protocols": ["strict"],
    "evaluated": {"all scenes": ["dry", "at random"], "one scene": ["dry"]},
    "baselines": {
        "untrained": {"of": "all scenes", "overrides": [], "conditions": ["dry"], "seeds": None},
        "log replay": {"of": "all scenes", "overrides": ["dynamics=log_playback"], "conditions": ["dry"], "seeds": 1},
    },
    "compare": [["all scenes", "one scene"], ["untrained", "all scenes"]],
    "drops": [["dry", "at random"]],
    "figures": ["learning", "rates", "matrix", "differences", "drops", "trend"],
    "trend": {"label": "training scenes", "values": {"one scene": 1, "all scenes": None}},
}
ALONE = {"trainings": {"all scenes": []}, "conditions": {"dry": []}, "evaluated": None, "baselines": {}, "compare": [], "trend": None}
ALONE |= {"figures": [], "drops": []}


def toy(folder, *overrides, **changes):
    """A study of seconds, on generated scenes."""
    settings = [f"runs={folder / 'runs'}", f"out={folder / 'out'}", "seeds=[3,4]", "progress=false", "evaluation.bootstrap=20"]
    found = hydra_config.load_config("study", "study=navigation", *settings, "evaluation.chunk_steps=30", *overrides)
    found["study"] = {**found["study"], **TOY, **changes}
    return found


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A whole study: its folder, its result, and how often its programs had been traced after each training."""
    folder, counts, train_run = tmp_path_factory.mktemp("study"), [], command._train

    def counted(*arguments):
        note = train_run(*arguments)
        counts.append(len(study_parts.TRACES))
        return note

    study_parts.TRACES.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "_train", counted)
        return folder, study(toy(folder)), counts


@pytest.fixture
def stub_training(monkeypatch, request):
    """Trainings that lock and write their folders as real ones do, and compute nothing: a list of (seed, resumed) as they begin."""
    begun, stops = [], request.node.name.startswith("test_a_stopped")

    def train(config, **_):
        with run_folder.open_run_folder(config) as (folder, _):
            begun.append((config["seed"], config["resume"]))
            run_config.write(folder, config)
            row = {"iteration": 1, "steps/total": 10, "minutes": 0.1, "casps": 100.0}
            (folder / "metrics.csv").write_text(",".join(row) + "\n" + ",".join(map(str, row.values())) + "\n")
            if len(begun) == 2 and stops:
                raise KeyboardInterrupt
        return training_loop.Run(folder, config, None, None, None, [row])

    monkeypatch.setattr(training_loop, "train", train)
    monkeypatch.setattr(training_loop, "prepare", lambda config: training_loop.Prepared(None, None, None, None))
    monkeypatch.setattr(command.Session, "training_scenes", lambda *_: None)
    monkeypatch.setattr(command.checkpoint, "drop_training_state", lambda *_: None)
    return begun


# ---- what a study leaves


def test_a_study_leaves_all_rows(done):
    folder, result, _ = done
    assert result["missing"] == [] and len(list((folder / "runs").glob("*/trained.json"))) == 4
    places = [(row["condition"], row["row"], row["seeds"]) for row in result["rows"]]
    dry = [("dry", name, [3, 4]) for name in ("all scenes", "one scene", "untrained")]
    assert places == [*dry, ("dry", "log replay", [3]), ("at random", "all scenes", [3, 4])]
    runs = {variant: trained["runs"]["3"] for variant, trained in result["trainings"].items()}
    assert [run["scenes"] for run in runs.values()] == [2, 1] and all(run["iterations"] == 2 for run in runs.values())
    curves = result["trainings"]["one scene"]["held_out"]["strict"]
    assert list(curves) == ["3", "4"] and len(curves["3"]["success"]) == 2 and curves["3"]["to_final"] is not None


def test_numbers_are_those_of_the_records(done):
    folder, result, _ = done
    plan = study_plan.make(toy(folder))
    own = {e.training.seed: read_records(e.file) for e in plan.evaluations if (e.row, e.condition) == ("one scene", "dry")}
    row = next(row for row in result["rows"] if row["row"] == "one scene")
    rate = statistics.summarise_runs(own, bootstrap=20, seed=1000)["road_edge_rate"]
    assert row["pooled"]["road_edge_rate"]["value"] == pytest.approx(rate.value, rel=1e-4)
    for seed, records in own.items():
        assert row["each"][str(seed)]["mean_remaining_m"] == pytest.approx(records["end_distance_m"].mean(), rel=1e-4)
    assert {(one["before"], one["after"], one["condition"]) for one in result["differences"]} == {
        ("all scenes", "one scene", "dry"), ("untrained", "all scenes", "dry")}  # fmt: skip


def test_the_report_shows_what_it_rests_on_and_no_path_of_this_machine(done):
    folder, result, _ = done
    text = (folder / "out" / "navigation.md").read_text()
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(shown) == 7 and all((folder / "out" / name).stat().st_size > 5000 for name in shown)
    assert "Collision rate" in text and "Clean success rate" in text and "| all scenes | 3 | 2 (" in text
    assert str(folder) not in text and str(folder) not in (folder / "out" / "result.json").read_text()
    assert result["made_with"]["commit"] in text and result["made_with"]["jax"] == jax.__version__
    assert "| dry | logged | dry | none | as trained |" in text and "| at random | random_pairs | snow | none | as trained |" in text
    ends = [one["change"][name] for one in result["differences"] for name in study_report.CHANGES]
    without_zero = sum(end["low"] is not None and not end["low"] <= 0 <= end["high"] for end in ends)
    counted = sum(end["low"] is not None for end in ends)
    assert f"{counted / 20:.1f} of the {counted} in this table. {without_zero} of them do" in text
    assert "evaluated on the recipe's own: the test scenes." in text


def test_every_agent_is_listed_beside_the_report(done):
    """The tables give the report's own numbers, and are small enough for a repository."""
    folder, result, _ = done
    text = (folder / "out" / "navigation.md").read_text()
    tables = {row["agents_file"].split("/")[1] for row in result["rows"]}
    parquet = {name.replace(".csv.xz", ".parquet") for name in tables}
    assert {path.name for path in (folder / "out" / "agents").iterdir()} == tables | parquet
    for row in result["rows"]:
        file = folder / "out" / row["agents_file"]
        agents = read_records(file)
        runs = {seed: select_rows(agents, agents["training_seed"] == seed) for seed in row["seeds"]}
        assert sum(len(one["scene"]) for one in runs.values()) == len(agents["scene"]) and {"surface", "failure"} <= set(agents)
        found = statistics.summarise_runs(runs, bootstrap=20, seed=1000)
        for name in ("success_rate", "collision_rate", "mean_max_drac", "mean_time_to_goal_s"):
            reported = row["pooled"][name]["value"]
            assert found[name].value == (reported if reported is None else pytest.approx(reported, rel=1e-3)), name
        assert f"({row['agents_file']})" in text and file.stat().st_size < 200 * len(agents["scene"]) + 2000


def test_uses_of_the_held_out_scenes_are_counted_over_all_calls(done):
    """9 evaluations of policies, and a point after each of two iterations of four trainings, in the one call that did something."""
    folder, result, _ = done
    [use] = result["held_out_uses"]
    assert (use["policies"], use["curve points"], use["cut"]) == (9, 8, "test")
    assert "9 times for a policy" in (folder / "out" / "navigation.md").read_text()


def test_results_give_banks_by_their_names():
    banks, overrides = {"town": "/data/town", "womd": "/data/town/2"}, ["stream.banks.a=/data/town/2", "x=/data/town", "name=/data/towns"]
    named = study_results._name_banks({"rows": [{"overrides": overrides, "count": 2}]}, banks)
    assert named == {"rows": [{"overrides": ["stream.banks.a=${banks.womd}", "x=${banks.town}", "name=/data/towns"], "count": 2}]}


@pytest.mark.slow
def test_a_report_is_drawn_again_from_its_numbers(done, tmp_path):
    """With the interpretation that lies beside them now."""
    folder, result, _ = done
    shutil.copytree(folder / "out", tmp_path / "out")
    (tmp_path / "out" / "learning.png").unlink()
    (tmp_path / "out" / study_report.INTERPRETATION).write_text("What it shows.\n")
    assert study(toy(tmp_path, "parts=draw")) == result and not (tmp_path / "runs").exists()
    before, after = ((place / "out" / "navigation.md").read_text().splitlines() for place in (folder, tmp_path))
    assert [line for line in after if line not in before] == ["What it shows."] and (tmp_path / "out" / "learning.png").is_file()
    with pytest.raises(ConfigError, match=r"result\.json not found in .*nowhere"):
        study(toy(tmp_path, "parts=draw") | {"out": str(tmp_path / "nowhere")})
    with pytest.raises(ConfigError, match=r"expected `draw` alone"):
        study(toy(tmp_path, "parts=[draw,train]"))
    with pytest.raises(ConfigError, match="parts"):
        study(toy(tmp_path) | {"parts": None})


def test_a_report_of_a_validation_cut_says_so_and_how_to_repeat_it(done, tmp_path, undrawn_figures):
    folder, result, _ = done
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text(json.dumps(result | {"settings": result["settings"] | {"cut": "validation"}}))
    study(toy(tmp_path, "parts=draw"))
    text = (tmp_path / "out" / "navigation.md").read_text()
    assert "are no test" in text and "study=navigation cut=validation train_scenes=..." in text
    assert "cut=" not in (folder / "out" / "navigation.md").read_text().split("How to repeat it")[1]


@pytest.mark.slow
def test_a_study_has_columns_of_its_own(done, tmp_path):
    folder, _, _ = done
    shutil.copytree(folder / "out", tmp_path / "out")
    study(toy(tmp_path, "parts=draw", metrics=["mean_remaining_m", "road_edge_rate", "nuplan_score"]))
    text = (tmp_path / "out" / "navigation.md").read_text()
    assert "|  | Condition | n | Remaining distance | Road-edge rate |" in text and "DRAC" not in text.split("## How to repeat")[0]
    assert "Remaining distance" in text.split("![")[0] and "nuPlan score" not in text.split("## Each seed")[0]
    names = [f"metrics-{name}-strict.png" for name in ("dry", "at-random")] + ["differences-strict.png"]
    assert all(f"({name})" in text and (tmp_path / "out" / name).stat().st_size > 5000 for name in names)
    with pytest.raises(ConfigError, match=r"study\.metrics.*expected names of success_rate, .*got 'beauty'"):
        study(toy(tmp_path, "parts=draw", metrics=["beauty"]))


def test_findings_are_those_that_holm_leaves_in_a_family():
    """0.02 is one of three comparisons under `dry`, and the only one under `wet`."""
    probabilities = [("dry", 0.02), ("dry", 0.001), ("dry", 0.6), ("wet", 0.02), ("wet", None)]
    changes = [{"condition": name, "protocol": "strict", "change": {"success_rate": {"p": p}}} for name, p in probabilities]
    assert study_report.find_findings(changes, ["success_rate", "accuracy"]) == {(place, "success_rate") for place in (0, 1, 3)}
    changes[0]["change"]["success_rate"]["p"] = 0.026
    assert (0, "success_rate") not in study_report.find_findings(changes, ["success_rate"])


def test_conditions_are_compared_within_each_row(done):
    """On the same agents and seeds, with the friction that was measured under them; Holm's families are rows."""
    folder, result, _ = done
    (drop,) = result["drops"]
    assert [drop[key] for key in ("before", "after", "row", "protocol")] == ["dry", "at random", "all scenes", "strict"]
    rows = {row["condition"]: row for row in result["rows"] if row["row"] == "all scenes"}
    assert rows["dry"]["friction"] > 1.0 and rows["at random"]["friction"] == pytest.approx(0.2, rel=0.02)
    for name in ("mean_time_to_goal_s", "mean_remaining_m"):
        values = [rows[condition]["pooled"].get(name, {}).get("value") for condition in ("dry", "at random")]
        if None not in values:
            assert drop["change"][name]["value"] == pytest.approx(values[1] - values[0], rel=1e-3)
    text = (folder / "out" / "navigation.md").read_text()
    assert "## Differences of conditions" in text and "| From | To | Row | Protocol |" in text
    given = (("a", 0.04), ("a", 0.5), ("b", 0.04))
    changes = [{"row": row, "protocol": "strict", "change": {"success_rate": {"p": p}}} for row, p in given]
    assert study_report.find_findings(changes, ["success_rate"], family="row") == {(2, "success_rate")}


def test_a_policy_by_name_is_a_row(tmp_path):
    """Its own config and weights, under the study's conditions; its records lie among the runs, and other weights are other records."""
    own = {"run": "drive", "overrides": ["actions.action_repeat=1", "+weather.hidden=true"]}
    given = {"policies": {"given": own}, "conditions": {"snow": ["weather=snow", "timing=waymax"]}, "compare": [["given", "all scenes"]]}
    entry = toy(tmp_path, "protocol=vmax", "test_scenes=test.bank", **{**ALONE, **given})
    plan = study_plan.make(entry)
    (one,) = [one for one in plan.evaluations if one.row == "given"]
    assert len(plan.trainings) == 2 and one.weights == study_plan.TRAINED and (one.training.folder / one.weights).is_dir()
    assert one.config["weather"]["hidden"] and one.config["actions"]["action_repeat"] == 1
    assert "friction_ahead" in one.config["observations"]
    assert one.file.parent.parent == tmp_path / "runs" and one.file.parent.name.startswith("given-") and command._is_ready(one)
    copy = tmp_path / "copy"
    shutil.copytree(one.training.folder, copy)
    next(path for path in (copy / "checkpoints").rglob("*") if path.is_file()).write_bytes(b"other")
    own["run"] = str(copy)
    (other,) = [one for one in study_plan.make(entry).evaluations if one.row == "given"]
    assert other.file.parent != one.file.parent
    with pytest.raises(ConfigError, match=r"study\.conditions\.snow: overrides: weather\.hiding: the run has no 'hiding' there"):
        own["overrides"] = ["weather.hiding=true"]
        study_plan.make(entry)


def test_a_condition_may_name_a_protocol(tmp_path):
    """Its settings, scores and terminations take the place of the study's; planners have their overrides of `evaluate`."""
    conditions = {"plain": ["timing=waymax"], "noisy": ["protocol=vmax_noise", "timing=waymax"]}
    plan = study_plan.make(toy(tmp_path, "protocol=vmax", **{**ALONE, "conditions": conditions, "planners": ["idm_route"]}))
    by_condition = {one.condition: one for one in plan.evaluations if one.row == "all scenes"}
    assert "noise" not in by_condition["plain"].scores and by_condition["noisy"].scores["noise"]["redraws"] == 8
    assert by_condition["noisy"].config["timing"]["control_hz"] == 10 and by_condition["noisy"].config["scenes"]["pack"]["agents"] == 1
    planner = next(one for one in plan.evaluations if one.row == "idm_route")
    assert planner.config["policy"]["_target_"].endswith("idm_route.make") and planner.weights == study_plan.UNTRAINED
    for changes, message in (
        ({"conditions": {"x": ["protocol=vmix"]}}, r"study\.conditions\.x: .*protocol"),
        ({"conditions": {"x": ["protocol=vmax"]}}, r"study\.conditions\.x: protocol=vmax has other planner_overrides"),
        ({"planners": ["pilot"]}, r"study\.planners: expected names of log, expert, .*got 'pilot'"),
    ):
        with pytest.raises(ConfigError, match=message):
            study_plan.make(toy(tmp_path, **{**ALONE, **changes}))


def test_a_result_of_other_runs_is_not_written_over_with_nothing(done, tmp_path, capsys, undrawn_figures):
    folder, result, _ = done
    shutil.copytree(folder / "out", tmp_path / "out")
    assert study(toy(tmp_path, "parts=report"))["rows"] == result["rows"]
    assert "are not changed" in capsys.readouterr().out
    assert (tmp_path / "out" / "result.json").read_bytes() == (folder / "out" / "result.json").read_bytes()


def test_an_interval_that_misses_its_value_is_drawn_up_to_it():
    odd = {name: statistics.Estimate(0.5, 0.55, 0.6, 9, agent_metrics.FRACTION, statistics.LEVELS) for name in plots.SHOWN_RATES}
    reach = [bars.get_segments() for axes in plots.rates_figure({"odd": odd}).axes for bars in axes.collections]
    assert len(reach) == len(plots.SHOWN_RATES) and all([end[0] for end in one[0]] == [0.5, 0.6] for one in reach)


# ---- nothing twice


def test_what_is_done_is_not_done_again(done, monkeypatch, undrawn_figures):
    folder, result, _ = done
    monkeypatch.setattr(training_loop, "train", lambda *a, **k: pytest.fail("trained again"))
    monkeypatch.setattr(command, "make_evaluator", lambda *a, **k: pytest.fail("evaluated again"))
    again = study(toy(folder))
    assert again["rows"] == result["rows"] and again["held_out_uses"] == result["held_out_uses"]
    other = toy(folder, f"out={folder / 'other'}", **{**ALONE, "name": "other"})  # what another study has done
    assert study({**other, "common": ["checkpoint_every=7"]})["rows"][0]["pooled"] == result["rows"][0]["pooled"]


def test_seeds_and_variants_share_their_programs(done):
    """After the first training nothing is traced again for other seeds and another number of scenes."""
    counts = done[2]
    assert counts[0] > 0 and counts == [counts[0]] * 4


def test_a_stopped_study_resumes_its_trainings(stub_training, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        study(toy(tmp_path, "parts=train", **ALONE))
    assert len(list((tmp_path / "runs").glob("*/trained.json"))) == 1 and len(list((tmp_path / "runs").iterdir())) == 2
    study(toy(tmp_path, "parts=train", **ALONE))
    assert stub_training == [(3, False), (4, False), (4, True)]
    assert len(list((tmp_path / "runs").glob("*/trained.json"))) == 2
    study(toy(tmp_path, "parts=train", **ALONE))
    assert len(stub_training) == 3


@pytest.mark.slow  # the same with real trainings, to the last bit; resumed runs are tests/cli/test_train's
def test_a_killed_study_gives_the_same_numbers(done, tmp_path, monkeypatch):
    from scenefactory_jax.loggers import metrics_csv

    folder, add, calls = done[0], metrics_csv.MetricsFile.add, []

    def killed(self, row):
        add(self, row)
        calls.append(1)
        if len(calls) == 7:  # two rows an iteration (metrics, held-out): within the second training
            raise KeyboardInterrupt

    monkeypatch.setattr(metrics_csv.MetricsFile, "add", killed)
    with pytest.raises(KeyboardInterrupt):
        study(toy(tmp_path, **ALONE))
    monkeypatch.undo()
    study(toy(tmp_path, **ALONE))
    files = sorted((tmp_path / "runs").glob("*/evaluated-*.csv"))
    assert len(files) == 2
    for file in files:
        [same] = (folder / "runs").glob(f"{file.parent.name}/{file.name}")
        assert file.read_bytes() == same.read_bytes()


def test_what_another_command_trains_is_left_to_it(stub_training, tmp_path, capsys):
    first, second = study_plan.make(toy(tmp_path, **ALONE)).trainings
    with run_folder.open_run_folder({**first.config, "out": str(first.folder)}):
        study(toy(tmp_path, "parts=train", **ALONE))
    assert "training all scenes, seed 3: left to the command that trains in" in capsys.readouterr().out
    assert not first.file.is_file() and second.file.is_file()


def test_tasks_are_divided_among_processes(stub_training, tmp_path):
    """What one process has claimed another does not do; the counts of all are added up."""
    config = toy(tmp_path, "parts=[train]", **ALONE)
    claims = tmp_path / "claims"
    claims.mkdir()
    plan = study_plan.make(config)
    first, second = plan.trainings
    command.TaskClaims(claims).take(f"{first.folder.name}-trained.json")
    assert command._run_claimed(1, "train", plan, config, claims, math.inf)
    assert stub_training == [(second.seed, False)] and not first.file.is_file()
    uses = command.HeldOutUses(tmp_path / "result.json", command="study", cut="test")
    for _ in range(2):
        uses.add({"policies": 1, "curve points": 2, "seconds": 0.5})
    [counted] = uses.read_result()["held_out_uses"]
    assert [counted[name] for name in command.COUNTS] == [2, 4, 1.0]


@pytest.mark.slow  # two processes compile a training and an evaluation each
def test_processes_divide_a_study_among_them(tmp_path, capfd):
    result = study(toy(tmp_path, "processes=2", "per_gpu=2", **ALONE))
    assert result["missing"] == [] and len(list((tmp_path / "runs").glob("*/trained.json"))) == 2
    assert result["rows"][0]["seeds"] == [3, 4]
    assert all(run["device"].endswith(", shared by 2") for run in result["trainings"]["all scenes"]["runs"].values())
    printed = capfd.readouterr().out
    assert [printed.count(f"training all scenes, seed {seed}\n") for seed in (3, 4)] == [1, 1]
    (uses,) = result["held_out_uses"]
    assert (uses["policies"], uses["curve points"]) == (2, 4) and uses["seconds"] > 0


@pytest.mark.slow  # two processes that import all of it; tests/core/test_gpu_processes has the errors of processes
def test_scenes_that_no_process_can_read_are_one_line(tmp_path):
    wrong = toy(tmp_path, "processes=2", "test_scenes=nowhere.bank", **ALONE)
    with pytest.raises(ConfigError, match=r"nowhere\.bank: no such file or folder"):
        study(wrong)


def test_a_study_stops_at_its_time_limit_and_says_what_is_missing(tmp_path, capsys):
    result = study(toy(tmp_path, "time_limit_s=0.0"))
    assert "stopped at the time limit" in capsys.readouterr().out and not (tmp_path / "runs").exists()
    assert len(result["missing"]) == 4 + 9 and "**Not complete**: 13 " in (tmp_path / "out" / "navigation.md").read_text()
    chosen = study(toy(tmp_path, "only=[one scene]", "parts=[report]"))["missing"]
    assert set(chosen) < set(result["missing"]) and len(chosen) == 2 + 2 and all("one scene" in label for label in chosen)


# ---- what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({**ALONE, "trainings": {"a": ["wrlds=3"]}}, r"study\.trainings\.a: wrlds: unknown key 'wrlds'; the top level has: "),
        ({**ALONE, "conditions": {"wet": ["weather=foggy"]}}, r"study\.conditions\.wet: .*Could not find 'weather/foggy'"),
        ({"evaluated": {"all scenes": ["drizzle"]}}, r"study\.evaluated\.all scenes: expected one of dry, at random, got 'drizzle'"),
        ({"compare": [["all scenes", "other"]]}, r"study\.compare\.0: expected one of all scenes, one scene, .*replay, got 'other'"),
        ({"drops": [["dry", "wet"]]}, r"study\.drops\.0: expected one of dry, at random, got 'wet'"),
        ({"drops": [["dry"]]}, r"study\.drops: expected pairs \[before, after\], got \['dry'\]"),
        ({"policies": {"all scenes": {"run": "drive", "overrides": []}}}, r"names that no other row has, got 'all scenes'"),
        ({"policies": {"x": {"run": "nowhere", "overrides": []}}}, r"study\.policies\.x: run: config\.yaml not found in nowhere"),
        ({"policies": {"x": {"run": "drive", "overrides": []}}}, r"study\.policies\.x: expected test_scenes=PATH, .*got null"),
        ({"compare": [["all scenes"]]}, r"study\.compare: expected pairs \[before, after\], got \['all scenes'\]"),
        ({"colour": "red"}, r"study\.colour: unknown key; valid: base, baselines"),
        ({"protocols": ["lenient"]}, r"study\.protocols: expected one or more of goal_only, rules, strict, vmax, whole, got \['lenient'\]"),
        ({"figures": ["pie"]}, r"study\.figures.*got 'pie'"),
        ({"baselines": {"f": {"of": "all scenes"}}}, r"study\.baselines\.f.*overrides"),
    ],
)
def test_wrong_keys_of_a_study_are_named(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        study(toy(tmp_path, **changes))
    assert not list(tmp_path.iterdir())


def test_wrong_keys_of_the_command_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"Available options:.*friction.*navigation"):
        hydra_config.load_config("study")
    messages = {"only=[bicycle]": r"only: expected one of all scenes, .*got 'bicycle'", "seeds=[1,1]": r"seeds: .*got \[1, 1\]"}
    for override, message in messages.items():
        with pytest.raises(ConfigError, match=message):
            study(toy(tmp_path, override))
    with pytest.raises(ConfigError, match=r"parts.*got 'trian'"):
        study(toy(tmp_path, "parts=trian"))


# ---- the studies of the paper


# As the paper's tables, and what a CPU evaluates
ONE_PROTOCOL = ("transfer", "friction", "winter", "floors", "network", "rewards", "recipe", "rewards_laptop", "network_laptop")


def steps_of(config):
    """Control steps that a training simulates, those of empty slots included."""
    assert config["minutes"] is None
    return math.prod([config["iterations"], config["worlds"], config["ppo"]["horizon"], config["actions"]["action_repeat"]])


TIMED = {"vmax": "vmax", "plants": "vmax", "scenarionet": "scenarionet", "curriculum": "scenarionet"}  # study -> its protocol
TIMED |= {"learners": "route100", "drive_rewards": "route100", "drive_collisions": "route100", "vmax_scenes": "vmax"}
STREAMED, ADVERSARIES = "recipe_drive", "adversaries"  # train on a mixture of banks and generated scenes, or of banks
WHOLE = [name for name in STUDIES if name not in (*TIMED, STREAMED, ADVERSARIES)]
TWINS = {"rewards_laptop", "network_laptop"}  # nearly the same variants as another study, for a CPU
LONG = {*TWINS, "floors", "friction", "recipe", "rewards"}  # many environments each


@pytest.mark.parametrize("name", sorted(TWINS))
def test_names_of_a_study_fit_each_other(name):
    study_plan.check(hydra_config.load_config("study", f"study={name}"))


@pytest.mark.slow  # test_train_learners and test_train build each learner and protocol
@pytest.mark.parametrize("name", sorted(TIMED))
def test_every_row_of_a_study_of_equal_time_builds(name, tmp_path):
    """Every learner finds its keys and its network, all judge by the study's protocol, and each row has its time."""
    entry = hydra_config.load_config("study", f"study={name}", f"runs={tmp_path}", "train_scenes=train.bank", "test_scenes=test.bank")
    plan = study_plan.make(entry | {"seeds": [0]})
    assert entry["protocol"]["name"] == TIMED[name] and {one.config["minutes"] for one in plan.trainings} == {entry_minutes(entry)}
    for one in {one.program: one for one in plan.trainings}.values():
        schema.check_train(one.config)
        training_loop.prepare(one.config)
    for one in {one.program: one for one in plan.evaluations}.values():
        environment.make_parts(one.config)
        assert (one.scores is None) == (TIMED[name] == "route100")
    kinds = {one.program: actor_of(one) for one in plan.evaluations if one.weights == study_plan.TRAINED}
    assert all(actor_of(one) == kinds.get(one.program) for one in plan.evaluations if one.program in kinds)
    assert not set(entry["study"]["planners"]) - {one.row for one in plan.evaluations}


def actor_of(evaluation):
    """What a learner's policy is built as; policies of before have no key `learner`."""
    return evaluation.config.get("learner", {}).get("actor")


def entry_minutes(entry):
    return next(float(word.partition("=")[2]) for word in entry["study"]["common"] if word.startswith("minutes="))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in LONG else []) for n in WHOLE])
def test_every_study_is_whole(name, tmp_path):
    """Every training and evaluation builds, and what is compared or drawn is evaluated."""
    entry = hydra_config.load_config("study", f"study={name}", f"runs={tmp_path}", "train_scenes=train.bank", "seeds=[0]")
    assert entry["study"]["protocols"] == ["goal_only"] + ["strict"] * (name not in ONE_PROTOCOL)
    plan = study_plan.make(entry | {"test_scenes": "it's.bank", "study": {**entry["study"], "protocols": ["strict"]}})
    assert entry["study"]["seeds"] == [0, 1, 2] and plan.trainings and plan.evaluations
    for built in {one.program: one.config for one in (*plan.trainings, *plan.evaluations)}.values():
        assert built["scenes"]["path"] == "train.bank" and built["scenes"]["heldout"]["path"] == "it's.bank"
        environment.make_parts(built)
    assert name == "longer" or len({steps_of(one.config) for one in plan.trainings}) == 1  # as much experience for all
    assert {one.config["spawning"]["respawn_clearance_m"] for one in plan.evaluations} == {None}  # one life a car


@pytest.mark.slow
def test_a_study_of_a_mixture_is_whole(tmp_path):
    """Every row takes one part of experiment=generalist away, judged with the same iterations; each comparison is with the recipe."""
    entry = hydra_config.load_config("study", f"study={STREAMED}", f"runs={tmp_path}", "test_scenes=test.bank", "seeds=[0]")
    plan = study_plan.make(study_plan.complete(entry))
    study = entry["study"]
    assert study["compare"] == [["recipe", name] for name in study["trainings"] if name != "recipe"]
    assert len({one.digest for one in plan.trainings}) == len(study["trainings"])
    for one in plan.trainings:
        banks = one.config["stream"]["banks"]
        assert one.config["scenes"]["path"] is None and banks == {name: entry["banks"][name] for name in ("womd", "womd_links")}
    assert len({steps_of(one.config) * one.config["scenes"]["pack"]["agents"] for one in plan.trainings}) == 1
    assert {one.condition for one in plan.evaluations} == set(study["conditions"]) and not any(one.scores for one in plan.evaluations)
    for built in {one.program: one.config for one in plan.evaluations if one.condition == "grip 0.15"}.values():
        assert built["scenes"]["pack"]["starts"]["mu"] == built["weather"]["friction"]["surfaces"]["ICE"]["mu"] == 0.15
    for one in {one.program: one for one in plan.trainings}.values():
        environment.make_parts(one.config)


def test_a_study_of_adversaries_meets_them(tmp_path):
    """Only the recording car is an agent, everybody else is as recorded and in time with it, and the rows differ by their scenes alone."""
    words = ["banks.adversarial=found.bank", "test_scenes=test.bank", "common=[start_from=drive]", "seeds=[0]"]
    plan = study_plan.make(hydra_config.load_config("study", f"study={ADVERSARIES}", f"runs={tmp_path}", *words))
    plain, both = (one.config for one in plan.trainings)
    assert both["stream"]["shares"]["womd_links"] > 0 and plain["stream"]["shares"] == {"womd": 1.0, "womd_links": None, "generator": None}
    assert both["stream"]["banks"]["womd_links"] == "found.bank" and {**both, "stream": plain["stream"], "name": plain["name"]} == plain
    assert both["scenes"]["pack"]["agents"] == 1 and both["traffic"]["members"] == ["log"]
    starts = [name for name, part in both["spawning"]["sampler"]["parts"].items() if part]
    assert both["spawning"]["respawn_clearance_m"] is None and starts == ["recorded"]
    environment.make_parts(both)
    assert {one.row for one in plan.evaluations} == {"before", "plain scenes", "adversarial scenes, too"}


def test_protocols_are_the_conditions_of_the_readmes_rows(tmp_path):
    """`recorded` and `strict` judge as navigation's first condition does, `paper` as its second: by name what the study spells out."""
    entry = hydra_config.load_config("study", "study=navigation", f"runs={tmp_path}", "seeds=[0]")
    conditions = {"recorded": "original", "strict": "original", "paper": "original, from rest"}
    plan = study_plan.make(entry)
    for name, condition in conditions.items():
        asked = hydra_config.load_config("evaluate", "run=x", f"protocol={name}")
        rows = [one for one in plan.evaluations if (one.row, one.condition) == ("rigid body", condition)]
        assert {one.protocol for one in rows} >= set(asked["protocol"]["termination"])
        expected = hydra_config.apply_overrides(rows[0].training.config, hydra_config.list_overrides(asked["protocol"]["settings"]))
        assert rows[0].config | {"termination": None} == expected | {"termination": None}
        assert [asked[key] for key in entry["evaluation"]] == list(entry["evaluation"].values())


def test_other_scenes_of_the_same_path_are_another_study(tmp_path):
    (tmp_path / "files").mkdir()
    bank = tmp_path / "test.bank"
    bank.mkdir()
    index = json.dumps({"format": bank_index.FORMAT, "shards": []})
    entry = toy(tmp_path, "train_scenes=" + str(tmp_path / "files"), f"test_scenes={bank}", **ALONE)
    found = []
    for content in ("one", "another", "another"):
        (tmp_path / "files" / "a.json").write_text(content)
        os.utime(tmp_path / "files" / "a.json", ns=(0, 0))
        (bank / bank_index.INDEX).write_text(index if content == "one" else index.replace("[]", '["new"]'))
        plan = study_plan.make(entry)
        found.append((plan.trainings[0].digest, plan.evaluations[0].program))
    assert found[0][0] != found[1][0] and found[0][1] != found[1][1] and found[1] == found[2]


def test_a_training_from_other_networks_is_another(tmp_path):
    entry = toy(tmp_path, "train_scenes=train.bank", "test_scenes=test.bank", **ALONE)
    words = [], ["start_from=null"], ["start_from=drive"]
    plain, null, tuned = (study_plan.make({**entry, "common": one}).trainings[0] for one in words)
    assert plain.digest == null.digest != tuned.digest and plain.program == tuned.program


def test_rewards_without_ranges_change_no_program_of_evaluations(tmp_path):
    """No evaluation reads a reward; a policy may observe the weights of one with ranges."""
    entry = toy(tmp_path, "train_scenes=train.bank", "test_scenes=test.bank", **ALONE, evaluation_overrides=["timing.episode_s=1"])
    words = [], ["reward.goal.weight=9.0"], ["reward.goal.weight=[1.0,9.0]"]
    plain, other, ranged = (study_plan.make({**entry, "common": one}) for one in words)
    assert plain.trainings[0].program != other.trainings[0].program
    assert plain.evaluations[0].program == other.evaluations[0].program != ranged.evaluations[0].program


@pytest.mark.parametrize("is_bank", [True, False])
def test_readers_of_formats_change_no_study_of_banks(tmp_path, is_bank):
    """A version that reads one format more finds what was trained before."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / (bank_index.INDEX if is_bank else "a.json")).write_text(json.dumps({"format": bank_index.FORMAT, "shards": []}))
    entry = toy(tmp_path, f"train_scenes={tmp_path / 'scenes'}", f"test_scenes={tmp_path / 'scenes'}", **ALONE)
    before, after = (study_plan.make({**entry, "common": [f"scenes.formats.nuplan.current={step}"]}) for step in (10, 11))
    assert (before.trainings[0].digest == after.trainings[0].digest) == is_bank
    assert (before.evaluations[0].program == after.evaluations[0].program) == is_bank


@pytest.mark.parametrize(
    ("name", "base"),
    [
        pytest.param("network", "experiment=smoke", marks=pytest.mark.slow),  # test_heads has the policy of the config
        pytest.param("recipe", "experiment=quick,worlds=2", marks=pytest.mark.slow),  # scenes of the recipe's size
        pytest.param("network_laptop", "experiment=laptop,scenes.take.count=1", marks=pytest.mark.slow),  # observations as in network
    ],
)
def test_networks_of_the_studies_fit_their_observations(name, base):
    plan = study_plan.make(hydra_config.load_config("study", f"study={name}", "seeds=[0]", f"study.base=[{base},scenes.count=1]"))
    scene = scene_source.load_training_scenes(plan.trainings[0].config["scenes"])[0]
    networks = {json.dumps([one.config["observations"], one.config["policy"]]): one.config for one in plan.trainings}
    for entry in networks.values():
        env, policy = environment.make_env(entry), training_loop.make_policy(entry)
        observed = jax.eval_shape(env.reset, jax.random.key(0), scene)[1]
        jax.eval_shape(policy.init, jax.random.key(0), observed)


@pytest.mark.parametrize(
    "alike", [{"transfer": "rigid body", "diversity": "all scenes"}, {"rewards": "all terms", "network": "as is"}], ids=" ".join
)
def test_studies_share_what_they_train_alike(alike, tmp_path):
    same = set()
    for name, variant in alike.items():
        entry = hydra_config.load_config("study", f"study={name}", f"runs={tmp_path}", "seeds=[1]")
        entry["study"]["trainings"] = {variant: entry["study"]["trainings"][variant]}
        plan = study_plan.make(entry | {"study": {**entry["study"], "compare": [], "trend": None, "baselines": {}}})
        same |= {one.digest for one in plan.trainings}
    assert len(same) == 1


def test_a_condition_by_a_protocol_of_other_episodes_is_refused(tmp_path):
    entry = toy(tmp_path, **{**ALONE, "conditions": {"dry": ["protocol=wosac"]}})
    with pytest.raises(ConfigError, match=r"study\.conditions\.dry: protocol=wosac has other repeats than the study's protocol"):
        study_plan.make(entry)


def test_overrides_within_overrides_are_written_out(tmp_path):
    entry = toy(tmp_path, **{**ALONE, "trainings": {"all scenes": [[["ppo.gamma=0.5"], "ppo.clip_eps=0.1"], "ppo.gamma=0.6"]}})
    training, _ = study_plan.make(entry).trainings
    assert training.config["ppo"]["gamma"] == 0.6 and training.config["ppo"]["clip_eps"] == 0.1


def test_later_overrides_win():
    assert study_plan.merge_overrides(["a=1", "b.c=2", "a=3", "~d", "+b.c=4"]) == ["a=3", "~d", "+b.c=4"]


# ---- subsets of scenes


def test_fewer_scenes_of_one_seed_are_a_part_of_more():
    entry = lambda *own: hydra_config.load_config("train", "experiment=smoke", "scenes.count=4", *own)["scenes"]  # noqa: E731
    everything = scene_source.load_training_scenes(entry())
    take = lambda *own: scene_source.take_scenes(everything, entry(*own))  # noqa: E731
    some = [set(take("seed=5", f"scenes.take.count={count}").names) for count in (1, 2, 3)]
    assert [len(names) for names in some] == [1, 2, 3] and some[0] < some[1] < some[2] < set(everything.names)
    fixed = take("seed=1", "scenes.take.count=3", "scenes.take.seed=5")
    assert set(fixed.names) == some[2] and "3 of the 4 scenes" in fixed.account
    shapes = [[leaf.shape[1:] for leaf in jax.tree.leaves(scenes.scene)] for scenes in (fixed, everything)]
    assert shapes[0] == shapes[1]  # so that programs are the same
    with pytest.raises(ConfigError, match=r"scenes\.take\.count: 7, but there are 4 scenes"):
        take("scenes.take.count=7")
    assert json.dumps(hydra_config.load_config("train")["scenes"]["take"]) == '{"count": null, "seed": 0}'
