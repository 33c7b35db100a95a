"""Three dense layers with ReLU between them, of rows: plain JAX, and Triton kernels (Pallas) whose hidden values stay on the chip.

Plain JAX writes the hidden values of every row to memory and reads them back, for the gradient too: 2 kB for a row of 40 bytes. Here one
program computes a tile of rows from features to output. For the gradient a program loops over tiles of rows, computes their hidden values
again for some channels of the second layer, and keeps the sums of the weights' gradients; sums of all programs are added up afterwards, in
the same order every time.

Arithmetic is that of plain JAX on the same GPU: products of the first layer in TF32, of the others in bfloat16. Sums and biases are
float32.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Float

from scenefactory_jax.core import pallas
from scenefactory_jax.learning.networks.set_kernel import tiles

Weights = list[tuple[Float[Array, "_ _"], Float[Array, " _"]]]

ROWS = 128  # of a tile
CHANNELS = 64  # of a tile of hidden values
INPUTS = 16  # columns of a row on the chip: its features, a one for the bias, zeros
HIDDEN, OUTPUTS = (64, 128, 192, 256), (32, 64)  # widths; more do not fit into registers and shared memory
MAX_SIZE = 2**31  # entries of an array, whose places are int32


def fits(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> bool:
    """Whether the kernels compute these layers: in bfloat16, two of 64, 128, 192 or 256 channels and one of 32 or 64, behind fewer than 16
    features. In float32 plain JAX is faster.
    """
    features, widths = x.shape[-1], [kernel.shape[1] for kernel, _ in weights]
    if dtype != "bfloat16" or len(widths) != 3 or not 0 < features < INPUTS:
        return False
    return {*widths[:2]} <= {*HIDDEN} and widths[2] in OUTPUTS and 0 < x.size // features * max(features, *widths) < MAX_SIZE


def embed(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> Float[Array, "*batch D"]:
    """Applies dense layers with ReLU between them; layers after the first in `dtype`. Kernels on GPUs that are known, if they fit."""
    quick, plain = functools.partial(embed_quick, dtype), functools.partial(embed_plain, dtype)
    return pallas.on_gpu(quick, plain, weights, x) if fits(dtype, weights, x) and pallas.knows_gpus() else plain(weights, x)


def embed_plain(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> Float[Array, "*batch D"]:
    """`embed` in plain JAX."""
    for index, (kernel, bias) in enumerate(weights):
        kind = dtype if index else jnp.float32
        x = jax.nn.relu(x.astype(dtype)) if index else x.astype(kind)
        x = jnp.matmul(x, kernel.astype(kind)) + bias.astype(kind)
    return x


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def embed_quick(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> Float[Array, "*batch D"]:
    """`embed` by the kernels. Forward-mode differentiation is not defined."""
    return encode(dtype, weights, x)


def _embed_forward(dtype: str, weights: Weights, x: Array) -> tuple[Array, tuple]:
    return encode(dtype, weights, x), (weights, x)


def _embed_backward(dtype: str, residuals: tuple, cotangent: Array) -> tuple[Weights, Array]:
    weights, x = residuals
    [of_rows] = jax.vjp(lambda x: embed_plain(dtype, weights, x), x)[1](cotangent)  # removed by the compiler where it is not used
    return gradient(dtype, weights, x, cotangent), of_rows


embed_quick.defvjp(_embed_forward, _embed_backward)


def encode(
    dtype: str, weights: Weights, x: Float[Array, "*batch F"], *, rows: int = ROWS, warps: int = 8, stages: int = 1, interpret: bool = False
) -> Float[Array, "*batch D"]:
    """Computes the embedding of each row.

    Args:
        rows: of a program.
        warps, stages: of a program, see Triton.
        interpret: run on any device, slowly.
    """
    (first, first_bias), (second, second_bias), (third, third_bias) = weights
    *batch, features = x.shape
    flat = x.reshape(-1, features).astype(jnp.float32)
    operands = (flat, first, first_bias, second.astype(dtype), second_bias, third.astype(dtype), third_bias)
    shape = jax.ShapeDtypeStruct((len(flat), third.shape[1]), dtype)
    out = pl.pallas_call(
        functools.partial(_encode, rows=rows),
        grid=(pl.cdiv(len(flat), rows),),
        in_specs=[*map(pallas.whole, operands)],
        out_specs=pallas.whole(shape),
        out_shape=shape,
        compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=stages),
        interpret=interpret,
        name="embed_rows",
    )(*operands)
    return out.reshape(*batch, out.shape[-1])


def _encode(x, first, first_bias, second, second_bias, third, third_bias, out, *, rows: int) -> None:
    at = pl.program_id(0) * rows + jnp.arange(rows)
    inner = _hidden(_load_rows(x, at), first, first_bias, second.dtype)
    result = jnp.broadcast_to(third_bias[...][None, :], (rows, third.shape[1]))
    for start, length in tiles(second.shape[1], CHANNELS):
        hidden = _second(inner, second, second_bias, start, length)
        result += pallas.product(hidden, third[pl.ds(start, length), :])
    columns = jnp.arange(third.shape[1])
    plgpu.store(out.at[at[:, None], columns[None, :]], result.astype(out.dtype), mask=(at < len(x))[:, None])


def gradient(
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch F"],
    cotangent: Float[Array, "*batch D"],
    *,
    rows: int = ROWS // 2,
    programs: int = 132,
    channels: int = 2 * CHANNELS,
    warps: int = 8,
    stages: tuple[int, int] = (1, 3),
    interpret: bool = False,
) -> Weights:
    """Computes the gradient of the weights: one kernel for the last two layers, and one for the first, behind the cotangent of the second.

    Args:
        rows: of a tile.
        programs: about as many share the work; a GPU has 132 processors.
        channels: that a program holds, half as many in layers that these do not divide.
        warps: of a program.
        stages: of a program of each kernel.
    """
    (first, first_bias), (second, second_bias), (third, _) = weights
    features, hidden, middle, outputs = len(first), *second.shape, third.shape[1]
    flat, pull = x.reshape(-1, features).astype(jnp.float32), cotangent.reshape(-1, outputs).astype(dtype)

    some, others = (channels if width % channels == 0 else CHANNELS for width in (middle, hidden))

    def call(kernel, index: int, name: str, parts: int, arrays: list[jax.ShapeDtypeStruct], sums: list[tuple[int, ...]], *operands: Array):
        share = max(1, min(programs // parts, pl.cdiv(len(flat), rows)))
        each = [pl.BlockSpec((None, None, *size), functools.partial(_place, len(size))) for size in sums]
        results = pl.pallas_call(
            functools.partial(kernel, rows=rows, programs=share),
            grid=(share, parts),
            in_specs=[*map(pallas.whole, operands)],
            out_specs=[*map(pallas.whole, arrays), *each],
            out_shape=[*arrays, *(jax.ShapeDtypeStruct((share, parts, *size), jnp.float32) for size in sums)],
            compiler_params=plgpu.CompilerParams(num_warps=warps, num_stages=stages[index]),
            interpret=interpret,
            name=name,
        )(*operands)
        return *results[: len(arrays)], *(jnp.sum(part, axis=0) for part in results[len(arrays) :])

    second = second.astype(dtype)
    steep, of_second, of_bias, of_third = call(
        _gradient_of_last, 0, "embed_rows_gradient", middle // some,
        [jax.ShapeDtypeStruct((middle, len(flat)), dtype)], [(some, hidden), (some,), (some, outputs)],
        flat, pull, first, first_bias, second, second_bias, third.astype(dtype),
    )  # fmt: skip
    [of_first] = call(
        _gradient_of_first, 1, "embed_rows_gradient_of_first", hidden // others, [], [(others, INPUTS)],
        flat, steep, first, first_bias, second,
    )  # fmt: skip
    of_first = of_first.reshape(hidden, -1).T
    return [
        (of_first[:features], of_first[features]),
        (of_second.reshape(middle, hidden).T, of_bias.reshape(-1)),
        (of_third.reshape(middle, outputs), jnp.sum(pull, axis=0, dtype=jnp.float32)),
    ]


def _gradient_of_last(
    x, pull, first, first_bias, second, second_bias, third, steep, of_second, of_bias, of_third, *, rows: int, programs: int
) -> None:
    """For some channels of the second layer: the cotangent before ReLU, and the gradients of its weights (transposed) and the third's."""
    channels, outputs = of_third.shape
    program, start = pl.program_id(0), pl.program_id(1) * channels
    mine, columns, parts = start + jnp.arange(channels), jnp.arange(outputs), tiles(len(second), channels)

    def add(index, sums):
        wide, bias, last = sums
        at = (program + index * programs) * rows + jnp.arange(rows)
        table = _load_rows(x, at)
        pulled = plgpu.load(pull.at[at[:, None], columns[None, :]], mask=(at < len(x))[:, None], other=0.0)
        inner = [_turned_hidden(table, first, first_bias, second.dtype, k, width) for k, width in parts]
        kernels = [second[pl.ds(k, width), pl.ds(start, channels)] for k, width in parts]
        middle = functools.reduce(jnp.add, [pallas.product(turned, part, along=0) for turned, part in zip(kernels, inner, strict=True)])
        middle = jnp.maximum(middle + second_bias[pl.ds(start, channels)][:, None], 0.0).astype(second.dtype)
        change = jnp.where(middle > 0, pallas.product(third[pl.ds(start, channels), :], pulled, over=1), 0.0)
        bias += jnp.sum(change, axis=1)
        change = change.astype(second.dtype)
        plgpu.store(steep.at[mine[:, None], at[None, :]], change, mask=(at < len(x))[None, :])
        wide = [total + pallas.product(change, part, over=1) for total, part in zip(wide, inner, strict=True)]
        return wide, bias, last + pallas.product(middle, pulled)

    zeros = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
    begin = [zeros(channels, width) for _, width in parts], zeros(channels), zeros(channels, outputs)
    wide, of_bias[...], of_third[...] = jax.lax.fori_loop(0, pl.cdiv(pl.cdiv(len(x), rows) - program, programs), add, begin)
    for (k, width), total in zip(parts, wide, strict=True):
        of_second[:, pl.ds(k, width)] = total


