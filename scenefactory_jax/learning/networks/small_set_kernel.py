"""Triton kernels, through Pallas, of `late_fusion.encode_set` for sets of up to 32 rows: a block of rows holds several sets.

As `set_kernel`, whose programs compute one set each, and its gradient from the winners alone. Small sets have fewer rows than winners, so
here the gradient goes through all rows.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import pallas
from scenefactory_jax.learning.networks import set_kernel
from scenefactory_jax.learning.networks.set_kernel import CHANNELS, Weights, tiles

MAX_ROWS = 32  # of a set
ROWS = 64  # of a block; with 4 warps and 264 programs the fastest of nine forms on an H200 (experiments/row_encoders)
MAX_INPUTS = 32  # columns of a row on the chip: its features, a one for the bias, zeros
MAX_CHANNELS = 96  # sums of a gradient of more do not fit into the registers


def fits(weights: Weights, rows: int) -> bool:
    """Whether the kernels can compute sets of so many rows: two layers of 32, 64 or 96 channels, behind fewer than 32 features."""
    return 0 < rows <= MAX_ROWS and set_kernel.fits(weights, inputs=MAX_INPUTS, channels=MAX_CHANNELS)


def encode(
    activation: str,
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch K F"],
    mask: Bool[Array, "*batch K"],
    *,
    warps: int = 4,
    interpret: bool = False,
) -> tuple[Float[Array, "*batch G"], Int[Array, "*batch G"]]:
    """Computes the largest value of each channel over the rows of the mask, and the first row with it; zeros for an empty set.

    Args:
        dtype: of the products of the second layer.
        warps: of a program, see Triton.
        interpret: run on any device, slowly.
    """
    (first, first_bias), (second, second_bias) = weights
    *batch, width, features = x.shape
    out = second.shape[1]
    if not mask.size:
        return jnp.zeros((*batch, out), jnp.float32), jnp.zeros((*batch, out), jnp.int32)
    x, mask = x.reshape(-1, features), mask.reshape(-1).astype(jnp.int8)
    operands = (x, mask, set_kernel.with_bias(first, first_bias, count_inputs(features)), second.astype(dtype), second_bias)
    total, size, (activate, _) = len(mask) // width, reserve(width), set_kernel.activations(interpret)[activation]
    pooled, winner = pl.pallas_call(
        functools.partial(_encode, activate=activate, size=size, width=width, total=total),
        grid=(pl.cdiv(total * size, ROWS),),
        in_specs=[*map(pallas.whole, operands)],
        out_specs=[pl.BlockSpec((total, out), lambda i: (0, 0))] * 2,
        out_shape=[jax.ShapeDtypeStruct((total, out), jnp.float32), jax.ShapeDtypeStruct((total, out), jnp.int32)],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="encode_small_sets",
    )(*operands)
    return pooled.reshape(*batch, out), winner.reshape(*batch, out)


def _encode(x, mask, first, second, second_bias, pooled, winner, *, activate, size: int, width: int, total: int) -> None:
    at, row, there = _rows(pl.program_id(0), size=size, width=width, total=total)
    valid = there & (plgpu.load(mask.at[at * width + row], mask=there, other=0) != 0)
    table = _read(x, at * width + row, valid, first.shape[0])
    hidden, out, sets = tiles(first.shape[1], 64), tiles(second.shape[1], CHANNELS), ROWS // size
    inner = [activate(pallas.product(table, first[:, pl.ds(start, length)])).astype(second.dtype) for start, length in hidden]
    mine = pl.program_id(0) * sets + jnp.arange(sets)
    for start, length in out:
        parts = [pallas.product(part, second[pl.ds(k, w), pl.ds(start, length)]) for part, (k, w) in zip(inner, hidden, strict=True)]
        values = jnp.where(valid[:, None], functools.reduce(jnp.add, parts), -jnp.inf).reshape(sets, size, length)
        largest, place = jnp.max(values, axis=1), jnp.argmax(values, axis=1).astype(jnp.int32)
        shown, columns = largest > -jnp.inf, start + jnp.arange(length)
        here, known = (mine[:, None], columns[None, :]), jnp.broadcast_to((mine < total)[:, None], (sets, length))
        largest = jnp.where(shown, largest + second_bias[pl.ds(start, length)][None, :], 0.0)
        plgpu.store(pooled.at[here], largest, mask=known)
        plgpu.store(winner.at[here], jnp.where(shown, place, 0), mask=known)


def gradient(
    activation: str,
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch K F"],
    winner: Int[Array, "*batch G"],
    cotangent: Float[Array, "*batch G"],
    *,
    programs: int = 264,
    warps: int = 4,
    interpret: bool = False,
) -> Weights:
    """Computes the gradient of the weights through all rows.

    Args:
        cotangent: of the pooled channels; zero for an empty set. Sets behind the last one that is not zero are not read.
        programs: that share the sets; their sums are added up afterwards.
    """
    (first, first_bias), (second, _) = weights
    width, features = x.shape[-2:]
    hidden, out = second.shape
    if not x.size:
        return jax.tree.map(jnp.zeros_like, weights)
    cotangent, size, inputs = cotangent.reshape(-1, out), reserve(width), count_inputs(features)
    total, last = len(cotangent), pallas.block_of((cotangent != 0.0).any(axis=1)[None])
    programs = min(programs, pl.cdiv(total * size, ROWS))
    activate, slope = set_kernel.activations(interpret)[activation]
    operands = (last, x.reshape(-1, features), winner.reshape(-1, out), cotangent)
    operands += (set_kernel.with_bias(first, first_bias, inputs), second.T.astype(dtype))
    shapes = (programs, hidden, out), (programs, inputs, hidden)
    outer, inner = pl.pallas_call(
        functools.partial(_gradient, activate=activate, slope=slope, size=size, width=width, total=total),
        grid=(programs,),
        in_specs=[*map(pallas.whole, operands)],
        out_specs=[pl.BlockSpec((None, *shape[1:]), lambda i: (i, 0, 0)) for shape in shapes],
        out_shape=[jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="encode_small_sets_gradient",
    )(*operands)
    inner = jnp.sum(inner, axis=0)
    return [(inner[:features], inner[features]), (jnp.sum(outer, axis=0), jnp.sum(cotangent, axis=0))]


def _gradient(last, x, winner, cotangent, first, second, outer, inner, *, activate, slope, size: int, width: int, total: int) -> None:
    hidden, out = tiles(first.shape[1], CHANNELS), tiles(second.shape[0], CHANNELS)
    program, programs = pl.program_id(0), pl.num_programs(0)

    def add(index, sums):
        at, row, there = _rows(program + index * programs, size=size, width=width, total=total)
        table, pulls = _read(x, at * width + row, there, first.shape[0]), []
        for start, length in out:
            here, known = (at[:, None], start + jnp.arange(length)[None, :]), jnp.broadcast_to(there[:, None], (ROWS, length))
            won = plgpu.load(winner.at[here], mask=known, other=-1) == row[:, None]
            pulls.append(jnp.where(won, plgpu.load(cotangent.at[here], mask=known, other=0.0), 0.0).astype(second.dtype))
        results = []
        for (start, length), (wide, narrow) in zip(hidden, sums, strict=True):
            before = pallas.product(table, first[:, pl.ds(start, length)])
            after = activate(before)
            parts = [pallas.product(pull, second[pl.ds(k, w), pl.ds(start, length)]) for pull, (k, w) in zip(pulls, out, strict=True)]
            steep = functools.reduce(jnp.add, parts) * slope(before, after)
            after = after.astype(second.dtype)
            wide = [part + pallas.product(after, pull, along=0) for part, pull in zip(wide, pulls, strict=True)]
            results.append((wide, narrow + pallas.product(table, steep, along=0)))
        return results

    zeros = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
    begin = [([zeros(length, w) for _, w in out], zeros(first.shape[0], length)) for _, length in hidden]
    sums = jax.lax.fori_loop(0, pl.cdiv(pl.cdiv(last[0] * size, ROWS) - program, programs), add, begin)
    for (start, length), (wide, narrow) in zip(hidden, sums, strict=True):
        for (k, w), part in zip(out, wide, strict=True):
            outer[pl.ds(start, length), pl.ds(k, w)] = part
        inner[:, pl.ds(start, length)] = narrow


def reserve(width: int) -> int:
    """Rows that a set takes of a block: a power of two."""
    return 1 << (width - 1).bit_length()


def count_inputs(features: int) -> int:
    """Columns of a row on the chip, with a one for the bias: a power of two, of which the matrix units need 16."""
    return max(16, reserve(features + 1))


def _rows(index: Any, *, size: int, width: int, total: int) -> tuple[Array, Array, Array]:
    """Set and place in it of each row of a block, and whether there is such a row."""
    lanes = jnp.arange(ROWS)
    at, row = index * (ROWS // size) + lanes // size, lanes % size
    return at, row, (at < total) & (row < width)


def _read(x: Any, at: Array, valid: Array, inputs: int) -> Array:
    """Reads rows, with a one behind their features for the bias and zeros behind it; zeros in place of those that are not valid."""
    features, columns = x.shape[1], jnp.arange(inputs)
    ones = set_kernel.mark_bias(len(at), features, inputs)
    return plgpu.load(x.at[at[:, None], columns[None, :]], mask=valid[:, None] & (columns < features)[None, :], other=ones)
