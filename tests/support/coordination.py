"""CoPO on probes and on a game of neighbours; in a process of its own on one virtual device and on two, what it learnt as JSON."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.learning.copo import train_iteration
from scenefactory_jax.learning.copo.config import CoPOConfig
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.trainer import get_policy_parameters
from support.probes import SMALL, ppo_config, probe, scenes

NUMBERS = dict(values=3, radius_m=40.0, lcf_mean=0.0, lcf_std=0.1, learning_rate=1e-2, passes=5)
GAME = 6
POLICY = late_fusion.make(**SMALL, values=3)


def make_numbers(**changes):
    return schema.read(NUMBERS | changes, CoPOConfig, where="learner")


def game(own=-0.5, others=1.0, **options):
    """The probes and, as task 6, a game in which an agent's throttle pays `own` to itself and `others` to every other active agent."""
    env = probe(**options)

    def control_step(scene, state, action):
        after, result = env.control_step(scene, state, action)
        throttle = jnp.where(state.active, jnp.clip(action[:, 0], -1.0, 1.0), 0.0)
        paid = own * throttle + others * (throttle.sum() - throttle)
        paid = jnp.where(state.active & (scene.weather.surface == GAME), paid, result.reward)
        return after, dataclasses.replace(result, reward=paid, terms={"paid": paid})

    return env._replace(control_step=control_step)


def make_learner(env, *, mesh=None, ppo=None, episode_steps=1000, **changes):
    return train_iteration.make_trainer(
        env, POLICY, ppo_config(**(ppo or {})), make_numbers(**changes), episode_steps=episode_steps, mesh=mesh
    )


def learn(devices):
    """Parameters, factors and metrics after three iterations, and whether the devices hold the same parameters."""
    mesh = sharding.make_mesh(devices)
    numbers = {"shards": 2, "stagger_episodes": True, "sample_fraction": 0.75}
    trainer = make_learner(game(life=3, episode_steps=4), mesh=mesh, ppo=numbers, episode_steps=4)
    stage = sharding.place_on_devices(jax.tree.map(np.asarray, scenes(8, GAME)), mesh)
    state = trainer.init(jax.random.key(3), stage)
    for _ in range(3):
        state, metrics = trainer.train_iteration(state, stage)
    copies = [[np.asarray(shard.data) for shard in leaf.addressable_shards] for leaf in jax.tree.leaves((state.parameters, state.learner))]
    return {
        "parameters": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(get_policy_parameters(state))]).tolist(),
        "factors": np.asarray(state.buffer["copo"]).tolist(),
        "metrics": {key: float(value) for key, value in metrics.items()},
        "same": all((one == leaf[0]).all() for leaf in copies for one in leaf),
        "parts": len(state.buffer["copo"].addressable_shards),
    }


if __name__ == "__main__":
    print("RESULT", json.dumps([learn(devices) for devices in (1, 2)]), flush=True)
