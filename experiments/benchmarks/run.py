"""The benchmark with rows that only a checkout can measure: trainings with a stream of scenes, and the unvectorised baseline.

python -m experiments.benchmarks.run experiment=paper suite=throughput 'baseline={worlds: 1, steps: 90, repeats: 3}' out=FOLDER
python -m experiments.benchmarks.run experiment=paper suite=streaming scenes=womd scenes.path=BANK out=FOLDER
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments.benchmarks import streaming
from experiments.unvectorised_baseline import baseline_environment
from scenefactory_jax.cli import benchmark, entry
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning.training_loop import make_policy


def measure_baseline(config: Mapping[str, Any], scenes: scene_source.Scenes, numbers: Mapping[str, int]) -> dict[str, Any]:
    """Measures the same task as loops in Python over the C engine, without learning, on the scenes with the most cars."""
    fullest = np.argsort(-np.asarray(scenes.scene.agents.present).sum(axis=1), kind="stable")[: numbers["worlds"]]
    chosen = [scenes[int(index)] for index in fullest]
    env, policy = environment.make_env(config), make_policy(config)
    seen = env.reset(jax.random.key(config["seed"]), chosen[0])[1]
    parameters = policy.init(jax.random.key(config["seed"]), seen)
    timing = {"steps": numbers["steps"], "repeats": numbers["repeats"], "seed": config["seed"]}
    return baseline_environment.measure(config, chosen, parameters, **timing)


def run(config: Mapping[str, Any]) -> dict[str, Any]:
    """Measures all variants of a config."""
    return benchmark.benchmark(config, measure_stream=streaming.measure, measure_baseline=measure_baseline)


if __name__ == "__main__":
    entry.run("benchmark", run, about="measure steps per second, also with a stream of scenes and of the unvectorised baseline")
