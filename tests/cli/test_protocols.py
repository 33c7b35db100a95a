"""Protocols: settings that one takes from another, and the overrides that they become."""

import pytest

from scenefactory_jax.cli import hydra_config


def overrides_of(name, *words):
    return hydra_config.list_overrides(hydra_config.load_config("evaluate", "run=x", f"protocol={name}", *words)["protocol"]["settings"])


@pytest.mark.parametrize(
    ("name", "parent", "own"),
    [
        ("strict", "recorded", []),
        ("paper", "recorded", ["spawning=from_rest"]),
        ("conflict_reactive", "conflict", ["traffic=idm"]),
        ("grip_hidden", "grip", ["observations.weather._target_=hidden_weather"]),
        ("grip_stops", "grip", ["scenes/pack/starts=grip_stops"]),
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


def test_values_read_back_as_they_were():
    settings = {"scenes.pack.agents": 3, "scenes.pack.scene_size_m": 90.0, "scenes.pack.centre": "mean", "scenes.pack.car_size_m": None}
    run = hydra_config.load_config("train", "experiment=smoke")
    pack = hydra_config.apply_overrides(run, hydra_config.list_overrides(settings))["scenes"]["pack"]
    assert {f"scenes.pack.{key}": pack[key] for key in ("agents", "scene_size_m", "centre", "car_size_m")} == settings


def test_one_setting_changes_on_the_command_line():
    assert "weather=wet" in overrides_of("recorded", "protocol.settings.weather=wet")
