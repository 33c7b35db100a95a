"""Triton kernels, through Pallas, of the attention of a few queries to many keys, as of latents to the tokens of an observation.

Plain JAX writes the logits of every sample to memory and orders queries, keys and values by heads first: more memory traffic than the
numbers themselves. Here one program computes the attention of one sample, with its softmax on the chip; the gradient computes it anew.
"""

import functools

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core import pallas

KEYS, FEW = 64, 16  # of a block; where there are no more keys than `FEW`
QUERIES, FEATURES = (16, 32, 64), (16, 32, 64)  # that fit: sizes of the matrix units, and what the registers hold
NONE = -1e30  # logit of a key that does not count

Queries = Float[Array, "B T H E"]
Keys = Float[Array, "B S H E"]


def fits(queries: Queries) -> bool:
    """Whether the kernels can compute these queries: 16, 32 or 64 of a sample, with as many features of a head."""
    return queries.shape[1] in QUERIES and queries.shape[3] in FEATURES


def attend(
    queries: Queries, keys: Keys, values: Keys, mask: Bool[Array, "B S"], *, warps: int = 1, interpret: bool = False
) -> tuple[Queries, Float[Array, "B H T"]]:
    """Computes the attention, zeros without a valid key, and the logarithm of each softmax's denominator.

    Args:
        warps: of a program, see Triton.
        interpret: run on any device, slowly.
    """
    batch, count, heads, _ = queries.shape
    operands = (*(_join_heads(x) for x in (queries, keys, values)), mask.astype(jnp.int8))
    blank = jax.ShapeDtypeStruct(operands[0].shape, values.dtype), jax.ShapeDtypeStruct((batch, heads, count), jnp.float32)
    found, total = pl.pallas_call(
        functools.partial(_attend, heads=heads, keys=keys.shape[1]),
        grid=(batch,),
        in_specs=[*map(pallas.row, operands)],
        out_specs=[*map(pallas.row, blank)],
        out_shape=blank,
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="attend",
    )(*operands)
    return found.reshape(queries.shape), total


def _attend(query, key, value, mask, found, total, *, heads: int, keys: int) -> None:
    count, features = query.shape[0], query.shape[1] // heads
    block = KEYS if keys > FEW else FEW
    for head in range(heads):
        columns = pl.ds(head * features, features)
        queries = query[:, columns]

        def step(index, carry, queries=queries, head=head):
            largest, norm, sums = carry
            rows, valid = _find_rows(index, block, mask, keys)
            logits = _logits(queries, _load(key, rows, head, features, keys), valid)
            high = jnp.maximum(largest, jnp.max(logits, axis=1))
            part, shrunk = _exp(logits - high[:, None], valid), jnp.exp(largest - high)
            values = _load(value, rows, head, features, keys)
            sums = shrunk[:, None] * sums + _product(part.astype(values.dtype), values)
            return high, shrunk * norm + jnp.sum(part, axis=1), sums

        start = jnp.full(count, NONE), jnp.zeros(count), jnp.zeros((count, features))
        largest, norm, sums = jax.lax.fori_loop(0, pl.cdiv(keys, block), step, start)
        known = norm > 0.0
        found[:, columns] = jnp.where(known[:, None], sums / jnp.where(known, norm, 1.0)[:, None], 0.0).astype(found.dtype)
        total[head, :] = jnp.where(known, largest + jnp.log(jnp.where(known, norm, 1.0)), 0.0)


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
    operands = (*joined, mask.astype(jnp.int8), _join_heads(found), total, _join_heads(cotangent.astype(found.dtype)))
    results = pl.pallas_call(
        functools.partial(_gradient, heads=heads, keys=keys.shape[1]),
        grid=(len(queries),),
        in_specs=[*map(pallas.row, operands)],
        out_specs=[*map(pallas.row, joined)],
        out_shape=[jax.ShapeDtypeStruct(x.shape, x.dtype) for x in joined],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="attend_gradient",
    )(*operands)
    of_queries, of_keys, of_values = (x.reshape(like.shape) for x, like in zip(results, (queries, keys, values), strict=True))
    return of_queries, of_keys, of_values


def _gradient(query, key, value, mask, found, total, cotangent, of_query, of_key, of_value, *, heads: int, keys: int) -> None:
    count, features = query.shape[0], query.shape[1] // heads
    block = KEYS if keys > FEW else FEW
    for head in range(heads):
        columns = pl.ds(head * features, features)
        queries, pull, logs = query[:, columns], cotangent[:, columns], total[head, :]
        along = jnp.sum(pull.astype(jnp.float32) * found[:, columns].astype(jnp.float32), axis=1)

        def step(index, sums, queries=queries, pull=pull, logs=logs, along=along, head=head):
            rows, valid = _find_rows(index, block, mask, keys)
            keys_here, values = (_load(x, rows, head, features, keys) for x in (key, value))
            part = _exp(_logits(queries, keys_here, valid) - logs[:, None], valid)
            slope = part * (_product(pull, values, over=1) - along[:, None]) * features**-0.5
            slope = slope.astype(queries.dtype)
            place = rows[:, None], (head * features + jnp.arange(features))[None, :]
            inside = (rows < keys)[:, None]
            plgpu.store(of_value.at[place], _product(part.astype(pull.dtype), pull, along=0).astype(of_value.dtype), mask=inside)
            plgpu.store(of_key.at[place], _product(slope, queries, along=0).astype(of_key.dtype), mask=inside)
            return sums + _product(slope, keys_here)

        sums = jax.lax.fori_loop(0, pl.cdiv(keys, block), step, jnp.zeros((count, features)))
        of_query[:, columns] = sums.astype(of_query.dtype)


def _find_rows(index: Array, block: int, mask, keys: int) -> tuple[Array, Array]:
    """The keys of a block, and which of them count."""
    rows = index * block + jnp.arange(block)
    return rows, plgpu.load(mask.at[rows], mask=rows < keys, other=0) != 0


def _load(x, rows: Array, head: int, features: int, keys: int) -> Array:
    """Rows of one head, zeros behind the last one."""
    columns = head * features + jnp.arange(features)
    return plgpu.load(x.at[rows[:, None], columns[None, :]], mask=(rows < keys)[:, None], other=0.0)


def _logits(queries: Array, keys: Array, valid: Array) -> Array:
    return jnp.where(valid[None], _product(queries, keys, over=1) * queries.shape[1] ** -0.5, NONE)


def _exp(x: Array, valid: Array) -> Array:
    return jnp.where(valid[None], jnp.exp(x), 0.0)


def _product(a: Array, b: Array, *, along: int = 1, over: int = 0) -> Array:
    """Multiplies matrices on the matrix units, over an axis of each; sums are float32."""
    return jax.lax.dot_general(a, b, (((along,), (over,)), ((), ())), preferred_element_type=jnp.float32)


def _join_heads(x: Float[Array, "B N H E"]) -> Float[Array, "B N C"]:
    return x.reshape(*x.shape[:2], -1)
