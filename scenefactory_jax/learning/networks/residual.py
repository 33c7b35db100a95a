"""Residual parts of encoders: what an attention found and a feed-forward part, each added times one learnt number (ReZero)."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core import pallas
from scenefactory_jax.learning.networks import residual_kernel
from scenefactory_jax.learning.networks.residual_kernel import Weights

Affine = tuple[Array, Array]  # kernel and bias


def affine(dtype: str, weights: Affine, x: Float[Array, "*batch I"]) -> Float[Array, "*batch O"]:
    """A dense layer in `dtype`."""
    kernel, bias = weights
    return jnp.matmul(x.astype(dtype), kernel.astype(dtype)) + bias.astype(dtype)


def feed_forward(dtype: str, hidden: Affine, back: Affine, x: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """A dense layer, GELU, and a dense layer back to the width of the input."""
    return affine(dtype, back, jax.nn.gelu(affine(dtype, hidden, x)))


def add(
    dtype: str, kernels: bool, x: Float[Array, "*batch D"], found: Float[Array, "*batch C"], scale: Float[Array, ""], weights: Weights
) -> Float[Array, "*batch D"]:
    """Adds the output layer of what was found, and then a feed-forward part, each times the scale.

    Args:
        dtype: of the products.
        kernels: Triton kernels on NVIDIA GPUs, where they fit; forward-mode differentiation is not defined then.
        weights: of the output layer, the hidden layer and the layer back.
    """
    quick = kernels and residual_kernel.fits(x, found, weights) and pallas.knows_gpus()
    return (_add if quick else add_plainly)(dtype, x, found, scale, weights)


def add_plainly(dtype: str, x: Array, found: Array, scale: Array, weights: Weights) -> Array:
    """Computes the same in plain JAX."""
    out, hidden, back = weights
    x = x + scale * affine(dtype, out, found).astype(jnp.float32)
    return x + scale * feed_forward(dtype, hidden, back, x).astype(jnp.float32)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _add(dtype: str, x: Array, found: Array, scale: Array, weights: Weights) -> Array:
    return _add_forward(dtype, x, found, scale, weights)[0]


def _add_forward(dtype: str, x: Array, found: Array, scale: Array, weights: Weights) -> tuple[Array, tuple]:
    def plain(x: Array, *others: Any) -> tuple[Array, Array]:
        return add_plainly(dtype, x, *others), jnp.zeros_like(x, dtype)  # no gradient of plain JAX needs the middle

    y, middle = pallas.on_gpu(functools.partial(residual_kernel.add, dtype), plain, x, found, scale, weights)
    return y, (x, found, scale, weights, middle)


def _add_backward(dtype: str, residuals: tuple, cotangent: Array) -> tuple:
    def plain(x: Array, found: Array, scale: Array, weights: Weights, middle: Array, cotangent: Array) -> tuple:
        del middle
        return jax.vjp(functools.partial(add_plainly, dtype), x, found, scale, weights)[1](cotangent)

    return pallas.on_gpu(functools.partial(residual_kernel.gradient, dtype), plain, *residuals, cotangent)


_add.defvjp(_add_forward, _add_backward)
