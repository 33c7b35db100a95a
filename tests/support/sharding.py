"""Runs in processes of its own: a few iterations of PPO on so many devices in so many shards; prints what was learnt as JSON.

    python sharding.py DEVICES:SHARDS[:PAST][,DEVICES:SHARDS ...][,LEARNER ...] [COORDINATOR PROCESSES INDEX]

PAST: of two past policies, which the probe reads, the newest replaces the oldest every so many iterations. LEARNER: of `learner_sharding`,
in the same process, which spares another one's start.
"""

import itertools
import json
import sys

import jax

if len(sys.argv) > 2:
    jax.distributed.initialize(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))

import numpy as np

from scenefactory_jax.core import sharding
from scenefactory_jax.learning import past_policies
from scenefactory_jax.learning.networks import late_fusion
from scenefactory_jax.learning.trainer import get_policy_parameters
from support import learner_sharding
from support.probes import SMALL, make_trainer, probe, probe_with_past, scenes

WORLDS = 8
COMPILED = ("jit(train_iteration)", "jit(replace_scenes)")


def learn(devices, shards, every=None):
    """Parameters and metrics after three iterations, other scenes in half of the worlds between them; and what was compiled."""
    mesh = sharding.make_mesh(devices)
    numbers = {"desired_kl": 0.01, "stagger_episodes": True, "sample_fraction": 0.75, "shards": shards}
    env, make = probe(life=5, episode_steps=6), lambda env: make_trainer(env, episode_steps=6, mesh=mesh, **numbers)
    if every is None:
        trainer = make(env)
    else:
        watched = probe_with_past(every, life=5, episode_steps=6)
        trainer = past_policies.add_past_policies(make, watched, late_fusion.make(**SMALL), mesh=mesh)
    stage = sharding.place_on_devices(jax.tree.map(np.asarray, scenes(WORLDS)), mesh)
    fresh = sharding.place_on_devices(jax.tree.map(np.asarray, scenes(WORLDS // 2, task=2)), mesh)
    compiled, history = [], []

    def note(event, _, **of):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(of["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(note)
    state = trainer.init(jax.random.key(3), stage)
    for iteration in range(3):
        if iteration:
            state, stage = trainer.replace_scenes(state, stage, np.array([5, 1, 2, 4]) + iteration, fresh)
        state, metrics = trainer.train_iteration(state, stage)
        history.append({name: float(value) for name, value in metrics.items()})
    jax.monitoring.unregister_event_duration_listener(note)
    found = {"record": np.asarray(state.scene_stats.episodes).tolist(), "compiled": [name for name in compiled if name in COMPILED]}
    state = trainer.restart(state, stage)
    if every is not None:
        found["taken"] = [np.asarray(shard.data).tolist() for shard in state.past.iteration.addressable_shards]
        newest = jax.tree.map(lambda kept: kept[int(np.argmax(found["taken"][0]))], jax.device_get(state.past.parameters))
        found["newest"] = [*itertools.chain(*(np.ravel(leaf).tolist() for leaf in jax.tree.leaves(newest)))]
    learnt = [np.asarray(leaf).ravel().tolist() for leaf in jax.tree.leaves(get_policy_parameters(state))]
    found |= {"devices": len(jax.devices()), "processes": jax.process_count()}
    return {"parameters": [*itertools.chain(*learnt)], "metrics": history, **found}


if __name__ == "__main__":
    words = sys.argv[1].split(",")
    found = [learn(*map(int, word.split(":"))) if word[0].isdigit() else learner_sharding.learn_on_each(word) for word in words]
    print("RESULT", json.dumps(found), flush=True)
