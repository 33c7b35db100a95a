"""Whole studies at the smallest size: they end, go on where they were stopped, do nothing twice, compile once, say what they rest on."""

import json
import math
import os
import re
import shutil

import jax
import pytest
from support import study_parts

from scenefactory_jax.cli import hydra_config, study_plan
from scenefactory_jax.cli import study as command
from scenefactory_jax.cli.study import Clock, study
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import agent_metrics, hierarchical_bootstrap
from scenefactory_jax.learning import run_folder, training_loop
from scenefactory_jax.loggers import metrics_csv
from scenefactory_jax.visualization.report import study_figures
from scenefactory_jax.visualization.report import study_report as report

pytestmark = pytest.mark.usefixtures("quickly")

STUDIES = sorted(path.stem for path in (hydra_config.find_conf() / "study").glob("*.yaml") if path.stem != "base")
TOY = {
    "base": [
        "experiment=smoke", "worlds=2", "scenes.count=2", "scenes.heldout.count=2", "observations.ego._target_=support.study_parts.ego"],
    "common": ["evaluation.every=1"],
    "examined": ["timing.episode_s=1", "spawning=logged", "weather=dry", "traffic=none", "reward=paper"],
    "trainings": {"all terms": [], "one scene": ["scenes.take.count=1"], "no TTC": ["reward.ttc=null", "ppo.learning_rate=1.0e-2"]},
    "conditions": {"dry": [], "at random": ["spawning=random_pairs", "weather=snow"]},
    "protocols": ["strict"],
    "judged": {"all terms": ["dry", "at random"], "one scene": ["dry"], "no TTC": ["dry"]},
    "floors": {
        "untrained": {"of": "all terms", "overrides": [], "conditions": ["dry"], "seeds": None},
        "log replay": {"of": "all terms", "overrides": ["dynamics=log_playback"], "conditions": ["dry"], "seeds": 1},
    },
    "compare": [["all terms", "no TTC"], ["untrained", "all terms"]],
    "figures": ["learning", "rates", "matrix", "differences", "trend"],
    "trend": {"label": "training scenes", "values": {"one scene": 1, "all terms": None}},
}
ALONE = {"trainings": {"all terms": []}, "conditions": {"dry": []}, "judged": None, "floors": {}, "compare": [], "trend": None}
ALONE |= {"figures": []}


def toy(folder, *overrides, **changes):
    """A study of seconds, on generated scenes."""
    settings = [f"runs={folder / 'runs'}", f"out={folder / 'out'}", "seeds=[3,4]", "progress=false", "evaluation.bootstrap=20"]
    found = hydra_config.load_config("study", "study=navigation", *settings, "evaluation.chunk_steps=30", *overrides)
    found["study"] = {**found["study"], **TOY, **changes}
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return folder, study(toy(folder))


# ---- what a study leaves


def test_a_study_ends_with_everything_that_it_wants(whole):
    folder, result = whole
    assert result["missing"] == [] and len(list((folder / "runs").glob("*/trained.json"))) == 6
    places = [(row["condition"], row["row"], row["seeds"]) for row in result["rows"]]
    dry = [("dry", name, [3, 4]) for name in ("all terms", "one scene", "no TTC", "untrained")]
    assert places == [*dry, ("dry", "log replay", [3]), ("at random", "all terms", [3, 4])]
    runs = {variant: trained["runs"]["3"] for variant, trained in result["trainings"].items()}
    assert [run["scenes"] for run in runs.values()] == [2, 1, 2] and all(run["iterations"] == 2 for run in runs.values())
    watched = result["trainings"]["no TTC"]["held_out"]["strict"]
    assert list(watched) == ["3", "4"] and len(watched["3"]["success"]) == 2 and watched["3"]["to_final"] is not None


def test_numbers_are_those_of_the_records(whole):
    folder, result = whole
    plan = study_plan.make(toy(folder))
    own = {one.training.seed: agent_metrics.read_csv(one.file) for one in plan.judgings if (one.row, one.condition) == ("no TTC", "dry")}
    row = next(row for row in result["rows"] if row["row"] == "no TTC")
    rate = hierarchical_bootstrap.summarise(own, bootstrap=20, seed=1000)["road_edge_rate"]
    assert row["pooled"]["road_edge_rate"]["value"] == pytest.approx(rate.value, rel=1e-4)
    for seed, records in own.items():
        assert row["each"][str(seed)]["mean_remaining_m"] == pytest.approx(records["end_distance_m"].mean(), rel=1e-4)
    assert {(one["before"], one["after"], one["condition"]) for one in result["differences"]} == {
        ("all terms", "no TTC", "dry"), ("untrained", "all terms", "dry")}  # fmt: skip


