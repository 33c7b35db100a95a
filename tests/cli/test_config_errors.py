"""What a user can get wrong is refused before anything runs for long: by file or key, with the value, and with what would be valid."""

import json

import pytest
from support.scene_documents import checker, document, packer, straight, thing, written

from scenefactory_jax.cli import hydra_config, schema
from scenefactory_jax.cli.benchmark import benchmark
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.cli.evaluate import evaluate
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.cli.train import train
from scenefactory_jax.cli.view import view
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel import task_map
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import batches, scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning.training_loop import make_policy, make_trainer

HERE = ["progress=false", "spread.timeout_s=null"]  # of a conversion in this process
COMMANDS = {"train": train, "benchmark": benchmark, "view": view, "scenes": scenes, "convert": convert, "evaluate": evaluate}


def test_overrides_of_a_run_are_a_list():
    with pytest.raises(ConfigError, match=r"overrides: expected a list, .* got 'worlds=3'"):
        hydra_config.apply_overrides({"worlds": 2}, "worlds=3")


def refused(command, *overrides):
    """The message with which a command refuses a config; a run must not even begin a folder."""
    with pytest.raises((ConfigError, SceneError)) as caught:
        COMMANDS[command](hydra_config.load_config(command, *overrides))
    return str(caught.value)


# ---- scene files


