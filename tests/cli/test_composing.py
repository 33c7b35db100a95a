"""What the tests share of Hydra's work changes nothing of what it composes."""

import pytest
from support import composing

from scenefactory_jax.cli import hydra_config

CASES = [
    ("train", "experiment=smoke", "worlds=3", "policy.trunk=[8]", "+reward.mine={weight: 1.0}", "~reward.progress", "out=a b"),
    ("train", "worlds=2", "weather=storm", "dynamics/randomization=spread", "observations.road.kernels=pallas", "~experiment"),
    ("study", "study=rewards", "seeds=[1,2]", "study.common=[weather=wet,worlds=3]"),
    ("task", "termination=strict", "timing.episode_s=3"),
    ("evaluate", "run=x", "protocol=paper", "overrides=[dynamics=bicycle]"),
]


@pytest.mark.parametrize("words", CASES, ids=lambda words: " ".join(words[:2]))
def test_a_shared_composition_is_hydras(words, monkeypatch, tmp_path):
    name, *overrides = words
    monkeypatch.setattr(composing, "FOLDER", tmp_path)
    for _ in range(2):  # composed, and read from its file
        monkeypatch.setattr(composing, "GROUPS", {})
        shared = composing.compose_once(name, overrides)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr(composing.ConfigRepository, "load_config", composing.load_config)
    monkeypatch.setattr(composing.defaults_list, "_create_interpolation_map", composing.map_choices)
    monkeypatch.setattr(composing.Box, "_re_parent", composing.set_parents)
    expected = composing.compose(name, overrides)
    shared, expected = hydra_config.to_dict(shared), hydra_config.to_dict(expected)
    assert shared == expected and repr(shared) == repr(expected)  # in the same order


def test_compositions_read_a_file_once(monkeypatch, tmp_path):
    files, load_config = [], composing.load_config
    monkeypatch.setattr(composing, "FOLDER", tmp_path)
    monkeypatch.setattr(composing, "FILES", {})
    monkeypatch.setattr(composing, "GROUPS", {})
    monkeypatch.setattr(composing, "load_config", lambda self, config_path: files.append(config_path) or load_config(self, config_path))
    for weather in ("wet", "ice"):
        composing.compose_once("task", [f"weather={weather}"])
    own = [file for file in files if (hydra_config.find_conf() / f"{file}.yaml").is_file()]
    assert {"weather/wet", "weather/ice", "weather/base"} < {*own} and len(own) == len({*own})


def test_a_changed_file_is_read_anew(tmp_path):
    (tmp_path / "weather").mkdir()
    for slope in (1.0, 2.0):
        (tmp_path / "weather" / "mine.yaml").write_text(f"defaults: [base]\nmade_up: {slope}\n")
        found = hydra_config.load_config("task", f"hydra.searchpath=[file://{tmp_path}]", "weather=mine")
        assert found["weather"]["made_up"] == slope