def _gradient_of_first(x, steep, first, first_bias, second, of_first, *, rows: int, programs: int) -> None:
    """For some channels of the first layer: the gradient of its weights, transposed."""
    channels = len(of_first)
    program, start = pl.program_id(0), pl.program_id(1) * channels
    parts = tiles(second.shape[1], CHANNELS)

    def add(index, total):
        at = (program + index * programs) * rows + jnp.arange(rows)
        table, back = _load_rows(x, at, one=True), []
        for k, width in parts:
            columns = k + jnp.arange(width)
            change = plgpu.load(steep.at[columns[:, None], at[None, :]], mask=(at < len(x))[None, :], other=0.0)
            back.append(pallas.product(second[pl.ds(start, channels), pl.ds(k, width)], change))
        inner = _turned_hidden(table, first, first_bias, second.dtype, start, channels)
        return total + pallas.product(jnp.where(inner > 0, functools.reduce(jnp.add, back), 0.0), table)

    begin = jnp.zeros(of_first.shape, jnp.float32)
    of_first[...] = jax.lax.fori_loop(0, pl.cdiv(pl.cdiv(len(x), rows) - program, programs), add, begin)


def _place(axes: int, program: Any, part: Any) -> tuple:
    """Where in an array of all programs' sums those of one program and part are."""
    return (program, part, *(0,) * axes)


