"""The roadgraph kernels against plain JAX, in Pallas's interpreter; their GPU lowering; derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.abstract_gpu import abstract_gpu

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import geometry
from scenefactory_jax.core.pytree import replace, unchecked
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.roadgraph import queries, road_kernels, spatial_grid

pytestmark = pytest.mark.usefixtures("quickly")
CARS = 24
EDGES = {"half_width_m": 0.05, "range_m": 40.0}
ROWS = {"radius_m": 10.0, "kind_scale": 20.0}


@pytest.fixture(scope="module")
def scenes():
    """Two worlds with more segments than a program takes at once, the second with gaps in its tables."""
    loaded = scene_source.load_training_scenes(load_config("train", "scenes.count=2")["scenes"]).scene
    loaded = spatial_grid.attach_grid(jax.tree.map(np.asarray, replace(loaded, road_grid=None)), radius_m=10.0, size_m=5.0)
    assert min(loaded.lanes.valid.shape[1], loaded.edges.valid.shape[1]) >= road_kernels.QUERY_BLOCK
    gaps = {name: np.array(getattr(loaded, name).valid) for name in ("lanes", "edges")}
    for valid in gaps.values():
        valid[1, ::3] = False
    tables = {name: unchecked(type(loaded.road), **(vars(getattr(loaded, name)) | {"valid": valid})) for name, valid in gaps.items()}
    return jax.device_put(unchecked(type(loaded), **(vars(loaded) | tables)))


@pytest.fixture(scope="module")
def cars(scenes):
    """Cars on the road, around it and far away; every third is not active."""
    rng, worlds = np.random.default_rng(0), 2
    road = np.asarray(scenes.road.midpoint)
    position = np.stack([rng.choice(road[world][np.asarray(scenes.road.valid[world])], CARS) for world in range(worlds)])
    position = (position + rng.normal(0.0, 3.0, position.shape)).astype(np.float32)
    position[:, 0] = 1e4
    yaw = rng.uniform(-3.0, 3.0, (worlds, CARS)).astype(np.float32)
    size = np.broadcast_to(np.array([4.0, 2.0], np.float32), position.shape)
    shape = {"radius_fraction": 0.55, "radius_floor_m": 0.45, "spacing_limit_m": 1.3}
    circles, radius = jax.jit(jax.vmap(lambda *at: geometry.cover_with_circles(*at, **shape)))(position, yaw, size)
    velocity = rng.normal(0.0, 6.0, position.shape).astype(np.float32)
    velocity[:, 2] = 0.0
    active = np.broadcast_to(np.arange(CARS) % 3 > 0, (worlds, CARS))
    return jax.device_put((circles, radius, velocity, yaw, position, active))


@pytest.fixture(scope="module", autouse=True)
def small_blocks():
    with pytest.MonkeyPatch.context() as patch:
        for name in ("QUERY_BLOCK", "GATHER_BLOCK"):
            patch.setattr(road_kernels, name, 64)  # several blocks of what is small enough for a test
        yield


def query(scenes, cars, find):
    """Results of active cars."""
    found = jax.jit(jax.vmap(find))(scenes, *cars)
    return [np.asarray(value)[np.asarray(cars[-1])] for value in found]


def test_the_query_kernel_finds_what_plain_jax_finds(scenes, cars):
    def kernel(scene, circles, radius, velocity, yaw, position, active):
        ahead = geometry.heading_vector(yaw)
        return road_kernels.query_road_blocks(
            scene.lanes, scene.edges, circles, radius, velocity, ahead, position, active, **EDGES, interpret=True
        )

    row, squared, rate = query(scenes, cars, kernel)
    expected = query(scenes, cars, lambda scene, *car: queries.query_road(scene, *car, **EDGES, kernels=False))
    np.testing.assert_array_equal(row, expected[0])
    np.testing.assert_allclose(np.sqrt(squared), expected[1], rtol=1e-5, atol=1e-5)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(1.0 / rate, expected[2], rtol=1e-4)
    assert np.isfinite(expected[2]).sum() > CARS / 4 and (expected[1] < 1.0).any()


def test_a_world_without_a_road_has_nothing_to_find(scenes, cars):
    def find(scene, circles, radius, velocity, yaw, position, active):
        lanes, edges = (replace(table, valid=table.valid & False) for table in (scene.lanes, scene.edges))
        return road_kernels.query_road_blocks(
            lanes, edges, circles, radius, velocity, geometry.heading_vector(yaw), position, active, **EDGES, interpret=True
        )

    row, squared, rate = jax.device_get(jax.jit(jax.vmap(find))(scenes, *cars))
    assert not row.any() and np.isinf(squared).all() and not rate.any()


@pytest.mark.parametrize("count", [20, 350])
def test_the_gathering_kernel_finds_what_plain_jax_finds(scenes, cars, count):
    *_, yaw, position, active = cars

    def kernel(scene, position, yaw, active):
        first, last = spatial_grid.find_cell_bounds(scene.road_grid, position)
        turn = geometry.heading_vector(-yaw)
        last = jnp.where(active, last, first)
        return road_kernels.gather_segment_blocks(
            scene.road, scene.road_grid, first, last, position, turn, count=count, **ROWS, interpret=True
        )

    features, mask = jax.device_get(jax.jit(jax.vmap(kernel))(scenes, position, yaw, active))
    plain = jax.jit(jax.vmap(lambda *given: queries.gather_segments(*given, count=count, **ROWS, kernels=False)))
    expected = plain(scenes, position, yaw, active)
    np.testing.assert_array_equal(mask, expected.mask)
    np.testing.assert_allclose(features, expected.features, atol=1e-5)
    assert mask.all(axis=-1).any() == (count == 20) and mask.any() and not mask[~np.asarray(active)].any()


@pytest.mark.slow
def test_derivatives_are_those_of_plain_jax(scenes, cars):
    """Of both modes, through the choice between kernel and plain JAX."""
    scene = jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[0], scenes))
    circles, radius, velocity, yaw, position, active = jax.device_put([np.asarray(value)[0, 3:] for value in cars])

    def make_total(kernels):
        def total(pose):
            shift, turn = pose[:2], pose[2]
            moved = circles + shift, radius, velocity, yaw + turn, position + shift, active
            road = queries.query_road(scene, *moved, **EDGES, kernels=kernels)
            found = queries.gather_segments(scene, position + shift, yaw + turn, active, count=20, **ROWS, kernels=kernels)
            edges = jnp.where(active & jnp.isfinite(road.edge), road.edge, 0.0).sum()
            times = jnp.where(active & jnp.isfinite(road.edge_ttc), jnp.minimum(road.edge_ttc, 10.0), 0.0).sum()
            return edges + times + (found.features**3).sum()

        return total

    pose = jnp.float32([0.1, 0.2, 0.05])
    expected = jax.jit(jax.grad(make_total(False)))(pose)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(make_total(True)))(pose), expected, rtol=1e-3)
    assert (np.abs(np.asarray(expected)) > 0).all()


def test_a_gpu_gets_kernels_and_other_devices_plain_jax(scenes, cars):
    def text(kernels, platform):
        def both(scene, circles, radius, velocity, yaw, position, active):
            segments = queries.gather_segments(scene, position, yaw, active, count=20, **ROWS, kernels=kernels)
            return segments, queries.query_road(scene, circles, radius, velocity, yaw, position, active, **EDGES, kernels=kernels)

        with abstract_gpu():
            return jax.jit(jax.vmap(both)).trace(scenes, *cars).lower(lowering_platforms=(platform,)).as_text()

    assert "query_road" in text(True, "cuda") and "gather_segments" in text(True, "cuda")
    assert "triton" not in text(True, "cpu") and "triton" not in text(False, "cuda")
