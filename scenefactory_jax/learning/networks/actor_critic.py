"""Policy on any encoder: heads of an actor and a critic, and of PPO a state-independent log standard deviation."""

from typing import Any, Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.core.types import Observation, Policy
from scenefactory_jax.learning.networks import squashed
from scenefactory_jax.learning.networks.heads import Encoder, Head, lecun_uniform, make_encoder


def make(
    *,
    encoder: dict[str, Any],
    hidden: list[Count],
    activation: Literal["elu", "relu", "tanh"],
    shared_encoder: bool,
    mean_init: list[float],
    log_std_init: float,
    actor_head_scale: float,
    dtype: Literal["float32", "bfloat16"],
    observation_groups: dict[str, Any],
    actor: squashed.Actor = "gaussian",
    numbers: int = squashed.FULL,
    values: Count = 1,
) -> Policy:
    """Builds the policy of PPO, or a squashed actor and critics.

    Args:
        encoder: entry of `encoders`.
        hidden: widths of the layers of each head, with activations between them.
        shared_encoder: actor and critic read one encoder, which both losses train; False: each has its own.
        mean_init, log_std_init, actor_head_scale: as of `late_fusion.make`.
        dtype: of products; the first layers of encoders, the last ones of heads, sums, parameters, means and values are float32.
        observation_groups: the config's `observations`.
        actor, numbers: of the learner, and of an action; supplied. A squashed actor and its critics share no encoder.
        values: of the critic, as the learner has them; supplied.

    Raises:
        ConfigError: a number that does not fit; at `init`, an observation that the encoder cannot read.
    """
    if len(mean_init) != 3:
        raise ConfigError(f"policy.mean_init: expected 3 numbers, throttle, steer and brake, got {mean_init}")
    bound = make_encoder(encoder, observations=observation_groups, dtype=dtype)
    first = {"mean_init": tuple(map(float, mean_init)), "log_std_init": float(log_std_init), "actor_head_scale": float(actor_head_scale)}
    if actor != "gaussian":
        if shared_encoder:
            raise ConfigError(f"policy.shared_encoder: expected false for the actor {actor}, whose critics share no encoder, got true")
        head = {"hidden": hidden, "activation": activation, "dtype": dtype, "activate_last": False}
        return squashed.make(bound, actor=actor, numbers=numbers, **head, **first)
    network = ActorCritic(bound, tuple(hidden), activation, shared_encoder, **first, dtype=dtype, values=values)
    return Policy(network.init, squashed.fix_unread(network.apply, numbers), encoder=bound)  # pyright: ignore[reportArgumentType]


class ActorCritic(nn.Module):
    """Heads and encoders: observation -> (mean, log_std, value)."""

    encoder: Encoder
    hidden: tuple[int, ...]
    activation: str
    shared_encoder: bool
    mean_init: tuple[float, ...]
    log_std_init: float
    actor_head_scale: float
    dtype: str
    values: int

    @nn.compact
    def __call__(self, observation: Observation) -> tuple[Float[Array, "*batch 3"], Float[Array, " 3"], Float[Array, "*batch_values"]]:
        actor = self.encoder(name="encoder" if self.shared_encoder else "actor_encoder")(observation)
        critic = actor if self.shared_encoder else self.encoder(name="critic_encoder")(observation)
        first = nn.initializers.orthogonal(self.actor_head_scale), lambda *_: jnp.array(self.mean_init, jnp.float32)
        mean = Head(self.hidden, len(self.mean_init), self.activation, self.dtype, *first, name="actor_head")(actor)
        value = Head(self.hidden, self.values, self.activation, self.dtype, lecun_uniform, name="critic_head")(critic)
        log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), (len(self.mean_init),), jnp.float32)
        return mean, log_std, value[..., 0] if self.values == 1 else value
