"""Pure pursuit of the goal, with a bicycle and by its errors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.learning.training_loop import make_policy

DT_S, BASE_M, LIMIT_RAD = 0.05, 2.6, 0.55654


@pytest.fixture(scope="module")
def pursuit():
    config = apply_overrides(load_config("train", "experiment=laptop"), ["policy=pure_pursuit", "dynamics=bicycle"])
    policy = make_policy(config)
    return policy._replace(apply=jax.jit(policy.apply))


def observe(goal_m, pose, speed_mps):
    """Observation group `ego` of a car at x, y, yaw."""
    away = np.asarray(goal_m) - pose[:2]
    forward = np.array([math.cos(pose[2]), math.sin(pose[2])])
    x, y, d = away @ forward, forward[0] * away[1] - forward[1] * away[0], np.linalg.norm(away)
    return {"ego": jnp.array([x / 100, y / 100, y / d, x / d, d / 100, speed_mps / 10, 0.0])}


def drive(pursuit, goal_m, *, steps=1200):
    """Least distance to the goal, the angles of the wheel, and the last speed of a bicycle about its rear axle that starts at rest."""
    pose, speed, least, steers = np.zeros(3), 0.0, math.inf, []
    for _ in range(steps):
        (throttle, steer, brake), _, _ = pursuit.apply({}, observe(goal_m, pose, speed))
        assert float(brake) == -1.0
        steers.append(float(steer))
        speed += 2.0 * float(throttle) * DT_S
        pose += DT_S * speed * np.array([math.cos(pose[2]), math.sin(pose[2]), math.tan(LIMIT_RAD * float(steer)) / BASE_M])
        least = min(least, float(np.hypot(*(goal_m - pose[:2]))))
        if least < 0.5:
            break
    return least, np.array(steers), speed


@pytest.mark.parametrize("goal_m", [(40.0, 0.0), (30.0, 20.0), (12.0, -15.0), (-30.0, 8.0)])
def test_the_goal_is_reached_on_a_circle(pursuit, goal_m):
    least, steers, speed = drive(pursuit, np.array(goal_m))
    assert least < 0.5 and speed < 8.01
    if goal_m[0] > 0:  # one turn of the wheel, held to the end
        np.testing.assert_allclose(steers[: len(steers) * 3 // 4], steers[0], atol=0.02)
    else:
        assert steers[0] == 1.0


def test_the_speed_is_held_for_any_batch_and_any_parameters(pursuit):
    ego = jnp.stack([observe((50.0, 0.0), np.zeros(3), speed)["ego"] for speed in (0.0, 8.0, 15.0)])
    mean, log_std, value = pursuit.apply({"of": jnp.ones(3)}, {"ego": jnp.stack([ego, ego])})
    np.testing.assert_allclose(mean[1, :, 0], [1.0, 0.0, -1.0], atol=1e-6)
    assert mean.shape == (2, 3, 3) and log_std.shape == (3,) and value.shape == (2, 3)


def test_missing_observations_and_wrong_numbers_are_named(pursuit):
    settings = apply_overrides(load_config("train", "experiment=laptop"), ["policy=pure_pursuit"])["policy"]
    with pytest.raises(ConfigError, match=r"pure pursuit needs the observation group `ego`; the observation has: turning"):
        pursuit.apply({}, {"turning": jnp.zeros(2)})
    for key in ("speed_mps", "goal_scale_m"):
        with pytest.raises(ConfigError, match=rf"policy\.{key}"):
            make_policy({"policy": {**settings, key: 0.0}})
    car = settings["trackers"]["bicycle"]
    with pytest.raises(ConfigError, match=r"policy\.trackers\.bicycle\.steering_limit_rad"):
        make_policy({"policy": {**settings, "trackers": {"bicycle": {**car, "steering_limit_rad": 2.0}}}})
