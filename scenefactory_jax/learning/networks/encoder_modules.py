"""Modules of the encoders: observation -> feature. `encoders` has their config entries.

ReZero (arXiv:2003.04887) in place of normalisation: each attention and each feed-forward part adds its output times a learnt number, which
is `residual_init` at first (0 in the paper).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.schema import ConfigError
from scenefactory_jax.core.types import Observation
from scenefactory_jax.env.observations.flat_vector import flatten_observation
from scenefactory_jax.env.observations.vmax import Block
from scenefactory_jax.learning.networks import residual
from scenefactory_jax.learning.networks.attention import (
    Attention,
    Embedding,
    FeedForward,
    Tokenizer,
    Tokens,
    Transformer,
    dense,
    join_tokens,
    normal,
    select_nearest_keys,
)
from scenefactory_jax.learning.networks.late_fusion import Architecture, fuse
from scenefactory_jax.learning.networks.observation_blocks import Blocks, Reader, check_groups, join_steps


class Flat(nn.Module):
    """The observation as one vector, with its valid flags."""

    @nn.compact
    def __call__(self, observation: Observation) -> Float[Array, "*batch W"]:
        check_groups(observation)
        return flatten_observation(observation)


class BlockEncoder(nn.Module):
    """Base of the encoders of blocks: `encode` sees blocks with one leading axis, whatever the observation has."""

    read: Reader

    @nn.compact
    def __call__(self, observation: Observation) -> Float[Array, "*batch W"]:
        blocks = self.read(observation)
        leading = next(iter(blocks.values())).mask.shape[:-2]
        flat = {
            name: Block(features.reshape(-1, *features.shape[-3:]), mask.reshape(-1, *mask.shape[-2:]))
            for name, (features, mask) in blocks.items()
        }
        feature = self.encode(flat)
        return feature.reshape(*leading, feature.shape[-1])

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        """Computes the feature."""
        raise NotImplementedError


class MultiLayer(BlockEncoder):
    """Dense layers for each block as one vector, and two dense layers for all."""

    embedding: tuple[int, ...]
    width: int
    dtype: str

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        parts = []
        for name, (features, mask) in blocks.items():
            flat = jnp.where(mask[..., None], features, 0.0).reshape(len(mask), -1)
            parts.append(Embedding(self.embedding, self.dtype, name=f"{name}_embedding")(flat))
        hidden = jax.nn.relu(dense(self.width, self.dtype, name="hidden")(jnp.concatenate(parts, axis=-1)))
        return dense(self.width, self.dtype, name="out")(hidden).astype(jnp.float32)


class LateFusion(nn.Module):
    """The encoders of `late_fusion`."""

    read: Reader
    architecture: Architecture

    @nn.compact
    def __call__(self, observation: Observation) -> Float[Array, "*batch W"]:
        return fuse(self.architecture, join_steps(self.read(observation)))


class LatentEncoder(BlockEncoder):
    """Base of the encoders with attention."""

    numbers: Transformer
    dtype: str

    def add(
        self,
        name: str,
        x: Float[Array, "B T D"],
        parts: tuple[Attention, FeedForward | None],
        keys_values: tuple[Array, Array] | None = None,
        mask: Bool[Array, "B #T S"] | None = None,
    ) -> Float[Array, "B T D"]:
        """Adds what the attention and then the feed-forward part compute, times one learnt number (ReZero).

        Args:
            keys_values: that the attention is to; the queries' own by default.
        """
        attention, forward = parts
        scale = self.param(f"rezero_{name}", nn.initializers.constant(self.numbers.residual_init), ())
        found = attention(x, attention.project(x) if keys_values is None else keys_values, mask)
        if forward is None:
            return x + scale * residual.affine(self.dtype, attention.out(), found).astype(jnp.float32)
        return residual.add(self.dtype, self.numbers.kernels, x, found, scale, (attention.out(), *forward()))

    def tokenize(self, blocks: Blocks, *, pool_steps: bool = False, time_scalars: bool = False) -> dict[str, Tokens]:
        """Embeds the rows of all blocks, see `Tokenizer`."""
        numbers = self.numbers
        return Tokenizer(numbers.embedding, self.dtype, numbers.kernels, pool_steps, time_scalars, name="tokens")(blocks)

    def start(self, count: int, width: int, batch: int, name: str = "latents") -> Float[Array, "B count width"]:
        """The learnt latents, for each sample."""
        return jnp.broadcast_to(self.param(name, normal, (count, width)), (batch, count, width))

    def parts(self, name: str, width: int) -> tuple[Attention, FeedForward]:
        """An attention to latents or tokens of that width, and the feed-forward part behind it."""
        return self.attention(width, f"{name}_attention"), self.feed_forward(width, f"{name}_feed_forward")

    def attention(self, width: int, name: str, *, query_bias: bool = False) -> Attention:
        """An attention that changes what is that wide."""
        return Attention(width, self.numbers, self.dtype, query_bias, name=name)

    def feed_forward(self, width: int, name: str) -> FeedForward:
        """A feed-forward part of what is that wide."""
        return FeedForward(width, self.numbers.feed_forward, name=name)


class LatentQuery(LatentEncoder):
    """Latents that attend to all tokens and to themselves, in rounds with the same weights (Perceiver)."""

    latents: int
    width: int
    rounds: int

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        tokens, mask = join_tokens(self.tokenize(blocks))
        cross, own = self.parts("cross", self.width), self.parts("self", self.width)
        keys_values = cross[0].project(tokens)  # once for all rounds
        x = self.start(self.latents, self.width, len(mask))
        for index in range(self.rounds):
            x = self.add(f"cross_{index}", x, cross, keys_values, mask[:, None])
            x = self.add(f"self_{index}", x, own)
        return jnp.mean(x, axis=1)


class HierarchicalLatentQuery(LatentEncoder):
    """Latents that attend to one block after the other, in their order."""

    latents: int
    width: int

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        x = self.start(self.latents, self.width, len(next(iter(blocks.values())).mask))
        for name, (tokens, mask) in self.tokenize(blocks).items():
            parts = self.parts(name, self.width)
            x = self.add(name, x, parts, parts[0].project(tokens), mask[:, None])
        return jnp.mean(x, axis=1)


class MotionTransformer(LatentEncoder):
    """All tokens attend to the nearest of the road users' tokens, in feature space (MTR); the mean over valid tokens."""

    layers: int
    nearest: int
    keys: tuple[str, ...]  # blocks of road users

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        if not (chosen := [name for name in blocks if name in self.keys]):
            valid = ", ".join(blocks)
            raise ConfigError(f"policy.encoder.keys: the encoder mtr needs one of {', '.join(self.keys)}; the observation has {valid}")
        tokens = self.tokenize(blocks, pool_steps=True)
        joined, mask = join_tokens(tokens)
        x = joined.astype(jnp.float32)
        keys, valid = join_tokens({name: tokens[name] for name in chosen})
        for index in range(self.layers):
            attention = self.attention(x.shape[-1], f"attention_{index}", query_bias=True)
            near = select_nearest_keys(x, keys, valid, self.nearest)
            forward = self.feed_forward(x.shape[-1], f"feed_forward_{index}") if index else None
            x = self.add(str(index), x, (attention, forward), attention.project(keys), near)
        return jnp.sum(jnp.where(mask[..., None], x, 0.0), axis=1) / jnp.maximum(jnp.sum(mask, axis=1, keepdims=True), 1)


class Wayformer(LatentEncoder):
    """Late fusion: latents of each block attend to its tokens, then to themselves; the mean over the latents of all blocks."""

    latents: int
    width: int
    depth: int

    def encode(self, blocks: Blocks) -> Float[Array, "B W"]:
        features = []
        for name, (tokens, mask) in self.tokenize(blocks, time_scalars=True).items():
            x = self.start(self.latents, self.width, len(mask), f"{name}_latents")
            parts = self.parts(f"{name}_0", self.width)
            x = self.add(f"{name}_0", x, parts, parts[0].project(tokens), mask[:, None])
            for index in range(1, self.depth):
                x = self.add(f"{name}_{index}", x, self.parts(f"{name}_{index}", self.width))
            features.append(x)
        return jnp.mean(jnp.concatenate(features, axis=1), axis=1)