def test_files_that_cannot_be_used_are_listed_and_the_rest_goes_on(tmp_path, capsys):
    whole = json.dumps(document())
    edge = [{"geometry": straight(-40, 40, 6), "type": "road_edge", "map_element_id": 15, "id": 3}]
    nan, infinite = document(), document()
    nan["objects"][1]["position"][4]["y"] = float("nan")
    infinite["roads"][1]["geometry"][2]["x"] = float("inf")
    folder = tmp_path / "in"
    folder.mkdir()
    files = {
        "cut.json": (whole[: len(whole) // 3], "not valid JSON, damaged or cut short after"),
        "laneless.json": (document(roads=edge), "no driving lane"),
        "nan.json": (nan, "objects[1].position[4].y: expected a finite number, got nan"),
        "infinite.json": (infinite, "roads[1].geometry[2].x: expected a finite number, got inf"),
        "foreign.json": ({"map": []}, "unknown format"),
        "text.txt": ("hello", "unknown format"),
    }
    for name, (content, _) in files.items():
        written(folder, content, name)
    written(folder, whole, "good.json")
    written(folder, document(objects=[thing(0, speed=0)]), "goalless.json")
    summary = convert(hydra_config.load_config("convert", f"source={folder}", f"out={tmp_path / 'bank'}", *HERE))
    printed = capsys.readouterr().out
    assert (summary.files, summary.scenes, len(summary.rejects)) == (8, 2, 6) and "2 scenes" in printed and "6 rejected" in printed
    assert "packing with these numbers refuses: 1 no agent left" in printed
    config = hydra_config.load_config("scenes", "scenes=womd", f"scenes.path={tmp_path / 'bank'}")
    account = scene_source.load_all_scenes(config["scenes"]).account
    assert "goalless.json (street): tracks: no agent is left of 1: 1 too_short" in account and "refuses: 1 no agent left" in account
    reasons = {reject["source"]: reject["reason"] for reject in bank_reader.open(tmp_path / "bank").rejects}
    for name, (_, reason) in files.items():
        assert reason in reasons[str(folder / name)] and f"rejected {folder / name}" in printed


def test_a_goal_outside_the_box_is_dropped_by_reason(tmp_path):
    far = thing(30, id=9)  # 150 m on in the one step that is left after the tenth
    far["position"] = [{"x": 30.0 + (150 if step == 11 else 0), "y": 0.0, "z": 0.0} for step in range(12)]
    path = written(tmp_path, document(objects=[thing(0, id=7, speed=40), far]))
    summary = convert(hydra_config.load_config("convert", f"source={path}", f"out={tmp_path / 'bank'}", *HERE))
    assert summary.agents_kept == 1 and summary.agents_dropped["goal_outside_box"] == 1
    scene, report = scene_source.pack_scenes(scene_source.open_bank(tmp_path / "bank"), [0], check=checker(), pack=packer())[0]
    assert report.track_ids == (7,) and scene.agents.present.sum() == 1

    alone = written(tmp_path, document(objects=[thing(0, kind="pedestrian"), far]), "alone.json")
    sized = [*HERE, f"source={alone}", f"out={tmp_path / 'none'}"]
    summary = convert(hydra_config.load_config("convert", *sized))
    assert (summary.scenes, summary.agents_kept, summary.refused) == (1, 0, {"no_agent_left": 1})
    message = refused("train", "scenes=womd", f"scenes.path={tmp_path / 'none'}", f"out={tmp_path / 'run'}")
    assert "no agent is left of 2: 1 not_a_vehicle, 1 goal_outside_box" in message
    unforced = hydra_config.load_config("scenes", "scenes=womd", "scenes.pack.require_agents=false")["scenes"]
    assert not scene_source.load_all_scenes(unforced | {"path": tmp_path / "none"}).scene.agents.present.any()


def test_nothing_to_train_on_says_why(tmp_path):
    path = written(tmp_path, document(objects=[thing(0, speed=0)]))
    message = refused("train", "scenes=womd", f"scenes.path={path}", f"out={tmp_path / 'run'}")
    assert f"scenes.path={path}: no usable scene" in message and "1 too_short" in message and not (tmp_path / "run").exists()
    assert "scenes.path: null; give a bank, a scene file or a folder" in refused("train", "experiment=smoke", "scenes=womd")
    with pytest.raises(ConfigError, match=r"scenes\.heldout\.seed: expected another seed than scenes.seed, got 7"):
        scene_source.load_heldout_scenes(hydra_config.load_config("train", "scenes.seed=7", "scenes.heldout.seed=7")["scenes"], path=None)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("quality.reject=[level]", "quality.reject: expected names of rules, got 'level'; valid: missing_map, "),
        ("lanes.topology.neighbour_distance_m=[5.0,2.0]", "lanes.topology.neighbour_distance_m: expected [min, max] >= 0, got [5.0, 2.0]"),
        ("features.streets.one_in=0", "features.streets.one_in: expected a number > 0, got 0"),
        ("spread.timeout_s=0.0", "spread.timeout_s: expected a number > 0 or null, got 0.0"),
        ("scenes.workers=0", "scenes.workers: expected an integer >= 1, got 0"),
    ],
)
def test_a_mistake_in_the_config_is_no_reject_of_every_file(tmp_path, override, message):
    path = written(tmp_path, document(), "good.json")
    assert refused("convert", f"source={path}", f"out={tmp_path / 'bank'}", *HERE, override).startswith(message)
    assert not (tmp_path / "bank").exists()


def test_a_mistake_in_the_config_is_no_scene_s_fault_in_a_stream():
    config = hydra_config.load_config("scenes", "scenes.pack.car_size_m=[4.0]")["scenes"]
    source, grid = scene_source.open_source(config), {"radius_m": None}
    loader = batches.BatchLoader(source, **scene_source.make_packing(config), grid=grid, task_map=task_map.in_process)
    with pytest.raises(ConfigError, match=r"^scenes\.pack\.car_size_m: expected \[length, width\] or null, got \[4.0\]"):
        batches.measure(loader, sample=[0], headroom=1.0, given={})


