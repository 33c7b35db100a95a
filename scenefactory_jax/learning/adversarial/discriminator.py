"""What a discriminator is, and its loss: binary cross-entropy between the expert's pairs of observations and the policy's.

D = sigmoid(score) is the probability that a pair is the expert's; J = -mean log D (expert's pairs) - mean log(1 - D) (policy's pairs).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.learning.means import partial_mean
from scenefactory_jax.learning.networks.heads import Encoder


@pytree_dataclass
class Pairs:
    """What was observed before and after actions."""

    observation: Observation
    next_observation: Observation  # anything, where nothing follows
    follows: Bool[Array, "*batch"]  # no event ended the agent
    log_probability: Float[Array, "*batch"]  # of the action, clipped, under the policy that acts in this iteration
    weight: Float[Array, "*batch"]


class Discriminator(NamedTuple):
    """An algorithm as functions."""

    init: Callable[[PRNGKeyArray, Observation], Any]  # -> parameters; of the observation only shapes matter
    score: Callable[[Any, Pairs], Float[Array, "*batch"]]  # (parameters, pairs) -> log D - log(1 - D)
    reward: Callable[[Float[Array, "*batch"]], Float[Array, "*batch"]]  # of a score


def compute_loss(
    parameters: Any, expert: Pairs, policy: Pairs, *, discriminator: Discriminator, totals: tuple[Array, Array]
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Computes the cross-entropy, and metrics; on several devices, each device's summand of them.

    Args:
        totals: weights of the expert's pairs and of the policy's on all devices.
    """
    real, made = discriminator.score(parameters, expert), discriminator.score(parameters, policy)
    of_expert = lambda x: partial_mean(x, weight=expert.weight, total=totals[0])  # noqa: E731
    of_policy = lambda x: partial_mean(x, weight=policy.weight, total=totals[1])  # noqa: E731
    loss = of_expert(jax.nn.softplus(-real)) + of_policy(jax.nn.softplus(made))
    metrics = {"loss": loss, "expert_accuracy": of_expert((real > 0.0) * 1.0), "policy_accuracy": of_policy((made < 0.0) * 1.0)}
    return loss, jax.lax.stop_gradient(metrics)


def get_encoder(policy: Policy, *, learner: str) -> Encoder:
    """Returns the encoder of a policy, of which each network makes its own.

    Raises:
        ConfigError: a policy without one.
    """
    if policy.encoder is None:
        raise ConfigError(f"policy: learner {learner} needs one with an encoder; valid: policy=late_fusion, policy=actor_critic")
    return policy.encoder
