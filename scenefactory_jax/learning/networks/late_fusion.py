"""Late-fusion policy: an encoder for each observation group, whose outputs are joined and go through a trunk (paper, section 4).

Actor and critic are two towers without shared weights. Vector groups are concatenated in the order of their names and share one encoder;
each set of rows has its own row encoder and is max-pooled over the rows of its mask. A group that a config adds is encoded by its kind: a
vector joins the vector encoder, a set gets an encoder of `rows_default` widths.

Rows are pooled before the last activation, which gives the same since activations increase. A pooled channel depends on one row, its
winner, so that the gradient recomputes the winners and stores no activation of other rows: exact, in less time and memory. Sets with at
most half as many rows as winners recompute all rows. On NVIDIA GPUs encoders of two layers run as one kernel where it fits
(`small_set_kernel`, `set_kernel`), which is tested against the plain JAX here.

Differences from the published code, which follow the paper instead: no LayerNorm, no extra 64 to 64 layer before the heads.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from scenefactory_jax.core.pallas import on_gpu
from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.core.types import Observation, Policy, SetObservation
from scenefactory_jax.learning.networks import set_kernel, small_set_kernel, squashed
from scenefactory_jax.learning.networks.heads import ACTIVATIONS, invert_deviation, split_gaussian
from scenefactory_jax.learning.networks.observation_blocks import check_groups

FEW = 4  # rows: `set_kernel` computes blocks of 32, of which more would be empty


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Widths of all layers, and how they compute; see `make`."""

    vector: tuple[int, ...]
    rows: tuple[tuple[str, tuple[int, ...]], ...]  # set, widths
    rows_default: tuple[int, ...]
    trunk: tuple[int, ...]
    activation: str
    dtype: str
    kernels: bool


def make(
    *,
    vector: list[Count],
    rows: dict[str, list[Count] | None],
    rows_default: list[Count],
    trunk: list[Count],
    activation: Literal["elu", "relu", "tanh"],
    mean_init: list[float],
    log_std_init: float,
    actor_head_scale: float,
    dtype: Literal["float32", "bfloat16"],
    kernels: bool,
    state_dependent_std: bool = False,
    actor: squashed.Actor = "gaussian",
    numbers: int = squashed.FULL,
    values: Count = 1,
) -> Policy:
    """Builds two late-fusion towers and a log standard deviation, or a squashed actor and critics.

    Args:
        vector: widths of the encoder of all vector groups.
        rows: widths of the row encoder of each named set; None: as if it were not named, for observations without that group.
        rows_default: widths for sets that `rows` does not name.
        trunk: widths of the layers between fusion and head.
        mean_init: first bias of the actor's last layer: throttle, steer, brake. With a brake around zero, stronger than the drive, cars
            stay at rest whatever the noise; a negative one lets untrained cars roll.
        log_std_init: logarithm of the first standard deviation of every action.
        actor_head_scale: gain of the orthogonal kernel of the actor's last layer; small, so that the first actions are near `mean_init`
            (Andrychowicz et al. 2021, "What matters in on-policy reinforcement learning?"). The published code has PyTorch's default.
        dtype: of products behind the first layer of an encoder; features, sums, parameters, means and values stay float32.
        kernels: Triton kernels for sets where there is an NVIDIA GPU; False: plain JAX.
        state_dependent_std: the actor computes deviations, too, as in Brax; False, as published: they are the same in every state.
        actor, numbers: of the learner, and of an action; supplied. A squashed actor: `squashed.make` on the encoders, with the trunk as
            head, whose means and deviations before the tanh begin as above.
        values: of the critic, as the learner has them; supplied.

    Raises:
        ConfigError: at `init`, an observation without groups or with one for planners, or widths for a set that it does not have.
    """
    named = {name: tuple(sizes) for name, sizes in sorted(rows.items()) if sizes is not None}
    each = {"vector": vector, "rows_default": rows_default, "trunk": trunk} | {f"rows.{name}": sizes for name, sizes in named.items()}
    for name, sizes in each.items():
        if not sizes:
            raise ConfigError(f"policy.{name}: expected one width or more, got []")
    if len(mean_init) != 3:
        raise ConfigError(f"policy.mean_init: expected 3 numbers, throttle, steer and brake, got {mean_init}")
    architecture = Architecture(tuple(vector), tuple(named.items()), tuple(rows_default), tuple(trunk), activation, dtype, kernels)
    first = {"mean_init": tuple(map(float, mean_init)), "log_std_init": float(log_std_init), "actor_head_scale": float(actor_head_scale)}
    encoder = functools.partial(Fusion, architecture)
    if actor == "gaussian":
        network = ActorCritic(architecture, **first, values=values, state_dependent_std=state_dependent_std)
        policy = Policy(network.init, squashed.fix_unread(network.apply, numbers), encoder=encoder)  # pyright: ignore[reportArgumentType]
    else:
        head = {"hidden": trunk, "activation": activation, "dtype": dtype, "activate_last": True}
        policy = squashed.make(encoder, actor=actor, numbers=numbers, **head, **first)

    def init(key: PRNGKeyArray, observation: Observation) -> Any:
        check_groups(observation)
        groups = sorted(name for name, group in observation.items() if isinstance(group, SetObservation))
        if unknown := sorted(set(named) - set(groups)):
            raise ConfigError(f"policy.rows.{unknown[0]}: the observation has no such set; valid: {', '.join(groups) or 'none'}")
        return policy.init(key, observation)

    return policy._replace(init=init)


