"""Maps a function over many cases in one Triton kernel, one case a lane, whatever the function's arrays are.

XLA divides a long function of small arrays into many loops, and writes what they pass to each other to memory. Here a case is read once,
computed in registers and written once.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Var
from jaxtyping import Array

from scenefactory_jax.core import pallas, scalars

LANES, WARPS = 32, 1  # of a program: few, so that few cases already use all processors
PIECE = 100  # operations in one loop: see `_compute_in_pieces`


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
    used = scalars.find_used(closed)
    kernel = _join_batches(functools.partial(_call, _trace_lanes(closed, used), used, closed.out_avals, name=name, interpret=interpret))
    plain = lambda *leaves: tuple(jax.tree.leaves(jax.vmap(compute)(*leaves)))  # noqa: E731
    results = kernel(*leaves) if interpret else pallas.dispatch(kernel, plain, *leaves)
    return jax.tree.unflatten(jax.tree.structure(result), results)


def _trace_lanes(closed: ClosedJaxpr, used: list[bool]) -> ClosedJaxpr:
    """Traces the function of one case as one of lanes: its arguments and results are a vector for each element that is used."""
    cases = [*itertools.compress(closed.in_avals, used)]

    def compute(*vectors: Array) -> list[Array]:
        rest = iter(vectors)
        known = iter([scalars.arrange([next(rest) for _ in range(math.prod(case.shape))], case.shape) for case in cases])
        found = scalars.evaluate(closed, [next(known) if is_used else np.empty(0, object) for is_used in used])
        parts = [(part, stored(like.dtype)) for part, like in zip(found, closed.out_avals, strict=True)]
        return [jnp.broadcast_to(element, LANES).astype(dtype) for part, dtype in parts for element in part.flat]

    return jax.make_jaxpr(compute)(*(jax.ShapeDtypeStruct((LANES,), case.dtype) for case in cases for _ in range(math.prod(case.shape))))


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


def _call(
    operations: ClosedJaxpr, used: list[bool], results: Sequence[Any], *leaves: Array, name: str, interpret: bool
) -> tuple[Array, ...]:
    count, needed = len(leaves[0]), [*itertools.compress(leaves, used)]
    cases, read = [*map(_drop_cases, needed)], [leaf.astype(stored(leaf.dtype)) for leaf in needed]
    written = [jax.ShapeDtypeStruct((count, *part.shape), stored(part.dtype)) for part in results]

    def kernel(*references: Any) -> None:
        rows = pl.program_id(0) * LANES + jnp.arange(LANES, dtype=jnp.int32)
        inside, inputs, outputs = rows < count, references[: len(read)], references[len(read) :]
        vectors = [x for reference, case in zip(inputs, cases, strict=True) for x in load(reference, (rows,), inside, case).flat]
        places = [reference.at[(rows, *place)] for reference in outputs for place in np.ndindex(*reference.shape[1:])]
        for place, vector in zip(places, _compute_in_pieces(operations, vectors), strict=True):
            plgpu.store(place, vector, mask=inside)

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


def _compute_in_pieces(closed: ClosedJaxpr, vectors: Sequence[Array]) -> list[Array]:
    """Computes a traced function of lanes, with a loop of one round around every few operations.

    The loops are for Triton's compiler. Its pass `TritonGPUCoalesce` visits, for each access to memory, all operations that are connected
    with it, and from each of these all that come before and after: with one long piece, minutes for the step of a car. What is in a loop it
    does not connect with what reads the loop's results. Only the compiler after it, LLVM, knows that programs are not numbered below zero,
    finds that there is one round, and leaves nothing of the loops.
    """
    jaxpr, one = closed.jaxpr, jnp.minimum(pl.program_id(0), 0) + 1
    zeros = functools.cache(functools.partial(jnp.zeros, LANES))
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *vectors], strict=True))
    for piece, results in _divide(jaxpr):
        compute = functools.partial(_compute_piece, piece, results, known)
        found = jax.lax.fori_loop(0, one, compute, [zeros(jnp.result_type(var.aval)) for var in results])
        known |= zip(results, found, strict=True)
    return [known[var] for var in jaxpr.outvars]


def _divide(jaxpr: Jaxpr) -> list[tuple[list[JaxprEqn], list[Var]]]:
    """Divides a function into pieces, each with those of its results that are read after it."""
    pieces, read = [], set(jaxpr.outvars)
    for start in reversed(range(0, len(jaxpr.eqns), PIECE)):
        piece = jaxpr.eqns[start : start + PIECE]
        pieces.append((piece, [var for equation in piece for var in equation.outvars if var in read]))
        read |= {var for equation in piece for var in equation.invars if isinstance(var, Var)}
    return pieces[::-1]


def _compute_piece(piece: list[JaxprEqn], results: list[Var], known: dict[Var, Array], *_: Any) -> list[Array]:
    """Computes `results`; the last arguments are a loop's."""
    inside = dict(known)
    for equation in piece:
        operands = [inside[var] if isinstance(var, Var) else var.val for var in equation.invars]
        inside[equation.outvars[0]] = equation.primitive.bind(*operands, **equation.params)
    return [inside[var] for var in results]


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
