"""GPU-batched driving simulation with real physics: scenes, MJX cars and PPO in one XLA graph.

    import jax, scenefactory_jax as sf

    config = sf.load_config("train", "experiment=demo")    # the same config as on the command line
    env = sf.make(config)                           # pure functions for one world: env.reset, env.step (one action)
    scenes = sf.load_scenes(config["scenes"])       # worlds stacked along the first axis
    state, observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), len(scenes)), scenes.scene)
    run = sf.train(config)                          # and sf.evaluate(sf.load_config("evaluate", f"run={run.folder}"))

Every function of `scenefactory_jax.cli` that is named like a command takes such a config.
"""

import contextlib
import importlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its optional Warp backend is missing
    from mujoco import mjx as _mjx  # noqa: F401

from scenefactory_jax.cli.hydra_config import apply_overrides, load_config
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.raw_scene import RawScene
from scenefactory_jax.data.loading import scene_source
from scenefactory_jax.data.loading.scene_source import load_training_scenes as load_scenes
from scenefactory_jax.env.environment import EnvParts, assemble
from scenefactory_jax.env.environment import make_env as make

if TYPE_CHECKING:
    from scenefactory_jax.cli.evaluate import evaluate
    from scenefactory_jax.cli.train import train
    from scenefactory_jax.cli.view import replay
    from scenefactory_jax.learning.policy_io import load_policy
    from scenefactory_jax.visualization.birds_eye.video import draw_frame

__version__ = "0.1.0"
__all__ = ["ConfigError", "EnvParts", "__version__", "apply_overrides", "assemble", "draw_frame", "evaluate", "load_config"]
__all__ += ["load_policy", "load_scenes", "make", "read", "replay", "train"]


def read(path: Path | str) -> Iterator[RawScene | str]:
    """Reads every scene of a bank, a file or a folder in float64, before checks and packing, in any of the known formats.

        for raw in scenefactory_jax.read("scenes.tfrecord"):
            print(raw if isinstance(raw, str) else raw.name)

    Returns:
        The scenes one after another; in place of a scene that cannot be read, the reason.

    Raises:
        SceneError: no such path.
    """
    return scene_source.read_scenes(load_config("scenes", "scenes=womd")["scenes"] | {"path": str(path)})


def __getattr__(name: str) -> Any:
    """What loads checkpoints and reports is imported when it is first used: that takes a second."""
    places = {
        "train": "cli.train",
        "evaluate": "cli.evaluate",
        "replay": "cli.view",
        "load_policy": "learning.policy_io",
        "draw_frame": "visualization.birds_eye.video",
    }
    if name not in places:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"scenefactory_jax.{places[name]}"), name)


def __dir__() -> list[str]:
    """For tab completion: the public names, also those that are not imported yet."""
    return sorted(__all__)
