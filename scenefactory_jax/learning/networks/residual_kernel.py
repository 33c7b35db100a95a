"""Triton kernels, through Pallas, of what follows the search of an attention: its output layer and a feed-forward part, with ReZero.

    middle = x + scale * (found @ out + bias),   y = middle + scale * (gelu(middle @ hidden + bias) @ back + bias)

Plain JAX writes what is between the products to memory, some ten times the numbers of x. Here one program computes a tile of rows, and the
hidden width in chunks; the gradient computes it anew from the middle, and writes the operands of the weights' gradients, which are three
large products.

Products are of numbers in `dtype`, float32 numbers in TF32; sums and what is between the products are float32.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Float

from scenefactory_jax.core import pallas

ROWS, CHUNK = 64, 32  # of a program, and hidden width at a time; both are halved as long as they do not divide their axis
LEAST, MOST = 16, 128  # of a width or of rows: the minimum of the matrix units, and what the registers hold
CUBIC, STEEP = 0.044715, 2.0 * math.sqrt(2.0 / math.pi)  # of the approximation of GELU, x * sigmoid(STEEP * (x + CUBIC * x^3))

Weights = tuple[tuple[Array, Array], ...]
"""Kernel and bias of the output layer [C, D], of the hidden layer [D, H], and of the layer back [H, D]."""


def fits(x: Float[Array, "*batch D"], found: Float[Array, "*batch C"], weights: Weights) -> bool:
    """Whether the kernels can compute these: widths of a power of two from 16 to 128, multiples of 16 rows and hidden values."""
    fine = all(LEAST <= width <= MOST and width & (width - 1) == 0 for width in (x.shape[-1], found.shape[-1]))
    return fine and x.size > 0 and min(math.gcd(math.prod(x.shape[:-1]), ROWS), math.gcd(weights[1][0].shape[1], CHUNK)) >= LEAST


def add(
    dtype: str,
    x: Float[Array, "*batch D"],
    found: Float[Array, "*batch C"],
    scale: Float[Array, ""],
    weights: Weights,
    *,
    interpret: bool = False,
) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch D"]]:
    """Computes y, and the middle in `dtype`.

    Args:
        dtype: of the products.
        interpret: run on any device, slowly.
    """
    tiles, shared = _divide(x, found.astype(dtype)), _prepare(dtype, scale, weights)
    results = pl.pallas_call(
        functools.partial(_add, chunk=math.gcd(weights[1][0].shape[1], CHUNK)),
        grid=(len(tiles[0]),),
        in_specs=[*map(pallas.row, tiles), *map(pallas.whole, shared)],
        out_specs=[pallas.row(tiles[0])] * 2,
        out_shape=[jax.ShapeDtypeStruct(tiles[0].shape, kind) for kind in (jnp.float32, dtype)],
        compiler_params=_settings(dtype),
        interpret=interpret,
        name="add_residual",
    )(*tiles, *shared)
    y, middle = (part.reshape(x.shape) for part in results)
    return y, middle


def _add(x, found, scale, out, out_bias, hidden, hidden_bias, back, back_bias, y, low_middle, *, chunk: int) -> None:
    middle = x[...] + scale[0] * (pallas.product(found[...], out[...]) + out_bias[...][None])
    low_middle[...] = rounded = middle.astype(out.dtype)

    def step(index, sums):
        part = pl.ds(index * chunk, chunk)
        before = pallas.product(rounded, hidden[:, part]) + hidden_bias[part][None]
        return sums + pallas.product((before * _gate(before)).astype(back.dtype), back[part, :])

    sums = jax.lax.fori_loop(0, hidden.shape[1] // chunk, step, jnp.zeros(middle.shape, jnp.float32))
    y[...] = middle + scale[0] * (sums + back_bias[...][None])


def gradient(
    dtype: str,
    x: Float[Array, "*batch D"],
    found: Float[Array, "*batch C"],
    scale: Float[Array, ""],
    weights: Weights,
    middle: Float[Array, "*batch D"],
    cotangent: Float[Array, "*batch D"],
    *,
    interpret: bool = False,
) -> tuple[Array, Array, Array, Weights]:
    """Computes the gradients of x, found, scale and weights from what `add` returned and the cotangent of y. Arguments as of `add`."""
    del x  # the gradient does not depend on it
    tiles, shared = _divide(middle, found.astype(dtype), cotangent), _prepare(dtype, scale, weights)
    (count, rows, width), inner = tiles[0].shape, weights[1][0].shape[1]
    like = lambda width, dtype: jax.ShapeDtypeStruct((count, rows, width), dtype)  # noqa: E731
    blank = [like(width, jnp.float32), like(found.shape[-1], found.dtype), *(like(w, dtype) for w in (width, width, inner, inner))]
    blank.append(jax.ShapeDtypeStruct((count, inner + 2 * width + 1), jnp.float32))
    *results, sums = pl.pallas_call(
        functools.partial(_gradient, chunk=math.gcd(inner, CHUNK)),
        grid=(count,),
        in_specs=[*map(pallas.row, tiles), *map(pallas.whole, shared)],
        out_specs=[*map(pallas.row, blank)],
        out_shape=blank,
        compiler_params=_settings(dtype),
        interpret=interpret,
        name="add_residual_gradient",
    )(*tiles, *shared)
    flat = [part.reshape(-1, part.shape[-1]) for part in (*tiles, *results)]
    middle_rows, found_rows, _, of_x, of_found, pull, pull_middle, after, slope = flat
    sums = jnp.sum(sums, axis=0)
    of_hidden_bias, of_y, of_middle = sums[:inner], sums[inner : inner + width], sums[inner + width : -1]
    of_scale = sums[-1] + of_y @ weights[2][1] + of_middle @ weights[0][1]
    by_rows = functools.partial(jnp.einsum, "ri,rj->ij", preferred_element_type=jnp.float32)
    of_out = scale * by_rows(found_rows, pull_middle), scale * of_middle
    of_weights = of_out, (by_rows(middle_rows, slope), of_hidden_bias), (scale * by_rows(after, pull), scale * of_y)
    return of_x.reshape(cotangent.shape), of_found.reshape(found.shape), of_scale, of_weights


def _gradient(
    middle, found, cotangent, scale, out, out_bias, hidden, hidden_bias, back, back_bias,
    of_x, of_found, low_pull, low_of_x, low_after, low_slope, sums, *, chunk: int,
) -> None:  # fmt: skip
    del out_bias, back_bias
    (rows, width), inner, middle = middle.shape, hidden.shape[1], middle[...]
    low_pull[...] = pull = cotangent[...].astype(out.dtype)

    def step(index, carry):
        total, along = carry
        part = pl.ds(index * chunk, chunk)
        before = pallas.product(middle, hidden[:, part]) + hidden_bias[part][None]
        gate = _gate(before)
        after, pulled = before * gate, pallas.product(pull, back[part, :], over=1)
        steep = gate + after * (1.0 - gate) * STEEP * (1.0 + 3.0 * CUBIC * before * before)
        slope = scale[0] * pulled * steep
        low = slope.astype(out.dtype)
        low_after[:, part], low_slope[:, part], sums[part] = after.astype(out.dtype), low, _sum_rows(low)
        return total + pallas.product(low, hidden[:, part], over=1), along + jnp.sum(after * pulled, axis=1)

    begin = cotangent[...], jnp.zeros(rows, jnp.float32)
    total, along = jax.lax.fori_loop(0, inner // chunk, step, begin)
    low = total.astype(out.dtype)
    of_x[...], low_of_x[...], pulled = total, low, pallas.product(low, out[...], over=1)
    of_found[...] = (scale[0] * pulled).astype(of_found.dtype)
    sums[pl.ds(inner, width)], sums[pl.ds(inner + width, width)] = _sum_rows(pull), _sum_rows(low)
    sums[inner + 2 * width] = jnp.sum(along + jnp.sum(found[...].astype(jnp.float32) * pulled, axis=1))


def _gate(x: Array) -> Array:
    """The factor of x in GELU."""
    return 1.0 / (1.0 + jnp.exp(-STEEP * (x + CUBIC * x * x * x)))


def _sum_rows(x: Float[Array, "rows width"]) -> Float[Array, " width"]:
    """Sums rows on the matrix units: threads would have to exchange them."""
    return jnp.sum(pallas.product(jnp.full((LEAST, len(x)), 1.0 / LEAST, x.dtype), x), axis=0)


def _divide(*arrays: Array) -> list[Array]:
    """Divides rows into tiles [tiles, rows, width]."""
    rows = math.gcd(math.prod(arrays[0].shape[:-1]), ROWS)
    return [x.reshape(-1, rows, x.shape[-1]) for x in arrays]


def _settings(dtype: str) -> plgpu.CompilerParams:
    """Of a program, see Triton; with float32 numbers more stages were slower."""
    return plgpu.CompilerParams(num_warps=4, num_stages=3 if dtype == "bfloat16" else 1)


def _prepare(dtype: str, scale: Array, weights: Weights) -> list[Any]:
    """What every program reads: the scale, then kernels, rounded, and biases."""
    return [scale.reshape(1), *(part for kernel, bias in weights for part in (kernel.astype(dtype), bias))]