class ActorCritic(nn.Module):
    """Both towers and the log standard deviation: observation -> (mean, log_std, value)."""

    architecture: Architecture
    mean_init: tuple[float, ...]
    log_std_init: float
    actor_head_scale: float
    values: int
    state_dependent_std: bool

    @nn.compact
    def __call__(self, observation: Observation) -> tuple[Float[Array, "*batch 3"], Float[Array, "*std 3"], Float[Array, "*batch_values"]]:
        count, first = len(self.mean_init), self.mean_init
        if self.state_dependent_std:
            first += (invert_deviation(self.log_std_init),) * count
        mean = Tower(self.architecture, head_bias=first, head_scale=self.actor_head_scale, name="actor")(observation)
        value = Tower(self.architecture, head_bias=(0.0,) * self.values, head_scale=1.0, name="critic")(observation)
        if self.state_dependent_std:
            mean, std = split_gaussian(mean)
            log_std = jnp.log(std)
        else:
            log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), (count,), jnp.float32)
        return mean, log_std, value[..., 0] if self.values == 1 else value


class Tower(nn.Module):
    """Encoders, fusion, trunk and a linear head."""

    architecture: Architecture
    head_bias: tuple[float, ...]
    head_scale: float

    @nn.compact
    def __call__(self, observation: Observation) -> Float[Array, "*batch outputs"]:
        architecture = self.architecture
        activate, fused = ACTIVATIONS[architecture.activation], fuse(architecture, observation)
        x = activate(Layers(architecture, architecture.trunk, name="trunk")(fused.astype(architecture.dtype)))
        kernel, bias = nn.initializers.orthogonal(self.head_scale), lambda *_: jnp.array(self.head_bias, jnp.float32)
        return nn.Dense(len(self.head_bias), kernel_init=kernel, bias_init=bias, dtype=jnp.float32, name="head")(x)


class Fusion(nn.Module):
    """Encoders and fusion."""

    architecture: Architecture

    @nn.compact
    def __call__(self, observation: Observation) -> Float[Array, "*batch W"]:
        return fuse(self.architecture, observation)


def fuse(architecture: Architecture, observation: Observation) -> Float[Array, "*batch W"]:
    """Encodes all groups inside a compact module, and joins them: vectors first, then the sets in the order of their names."""
    rows, activate = dict(architecture.rows), ACTIVATIONS[architecture.activation]
    vectors = [group for _, group in sorted(observation.items()) if not isinstance(group, SetObservation)]
    fused = [activate(Layers(architecture, architecture.vector, name="vector")(jnp.concatenate(vectors, axis=-1)))] if vectors else []
    for name, group in sorted(observation.items()):
        if isinstance(group, SetObservation):
            layers = Layers(architecture, rows.get(name, architecture.rows_default), name=f"{name}_rows")
            fused.append(activate(layers(group.features, group.mask)))
    return jnp.concatenate(fused, axis=-1)


