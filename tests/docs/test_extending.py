"""The code of docs/extending.md, as it stands there: every module of the page is written to a file and used by the page's own commands."""

import re
import sys

import jax
import jax.numpy as jnp
import pytest
from support.hand_scenes import scene_of
from support.pages import commands
from support.running import ROOT
from support.scene_documents import checker, packer

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.cli.convert import convert
from scenefactory_jax.data.bank import bank_reader
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The modules that docs/extending.md shows, as files of a folder that is importable; and its commands, without the first word."""
    folder, path = tmp_path_factory.mktemp("page"), ROOT / "docs" / "extending.md"
    blocks = dict(re.findall(r"```python\n# (my_\w+)\.py\n(.*?)```", path.read_text(), re.DOTALL))
    for name, text in blocks.items():
        (folder / f"{name}.py").write_text(text)
        sys.modules.pop(name, None)  # other tests here have modules of the same names
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield blocks, [words for _, *words in commands(path)]
    for name in blocks:
        sys.modules.pop(name, None)


def test_the_parts_of_the_page_drive_together(page):
    """Reward, observation, action and backend of the page in one environment, by the commands of the page."""
    blocks, calls = page
    overrides = [word for words in calls for word in words if "my_" in word or word == "~dynamics" or ".gentle" in word]
    parts = [word for word in overrides if "my_reader" not in word]
    assert set(blocks) == {"my_terms", "my_groups", "my_controls", "my_backend", "my_reader"}
    assert all(any(name in word for word in overrides) for name in blocks)
    env = environment.make_env(
        hydra_config.load_config("task", *parts, "observations=small", "~observations.road", "~observations.neighbours")
    )
    scene = scene_of([[0, 0], [-20, 0]], [[30, 0], [20, 0]], present=[True, False])
    state, step = env.init_state(jax.random.key(0), scene), jax.jit(env.step)
    actions = [[0.8, 0.0, -1.0]] * 10 + [[0.0, 0.5, -1.0]] * 10 + [[-1.0, 0.0, -1.0]] * 10
    speeds, yaws = [], []
    for action in actions:
        state, outcome = step(scene, state, jnp.array([action] * 2))
        speeds.append(float(outcome.metrics.speed[0]))
        yaws.append(float(state.motion.yaw[0]))
        assert env.observe(scene, state)["clock"].shape == (2, 2)
        assert float(outcome.terms["smoothness"][0]) <= 0.0
    dt, held = 1 / 30, env.action_repeat
    assert speeds[9] == pytest.approx(10 * held * dt * 3.0 * 0.5 * 0.8, rel=1e-4) and speeds[19] == pytest.approx(speeds[9], rel=1e-4)
    assert yaws[9] == 0.0 and yaws[19] == pytest.approx(10 * held * dt * 0.8 * 0.5, rel=1e-4) and speeds[29] < speeds[19]
    assert 0.1 < float(state.motion.position[0, 0]) < 1.0 and state.motion.position[1].tolist() == pytest.approx([-20, 0, 0.5])


def test_the_reader_of_the_page_converts_a_table(page, tmp_path):
    _, calls = page
    [words] = [words for words in calls if any("my_reader" in word for word in words)]
    lines = [f"lane,{x},0" for x in range(-40, 41)] + [f"car,{x},0" for x in range(-20, 21, 2)]
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "street.csv").write_text("\n".join(lines))
    (tmp_path / "in" / "empty.csv").write_text("lane,0,0")
    own = [word for word in words if "my_reader" in word]
    summary = convert(hydra_config.load_config("convert", f"source={tmp_path / 'in'}", f"out={tmp_path / 'bank'}", "progress=false", *own))
    assert (summary.files, summary.scenes) == (2, 1)
    opened = bank_reader.open(tmp_path / "bank")
    scene, report = scene_source.pack_scenes(scene_source.open_bank(opened), [0], check=checker(), pack=packer(), workers=1)[0]
    assert report.track_ids == (7,) and float(scene.agents.speed[0]) == pytest.approx(10.0) and float(scene.log.dt) == pytest.approx(0.2)
