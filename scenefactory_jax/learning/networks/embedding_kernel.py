"""Three dense layers with ReLU between them, of rows: plain JAX, and Triton kernels (Pallas) whose hidden values stay on the chip.

Plain JAX writes the hidden values of every row to memory and reads them back, for the gradient too: 2 kB for a row of 40 bytes. Here one
program computes a tile of rows from features to output. For the gradient a program loops over tiles of rows, computes their hidden values
again for some channels of the second layer, and keeps the sums of the weights' gradients; sums of all programs are added up afterwards, in
the same order every time.

Arithmetic is that of plain JAX on the same GPU: products of float32 numbers in TF32, of bfloat16 numbers as they are. Sums and biases are
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
MAX_HIDDEN, MAX_OUTPUTS, MAX_FEATURES = 256, 128, 31  # more do not fit into the registers
INPUTS = (16, 32)  # columns of a row on the chip: its features, a one for the bias, zeros
MAX_SIZE = 2**31  # entries of an array, whose places are int32


def fits(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> bool:
    """Whether the kernels compute these layers: in bfloat16, two of 64, 128, 192 or 256 channels and one of 32, 64 or 128, behind up to
    31 features. In float32 plain JAX is faster.
    """
    features, *widths = x.shape[-1], *(kernel.shape[1] for kernel, _ in weights)
    rows = x.size // max(features, 1)
    return (
        dtype == "bfloat16"
        and len(widths) == 3
        and all(width % CHANNELS == 0 and 0 < width <= MAX_HIDDEN for width in widths[:2])
        and widths[2] in (32, 64, MAX_OUTPUTS)
        and 0 < features <= MAX_FEATURES
        and 0 < rows * max(features, widths[2]) < MAX_SIZE
    )


def embed(dtype: str, weights: Weights, x: Float[Array, "*batch F"]) -> Float[Array, "*batch D"]:
    """Applies dense layers with ReLU between them; layers after the first multiply in `dtype`. Kernels on NVIDIA GPUs, if they fit."""
    plain = functools.partial(embed_plain, dtype)
    return pallas.on_gpu(functools.partial(embed_quick, dtype), plain, weights, x) if fits(dtype, weights, x) else plain(weights, x)


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
        result += _product(hidden, third[pl.ds(start, length), :])
    columns = jnp.arange(third.shape[1])
    plgpu.store(out.at[at[:, None], columns[None, :]], result.astype(out.dtype), mask=(at < len(x))[:, None])


def gradient(
    dtype: str,
    weights: Weights,
    x: Float[Array, "*batch F"],
    cotangent: Float[Array, "*batch D"],
    *,
    rows: int = ROWS,
    programs: int = 132,
    channels: int = 2 * CHANNELS,
    warps: tuple[int, int] = (8, 8),
    stages: tuple[int, int] = (1, 1),
    interpret: bool = False,
) -> Weights:
    """Computes the gradient of the weights: one kernel for the last two layers, and one for the first, behind the cotangent of the second.

    Args:
        rows: of a tile.
        programs: about as many share the work; a GPU has 132 processors.
        warps, stages: of a program of each kernel.
    """
    (first, first_bias), (second, second_bias), (third, _) = weights
    features, hidden, middle, outputs = len(first), *second.shape, third.shape[1]
    flat, pull = x.reshape(-1, features).astype(jnp.float32), cotangent.reshape(-1, outputs).astype(dtype)
    channels = channels if hidden % channels == 0 else CHANNELS

    def call(kernel, index: int, name: str, parts: int, arrays: list[jax.ShapeDtypeStruct], sums: list[tuple[int, ...]], *operands: Array):
        share = max(1, min(programs // parts, pl.cdiv(len(flat), rows)))
        each = [pl.BlockSpec((None, None, *size), functools.partial(_place, len(size))) for size in sums]
        results = pl.pallas_call(
            functools.partial(kernel, rows=rows, programs=share),
            grid=(share, parts),
            in_specs=[*map(pallas.whole, operands)],
            out_specs=[*map(pallas.whole, arrays), *each],
            out_shape=[*arrays, *(jax.ShapeDtypeStruct((share, parts, *size), jnp.float32) for size in sums)],
            compiler_params=plgpu.CompilerParams(num_warps=warps[index], num_stages=stages[index]),
            interpret=interpret,
            name=name,
        )(*operands)
        return *results[: len(arrays)], *(jnp.sum(part, axis=0) for part in results[len(arrays) :])

    second = second.astype(dtype)
    steep, of_second, of_bias, of_third = call(
        _gradient_of_last, 0, "embed_rows_gradient", middle // CHANNELS,
        [jax.ShapeDtypeStruct((len(flat), middle), dtype)], [(CHANNELS, hidden), (CHANNELS,), (CHANNELS, outputs)],
        flat, pull, first, first_bias, second, second_bias, third.astype(dtype),
    )  # fmt: skip
    [of_first] = call(
        _gradient_of_first, 1, "embed_rows_gradient_of_first", hidden // channels, [], [(_inputs(features), channels)],
        flat, steep, first, first_bias, second,
    )  # fmt: skip
    of_first = jnp.moveaxis(of_first, 0, 1).reshape(-1, hidden)
    return [
        (of_first[:features], of_first[features]),
        (of_second.reshape(middle, hidden).T, of_bias.reshape(-1)),
        (of_third.reshape(middle, outputs), jnp.sum(pull, axis=0, dtype=jnp.float32)),
    ]


def _gradient_of_last(
    x, pull, first, first_bias, second, second_bias, third, steep, of_second, of_bias, of_third, *, rows: int, programs: int
) -> None:
    """For some channels of the second layer: the cotangent before ReLU, and the gradients of its weights (transposed) and the third's."""
    program, start = pl.program_id(0), pl.program_id(1) * CHANNELS
    parts, columns, mine = tiles(first.shape[1], CHANNELS), jnp.arange(third.shape[1]), start + jnp.arange(CHANNELS)

    def add(index, sums):
        wide, bias, last = sums
        at = (program + index * programs) * rows + jnp.arange(rows)
        exists = (at < len(x))[:, None]
        inner = _hidden(_load_rows(x, at), first, first_bias, second.dtype)
        middle = _second(inner, second, second_bias, start, CHANNELS)
        pulled = plgpu.load(pull.at[at[:, None], columns[None, :]], mask=exists, other=0.0)
        change = jnp.where(middle > 0, _product(pulled, third[pl.ds(start, CHANNELS), :], (1, 1)), 0.0)
        bias += jnp.sum(change, axis=0)
        change = change.astype(second.dtype)
        plgpu.store(steep.at[at[:, None], mine[None, :]], change, mask=exists)
        wide = [total + _product(change, part, (0, 0)) for total, part in zip(wide, inner, strict=True)]
        return wide, bias, last + _product(middle, pulled, (0, 0))

    zeros = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
    begin = [zeros(CHANNELS, width) for _, width in parts], zeros(CHANNELS), zeros(*of_third.shape)
    wide, of_bias[...], of_third[...] = jax.lax.fori_loop(0, pl.cdiv(pl.cdiv(len(x), rows) - program, programs), add, begin)
    for (k, width), total in zip(parts, wide, strict=True):
        of_second[:, pl.ds(k, width)] = total


