"""Levels of difficulty: what makes a scene hard by hand, when the next level begins, and that a resumed stream stays at its level."""

import itertools
import json
import math

import numpy as np
import pytest

from scenefactory_jax.cli import hydra_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.parallel import task_map
from scenefactory_jax.data.loading import batches, curriculum, samplers, scene_source, stream

pytestmark = pytest.mark.usefixtures("quickly")

LEVELS, SCENES, WORLDS = 3, 12, 4
SETTINGS = curriculum.Curriculum(levels=LEVELS, promote_at=0.7, min_episodes=8, traffic_weight=10.0)
STATE = {"level": 0, "levels": [index % LEVELS for index in range(SCENES)]}


def entry(*overrides):
    """Streets of a car that drives 5 m straight on from its start; index modulo 3 is the number of other cars, which drive, too."""
    found = hydra_config.load_config(
        "train", "experiment=smoke", "stream=levels", "stream.workers=0", "stream.sample=4", "stream.swap_fraction=0.5", f"worlds={WORLDS}",
        f"scenes.count={SCENES}", "scenes.pack.agents=1", "scenes.pack.traffic=4", f"stream.curriculum.levels={LEVELS}",
        "stream.curriculum.min_episodes=8", "stream.curriculum.traffic_weight=10", *overrides,
    )  # fmt: skip
    found["scenes"]["generate"] = {"_target_": "support.streets.street", "unusable": [], "broken": [], "deadly": [], "endless": []}
    return found


def swap(state, held, worlds, fresh):
    return state, fresh


def advance(flow, turns, goals):
    """Exchanges scenes that often; every world's agents end three episodes a turn, `goals` of them at the goal."""
    held, rows = flow.scenes(), []
    for _ in range(turns):
        _, held = flow.exchange(swap, None, held)
        flow.draw()
        rows.append(flow.note(np.full(WORLDS, 3), np.full(WORLDS, goals)))
    return held, rows, json.loads(json.dumps(flow.state()))


def levels_of(indices):
    return {index % LEVELS for index in np.ravel(indices).tolist()}


# ---- difficulty


def test_a_straight_track_is_as_hard_as_it_is_long():
    x = np.arange(0.0, 20.5, 0.5)
    assert curriculum.measure_track(np.stack([x, 0 * x], axis=1), 7.0) == pytest.approx(20.0)


def test_a_quarter_of_a_circle_adds_half_its_length():
    angle = np.linspace(0.0, math.pi / 2, 400)
    track = 50.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    length = 50.0 * math.pi / 2
    assert curriculum.measure_track(track, 0.0) == pytest.approx(length * 1.5, rel=0.02)


def test_corners_to_either_side_add_up():
    """Right angles to the left, to the right and across the direction of -x: 1.5 pi in all."""
    corners = np.array([[0, 0], [10, 0], [10, 10], [0, 10], [0, 20]], float)
    track = np.concatenate([np.linspace(a, b, 50, endpoint=False) for a, b in itertools.pairwise(corners)] + [corners[-1:]])
    assert curriculum.measure_track(track, 0.0) == pytest.approx(40.0 * 2.5, rel=0.01)


def test_noise_of_a_car_that_stands_is_no_bend():
    noise = np.random.default_rng(0).normal(0.0, 0.05, (90, 2))
    assert curriculum.measure_track(noise, 12.0) == 12.0 and curriculum.measure_track(np.zeros((0, 2)), 3.0) == 3.0


def test_the_difficulty_of_a_packed_scene_by_hand():
    config = entry()["scenes"]
    source, packing = scene_source.open_source(config), scene_source.make_packing(config)
    loader = batches.BatchLoader(source, **packing, grid=config["road_grid"], task_map=task_map.in_process)
    for weight in (0.0, 10.0):
        found = list(loader.each(lambda read, weight=weight: curriculum.compute_difficulty(read(), traffic_weight=weight), range(4)))
        np.testing.assert_allclose(found, 5.0 + weight * np.array([0, 1, 2, 0]), atol=1e-4)


