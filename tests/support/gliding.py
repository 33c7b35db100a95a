"""An environment on stand-in bodies that keep their velocity, for tests of everything but dynamics."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import geometry, schema
from scenefactory_jax.core.types import Dynamics, Motion
from scenefactory_jax.env import actions, environment, observations, rewards, route_following, spawning, step_metrics, termination, traffic
from scenefactory_jax.weather.road_condition import keep_condition

CIRCLES = {"radius_fraction": 0.55, "radius_floor_m": 0.45, "spacing_limit_m": 1.3}


def glide() -> Dynamics:
    """Cars that keep their velocity; action 0 steers the speed directly. Throttle above 0.99 breaks the car (NaN)."""

    def init(key, scene):
        a = scene.agents
        return {"p": a.position, "yaw": a.yaw, "v": a.speed, "force": jnp.zeros_like(a.speed)}

    def advance(scene, body, action, active):
        v = jnp.where(active, body["v"] + action[:, 0], body["v"])
        v = jnp.where(action[:, 0] > 0.99, jnp.nan, v)
        p = body["p"] + jnp.where(active, v / 30, 0.0)[:, None] * geometry.heading_vector(body["yaw"])
        return {**body, "p": p, "v": v, "force": jnp.where(action[:, 2] > 0.5, 100.0, 0.0)}

    def read(body):
        zero = jnp.zeros_like(body["v"])
        flat = lambda xy, z: jnp.concatenate([xy, z[:, None]], axis=1)  # noqa: E731
        velocity = body["v"][:, None] * geometry.heading_vector(body["yaw"])
        place, speed = flat(body["p"], zero + 0.6), flat(velocity, zero)
        return Motion(place, speed, body["yaw"], zero, zero + 1, zero, body["force"], zero + 1, zero, zero)

    return Dynamics(init, advance, read)


def build_env(config, *, draw=spawning.logged, steps=1500, respawn=None, ending=None, beside=None, hold=1, move=None):
    metrics = schema.read(config["step_metrics"], step_metrics.StepMetricsConfig)
    parts = environment.EnvParts(
        dynamics=glide(),
        map_action=actions.pedals_with_reverse,
        action_repeat=hold,
        sample_agents=draw,
        sample_weather=keep_condition,
        traffic=beside or traffic.no_traffic(),
        advance_route=functools.partial(route_following.advance, config=metrics.route),
        compute_metrics=functools.partial(step_metrics.compute, config=metrics, control_dt=1 / 30),
        evaluate_termination=functools.partial(termination.evaluate, ending=ending or config["termination"]["ending"]),
        terms=rewards.make(config["reward"]),
        groups=observations.make(
            {**config["observations"], "road": {**config["observations"]["road"], "count": 40}},
            reward_ranges=rewards.read_ranges(config["reward"]),
        ),
        episode_steps=steps,
        control_dt=1 / 30,
        respawn_clearance_m=respawn,
        move_action=move,
    )
    env = environment.assemble(parts)  # compiled: operations that run one by one are compiled one by one
    return env._replace(reset=jax.jit(env.reset), init_state=jax.jit(env.init_state), observe=jax.jit(env.observe))


@functools.cache
def jitted(function):
    """One compiled function an environment, whichever test asks."""
    return jax.jit(function)


def drive(env, scene, action, steps, key=0):
    """State and results of that many actions, these as numpy."""
    state, _ = env.reset(jax.random.key(key), scene)
    history = []
    for _ in range(steps):
        state, outcome = jitted(env.step)(scene, state, action)
        history.append(jax.tree.map(np.asarray, outcome))
    return state, history
