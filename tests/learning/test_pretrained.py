"""The policies that come with the package: small, told about, ours to ship, and able to drive."""

import re

import jax
import jax.numpy as jnp
import pytest
from support.choosing import slow_except
from support.running import ROOT

import scenefactory_jax as sf
from scenefactory_jax.cli import hydra_config
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation.metrics import agent_metrics
from scenefactory_jax.learning import policy_io, run_paths

SHIPPED = [file.parent for file in sorted(run_paths.SHIPPED.glob("*/config.yaml"))]
TOWN = run_paths.SHIPPED / "town" / "README.md"


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_policy_is_small_and_has_a_card(folder):
    assert sum(file.stat().st_size for file in folder.rglob("*")) < 1_000_000
    card = (folder / "README.md").read_text()
    assert card.startswith(f"# {folder.name}\n") and "## Training" in card and "## Scores" in card and "agent steps" in card


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_policy_was_trained_on_generated_scenes(folder):
    scenes = hydra_config.read(folder)["scenes"]
    assert scenes["path"] is None and scenes["heldout"]["path"] is None
    assert scenes["generate"]["_target_"].startswith("scenefactory_jax.data.generators.") and scenes["seed"] != scenes["heldout"]["seed"]


@pytest.mark.parametrize("folder", slow_except(SHIPPED, TOWN.parent), ids=lambda folder: folder.name)
def test_a_policy_fits_its_networks_and_observations(folder):
    """Of this version. How well one drives is a slow test's."""
    trained = policy_io.load_policy(folder)
    config = hydra_config.apply_overrides(trained.config, ["scenes.heldout.count=1"])
    scene = scene_source.load_heldout_scenes(config["scenes"], path=None)[0]
    observed = jax.eval_shape(environment.make_env(config).reset, jax.random.key(0), scene)[1]
    drawn = jax.eval_shape(trained.policy.init, jax.random.key(0), observed)
    assert jax.tree.map(jnp.shape, trained.parameters) == jax.tree.map(jnp.shape, drawn)
    action, *_ = jax.eval_shape(trained.policy.apply, trained.parameters, observed)
    assert action.shape == (config["scenes"]["pack"]["agents"], 3)


def drive_town(out, *, scenes, untrained, dynamics):
    overrides = f"overrides=[spawning=logged,weather=dry,dynamics={dynamics},scenes.heldout.count={scenes},timing.episode_s=12]"
    plainly = ["protocol.termination=[strict]", f"untrained={untrained}", "video.enable=false", "failures.pictures.enable=false"]
    return sf.evaluate(sf.load_config("evaluate", "run=town", f"out={out}", overrides, *plainly)).records


@pytest.mark.slow
def test_town_drives_on_other_scenes(tmp_path, quickly):
    records = drive_town(tmp_path, scenes=1, untrained="false", dynamics="articulated")["strict"]
    bends = records["route_m"] >= agent_metrics.BEND * records["start_distance_m"]
    assert len(records["goal_reached"]) >= 4 and bends.any()
    assert records["goal_reached"].mean() > 0.75 and records["goal_reached"][bends].any()


def test_figures_of_the_readme_are_those_of_the_card():
    row = r"^\| 64 held-out Waymo scenes \(womd_test, protocol=recorded\) \| goal_only \| 369 \| (.+) \|$"
    rows = re.findall(row, TOWN.read_text(), re.MULTILINE)
    success, clean, _, collided, *_ = rows[0].split(" | ")
    said = " ".join((ROOT / "README.md").read_text().split())
    assert f"it reaches the goal in {success}, without any other event in {clean}, and {collided} of its cars collide" in said


def test_the_readme_says_what_the_card_of_drive_does():
    card = (run_paths.SHIPPED / "drive" / "README.md").read_text()
    lines = [line for line in card.splitlines() if line.startswith("| Driven") or ("(protocol=route100" in line and line.startswith("|"))]
    header, row = ([cell.strip() for cell in line.split("|")] for line in lines)
    said = " ".join((ROOT / "README.md").read_text().split())
    assert f"completes {row[header.index('Clean completion')]} of the routes of `route100` in new towns without any event" in said


@pytest.mark.slow  # the car it learnt in, and the policy before training
def test_town_drives_better_than_before_training(tmp_path, quickly):
    found = drive_town(tmp_path, scenes=2, untrained="true", dynamics="articulated")
    records, before = found["strict"], found["strict, untrained"]  # which came with no checkpoint
    assert len(before["goal_reached"]) == len(records["goal_reached"]) >= 8
    assert before["clean"].mean() < records["clean"].mean() and records["goal_reached"].mean() > 0.75
