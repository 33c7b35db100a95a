"""Evaluates a traced function with every element of its arrays as a value of its own.

A kernel computes one case a lane: what is a number in the function becomes a vector of lanes, and an array of the function a NumPy array of
such vectors. Slices, reshapes and concatenations then only sort these vectors while the kernel is traced, and Triton, which knows no small
or odd shapes, sees arithmetic alone.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend import core as jaxprs

Elements = np.ndarray
"""An array of dtype object: of vectors of lanes, or of NumPy numbers that are the same in all lanes."""


def evaluate(closed: jaxprs.ClosedJaxpr, leaves: Sequence[Elements]) -> list[Elements]:
    """Evaluates a traced function (`jax.make_jaxpr`): an array of elements for each leaf of its arguments, and for each of its result.

    A product with a constant zero is zero: a NaN in its other factor is lost.

    Raises:
        NotImplementedError: an operation of JAX that mixes elements in a way that is not known here.
    """
    jaxpr, consts = closed.jaxpr, [list_elements(const) for const in closed.consts]
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *leaves], strict=True))

    def find(var: Any) -> Elements:
        is_number = isinstance(var, jaxprs.Literal)
        return list_elements(np.asarray(var.val, jax.numpy.result_type(var.aval))) if is_number else known[var]

    for equation in jaxpr.eqns:
        results = _apply(equation, [find(var) for var in equation.invars])
        known.update(zip(equation.outvars, results, strict=True))
    return [find(var) for var in jaxpr.outvars]


def find_used(closed: jaxprs.ClosedJaxpr) -> list[bool]:
    """Finds the leaves of the arguments that a traced function reads."""
    jaxpr = closed.jaxpr
    read = {id(var) for equation in jaxpr.eqns for var in equation.invars} | {id(var) for var in jaxpr.outvars}
    return [id(var) in read for var in jaxpr.invars]


def list_elements(numbers: Any) -> Elements:
    """Lists the numbers of an array, with its shape."""
    array = np.asarray(numbers)
    return arrange((array[place] for place in np.ndindex(array.shape)), array.shape)


def arrange(values: Iterable[Any], shape: tuple[int, ...]) -> Elements:
    """Makes an array of the elements of a shape, row by row."""
    elements = np.empty(shape, object)
    for place, value in zip(np.ndindex(shape), values, strict=True):
        elements[place] = value
    return elements


def _apply(equation: Any, operands: list[Elements]) -> list[Elements]:
    name, params = equation.primitive.name, equation.params
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None:  # a call
        return evaluate(inner, operands)
    if name in ARRANGING:
        return [ARRANGING[name](*operands, **params)]
    if name in DIVIDING:
        return DIVIDING[name](*operands, **params)
    if name in REDUCING:
        axes = params["axes"]
        return [_reduce(REDUCING[name], np.moveaxis(operands[0], axes, range(len(axes))), count=len(axes))]
    if name not in ELEMENTWISE:
        raise NotImplementedError(f"{name}: expected an operation on single elements, an arrangement or a reduction, got {equation}")
    return [_compute(functools.partial(equation.primitive.bind, **params), *operands, name=name)]


def _compute(operation: Callable[..., Any], *operands: Elements, name: str = "") -> Elements:
    """Computes an operation on single elements, of arrays that broadcast; `name`: of one that may need no arithmetic."""
    spread = np.broadcast_arrays(*operands)
    result = np.empty(spread[0].shape, object)
    for place in np.ndindex(result.shape):
        result[place] = _compute_element(operation, [operand[place] for operand in spread], name)
    return result


def _compute_element(operation: Callable[..., Any], values: list[Any], name: str) -> Any:
    """Computes one element; numbers, which are the same in all lanes, on the host."""
    lanes = [value for value in values if _is_lanes(value)]
    if not lanes:
        with jax.ensure_compile_time_eval():
            return np.asarray(operation(*map(jax.numpy.asarray, values)))[()]
    if (short := _shorten(name, values)) is not None:
        return short
    shape = lanes[0].shape
    return operation(*(value if _is_lanes(value) else lax.full(shape, value, value.dtype) for value in values))


def _is_lanes(value: Any) -> bool:
    return not isinstance(value, np.generic)


def _shorten(name: str, values: list[Any]) -> Any:
    """The result of a sum with zero or a product with zero or one, which needs no arithmetic; else None."""
    if name not in ("add", "sub", "mul", "div") or len(values) != 2:
        return None
    a, b = values
    first, second = (math.nan if _is_lanes(value) else float(value) for value in values)
    match name:
        case "add" | "sub" if second == 0.0:
            return a
        case "add" if first == 0.0:
            return b
        case "mul" if first == 0.0 or second == 1.0:
            return a
        case "mul" if second == 0.0 or first == 1.0:
            return b
        case "div" if second == 1.0 or first == 0.0:
            return a
    return None


def _reduce(operation: Callable[..., Any], x: Elements, *, count: int) -> Elements:
    """Combines the elements along the first `count` axes."""
    parts = x.reshape(-1, *x.shape[count:])
    combine = functools.partial(_compute, operation, name="add" if operation is lax.add else "")
    return functools.reduce(combine, [parts[number, ...] for number in range(len(parts))])


def _where(chosen: Elements, one: Elements, other: Elements) -> Elements:
    return _compute(lax.select_n, chosen, other, one)


def _broadcast(x: Elements, *, shape: Sequence[int], broadcast_dimensions: Sequence[int], **_: Any) -> Elements:
    sizes = [1] * len(shape)
    for axis, dimension in enumerate(broadcast_dimensions):
        sizes[dimension] = x.shape[axis]
    return np.broadcast_to(x.reshape(sizes), shape)


def _slice(x: Elements, *, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None) -> Elements:
    return x[tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))]


def _unstack(x: Elements, *, axis: int, **_: Any) -> list[Elements]:
    parts = np.moveaxis(x, axis, 0)
    return [parts[number, ...] for number in range(len(parts))]


def _slice_from(x: Elements, *starts: Elements, slice_sizes: Sequence[int]) -> Elements:
    """`dynamic_slice`: each lane chooses among all slices. A start before the first is the first, one beyond the last is the last."""
    found = x
    for axis, (start, size) in enumerate(zip(starts, slice_sizes, strict=True)):
        parts = [found.take(range(first, first + size), axis) for first in range(found.shape[axis] - size + 1)]
        found = parts[0]
        for first, part in enumerate(parts[1:], 1):
            found = _where(_compute(lax.ge, start, list_elements(np.int32(first))), part, found)
    return found


def _count_up(*, dtype: Any, shape: Sequence[int], dimension: int, **_: Any) -> Elements:
    """`iota`."""
    return list_elements(np.indices(shape, dtype)[dimension])


def _find_largest(x: Elements, *, axes: Sequence[int], **_: Any) -> Elements:
    """`argmax`: the first of the largest."""
    values = np.moveaxis(x, axes[0], 0)
    best, index = values[0, ...], list_elements(np.zeros(values.shape[1:], np.int32))
    for number in range(1, len(values)):
        value = values[number, ...]
        larger = _compute(lax.gt, value, best)
        best, index = _where(larger, value, best), _where(larger, list_elements(np.int32(number)), index)
    return index


def _multiply_matrices(a: Elements, b: Elements, *, dimension_numbers: Any, **_: Any) -> Elements:
    """`dot_general`."""
    (along, over), (batch, _) = dimension_numbers
    if batch:
        raise NotImplementedError(f"dot_general: expected no batch axes, got {batch}")
    first, second = np.moveaxis(a, along, range(len(along))), np.moveaxis(b, over, range(len(over)))
    spread = first.reshape(*first.shape, *[1] * (second.ndim - len(over)))
    terms = _compute(lax.mul, spread, np.expand_dims(second, tuple(range(len(along), first.ndim))), name="mul")
    return _reduce(lax.add, terms, count=len(along))


ARRANGING: dict[str, Callable[..., Elements]] = {  # what takes elements to other places, and what is made of that
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "reshape": lambda x, *, new_sizes, **_: np.reshape(x, new_sizes),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "concatenate": lambda *parts, dimension: np.concatenate(parts, dimension),
    "stack": lambda *parts, axis: np.stack(parts, axis),
    "stop_gradient": lambda x, **_: x,
    "copy": lambda x: x,
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "dynamic_slice": _slice_from,
    "iota": _count_up,
    "argmax": _find_largest,
    "dot_general": _multiply_matrices,
}
DIVIDING: dict[str, Callable[..., list[Elements]]] = {  # arrangements of several results
    "split": lambda x, *, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "unstack": _unstack,
}
ELEMENTWISE = {
    "abs", "add", "and", "atan", "atan2", "ceil", "convert_element_type", "cos", "div", "eq", "exp", "exp2", "expm1", "floor", "ge",
    "gt", "integer_pow", "is_finite", "le", "log", "log1p", "log2", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not",
    "one_minus_square", "or", "pow", "rem", "rsqrt", "select_n", "sign", "sin", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
REDUCING = {
    "reduce_sum": lax.add,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
