"""Articulated cars on patches: what split friction, ice in a bend and a slippery stretch do to a car.

All runs share one compiled function: eight cars on eight "lanes" 500 m apart on dry asphalt, and eight patches where a test wants them.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES, Patches
from scenefactory_jax.weather.friction import make_uniform
from scenefactory_jax.weather.patches import read_condition

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("quickly")]

G, CARS, CHUNK = 9.81, 8, 30
LANES = 500.0 * np.arange(CARS)
MU = {"AC": 1.1048, "GRAVEL": 0.6, "SNOW": 0.2, "ICE": 0.1}


@functools.cache
def backend():
    config = load_config("task")
    grip = instantiate(config["weather"]["friction"], builtins="scenefactory_jax.weather.friction", where="weather.friction")
    context = {"friction": grip, "physics_dt": 1 / 120, "control_dt": 1 / 30}
    dynamics = instantiate(config["dynamics"], builtins="scenefactory_jax.dynamics", where="dynamics", **context)()

    @jax.jit
    def second(scene, body, action):
        def step(body, a):
            body = dynamics.advance(scene, body, a, jnp.ones(CARS, bool))
            return body, dynamics.read(body)

        return jax.lax.scan(step, body, action)

    return second, jax.jit(functools.partial(dynamics.init, jax.random.key(0)))


def drive(shapes, *, speed, seconds, throttle=0.0, steer=0.0, brake=0.0):
    """Motions of every step, as numpy; `shapes` is lane -> (vertices about the car's start, radius, surface, film)."""
    vertices, radius = np.zeros((CARS, 4, 2), np.float32), np.zeros(CARS, np.float32)
    surface, film, present = np.zeros(CARS, np.int32), np.zeros(CARS, np.float32), np.zeros(CARS, bool)
    for lane, (line, reach, name, depth) in shapes.items():
        vertices[lane] = np.pad(np.array(line, float), ((0, 4 - len(line)), (0, 0)), mode="edge") + np.array([0.0, LANES[lane]])
        radius[lane], surface[lane], film[lane], present[lane] = reach, SURFACES.index(name), depth, True
    nothing = jnp.zeros(CARS, jnp.float32)
    columns = (jnp.asarray(column) for column in (radius, surface, film))
    radius, surface, film = columns
    patches = Patches(jnp.asarray(vertices), jnp.zeros(CARS, bool), radius, surface, film, nothing, jnp.asarray(present))
    start = np.stack([np.zeros(CARS), LANES], 1)
    scene = scene_of(start, start, speeds=np.full(CARS, speed))
    scene = replace(scene, weather=replace(make_uniform(jnp.float32(0.0), jnp.int32(0)), patches=patches))
    second, init = backend()
    body, parts = init(scene), []
    action = np.stack(np.broadcast_arrays(throttle, steer, brake, np.zeros(CARS))[:3], -1).astype(np.float32)
    for _ in range(seconds):
        body, motion = second(scene, body, jnp.asarray(np.tile(action, (CHUNK, 1, 1))))
        parts.append(jax.tree.map(np.asarray, motion))
    motion = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    motion.position[..., 1] -= LANES
    return motion


def strip(left, right, surface, *, begin=-20.0, end=400.0, film=0.0):
    """A band along the lane between two offsets, round at its ends."""
    middle, half = (left + right) / 2, (left - right) / 2
    return [[begin + half, middle], [end - half, middle]], half, surface, film


LEFT, RIGHT = strip(12.0, 0.0, "ICE", begin=-100.0), strip(0.0, -12.0, "ICE", begin=-100.0)


@pytest.fixture(scope="module")
def braking():
    """All brake fully from 8 m/s: ice under the left or right wheels; all over; from 0 to 5 m; gravel; snow; a puddle; nothing."""
    full = lambda name, **numbers: strip(60.0, -60.0, name, begin=-100.0, **numbers)  # noqa: E731
    short = strip(1.5, -1.5, "ICE", begin=0.0, end=5.0)
    shapes = {0: LEFT, 1: RIGHT, 2: full("ICE"), 3: short, 4: full("GRAVEL"), 5: full("SNOW"), 6: full("AC", film=0.5)}
    return drive(shapes, speed=8.0, seconds=9, brake=1.0)


def test_wheels_on_the_two_sides_have_the_friction_of_their_side(braking):
    np.testing.assert_allclose(braking.mu[0, :2], (MU["ICE"] + MU["AC"]) / 2, atol=2e-3)
    wanted = [MU["ICE"], MU["GRAVEL"], MU["SNOW"], 0.8595, MU["AC"]]
    np.testing.assert_allclose(braking.mu[0, [2, 4, 5, 6, 7]], wanted, atol=2e-3)


def test_split_friction_turns_a_braking_car_to_the_side_that_grips(braking):
    yaw, aside = braking.yaw[:, :2], braking.position[:, :2, 1]
    half = CHUNK // 2
    assert yaw[half, 0] < -0.03 and aside[CHUNK, 0] < -0.02, "ice on the left: to the right"
    assert yaw[half, 1] > 0.03 and aside[CHUNK, 1] > 0.02, "and its mirror image"
    np.testing.assert_allclose(yaw[: 2 * half, 0], -yaw[: 2 * half, 1], atol=0.02)
    assert np.abs(braking.yaw[half, 2:]).max() < 0.005, "on even ground it stays straight"


def test_slippery_stretches_lengthen_the_way_to_stop(braking):
    stop = braking.position[-1, :, 0]
    assert np.linalg.norm(braking.velocity[-1, 2:], axis=-1).max() < 0.05
    even = [2, 4, 5, 6, 7]
    wanted = 8.0**2 / (2 * np.array([MU["ICE"], MU["GRAVEL"], MU["SNOW"], 0.8595, MU["AC"]]) * G)
    assert (stop[even] < 1.1 * wanted).all() and (stop[even] > 0.88 * wanted).all(), stop[even] / wanted  # ice: rolling resistance helps
    assert stop[7] + 2.0 < stop[3] < stop[5] < stop[2]
    assert braking.mu[0, 3] == pytest.approx((MU["ICE"] + MU["AC"]) / 2, abs=2e-3), "the front axle starts on the ice"


def test_ice_in_a_bend_pushes_a_car_wide():
    """Even cars turn left, odd ones right; there is ice at 12 m on the first two lanes, snow on the next, nothing on the others."""
    steer = 0.25 * np.array([1, -1] * 4)
    ahead = lambda name: ([[12.0, 0.0]], 7.0, name, 0.0)  # noqa: E731
    motion = drive({0: ahead("ICE"), 1: ahead("ICE"), 2: ahead("SNOW"), 3: ahead("SNOW")}, speed=11.0, seconds=3, steer=steer)
    speed = np.linalg.norm(motion.velocity[..., :2], axis=-1)
    flip = np.array([1.0, -1.0] * 4)
    radius = (speed / np.abs(motion.yaw_rate))[CHUNK, 6]
    # the dry car's circle: its centre lies to the left of where it is a second later
    place, yaw = motion.position[CHUNK, 6, :2], np.arctan2(*motion.velocity[CHUNK, 6, 1::-1])
    centre = place + radius * np.array([-np.sin(yaw), np.cos(yaw)])
    mirrored = motion.position[..., :2] * np.stack([np.ones(8), flip], -1)
    wide = np.linalg.norm(mirrored - centre, axis=-1)[CHUNK : 2 * CHUNK + 15].max(0) - radius
    assert np.abs(wide[4:]).max() < 1.0, "dry cars stay on their circle"
    assert (wide[:2] > 3.0).all() and (wide[2:4] > 1.0).all() and (wide[:2] > wide[2:4]).all()
    np.testing.assert_allclose(wide[::2], wide[1::2], atol=0.3)
    turned = np.abs(np.unwrap(motion.yaw, axis=0)[45] - motion.yaw[0])
    assert (turned[:2] < turned[2:4]).all() and (turned[2:4] < turned[4:].min() - 0.05).all()


def test_no_run_compiled_a_second_time():
    drive({}, speed=1.0, seconds=1)
    assert backend()[0]._cache_size() == 1


def test_the_condition_is_asked_where_the_wheels_are():
    """One wheel of four on a coin of ice: the mean friction says so, wherever the car stands and points."""
    coin = ([[1.3, 1.0]], 0.2, "ICE", 0.0)
    motion = drive({0: coin, 1: ([[1.3, -1.0]], 0.2, "ICE", 0.0), 2: ([[0.0, 0.0]], 0.5, "ICE", 0.0)}, speed=0.0, seconds=1)
    one = (3 * MU["AC"] + MU["ICE"]) / 4
    np.testing.assert_allclose(motion.mu[0, :4], [one, one, MU["AC"], MU["AC"]], atol=2e-3)
    assert read_condition(make_uniform(jnp.float32(0.0), jnp.int32(0)), jnp.zeros((2, 4, 2)))[0].shape == (2, 4)
