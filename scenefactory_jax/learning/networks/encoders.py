"""Config entries of the encoders (`policy/encoder=lq`): functions that return one, for `heads`.

Structures and sizes are those of V-Max (arXiv:2503.08388) where it has the encoder. A difference: what is not valid never counts, neither
as a key of a query that has no other, nor in the mean of MTR.
"""

import functools
from typing import Literal

from scenefactory_jax.core.schema import Count
from scenefactory_jax.learning.networks import encoder_modules as modules
from scenefactory_jax.learning.networks.attention import Transformer
from scenefactory_jax.learning.networks.heads import Encoder
from scenefactory_jax.learning.networks.late_fusion import Architecture
from scenefactory_jax.learning.networks.observation_blocks import Reader

Dtype = Literal["float32", "bfloat16"]


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


def lq(*, transformer: Transformer, latents: Count, width: Count, rounds: Count, read: Reader, dtype: Dtype) -> Encoder:
    """Latent queries (Perceiver, arXiv:2103.03206): latents attend to all tokens, then to themselves, in rounds with the same weights.

    Args:
        transformer: see `Transformer`.
        latents: their number.
        width: of a latent, and of the feature.
        rounds: of attention to the tokens and to themselves.
    """
    return functools.partial(modules.LatentQuery, read, transformer, dtype, latents, width, rounds)


def lqh(*, transformer: Transformer, latents: Count, width: Count, read: Reader, dtype: Dtype) -> Encoder:
    """Hierarchical latent queries (arXiv:2210.09539): latents attend to one block after the other. Arguments as of `lq`."""
    return functools.partial(modules.HierarchicalLatentQuery, read, transformer, dtype, latents, width)


def mtr(*, transformer: Transformer, layers: Count, nearest: Count, keys: list[str], read: Reader, dtype: Dtype) -> Encoder:
    """Motion transformer (MTR, arXiv:2209.13508): every token attends to the road users that are nearest to it in feature space.

    Args:
        transformer: see `Transformer`.
        layers: of attention; the first is without a feed-forward part.
        nearest: road users that a token attends to.
        keys: names of the blocks of road users; the observation must have one of them.
    """
    return functools.partial(modules.MotionTransformer, read, transformer, dtype, layers, nearest, tuple(keys))


def wayformer(*, transformer: Transformer, latents: Count, width: Count, depth: Count, read: Reader, dtype: Dtype) -> Encoder:
    """Wayformer with late fusion (arXiv:2207.05844): latents of each block attend to its tokens, then to themselves.

    Args:
        depth: attentions of each block, of which the first is to its tokens; the others as of `lq`.
    """
    return functools.partial(modules.Wayformer, read, transformer, dtype, latents, width, depth)