def test_the_report_shows_what_it_rests_on_and_no_place_of_this_machine(whole):
    folder, result = whole
    text = (folder / "out" / "navigation.md").read_text()
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(shown) == 6 and all((folder / "out" / name).stat().st_size > 5000 for name in shown)
    assert "Collision rate" in text and "Clean success rate" in text and "| all terms | 3 | 2 (" in text
    assert str(folder) not in text and str(folder) not in (folder / "out" / "result.json").read_text()
    assert result["made_with"]["commit"] in text and result["made_with"]["jax"] == jax.__version__
    assert "| dry | logged | dry | ignore | as trained |" in text and "| at random | random_pairs | snow | ignore | as trained |" in text
    ends = [one["change"][name] for one in result["differences"] for name in report.CHANGES]
    without_zero = sum(end["low"] is not None and not end["low"] <= 0 <= end["high"] for end in ends)
    counted = sum(end["low"] is not None for end in ends)
    assert f"{counted / 20:.1f} of the {counted} in this table. {without_zero} of them do" in text
    assert "judged on the recipe's own: the test scenes." in text and "chose no setting" not in text  # nothing here knows that


def test_every_agent_is_listed_beside_the_report(whole):
    """The tables give the report's own numbers, and are as small as a repository wants them."""
    folder, result = whole
    text = (folder / "out" / "navigation.md").read_text()
    assert {path.name for path in (folder / "out" / "agents").iterdir()} == {row["agents_file"].split("/")[1] for row in result["rows"]}
    for row in result["rows"]:
        file = folder / "out" / row["agents_file"]
        agents = agent_metrics.read_csv(file)
        runs = {seed: agent_metrics.select(agents, agents["training_seed"] == seed) for seed in row["seeds"]}
        assert sum(len(one["scene"]) for one in runs.values()) == len(agents["scene"]) and {"surface", "failure"} <= set(agents)
        found = hierarchical_bootstrap.summarise(runs, bootstrap=20, seed=1000)
        for name in ("success_rate", "collision_rate", "mean_max_drac", "mean_time_to_goal_s"):
            reported = row["pooled"][name]["value"]
            assert found[name].value == (reported if reported is None else pytest.approx(reported, rel=1e-3)), name
        assert f"({row['agents_file']})" in text and file.stat().st_size < 200 * len(agents["scene"]) + 2000


def test_looks_are_counted_over_all_calls(whole):
    """11 judgings of policies, and a point after each of two iterations of six trainings, in the one call that did something."""
    folder, result = whole
    [look] = result["looks"]
    assert (look["policies"], look["curve points"], look["cut"]) == (11, 12, "test")
    assert "11 times to judge a policy" in (folder / "out" / "navigation.md").read_text()


def test_a_report_is_drawn_anew_from_its_numbers(whole, tmp_path):
    folder, result = whole
    shutil.copytree(folder / "out", tmp_path / "out")
    (tmp_path / "out" / "learning.png").unlink()
    again = study(toy(tmp_path, "parts=draw", reading="What it shows."))
    assert again == result | {"study": result["study"] | {"reading": "What it shows."}} and not (tmp_path / "runs").exists()
    before, after = ((place / "out" / "navigation.md").read_text().splitlines() for place in (folder, tmp_path))
    assert [line for line in after if line not in before] == ["What it shows."] and (tmp_path / "out" / "learning.png").is_file()
    with pytest.raises(ConfigError, match=r"nowhere: no result\.json to draw"):
        study(toy(tmp_path, "parts=draw") | {"out": str(tmp_path / "nowhere")})
    with pytest.raises(ConfigError, match=r"`draw` stands alone"):
        study(toy(tmp_path, "parts=[draw,train]"))
    with pytest.raises(ConfigError, match="parts"):
        study(toy(tmp_path) | {"parts": None})


def test_a_report_of_a_validation_cut_says_so_and_how_to_make_it_again(whole, tmp_path):
    folder, result = whole
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text(json.dumps(result | {"settings": result["settings"] | {"cut": "validation"}}))
    study(toy(tmp_path, "parts=draw"))
    text = (tmp_path / "out" / "navigation.md").read_text()
    assert "are no test" in text and "study=navigation cut=validation train_scenes=..." in text
    assert "cut=" not in (folder / "out" / "navigation.md").read_text().split("To do it again")[1]


