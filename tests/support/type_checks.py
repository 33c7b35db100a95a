"""Checks of annotations (`--jaxtyping-packages`) at less cost: only functions that name shapes need what jaxtyping keeps for a call.

jaxtyping's import hook wraps every function in one that binds the arguments, keeps the sizes of named axes, and has them checked twice.
Functions without annotations have nothing to check, and those without arrays of jaxtyping's need none of it: beartype alone checks them.
"""

import functools
import inspect
import types
import typing

import jaxtyping
from jaxtyping._array_types import AbstractArray

jaxtyped = jaxtyping.jaxtyped
NEEDS = {}  # code of a function -> its check; functions within others are decorated at each call of the outer one


def names_shapes(annotation):
    """Whether arrays of jaxtyping's, or trees of them, are in an annotation; what is written as text may hold some."""
    if isinstance(annotation, str | typing.ForwardRef):  # jaxtyping leaves unchecked what it cannot resolve
        return True
    if isinstance(annotation, type) and (issubclass(annotation, AbstractArray) or annotation.__module__.startswith("jaxtyping")):
        return True
    inner = annotation if isinstance(annotation, list | tuple) else typing.get_args(annotation)  # a list: the arguments of a Callable
    return any(map(names_shapes, inner))


def choose_check(function):
    annotations = function.__annotations__
    if not annotations:
        return "nothing"
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function) or any(map(names_shapes, annotations.values())):
        return "shapes"
    return "types"


def check_from_first_call(function, check):
    """Prepares the check of a function when it is first called: most functions are not called in a process that runs a few tests.

    Without shapes, a test may turn the check off (`jaxtyping_disable`), as jaxtyping's own.
    """
    checked = None

    @functools.wraps(function)
    def call(*arguments, **named):
        __tracebackhide__ = True
        nonlocal checked
        if jaxtyping.config.jaxtyping_disable:
            return function(*arguments, **named)
        checked = checked or check(function)
        return checked(*arguments, **named)

    return call


def check_lightly(function=jaxtyping._decorator._sentinel, *, typechecker=jaxtyping._decorator._sentinel):
    """In place of `jaxtyping.jaxtyped`."""
    if isinstance(function, types.FunctionType) and callable(typechecker):
        code = function.__code__
        if code not in NEEDS:
            NEEDS[code] = choose_check(function)
        if NEEDS[code] == "nothing":
            return function
        check = typechecker if NEEDS[code] == "types" else functools.partial(jaxtyped, typechecker=typechecker)
        return check_from_first_call(function, check)
    elif function is jaxtyping._decorator._sentinel:
        return lambda function: check_lightly(function, typechecker=typechecker)
    return jaxtyped(function, typechecker=typechecker)


jaxtyping.jaxtyped = check_lightly