def _gradient_of_first(x, steep, first, first_bias, second, of_first, *, rows: int, programs: int) -> None:
    """For some channels of the first layer: the gradient of its weights."""
    channels = of_first.shape[1]
    program, start = pl.program_id(0), pl.program_id(1) * channels
    parts = tiles(second.shape[1], CHANNELS)

    def add(index, total):
        at = (program + index * programs) * rows + jnp.arange(rows)
        table = _load_rows(x, at, one=True)
        [inner] = _hidden(table, first, first_bias, second.dtype, [(start, channels)])
        back = []
        for k, width in parts:
            columns = k + jnp.arange(width)
            change = plgpu.load(steep.at[at[:, None], columns[None, :]], mask=(at < len(x))[:, None], other=0.0)
            back.append(_product(change, second[pl.ds(start, channels), pl.ds(k, width)], (1, 1)))
        return total + _product(table, jnp.where(inner > 0, functools.reduce(jnp.add, back), 0.0), (0, 0))

    begin = jnp.zeros(of_first.shape, jnp.float32)
    of_first[...] = jax.lax.fori_loop(0, pl.cdiv(pl.cdiv(len(x), rows) - program, programs), add, begin)


def _place(axes: int, program: Any, part: Any) -> tuple:
    """Where in an array of all programs' sums those of one program and part are."""
    return (program, part, *(0,) * axes)


def _inputs(features: int) -> int:
    """Columns of a row on the chip."""
    return next(count for count in INPUTS if features < count)


def _load_rows(x, at: Array, *, one: bool = False) -> Array:
    """Rows with zeros behind their features, and rows of zeros where there is none; with `one` the first column behind them is a one."""
    count, features = x.shape
    columns = jnp.arange(_inputs(features))
    other = jnp.broadcast_to(jnp.where(columns == features, float(one), 0.0)[None, :], (len(at), len(columns)))
    return plgpu.load(x.at[at[:, None], columns[None, :]], mask=(at < count)[:, None] & (columns < features)[None, :], other=other)


def _hidden(table: Array, first, bias, dtype, parts: list | None = None) -> list[Array]:
    """Tiles of the first layer's values behind ReLU; all of them, or some parts."""
    rows, results = jnp.arange(table.shape[1]), []
    for start, length in parts or tiles(first.shape[1], CHANNELS):
        columns = start + jnp.arange(length)
        kernel = plgpu.load(first.at[rows[:, None], columns[None, :]], mask=(rows < len(first))[:, None], other=0.0)
        values = _product(table, kernel) + bias[pl.ds(start, length)][None, :]
        results.append(jnp.maximum(values, 0.0).astype(dtype))
    return results


def _second(inner: list[Array], second, bias, start, length: int) -> Array:
    """The second layer's values behind ReLU, for some of its channels."""
    parts = tiles(second.shape[0], CHANNELS)
    values = [_product(part, second[pl.ds(k, width), pl.ds(start, length)]) for part, (k, width) in zip(inner, parts, strict=True)]
    return jnp.maximum(functools.reduce(jnp.add, values) + bias[pl.ds(start, length)][None, :], 0.0).astype(second.dtype)


def _product(a: Array, b: Array, along: tuple[int, int] = (1, 0)) -> Array:
    """Multiplies matrices on the matrix units, over an axis of each; sums are float32."""
    return jax.lax.dot_general(a, b, (((along[0],), (along[1],)), ((), ())), preferred_element_type=jnp.float32)