def test_a_result_of_other_runs_is_not_written_over_with_nothing(whole, tmp_path, capsys):
    folder, result = whole
    shutil.copytree(folder / "out", tmp_path / "out")
    assert study(toy(tmp_path, "parts=report"))["rows"] == result["rows"]
    assert "stay as they are" in capsys.readouterr().out
    assert (tmp_path / "out" / "result.json").read_bytes() == (folder / "out" / "result.json").read_bytes()


def test_an_interval_that_misses_its_value_is_drawn_up_to_it():
    odd = {name: agent_metrics.Estimate(0.5, 0.55, 0.6, 9, agent_metrics.SHARE, agent_metrics.LEVELS) for name in study_figures.SHOWN}
    whole = study_figures._bars({"odd": odd}, {"odd": "#cc3311"})
    reach = [bars.get_segments() for axes in whole.axes for bars in axes.collections]
    assert len(reach) == len(study_figures.SHOWN) and all([end[0] for end in one[0]] == [0.5, 0.6] for one in reach)


# ---- nothing twice


def test_what_is_done_is_not_done_again(whole, monkeypatch):
    folder, result = whole
    monkeypatch.setattr(training_loop, "train", lambda *a, **k: pytest.fail("trained again"))
    monkeypatch.setattr(command, "make_examiner", lambda *a, **k: pytest.fail("judged again"))
    again = study(toy(folder))
    assert again["rows"] == result["rows"] and again["looks"] == result["looks"]
    other = toy(folder, f"out={folder / 'other'}", **{**ALONE, "name": "other"})  # what another study has done
    assert study({**other, "common": ["checkpoint_every=7"]})["rows"][0]["pooled"] == result["rows"][0]["pooled"]


def test_seeds_and_variants_share_their_programs(tmp_path):
    """With more seeds and another number of scenes nothing is traced anew: the same count as for one seed of one variant."""
    counts = []
    for seeds, variants in (("[0]", {"a": []}), ("[0,1,2]", {"a": [], "b": ["scenes.take.count=1"]})):
        study_parts.TRACES.clear()
        study(toy(tmp_path / str(len(counts)), f"seeds={seeds}", **{**ALONE, "trainings": variants}))
        counts.append(len(study_parts.TRACES))
    assert counts[0] > 0 and counts[1] == counts[0]


def test_a_killed_study_goes_on_to_the_same_numbers(whole, tmp_path, monkeypatch):
    folder, _ = whole
    add, calls = metrics_csv.MetricsFile.add, []

    def killed(self, row):
        add(self, row)
        calls.append(1)
        if len(calls) == 7:  # two rows an iteration (metrics, held-out): within the second training
            raise KeyboardInterrupt

    monkeypatch.setattr(metrics_csv.MetricsFile, "add", killed)
    with pytest.raises(KeyboardInterrupt):
        study(toy(tmp_path, **ALONE))
    monkeypatch.undo()
    assert len(list((tmp_path / "runs").glob("*/trained.json"))) == 1 and len(list((tmp_path / "runs").iterdir())) == 2
    study(toy(tmp_path, **ALONE))
    files = sorted((tmp_path / "runs").glob("*/judged-*.csv"))
    assert len(files) == 2
    for file in files:
        [same] = (folder / "runs").glob(f"{file.parent.name}/{file.name}")
        assert file.read_bytes() == same.read_bytes()


def test_what_another_command_trains_is_left_to_it(tmp_path, capsys):
    first, second = study_plan.make(toy(tmp_path, **ALONE)).trainings
    with run_folder.open_run_folder({**first.config, "out": str(first.folder)}):
        result = study(toy(tmp_path, **ALONE))
    assert "training all terms, seed 3: left to the command that trains in" in capsys.readouterr().out
    assert not command.is_trained(first) and command.is_trained(second) and result["rows"][0]["seeds"] == [4]


def test_processes_divide_a_study_among_them(tmp_path, capfd):
    result = study(toy(tmp_path, "processes=2", "per_gpu=2", **ALONE))
    assert result["missing"] == [] and len(list((tmp_path / "runs").glob("*/trained.json"))) == 2
    assert result["rows"][0]["seeds"] == [3, 4]
    assert all(run["device"].endswith(", shared by 2") for run in result["trainings"]["all terms"]["runs"].values())
    printed = capfd.readouterr().out
    assert [printed.count(f"training all terms, seed {seed}\n") for seed in (3, 4)] == [1, 1]
    (looks,) = result["looks"]
    assert (looks["policies"], looks["curve points"]) == (2, 4) and looks["seconds"] > 0


