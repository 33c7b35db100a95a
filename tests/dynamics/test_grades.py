"""The articulated car on roads with heights: laws of motion on grades and banks, and the C engine under tilted gravity."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.driving import CAR, CONVERGED, KEY, SOLVER, G, make, random_controls

from scenefactory_jax.core.geometry import wrap_angle
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Elevation
from scenefactory_jax.dynamics import mujoco_c, open_ground
from scenefactory_jax.dynamics.articulated.equations_of_motion import total_mass

pytestmark = pytest.mark.usefixtures("quickly")

FREE = dict(wheel_damping=0.0, rolling_torque=0.0, air_drag=0.0)  # nothing but the road slows it
MASS = total_mass(CAR)
INERT = MASS + 4 * CAR.wheel_inertia[0] / CAR.wheel_radius**2  # with the wheels' inertia
SLOPES = np.array([[0, 0], [0.05, 0], [-0.05, 0], [0.1, 0], [-0.15, 0], [0, 0.08], [0.06, -0.05], [-0.08, 0.03]])  # along x and y
RADIUS, BANK = 100.0, 0.1  # of the cone
CHUNK = 30


AXIS = 4.0 * np.arange(-40, 41)  # of the coefficients


def plane(slope):
    """Heights of a plane through the origin; beyond the grid it goes on."""
    return AXIS[None, :] * slope[0] + AXIS[:, None] * slope[1]


def cone():
    """Heights of a road that rises outwards from the middle of a circle, and is 0 on it."""
    return BANK * (np.hypot(AXIS[None, :], AXIS[:, None]) - RADIUS)


def worlds(surfaces, *, speed, position=(0.0, 0.0), yaw=0.0):
    """Worlds of one car on these surfaces; each has the same surface again 6 m below, which the car never meets."""
    count = len(surfaces)
    full = lambda value: np.broadcast_to(value, (count, 1))  # noqa: E731
    scene = open_ground.make_open_ground(
        np.broadcast_to(position, (count, 1, 2)), full(yaw), np.reshape(np.broadcast_to(speed, count), (count, 1)), np.full(count, 0.8),
        np.zeros(count, np.int32), size=(CAR.length, CAR.width),
    )  # fmt: skip

    def lift(world, height):
        return replace(world, elevation=Elevation(jnp.stack([height - 6.0, height]), jnp.full(2, AXIS[0]), jnp.float32(4.0)))

    return jax.vmap(lift)(scene, jnp.asarray(np.stack(surfaces), jnp.float32))


@pytest.fixture(scope="module")
def drive():
    """(scenes, actions [T, 8, 3], radius) -> bodies and motions [T, 8, ...] of one compiled second after another."""
    dynamics = make("articulated", car=FREE, friction=lambda weather, position, speed: jnp.broadcast_to(weather.film_mm, speed.shape))

    def step(scene, radius, body, action):
        motion = dynamics.read(body)
        (x, y), yaw = motion.position[0, :2], motion.yaw[0]
        inwards = wrap_angle(yaw - jnp.arctan2(y, x) - 0.5 * jnp.pi)
        steer = CAR.wheelbase / radius + 0.01 * (jnp.hypot(x, y) - radius) - 0.3 * inwards
        action = action.at[1].add(jnp.where(jnp.isfinite(radius), steer / CAR.steering_limit, 0.0))
        body = dynamics.advance(scene, body, action[None], jnp.ones(1, bool))
        return body, (body, dynamics.read(body))

    @jax.jit
    def second(scenes, radius, bodies, actions):
        return jax.vmap(lambda s, b, a: jax.lax.scan(lambda c, x: step(s, radius, c, x), b, a))(scenes, bodies, actions)

    start = jax.jit(jax.vmap(lambda scene: dynamics.init(KEY, scene)))

    def run(scenes, actions, radius=np.inf):
        bodies, parts = start(scenes), []
        actions = np.broadcast_to(actions, (*np.shape(actions)[:1], 8, 3)).astype(np.float32)
        for chunk in actions.reshape(-1, CHUNK, 8, 3):
            bodies, trace = second(scenes, jnp.float32(radius), bodies, np.moveaxis(chunk, 0, 1))
            parts.append(jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf)[:, :, 0], 0, 1), trace))
        return jax.tree.map(lambda *part: np.concatenate(part), *parts)

    return run


def hold(brake=0.0, seconds=3):
    return np.tile(np.array([0.0, 0.0, brake]), (seconds * CHUNK, 1, 1))


@pytest.mark.slow  # these four share a program; test_elevation has the roads
def test_a_coasting_car_has_the_acceleration_of_the_grade(drive):
    _, motion = drive(worlds(list(map(plane, SLOPES)), speed=10.0), hold())
    straight = SLOPES[:, 1] == 0
    speed = np.linalg.norm(motion.velocity, axis=-1)
    sine = SLOPES[:, 0] / np.sqrt(1 + SLOPES[:, 0] ** 2)
    found = (speed[-1] - speed[CHUNK]) / (2 - 1 / CHUNK)
    np.testing.assert_allclose(found[straight], (-G * sine * MASS / INERT)[straight], rtol=0.01, atol=2e-3)
    height = (motion.position[..., :2] * SLOPES).sum(-1)
    upright = np.broadcast_to(1 / np.sqrt(1 + (SLOPES**2).sum(-1)), motion.upright.shape)
    np.testing.assert_allclose((motion.position[..., 2] - height) * upright, motion.position[0, 0, 2], atol=0.01)
    np.testing.assert_allclose(motion.upright, upright, atol=2e-3)


@pytest.mark.slow
def test_stopping_on_a_grade_takes_the_distance_of_gravity_and_friction(drive):
    """Full brakes, limited by friction: the force is that of the load g cos, and gravity adds g sin."""
    straight = SLOPES[:, 1] == 0
    _, motion = drive(worlds(list(map(plane, SLOPES)), speed=15.0), hold(brake=1.0, seconds=6))
    way = np.linalg.norm(motion.position[-1] - motion.position[0], axis=-1) + 15.0 / CHUNK
    sine, cosine = SLOPES[:, 0] / np.hypot(1, SLOPES[:, 0]), 1 / np.hypot(1, SLOPES[:, 0])
    flat = 15.0**2 / (2 * way[0])
    np.testing.assert_allclose(way[straight], (15.0**2 / (2 * (flat * cosine + G * sine)))[straight], rtol=0.02)
    last = motion.position[-CHUNK:]
    assert np.abs(last - last[0]).max() < 1e-3, "brakes hold the car on the grade"


@pytest.mark.slow
def test_at_the_neutral_speed_of_a_banked_curve_the_tyres_carry_nothing_across(drive):
    neutral = np.sqrt(G * RADIUS * BANK)
    speed = neutral * np.linspace(0.86, 1.14, 8)
    body, motion = drive(worlds([cone()] * 8, speed=speed, position=(RADIUS, 0.0), yaw=np.pi / 2), hold(seconds=6), radius=RADIUS)
    settled = slice(-2 * CHUNK, None)
    np.testing.assert_allclose(np.hypot(*motion.position[-1, :, :2].T), RADIUS, atol=1.0)
    across = body.tyres.left[settled].sum(-1).mean(0)
    squared = (motion.velocity[settled, :, :2] ** 2).sum(-1).mean(0)
    slope, offset = np.polyfit(squared, across, 1)
    radius = np.hypot(motion.position[settled, :, 0], motion.position[settled, :, 1]).mean()
    assert np.sqrt(-offset / slope) == pytest.approx(np.sqrt(G * radius * BANK), rel=0.02)


@pytest.mark.slow
def test_a_tilted_road_is_tilted_gravity_of_the_c_engine(drive):
    """2 s of random controls: float32 and two iterations against float64 to convergence."""
    controls, speed = random_controls(3, 2, 15), np.linspace(4, 14, 8)
    body, _ = drive(worlds(list(map(plane, SLOPES)), speed=speed), controls)
    car = dataclasses.replace(CAR, **FREE)
    rig = mujoco_c.make_one(car, SOLVER, abs_enabled=True, physics_dt=CONVERGED["physics_dt"], iterations=100, line_search=50)
    rest = mujoco_c.models.find_rest_pose(rig.model, car)
    for i in (4, 6, 7):
        x, y = SLOPES[i]
        up = np.array([-x, -y, 1.0]) / np.sqrt(1 + x**2 + y**2)
        turn = np.array([[0, 0, up[0]], [0, 0, up[1]], [-up[0], -up[1], 0]])
        tilt = np.eye(3) + turn + turn @ turn / (1 + up[2])  # the shortest turn from the world's up (Rodrigues)
        rig.model.opt.gravity[:] = tilt.T @ [0, 0, -G]
        mujoco_c.place(rig, rest, np.zeros((1, 2)), np.zeros(1), speed[[i]])
        truth = mujoco_c.simulate_placed(rig, controls[:, [i]].astype(float), np.full((1, 4), 0.8), substeps=4)
        start = np.array([0, 0, rest[2] / up[2]]) - tilt @ [0, 0, rest[2]]
        assert np.linalg.norm(body.qpos[:, i, :3] - truth.qpos[:, :3] @ tilt.T - start, axis=1).max() < 0.02, i
