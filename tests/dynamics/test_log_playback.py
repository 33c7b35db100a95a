"""Cars that follow the recording: between its rows, through its gaps, before its first and after its last."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_dynamics import LANES, drive, random_controls, scene_for

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.track_interpolation import interpolate_track
from scenefactory_jax.core.types import AgentLog

pytestmark = pytest.mark.usefixtures("quickly")


def logged(valid):
    """Cars that run at 10 m/s along x and turn at 0.5 rad/s through the wrap of the angle, every 0.1 s."""
    t = 0.1 * np.arange(len(valid))
    position = np.stack([np.stack([10 * t, np.full_like(t, y)], -1) for y in LANES])
    yaw = np.tile((3.0 + 0.5 * t + np.pi) % (2 * np.pi) - np.pi, (8, 1))
    velocity = np.tile(np.array([10.0, 0.0]), (8, len(t), 1))
    position, yaw, velocity = (jnp.asarray(x, jnp.float32) for x in (position, yaw, velocity))
    return AgentLog(position=position, yaw=yaw, velocity=velocity, valid=jnp.tile(jnp.asarray(valid, bool), (8, 1)), dt=jnp.float32(0.1))


def test_replay_follows_the_log_whatever_the_action():
    scene = replace(scene_for(), log=logged([True] * 11))
    _, (_, motion) = drive("log_playback", scene, random_controls(0, 2, 1))
    t = np.arange(1, 61) / 30
    moving = t < 1.0 - 1e-6
    np.testing.assert_allclose(motion.position[:, 0, 0], np.minimum(10 * t, 10.0), atol=1e-4)
    np.testing.assert_allclose(motion.velocity[moving, 0, 0], 10.0, rtol=1e-5)
    np.testing.assert_allclose(motion.yaw_rate[moving, 0], 0.5, rtol=1e-3)
    assert not motion.velocity[t > 1.01].any()
    np.testing.assert_allclose(np.unwrap(motion.yaw[:, 0])[moving], 3.0 + 0.5 * t[moving], atol=1e-3)
    assert np.abs(motion.yaw).max() <= np.pi + 1e-5


def test_replay_bridges_gaps_and_stands_where_nothing_was_seen():
    log = logged([False, True, True, False, False, True, False, False])
    at = lambda row: interpolate_track(jnp.float32(row), log.position[0], log.yaw[0], log.velocity[0], log.valid[0], dt=log.dt)  # noqa: E731
    cases = ((0.0, 1, 0), (0.5, 1, 0), (1.5, 1.5, 10), (3.0, 3, 10), (4.5, 4.5, 10), (5.0, 5, 10), (6.5, 5, 0), (99.0, 5, 0))
    for row, x, speed in cases:
        turning = speed if row < 5.0 else 0  # the last row has its logged velocity; nothing is known of how it turns on
        position, velocity, _, yaw_rate = at(row)
        assert float(position[0]) == pytest.approx(x, abs=1e-4), row
        assert float(velocity[0]) == pytest.approx(speed, abs=1e-4) and float(yaw_rate) == pytest.approx(0.05 * turning, abs=1e-3), row
    nothing = interpolate_track(jnp.float32(2.0), log.position[0], log.yaw[0], log.velocity[0], log.valid[0] & False, dt=log.dt)
    assert all(np.isfinite(x).all() for x in nothing) and not nothing[1].any()
