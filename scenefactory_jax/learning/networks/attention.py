"""Parts of encoders with attention: row embeddings, multi-head attention, feed-forward layers.

Parameters and the sums of ReZero are float32; tokens are stored and matrices multiply in `dtype`, except for the first layer of an
embedding: bfloat16 has 0.3 m for a place at 70 m.
"""

import dataclasses
import functools
import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import pallas
from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.learning.networks import attention_kernel
from scenefactory_jax.learning.networks.embedding_kernel import embed, embed_plain
from scenefactory_jax.learning.networks.heads import lecun_uniform
from scenefactory_jax.learning.networks.late_fusion import Affine, pool
from scenefactory_jax.learning.networks.observation_blocks import Blocks

Tokens = tuple[Array, Array]  # [B, T, D] and their mask [B, T]
ROAD_USERS = ("ego", "others")  # blocks whose time steps are the same
normal = nn.initializers.normal(0.01)  # flax's own default


@dataclasses.dataclass(frozen=True)
class Transformer:
    """Numbers of an encoder with attention."""

    embedding: tuple[Count, ...]  # widths of the layers that make a token of each row; the last one is the token's
    heads: Count
    head_features: Count
    feed_forward: Count  # hidden width of a feed-forward part, in widths of its input
    residual_init: float  # the learnt numbers of ReZero at first
    kernels: bool  # Triton kernels on an H100 or H200, where they fit

    def __post_init__(self) -> None:
        if not self.embedding:
            raise ConfigError("embedding: expected one width or more, got []")


def dense(width: int, dtype: Any, *, use_bias: bool = True, name: str | None = None) -> nn.Dense:
    """A dense layer with LeCun's uniform initialisation."""
    return nn.Dense(width, use_bias=use_bias, kernel_init=lecun_uniform, dtype=dtype, name=name)


class Embedding(nn.Module):
    """Dense layers with ReLU between them and none after the last, see `embedding_kernel`."""

    widths: tuple[int, ...]
    dtype: str
    kernels: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "*batch F"]) -> Float[Array, "*batch D"]:
        pairs = itertools.pairwise((x.shape[-1], *self.widths))
        weights = [Affine(*pair, lecun_uniform, name=f"layer_{index}")() for index, pair in enumerate(pairs)]
        return embed(self.dtype, weights, x) if self.kernels else embed_plain(self.dtype, weights, x)


class Tokenizer(nn.Module):
    """Embeds each row of each block, with an embedding for each block, and adds a learnt table over its rows and steps.

    `pool_steps`: a row's steps become one token, of their largest values. `time_scalars`: a learnt number for each time step is added.
    """

    widths: tuple[int, ...]  # of the embeddings
    dtype: str
    kernels: bool
    pool_steps: bool = False
    time_scalars: bool = False

    @nn.compact
    def __call__(self, blocks: Blocks) -> dict[str, Tokens]:
        scalars: dict[tuple[str, int], Array] = {}
        tokens = {}
        for name, (features, mask) in blocks.items():
            x = Embedding(self.widths, self.dtype, self.kernels, name=f"{name}_embedding")(features).astype(jnp.float32)
            if self.pool_steps:
                x, mask = pool(x, mask)[..., None, :], jnp.any(mask, axis=-1, keepdims=True)
            x = x + self.param(f"{name}_positions", normal, x.shape[-3:])
            if self.time_scalars and mask.shape[-1] > 1:
                clock = "road_users" if name in ROAD_USERS else name, mask.shape[-1]
                if clock not in scalars:
                    scalars[clock] = self.param(f"{clock[0]}_times_{clock[1]}", normal, clock[1:])
                x = x + scalars[clock][:, None]
            tokens[name] = x.astype(self.dtype).reshape(len(x), -1, x.shape[-1]), mask.reshape(len(x), -1)
        return tokens


def join_tokens(tokens: dict[str, Tokens]) -> Tokens:
    """Joins the tokens of all blocks."""
    rows, masks = zip(*tokens.values(), strict=True)
    return jnp.concatenate(rows, axis=1), jnp.concatenate(masks, axis=1)


