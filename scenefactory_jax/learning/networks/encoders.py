"""Config entries of the encoders (`policy/encoder=lq`): functions that return one, for `heads`.

Structures and sizes are those of V-Max (arXiv:2503.08388) where it has the encoder. Two differences: what is not valid never counts, neither
as a key of a query that has no other, nor in the mean of MTR; and sums stay float32 when matrices multiply in bfloat16.
"""

import functools
from typing import Literal

from scenefactory_jax.core.schema import ConfigError, Count
from scenefactory_jax.learning.networks import encoder_modules as modules
from scenefactory_jax.learning.networks.attention import Widths
from scenefactory_jax.learning.networks.heads import Encoder
from scenefactory_jax.learning.networks.late_fusion import Architecture
from scenefactory_jax.learning.networks.observation_blocks import Reader

Dtype = Literal["float32", "bfloat16"]
Implementation = Literal["xla", "cudnn"]


def none() -> Encoder:
    """The observation as one vector; the head is all there is."""
    return modules.Flat


def mlp(*, embedding: list[Count], width: Count, read: Reader, dtype: Dtype) -> Encoder:
    """Dense layers for each block as one vector, joined by two layers.

    Args:
        embedding: widths of the layers of each block.
        width: of the two layers behind, and of the feature.
    """
    return functools.partial(modules.MultiLayer, read, tuple(embedding), width, dtype)


def late_fusion(
    *, vector: list[Count], rows: list[Count], activation: Literal["elu", "relu", "tanh"], kernels: bool, read: Reader, dtype: Dtype
) -> Encoder:
    """Encoders of all vectors and of each set, max-pooled, as in the policy `late_fusion`.

    Args:
        vector: widths of the encoder of all vectors.
        rows: widths of the row encoder of each set.
        kernels: Triton kernels for sets where there is an NVIDIA GPU.
    """
    architecture = Architecture(tuple(vector), (), tuple(rows), (), activation, dtype, kernels)
    return functools.partial(modules.LateFusion, read, architecture)


def lq(
    *,
    embedding: list[Count],
    heads: Count,
    head_features: Count,
    feed_forward: Count,
    attention: Implementation,
    latents: Count,
    width: Count,
    rounds: Count,
    read: Reader,
    dtype: Dtype,
) -> Encoder:
    """Latent queries (Perceiver, arXiv:2103.03206): latents attend to all tokens, then to themselves, in rounds with the same weights.

    Args:
        embedding: widths of the layers that make a token of each row; the last one is the token's.
        heads, head_features: of each attention.
        feed_forward: hidden width of a feed-forward part, in widths of its input.
        attention: xla, or cudnn (NVIDIA GPUs and bfloat16).
        latents: their number.
        width: of a latent, and of the feature.
        rounds: of attention to the tokens and to themselves.
    """
    widths = _check(embedding, heads, head_features, feed_forward, dtype, attention)
    return functools.partial(modules.LatentQuery, read, widths, latents, width, rounds)


def lqh(
    *,
    embedding: list[Count],
    heads: Count,
    head_features: Count,
    feed_forward: Count,
    attention: Implementation,
    latents: Count,
    width: Count,
    read: Reader,
    dtype: Dtype,
) -> Encoder:
    """Hierarchical latent queries (arXiv:2210.09539): latents attend to one block after the other. Arguments as of `lq`."""
    widths = _check(embedding, heads, head_features, feed_forward, dtype, attention)
    return functools.partial(modules.HierarchicalLatentQuery, read, widths, latents, width)


def mtr(
    *,
    embedding: list[Count],
    heads: Count,
    head_features: Count,
    feed_forward: Count,
    attention: Implementation,
    layers: Count,
    nearest: Count,
    keys: list[str],
    read: Reader,
    dtype: Dtype,
) -> Encoder:
    """Motion transformer (MTR, arXiv:2209.13508): every token attends to the road users that are nearest to it in feature space.

    Args:
        layers: of attention; the first is without a feed-forward part.
        nearest: road users that a token attends to.
        keys: names of the blocks of road users.
        (others): as of `lq`
    """
    widths = _check(embedding, heads, head_features, feed_forward, dtype, attention)
    return functools.partial(modules.MotionTransformer, read, widths, layers, nearest, tuple(keys))


def wayformer(
    *,
    embedding: list[Count],
    heads: Count,
    head_features: Count,
    feed_forward: Count,
    attention: Implementation,
    latents: Count,
    width: Count,
    depth: Count,
    read: Reader,
    dtype: Dtype,
) -> Encoder:
    """Wayformer with late fusion (arXiv:2207.05844): latents of each block attend to its tokens, then to themselves.

    Args:
        depth: attentions of each block, of which the first is to its tokens.
        (others): as of `lq`
    """
    widths = _check(embedding, heads, head_features, feed_forward, dtype, attention)
    return functools.partial(modules.Wayformer, read, widths, latents, width, depth)


def _check(embedding: list[int], heads: int, head_features: int, feed_forward: int, dtype: str, attention: str) -> Widths:
    """Joins the numbers of an encoder with attention."""
    if not embedding:
        raise ConfigError("policy.encoder.embedding: expected one width or more, got []")
    if attention == "cudnn" and dtype != "bfloat16":
        raise ConfigError(f"policy.encoder.attention: cudnn needs policy.dtype=bfloat16, got {dtype}")
    return Widths(tuple(embedding), heads, head_features, feed_forward, dtype, attention)
