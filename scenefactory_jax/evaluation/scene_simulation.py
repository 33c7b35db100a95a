"""`scenes op=simulate`: some seconds of every scene, as a check that it can be simulated at all."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from scenefactory_jax.core.types import Env, Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.evaluation import agent_metrics

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
    """Steps every scene for `simulate.seconds` and counts what went wrong, scene by scene.

    The default follows the log (`dynamics=log_playback`); `dynamics=bicycle spawning=from_rest` lets cars stand.

    Returns:
        Scene name -> counts, see MEANING.

    Raises:
        ConfigError: an environment that cannot be made.
        SceneError: nothing usable at the path.
    """
    scene_source.use_compilation_cache()
    env, loaded = environment.make_env(config), scene_source.load_training_scenes(config["scenes"])
    steps = max(round(config["simulate"]["seconds"] * config["timing"]["control_hz"]), 1)
    run = jax.jit(jax.vmap(lambda key, scene: drive(env, key, scene, steps=steps)))
    found: dict[str, dict[str, int]] = {}
    size = min(config["simulate"]["worlds"], len(loaded))
    for begin in range(0, len(loaded), size):
        rows = np.minimum(np.arange(begin, begin + size), len(loaded) - 1)  # the last block repeats the last scene: one shape, one program
        block = jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], loaded.scene)
        counts = jax.device_get(run(jax.random.split(jax.random.key(config["seed"]), size), block))
        for place, index in enumerate(range(begin, min(begin + size, len(loaded)))):
            found[loaded.names[index]] = {name: int(counts[name][place]) for name in MEANING}
    return found


def describe(found: Mapping[str, Mapping[str, int]]) -> str:
    """A table of the scenes in which something went wrong, and the sums."""
    bad = {name: row for name, row in found.items() if any(row[key] for key in list(MEANING)[1:])}
    lines = [agent_metrics.grid(["scene", *MEANING], [[name, *row.values()] for name, row in bad.items()])]
    lines += [f"{key}: {sum(row[key] for row in found.values())} {meaning}" for key, meaning in MEANING.items()]
    return "\n".join([*lines, f"{len(found)} scenes; {len(found) - len(bad)} without any of these"])


def drive(env: Env, key: PRNGKeyArray, scene: Scene, *, steps: int) -> dict[str, Array]:
    """One world without any control input: how many of its cars had what, see MEANING."""
    state = env.init_state(key, scene)
    present = state.active
    action = jnp.zeros((len(present), 3), jnp.float32)

    def advance(state, _):
        after, outcome = env.control_step(scene, state, action)
        return after, (outcome.metrics, state.active)

    _, (metrics, active) = jax.lax.scan(advance, state, length=steps)
    events, ever = metrics.events, lambda past_events: jnp.any(past_events & active, axis=0)  # metrics of finished cars mean nothing
    marks = {
        "cars": present,
        "faults": ever(events.numerical_error),
        "overlapping": (metrics.contact_force[0] > 0) & present,
        "on_edge": events.road_edge_contact[0] & present,
        "off_lane": metrics.off_lane[0] & present,
        "collision": ever(events.collision),
        "road_edge_contact": ever(events.road_edge_contact),
    }
    return {name: jnp.sum(mark) for name, mark in marks.items()}