def _load_rows(x, at: Array, *, one: bool = False) -> Array:
    """Rows with zeros behind their features, and rows of zeros where there is none; with `one` the first column behind them is a one."""
    count, features = x.shape
    columns = jnp.arange(INPUTS)
    other = jnp.broadcast_to(jnp.where(columns == features, float(one), 0.0)[None, :], (len(at), len(columns)))
    return plgpu.load(x.at[at[:, None], columns[None, :]], mask=(at < count)[:, None] & (columns < features)[None, :], other=other)


def _hidden(table: Array, first, bias, dtype) -> list[Array]:
    """Tiles of the first layer's values behind ReLU."""
    values = [
        pallas.product(table, _load_first(first, start, length)) + bias[pl.ds(start, length)][None, :]
        for start, length in tiles(first.shape[1], CHANNELS)
    ]
    return [jnp.maximum(part, 0.0).astype(dtype) for part in values]


def _turned_hidden(table: Array, first, bias, dtype, start, length: int) -> Array:
    """The first layer's values behind ReLU, channels by rows, for some of its channels."""
    values = pallas.product(_load_first(first, start, length), table, along=0, over=1) + bias[pl.ds(start, length)][:, None]
    return jnp.maximum(values, 0.0).astype(dtype)


def _load_first(first, start, length: int) -> Array:
    """Some columns of the first layer's kernel, with zeros behind its features."""
    rows, columns = jnp.arange(INPUTS), start + jnp.arange(length)
    return plgpu.load(first.at[rows[:, None], columns[None, :]], mask=(rows < len(first))[:, None], other=0.0)


def _second(inner: list[Array], second, bias, start, length: int) -> Array:
    """The second layer's values behind ReLU, for some of its channels."""
    parts = tiles(second.shape[0], CHANNELS)
    values = [pallas.product(part, second[pl.ds(k, width), pl.ds(start, length)]) for part, (k, width) in zip(inner, parts, strict=True)]
    return jnp.maximum(functools.reduce(jnp.add, values) + bias[pl.ds(start, length)][None, :], 0.0).astype(second.dtype)