def test_a_name_leads_nowhere_and_can_be_printed(tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    written(folder, document(name="../escaped"), "a.json")
    written(folder, document(name="\ud800half"), "b.json")  # half a surrogate pair
    loaded = scenes(hydra_config.load_config("scenes", "scenes=womd", f"scenes.path={folder}", "op=check", f"out={tmp_path / 'out'}"))
    assert len(loaded) == 2 and "\\ud800half" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        ".._escaped.png", "_ud800half.png", "agents.csv", "agents.parquet", "sheet.png"
    }  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out"]
    summary = convert(hydra_config.load_config("convert", f"source={folder}", f"out={tmp_path / 'bank'}", *HERE))
    assert [reject["scene"] for reject in summary.rejects] == ["\ud800half"]  # Arrow holds no half pair
    assert "b.json (\\ud800half): " in capsys.readouterr().out


# ---- keys that do not exist


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("wrlds=3", r"wrlds: unknown key 'wrlds'; the top level has: actions, checkpoint_every, .*worlds"),
        (
            "step_metrics.circles.radius=1",
            r"step_metrics\.circles\.radius: unknown key 'radius'; step_metrics\.circles has: radius_floor_m, ",
        ),
        ("seed.value=1", r"seed\.value: unknown key 'value'; seed has: nothing: it is a value"),
        ("scenes.capacity.rod=3", r"unknown key 'rod'; scenes\.capacity has: agents, changes, controls, edges, lanes, road"),
        ("dynamics=hover", r"Could not find 'dynamics/hover' Available options in 'dynamics': articulated articulated_paper base"),
        (
            "experiment=smok",
            r"Could not find 'experiment/smok' Available options in 'experiment': "
            r"bicycle demo drive generalist generalist_finetune laptop .* smoke",
        ),
        ("dynamics={_target_: mine.make, gain: 1.0}", r"to replace all of dynamics: ~dynamics \+dynamics=\{\.\.\.\}"),
        ("timing=null", r"timing=null: "),
        ("worlds", r"worlds"),
    ],
)
def test_an_unknown_key_or_option_is_named_with_the_valid_ones(override, message):
    with pytest.raises(ConfigError, match=message):
        hydra_config.load_config("train", override)


def test_an_unknown_config_is_named():
    with pytest.raises(ConfigError, match=r"config: expected one of attack, benchmark, compare, convert, .*train.*, got 'fly'"):
        hydra_config.load_config("fly")


# ---- values that do not fit


