"""Runs in a process of its own with two virtual devices: learners on one device and on both; prints what was learnt as JSON."""

import json
import sys

import jax
import numpy as np

from scenefactory_jax.core import sharding
from scenefactory_jax.learning import sample_stream
from scenefactory_jax.learning.trainer import get_policy_parameters
from support.probes import make_learner, probe, scenes


def learn(name, devices):
    """Parameters, buffers' rows and the metrics after three iterations, and whether the devices hold the same parameters."""
    mesh = sharding.make_mesh(devices)
    _, trainer = make_learner(name, probe(life=2, episode_steps=3), mesh=mesh, shards=2, stagger_episodes=True, episode_steps=3)
    stage = sharding.place_on_devices(jax.tree.map(np.asarray, scenes(8)), mesh)
    state = trainer.init(jax.random.key(3), stage)
    for _ in range(3):
        state, metrics = trainer.train_iteration(state, stage)
    copies = [[np.asarray(shard.data) for shard in leaf.addressable_shards] for leaf in jax.tree.leaves(state.parameters)]
    return {
        "parameters": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(get_policy_parameters(state))]).tolist(),
        "critics": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(state.learner["sac"].critics)]).tolist(),
        "rows": [np.asarray(buffer.rows["action"]).tolist() for buffer in state.buffer.values()],
        "filled": [np.asarray(buffer.filled).tolist() for buffer in state.buffer.values()],
        "metrics": {name: float(value) for name, value in metrics.items()},
        "same": all((one == leaf[0]).all() for leaf in copies for one in leaf),
        "parts": [len(buffer.filled.addressable_shards) for buffer in state.buffer.values()],
    }


def fill(name, devices):
    """Rows and metrics of a learner from recorded samples, after a chunk of 60 samples, 30 in each group, and an iteration."""
    mesh = sharding.make_mesh(devices)
    _, trainer = make_learner("bc", probe(), mesh=mesh, shards=2, samples="there")
    stage = sharding.place_on_devices(jax.tree.map(np.asarray, scenes(8)), mesh)
    state = trainer.init(jax.random.key(3), stage)
    cue = np.linspace(-1, 1, 60, dtype=np.float32)[:, None]
    arrays = sample_stream.divide({"cue": cue, "action": np.concatenate([cue, -cue], axis=1)}, 2, size=32)
    chunk = {"observation": {"cue": arrays["cue"]}, "action": arrays["action"]}, arrays[sample_stream.VALID]
    state = trainer.put_samples(state, *sharding.place_on_devices(chunk, mesh))
    state, metrics = trainer.train_iteration(state, stage)
    buffer = state.buffer["bc"]
    return {
        "rows": np.asarray(buffer.rows["action"]).tolist(),
        "filled": np.asarray(buffer.filled).tolist(),
        "metrics": {name: float(value) for name, value in metrics.items()},
        "parts": len(buffer.filled.addressable_shards),
    }


def learn_on_each(name):
    """What is learnt on one device and on two."""
    return [(fill if name == "recorded" else learn)(name, devices) for devices in (1, 2)]


if __name__ == "__main__":
    print("RESULT", json.dumps(learn_on_each(sys.argv[1])), flush=True)
