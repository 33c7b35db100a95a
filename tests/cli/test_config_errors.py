"""What a user can get wrong is refused before anything runs for long: by file or key, with the value, and with what would be valid."""

import json

import pytest
from support.scene_documents import checker, document, packer, straight, thing, written

from scenefactory_jax.cli import hydra_config, schema
from scenefactory_jax.cli.benchmark import bench
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.cli.render import render
from scenefactory_jax.cli.scenes import scenes
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import batches, scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation.protocols import evaluate
from scenefactory_jax.learning.training_loop import make_policy, make_trainer, train

HERE = ["progress=false", "spread.timeout_s=null"]  # of a conversion in this process
COMMANDS = {"train": train, "bench": bench, "render": render, "scenes": scenes, "convert": convert, "evaluate": evaluate}


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
        "cut.json": (whole[: len(whole) // 3], "no valid JSON, damaged or cut short after"),
        "laneless.json": (document(roads=edge), "no driving lane"),
        "nan.json": (nan, "objects[1].position[4].y: nan is not finite"),
        "infinite.json": (infinite, "roads[1].geometry[2].x: inf is not finite"),
        "foreign.json": ({"map": []}, "no reader knows this format"),
        "text.txt": ("hello", "no reader knows this format"),
    }
    for name, (content, _) in files.items():
        written(folder, content, name)
    written(folder, whole, "good.json")
    written(folder, document(objects=[thing(0, speed=0)]), "goalless.json")
    summary = convert(hydra_config.load_config("convert", f"source={folder}", f"out={tmp_path / 'bank'}", *HERE))
    printed = capsys.readouterr().out
    assert (summary.files, summary.scenes, len(summary.rejects)) == (8, 2, 6) and "2 scenes" in printed and "6 rejected" in printed
    assert "packing with these numbers refuses: 1 no agent left" in printed
    account = scene_source.from_path(hydra_config.load_config("scenes", "scenes=womd")["scenes"], tmp_path / "bank").account
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
    scene, report = bank_reader.pack_scenes(bank_reader.open(tmp_path / "bank"), [0], check=checker(), pack=packer(), workers=1)[0]
    assert report.track_ids == (7,) and scene.agents.present.sum() == 1

    alone = written(tmp_path, document(objects=[thing(0, kind="pedestrian"), far]), "alone.json")
    sized = [*HERE, f"source={alone}", f"out={tmp_path / 'none'}"]
    summary = convert(hydra_config.load_config("convert", *sized))
    assert (summary.scenes, summary.agents_kept, summary.refused) == (1, 0, {"no_agent_left": 1})
    message = refused("train", "scenes=womd", f"scenes.path={tmp_path / 'none'}", f"out={tmp_path / 'run'}")
    assert "no agent is left of 2: 1 not_a_vehicle, 1 goal_outside_box" in message
    unforced = hydra_config.load_config("scenes", "scenes=womd", "scenes.pack.require_agents=false")["scenes"]
    assert not scene_source.from_path(unforced, tmp_path / "none").scene.agents.present.any()


def test_nothing_to_train_on_says_why(tmp_path):
    path = written(tmp_path, document(objects=[thing(0, speed=0)]))
    message = refused("train", "scenes=womd", f"scenes.path={path}", f"out={tmp_path / 'run'}")
    assert f"scenes.path={path}: no usable scene" in message and "1 too_short" in message and not (tmp_path / "run").exists()
    assert "scenes.path: null; give a bank, a scene file or a folder" in refused("train", "experiment=smoke", "scenes=womd")
    with pytest.raises(ConfigError, match=r"scenes\.heldout\.seed: 7 is the training seed"):
        scene_source.load_heldout_scenes(hydra_config.load_config("train", "scenes.seed=7", "scenes.heldout.seed=7")["scenes"], path=None)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("quality.reject=[level]", "quality.reject: 'level' is no rule; valid: missing_map, "),
        ("lanes.topology.neighbour_distance_m=[5.0,2.0]", "lanes.topology.neighbour_distance_m: [5.0, 2.0]; wanted is [least, most]"),
        ("features.streets.one_in=0", "features.streets.one_in: 0; wanted is a number above 0"),
        ("spread.timeout_s=0.0", "spread.timeout_s: 0; wanted is a number above 0"),
        ("scenes.workers=0", "spread.workers: 0; wanted is a number of at least 1"),
    ],
)
def test_a_mistake_in_the_config_is_no_reject_of_every_file(tmp_path, override, message):
    path = written(tmp_path, document(), "good.json")
    assert refused("convert", f"source={path}", f"out={tmp_path / 'bank'}", *HERE, override).startswith(message)
    assert not (tmp_path / "bank").exists()


