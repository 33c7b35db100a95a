"""Reward weights that agents draw: from their range, one for each start, in the reward and in the observation."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.gliding import build_env, drive, jitted
from support.hand_scenes import scene_of

import scenefactory_jax
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.data.loading.scene_source import Scenes
from scenefactory_jax.env import environment, observations, rewards
from scenefactory_jax.evaluation import episode_records

pytestmark = pytest.mark.usefixtures("quickly")

CARS, GOALS = [[0.0, 0.0], [40.0, 0.0], [-40.0, 0.0]], [[6.0, 0.0], [90.0, 0.0], [0.0, 30.0]]
RANGES = {"goal": [20.0, 60.0], "progress": [1.0, 3.0], "idle": [-1.0, -1.0]}


def with_ranges(**changes):
    config = scenefactory_jax.load_config("task")
    reward = {name: dict(entry) for name, entry in config["reward"].items()}
    for name, span in RANGES.items():
        reward[name] |= {"weight": span, **changes.get(name, {})}
    return {**config, "reward": reward, "observations": {**config["observations"], "reward_weights": {"_target_": "reward_weights"}}}


@pytest.fixture(scope="module")
def driven():
    """States before and after each of 40 steps, and the results: the first car reaches its goal and starts again."""
    env, scene = build_env(with_ranges(), respawn=10.0), scene_of(CARS, GOALS, speeds=[6.0, 0.0, 1.0])
    state, observation = env.reset(jax.random.key(0), scene)
    moments, seen = [state], [observation]
    results = []
    for _ in range(40):
        state, result = jitted(env.step)(scene, state, jnp.zeros((3, 3)))
        moments.append(state)
        seen.append(result.observation)
        results.append(result)
    return jax.device_get((moments, seen, results))


def test_every_agent_draws_its_own_weights_within_the_range(driven):
    moments, _, _ = driven
    for name, (low, high) in RANGES.items():
        drawn = np.stack([moment.reward_weights[name] for moment in moments])
        assert ((drawn >= low) & (drawn <= high)).all(), name
        assert len(np.unique(drawn[0])) == (3 if low < high else 1), name


def test_draws_are_uniform_and_independent_between_terms_and_worlds():
    terms = rewards.make(with_ranges()["reward"])
    drawn = jax.jit(jax.vmap(lambda key: rewards.draw_weights(key, terms, 8)))(jax.random.split(jax.random.key(1), 500))
    goal, progress = (np.asarray(drawn[name]).ravel() for name in ("goal", "progress"))
    assert goal.mean() == pytest.approx(40.0, abs=1.0) and goal.std() == pytest.approx(40.0 / 12**0.5, rel=0.05)
    assert abs(np.corrcoef(goal, progress)[0, 1]) < 0.06


def test_weights_last_for_an_episode_and_change_at_a_new_start(driven):
    moments, _, results = driven
    starts = np.stack([after.steps_since_spawn <= before.steps_since_spawn for before, after in itertools.pairwise(moments)])
    starts &= np.stack([moment.active for moment in moments[1:]])
    changed = np.stack([b.reward_weights["goal"] != a.reward_weights["goal"] for b, a in itertools.pairwise(moments)])
    assert starts[:, 0].sum() >= 1 and not starts[:, 1].any()
    np.testing.assert_array_equal(changed, starts)
    assert sum(bool(result.events.goal_reached[0]) for result in results) >= 2


def test_the_reward_is_the_sum_of_terms_with_the_weights_drawn(driven):
    """At the goal: the drawn weight; on the way, progress by hand; each step with the weights of before a new start."""
    moments, _, results = driven
    for before, result in zip(moments, results, strict=False):
        weights = before.reward_weights
        np.testing.assert_array_equal(result.terms["goal"], weights["goal"] * result.events.goal_reached)
        progress = np.where(before.active, weights["progress"] * np.clip(result.metrics.progress, -2.0, 2.0), 0.0)
        np.testing.assert_allclose(result.terms["progress"], progress, rtol=1e-6)
        np.testing.assert_allclose(result.reward, sum(result.terms.values()), rtol=1e-5, atol=1e-6)
    assert results[0].terms["progress"][2] > 0.0 or results[0].terms["progress"][0] > 0.0


def test_the_observation_shows_the_weights_from_minus_1_to_1(driven):
    moments, seen, _ = driven
    for moment, observation in zip(moments, seen, strict=True):
        goal, progress = moment.reward_weights["goal"], moment.reward_weights["progress"]
        expected = np.stack([(goal - 40.0) / 20.0, np.zeros(3), progress - 2.0], axis=1)  # goal, idle, progress
        np.testing.assert_allclose(observation["reward_weights"], expected * moment.active[:, None], atol=1e-5)


@pytest.mark.slow
def test_an_evaluation_holds_the_middle_or_the_weight_that_is_given():
    held = rewards.hold_weights(with_ranges(goal={"held": 55.0})["reward"])
    assert {name: held[name]["held"] for name in RANGES} == {"goal": 55.0, "progress": 2.0, "idle": -1.0}
    config = {**with_ranges(), "reward": held}
    assert all("held" not in held[name] for name in held.keys() - RANGES.keys())
    drawn = rewards.draw_weights(jax.random.key(0), rewards.make(held), 3)
    np.testing.assert_array_equal(drawn["goal"], np.full(3, 55.0, np.float32))
    group = observations.make({"w": {"_target_": "reward_weights"}}, reward_ranges=rewards.read_ranges(config["reward"]))["w"]
    scene = scene_of(CARS, GOALS)
    state, _ = drive(build_env(config), scene, jnp.zeros((3, 3)), 1)
    np.testing.assert_allclose(group(scene, state), np.broadcast_to([0.75, 0.0, 0.0], (3, 3)))


def test_fixed_weights_leave_state_and_reward_as_they_were():
    config = scenefactory_jax.load_config("task")
    assert rewards.draw_weights(jax.random.key(0), rewards.make(config["reward"]), 3) == ()
    assert rewards.read_ranges(config["reward"]) == {} and rewards.hold_weights(config["reward"]) == config["reward"]
    fixed, ranged = (rewards.make({"goal": {"_target_": "idle", "weight": weight}})["goal"][0] for weight in (3, [3, 4]))
    assert fixed == 3.0 and type(fixed) is float and ranged == rewards.WeightRange(3.0, 4.0, None)


def test_the_middle_of_the_conditioned_reward_is_drive():
    drives, conditioned = (scenefactory_jax.load_config("task", f"reward={name}")["reward"] for name in ("drive", "drive_conditioned"))
    held = rewards.hold_weights(conditioned)
    given = scenefactory_jax.apply_overrides({"reward": conditioned}, ["reward.progress.held=2.5"])["reward"]
    assert rewards.hold_weights(given)["progress"]["held"] == 2.5
    assert {name: entry and entry.get("held", entry["weight"]) for name, entry in held.items()} == {
        name: entry and entry["weight"] for name, entry in drives.items()
    }


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"weight": [3.0, 1.0]}, r"reward\.idle\.weight: expected a number or \[min, max\], got \[3\.0, 1\.0\]"),
        ({"weight": [1.0]}, r"reward\.idle\.weight: expected a number or \[min, max\], got \[1\.0\]"),
        ({"weight": [1.0, 2.0], "held": 3.0}, r"reward\.idle\.held: expected a number of the range .*=\[1\.0, 2\.0\], or null, got 3"),
        ({"weight": 1.0, "held": 1.0}, r"reward\.idle\.held: unknown key; valid: none"),
    ],
)
def test_ranges_that_cannot_be_drawn_from_are_named(entry, message):
    with pytest.raises(ConfigError, match=message) as error:
        rewards.make({"idle": {"_target_": "idle", **entry}})
    assert "\n" not in str(error.value)


def test_showing_weights_that_nobody_draws_is_refused():
    config = {**with_ranges(), "reward": scenefactory_jax.load_config("task")["reward"]}
    with pytest.raises(ConfigError, match=r"observations\.reward_weights: expected a reward term with a range"):
        build_env(config).reset(jax.random.key(0), scene_of(CARS, GOALS))


def test_the_episodes_of_an_evaluation_have_held_weights(monkeypatch):
    """The environment that an evaluation builds: neither training's respawns nor its draws."""
    built = []

    def build(config):
        built.append(config)
        raise InterruptedError

    monkeypatch.setattr(environment, "make_env", build)
    scenes = Scenes(jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], scene_of(CARS, GOALS)), ("street",), "")
    with pytest.raises(InterruptedError):
        numbers = {"repeats": 1, "seed": 0}
        episode_records.make_episode_runner(with_ranges(), scenes, settings=numbers, worlds=0)
    assert {name: built[0]["reward"][name]["held"] for name in RANGES} == {"goal": 40.0, "progress": 2.0, "idle": -1.0}
