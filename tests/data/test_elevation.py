"""Heights of packed scenes: planes, bridges and hills, and what stands on them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.pytree import to_jax, unchecked
from scenefactory_jax.core.raw_scene import Polyline, RawScene, Track, Unpackable
from scenefactory_jax.core.types import DRIVABLE, Boxes, State
from scenefactory_jax.data.formats import reader_selection
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.packing import elevation_grid, route_columns, route_conflicts
from scenefactory_jax.data.packing.stack import stack
from scenefactory_jax.dynamics import bicycle
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.env.observations import state_vectors
from scenefactory_jax.roadgraph import elevation
from scenefactory_jax.roadgraph.elevation import Ground
from scenefactory_jax.visualization.mujoco import exported_world

LINE = np.linspace(-90.0, 90.0, 181)
SLOPE = np.array([0.06, -0.02])
BRIDGE_M, AT_M = 6.0, 5.0  # height of the bridge in the middle, place of the car on it
FIND = jax.jit(elevation.find_ground)
HIGH_M = BRIDGE_M * np.exp(-((AT_M / 40.0) ** 2))


def lane(id, start, direction, height, *, kind=2):
    xy = np.array(start) + LINE[:, None] * np.array(direction)
    return Polyline(kind=kind, xyz=np.column_stack([xy, height(xy)]), id=id)


def driver(id, place, yaw, height):
    xyz = np.tile([*place, height], (3, 1)).astype(float)
    return Track(id, "vehicle", (4.0, 2.0, 1.5), xyz, np.full(3, yaw), np.zeros((3, 2)), np.ones(3, bool))


def scene_with(*roads, tracks=()):
    return RawScene("made", "by hand", roads, tuple(tracks), 0.1 * np.arange(3), current=0, sdc=0, metadata={})


def pack(raw, *changes):
    config = load_config("train", "scenes=womd", "scenes/pack/elevation=hills", "scenes.pack.min_travel_m=-1", *changes)
    return to_jax(scene_source.prepare(raw, **scene_source.make_packing(config["scenes"])).scene)


@pytest.fixture(scope="module")
def crossing():
    """A street along x, a bridge over it along y, and a car on each of them, the lower one under the bridge."""
    plain, bridge = lambda xy: 0 * xy[:, 0], lambda xy: BRIDGE_M * np.exp(-((xy[:, 1] / 40.0) ** 2))
    roads = [lane(1, (0, y), (1, 0), plain) for y in (-2.0, 2.0)] + [lane(2, (x, 0), (0, 1), bridge) for x in (-2.0, 2.0)]
    roads += [lane(3, (0, 5), (1, 0), plain, kind=15), lane(4, (5, 0), (0, 1), bridge, kind=15)]
    return scene_with(*roads, tracks=[driver(1, (-1.0, 2.0), 0.0, 0.0), driver(2, (2.0, AT_M), np.pi / 2, HIGH_M)])


def test_a_plane_is_exact_where_the_map_is_and_beyond():
    roads = [lane(i, (0, y), (1, 0), lambda xy: xy @ SLOPE + 300.0) for i, y in enumerate((-3.5, 0.0, 3.5))]
    scene = pack(scene_with(*roads, tracks=[driver(1, (0, 0), 0.0, 300.0)]))
    places = jnp.array([[0.0, 0.0], [37.1, -2.2], [-80.3, 60.0], [150.0, -120.0]])

    @jax.jit  # by itself, each of its operations would be compiled
    def look(scene, places):
        ground = elevation.find_ground(scene.elevation, places, jnp.zeros(4))
        state = unchecked(State, motion=bicycle.read(bicycle.init(jax.random.key(0), scene), height=0.7), agents=scene.agents)
        grades = state_vectors.grade_ahead(scene, state, ahead_m=[10.0, 20.0], grade_scale=0.1)
        return ground, elevation.compute_grade(ground, jnp.full(4, jnp.pi)), grades

    ground, (sine, cosine), grades = look(scene, places)
    np.testing.assert_allclose(ground.height, places @ SLOPE, atol=2e-3)
    np.testing.assert_allclose(ground.slope, np.tile(SLOPE, (4, 1)), atol=1e-4)
    np.testing.assert_allclose(sine / cosine, -SLOPE[0], atol=1e-4)
    assert scene.road.height is None
    np.testing.assert_allclose(grades[0], [0.6, 0.6, 0.6, -0.2], atol=1e-3)
    with pytest.raises(ConfigError, match=r"^scenes\.pack\.elevation: an exported world is flat; expected null"):
        exported_world.make_sampler(load_config("train", "experiment=smoke", "dynamics=articulated"))(scene, 0)


def test_levels_are_told_apart_by_height_and_by_the_lanes_direction(crossing):
    with pytest.raises(Unpackable, match=r"roads: 2 levels at one place; scenes\.pack\.elevation\.levels is 1"):
        pack(crossing)
    scene = pack(crossing, "scenes.pack.elevation.levels=2")
    for road in crossing.roads:
        points = jnp.asarray(road.xyz - [-1.0, 2.0, 0.0], jnp.float32)  # around the first car
        np.testing.assert_allclose(FIND(scene.elevation, points[:, :2], points[:, 2]).height, points[:, 2], atol=0.05)
    beside = jnp.tile(jnp.array([9.0, -15.0]), (len(LINE), 1))  # of the ramp, 4 m below it
    assert np.abs(FIND(scene.elevation, beside, jnp.zeros(len(LINE))).height).max() < 2.0, "a car there is not lifted onto the ramp"

    @jax.jit
    def look(scene):
        zero, agents = jnp.zeros(2), scene.agents
        boxes = Boxes(agents.position[:2], zero + 0.7, agents.yaw[:2], jnp.zeros((2, 2)), zero, jnp.ones((2, 2)), zero, zero == 0)
        motion = bicycle.read(bicycle.init(jax.random.key(0), scene), height=0.7)
        return elevation.lift_boxes(scene, boxes).elevation, motion, elevation.select_level(scene, motion).edges.valid[:2]

    lifted, motion, edges = look(scene)
    np.testing.assert_allclose(lifted, [0.7, HIGH_M + 0.7], atol=0.1)
    np.testing.assert_allclose(motion.position[:2, 2], lifted, atol=1e-4)
    near = np.linalg.norm(np.asarray(scene.edges.midpoint) - np.asarray(scene.agents.position[0]), axis=1) < 10.0
    along = np.abs(np.asarray(scene.edges.direction)[:, 0]) > 0.5
    assert edges[0, near & along].all() and not edges[0, near & ~along].any()
    assert edges[1, near & ~along].all() and not edges[1, near & along].any()


def test_who_follows_a_road_stays_on_it(crossing):
    """A wheel that sinks 2 cm into the road, and whose height chooses the level, over each lane in both directions."""
    config = load_config("train", "scenes=womd", "scenes/pack/elevation=hills", "scenes.pack.elevation.levels=2")["scenes"]
    numbers = elevation_grid.ElevationConfig(**config["pack"]["elevation"])
    fit = to_jax(elevation_grid.fit_elevation(crossing, np.zeros(3), 100.0, numbers))
    lanes = np.stack([way for line in crossing.roads if line.kind in DRIVABLE for way in (line.xyz, line.xyz[::-1])]).astype(np.float32)

    def roll(height, place):
        found = elevation.find_ground(fit, place, height - 0.02).height
        return found, found

    heights = jax.jit(jax.vmap(lambda lane: jax.lax.scan(roll, lane[0, 2], lane[:, :2])[1]))(lanes)
    np.testing.assert_allclose(heights, lanes[..., 2], atol=0.05)


def test_routes_on_two_levels_do_not_meet():
    """A route along x and one along y over it, or on the same ground."""
    way = np.arange(-20.0, 21.0)
    lines = np.stack([np.column_stack([way, 0 * way]), np.column_stack([0 * way, way])])
    leaves = {
        "traffic_log.has_route": np.ones(2, bool), "traffic_log.route": np.arange(2), "traffic_log.size": np.full((2, 2), 2.0),
        "routes.position": lines, "routes.length": np.full(2, 40.0), "routes.lane": np.tile([[7], [8]], (1, 41)),
        "road.midpoint": lines.reshape(-1, 2), "road.polyline": np.repeat([7, 8], 41),
    }  # fmt: skip
    for height, meet in ((BRIDGE_M, False), (0.0, True)):
        heights = leaves | {"road.height": np.repeat([0.0, height], 41)}
        zones = route_conflicts.find_zones(heights | route_columns.find_heights(heights))
        assert np.isfinite(zones["traffic_log.zone_enter"]).any() == meet


def test_stacked_scenes_have_heights_of_one_size_or_none(crossing):
    two = pack(crossing, "scenes.pack.elevation.levels=2")
    stacked, _ = stack([two, two], capacity={})
    assert stacked.elevation.height.shape == (2, *two.elevation.height.shape) and stacked.edges.height.shape[0] == 2
    flat = pack(replace(crossing, roads=crossing.roads[:2], tracks=crossing.tracks[:1]), "scenes/pack/elevation=flat")
    assert flat.elevation is None
    with pytest.raises(ConfigError, match=r"^scenes\.pack\.elevation: expected the same sizes in all scenes, got \(2, 55, 55\), None$"):
        elevation_grid.stack_elevations([two.elevation, flat.elevation])


def test_a_bicycle_feels_the_grade_along_its_heading():
    limits = bicycle.Limits(2.7, 1.35, 0.6, 3.0, 6.0, 0.1, 0.0, 0.0, 60.0)
    zero, yaw = jnp.zeros(4), jnp.array([0.0, np.pi / 2, np.pi, 0.0])
    ground = Ground(zero, jnp.tile(jnp.array([0.1, 0.0]), (4, 1)))
    body = bicycle.Body(jnp.zeros((4, 2)), yaw, jnp.array([10.0, 10.0, 10.0, 0.0]), *[zero] * 6, ground=ground)
    drive = jax.jit(lambda body: (bicycle.integrate_bicycle(body, jnp.zeros((4, 3)), limits, dt=0.1), bicycle.read(body, height=0.7)))
    after, motion = drive(body)
    sine = 0.1 / np.hypot(1.0, 0.1)
    np.testing.assert_allclose((after.speed - body.speed) / 0.1, [-0.1 - GRAVITY * sine, -0.1, -0.1 + GRAVITY * sine, 0.0], rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(motion.velocity, axis=1), body.speed, rtol=1e-5)
    np.testing.assert_allclose(motion.velocity[:, 2], [10 * sine, 0.0, -10 * sine, 0.0], atol=1e-5)


def test_a_town_on_hills_is_the_town_with_heights():
    flat, hilly = (
        scene_source.make_generator(load_config("train", "scenes=streets", *changes)["scenes"])(0, 2)
        for changes in ([], ["scenes.generate.hills={grade: [0.08, 0.08], wave_m: [100.0, 200.0]}"])
    )
    steepest = 0.0
    for before, after in zip(flat.roads, hilly.roads, strict=True):
        np.testing.assert_array_equal(before.xyz[:, :2], after.xyz[:, :2])
        if after.kind in DRIVABLE:
            step = np.diff(after.xyz, axis=0)
            steepest = max(steepest, float(np.max(np.abs(step[:, 2]) / np.linalg.norm(step[:, :2], axis=1))))
    assert steepest == pytest.approx(0.08, rel=1e-6)
    for track in hilly.tracks:
        lanes = np.concatenate([line.xyz for line in hilly.roads if line.kind in DRIVABLE])
        place = track.xyz[track.valid][0]
        nearest = lanes[np.argmin(np.linalg.norm(lanes[:, :2] - place[:2], axis=1))]
        apart = np.linalg.norm(nearest[:2] - place[:2])
        assert abs(place[2] - track.size[2] / 2 - nearest[2]) <= 0.2 * apart + 1e-3


def test_heights_of_opendrive_and_womd_are_those_of_their_lanes(shared_data):
    config = load_config("train", "scenes=womd", "scenes/pack/elevation=hills")["scenes"]
    numbers = elevation_grid.ElevationConfig(**config["pack"]["elevation"])
    formats = config["formats"] | {"opendrive": config["formats"]["opendrive"] | {"traffic": None}}
    womd = min((shared_data / "womd" / "train").iterdir())
    for path, error_m, grade in ((shared_data / "formats" / "opendrive" / "crest-curve.xodr", 0.01, 0.13), (womd, 0.1, 0.01)):
        raw = next(iter(reader_selection.read(path, reader_selection.make(formats))))
        origin = np.concatenate([line.xyz for line in raw.roads if line.kind in DRIVABLE]).mean(axis=0)
        fit = to_jax(elevation_grid.fit_elevation(raw, origin, 100.0, numbers))
        points = np.concatenate([line.xyz for line in raw.roads if line.kind in DRIVABLE]) - origin
        points = points[(np.abs(points[:, :2]) <= 100.0).all(axis=1)][::5][:1000]
        ground = FIND(fit, jnp.asarray(np.resize(points[:, :2], (1000, 2)), jnp.float32), jnp.zeros(1000))
        assert np.abs(ground.height - np.resize(points[:, 2], 1000)).max() < error_m, path
        assert np.linalg.norm(ground.slope, axis=1).max() > grade, path
