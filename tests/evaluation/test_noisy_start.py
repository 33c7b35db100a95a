"""V-Max's noisy start: what is drawn, where the car then is, and that it is drawn again while the car fails."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import road_of, scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import EDGE_BOUNDARY
from scenefactory_jax.evaluation import noisy_start
from scenefactory_jax.evaluation.settings import ScoreSettings

ROWS, SPEED, DRAWS = 10, 6.0, 4000
WORLDS = 8
SCORES = schema.read(load_config("evaluate", "protocol=vmax_noise")["protocol"]["scores"], ScoreSettings)
NOISE = SCORES.noise


def test_actions_are_those_of_v_max():
    """0.6 of 6 m/s^2; 0.3 1/m x 0.4 of a car that stands, x 0.03 from 40 km/h on; three quarters and a tenth of the others are strong."""
    speed = np.repeat(np.float32([0.0, 20 / 3.6, 40 / 3.6, 30.0]), DRAWS)
    drawn = jax.jit(lambda key, speed: noisy_start.draw_action(key, speed, NOISE))(jax.random.key(0), speed)
    push, bend = (np.asarray(part).reshape(4, DRAWS) for part in drawn)
    bounds = 0.3 * np.array([0.4, 0.215, 0.03, 0.03])
    for size in (np.abs(push) / 3.6, np.abs(bend) / bounds[:, None]):
        assert 0.99 < size.max() < 1.001
        assert np.mean(size >= 0.9) == pytest.approx(0.75 + 0.25 * 0.1, abs=0.02)
    both = (np.abs(push) / 3.6 >= 0.9) == (np.abs(bend) / bounds[:, None] >= 0.9)
    assert both.mean() == pytest.approx(0.75 + 0.25 * (0.01 + 0.81), abs=0.02), "an action is strong as a whole"
    assert np.mean(push > 0) == pytest.approx(0.5, abs=0.02) and np.mean(push * bend > 0) == pytest.approx(0.5, abs=0.02)


def log_scene(wall_m=50.0, *, start=True):
    """A car at 6 m/s along x that is at the origin in row 10, another that stands far away, and walls beside both."""
    scene = scene_of([[0.0, 0.0], [0.0, 30.0]], [[50.0, 0.0], [50.0, 30.0]], speeds=[SPEED, 0.0], steps=ROWS + 3)
    x = SPEED * 0.1 * (np.arange(ROWS + 3) - ROWS)
    position = np.stack([np.stack([x, 0 * x], -1), np.stack([0 * x, 0 * x + 30.0], -1)])
    velocity = np.zeros_like(position)
    velocity[0, :, 0] = SPEED
    valid = np.ones(position.shape[:2], bool)
    valid[:, 0] = start
    moved = {"position": jnp.asarray(position, jnp.float32), "velocity": jnp.asarray(velocity, jnp.float32)}
    log = replace(scene.log, **moved, yaw=jnp.zeros(valid.shape), valid=jnp.asarray(valid), dt=jnp.float32(0.1))
    line = np.arange(-60.0, 60.5, 0.5)
    edges = [(EDGE_BOUNDARY, np.stack([side * line, 0 * line - wall_m * side], -1)) for side in (1, -1)]
    return replace(scene, log=log, edges=road_of(edges))


@jax.jit
def perturb(keys, scenes):
    return noisy_start.perturb_starts(keys, scenes, NOISE, past_rows=ROWS)


@functools.cache
def perturbed(wall_m=50.0, start=True):
    scenes = jax.device_put(jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * WORLDS), log_scene(wall_m, start=start)))
    keys = jax.random.split(jax.random.key(1), WORLDS)
    return scenes, jax.device_get(perturb(keys, scenes))


def test_a_held_action_leads_to_the_start():
    """From row 0 the car moves by Waymax's bicycle with one acceleration and one curvature; the log goes on as recorded."""
    before, after = perturbed()
    np.testing.assert_array_equal(after.log.position[:, :, ROWS:], before.log.position[:, :, ROWS:])
    np.testing.assert_array_equal(after.log.position[:, :, 0], before.log.position[:, :, 0])
    position = np.concatenate([after.log.position[:, 0, :ROWS], after.agents.position[:, :1]], axis=1)
    yaw = np.concatenate([after.log.yaw[:, 0, :ROWS], after.agents.yaw[:, :1]], axis=1)
    speed = np.concatenate([np.linalg.norm(after.log.velocity[:, 0, :ROWS], axis=-1), after.agents.speed[:, :1]], axis=1)
    push = np.diff(speed, axis=1) / 0.1
    bend = np.diff(yaw, axis=1) / (speed[:, :-1] * 0.1 + 0.5 * push * 0.01)
    assert np.ptp(push, axis=1).max() < 1e-3 and np.ptp(bend, axis=1).max() < 1e-3, "held"
    assert len(np.unique(push[:, 0].round(3))) == WORLDS and (push[:, 0] > 0).any() and (push[:, 0] < 0).any()
    heading = np.stack([np.cos(yaw), np.sin(yaw)], -1)[:, :-1]
    expected = (speed[:, :-1] * 0.1 + 0.5 * push * 0.01)[..., None] * heading
    np.testing.assert_allclose(np.diff(position, axis=1), expected, atol=1e-4)


def test_a_car_that_stands_does_not_reverse():
    _, after = perturbed()
    assert (after.agents.speed[:, 1] >= 0).all() and after.agents.speed[:, 1].max() > 2.0


def test_a_drive_that_fails_is_drawn_again():
    """Between walls 1.25 m from the line of a car of 2 m width, an action with a strong curvature leaves the road."""
    free, narrow = perturbed()[1], perturbed(1.25)[1]
    aside = lambda scene: np.abs(np.concatenate([scene.log.position[:, 0, :ROWS, 1], scene.agents.position[:, :1, 1]], axis=1)).max(axis=1)  # noqa: E731
    assert (aside(free) > 0.25).sum() >= WORLDS // 2
    assert (aside(narrow) < 0.25).sum() > (aside(free) < 0.25).sum()


def test_without_a_past_a_start_is_as_recorded():
    before, after = perturbed(start=False)
    jax.tree.map(np.testing.assert_array_equal, after, before)
