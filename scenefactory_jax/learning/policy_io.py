"""Loads trained policies: from a folder that `train` or `export` wrote, or by the name of one that comes with the package."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from scenefactory_jax.core import config as configs
from scenefactory_jax.core.types import Policy, Scene
from scenefactory_jax.env import environment
from scenefactory_jax.learning import checkpoint, run_paths, trainer
from scenefactory_jax.learning.training_loop import make_policy


class TrainedPolicy(NamedTuple):
    """A policy with its parameters, and the config of its training."""

    folder: Path
    config: dict[str, Any]
    policy: Policy
    parameters: Any


def load_policy(run: str | Path, *, trust: bool = False) -> TrainedPolicy:
    """Loads a trained policy.

        trained = sf.load_policy("runs/demo-...")
        env = sf.make(trained.config)
        mean, log_std, value = trained.policy.apply(trained.parameters, observation)

    Args:
        run: a folder that `train` or `export` wrote, or the name of a policy that comes with the package; else a ConfigError.
        trust: whether its config may name functions outside of the package, which are then imported and called; else a ConfigError.
    """
    folder = run_paths.find(run)
    config = configs.read(folder, trust=trust)
    return TrainedPolicy(folder, config, make_policy(config), checkpoint.restore_parameters(folder / "checkpoints"))


def draw_untrained(config: Mapping[str, Any], scene: Scene) -> Any:
    """Samples the parameters of a run's policy before training, from its config and seed.

    Args:
        scene: one world, for the shapes of the observation.
    """
    key = jax.random.key(config["seed"])
    shapes, policy = jax.eval_shape(environment.make_env(config).reset, key, scene)[1], make_policy(config)

    @jax.jit  # by itself, each of its operations would be compiled
    def draw(key: PRNGKeyArray) -> Any:
        blank = jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape), leaf.dtype), shapes)
        return trainer.init_parameters(key, policy, blank)

    return draw(key)
