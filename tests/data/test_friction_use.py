"""u of the suite grip over all agents of all scenes, and the speeds and table columns that follow."""

from collections import Counter

import jax
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Agents, Scene
from scenefactory_jax.data.loading.scene_source import load_training_scenes
from scenefactory_jax.data.packing.friction_use import spread_uses

G, SLOTS = 9.81, 4
LENGTH_M = np.array([[10.0, 20.0, 30.0, 40.0]] * 3)


def scenes(counts, speed):
    """Stacked scenes with agents in their first slots."""
    one = scene_of([(9.0 * slot, 0.0) for slot in range(SLOTS)], [(50.0, 0.0)] * SLOTS)
    stacked = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * len(counts)), one)
    present = np.arange(SLOTS) < np.array(counts)[:, None]
    agents = unchecked(Agents, **vars(stacked.agents) | {"present": present, "speed": np.asarray(speed, np.float32)})
    return unchecked(Scene, **vars(stacked) | {"agents": agents})


@pytest.mark.parametrize(("name", "column", "factor"), [("grip", "bend_radius_m", 1.0), ("grip_stops", "stop_distance_m", 2.0)])
def test_every_u_has_as_many_agents_and_speeds_follow(name, column, factor):
    entry = load_config("train", f"scenes/pack/starts={name}", "scenes/pack/routes=route100")["scenes"]["pack"]["starts"] | {"mu": 0.3}
    in_turn = np.array(entry["use"])[np.arange(SLOTS) % 3]  # as each scene was packed
    packed = scenes([1, 4, 2], np.sqrt(factor * in_turn * 0.3 * G * LENGTH_M))
    found, columns = spread_uses(packed, entry)
    present = packed.agents.present
    assert columns["friction_use"][present].tolist() == [0.6, 0.8, 1.0, 0.6, 0.8, 1.0, 0.6]
    counts = Counter(columns["friction_use"][present].tolist())
    assert max(counts.values()) - min(counts.values()) <= 1
    np.testing.assert_allclose(columns[column][present], LENGTH_M[present], rtol=1e-5)
    expected = np.sqrt(factor * columns["friction_use"] * 0.3 * G * LENGTH_M)
    np.testing.assert_allclose(found.agents.speed[present], expected[present], rtol=1e-6)
    assert found.agents.speed.dtype == np.float32 and found.agents.present is present


@pytest.mark.parametrize("name", [None, "route100"])
def test_other_starts_are_left_as_they_are(name):
    entry = name and load_config("train", f"scenes/pack/starts={name}", "scenes/pack/routes=route100")["scenes"]["pack"]["starts"]
    packed = scenes([2], np.ones((1, SLOTS)))
    found, columns = spread_uses(packed, entry)
    assert found is packed and columns == {}


def test_loaded_scenes_have_the_columns_also_of_a_sample():
    words = [
        "scenes=streets",
        "scenes.count=3",
        "scenes/pack/routes=route100",
        "scenes/pack/starts=grip_stops",
        "scenes.pack.routes.attempts=200",
    ]
    config = load_config("train", *words, "scenes.pack.routes.drawn_length_m=[40,60]", "scenes.pack.routes.drawn=12")["scenes"]
    every, part = (load_training_scenes(config | {"take": {"count": count, "seed": 0}}) for count in (None, 2))
    present = every.scene.agents.present
    use, distance = (every.agent_columns[name][present] for name in ("friction_use", "stop_distance_m"))
    assert present.sum() >= 3 and np.ptp(np.unique(use, return_counts=True)[1]) <= 1
    np.testing.assert_allclose(distance, config["pack"]["starts"]["distance_m"], rtol=1e-5)
    np.testing.assert_allclose(every.scene.agents.speed[present], np.sqrt(2 * use * G * distance), rtol=1e-6)
    rows = [every.names.index(name) for name in part.names]
    np.testing.assert_array_equal(part.agent_columns["friction_use"], every.agent_columns["friction_use"][rows])