class Layers(nn.Module):
    """Dense layers with activations between them and none after the last; with a mask, max-pooled over the rows."""

    architecture: Architecture
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Float[Array, "..."], mask: Bool[Array, "..."] | None = None) -> Float[Array, "..."]:
        widths, kind = (x.shape[-1], *self.widths), self.architecture
        weights = [Affine(*pair, name=f"layer_{index}")() for index, pair in enumerate(itertools.pairwise(widths))]
        if mask is None:
            return affine(kind.activation, kind.dtype, weights, x)
        return encode_set(kind.activation, kind.dtype, kind.kernels, weights, x, mask)


class Affine(nn.Module):
    """Kernel and bias of one dense layer, initialised as `flax.linen.Dense` does by default."""

    inputs: int
    outputs: int
    kernel_init: Callable = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]]:
        kernel = self.param("kernel", self.kernel_init, (self.inputs, self.outputs), jnp.float32)
        return kernel, self.param("bias", nn.initializers.zeros, (self.outputs,), jnp.float32)


def affine(activation: str, dtype: str, weights: list, x: Float[Array, "*batch F"]) -> Float[Array, "*batch G"]:
    """Applies dense layers with activations between them; layers after the first multiply in `dtype`."""
    for index, (kernel, bias) in enumerate(weights):
        x = ACTIVATIONS[activation](x).astype(dtype) if index else x
        x = jnp.matmul(x, kernel.astype(x.dtype), preferred_element_type=jnp.float32) + bias
    return x


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def encode_set(
    activation: str, dtype: str, kernels: bool, weights: list, x: Float[Array, "*batch K F"], mask: Bool[Array, "*batch K"]
) -> Float[Array, "*batch G"]:
    """Applies `affine` to rows and computes each channel's maximum over the rows of the mask; zeros for an empty set.

    Of equal rows the first gets the gradient. Forward-mode differentiation is not defined.
    """
    return _winners(activation, dtype, kernels, weights, x, mask)[0]


def pool(x: Float[Array, "*batch K F"], mask: Bool[Array, "*batch K"]) -> Float[Array, "*batch F"]:
    """Computes each channel's maximum over the rows of the mask; zeros for an empty set."""
    largest = jnp.max(jnp.where(mask[..., None], x, -jnp.inf), axis=-2, initial=-jnp.inf)
    return jnp.where(jnp.any(mask, axis=-1)[..., None], largest, 0.0)


