"""Networks of actors and critics: an encoder of the observation, and a head of dense layers on its feature.

    actor = make_actor(encoder, 2 * actions, hidden=[256, 64, 32], activation="relu")
    mean, std = split_gaussian(actor.apply(actor.init(key, observation), observation))   # of a Gaussian before its tanh
    critic = make_critic(encoder, 2, hidden=[256, 64, 32], activation="relu")
    q = critic.apply(critic.init(key, observation, action), observation, action)         # [2, ...]

An encoder is a function that returns a new module, observation -> feature, each time that it is called (`networks.encoders`), so that no
two networks can share one by mistake.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.core.types import Observation
from scenefactory_jax.learning.networks.observation_blocks import make_reader

Encoder = Callable[..., nn.Module]
"""`encoder(name="encoder")` returns a new module, which turns an observation with any leading axes into a feature [..., W]."""

# Increasing, and zero at zero: only so may rows be pooled before the activation, and an empty set be zeros on both sides of it
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"elu": jax.nn.elu, "relu": jax.nn.relu, "tanh": jnp.tanh}
MIN_STD = 0.001
lecun_uniform = nn.initializers.lecun_uniform()


class Network(NamedTuple):
    """`init(key, *inputs) -> parameters` and `apply(parameters, *inputs)`; inputs are an observation and, of critics, an action.

    `read(parameters, feature, *others)` is what follows the encoder in `apply`.
    """

    init: Callable[..., Any]
    apply: Callable[..., Any]
    read: Callable[..., Any]


def make_encoder(entry: Mapping[str, Any], *, observations: Mapping[str, Any], dtype: str, where: str = "policy.encoder") -> Encoder:
    """Builds the encoder of a config entry (`conf/policy/encoder`).

    Args:
        observations: the config's `observations`, whose groups say how their vectors divide into blocks.
        dtype: of products, see `attention`.
        where: key of the entry, for messages.

    Raises:
        ConfigError: an unknown encoder, or a number that does not fit.
    """
    builtins = "scenefactory_jax.learning.networks.encoders"
    return instantiate(entry, builtins=builtins, where=where, read=make_reader(observations), dtype=dtype)()


def make_actor(
    encoder: Encoder, outputs: int, *, hidden: Sequence[Count], activation: str, dtype: str = "float32", activate_last: bool = False
) -> Network:
    """Builds `apply(parameters, observation) -> [..., outputs]`: parameters of a distribution, or of a deterministic action.

    Args:
        encoder: makes a new encoder, see `Encoder`.
        hidden, activation, activate_last: of the head, see `Head`.
        dtype: of the head's products.

    Raises:
        ConfigError: an unknown activation; at `init`, an observation that the encoder cannot read.
    """
    if activation not in ACTIVATIONS:
        raise ConfigError(f"policy.activation: expected one of {', '.join(ACTIVATIONS)}, got {activation!r}")
    return make_network(encoder, functools.partial(Head, tuple(hidden), outputs, activation, dtype, activate_last=activate_last))


def make_network(encoder: Encoder, head: Callable[..., nn.Module]) -> Network:
    """Joins an encoder and a head, both functions that return a new module."""
    tower = Tower(encoder, head)

    def read(parameters: Any, feature: Array, *extra: Array) -> Array:
        joined = jnp.concatenate([feature, *extra], axis=-1)
        return head().apply({"params": parameters["params"]["head"]}, joined)  # pyright: ignore[reportReturnType]

    return Network(tower.init, tower.apply, read)


def make_value(encoder: Encoder, *, hidden: Sequence[Count], activation: str, dtype: str = "float32") -> Network:
    """Builds `apply(parameters, observation) -> [...]`."""
    value = make_actor(encoder, 1, hidden=hidden, activation=activation, dtype=dtype)
    return Network(value.init, _take_number(value.apply), _take_number(value.read))


def make_critic(
    encoder: Encoder, count: int = 2, *, hidden: Sequence[Count], activation: str, dtype: str = "float32", activate_last: bool = False
) -> Network:
    """Builds `apply(parameters, observation, action) -> [count, ...]`: values of that many networks without shared weights; `read` takes
    features [count, ..., W].

    Each has an encoder and a head of its own; the head reads the feature joined with the action. Parameters have the axis `count` in front.
    """
    one = make_actor(encoder, 1, hidden=hidden, activation=activation, dtype=dtype, activate_last=activate_last)

    def init(key: PRNGKeyArray, observation: Observation, action: Float[Array, "*batch D"]) -> Any:
        return jax.vmap(lambda key: one.init(key, observation, action))(jax.random.split(key, count))

    apply, read = _take_number(one.apply), _take_number(one.read)
    return Network(init, jax.vmap(apply, in_axes=(0, None, None)), jax.vmap(read, in_axes=(0, 0, None)))


def _take_number(call: Callable[..., Array]) -> Callable[..., Array]:
    """Makes a function that returns the only output without its axis."""
    return lambda *inputs: call(*inputs)[..., 0]


def split_gaussian(raw: Float[Array, "*batch twice"]) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch D"]]:
    """Splits an actor's output into the mean and the standard deviation, softplus(raw) + MIN_STD, of a Gaussian."""
    mean, spread = jnp.split(raw, 2, axis=-1)
    return mean, jax.nn.softplus(spread) + MIN_STD


def invert_deviation(log_std: float) -> float:
    """Computes the output of which `split_gaussian` makes a standard deviation.

    Raises:
        ConfigError: one that is not above MIN_STD.
    """
    spread = math.exp(log_std) - MIN_STD
    if spread <= 0.0:
        raise ConfigError(f"policy.log_std_init: expected a number above the logarithm of {MIN_STD}, got {log_std}")
    return math.log(math.expm1(spread))


class Head(nn.Module):
    """Dense layers with activations between them, then a linear layer to the outputs; after the last of `hidden` there is an activation
    only with `activate_last`.

    Hidden layers multiply in `dtype`, the last one in float32.
    """

    hidden: tuple[int, ...]
    outputs: int
    activation: str
    dtype: str
    kernel_init: Callable = lecun_uniform  # of the last layer
    bias_init: Callable = nn.initializers.zeros
    activate_last: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*batch F"]) -> Float[Array, "*batch outputs"]:
        for index, width in enumerate(self.hidden):
            x = ACTIVATIONS[self.activation](x) if index else x
            x = nn.Dense(width, kernel_init=lecun_uniform, dtype=self.dtype, name=f"layer_{index}")(x)
        x = ACTIVATIONS[self.activation](x) if self.activate_last else x
        last = nn.Dense(self.outputs, kernel_init=self.kernel_init, bias_init=self.bias_init, dtype=jnp.float32, name="last")
        return last(x)


class Tower(nn.Module):
    """An encoder and a head; `extra` inputs are joined with the feature."""

    encoder: Encoder
    head: Callable[..., nn.Module]

    @nn.compact
    def __call__(self, observation: Observation, *extra: Float[Array, "*batch D"]) -> Float[Array, "*batch outputs"]:
        feature = self.encoder(name="encoder")(observation)
        return self.head(name="head")(jnp.concatenate([feature, *extra], axis=-1))