def test_a_process_that_fails_is_told_once_the_others_are_done(tmp_path):
    wrong = toy(tmp_path, "processes=2", "test_scenes=nowhere.bank", **ALONE)
    with pytest.raises(RuntimeError, match="2 of 2 processes ended with an error"):
        study(wrong)


def test_a_study_stops_in_time_and_tells_what_is_missing(tmp_path, capsys):
    result = study(toy(tmp_path, "until_s=0.0"))
    assert "training all terms, seed 3: would take" in capsys.readouterr().out and not (tmp_path / "runs").exists()
    assert len(result["missing"]) == 6 + 11 and "**Not complete**: 17 " in (tmp_path / "out" / "navigation.md").read_text()
    assert Clock(None).fits(1e9, what="") and Clock(100.0).fits(50.0, what="")
    assert Clock(100.0).fits(1000.0, what="")  # would never fit: it goes on from its checkpoint
    late = Clock(100.0)
    late._begun -= 60.0
    assert late.fits(30.0, what="") and not late.fits(50.0, what="judging")


# ---- what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({**ALONE, "trainings": {"a": ["wrlds=3"]}}, r"study\.trainings\.a: wrlds: unknown key 'wrlds'; the top level has: "),
        ({**ALONE, "conditions": {"wet": ["weather=foggy"]}}, r"study\.conditions\.wet: .*Could not find 'weather/foggy'"),
        ({"judged": {"all terms": ["drizzle"]}}, r"study\.judged\.all terms: unknown 'drizzle'; valid: dry, at random"),
        ({"compare": [["all terms", "nobody"]]}, r"study\.compare\.0: unknown 'nobody'; valid: all terms, one scene, .*log replay"),
        ({"compare": [["all terms"]]}, r"study\.compare: \['all terms'\]; wanted are pairs"),
        ({"colour": "red"}, r"study\.colour: unknown key; valid: name, question"),
        ({"protocols": ["lenient"]}, r"study\.protocols: \['lenient'\]; valid: one or more of goal_only, strict"),
        ({"figures": ["pie"]}, r"study\.figures: \['pie'\]"),
        ({"floors": {"f": {"of": "all terms"}}}, r"study\.floors\.f\.overrides: missing"),
    ],
)
def test_wrong_keys_of_a_study_are_named(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        study(toy(tmp_path, **changes))
    assert not list(tmp_path.iterdir())


def test_wrong_keys_of_the_command_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"Available options:.*friction.*navigation"):
        hydra_config.load_config("study")
    for override, message in {"only=[bicycle]": r"only: unknown 'bicycle'; valid: all terms", "seeds=[1,1]": r"seeds: \[1, 1\]"}.items():
        with pytest.raises(ConfigError, match=message):
            study(toy(tmp_path, override))
    with pytest.raises(ConfigError, match=r"parts: \['trian'\]"):
        study(toy(tmp_path, "parts=trian"))


# ---- the studies of the paper


# As the paper's tables, and what a CPU judges
ONE_PROTOCOL = ("transfer", "friction", "winter", "floors", "network", "rewards", "recipe", "rewards_laptop", "network_laptop")


def steps_of(config):
    """Control steps that a training simulates, those of empty slots included."""
    assert config["minutes"] is None
    return math.prod([config["iterations"], config["worlds"], config["ppo"]["horizon"], config["actions"]["action_repeat"]])


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_is_whole(name, tmp_path):
    """Every training and judging builds, and whatever is compared or drawn is judged."""
    entry = hydra_config.load_config("study", f"study={name}", f"runs={tmp_path}", "train_scenes=train.bank", "seeds=[0]")
    assert entry["study"]["protocols"] == ["goal_only"] + ["strict"] * (name not in ONE_PROTOCOL)
    plan = study_plan.make(entry | {"test_scenes": "it's.bank", "study": {**entry["study"], "protocols": ["strict"]}})
    assert entry["study"]["seeds"] == [0, 1, 2] and plan.trainings and plan.judgings
    for built in {one.program: one.config for one in (*plan.trainings, *plan.judgings)}.values():
        assert built["scenes"]["path"] == "train.bank" and built["scenes"]["heldout"]["path"] == "it's.bank"
        environment.make_parts(built | {"termination": hydra_config.load_config("task")["termination"]})
    assert name == "longer" or len({steps_of(one.config) for one in plan.trainings}) == 1  # as much experience for all
    assert {one.config["spawning"]["respawn_clearance_m"] for one in plan.judgings} == {None}  # one life a car


