"""Policies whose actions pass through tanh, for learners off policy: squashed Gaussians (SAC), deterministic ones (TD3), and critics.

`Policy.apply` gives the deterministic action, tanh(mean), as what is evaluated, and no deviation: `sample_action` draws under the tanh.
An action has 3 numbers, or the first 2 of them where the environment reads no more (`actions.numbers`); the third is then 0.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.learning import gaussian
from scenefactory_jax.learning.networks.heads import Encoder, Head, Network, invert_deviation, make_critic, make_network, split_gaussian

Actor = Literal["gaussian", "tanh_gaussian", "deterministic"]
"""gaussian: of PPO, not squashed."""

FULL = 3  # numbers of an action of the environment


class Networks(NamedTuple):
    """The parts of a policy that a learner needs; D: numbers of an action."""

    actor: Actor
    numbers: int
    distribution: Callable[[Any, Observation], tuple[Array, Array]]  # (parameters, observation) -> mean, std [..., D] before the tanh
    critic: Network  # (parameters, observation, action [..., D]) -> values [2, ...]
    encode: Callable[[Any, Any, Observation], Array]  # (parameters, critics, observation) -> features [3, ..., W] of all three, in one pass
    read: Callable[[Array], "Networks"]  # features -> networks that read these, whatever observation they are given


def make(
    encoder: Encoder,
    *,
    actor: Actor,
    numbers: int,
    hidden: Sequence[int],
    activation: str,
    dtype: str,
    activate_last: bool,
    mean_init: Sequence[float],
    log_std_init: float,
    actor_head_scale: float,
) -> Policy:
    """Builds the policy and two critics, each with an encoder of its own.

    Args:
        numbers: of an action, 2 or 3.
        hidden, activation, dtype, activate_last: of each head, see `heads.Head`.
        mean_init: first means before the tanh.
        log_std_init: logarithm of the first standard deviations before the tanh; read for the actor `tanh_gaussian` alone.
        actor_head_scale: gain of the orthogonal kernel of the actor's last layer.

    Raises:
        ConfigError: a first standard deviation that is not above the smallest one.
    """
    is_random = actor == "tanh_gaussian"
    bias = [*mean_init[:numbers]]
    if is_random:
        bias += [invert_deviation(log_std_init)] * numbers
    last = nn.initializers.orthogonal(actor_head_scale), lambda *_: jnp.array(bias, jnp.float32)
    network = make_network(encoder, functools.partial(Head, tuple(hidden), len(bias), activation, dtype, *last, activate_last))
    critic = make_critic(encoder, 2, hidden=hidden, activation=activation, dtype=dtype, activate_last=activate_last)

    def split(raw: Array) -> tuple[Array, Array]:
        return split_gaussian(raw) if is_random else (raw, jnp.zeros_like(raw))

    def distribution(parameters: Any, observation: Observation) -> tuple[Array, Array]:
        return split(network.apply(parameters, observation))

    def apply(parameters: Any, observation: Observation) -> tuple[Array, Array, Array]:
        action = pad_action(jnp.tanh(distribution(parameters, observation)[0]))
        return action, jnp.full(FULL, -jnp.inf), jnp.zeros_like(action[..., 0])

    def encode(parameters: Any, critics: Any, observation: Observation) -> Float[Array, "3 *batch W"]:
        own, others = (tree["params"].get("encoder", {}) for tree in (parameters, critics))
        trees = jax.tree.map(lambda one, two: jnp.concatenate([one[None], two]), own, others)
        return jax.vmap(lambda tree: encoder().apply({"params": tree}, observation), axis_size=3)(trees)  # pyright: ignore[reportReturnType]

    def read(features: Float[Array, "3 *batch W"]) -> Networks:
        of_critics = critic._replace(apply=lambda critics, _, action: critic.read(critics, features[1:], action))
        return networks._replace(distribution=lambda parameters, _: split(network.read(parameters, features[0])), critic=of_critics)

    networks = Networks(actor, numbers, distribution, critic, encode, read)
    return Policy(network.init, apply, networks)  # pyright: ignore[reportArgumentType]


def pad_action(action: Float[Array, "*batch D"]) -> Float[Array, "*batch 3"]:
    """Appends zeros as the numbers that the environment does not read."""
    return jnp.pad(action, [(0, 0)] * (action.ndim - 1) + [(0, FULL - action.shape[-1])])


def sample_action(policy: Policy, parameters: Any, observation: Observation, key: PRNGKeyArray) -> Float[Array, "*batch 3"]:
    """Samples actions of any policy: of a squashed Gaussian under its tanh, otherwise of the Gaussian that `apply` gives."""
    if policy.networks is None:
        mean, log_std, _ = policy.apply(parameters, observation)
        return gaussian.sample(key, mean, log_std)
    mean, std = policy.networks.distribution(parameters, observation)
    return pad_action(jnp.tanh(gaussian.sample(key, mean, jnp.log(std))))


def fix_unread(apply: Callable[..., Any], numbers: int) -> Callable[..., Any]:
    """Makes those numbers of a Gaussian policy that the environment does not read standard normal, whatever the parameters: they would add
    noise to the ratios of probabilities, and to the divergence, that PPO learns by.

    Args:
        apply: (parameters, observation) -> (mean, log_std, value).
        numbers: of an action that are read.
    """
    if numbers == FULL:
        return apply

    def apply_fixed(parameters: Any, observation: Observation) -> tuple[Array, Array, Array]:
        mean, log_std, value = apply(parameters, observation)
        return mean.at[..., numbers:].set(0.0), log_std.at[..., numbers:].set(0.0), value

    return apply_fixed


def get_networks(policy: Policy, actors: Sequence[Actor], *, learner: str) -> Networks:
    """Returns the networks of a policy that a learner can train.

    Raises:
        ConfigError: a policy without them, or with another kind of actor.
    """
    networks = policy.networks
    if networks is None:
        raise ConfigError(f"policy: learner {learner} needs one with critics; valid: policy=late_fusion, policy=actor_critic")
    if networks.actor not in actors:
        raise ConfigError(f"learner.actor: expected {' or '.join(actors)}, got {networks.actor}")
    return networks


def init_critics(policy: Policy, key: PRNGKeyArray, observation: Observation) -> Any:
    """Samples the critics' parameters; of the observation only shapes matter."""
    action = jnp.zeros((*jax.tree.leaves(observation)[0].shape[:2], policy.networks.numbers), jnp.float32)
    return policy.networks.critic.init(key, jax.tree.map(lambda leaf: leaf[:1], observation), action[:1])
