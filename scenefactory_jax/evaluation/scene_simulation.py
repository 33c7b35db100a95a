"""Simulates some seconds of every scene, as a check that it can be simulated at all."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from scenefactory_jax.core import markdown
from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.env.rollout import rollout, start_rollout

MEANING = {
    "cars": "agents",
    "faults": "cars whose motion was not finite at some step",
    "overlapping": "cars that touch another car or object in the first step",
    "on_edge": "cars that touch a road edge in the first step",
    "off_lane": "cars that begin away from any driving lane",
    "collision": "cars that hit another car or object at some step",
    "road_edge_contact": "cars that touched a road edge at some step",
}


def simulate(config: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Steps every scene for `simulate.seconds` and counts what went wrong: scene name -> counts, see MEANING.

    The default follows the log (`dynamics=log_playback`); `dynamics=bicycle spawning=from_rest` lets cars stand.
    """
    scene_source.use_compilation_cache()
    env, loaded = environment.make_env(config), scene_source.load_training_scenes(config["scenes"])
    steps = max(round(config["simulate"]["seconds"] * config["timing"]["control_hz"]), 1)
    run = jax.jit(jax.vmap(lambda key, scene: simulate_scene(env, key, scene, steps=steps)))
    results: dict[str, dict[str, int]] = {}
    size = min(config["simulate"]["worlds"], len(loaded))
    for start in range(0, len(loaded), size):
        rows = np.minimum(np.arange(start, start + size), len(loaded) - 1)  # the last block repeats the last scene: one shape, one program
        block = jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], loaded.scene)
        counts = jax.device_get(run(jax.random.split(jax.random.key(config["seed"]), size), block))
        for position, index in enumerate(range(start, min(start + size, len(loaded)))):
            results[loaded.names[index]] = {name: int(counts[name][position]) for name in MEANING}
    return results


def describe(results: Mapping[str, Mapping[str, int]]) -> str:
    """Formats a table of the scenes in which something went wrong, and the sums."""
    faulty = {name: row for name, row in results.items() if any(row[key] for key in list(MEANING)[1:])}
    lines = [markdown.format_table(["scene", *MEANING], [[name, *row.values()] for name, row in faulty.items()])]
    lines += [f"{key}: {sum(row[key] for row in results.values())} {meaning}" for key, meaning in MEANING.items()]
    return "\n".join([*lines, f"{len(results)} scenes; {len(results) - len(faulty)} without any of these"])


def simulate_scene(env: Env, key: PRNGKeyArray, scene: Scene, *, steps: int) -> dict[str, Array]:
    """Simulates one world without control input and counts its cars by what happened to them, see MEANING."""
    state = env.init_state(key, scene)
    present = state.active
    act = lambda parameters, observation, key: jnp.zeros((len(present), 3), jnp.float32)  # noqa: E731
    measure = lambda carry, step: (carry, (step.result.metrics, step.before.active))  # noqa: E731
    _, (metrics, active) = rollout(env, act, None, scene, start_rollout(state, None), key, steps=steps, hook=measure)
    events, at_any_step = metrics.events, lambda event: jnp.any(event & active, axis=0)  # metrics of inactive cars are not valid
    marks = {
        "cars": present,
        "faults": at_any_step(events.numerical_error),
        "overlapping": (metrics.contact_force[0] > 0) & present,
        "on_edge": events.road_edge_contact[0] & present,
        "off_lane": metrics.off_lane[0] & present,
        "collision": at_any_step(events.collision),
        "road_edge_contact": at_any_step(events.road_edge_contact),
    }
    return {name: jnp.sum(mark) for name, mark in marks.items()}
