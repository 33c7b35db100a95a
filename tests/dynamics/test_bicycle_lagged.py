"""nuPlan's lags of the bicycle: commands act as first-order lags by implicit Euler steps, and without lags nothing changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import driving

from scenefactory_jax.dynamics import bicycle

THROTTLE, STEER, BRAKE = 0.5, 0.25, 0.0
STEPS = np.arange(1, driving.CHUNK + 1)


@pytest.fixture(scope="module")
def lagged():
    """Bodies and motions of a second of a constant command, from 5 m/s."""
    scene = driving.scene_for(speed=5.0)
    return driving.drive("bicycle_lagged", scene, driving.constant(THROTTLE, STEER, BRAKE))[1]


def test_acceleration_and_steering_approach_their_commands(lagged):
    """x_n = command (1 - (lag / (dt + lag))^n): constants of nuPlan, 0.2 s and 0.05 s."""
    body, motion = lagged
    numbers, dt = driving.config("bicycle_lagged"), 1 / 30
    assert (numbers["acceleration_lag_s"], numbers["steering_lag_s"]) == (0.2, 0.05)
    steer = numbers["steering_limit"] * STEER * (1 - (0.05 / (dt + 0.05)) ** STEPS)
    np.testing.assert_allclose(motion.steer[:, 0], steer, rtol=1e-5)
    throttle = THROTTLE * (1 - (0.2 / (dt + 0.2)) ** STEPS)
    np.testing.assert_allclose(body.command[:, 0, 0], throttle, rtol=1e-5)
    speed = np.concatenate([[5.0], body.body.speed[:, 0]])
    push = np.diff(speed) / dt + numbers["rolling"] + numbers["air_drag"] * speed[:-1] ** 2
    np.testing.assert_allclose(push, numbers["acceleration"] * throttle, atol=2e-4)


def test_released_pedals_are_at_zero_and_cars_that_have_ended_stay():
    active = jnp.arange(8) < 4
    body, _ = driving.drive("bicycle_lagged", driving.scene_for(speed=5.0), driving.constant(-1.0, STEER, -1.0), active)
    np.testing.assert_array_equal(body.command[:, [0, 2]], 0.0)
    np.testing.assert_allclose(body.command[:, 1], np.where(active, STEER, 0.0), atol=1e-5)
    assert (np.asarray(body.body.position)[4:, 0] == 0.0).all() and (np.asarray(body.body.position)[:4, 0] > 4.0).all()


def test_without_lags_it_is_the_plain_bicycle():
    none = driving.make("bicycle_lagged", acceleration_lag_s=0.0, steering_lag_s=0.0)
    assert isinstance(jax.eval_shape(none.init, driving.KEY, driving.scene_for()), bicycle.Body)
