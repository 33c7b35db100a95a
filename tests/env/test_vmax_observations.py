"""V-Max's observations: published sizes, blocks of a scene made by hand, invariance, the published error of velocities, empty worlds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import column_of
from support.planning_scenes import state_of, street, turn

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.env import observations
from scenefactory_jax.env.observations import vmax_blocks
from scenefactory_jax.env.observations.agent_routes import select_routes
from scenefactory_jax.env.observations.vmax import split_observation
from scenefactory_jax.env.observations.vmax_blocks import View
from scenefactory_jax.roadgraph import nearest_rows

SIZES = {"base": 3255, "segment": 1281, "lane": 2155, "road": 1655}
pytestmark = pytest.mark.usefixtures("quickly")


@functools.cache
def entry(kind, *overrides):
    return load_config("task", f"observations=vmax_{kind}", *overrides)["observations"]


@functools.cache
def program(kind, *overrides):
    group = observations.make(entry(kind, *overrides), control_dt=0.1)["vmax"]
    return jax.jit(lambda scene, state: group(scene, state))


@functools.cache
def splitting(kind, *overrides):
    numbers = entry(kind, *overrides)["vmax"]
    view = schema.read(numbers["view"], View)
    rows = numbers["lanes" if kind == "segment" else "road_points"]
    return jax.jit(functools.partial(split_observation, view=view, kind=kind, road_rows=rows))


def blocks(kind, scene, state, *overrides):
    """The observation of the first car, as blocks of numpy."""
    found = splitting(kind, *overrides)(np.asarray(program(kind, *overrides)(scene, state))[0])
    return {name: (np.asarray(block.features), np.asarray(block.mask)) for name, block in found.items()}


@pytest.fixture(scope="module")
def scene():
    return street()


@pytest.mark.parametrize("kind", SIZES)
def test_flat_sizes_are_the_published_ones(scene, kind):
    assert jax.eval_shape(program(kind), scene, state_of(scene)).shape == (2, SIZES[kind])


def test_blocks_of_a_street(scene):
    found = blocks("base", scene, state_of(scene))
    ego, mask = found["ego"]
    assert ego.shape == (1, 5, 7) and mask.all()
    np.testing.assert_allclose(ego[0, :, 0], -5.0 * 0.1 * np.arange(4, -1, -1) / 50, atol=1e-6)  # the oldest first
    np.testing.assert_allclose(ego[0, :, 1:], np.tile([0, 5 / 30, 0, 0, 4 / 50, 2 / 50], (5, 1)), atol=1e-6)
    others, mask = found["others"]
    assert mask[:2].all() and not mask[2:].any() and not others[2:].any()
    np.testing.assert_allclose(others[0, -1], [10 / 50, 0, 8 / 30, 0, 0, 4 / 50, 2 / 50], atol=1e-6)  # the car ahead is nearest
    np.testing.assert_allclose(others[0, 0, 0], (10 - 0.4 * 8) / 50, atol=1e-6)
    np.testing.assert_allclose(others[1, -1], [15 / 50, 5 / 50, 0, 0, 0, 2 / 50, 2 / 50], atol=1e-6)
    lights, mask = found["lights"]
    assert mask[0].all() and not mask[1:].any()  # the stop sign is no light
    np.testing.assert_allclose(lights[0, :, :2], np.tile([20 / 50, 0], (5, 1)), atol=1e-6)
    # the present time is 0.3 s: unknown before 0, red (column of stop) to 0.25 s, then green
    np.testing.assert_array_equal(lights[0, :, 2:].argmax(1) * lights[0, :, 2:].any(1), [0, 3, 3, 3, 5])
    assert not lights[0, 0, 2:].any()
    np.testing.assert_allclose(found["path"][0][:, 0, 0], np.minimum(1 + 5.0 * np.arange(1, 11), 50) / 50, atol=1e-6)
    road, mask = found["road"]
    distance = np.hypot(road[:, 0, 0], road[:, 0, 1])[mask[:, 0]]
    assert (np.diff(distance) >= -1e-6).all() and (road[mask[:, 0]][:, 0, 4:].sum(1) == 1).all()
    x, y = 50 * road[mask[:, 0], 0, 0], 50 * road[mask[:, 0], 0, 1]
    assert x.min() >= -5 and x.max() <= 50
    signs = road[mask[:, 0]][:, 0, 4 + 5] > 0
    assert (x[signs].tolist(), y[signs].tolist()) == (pytest.approx([30.0], abs=1e-5), pytest.approx([3.0], abs=1e-5))
    lane = road[mask[:, 0]][:, 0, 4 + 1] > 0
    along = np.sort(x[lane])
    np.testing.assert_allclose(along[1:] - along[:-1], 2.0, atol=1e-5)  # every second of the points 1 m apart
    assert (y[lane] == 0).all()


def test_road_and_lane_show_their_kinds(scene):
    state = state_of(scene)
    road, mask = blocks("road", scene, state)["road"]
    np.testing.assert_allclose(np.abs(road[mask[:, 0], 0, 1]) * 70, 6.0, atol=1e-4)
    lane, mask = blocks("lane", scene, state)["road"]
    np.testing.assert_allclose(lane[mask[:, 0], 0, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(lane[mask[:, 0], 0, 2:], np.tile([1.0, 0.0], (mask.sum(), 1)), atol=1e-6)


def test_segments_of_the_nearest_lane(scene):
    found = blocks("segment", scene, state_of(scene))
    row, mask = found["road"]
    assert mask[:, 0].tolist() == [True] + [False] * 9 and not row[1:].any()
    x, kind, direction = row[0, 0, :40].reshape(20, 2) * 50, row[0, 0, 40:48], row[0, 0, 48:].reshape(20, 2)
    # points from x = -60 to 59 m in steps of 1 m: 100 of them around the one at 0, of which -50 to 49
    np.testing.assert_allclose(x[:, 0], -50 + np.round(99 * np.arange(20) / 19), atol=1e-4)
    np.testing.assert_allclose(direction, np.tile([1.0, 0.0], (20, 1)), atol=1e-6)
    assert kind.tolist() == [0, 1, 0, 0, 0, 0, 0, 0]
    light, mask = found["lights"]
    assert light.shape == (1, 1, 10) and mask.all() and light[0, 0, 2:].argmax() == 5
    unrouted = replace(scene, agents=replace(scene.agents, route_end=jnp.zeros(2)), routes=replace(scene.routes, agent=jnp.array([1])))
    found = blocks("segment", unrouted, state_of(unrouted))
    assert not found["lights"][1].any() and not found["path"][0].any()


def test_a_drawn_route_is_shown_in_place_of_the_agents_own(scene):
    """Row 0 is of no agent and is driven; a second row of the agent's own leads elsewhere."""
    two = jax.device_put(jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), scene.routes))
    ahead = np.array([0.0, 1.0])
    position = column_of(np.asarray(two.position) + 3.0 * ahead[:, None, None])
    own = replace(two, agent=column_of([0, 0], np.int32), position=position, length=column_of(np.asarray(two.length) + ahead))
    for agents, aside in (([0, 0], 3.0), ([-1, 0], 0.0)):  # the longest of its own; the one that it drives
        state = state_of(scene)
        driven = replace(scene, routes=replace(own, agent=column_of(agents, np.int32)))
        route, mask = jax.device_get(jax.jit(select_routes)(driven, state.agents))
        assert mask.tolist() == [True, False] and np.asarray(own.position)[route[0], 0, 1] == aside


