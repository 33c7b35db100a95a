"""WOSAC's scores of scenes that lack something, on a straight street by hand, and files of rollouts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.evaluation.metrics import wosac_scores, wosac_submission
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import Lights, Lines, RoadMap

FUTURE, ROLLOUTS = 80, 4
pytestmark = pytest.mark.usefixtures("quickly")
VARIANTS = ("all", "no edges", "no lights", "no vehicle", "nothing logged")


def make_scene(variant):
    """Two cars drive along a street at 10 m/s and pass a red light after 2 s, at 30 m; the first rollout stands still.

    The third object is absent now, and later stands where the first one drives: no rollout has it.
    """
    steps = np.arange(HISTORY_STEPS + FUTURE)
    state = np.zeros((3, len(steps), 4), np.float32)
    state[:2, :, 0] = steps
    state[:2, :, 1] = [[2.0], [-2.0]]
    state[2, :, :2] = 30.0, 2.0
    valid = np.ones(state.shape[:2], bool)
    valid[2, : HISTORY_STEPS + 1] = False
    rollouts = np.repeat(state[None, :, HISTORY_STEPS:], ROLLOUTS, axis=0)
    rollouts[0, :2, :, 0] = 10.0
    edge = lambda y, way: [[-50.0 * way, y, 0.0], [200.0 * way, y, 0.0]]  # noqa: E731
    edges = Lines(
        jnp.array(edge(-6.0, 1) + edge(6.0, -1)), jnp.array([0, 0, 1, 1]), jnp.full(4, variant != "no edges")
    )  # the road lies to the left of each
    lanes = Lines(jnp.array([[-50.0, 0.0, 0.0], [200.0, 0.0, 0.0]]), jnp.array([7, 7]), jnp.ones(2, bool))
    red = jnp.full((len(steps), 1), 0 if variant == "no lights" else 4)
    lights = Lights(jnp.array([7]), red, jnp.array([[30.5, 0.0, 0.0]]))
    log = Objects(jnp.asarray(state), jnp.asarray(valid), jnp.tile(jnp.array([4.0, 2.0, 1.5]), (3, 1)))
    kept = jnp.full(2, variant != "nothing logged")
    vehicle = jnp.full(3, variant != "no vehicle")
    return log, jnp.asarray(rollouts), jnp.array([0, 1]), kept, vehicle, RoadMap(edges, lanes, lights)


@functools.cache
def scores():
    """Scores of all variants, by name."""
    score = jax.vmap(functools.partial(wosac_scores.score_rollouts, challenge=wosac_scores.CHALLENGES[2025]))
    scenes = jax.device_put(jax.tree.map(lambda *rows: np.stack(rows), *map(make_scene, VARIANTS)))
    found = jax.tree.map(np.asarray, jax.jit(lambda scenes: score(*scenes))(scenes))
    return {name: jax.tree.map(lambda values, row=row: values[row], found) for row, name in enumerate(VARIANTS)}


def list_invalid(found):
    """Names of the scores that a scene does not determine."""
    named = found.likelihoods | found.buckets | {"meta": found.meta, "ade": found.ade, "min_ade": found.min_ade}
    return {name for name, score in named.items() if not score.valid}


EDGES, LIGHTS_ONLY = {"distance_to_road_edge", "offroad", "map", "meta"}, {"light_violation"}


@pytest.mark.parametrize(
    ("variant", "invalid"),
    [
        ("all", set()),
        ("no edges", EDGES),
        ("no lights", LIGHTS_ONLY),
        ("no vehicle", {"time_to_collision", "light_violation", "interactive", "meta"}),
        ("nothing logged", {*wosac_scores.WEIGHTS, *wosac_scores.BUCKETS, "meta", "ade", "min_ade"}),
    ],
)
def test_scores_that_a_scene_lacks_are_marked(variant, invalid):
    assert list_invalid(scores()[variant]) == invalid


def test_scores_of_the_street():
    found = scores()["all"]
    stands = 1 / ROLLOUTS
    assert found.rates["light_violation"].value == 1 - stands
    assert found.rates["collision"].value == found.rates["offroad"].value == 0
    assert found.likelihoods["collision"].value > 0.99  # the absent object is left out of the log, too
    np.testing.assert_allclose(found.likelihoods["light_violation"].value, 1 - stands, atol=1e-3)
    mean = np.arange(1, FUTURE + 1).sum() / (FUTURE + HISTORY_STEPS)
    np.testing.assert_allclose([found.ade.value, found.min_ade.value], [mean * stands, 0.0], rtol=1e-5)
    speeds = FUTURE * (ROLLOUTS - 1) - (ROLLOUTS - 1)  # in the log's bin: all of rollouts that drive, except for their last step
    np.testing.assert_allclose(found.likelihoods["linear_speed"].value, (speeds + 0.1) / (FUTURE * ROLLOUTS + 1), rtol=1e-5)


def test_a_scene_without_lights_counts_as_without_violations():
    lit, dark = scores()["all"], scores()["no lights"]
    np.testing.assert_allclose(dark.likelihoods["light_violation"].value, 1.0, atol=1e-3)
    gained = dark.likelihoods["light_violation"].value - lit.likelihoods["light_violation"].value
    np.testing.assert_allclose(dark.meta.value - lit.meta.value, 0.05 * gained, rtol=1e-4)


def test_means_leave_out_what_is_not_counted():
    mean = wosac_scores.average(jnp.array([1.0, jnp.nan, 2.0]), jnp.array([True, False, True]))
    assert mean.value == 1.5 and mean.valid
    assert not wosac_scores.average(jnp.ones(2), jnp.zeros(2, bool)).valid


@pytest.mark.parametrize(("year", "total"), [(2023, 0.99), (2024, 1.0), (2025, 1.0)])
def test_weights_sum_as_published(year, total):
    np.testing.assert_allclose(sum(wosac_scores.CHALLENGES[year].weights.values()), total)


def test_a_file_of_rollouts_reads_as_written(tmp_path):
    rollouts = np.random.default_rng(0).normal(size=(32, 3, FUTURE, 4)).astype(np.float32)
    written = wosac_submission.SceneRollouts("scene/1", np.array([7, 3, 2314]), rollouts, np.array([8123.456, -4000.5, 12.0]))
    path = wosac_submission.write_rollouts(tmp_path, written)
    assert path.name == "scene_1.npz"
    read = wosac_submission.read_rollouts(path)
    assert read.scenario_id == written.scenario_id
    for found, expected in zip(read[1:], written[1:], strict=True):
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == expected.dtype


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object_id": np.array([1, 1])}, "object_id: expected 2 different ids, got 1"),
        ({"trajectory": np.zeros((32, 2, 79, 4), np.float32)}, r"trajectory: expected \[rollouts, 2, 80, 4\], got \(32, 2, 79, 4\)"),
        ({"trajectory": np.full((32, 2, 80, 4), np.nan, np.float32)}, "trajectory: a value is not finite"),
    ],
)
def test_rollouts_that_do_not_fit_are_refused(tmp_path, change, message):
    whole = wosac_submission.SceneRollouts("a", np.array([1, 2]), np.zeros((32, 2, 80, 4), np.float32), np.zeros(3))
    with pytest.raises(ValueError, match=message):
        wosac_submission.write_rollouts(tmp_path, whole._replace(**change))
    assert not list(tmp_path.iterdir())
