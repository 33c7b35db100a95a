"""Shared parts of the Triton kernels: the choice of the platform, blocks of operands, products, and the length of masks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jaxtyping import Array, Bool, Int

MEASURED = "9.0"  # compute capability of the GPUs (H100, H200) on which kernels that fill a processor's memory were measured


def knows_gpus() -> bool:
    """Whether this process's GPUs, if it has any, are those of `MEASURED`: others may have too little shared memory."""
    try:
        return all(device.compute_capability == MEASURED for device in jax.local_devices(backend="cuda"))
    except RuntimeError:  # no GPU: a program that is only lowered
        return True


def on_gpu(quick: Callable, plain: Callable, *arguments: Any) -> Any:
    """`quick` on NVIDIA GPUs, `plain` elsewhere."""
    return jax.lax.platform_dependent(*arguments, cuda=quick, default=plain)


def dispatch(kernel: Callable, plain: Callable, *operands: Any) -> Any:
    """Calls the kernel on NVIDIA GPUs and plain JAX elsewhere, with the derivative of plain JAX."""

    @jax.custom_jvp
    def call(*operands: Any) -> Any:
        return on_gpu(kernel, plain, *operands)

    @call.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple:
        return jax.jvp(plain, primals, tangents)

    return call(*operands)


def row(operand: Any) -> pl.BlockSpec:
    """Each program's own row of an operand, in a grid of one axis."""
    rest = operand.shape[1:]
    return pl.BlockSpec((None, *rest), lambda program: (program,) + (0,) * len(rest))


def whole(operand: Any) -> pl.BlockSpec:
    """All of an operand for every program of any grid."""
    return pl.BlockSpec(operand.shape, lambda *programs: (0,) * len(operand.shape))


def product(a: Array, b: Array, *, along: int = 1, over: int = 0) -> Array:
    """Multiplies matrices on the matrix units, over an axis of each; sums are float32."""
    return jax.lax.dot_general(a, b, (((along,), (over,)), ((), ())), preferred_element_type=jnp.float32)


def block_of(mask: Bool[Array, "*n K"]) -> Int[Array, "*n"]:
    """Number of entries of the last axis up to the last true one."""
    count = jnp.arange(1, mask.shape[-1] + 1, dtype=jnp.int32)
    return jnp.max(jnp.where(mask, count, 0), axis=-1, initial=0)
