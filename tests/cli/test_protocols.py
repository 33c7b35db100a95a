"""Protocols: settings that one takes from another, and the overrides that they become."""

import pytest

from scenefactory_jax.cli import hydra_config, schema
from scenefactory_jax.cli.evaluate import format_rerun_command
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.env import environment, rewards


def overrides_of(name, *words):
    return hydra_config.list_overrides(hydra_config.load_config("evaluate", "run=x", f"protocol={name}", *words)["protocol"]["settings"])


@pytest.mark.parametrize(
    ("name", "parent", "own"),
    [
        ("strict", "recorded", []),
        ("paper", "recorded", ["spawning=from_rest"]),
        ("conflict_reactive", "conflict", ["traffic=idm"]),
        ("nuplan_reactive", "nuplan", ["traffic=idm"]),
        ("grip_hidden", "grip", ["weather.hidden=true"]),
        ("grip_stops", "grip", ["scenes/pack/starts=grip_stops", "weather.patches.routes.end_m=4.0"]),
    ],
)
def test_a_protocol_says_what_differs_from_another(name, parent, own):
    theirs = {word.partition("=")[0]: word for word in overrides_of(parent)}
    expected = theirs | {word.partition("=")[0]: word for word in own}
    assert sorted(overrides_of(name)) == sorted(expected.values()) and len(overrides_of(name)) >= 13


def test_groups_come_before_values_and_before_their_parts():
    """An option sets all of its group: a value before it would be lost."""
    settings = {
        "traffic.reactive": "all",
        "dynamics/randomization": "spread",
        "scenes.pack.agents": 16,
        "dynamics": "articulated",
        "traffic": "idm",
    }
    expected = ["dynamics=articulated", "traffic=idm", "dynamics/randomization=spread", "traffic.reactive=all", "scenes.pack.agents=16"]
    assert hydra_config.list_overrides(settings) == expected
    words = overrides_of("route100")
    assert words.index("traffic=trajectory_idm") < words.index("traffic.reactive=all")
    assert words.index("scenes/pack/routes=route100") < words.index("scenes.pack.traffic=64")
    assert overrides_of("trained") == []


@pytest.mark.parametrize("name", ["strict", "paper", "route100", "conflict", "grip", "vmax", "nuplan", "wosac"])
def test_a_policy_that_observes_its_reward_weights_can_be_evaluated(name):
    """Its observation needs the ranges that it was trained with."""
    words = ("reward=drive_conditioned", "observations=drive_conditioned", "scenes=town")
    run = hydra_config.apply_overrides(hydra_config.load_config("train", *words), overrides_of(name))
    held = rewards.hold_weights(run["reward"])
    assert len(rewards.read_ranges(held)) == 8
    environment.make_env({**run, "reward": held})


def test_values_read_back_as_they_were():
    settings = {"scenes.pack.agents": 3, "scenes.pack.scene_size_m": 90.0, "scenes.pack.centre": "mean", "scenes.pack.car_size_m": None}
    run = hydra_config.load_config("train", "experiment=smoke")
    pack = hydra_config.apply_overrides(run, hydra_config.list_overrides(settings))["scenes"]["pack"]
    assert {f"scenes.pack.{key}": pack[key] for key in ("agents", "scene_size_m", "centre", "car_size_m")} == settings


@pytest.mark.parametrize("protocol", ["vmax", "nuplan", "scenarionet", "recorded", "route100"])
@pytest.mark.parametrize("experiment", ["vmax", "scenarionet"])
def test_no_start_or_goal_is_out_of_bounds(experiment, protocol):
    """Cars end where the square ends in which starts and goals lie, in training and in every protocol; in one 10 m behind it."""
    trained = hydra_config.load_config("train", f"experiment={experiment}")
    for config, beyond in (
        (trained, 0.0),
        (hydra_config.apply_overrides(trained, overrides_of(protocol)), 20.0 * (protocol == "route100")),
    ):
        assert config["step_metrics"]["scene_size_m"] == config["scenes"]["pack"]["scene_size_m"] + beyond
    narrow = hydra_config.load_config("train", f"experiment={experiment}", "scenes.pack.scene_size_m=150")
    assert narrow["step_metrics"]["scene_size_m"] == 150


def test_one_setting_changes_on_the_command_line():
    assert "weather=wet" in overrides_of("recorded", "protocol.settings.weather=wet")


# ---- the friction of the suite grip


def judged(*overrides, mu="0.3"):
    run = hydra_config.load_config("train", "experiment=smoke")
    return hydra_config.apply_overrides(run, [*overrides_of("grip", f"protocol.mu={mu}"), *overrides])


def test_one_word_gives_the_starts_and_the_road_their_friction():
    found = judged()
    assert found["scenes"]["pack"]["starts"]["mu"] == found["weather"]["friction"]["surfaces"]["ICE"]["mu"] == 0.3
    schema.check_mu(found)
    words = ["scenes/pack/starts=grip", "scenes/pack/routes=route100", "weather=grip", "weather.friction.surfaces.ICE.mu=0.15"]
    trained = hydra_config.load_config("train", "experiment=smoke", *words)
    assert trained["scenes"]["pack"]["starts"]["mu"] == 0.15
    schema.check_train(trained)


@pytest.mark.parametrize("override", ["scenes.pack.starts.mu=0.6", "weather.friction.surfaces.ICE.mu=0.6", "weather=ice"])
def test_a_road_with_another_friction_than_the_starts_is_refused(override):
    with pytest.raises(
        ConfigError, match=r"scenes\.pack\.starts\.mu: expected the mu of a surface of the weather, got 0\.[36] and .*protocol\.mu="
    ):
        schema.check_mu(judged(override))


def test_protocols_without_a_friction_and_wrong_ones_are_refused():
    with pytest.raises(ConfigError, match=r"protocol\.mu"):
        hydra_config.load_config("evaluate", "run=x", "protocol=recorded", "protocol.mu=0.3")
    with pytest.raises(ConfigError, match=r"protocol\.mu: expected a number > 0 or null, got 0"):
        schema.check_evaluate(hydra_config.load_config("evaluate", "run=x", "protocol=grip", "protocol.mu=0"))


def test_the_command_of_a_report_names_the_friction():
    config = hydra_config.load_config("evaluate", "run=x", "protocol=grip_stops", "protocol.mu=0.3")
    request = {"run": "x", "overrides": [], "protocol": "grip_stops", "protocols": ["strict"], "scenes": None, "trust": False}
    assert format_rerun_command(request, config) == "python -m scenefactory_jax evaluate run=x protocol=grip_stops protocol.mu=0.3"
