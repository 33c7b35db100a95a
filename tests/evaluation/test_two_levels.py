"""Articulated cars drive whole episodes under and over a bridge: who is on the other level is no leader, and nobody to collide with."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.driving import CAR

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.pytree import to_jax
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env.environment import make_env
from scenefactory_jax.learning.training_loop import make_policy
from scenefactory_jax.visualization import road_levels
from scenefactory_jax.visualization.mujoco import ground_meshes, scene_model

pytestmark = pytest.mark.usefixtures("quickly")

LINE = np.linspace(-90.0, 90.0, 91)
BRIDGE_M, REACH_M, STEPS, SPEED_MPS = 6.0, 45.0, 91, 8.0
UNDER, OVER = 0, 1  # agents; each of them meets a car that stands above or below its lane
QUIET = ("road", "neighbours", "lane", "turning", "weather", "friction_ahead")


def rise(xy):
    return BRIDGE_M * np.exp(-((xy[..., 1] / REACH_M) ** 2))


def lane(number, start, along, height):
    xy = np.array(start) + LINE[:, None] * np.array(along)
    return Polyline(kind=2, xyz=np.column_stack([xy, height(xy)]), id=number, speed_limit=10.0)


def drive(number, place, yaw, speed, height):
    xy = np.array(place) + speed * 0.1 * np.arange(STEPS)[:, None] * [np.cos(yaw), np.sin(yaw)]
    xyz = np.column_stack([xy, height(xy)])
    return Track(number, "vehicle", (4.0, 2.0, 1.5), xyz, np.full(STEPS, yaw), np.gradient(xy, 0.1, axis=0), np.ones(STEPS, bool))


@pytest.fixture(scope="module")
def settings():
    off = [f"observations.{name}=null" for name in QUIET]
    return load_config(
        "train", "scenes=womd", "observations=drive_hills", "actions=one_pedal_10hz", "traffic=static", "termination=goal_only",
        "spawning=logged", "scenes/pack/elevation=hills", "scenes.pack.elevation.levels=2", "scenes/pack/routes=lanes",
        "scenes.pack.agents=2", "scenes.pack.min_travel_m=1", "timing.episode_s=14", *off,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(settings):
    """A street along x, a bridge over it along y, a car that drives on each, and one that stands on each where the other road crosses."""
    flat = lambda xy: 0.0 * xy[..., 0]  # noqa: E731
    roads = [lane(1, (0, -2), (1, 0), flat), lane(2, (0, 2), (-1, 0), flat)]
    roads += [lane(3, (2, 0), (0, 1), rise), lane(4, (-2, 0), (0, -1), rise)]
    tracks = [drive(1, (-50, -2), 0.0, SPEED_MPS, flat), drive(2, (2, -50), np.pi / 2, SPEED_MPS, rise)]
    tracks += [drive(3, (-2, -2), -np.pi / 2, 0.0, rise), drive(4, (2, 2), np.pi, 0.0, flat)]
    raw = RawScene("made", "by hand", tuple(roads), tuple(tracks), 0.1 * np.arange(STEPS), current=0, sdc=0, metadata={})
    return to_jax(scene_source.prepare(raw, **scene_source.make_packing(settings["scenes"])).scene)


@pytest.fixture(scope="module")
def driven(settings, scene):
    """Motions, events, leaders and levels' heights over an episode."""
    env, policy = make_env(settings), make_policy(apply_overrides(settings, ["policy=idm_route"]))

    def step(carry, _):
        state, seen = carry
        after, result = env.step(scene, state, policy.apply({}, seen)[0])
        return (after, result.observation), (after.motion, result.events, seen["leader"], result.metrics, state.active)

    start = lambda: env.reset(jax.random.key(0), scene)  # noqa: E731
    return jax.jit(lambda: jax.lax.scan(step, start(), None, length=140)[1])()



@pytest.mark.slow  # test_elevation tells levels apart
def test_cars_keep_their_level_and_reach_their_goals(driven):
    motion, events, leader, metrics, active = jax.device_get(driven)
    place = motion.position + np.array([-50.0, -2.0, 0.0])  # the scene's origin is the first agent
    road = np.stack([0.0 * place[:, UNDER, 0], rise(place[:, OVER])], axis=1)
    above = (place[..., 2] - road)[active]
    np.testing.assert_allclose(above, place[0, UNDER, 2], atol=0.05)
    assert np.abs(place[:, UNDER, 0]).min() < 1.0 and np.abs(place[:, OVER, 1]).min() < 1.0, "both have been at the crossing"
    assert events.goal_reached.any(axis=0).all()
    assert not {name for name, event in vars(events).items() if event.any()} - {"goal_reached"}
    assert not leader[..., 0].any() and metrics.speed[active].min() > SPEED_MPS - 0.1, "nothing is ahead of them"


@pytest.mark.slow
def test_pictures_have_the_heights_of_each_level(driven, scene):
    motion, *_, active = jax.device_get(driven)
    world = jax.tree.map(np.asarray, scene)
    covered = road_levels.find_covered(world, motion.position[..., :2], motion.position[..., 2])
    middle = np.abs(motion.position[:, UNDER, 0] - 50.0) < 3.0
    assert covered[middle, UNDER].all() and not covered[~middle & active[:, UNDER], UNDER].all() and not covered[:, OVER].any()
    lowest, bridge = road_levels.list_levels(world)
    assert bridge.road.valid.any() and not (lowest.road.valid & bridge.road.valid).any()
    np.testing.assert_array_equal(lowest.road.valid | bridge.road.valid, world.road.valid)
    found = {surface.name: surface.vertices for surface in ground_meshes.find_surfaces(world)}
    tops = found["asphalt1"][found["asphalt1"][:, 2] > 1.0]
    np.testing.assert_allclose(tops[:, 2], rise(tops[:, :2] + [-50.0, -2.0]), atol=0.3)


def test_level_cars_are_put_on_the_road(scene):
    """A car that drives north up the bridge: its axes are along the road and across it."""
    place, yaw, zero = np.array([[52.0, -30.0], [10.0, 0.0]]), np.array([np.pi / 2, 0.3]), np.zeros(2)
    joints = scene_model.set_posture(CAR, place, yaw, zero, zero)
    stood = scene_model.stand_on_road(jax.tree.map(np.asarray, scene), joints, np.array([4.0, 0.0]))
    np.testing.assert_allclose(stood[:, 2] - joints[:, 2], [rise(place[0] + np.array([-50.0, -2.0])), 0.0], atol=0.03)
    turn = Rotation.from_quat(np.roll(stood[:, 3:7], -1, axis=1)).as_matrix()
    slope = np.diff(rise(np.array([[2.0, -32.1], [2.0, -31.9]])))[0] / 0.2
    np.testing.assert_allclose(turn[0, :, 0], np.array([0.0, 1.0, slope]) / np.hypot(1.0, slope), atol=0.02)
    np.testing.assert_allclose(turn[1, :, 0], [np.cos(0.3), np.sin(0.3), 0.0], atol=0.02)
