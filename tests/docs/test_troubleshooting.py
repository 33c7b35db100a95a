"""docs/troubleshooting.md quotes what a user sees: each of its commands is called here, and must say what the page says."""

import json
import re
import shlex
import shutil
import sys
import traceback
from pathlib import Path

import jax.numpy as jnp
import pytest
from support.running import ROOT, shell, smoke

import scenefactory_jax.__main__ as command_line
from scenefactory_jax.cli import error_messages
from scenefactory_jax.cli.train import train
from scenefactory_jax.core import config as run_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.data.bank import bank_index
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.evaluation import settings
from scenefactory_jax.learning import training_loop

PAGE = (ROOT / "docs" / "troubleshooting.md").read_text()
SHOWN = re.findall(r"```console\n\$ (.+)\n((?:.+\n)+?)```", PAGE)
CALL = "python -m scenefactory_jax "
OWN_REWARD = "import jax.numpy as jnp\n\n\ndef haste(step):\n    return jnp.log(step.metrics.speed - 100.0)\n"
ELSEWHERE = re.compile(r"JAX_PLATFORMS=cuda")  # what a process decides when it starts

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder as a user has one: a short run, a bank of another version, a reward of one's own, runs with it and with damage.

    The run learnt nothing: no command reads what it learnt, and there is less to compile.
    """
    folder = tmp_path_factory.mktemp("here")
    config = smoke(folder / "runs" / "mine", "evaluation.enable=false", "iterations=1")
    prepared = training_loop.prepare(config)
    learns_nothing = lambda state, _: (replace(state, iteration=state.iteration + 1), {"steps/spawned": 1.0})  # noqa: E731
    train(config, prepared=prepared._replace(trainer=prepared.trainer._replace(train_iteration=learns_nothing)))
    (folder / "old.bank").mkdir()
    (folder / "old.bank" / bank_index.INDEX).write_text(json.dumps({"format": bank_index.FORMAT, "schema": 2}))
    (folder / "my_reward.py").write_text(OWN_REWARD)
    shutil.copytree(folder / "runs" / "mine", folder / "runs" / "damaged")
    (folder / "runs" / "damaged" / "checkpoints" / "2.npz").write_text("{")
    run_config.write(folder / "runs" / "theirs", smoke(None, "+reward.haste={_target_: my_reward.haste, weight: 1.0}"))
    return folder


@pytest.fixture
def lacking(monkeypatch):
    """A machine without the extras and with too little memory, whatever this one has."""
    found = settings.importlib.util.find_spec
    monkeypatch.setattr(settings.importlib.util, "find_spec", lambda name, *rest: None if name == "imageio_ffmpeg" else found(name, *rest))
    for name in ("ray", "gymnasium"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "scenefactory_jax.adapters.gymnasium", raising=False)
    assign = scene_source.assign_scenes

    def short_of_memory(scenes, worlds, **rest):
        return assign(scenes, worlds, **rest) if worlds < 10_000 else jnp.zeros((10**15,), jnp.uint8)

    monkeypatch.setattr(scene_source, "assign_scenes", short_of_memory)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def said(command, folder, monkeypatch, capsys) -> str:
    """What a command of the page prints, called in a folder; paths are relative to it."""
    monkeypatch.chdir(folder)
    if ELSEWHERE.search(command):
        environment, arguments = command.split(CALL)
        done = shell(folder, *shlex.split(arguments), **dict(one.split("=") for one in environment.split()))
        return done.stdout + done.stderr
    if not command.startswith(CALL):
        with pytest.raises(ImportError) as caught:
            exec(command.removeprefix("python -c ").strip('"'), {})
        return traceback.format_exception_only(caught.value)[-1]
    monkeypatch.syspath_prepend(str(folder))
    arguments = shlex.split(command.removeprefix(CALL))
    monkeypatch.setattr(sys, "argv", ["scenefactory_jax", *arguments])
    try:
        command_line.main()
    except SystemExit as stopped:
        assert stopped.code == 2
    captured = capsys.readouterr()
    return captured.out + captured.err


def normal(text: str, folder: Path) -> str:
    """Without the machine: where the folder lies, how much an allocation was, progress bars."""
    text = text.replace(f"{folder.resolve()}/", "").replace(f"{folder}/", "")
    lines = [line.rstrip() for line in re.sub(r"allocating \d+ bytes", "allocating N bytes", text).splitlines()]
    return "\n".join(line for line in lines if line and not re.match(r"convert +\d+%", line))


def test_the_page_shows_every_likely_mistake():
    headings = re.findall(r"^## \d+\. (.+)$", PAGE, re.MULTILINE)
    assert len(headings) == 12 and len(SHOWN) >= 12 and PAGE.count("```console") == len(SHOWN)
    assert all("Traceback" not in text for _, text in SHOWN)


@pytest.mark.parametrize(("command", "quoted"), SHOWN, ids=[command[:70] for command, _ in SHOWN])
def test_the_page_quotes_what_is_printed(command, quoted, place, lacking, monkeypatch, capsys):
    printed, expected = normal(said(command, place, monkeypatch, capsys), place), normal(quoted, place)
    if expected.startswith("...\n"):  # the page leaves out what stands before
        assert f"\n{printed}".endswith(expected[3:])
    else:
        assert printed == expected


def test_a_car_that_breaks_does_not_end_training():
    broken = {"iteration": 3, "reward/haste": float("nan"), "ppo/skipped": 4.0, "ppo/gradient_norm": 0.0}
    with pytest.raises(ConfigError, match=r"reward\.haste: nan in iteration 3"):
        training_loop.check_finite(broken)
    for sound in ({"reward/haste": 1.0}, {"ppo/skipped": 0.0}, {"ppo/gradient_norm": 0.3}):  # it learnt, or no term is at fault
        training_loop.check_finite({**broken, **sound})


def test_an_error_of_our_own_keeps_its_traceback():
    assert error_messages.explain_error(RuntimeError("a bug"), {}) is None and error_messages.explain_error(AssertionError(), {}) is None
    assert error_messages.explain_error(KeyError("worlds"), {"worlds": 4}) is None
    told = error_messages.explain_error(
        MemoryError("Unable to allocate 1.53 GiB for an array with shape (400000, 1024)"), {"worlds": 400000}
    )
    assert told is not None and "out of memory: Unable to allocate 1.53 GiB" in told and "worlds=400000" in told
