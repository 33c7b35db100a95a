"""MetaDrive's vector: published sizes, columns for a street made by hand, rays against brute force, invariance, empty worlds; edge rays."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import road_of
from support.planning_scenes import state_of, street, turn

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import ray_casting
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.env import observations

pytestmark = pytest.mark.usefixtures("quickly")


@functools.cache
def program(*overrides):
    entry = load_config("task", "observations=metadrive", *(f"observations.metadrive.{override}" for override in overrides))["observations"]
    group = observations.make(entry, control_dt=0.1)["metadrive"]
    return jax.jit(lambda scene, state: group(scene, state))


@pytest.mark.parametrize("side_rays, size", [(12, 161), (0, 151)])
def test_sizes_are_the_published_ones(side_rays, size):
    scene = street()
    assert jax.eval_shape(program(f"side_rays={side_rays}"), scene, state_of(scene)).shape == (2, size)


def test_columns_of_a_street():
    """A car 1 m to the left of its route, 0.1 rad off it, 6 m from the edges and 10 m behind another car of 4 m."""
    scene = street(starts=((0.0, 1.0), (10.0, 1.0)), yaws=(0.1, 0.0))
    state = state_of(scene)
    state = replace(
        state, previous_action=jnp.array([[0.5, -0.2, 0.0], [0.0, 0.0, 1.0]]), motion=replace(state.motion, steer=jnp.full(2, 0.349))
    )
    found = np.asarray(program()(scene, state))
    half = lambda value: 0.5 * (value + 1)  # noqa: E731
    np.testing.assert_allclose(found[0, :6], [half(0.1 / np.pi), 5 / 22.2, half(0.5), half(-0.2), half(0.5), 0.0], atol=1e-4)
    assert found[1, 4] == 0  # full brake
    # side rays 0 and 6 run along the car, 3 and 9 to its sides; the edges are at y = 6 and -6
    sides = found[0, 6:18] * 50
    np.testing.assert_allclose(sides[[3, 9]], [5 / np.cos(0.1), 7 / np.cos(0.1)], atol=1e-3)
    np.testing.assert_allclose(found[0, 18], half(2 * 1.0 / 4.5), atol=1e-4)
    cos, sin = np.cos(0.1), np.sin(0.1)
    ahead = np.stack([2.0 * np.arange(1, 11), np.full(10, -1.0)], axis=1) @ np.array([[cos, -sin], [sin, cos]])
    np.testing.assert_allclose(found[0, 19:39].reshape(10, 2), half(ahead / 30), atol=1e-4)
    np.testing.assert_allclose(found[0, 39:41], [half(1 / 4), half(0.1 / np.pi)], atol=1e-4)
    lidar = found[0, 41:] * 50
    np.testing.assert_allclose(lidar[0], 8.0 / cos, atol=1e-3)  # the rear of the car ahead
    np.testing.assert_allclose(lidar[[30, 90]], sides[[3, 9]], atol=1e-3)
    published = np.asarray(program("as_published=true")(scene, state))
    assert not published[:, 37:39].any()
    np.testing.assert_array_equal(np.delete(published, [37, 38], axis=1), np.delete(found, [37, 38], axis=1))


def brute_force(ray, corners, closed):
    """First hit of a polyline of points by a ray from the origin, by the equation of each side."""
    best = np.inf
    for first, second in zip(corners, np.roll(corners, -1, axis=0) if closed else corners[1:], strict=False):
        matrix = np.stack([ray, first - second], axis=1)
        if abs(np.linalg.det(matrix)) > 1e-9:
            distance, place = np.linalg.solve(matrix, first)
            best = distance if distance >= 0 and 0 <= place <= 1 and distance < best else best
    return best


def test_rays_against_brute_force():
    rng = np.random.default_rng(0)
    rays = np.asarray(ray_casting.make_ray_directions(37))
    place, yaw, size = rng.uniform(-20, 20, (6, 2)), rng.uniform(-3, 3, 6), rng.uniform(1, 6, (6, 2))
    place[np.hypot(*place.T) < 6] += 12.0
    middle, angle, half = rng.uniform(-20, 20, (8, 2)), rng.uniform(-3, 3, 8), rng.uniform(0.5, 4, 8)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    @jax.jit
    def cast(place, yaw, size, middle, along, half):
        yes = lambda table: jnp.ones(table.shape[:2], bool)  # noqa: E731
        boxes = ray_casting.cast_to_boxes(jnp.asarray(rays), place, yaw, size, yes(yaw), range_m=30.0)
        return boxes, ray_casting.cast_to_segments(jnp.asarray(rays), middle, along, half, yes(half), range_m=30.0)

    boxes, segments = cast(*(jnp.asarray(table, jnp.float32)[None] for table in (place, yaw, size, middle, along, half)))
    for number, ray in enumerate(rays.astype(float)):
        hits = []
        for xy, turned, extent in zip(place, yaw, size, strict=True):
            corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * extent / 2
            rotation = np.array([[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]])
            hits.append(brute_force(ray, corners @ rotation + xy, closed=True))
        np.testing.assert_allclose(boxes[0, number], min(30.0, *hits), atol=1e-3)
        ends = [brute_force(ray, np.stack([m - h * d, m + h * d]), closed=False) for m, d, h in zip(middle, along, half, strict=True)]
        np.testing.assert_allclose(segments[0, number], min(30.0, *ends), atol=1e-3)


def test_the_frame_of_the_world_does_not_matter():
    scene = street(starts=((0.137, 1.1), (10.21, 1.07)), yaws=(0.2, 2.5))
    state = state_of(scene)
    np.testing.assert_allclose(program()(scene, state), program()(*turn(scene, state, 2.0, (30.0, -20.0))), atol=1e-4)


def test_worlds_without_routes_and_traffic():
    scene = street(routes=False, lights=False, boxes=0)
    scene = replace(scene, edges=road_of([]))
    worlds = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (scene, state_of(scene)))
    found = np.asarray(jax.vmap(program())(*worlds))
    assert found.shape == (2, 2, 161) and np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
    assert (found[:, 0, 6:18] == 1).all() and found[0, 0, 41] < 1


def test_edge_rays_of_a_street():
    """Edges at y = 6 and -6, seen 1 m to the left of the middle and 0.1 rad off it, and 2 m to its right."""
    entry = {"count": 32, "range_m": 40.0, "segments": 384, "distance_scale_m": 5.0}
    group = observations.make({"edges": {"_target_": "edge_rays", **entry}})["edges"]
    scene = street(starts=((0.0, 1.0), (0.0, -2.0)), yaws=(0.1, 0.0))
    state = state_of(scene)
    see = jax.jit(lambda scene, state: group(scene, state))
    found = np.asarray(see(scene, state))
    angle = 2 * np.pi * np.arange(32) / 32 + np.array([[0.1], [0.0]])
    gap = np.abs(np.where(np.sin(angle) > 0, 6.0, -6.0) - np.array([[1.0], [-2.0]]))
    length = np.minimum(gap / np.maximum(np.abs(np.sin(angle)), 1e-9), 40.0)
    inside = np.abs(length * np.cos(angle)) < 35  # the street ends
    assert inside.sum() > 50
    np.testing.assert_allclose(found[inside], (length / (5 + length))[inside], rtol=1e-4)
    above = replace(scene, edges=replace(scene.edges, height=jnp.full(scene.edges.valid.shape, 6.0)))  # a bridge's
    np.testing.assert_allclose(see(above, state), 40.0 / 45.0, rtol=1e-6)
    below = replace(above, edges=replace(above.edges, height=jnp.zeros(scene.edges.valid.shape)))
    np.testing.assert_array_equal(see(below, state), found)