def test_a_mistake_in_the_config_is_no_scene_s_fault_in_a_stream():
    source = batches.open(hydra_config.load_config("scenes", "scenes.pack.scene_size_m=-1.0")["scenes"])
    with pytest.raises(ConfigError, match=r"^scenes\.pack\.scene_size_m: -1; wanted is a number above 0"):
        batches.measure(source, None, grid={"radius_m": None}, sample=1, headroom=1.0, given={}, seed=0)


def test_a_name_leads_nowhere_and_can_be_printed(tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    written(folder, document(name="../escaped"), "a.json")
    written(folder, document(name="\ud800half"), "b.json")  # half a surrogate pair
    loaded = scenes(hydra_config.load_config("scenes", "scenes=womd", f"scenes.path={folder}", "op=sheet", f"out={tmp_path / 'out'}"))
    assert len(loaded) == 2 and "\\ud800half" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".._escaped.png", "_ud800half.png", "sheet.png"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out"]
    summary = convert(hydra_config.load_config("convert", f"source={folder}", f"out={tmp_path / 'bank'}", *HERE))
    assert [reject["scene"] for reject in summary.rejects] == ["\ud800half"]  # Arrow holds no half pair
    assert "b.json (\\ud800half): " in capsys.readouterr().out


# ---- keys that do not exist


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("wrlds=3", r"wrlds: unknown key 'wrlds'; the top level has: checkpoint_every, .*worlds"),
        (
            "step_metrics.circles.radius=1",
            r"step_metrics\.circles\.radius: unknown key 'radius'; step_metrics\.circles has: radius_floor_m, ",
        ),
        ("seed.value=1", r"seed\.value: unknown key 'value'; seed has: nothing: it is a value"),
        ("scenes.capacity.rod=3", r"unknown key 'rod'; scenes\.capacity has: agents, edges, lanes, others, road, steps"),
        ("dynamics=hover", r"Could not find 'dynamics/hover' Available options in 'dynamics': base bicycle mjx_car mjx_published replay"),
        (
            "experiment=smok",
            r"Could not find 'experiment/smok' Available options in 'experiment': bicycle demo laptop published quick smoke",
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
    with pytest.raises(ConfigError, match=r"no config 'fly'; valid: bench, compare, convert, drive, evaluate, .*train"):
        hydra_config.load_config("fly")


# ---- values that do not fit


@pytest.mark.parametrize(
    ("command", "override", "message"),
    [
        ("train", "worlds=abc", "worlds: 'abc' is of type str, wanted int"),
        ("train", "worlds=1.5", "worlds: 1.5 is of type float, wanted int"),
        ("train", "worlds=0", "worlds: 0; wanted is at least 1"),
        ("train", "iterations=true", "iterations: True is of type bool, wanted int"),
        ("train", "iterations=0", "iterations: 0; wanted is at least 1"),
        ("train", "seed=abc", "seed: 'abc' is of type str, wanted int"),
        ("train", "seed=-1", "seed: -1; wanted is at least 0"),
        ("train", "minutes=soon", "minutes: 'soon' is of type str, wanted float | None"),
        ("train", "checkpoint_every=0", "checkpoint_every: 0; wanted is at least 1"),
        ("train", "resume=maybe", "resume: 'maybe' is of type str, wanted bool"),
        ("train", "out=3", "out: 3 is of type int, wanted str | None"),
        ("train", "evaluation.protocols=strict", "evaluation.protocols: 'strict' is of type str, wanted list[str]"),
        ("train", "evaluation.protocols=[sharp]", "evaluation.protocols: ['sharp']; valid: one or more of goal_only, strict"),
        ("train", "evaluation.protocols=[]", "evaluation.protocols: []; valid: one or more of goal_only, strict"),
        ("train", "evaluation.repeats=0", "evaluation.repeats: 0; wanted is at least 1"),
        ("train", "evaluation.video.fps=fast", "evaluation.video.fps: 'fast' is of type str, wanted float"),
        ("train", "evaluation.video.suffix=.avi", "evaluation.video.suffix: '.avi'"),
        ("train", "scenes.count=abc", "scenes.count: 'abc' is of type str, wanted int"),
        ("train", "scenes.count=0", "scenes.count: 0; wanted is at least 1"),
        ("train", "scenes.heldout.seed=abc", "scenes.heldout.seed: 'abc' is of type str, wanted int"),
        ("train", "scenes.path=3", "scenes.path: 3 is of type int, wanted str | None"),
        ("train", "scenes.workers=0", "scenes.workers: 0; wanted is at least 1"),
        ("bench", "repeats=0", "repeats: 0; wanted is at least 1"),
        ("render", "index=first", "index: 'first' is of type str, wanted int"),
        ("scenes", "limit=few", "limit: 'few' is of type str, wanted int"),
        ("convert", "source=3", "source: 3 is of type int, wanted str | None"),
        ("evaluate", "repeats=0", "repeats: 0; wanted is at least 1"),
        ("evaluate", "overrides=weather", "overrides: 'weather' is of type str, wanted list[str]"),
        ("evaluate", "video.worlds=-1", "video.worlds: -1; wanted is at least 0"),
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
        ("ppo.horizon=long", "ppo.horizon: 'long' is of type str, wanted int"),
        ("ppo.gamma=1.5", "ppo.gamma: 1.5; wanted is a number from 0 to 1"),
        ("policy.trunk=wide", "policy.trunk: 'wide' is of type str, wanted list[int]"),
        ("policy.activation=gelu", "policy.activation: 'gelu'"),
        ("step_metrics.scene_size_m=abc", "step_metrics.scene_size_m: 'abc' is of type str, wanted float"),
        ("reward.goal.weight=big", "reward.goal.weight: 'big' is of type str, wanted float"),
        ("~reward.goal.weight", "reward.goal.weight: missing"),
        ("observations.road.count=many", "observations.road.count: 'many' is of type str, wanted int"),
        ("timing.control_hz=0", "timing.control_hz: 0; wanted is a number above 0"),
        ("timing.episode_s=long", "timing.episode_s: 'long' is of type str, wanted float"),
        ("spawning.respawn_clearance_m=near", "spawning.respawn_clearance_m: 'near' is of type str, wanted float | None"),
        ("dynamics.wheelbase=long", "dynamics.wheelbase: 'long' is of type str, wanted float"),
        ("weather.grip.mode=sticky", "weather.grip.mode: 'sticky'"),
        (
            "termination.ending=[fault,reached,bored]",
            "termination.ending: unknown event 'bored'; valid: fault, reached, collided, crashed, road_edge_contact",
        ),
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
    with pytest.raises(ConfigError, match="worlds: missing; the command needs name, out, resume, seed, worlds"):
        schema.check_train({name: value for name, value in settings.items() if name != "worlds"})
    with pytest.raises(ConfigError, match="group 'reward' is missing; an environment needs timing, controls"):
        environment.make_env({name: value for name, value in settings.items() if name != "reward"})