def test_levels_hold_equally_many_scenes_in_order_of_difficulty():
    found = curriculum.sort_into_levels(np.array([5.0, np.nan, 1.0, 9.0, 2.0, 7.0]), 2)
    assert found.tolist() == [0, -1, 0, 1, 0, 1]
    with pytest.raises(ConfigError, match=r"stream\.curriculum\.levels: expected as many as there are scenes, 1, or fewer, got 2"):
        curriculum.sort_into_levels(np.array([1.0, np.nan]), 2)


# ---- promotion


@pytest.mark.parametrize(
    ("episodes", "successes", "moves"), [(8, 6, True), (7, 7, False), (10, 7, True), (10, 6, False)], ids=["passes", "few", "just", "fails"]
)
def test_success_in_enough_episodes_promotes(episodes, successes, moves):
    """Episodes of another level do not count."""
    levels = curriculum.Levels(SETTINGS, STATE)
    table = samplers.empty(SCENES)
    table.episodes[3], table.successes[3] = episodes, successes
    table.episodes[4], table.successes[4] = 100, 100
    moved, row = levels.promote(table)
    assert moved is moves and levels.level == int(moves)
    assert row == {"curriculum/level": 1, "curriculum/success": successes / episodes}


def test_the_last_level_is_not_left():
    levels, table = curriculum.Levels(SETTINGS, {**STATE, "level": 2}), samplers.empty(SCENES)
    table.episodes[:], table.successes[:] = 9, 9
    assert levels.promote(table)[0] is False and levels.level == 2


def test_scenes_of_the_next_level_follow_a_success_and_the_old_ones_leave():
    with stream.open_stream(entry(), mesh=None, before=None) as flow:
        held, rows, state = advance(flow, 3, goals=1)
        assert [row["curriculum/level"] for row in rows] == [1, 1, 1] and rows[-1]["curriculum/success"] == pytest.approx(1 / 3)
        assert levels_of(state["placed"]) == levels_of(state["waiting"]) == {0} and state["curriculum"] == STATE
        flow.note(np.full(WORLDS, 30), np.full(WORLDS, 30))
        state = flow.state()
        assert levels_of(state["placed"]) == {0} and levels_of(state["waiting"]) == {1} and state["curriculum"]["level"] == 1
        for _ in range(2):  # half of the worlds at once
            _, held = flow.exchange(swap, None, held)
            flow.draw()
        row = flow.note(np.full(WORLDS, 1), np.full(WORLDS, 0))
        assert levels_of(flow.state()["placed"]) == {1} and row["curriculum/level"] == 2 and row["curriculum/success"] == 0.0


@pytest.mark.parametrize("sampler", ["shuffled", "prioritize_failures"])
def test_a_resumed_stream_goes_on_at_its_level(sampler):
    found = entry()
    found["stream"]["sampler"] = {"_target_": sampler} | ({"floor": 0.5} if sampler == "prioritize_failures" else {})
    with stream.open_stream(found, mesh=None, before=None) as flow:
        _, rows, state = advance(flow, 3, goals=3)
        _, more, whole = advance(flow, 3, goals=2)
    with stream.open_stream(found, mesh=None, before=state) as flow:
        _, again, resumed = advance(flow, 3, goals=2)
    clean = lambda rows: [{name: value for name, value in row.items() if name != "stream/wait_s"} for row in rows]  # noqa: E731
    assert state["curriculum"]["level"] == 2 and rows[0]["curriculum/level"] == 1
    assert resumed == whole and clean(again) == clean(more)


def test_a_stream_without_a_curriculum_stores_and_logs_none():
    found = entry()
    found["stream"]["curriculum"] = None
    with stream.open_stream(found, mesh=None, before=None) as flow:
        _, rows, state = advance(flow, 1, goals=3)
    assert "curriculum" not in state and not [name for name in rows[0] if name.startswith("curriculum")]


def test_numbers_that_cannot_work_are_named():
    with pytest.raises(ConfigError, match=r"stream\.curriculum\.promote_at: expected a number > 0 and <= 1, got 1\.5"):
        schema.read(entry("stream.curriculum.promote_at=1.5")["stream"], stream.StreamConfig, where="stream")
