"""The parts of `validate` that need more than physics: a whole task with its scenes, a learner, or a clock."""

import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments.benchmarks import physics_features as timing
from experiments.validation import fault_isolation as breaking
from experiments.validation.measurements import Spread, bound
from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.types import Scene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.env import environment
from scenefactory_jax.learning.training_loop import make_policy, make_trainer

DETERMINISTIC = "xla_gpu_deterministic_ops=true"  # the flag of XLA that a GPU needs to give the same bits twice


def faults(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """One broken car after the other in whole worlds, and the same seed twice: what differs, bit for bit."""
    del spread  # all in this process
    own = dict(config["validation"]["faults"])
    settings = configs.load_config("train", *own.pop("task"))
    worlds = _worlds(settings["scenes"], settings["worlds"], config["validation"]["seed"])
    env = environment.make_env(settings)
    present = np.flatnonzero(np.asarray(worlds.agents.present[own["world"]]))
    seed = config["validation"]["seed"]
    own["agent"] = int(present[min(own["agent"], len(present) - 1)])
    run = bound(own, breaking, "run", "validation.faults", seed=seed)
    report = run(env, make_trainer(settings, env, make_policy(settings)), worlds)
    return {
        "worlds": settings["worlds"],
        "cars": int(worlds.agents.present.sum()),
        "steps": own["steps"],
        "iterations": own["iterations"],
        "deterministic_flag": DETERMINISTIC in os.environ.get("XLA_FLAGS", ""),
        "backend": jax.default_backend(),
        "faults": [finding._asdict() for finding in report.faults],
        "driving": [len(report.driving), [path for path, same in report.driving.items() if not same]],
        "learning": [len(report.learning), [path for path, same in report.learning.items() if not same]],
    }


def costs(config: Mapping[str, Any], spread: Spread) -> dict[str, Any]:
    """Physics alone with its features one by one."""
    del spread
    own = dict(config["validation"]["costs"])
    scenes = configs.load_config("benchmark", *own.pop("scenes"))["scenes"]
    worlds, everything = _worlds(scenes, own.pop("worlds"), config["validation"]["seed"]), own.pop("everything")
    rows = bound(own, timing, "costs", "validation.costs", seed=config["validation"]["seed"])(worlds)
    present = worlds.agents.present
    slots = {"slots": present.size, "worlds": len(present), "present": int(present.sum())}
    return {"backend": jax.default_backend(), "everything": everything, **slots, "rows": rows}


def _worlds(scenes: Mapping[str, Any], count: int, seed: int) -> Scene:
    return scene_source.assign_scenes(scene_source.load_training_scenes(scenes), count, seed=seed)[0]
