"""Triton kernels, through Pallas, of the attention of a few queries to many keys, as of latents to the tokens of an observation.

Plain JAX writes the logits of every sample to memory and orders queries, keys and values by heads first: more memory traffic than the
numbers themselves. Here one program computes one head of one sample, with its softmax on the chip; the gradient computes it anew.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import pallas

KEYS, FEW = 32, 16  # of a block; where there are no more keys than `FEW`
QUERIES, FEATURES = (16, 32, 64), (16, 32, 64)  # that fit: sizes of the matrix units, and what the registers hold
NONE = -1e30  # logit of a key that does not count

Queries = Float[Array, "B T H E"]
Keys = Float[Array, "B S H E"]


def fits(queries: Queries) -> bool:
    """Whether the kernels can compute these queries: 16, 32 or 64 of a sample, with as many features of a head."""
    return len(queries) > 0 and queries.shape[1] in QUERIES and queries.shape[3] in FEATURES


def attend(
    queries: Queries, keys: Keys, values: Keys, mask: Bool[Array, "B S"], *, warps: int = 1, interpret: bool = False
) -> tuple[Queries, Float[Array, "B H T"]]:
    """Computes the attention, zeros without a valid key, and the logarithm of each softmax's denominator.

    Args:
        warps: of a program, see Triton.
        interpret: run on any device, slowly.
    """
    batch, count, heads, _ = queries.shape
    operands, total = [_join_heads(x) for x in (queries, keys, values)], jax.ShapeDtypeStruct((batch, heads, count), jnp.float32)
    found, total = pl.pallas_call(
        functools.partial(_attend, keys=keys.shape[1]),
        grid=(batch, heads),
        in_specs=[*(_head(x, heads) for x in operands), _row(mask)],
        out_specs=[_head(operands[0], heads), _log(total)],
        out_shape=[jax.ShapeDtypeStruct(operands[0].shape, values.dtype), total],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="attend",
    )(*operands, mask.astype(jnp.int8))
    return found.reshape(queries.shape), total


def _attend(query, key, value, mask, found, total, *, keys: int) -> None:
    block, queries = KEYS if keys > FEW else FEW, query[...]

    def step(index, carry):
        largest, norm, sums = carry
        rows, valid = _find_rows(index, block, mask, keys)
        logits = _logits(queries, _load(key, rows, keys), valid)
        high = jnp.maximum(largest, jnp.max(logits, axis=1))
        part, shrunk = _exp(logits - high[:, None], valid), jnp.exp(largest - high)
        sums = shrunk[:, None] * sums + pallas.product(part.astype(value.dtype), _load(value, rows, keys))
        return high, shrunk * norm + jnp.sum(part, axis=1), sums

    start = jnp.full(len(queries), NONE), jnp.zeros(len(queries)), jnp.zeros(queries.shape)
    largest, norm, sums = jax.lax.fori_loop(0, pl.cdiv(keys, block), step, start)
    known = norm > 0.0
    found[...] = jnp.where(known[:, None], sums / jnp.where(known, norm, 1.0)[:, None], 0.0).astype(found.dtype)
    total[...] = jnp.where(known, largest + jnp.log(jnp.where(known, norm, 1.0)), 0.0)


def gradient(
    queries: Queries,
    keys: Keys,
    values: Keys,
    mask: Bool[Array, "B S"],
    found: Queries,
    total: Float[Array, "B H T"],
    cotangent: Queries,
    *,
    warps: int = 1,
    interpret: bool = False,
) -> tuple[Queries, Keys, Keys]:
    """Computes the gradients of queries, keys and values from what `attend` returned and its cotangent."""
    heads = queries.shape[2]
    joined = [_join_heads(x) for x in (queries, keys, values)]
    operands = [*joined, _join_heads(found), _join_heads(cotangent.astype(found.dtype))]
    results = pl.pallas_call(
        functools.partial(_gradient, keys=keys.shape[1]),
        grid=(len(queries), heads),
        in_specs=[*(_head(x, heads) for x in operands), _log(total), _row(mask)],
        out_specs=[_head(x, heads) for x in joined],
        out_shape=[jax.ShapeDtypeStruct(x.shape, x.dtype) for x in joined],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="attend_gradient",
    )(*operands, total, mask.astype(jnp.int8))
    of_queries, of_keys, of_values = (x.reshape(like.shape) for x, like in zip(results, (queries, keys, values), strict=True))
    return of_queries, of_keys, of_values


def _gradient(query, key, value, found, cotangent, total, mask, of_query, of_key, of_value, *, keys: int) -> None:
    block, queries, pull, logs = KEYS if keys > FEW else FEW, query[...], cotangent[...], total[...]
    along = jnp.sum(pull.astype(jnp.float32) * found[...].astype(jnp.float32), axis=1)

    def step(index, sums):
        rows, valid = _find_rows(index, block, mask, keys)
        here = _load(key, rows, keys)
        part = _exp(_logits(queries, here, valid) - logs[:, None], valid)
        slope = part * (pallas.product(pull, _load(value, rows, keys), over=1) - along[:, None]) * queries.shape[1] ** -0.5
        slope = slope.astype(queries.dtype)
        _store(of_value, rows, keys, pallas.product(part.astype(pull.dtype), pull, along=0))
        _store(of_key, rows, keys, pallas.product(slope, queries, along=0))
        return sums + pallas.product(slope, here)

    of_query[...] = jax.lax.fori_loop(0, pl.cdiv(keys, block), step, jnp.zeros(queries.shape)).astype(of_query.dtype)


def _head(x: Any, heads: int) -> pl.BlockSpec:
    """The features of one head, of one sample."""
    return pl.BlockSpec((None, x.shape[1], x.shape[2] // heads), lambda sample, head: (sample, 0, head))


def _log(total: Any) -> pl.BlockSpec:
    """One number for each query of one head."""
    return pl.BlockSpec((None, None, total.shape[2]), lambda sample, head: (sample, head, 0))


def _row(mask: Any) -> pl.BlockSpec:
    """The mask of one sample."""
    return pl.BlockSpec((None, mask.shape[1]), lambda sample, head: (sample, 0))


def _find_rows(index: Array, block: int, mask, keys: int) -> tuple[Array, Array]:
    """The keys of a block, and which of them count."""
    rows = index * block + jnp.arange(block)
    return rows, plgpu.load(mask.at[rows], mask=rows < keys, other=0) != 0


def _place(x, rows: Array) -> Any:
    return x.at[rows[:, None], jnp.arange(x.shape[1])[None, :]]


def _load(x, rows: Array, keys: int) -> Array:
    """Rows of a head, zeros behind the last one."""
    return plgpu.load(_place(x, rows), mask=(rows < keys)[:, None], other=0.0)


def _store(x, rows: Array, keys: int, values: Array) -> None:
    plgpu.store(_place(x, rows), values.astype(x.dtype), mask=(rows < keys)[:, None])


def _logits(queries: Array, keys: Array, valid: Array) -> Array:
    return jnp.where(valid[None], pallas.product(queries, keys, over=1) * queries.shape[1] ** -0.5, NONE)


def _exp(x: Array, valid: Array) -> Array:
    return jnp.where(valid[None], jnp.exp(x), 0.0)


def _join_heads(x: Float[Array, "B N H E"]) -> Float[Array, "B N C"]:
    return x.reshape(*x.shape[:2], -1)