class Attention(nn.Module):
    """Multi-head attention of queries [B, T, width] to keys and values that `project` computes.

    Returns what all heads found, zeros for a query without a valid key; `out` has the weights of the layer behind.
    """

    width: int
    numbers: Transformer
    dtype: str
    query_bias: bool = False

    def setup(self) -> None:
        inner = self.numbers.heads * self.numbers.head_features
        self.query = dense(inner, self.dtype, use_bias=self.query_bias)
        self.key = dense(inner, self.dtype, use_bias=False)
        self.value = dense(inner, self.dtype, use_bias=False)
        self.out = Affine(inner, self.width, lecun_uniform)

    def project(self, x: Float[Array, "B S D"]) -> tuple[Float[Array, "B S H E"], Float[Array, "B S H E"]]:
        """Computes keys and values of tokens."""
        return self._split(self.key(x)), self._split(self.value(x))

    def __call__(
        self, x: Float[Array, "B T D"], keys_values: tuple[Array, Array], mask: Bool[Array, "B #T S"] | None = None
    ) -> Float[Array, "B T C"]:
        keys, values = keys_values
        queries = self._split(self.query(x))
        mask = jnp.ones((*keys.shape[:1], 1, keys.shape[1]), bool) if mask is None else mask
        if self.numbers.kernels and mask.shape[1] == 1 and attention_kernel.fits(queries) and pallas.knows_gpus():
            found = attend(queries, keys, values, mask[:, 0])
        else:
            found = attend_plainly(queries, keys, values, mask)
        return found.reshape(*x.shape[:-1], -1)

    def _split(self, x: Float[Array, "B T C"]) -> Float[Array, "B T H E"]:
        return x.reshape(*x.shape[:-1], self.numbers.heads, self.numbers.head_features)


def attend_plainly(
    queries: Float[Array, "B T H E"], keys: Float[Array, "B S H E"], values: Float[Array, "B S H E"], mask: Bool[Array, "B #T S"]
) -> Float[Array, "B T H E"]:
    """Computes the attention in plain JAX, zeros for a query without a valid key."""
    found = jax.nn.dot_product_attention(queries, keys, values, mask=mask[:, None])
    return jnp.where(jnp.any(mask, axis=-1)[..., None, None], found, 0)


@jax.custom_vjp
def attend(
    queries: Float[Array, "B T H E"], keys: Float[Array, "B S H E"], values: Float[Array, "B S H E"], mask: Bool[Array, "B S"]
) -> Float[Array, "B T H E"]:
    """Computes the same, by a kernel on NVIDIA GPUs; all queries of a sample have one mask. Forward-mode differentiation is not defined."""
    return _attend_forward(queries, keys, values, mask)[0]


def _attend_forward(queries: Array, keys: Array, values: Array, mask: Array) -> tuple[Array, tuple]:
    def plain(queries: Array, keys: Array, values: Array, mask: Array) -> tuple[Array, Array]:
        batch, count, heads, _ = queries.shape
        return attend_plainly(queries, keys, values, mask[:, None]), jnp.zeros((batch, heads, count), jnp.float32)

    found, total = pallas.on_gpu(attention_kernel.attend, plain, queries, keys, values, mask)
    return found, (queries, keys, values, mask, found, total)


def _attend_backward(residuals: tuple, cotangent: Array) -> tuple[Array, Array, Array, None]:
    def plain(queries: Array, keys: Array, values: Array, mask: Array, found: Array, total: Array, cotangent: Array) -> tuple:
        return jax.vjp(functools.partial(attend_plainly, mask=mask[:, None]), queries, keys, values)[1](cotangent)

    return *pallas.on_gpu(attention_kernel.gradient, plain, *residuals, cotangent), None


attend.defvjp(_attend_forward, _attend_backward)


class FeedForward(nn.Module):
    """Weights of a feed-forward part, see `residual.add`: a dense layer, and a dense layer back."""

    width: int
    multiple: int  # of the width, which is the hidden one

    def setup(self) -> None:
        self.hidden = Affine(self.width, self.width * self.multiple, lecun_uniform)
        self.out = Affine(self.width * self.multiple, self.width, lecun_uniform)

    def __call__(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        return self.hidden(), self.out()


def select_nearest_keys(
    x: Float[Array, "B T D"], keys: Float[Array, "B S D"], mask: Bool[Array, "B S"], count: int
) -> Bool[Array, "B #T S"]:
    """Selects for each query the `count` valid keys that are nearest in feature space."""
    if keys.shape[1] <= count:
        return mask[:, None]
    square = jnp.sum(keys**2, axis=-1)[:, None] - 2.0 * jnp.einsum("btd,bsd->bts", x, keys)  # less the query's own square
    distance = jnp.where(mask[:, None], jax.lax.stop_gradient(square), jnp.inf)
    farthest = -jax.lax.top_k(-distance, count)[0][..., -1:]
    return (distance <= farthest) & mask[:, None]
