"""Maps a function over many cases in one Triton kernel, one case a lane, whatever the function's arrays are.

XLA divides a long function of small arrays into many loops, and writes what they pass to each other to memory. Here a case is read once,
computed in registers and written once.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from scenefactory_jax.core import pallas, scalars

LANES, WARPS = 32, 1  # of a program: few, so that few cases already use all processors


def map_cases(function: Callable[..., Any], *operands: Any, name: str, enable: bool = True, interpret: bool = False) -> Any:
    """Computes `function` of every case: on NVIDIA GPUs by a kernel, elsewhere by `vmap`. Derivatives are those of plain JAX.

    Args:
        function: of one case; it may do what `scalars` can evaluate.
        operands: their leaves have the cases along the first axis. `vmap` over this call makes more cases of one kernel.
        name: of the kernel.
        enable: false: `vmap` everywhere.
        interpret: run the kernel on any device, slowly.
    """
    if not interpret and not (enable and pallas.on_gpu_by_default()):
        return jax.vmap(function)(*operands)
    leaves, tree = jax.tree.flatten(operands)

    def compute(*case: Array) -> Any:
        return function(*jax.tree.unflatten(tree, case))

    closed, result = jax.make_jaxpr(compute, return_shape=True)(*map(_drop_cases, leaves))
    kernel = _join_batches(functools.partial(_call, closed, name=name, interpret=interpret))
    plain = lambda *leaves: tuple(jax.tree.leaves(jax.vmap(compute)(*leaves)))  # noqa: E731
    results = kernel(*leaves) if interpret else pallas.dispatch(kernel, plain, *leaves)
    return jax.tree.unflatten(jax.tree.structure(result), results)


def _drop_cases(leaf: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype)


def _join_batches(call: Callable[..., tuple[Array, ...]]) -> Callable[..., tuple[Array, ...]]:
    """Makes a function that is, under `vmap`, the same function of more cases."""
    joined = jax.custom_batching.custom_vmap(call)

    @joined.def_vmap
    def _(size: int, batched: list[bool], *leaves: Array) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
        spread = [leaf if mapped else jnp.broadcast_to(leaf, (size, *leaf.shape)) for leaf, mapped in zip(leaves, batched, strict=True)]
        results = joined(*(leaf.reshape(-1, *leaf.shape[2:]) for leaf in spread))
        return tuple(part.reshape(size, -1, *part.shape[1:]) for part in results), (True,) * len(results)

    return joined


def _call(closed: ClosedJaxpr, *leaves: Array, name: str, interpret: bool) -> tuple[Array, ...]:
    examples, results, count, used = [*map(_drop_cases, leaves)], closed.out_avals, len(leaves[0]), scalars.find_used(closed)
    read = [leaf.astype(stored(leaf.dtype)) for leaf, needed in zip(leaves, used, strict=True) if needed]
    written = [jax.ShapeDtypeStruct((count, *part.shape), stored(part.dtype)) for part in results]

    def kernel(*references: Any) -> None:
        rows = pl.program_id(0) * LANES + jnp.arange(LANES, dtype=jnp.int32)
        inside, inputs = rows < count, iter(references)
        elements = [
            load(next(inputs), (rows,), inside, case) if needed else np.empty(case.shape, object)
            for case, needed in zip(examples, used, strict=True)
        ]
        for reference, part in zip(inputs, scalars.evaluate(closed, elements), strict=True):
            for place, element in np.ndenumerate(part):
                plgpu.store(reference.at[(rows, *place)], jnp.broadcast_to(element, LANES).astype(reference.dtype), mask=inside)

    found = pl.pallas_call(
        kernel,
        grid=(pl.cdiv(count, LANES),),
        in_specs=[*map(pallas.whole, read)],
        out_specs=[*map(pallas.whole, written)],
        out_shape=written,
        compiler_params=plgpu.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
        name=name,
    )(*read)
    return tuple(part.astype(like.dtype) for part, like in zip(found, results, strict=True))


def stored(dtype: Any) -> Any:
    """The type of numbers in memory: Triton loads no truth values."""
    return jnp.int8 if dtype == jnp.bool_ else dtype


def load(reference: Any, at: tuple[Array, ...], mask: Array, case: jax.ShapeDtypeStruct) -> scalars.Elements:
    """Reads the elements of the arrays of all lanes.

    Args:
        reference: to a table of such arrays, in the type of `stored`.
        at: indices of each lane's array.
        mask: of the lanes that have one.
        case: shape and type of one.
    """
    elements = np.empty(case.shape, object)
    for place in np.ndindex(case.shape):
        value = plgpu.load(reference.at[(*at, *place)], mask=mask, other=0)
        elements[place] = value != 0 if case.dtype == jnp.bool_ else value
    return elements
