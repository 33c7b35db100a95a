"""GPU-batched driving simulation with real physics: scenes, MJX cars and PPO in one XLA graph.

    import jax, scenefactory_jax as sf

    config = sf.load_config("train", "experiment=demo")    # the same config as on the command line
    env = sf.make(config)                           # pure functions for one world: env.reset, env.step (one action)
    scenes = sf.load_scenes(config["scenes"])       # worlds stacked along the first axis
    state, observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), len(scenes)), scenes.scene)
    run = sf.train(config)                          # and sf.evaluate(sf.load_config("evaluate", f"run={run.folder}"))

Every function of `scenefactory_jax.cli` that is named like a command takes such a config.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenefactory_jax.cli.evaluate import evaluate
    from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
    from scenefactory_jax.cli.read import read
    from scenefactory_jax.cli.train import train
    from scenefactory_jax.cli.view import replay
    from scenefactory_jax.core.schema import ConfigError
    from scenefactory_jax.data.loading.scene_source import load_training_scenes as load_scenes
    from scenefactory_jax.env.environment import EnvParts, assemble
    from scenefactory_jax.env.environment import make_env as make
    from scenefactory_jax.learning.policy_io import load_policy
    from scenefactory_jax.visualization.birds_eye.video import draw_frame

__version__ = "0.1.0"
__all__ = ["ConfigError", "EnvParts", "__version__", "apply_overrides", "assemble", "draw_frame", "evaluate", "load_config"]
__all__ += ["load_policy", "load_scenes", "make", "read", "replay", "train"]

PLACES = {  # module of each public name, and its name there
    "ConfigError": ("core.schema", "ConfigError"),
    "EnvParts": ("env.environment", "EnvParts"),
    "apply_overrides": ("cli.hydra_config", "apply_overrides"),
    "assemble": ("env.environment", "assemble"),
    "draw_frame": ("visualization.birds_eye.video", "draw_frame"),
    "evaluate": ("cli.evaluate", "evaluate"),
    "load_config": ("cli.hydra_config", "load_config"),
    "load_policy": ("learning.policy_io", "load_policy"),
    "load_scenes": ("data.loading.scene_source", "load_training_scenes"),
    "make": ("env.environment", "make_env"),
    "read": ("cli.read", "read"),
    "replay": ("cli.view", "replay"),
    "train": ("cli.train", "train"),
}


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used: JAX, MuJoCo and Hydra take seconds, which worker processes and `--help` do not need."""
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = PLACES[name]
    globals()[name] = value = getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
    return value


def __dir__() -> list[str]:
    """For tab completion: the public names, also those that are not imported yet."""
    return sorted(__all__)
