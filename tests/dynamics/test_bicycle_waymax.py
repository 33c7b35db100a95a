"""Waymax's bicycle as a backend: actions and their inverse. `evaluation/test_waymax_golden` compares its formulas with golden values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.hand_scenes import scene_of

from scenefactory_jax.cli.hydra_config import load_config
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.dynamics import bicycle_waymax
from scenefactory_jax.env.actions import acceleration_and_steering

pytestmark = pytest.mark.usefixtures("quickly")
CONFIG = load_config("task", "dynamics=bicycle_waymax")["dynamics"]
DT = 0.1


def make(**changes):
    context = {"friction": lambda weather, position, speed: jnp.ones_like(speed), "physics_dt": DT, "control_dt": DT}
    return instantiate(CONFIG | changes, builtins="scenefactory_jax.dynamics", where="dynamics", **context)()


def drive(actions):
    """Motions of four cars under actions [T, 4, 3] of Waymax, the start first; the fourth car is inactive."""
    dynamics, start = make(), [[0.0, 50.0 * row] for row in range(4)]
    scene = scene_of(start, start, speeds=[5.0] * 4, yaws=[0.0, 1.0, -2.0, 0.0])
    active = jnp.array([True, True, True, False])

    def step(body, action):
        body = dynamics.advance(scene, body, acceleration_and_steering(action), active)
        return body, dynamics.read(body)

    def run(actions):
        body = dynamics.init(jax.random.key(0), scene)
        return dynamics.read(body), jax.lax.scan(step, body, actions)[1]

    first, rest = jax.jit(run)(jnp.asarray(actions, jnp.float32))
    return jax.tree.map(lambda one, many: np.concatenate([np.asarray(one)[None], many]), first, rest)


def invert(yaw, velocity):
    """Actions between the steps of tracks [A, L]."""
    push, bend = bicycle_waymax.compute_inverse_action(yaw[:, :-1], velocity[:, :-1], yaw[:, 1:], velocity[:, 1:], dt=DT)
    return jnp.stack([push / CONFIG["acceleration"], bend / CONFIG["curvature"]], axis=-1)


def test_expert_actions_lead_along_the_log():
    """Actions of a drive are found again from its states, and an inactive car stands."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.5, 0.5, (20, 4, 3))
    actions[..., 0] += 0.1  # never slower than 0.6 m/s
    motion = drive(actions)
    assert motion.velocity[:, :3].any() and not (motion.position[:, 3] - motion.position[0, 3]).any()
    speed = np.linalg.norm(motion.velocity[:, :3, :2], axis=-1)
    assert speed.min() > 0.6
    np.testing.assert_allclose(np.diff(speed, axis=0), DT * 6.0 * actions[:, :3, 0], atol=1e-5)
    track = lambda values: jnp.asarray(np.swapaxes(values[:, :3], 0, 1))  # noqa: E731
    found = invert(track(motion.yaw), track(motion.velocity[..., :2]))
    np.testing.assert_allclose(found, np.swapaxes(actions[:, :3, :2], 0, 1), atol=1e-3)


def test_a_standing_car_and_a_jump_have_finite_actions():
    found = invert(jnp.zeros((1, 3)), jnp.array([[[0.3, 0.0], [0.5, 0.1], [30.0, 0.0]]]))
    assert not found[0, :, 1].any() and found[0, 1, 0] > 1.0
    assert np.isfinite(found).all()


def test_numbers_are_checked():
    with pytest.raises(ConfigError, match=r"dynamics.curvature: expected a number > 0, got 0"):
        make(curvature=0.0)
