"""Triton kernels, through Pallas, of `late_fusion.encode_set` for two layers: values between rows and pooled set stay on the chip.

Plain JAX writes the hidden and output values of every row to memory and reads them back: 270 kB for a set of 350 rows, of 7 kB. Here one
program loops over the rows of one set and keeps the largest value of every channel, with its row; it stops behind the last valid row. The
gradient loops over the winners alone.

Arithmetic is that of plain JAX on the same GPU: products of float32 numbers in TF32, of bfloat16 numbers as they are, sums in float32.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import pallas

Weights = list[tuple[Float[Array, "_ _"], Float[Array, " _"]]]

INPUTS = 16  # columns of a row on the chip: its features, a one for the bias, zeros; the minimum of the matrix units
CHANNELS = 32  # of an output tile; one width for all of them keeps one layout, so that hidden values are computed once
ROWS, FEW = 64, 32  # of a block; in sets with no more rows than `FEW`
MAX_CHANNELS = 128  # more do not fit into the registers
LOG2_E = 1.4426950408889634


def fits(weights: Weights, *, inputs: int = INPUTS, channels: int = MAX_CHANNELS) -> bool:
    """Whether the kernels can compute these layers: two, of 32, 64, 96 or 128 channels, behind fewer than 16 features."""
    widths = [kernel.shape[1] for kernel, _ in weights]
    return len(widths) == 2 and weights[0][0].shape[0] < inputs and all(0 < w <= channels and w % CHANNELS == 0 for w in widths)


def encode(
    activation: str,
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch K F"],
    mask: Bool[Array, "*batch K"],
    *,
    warps: int = 4,
    stages: int = 1,
    interpret: bool = False,
) -> tuple[Float[Array, "*batch G"], Int[Array, "*batch G"]]:
    """Computes the largest value of each channel over the rows of the mask, and the first row with it; zeros for an empty set.

    Args:
        dtype: of the products of the second layer.
        warps, stages: of a program, see Triton.
        interpret: run on any device, slowly.
    """
    (first, first_bias), (second, second_bias) = weights
    *batch, width, features = x.shape
    out = second.shape[1]
    if not mask.size:
        return jnp.zeros((*batch, out), jnp.float32), jnp.zeros((*batch, out), jnp.int32)
    x, mask = x.reshape(-1, width, features), mask.reshape(-1, width)
    operands = (pallas.block_of(mask)[:, None], x, mask.astype(jnp.int8))
    operands += (with_bias(first, first_bias, INPUTS), second.astype(dtype), second_bias)
    rows = ROWS if width > FEW else FEW
    pooled, winner = pl.pallas_call(
        functools.partial(_encode, activate=activations(interpret)[activation][0], rows=rows, width=width, features=features),
        grid=(len(x),),
        in_specs=[*map(pallas.row, operands[:3]), *map(pallas.whole, operands[3:])],
        out_specs=[pl.BlockSpec((None, out), lambda i: (i, 0))] * 2,
        out_shape=[jax.ShapeDtypeStruct((len(x), out), jnp.float32), jax.ShapeDtypeStruct((len(x), out), jnp.int32)],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=stages),
        interpret=interpret,
        name="encode_set",
    )(*operands)
    return pooled.reshape(*batch, out), winner.reshape(*batch, out)


def _encode(last, x, mask, first, second, second_bias, pooled, winner, *, activate, rows: int, width: int, features: int) -> None:
    hidden, out = tiles(first.shape[1], 64), tiles(second.shape[1], CHANNELS)
    count, lanes, columns = last[0], jnp.arange(rows), jnp.arange(INPUTS)
    ones = mark_bias(rows, features, INPUTS)
    split = (rows // 16, 2, 8)  # a thread of the matrix units holds rows r and r + 8 of 16: the larger of them needs no other thread

    def block(index, best):
        at = index * rows + lanes
        valid = plgpu.load(mask.at[at], mask=at < width, other=0) != 0
        table = plgpu.load(x.at[at[:, None], columns[None, :]], mask=valid[:, None] & (columns < features)[None, :], other=ones)
        inner = [activate(pallas.product(table, first[:, pl.ds(start, length)])).astype(second.dtype) for start, length in hidden]
        results = []
        for (start, length), (value, where) in zip(out, best, strict=True):
            parts = [pallas.product(part, second[pl.ds(k, w), pl.ds(start, length)]) for part, (k, w) in zip(inner, hidden, strict=True)]
            values = jnp.where(valid[:, None], functools.reduce(jnp.add, parts), -jnp.inf).reshape(*split, length)
            largest, half = jnp.max(values, axis=1), jnp.argmax(values, axis=1).astype(jnp.int32)
            better = largest > value
            results.append((jnp.where(better, largest, value), jnp.where(better, 2 * index + half, where)))
        return results

    shape = (rows // 16, 8)
    begin = [(jnp.full((*shape, length), -jnp.inf, jnp.float32), jnp.zeros((*shape, length), jnp.int32)) for _, length in out]
    best = jax.lax.fori_loop(0, pl.cdiv(count, rows), block, begin)
    for (start, length), (value, where) in zip(out, best, strict=True):
        largest = jnp.max(jnp.max(value, axis=1), axis=0)
        place = 16 * jax.lax.broadcasted_iota(jnp.int32, value.shape, 0) + jax.lax.broadcasted_iota(jnp.int32, value.shape, 1)
        row = jnp.where(value == largest[None, None], (where // 2) * rows + (where % 2) * 8 + place, width)
        pooled[pl.ds(start, length)] = jnp.where(count > 0, largest + second_bias[pl.ds(start, length)], 0.0)
        winner[pl.ds(start, length)] = jnp.where(count > 0, jnp.min(jnp.min(row, axis=1), axis=0), 0)


def gradient(
    activation: str,
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch K F"],
    winner: Int[Array, "*batch G"],
    cotangent: Float[Array, "*batch G"],
    *,
    programs: int = 132,
    warps: int = 4,
    interpret: bool = False,
) -> Weights:
    """Computes the gradient of the weights through the winning row of each channel.

    Args:
        cotangent: of the pooled channels; zero for an empty set. Sets behind the last one that is not zero are not read.
        programs: that share the sets, for each tile of channels; their sums are added up afterwards.
    """
    (first, first_bias), (second, _) = weights
    width, features = x.shape[-2:]
    hidden, out = second.shape
    if not x.size:
        return jax.tree.map(jnp.zeros_like, weights)
    cotangent = cotangent.reshape(-1, out)
    programs = min(programs, len(cotangent))
    last = pallas.block_of((cotangent != 0.0).any(axis=1)[None])
    activate, slope = activations(interpret)[activation]
    rounded = second.T.astype(dtype).astype(jnp.float32)
    operands = (last, x.reshape(-1, width, features), winner.reshape(-1, out), cotangent, with_bias(first, first_bias, INPUTS), rounded)
    outer, inner = pl.pallas_call(
        functools.partial(_gradient, activate=activate, slope=slope, dtype=jnp.dtype(dtype), features=features),
        grid=(programs, out // CHANNELS),
        in_specs=[*map(pallas.whole, operands)],
        out_specs=[
            pl.BlockSpec((None, CHANNELS, hidden), lambda i, j: (i, j, 0)),
            pl.BlockSpec((None, None, INPUTS, hidden), lambda i, j: (i, j, 0, 0)),
        ],
        out_shape=[
            jax.ShapeDtypeStruct((programs, out, hidden), jnp.float32),
            jax.ShapeDtypeStruct((programs, out // CHANNELS, INPUTS, hidden), jnp.float32),
        ],
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="encode_set_gradient",
    )(*operands)
    inner = jnp.sum(inner, axis=(0, 1))
    return [(inner[:features], inner[features]), (jnp.sum(outer, axis=0).T, jnp.sum(cotangent, axis=0))]


def _gradient(last, x, winner, cotangent, first, second, outer, inner, *, activate, slope, dtype, features: int) -> None:
    parts, columns = tiles(first.shape[1], CHANNELS), jnp.arange(INPUTS)
    program, programs, base = pl.program_id(0), pl.num_programs(0), pl.program_id(1) * CHANNELS
    mine = base + jnp.arange(CHANNELS)
    ones, known = mark_bias(CHANNELS, features, INPUTS), jnp.broadcast_to((columns < features)[None, :], (CHANNELS, INPUTS))

    def add(index, sums):
        at = program + index * programs  # the first sets may have rows where later ones are empty: each program gets some of both
        pull, row = cotangent[at, mine], winner[at, mine]
        table = plgpu.load(x.at[at, row[:, None], columns[None, :]], mask=known, other=ones)
        results = []
        for (start, length), (wide, narrow) in zip(parts, sums, strict=True):
            before = pallas.product(table, first[:, pl.ds(start, length)])
            after = activate(before)
            steep = pull[:, None] * second[pl.ds(base, CHANNELS), pl.ds(start, length)] * slope(before, after)
            wide += pull[:, None] * after.astype(dtype).astype(jnp.float32)
            results.append((wide, narrow + pallas.product(table, steep, along=0)))
        return results

    begin = [(jnp.zeros((CHANNELS, length), jnp.float32), jnp.zeros((INPUTS, length), jnp.float32)) for _, length in parts]
    sums = jax.lax.fori_loop(0, pl.cdiv(last[0] - program, programs), add, begin)
    for (start, length), (wide, narrow) in zip(parts, sums, strict=True):
        outer[:, pl.ds(start, length)] = wide
        inner[:, pl.ds(start, length)] = narrow


def tiles(width: int, most: int) -> list[tuple[int, int]]:
    """Divides a width into starts and lengths, powers of two, the largest first: 96 -> (0, 64), (64, 32)."""
    results, start = [], 0
    while start < width:
        length = min(most, 1 << ((width - start).bit_length() - 1))
        results.append((start, length))
        start += length
    return results


def mark_bias(rows: int, features: int, inputs: int) -> Array:
    """Columns of rows beside their features: a one, for the bias."""
    return jnp.broadcast_to(jnp.where(jnp.arange(inputs) == features, 1.0, 0.0)[None, :], (rows, inputs))


def with_bias(kernel: Array, bias: Array, inputs: int) -> Array:
    """The first layer as one matrix, for rows of so many columns with a one behind their features."""
    return jnp.concatenate([kernel, bias[None], jnp.zeros((inputs - 1 - len(kernel), kernel.shape[1]), kernel.dtype)])


def activations(interpret: bool) -> dict[str, tuple[Callable[[Any], Any], Callable[[Any, Any], Any]]]:
    """Name -> the function, and its slope from its input and output."""
    exp2 = jnp.exp2 if interpret else _exp2
    return {
        "elu": (lambda x: jnp.where(x > 0.0, x, exp2(LOG2_E * x) - 1.0), lambda x, y: jnp.where(x > 0.0, 1.0, y + 1.0)),
        "relu": (lambda x: jnp.maximum(x, 0.0), lambda x, y: jnp.where(x > 0.0, 1.0, 0.0)),
        "tanh": (jnp.tanh, lambda x, y: 1.0 - y * y),
    }


def _exp2(x: Array) -> Array:
    """Computes 2^x by the hardware, to 2 ulp; `jnp.exp2` and `jnp.expm1` are library functions of 10 and 30 instructions."""
    [result] = plgpu.elementwise_inline_asm(
        "ex2.approx.ftz.f32 $0, $1;", args=[x], constraints="=f,f", pack=1, result_shape_dtypes=[jax.ShapeDtypeStruct(x.shape, x.dtype)]
    )
    return result