@pytest.mark.parametrize(
    ("command", "override", "message"),
    [
        ("train", "worlds=abc", "worlds: expected an integer >= 1, got 'abc'"),
        ("train", "worlds=1.5", "worlds: expected an integer >= 1, got 1.5"),
        ("train", "worlds=0", "worlds: expected an integer >= 1, got 0"),
        ("train", "iterations=true", "iterations: expected an integer >= 1, got True"),
        ("train", "iterations=0", "iterations: expected an integer >= 1, got 0"),
        ("train", "seed=abc", "seed: expected an integer >= 0, got 'abc'"),
        ("train", "seed=-1", "seed: expected an integer >= 0, got -1"),
        ("train", "minutes=soon", "minutes: expected a number >= 0 or null, got 'soon'"),
        ("train", "checkpoint_every=0", "checkpoint_every: expected an integer >= 1, got 0"),
        ("train", "resume=maybe", "resume: expected true or false, got 'maybe'"),
        ("train", "out=3", "out: expected a text or null, got 3"),
        ("train", "evaluation.protocols=strict", "evaluation.protocols: expected a list, each a text, got 'strict'"),
        ("train", "evaluation.protocols=[hard]", "protocols: expected one or more of goal_only, rules, strict, vmax, whole, got ['hard']"),
        ("train", "evaluation.protocols=[]", "evaluation.protocols: expected one or more of goal_only, rules, strict, vmax, whole, got []"),
        ("train", "evaluation.repeats=0", "evaluation.repeats: expected an integer >= 1, got 0"),
        ("train", "evaluation.video.fps=fast", "evaluation.video.fps: expected a number >= 0.1, got 'fast'"),
        ("train", "evaluation.video.suffix=.avi", "evaluation.video.suffix: expected .gif or .mp4, got '.avi'"),
        ("train", "scenes.count=abc", "scenes.count: expected an integer >= 1, got 'abc'"),
        ("train", "scenes.count=0", "scenes.count: expected an integer >= 1, got 0"),
        ("train", "scenes.heldout.seed=abc", "scenes.heldout.seed: expected an integer >= 0, got 'abc'"),
        ("train", "scenes.path=3", "scenes.path: expected a text or null, got 3"),
        ("train", "scenes.workers=0", "scenes.workers: expected an integer >= 1, got 0"),
        ("benchmark", "repeats=0", "repeats: expected an integer >= 1, got 0"),
        ("view", "skip=first", "skip: expected an integer >= 0, got 'first'"),
        ("scenes", "check.max_pictures=few", "check.max_pictures: expected an integer >= 0, got 'few'"),
        ("convert", "source=3", "source: expected a text or null, got 3"),
        ("evaluate", "repeats=0", "repeats: expected an integer >= 1, got 0"),
        ("evaluate", "overrides=weather", "overrides: expected a list, each a text, got 'weather'"),
        ("evaluate", "planners=[pdm]", "planners: expected names of log, expert, pdm_closed, idm_route, route_pursuit, pure_pursuit"),
        ("evaluate", "video.worlds=-1", "video.worlds: expected an integer >= 0, got -1"),
    ],
)
def test_a_wrong_value_of_a_commands_own_key_is_named(command, override, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = [f"run={tmp_path}"] if command == "evaluate" else []
    assert message in refused(command, *run, *(["experiment=smoke"] if command == "train" else []), override)
    assert not list(tmp_path.iterdir())  # no run was begun


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("ppo.horizon=long", "ppo.horizon: expected an integer >= 1, got 'long'"),
        ("ppo.gamma=1.5", "ppo.gamma: expected a number >= 0 and <= 1, got 1.5"),
        ("policy.trunk=wide", "policy.trunk: expected a list, each an integer >= 1, got 'wide'"),
        ("policy.activation=gelu", "policy.activation: expected"),
        ("step_metrics.scene_size_m=abc", "step_metrics.scene_size_m: expected a number > 0, got 'abc'"),
        ("reward.goal.weight=big", "reward.goal.weight: expected a number or [min, max], got 'big'"),
        ("~reward.goal.weight", "reward.goal.weight: missing"),
        ("observations.road.count=many", "observations.road.count: expected an integer >= 1, got 'many'"),
        ("timing.control_hz=0", "timing.control_hz: expected a number > 0, got 0"),
        ("timing.episode_s=long", "timing.episode_s: expected a number > 0, got 'long'"),
        ("spawning.respawn_clearance_m=near", "spawning.respawn_clearance_m: expected a number >= 0 or null, got 'near'"),
        ("dynamics.wheelbase=long", "dynamics.wheelbase: expected a number > 0, got 'long'"),
        ("weather.friction.mode=sticky", "weather.friction.mode: expected"),
        ("termination.ending=[goal_reached,bored]", "termination.ending: expected one of numerical_error, goal_reached, "),
    ],
)
def test_a_wrong_value_of_a_part_is_named(override, message):
    settings = hydra_config.load_config("train", "experiment=smoke", override)
    with pytest.raises(ConfigError) as caught:
        make_trainer(settings, environment.make_env(settings), make_policy(settings))
    assert message in str(caught.value)


def test_a_config_from_python_is_checked_too(tmp_path):
    settings = hydra_config.load_config("train", "experiment=smoke")
    schema.check_train(settings | {"out": tmp_path})  # a path is as good as its text
    with pytest.raises(ConfigError, match=r"worlds: missing; the config needs actions, .*, worlds"):
        schema.check_train({name: value for name, value in settings.items() if name != "worlds"})
    with pytest.raises(ConfigError, match="reward: missing; the config needs actions, "):
        environment.make_env({name: value for name, value in settings.items() if name != "reward"})
