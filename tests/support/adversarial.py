"""GAIL and AIRL on a probe; in a process of its own on one virtual device and on two, what they learnt as JSON."""

import json

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.core import schema, sharding
from scenefactory_jax.learning.adversarial import airl, gail, train_iteration
from scenefactory_jax.learning.adversarial.config import AdversarialConfig
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.trainer import get_policy_parameters
from support.probes import SMALL, expert, ppo_config, probe, scenes

GAMMA = 0.9
NUMBERS = dict(
    hidden=[16],
    activation="tanh",
    learning_rate=1e-2,
    l2=1e-5,
    passes=2,
    batch=64,
    expert={},
    samples=None,
    expert_every=2,
    expert_steps=16,
    buffer=512,
    storage="float32",
)
POLICY = late_fusion.make(**SMALL)


def make_numbers(**changes):
    return schema.read(NUMBERS | changes, AdversarialConfig, where="learner")


def make_discriminator(name):
    if name == "gail":
        return gail.make_discriminator(POLICY, make_numbers())
    return airl.make_discriminator(POLICY, make_numbers(), gamma=GAMMA)


def remembering_probe():
    """Agents of three steps that see their cue and what they did last: states say what an expert does."""

    def observe(scene, state):
        seen = jnp.stack([state.body, state.previous_action[:, 0]], axis=-1)
        return {"cue": jnp.where(state.active[:, None], seen, 0.0)}

    return probe(life=3)._replace(observe=observe)


def make_learner(name, *, mesh=None, shards=None, env=None, expert=expert, **changes):
    numbers = ppo_config(learning_rate=1e-2, gamma=GAMMA, shards=shards)
    judge, env = make_discriminator(name), env or remembering_probe()
    return train_iteration.make_trainer(
        name, env, POLICY, judge, numbers, make_numbers(**changes), expert, numbers=2, episode_steps=1000, mesh=mesh
    )


def learn(name, devices):
    """Parameters, the expert's actions and the metrics after two iterations, and whether the devices hold the same parameters."""
    mesh = sharding.make_mesh(devices)
    trainer, stage = make_learner(name, mesh=mesh, shards=2), sharding.place_on_devices(jax.tree.map(np.asarray, scenes(8, 1)), mesh)
    state = trainer.init(jax.random.key(3), stage)
    for _ in range(2):
        state, metrics = trainer.train_iteration(state, stage)
    copies = [[np.asarray(shard.data) for shard in leaf.addressable_shards] for leaf in jax.tree.leaves(state.learner)]
    leaves = jax.tree.leaves((get_policy_parameters(state), state.learner[name].parameters))
    return {
        "parameters": np.concatenate([np.ravel(leaf) for leaf in leaves]).tolist(),
        "rows": np.asarray(state.buffer[name].rows["action"]).tolist(),
        "metrics": {key: float(value) for key, value in metrics.items()},
        "same": all((one == leaf[0]).all() for leaf in copies for one in leaf),
        "parts": len(state.buffer[name].filled.addressable_shards),
    }


if __name__ == "__main__":
    print("RESULT", json.dumps([learn("gail", devices) for devices in (1, 2)]), flush=True)