@pytest.mark.parametrize("kind", ["base", "segment"])
def test_the_frame_of_the_world_does_not_matter(scene, kind):
    scene = street(starts=((0.137, 0.31), (10.21, 1.07)), yaws=(0.2, 2.5))
    state = state_of(scene)
    same, turned = program(kind)(scene, state), program(kind)(*turn(scene, state, 2.0, (30.0, -20.0)))
    np.testing.assert_allclose(same, turned, atol=2e-5)


def test_published_velocities_are_cut_at_zero():
    scene = street(yaws=(0.0, np.pi))
    oncoming = blocks("base", scene, state_of(scene))
    np.testing.assert_allclose(oncoming["others"][0][0, -1, 2], -8 / 30, atol=1e-5)
    published = blocks("base", scene, state_of(scene), "observations.vmax.as_published=true")
    assert published["others"][0][0, -1, 2] == 0
    np.testing.assert_array_equal(published["road"][0], oncoming["road"][0])


@pytest.mark.parametrize("kind", ["base", "segment"])
def test_worlds_without_routes_lights_and_traffic(kind):
    scene = street(routes=False, lights=False, boxes=0)
    state = state_of(scene)
    twice = lambda leaf: jnp.stack([leaf, leaf])  # noqa: E731
    found = np.asarray(jax.jit(lambda *world: jax.vmap(program(kind))(*jax.tree.map(twice, world)))(scene, state))
    assert found.shape == (2, 2, SIZES[kind]) and np.isfinite(found).all()
    assert not found[..., -20:].any() and found.any()


def test_nearest_rows_are_those_of_a_sort():
    rng, far = np.random.default_rng(1), np.array([[0.0], [0.5], [0.9], [0.99], [1.0]])
    squared = np.where(rng.random((5, 400)) < far, np.inf, rng.uniform(0.0, 5000.0, (5, 400))).astype(np.float32)
    index, mask = jax.jit(lambda table: nearest_rows.select_nearest(table, count=30))(squared)
    expected = np.argsort(np.asarray(squared), axis=1)[:, :30]
    finite = np.isfinite(np.take_along_axis(np.asarray(squared), expected, axis=1))
    np.testing.assert_array_equal(mask, finite)
    np.testing.assert_array_equal(np.asarray(index)[finite], expected[finite])


def test_a_large_map_is_searched_by_chunks(monkeypatch):
    """Random walks of 40 points: the points that few chunks hold are those of a search through all."""
    rng = np.random.default_rng(3)
    walks = [np.cumsum(rng.normal(0, 0.7, (40, 2)), axis=0) + rng.uniform(-60, 60, 2) for _ in range(30)]
    position = jnp.asarray(np.concatenate(walks), jnp.float32)
    count, line = len(position), jnp.repeat(jnp.arange(30), 40)
    valid = jnp.asarray(rng.uniform(size=count) < 0.9)
    points = vmax_blocks.MapPoints(position, position, jnp.zeros(count, jnp.int32), line, valid)
    view = schema.read(entry("base")["vmax"]["view"], View)
    place, yaw = rng.uniform(-30, 30, (6, 2)), rng.uniform(-3, 3, 6)
    frame = vmax_blocks.Frame(jnp.asarray(place, jnp.float32), jnp.asarray(yaw, jnp.float32), view, False)
    found = []
    for chunks in (200, 30):  # all rows; 30 of the 75 chunks
        monkeypatch.setattr(vmax_blocks, "SEARCHED_CHUNKS", chunks)
        found.append(jax.jit(lambda: vmax_blocks.select_points_in_box(frame, points, count=25))())
    (index, mask), (few, few_mask) = jax.tree.map(np.asarray, found)
    np.testing.assert_array_equal(mask, few_mask)
    assert mask.sum() > 60
    np.testing.assert_array_equal(np.where(mask, index, 0), np.where(mask, few, 0))
