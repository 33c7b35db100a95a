"""AIRL (Fu et al. 2018) with a reward of states: D = exp f / (exp f + pi), f(s, s') = g(s) + gamma h(s') - h(s), and PPO on f - log pi.

g is the reward that is recovered, h a shaping of it, each a network with an encoder of its own; h is zero where an event ended the agent.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.types import Env, Observation, Policy
from scenefactory_jax.learning.adversarial import train_iteration
from scenefactory_jax.learning.adversarial.config import AdversarialConfig
from scenefactory_jax.learning.adversarial.discriminator import Discriminator, Pairs, get_encoder
from scenefactory_jax.learning.networks.heads import make_value
from scenefactory_jax.learning.trainer import Trainer


def make_discriminator(policy: Policy, config: AdversarialConfig, *, gamma: float) -> Discriminator:
    """Builds the discriminator: score f - log pi, which is also the reward, log D - log(1 - D).

    Raises:
        ConfigError: a policy without an encoder.
    """
    network = make_value(get_encoder(policy, learner="airl"), hidden=config.hidden, activation=config.activation)

    def init(key: PRNGKeyArray, observation: Observation) -> dict[str, Any]:
        return {name: network.init(key, observation) for name, key in zip(("reward", "shaping"), jax.random.split(key), strict=True)}

    def score(parameters: dict[str, Any], pairs: Pairs) -> Float[Array, "*batch"]:
        reward, here = (network.apply(parameters[name], pairs.observation) for name in ("reward", "shaping"))
        there = jnp.where(pairs.follows, network.apply(parameters["shaping"], pairs.next_observation), 0.0)
        return reward + gamma * there - here - pairs.log_probability

    return Discriminator(init, score, lambda score: score)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is AIRL; the numbers of PPO, gamma among them, are the group `ppo`."""
    build = lambda numbers, ppo: make_discriminator(policy, numbers, gamma=ppo.gamma)  # noqa: E731
    return train_iteration.make("airl", build, config, env, policy, mesh=mesh)
