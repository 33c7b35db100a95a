"""`convert` of a generator: the scenes that it makes, a larger count later, and a scene that it cannot make."""

import numpy as np
import pytest

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import SceneError
from scenefactory_jax.data import conversion
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source


def command(*overrides):
    return hydra_config.load_config("convert", "scenes=town", "progress=false", *overrides)


@pytest.mark.slow
def test_a_bank_of_generated_scenes_grows_with_their_count(tmp_path, capsys):
    out = tmp_path / "town"
    convert(command("scenes.count=1", f"out={out}"))
    assert "1 scenes with" in capsys.readouterr().out
    config = command("scenes.count=3", f"out={out}")
    summary = convert(config)
    assert (summary.scenes, summary.files, summary.rejects) == (3, 0, ())
    bank, generate = bank_reader.open(out), scene_source.make_generator(config["scenes"])
    assert bank.index.files == ("0-0", "0-1", "0-2")
    for index, raw in enumerate(bank_reader.read_raws(bank, range(3))):
        made = generate(0, index)
        assert (raw.name, len(raw.tracks), len(raw.roads)) == (made.name, len(made.tracks), len(made.roads))
        np.testing.assert_array_equal(raw.tracks[0].xyz, made.tracks[0].xyz)
    with pytest.raises(SceneError, match=r"source: 'generated scenes of seed 0' there, 'generated scenes of seed 1' here"):
        convert(command("scenes.seed=1", f"out={out}"))
    with pytest.raises(ConfigError, match=r"out: missing"):
        convert(command())


def test_a_scene_that_cannot_be_made_is_listed(tmp_path):
    config = command()
    generate, packing = scene_source.make_generator(config["scenes"]), scene_source.make_packing(config["scenes"])

    def fails(seed, index):
        if index == 1:
            raise ValueError("no room")
        return generate(seed, index)

    tools = conversion.SceneTools({}, **packing)
    numbers = {"settings": {}, "spread": map, "shard_scenes": 2, "compression": None}
    summary = conversion.convert(conversion.Generated(fails, 0, 2), tmp_path / "bank", tools=tools, **numbers)
    assert [(one["source"], one["reason"]) for one in summary.rejects] == [("generated scene 1", "ValueError: no room")]
    again = conversion.convert(conversion.Generated(generate, 0, 2), tmp_path / "bank", tools=tools, **numbers)  # it is made anew
    assert again.scenes == 2 and not again.rejects
