"""GAIL (Ho and Ermon 2016) from observations (GAIfO, Torabi et al. 2018): a discriminator of pairs (s, s'), and PPO on -log(1 - D(s, s')).

A network d reads the features of both observations, by one encoder; the second one is zero where an event ended the agent, so that
endings are judged by where they happen.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.types import Env, Observation, Policy
from scenefactory_jax.learning.adversarial import train_iteration
from scenefactory_jax.learning.adversarial.config import AdversarialConfig
from scenefactory_jax.learning.adversarial.discriminator import Discriminator, Pairs, get_encoder
from scenefactory_jax.learning.networks.heads import Encoder, Head
from scenefactory_jax.learning.trainer import Trainer


class PairTower(nn.Module):
    """One encoder of both observations, and a head on their features."""

    encoder: Encoder
    head: Callable[..., nn.Module]

    @nn.compact
    def __call__(
        self, observation: Observation, next_observation: Observation, follows: Bool[Array, "*batch"]
    ) -> Float[Array, "*batch outputs"]:
        encoder = self.encoder(name="encoder")
        features = encoder(observation), jnp.where(follows[..., None], encoder(next_observation), 0.0)
        return self.head(name="head")(jnp.concatenate(features, axis=-1))


def make_discriminator(policy: Policy, config: AdversarialConfig) -> Discriminator:
    """Builds the discriminator: score d(s, s'), reward -log(1 - D) = softplus(d).

    Raises:
        ConfigError: a policy without an encoder.
    """
    encoder = get_encoder(policy, learner="gail")
    network = PairTower(encoder, functools.partial(Head, tuple(config.hidden), 1, config.activation, "float32"))

    def init(key: PRNGKeyArray, observation: Observation) -> Any:
        return network.init(key, observation, observation, jnp.ones(jax.tree.leaves(observation)[0].shape[:2], bool))

    def score(parameters: Any, pairs: Pairs) -> Float[Array, "*batch"]:
        raw: Any = network.apply(parameters, pairs.observation, pairs.next_observation, pairs.follows)
        return raw[..., 0]

    return Discriminator(init, score, reward=jax.nn.softplus)


def make(config: Mapping[str, Any], env: Env, policy: Policy, *, mesh: Mesh | None = None) -> Trainer:
    """Builds the trainer of a config whose `learner` is GAIL; the numbers of PPO are the group `ppo`."""
    return train_iteration.make("gail", lambda numbers, ppo: make_discriminator(policy, numbers), config, env, policy, mesh=mesh)
