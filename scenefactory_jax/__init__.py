"""GPU-batched driving simulation with real physics: scenes, MJX cars and PPO in one XLA graph.

    import jax, scenefactory_jax as sf

    config = sf.load("train", "experiment=demo")    # the same config as on the command line
    env = sf.make(config)                           # pure functions for one world: env.reset, env.step
    scenes = sf.load_scenes(config["scenes"])       # worlds stacked along the first axis
    state, observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), len(scenes)), scenes.scene)

Everything under `run/` (`train`, `evaluate`, `convert`, `render`) takes such a config too.
"""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional Warp backend is missing
    from mujoco import mjx as _mjx  # noqa: F401

from scenefactory_jax.build import ConfigError
from scenefactory_jax.run.config import load
from scenefactory_jax.run.sources import training as load_scenes
from scenefactory_jax.world import Parts, assemble, make

__version__ = "0.1.0"
__all__ = ["ConfigError", "Parts", "__version__", "assemble", "load", "load_scenes", "make"]
