"""Time of WOSAC's scores on a made-up scene of real size: random drives between random road edges.

python -m experiments.benchmarks.wosac --scenes 1
"""

import argparse
import functools
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

from scenefactory_jax.evaluation.metrics import wosac_scores
from scenefactory_jax.evaluation.metrics.wosac_features import HISTORY_STEPS, Objects
from scenefactory_jax.evaluation.metrics.wosac_map_features import Lights, Lines, RoadMap

STEPS, POINTS_A_LINE, LIGHTS = HISTORY_STEPS + 80, 50, 16


def make_lines(rng: np.random.Generator, points: int) -> Lines:
    """Lines of POINTS_A_LINE points, half a metre apart."""
    line = np.arange(points) // POINTS_A_LINE
    turn = np.cumsum(rng.normal(0.0, 0.02, points)) + rng.uniform(-np.pi, np.pi, points)[line]
    way = np.cumsum(0.5 * np.stack([np.cos(turn), np.sin(turn), np.zeros(points)], axis=-1), axis=0)
    start = rng.uniform(-100.0, 100.0, (points, 3)) * [1.0, 1.0, 0.01]
    return Lines(jnp.asarray(way - way[line * POINTS_A_LINE] + start[line], jnp.float32), jnp.asarray(line), jnp.ones(points, bool))


def make_scene(seed: int, *, objects: int, evaluated: int, rollouts: int, points: int):
    """The operands of `score_rollouts`."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi, (objects, 1)) + np.cumsum(rng.normal(0.0, 0.02, (1 + rollouts, objects, STEPS)), axis=-1)
    step = rng.uniform(0.0, 1.5, (objects, 1, 1)) * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    position = rng.uniform(-80.0, 80.0, (objects, 1, 2)) + np.cumsum(step, axis=2)
    state = np.concatenate([position, np.zeros_like(turn)[..., None], turn[..., None]], axis=-1).astype(np.float32)
    log = Objects(jnp.asarray(state[0]), jnp.ones((objects, STEPS), bool), jnp.tile(jnp.array([4.5, 2.0, 1.6]), (objects, 1)))
    lanes = make_lines(rng, points)
    stop = lanes.position[::POINTS_A_LINE][:LIGHTS]
    lights = Lights(lanes.line[::POINTS_A_LINE][:LIGHTS], jnp.full((STEPS, len(stop)), 4), stop)
    chosen = jnp.arange(evaluated), jnp.ones(evaluated, bool), jnp.ones(objects, bool)
    return log, jnp.asarray(state[1:, :, HISTORY_STEPS:]), *chosen, RoadMap(make_lines(rng, points), lanes, lights)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    sizes = {"scenes": 1, "objects": 128, "evaluated": 8, "rollouts": 32, "points": 4096, "repeats": 3}
    for name, value in sizes.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    numbers = vars(parser.parse_args())
    scenes, repeats = numbers.pop("scenes"), numbers.pop("repeats")
    operands = jax.tree.map(lambda *rows: jnp.stack(rows), *(make_scene(seed, **numbers) for seed in range(scenes)))
    score = jax.vmap(functools.partial(wosac_scores.score_rollouts, challenge=wosac_scores.CHALLENGES[2025]))
    begun = time.perf_counter()
    compiled = jax.jit(score).lower(*operands).compile()
    compile_s, seconds = time.perf_counter() - begun, []
    for _ in range(1 + repeats):
        begun = time.perf_counter()
        jax.block_until_ready(compiled(*operands))
        seconds.append(time.perf_counter() - begun)
    memory = compiled.memory_analysis()
    row = {
        "device": jax.devices()[0].device_kind,
        "scenes": scenes,
        **numbers,
        "compile_s": compile_s,
        "seconds_a_scene": float(np.median(seconds[1:])) / scenes,
        "scratch_mib": memory.temp_size_in_bytes / 2**20 if memory else None,
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