def test_protocols_are_the_conditions_of_the_readmes_rows(tmp_path):
    """`recorded` and `strict` judge as navigation's first condition does, `paper` as its second: by name what the study spells out."""
    entry = hydra_config.load_config("study", "study=navigation", f"runs={tmp_path}", "seeds=[0]")
    conditions = {"recorded": "original", "strict": "original", "paper": "original, from rest"}
    plan = study_plan.make(entry)
    for name, condition in conditions.items():
        asked = hydra_config.load_config("evaluate", "run=x", f"protocol={name}")
        rows = [one for one in plan.judgings if (one.row, one.condition) == ("rigid body", condition)]
        assert {one.protocol for one in rows} >= set(asked["protocol"]["termination"])
        assert rows[0].config == hydra_config.apply_overrides(rows[0].training.config, asked["protocol"]["settings"])
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
        found.append((plan.trainings[0].digest, plan.judgings[0].program))
    assert found[0][0] != found[1][0] and found[0][1] != found[1][1] and found[1] == found[2]


@pytest.mark.parametrize(
    ("name", "base"),
    [("network", "experiment=smoke"), ("recipe", "experiment=quick,worlds=2"), ("network_laptop", "experiment=laptop,scenes.take.count=1")],
)
def test_networks_of_the_studies_fit_their_observations(name, base):
    plan = study_plan.make(hydra_config.load_config("study", f"study={name}", "seeds=[0]", f"study.base=[{base},scenes.count=1]"))
    scene = scene_source.load_training_scenes(plan.trainings[0].config["scenes"])[0]
    networks = {json.dumps([one.config["observations"], one.config["policy"]]): one.config for one in plan.trainings}
    for entry in networks.values():
        env, policy = environment.make_env(entry), training_loop.make_policy(entry)
        seen = jax.eval_shape(env.reset, jax.random.key(0), scene)[1]
        jax.eval_shape(policy.init, jax.random.key(0), seen)


@pytest.mark.parametrize(
    "alike", [{"transfer": "rigid body", "diversity": "all scenes"}, {"rewards": "all terms", "network": "as is"}], ids=" ".join
)
def test_studies_share_what_they_train_alike(alike, tmp_path):
    same = set()
    for name, variant in alike.items():
        entry = hydra_config.load_config("study", f"study={name}", f"runs={tmp_path}", "seeds=[1]")
        entry["study"]["trainings"] = {variant: entry["study"]["trainings"][variant]}
        plan = study_plan.make(entry | {"study": {**entry["study"], "compare": [], "trend": None, "floors": {}}})
        same |= {one.digest for one in plan.trainings}
    assert len(same) == 1


def test_later_overrides_win():
    assert study_plan.merge_overrides(["a=1", "b.c=2", "a=3", "~d", "+b.c=4"]) == ["a=3", "~d", "+b.c=4"]


# ---- subsets of scenes


def test_fewer_scenes_of_one_seed_are_a_part_of_more():
    load = lambda *own: scene_source.load_training_scenes(  # noqa: E731
        hydra_config.load_config("train", "experiment=smoke", "scenes.count=4", *own)["scenes"]
    )
    everything = load()
    some = [set(load("seed=5", f"scenes.take.count={count}").names) for count in (1, 2, 3)]
    assert [len(names) for names in some] == [1, 2, 3] and some[0] < some[1] < some[2] < set(everything.names)
    fixed = load("seed=1", "scenes.take.count=3", "scenes.take.seed=5")
    assert set(fixed.names) == some[2] and "3 of the 4 scenes" in fixed.account
    shapes = [[leaf.shape[1:] for leaf in jax.tree.leaves(scenes.scene)] for scenes in (fixed, everything)]
    assert shapes[0] == shapes[1]  # so that programs are the same
    with pytest.raises(ConfigError, match=r"scenes\.take\.count: 7, but there are 4 scenes"):
        load("scenes.take.count=7")
    assert json.dumps(hydra_config.load_config("train")["scenes"]["take"]) == '{"count": null, "seed": 0}'