def find_winners(x: Float[Array, "*batch K F"], mask: Bool[Array, "*batch K"]) -> tuple[Float[Array, "*batch F"], Int[Array, "*batch F"]]:
    """Computes each channel's maximum over the rows of the mask, and the first row with it, in one pass; zeros for an empty set."""

    def larger(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
        first = (one[0] > other[0]) | jnp.isnan(one[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
        return jnp.where(first, one[0], other[0]), jnp.where(first, one[1], other[1])

    row = jax.lax.broadcasted_iota(jnp.int32, x.shape, x.ndim - 2)
    columns, nothing = (jnp.where(mask[..., None], x, -jnp.inf), row), (jnp.float32(-jnp.inf), jnp.int32(x.shape[-2]))
    value, winner = jax.lax.reduce(columns, nothing, larger, (x.ndim - 2,))
    shown = jnp.any(mask, axis=-1)[..., None]
    return jnp.where(shown, value, 0.0), jnp.where(shown, winner, 0)


def _winners(activation: str, dtype: str, kernels: bool, weights: list, x: Array, mask: Array) -> tuple[Array, Array]:
    """Computes the pooled channels and the row that each is from."""

    def plain(weights: list, x: Array, mask: Array) -> tuple[Array, Array]:
        return find_winners(affine(activation, dtype, weights, x), mask)

    kernel = _find_kernel(weights, mask) if kernels else None
    if kernel is None:
        return plain(weights, x, mask)
    return on_gpu(functools.partial(kernel.encode, activation, dtype), plain, weights, x, mask)


def _find_kernel(weights: list, mask: Bool[Array, "*batch K"]) -> Any:
    """Returns the module whose kernels can compute these sets; None: neither can."""
    rows = mask.shape[-1]
    if small_set_kernel.fits(weights, rows):
        return small_set_kernel
    return set_kernel if rows > FEW and set_kernel.fits(weights) else None


def _encode_forward(activation: str, dtype: str, kernels: bool, weights: list, x: Array, mask: Array) -> tuple[Array, tuple]:
    pooled, winner = _winners(activation, dtype, kernels, weights, x, mask)
    return pooled, (weights, x, winner, mask)


def _encode_backward(activation: str, dtype: str, kernels: bool, residuals: tuple, cotangent: Array) -> tuple[list, Array, None]:
    weights, x, winner, mask = residuals
    cotangent = jnp.where(jnp.any(mask, axis=-1)[..., None], cotangent, 0.0)
    few = 2 * mask.shape[-1] <= weights[-1][0].shape[1]  # rows need no gather
    plain = functools.partial(_through_rows if few else _through_winners, activation, dtype)
    kernel, operands = _find_kernel(weights, mask) if kernels else None, (weights, x, winner, cotangent)
    if kernel is None:
        return *plain(*operands), None
    of_weights = on_gpu(functools.partial(kernel.gradient, activation, dtype), lambda *operands: plain(*operands)[0], *operands)
    return of_weights, plain(*operands)[1], None  # the compiler removes the gradient of the rows where it is not used


encode_set.defvjp(_encode_forward, _encode_backward)


def _through_rows(activation: str, dtype: str, weights: list, x: Array, winner: Array, cotangent: Array) -> tuple[list, Array]:
    """Computes the gradient of weights and rows with all rows anew."""
    won = winner[..., None, :] == jnp.arange(x.shape[-2])[:, None]
    return _affine_backward(activation, dtype, weights, x, jnp.where(won, cotangent[..., None, :], 0.0))


def _through_winners(activation: str, dtype: str, weights: list, x: Array, winner: Array, cotangent: Array) -> tuple[list, Array]:
    """Computes the gradient of weights and rows with the winner of each channel anew."""

    def at_winners(weights: list, x: Array) -> Array:
        rows = jnp.take_along_axis(x, winner[..., None], axis=-2)  # [..., G, F]: the winner of each channel
        kernel, bias = weights[-1]
        if len(weights) > 1:
            rows = ACTIVATIONS[activation](affine(activation, dtype, weights[:-1], rows)).astype(dtype)
        return jnp.einsum("...gh,hg->...g", rows, kernel.astype(rows.dtype), preferred_element_type=jnp.float32) + bias

    return jax.vjp(at_winners, weights, x)[1](cotangent)


def _affine_backward(
    activation: str, dtype: str, weights: list, x: Float[Array, "*batch F"], cotangent: Float[Array, "*batch G"]
) -> tuple[list, Float[Array, "*batch F"]]:
    """Computes the gradient of `affine`, with hidden values anew, and with products in `dtype`, where JAX's own has float32."""
    inputs, activations = [x], []
    for layer in weights[:-1]:
        hidden, back = jax.vjp(ACTIVATIONS[activation], affine(activation, dtype, [layer], inputs[-1]))
        inputs.append(hidden.astype(dtype))
        activations.append(back)
    gradients, product = [], functools.partial(jnp.einsum, preferred_element_type=jnp.float32)
    for (kernel, _), rows, back in zip(weights[::-1], inputs[::-1], [*activations[::-1], None], strict=True):
        pull = cotangent.astype(rows.dtype)
        gradients.append((product("...f,...g->fg", rows, pull), jnp.sum(cotangent, axis=range(cotangent.ndim - 1))))
        cotangent = product("...g,fg->...f", pull, kernel.astype(rows.dtype))
        cotangent = cotangent if back is None else back(cotangent)[0]
    return gradients[::-1], cotangent
