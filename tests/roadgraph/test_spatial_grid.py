"""A search by the grid finds what a search through all segments finds, bit for bit."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.choosing import slow_except
from support.running import SHARED

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.core.types import Motion
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import observations
from scenefactory_jax.roadgraph import spatial_grid

pytestmark = pytest.mark.usefixtures("quickly")

WOMD = SHARED / "womd" / "test"
PLACES = 256


def load(*overrides):
    """Stacked scenes without a grid."""
    return scene_source.load_training_scenes(load_config("train", "scenes.road_grid.radius_m=null", *overrides)["scenes"]).scene


@pytest.fixture(scope="module")
def scenes():
    return load("scenes.count=2", "scenes.generate.kinds=[intersection]")


@pytest.fixture(scope="module")
def womd_scenes():
    if not WOMD.is_dir():
        pytest.skip(f"no data at {WOMD}")
    return load("scenes=womd", f"scenes.path={sorted(WOMD.iterdir())[0]}")


def places(scene, seed):
    """Positions on the road, around it, far outside, and on the corners of cells."""
    rng = np.random.default_rng(seed)
    road = np.asarray(scene.road.midpoint)[np.asarray(scene.road.valid)]
    on = rng.choice(road, PLACES // 2) + rng.normal(0.0, 3.0, (PLACES // 2, 2))
    around = rng.uniform(-150.0, 150.0, (PLACES // 4, 2))
    corners = np.asarray(scene.road_grid.origin) + 5.0 * rng.integers(0, scene.road_grid.side + 1, (PLACES // 4 - 2, 2))
    return np.concatenate([on, around, corners, [[1e4, -1e4], [np.inf, 0.0]]]).astype(np.float32)


def look(count):
    """The road observation of cars at positions."""

    def at(scene, position):
        agents = len(position)
        zeros = jnp.zeros(agents, jnp.float32)
        motion = Motion(
            position=jnp.concatenate([position, zeros[:, None]], axis=1), velocity=jnp.zeros((agents, 3)), yaw=0.1 * jnp.arange(agents),
            **dict.fromkeys(("yaw_rate", "upright", "steer", "contact_force", "mu", "friction_utilization", "slip"), zeros),
        )  # fmt: skip
        state = type("State", (), {"motion": motion, "active": jnp.ones(agents, bool)})()
        return inspect.unwrap(observations.road)(scene, state, count=count, radius_m=10.0, kind_scale=20.0, kernels=True)

    return jax.jit(at)


GRIDS = [("scenes", 5.0, 350), ("scenes", 3.0, 20), ("womd_scenes", 25.0, 64)]


@pytest.mark.parametrize(("source", "size_m", "count"), slow_except(GRIDS, *GRIDS[:2]))
def test_a_grid_finds_what_a_search_through_all_segments_finds(request, source, size_m, count):
    scenes = request.getfixturevalue(source)
    with_grid, find = spatial_grid.attach_grid(scenes, radius_m=10.0, size_m=size_m), look(count)
    for world in range(len(scenes.log.dt)):
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[world]), with_grid)  # noqa: B023
        position = places(scene, world)
        found, expected = find(scene, position), find(replace(scene, road_grid=None), position)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        assert expected.mask.any(axis=1).sum() > PLACES // 4 and not expected.mask[-2:].any()
        assert int(scene.road_grid.longest_list) < int(scene.road.valid.sum())


def test_a_larger_radius_searches_all_segments(scenes):
    narrow = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), spatial_grid.attach_grid(scenes, radius_m=4.0, size_m=5.0))
    find, position = look(350), places(narrow, 0)
    jax.tree.map(np.testing.assert_array_equal, find(narrow, position), find(replace(narrow, road_grid=None), position))


def test_a_world_without_a_road_has_empty_lists(scenes):
    road = scenes.road
    bare = unchecked(type(scenes), **(vars(scenes) | {"road": unchecked(type(road), **(vars(road) | {"valid": road.valid & False}))}))
    made = spatial_grid.attach_grid(bare, radius_m=10.0, size_m=5.0).road_grid
    assert not made.first.any() and made.longest_list == 1
    one = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), made)
    _, listed = spatial_grid.list_segments(one, *spatial_grid.find_cell_bounds(one, jnp.zeros((3, 2))))
    assert not listed.any()


def test_the_radius_of_the_grid_is_that_of_the_observation():
    assert load_config("train", "experiment=paper")["scenes"]["road_grid"]["radius_m"] == 10.0
    assert load_config("train", "observations.road.radius_m=25")["scenes"]["road_grid"]["radius_m"] == 25
    assert load_config("convert")["scenes"]["road_grid"]["radius_m"] is None
