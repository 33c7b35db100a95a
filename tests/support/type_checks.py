"""Checks of annotations (`--jaxtyping-packages`) at less cost: only functions that name shapes need what jaxtyping keeps for a call.

jaxtyping's import hook wraps every function in one that binds the arguments, keeps the sizes of named axes, and has them checked twice.
Functions without annotations have nothing to check, and those without arrays of jaxtyping's need none of it: beartype alone checks them.
Where the sizes are not those of arguments (`"{count} 2"`), beartype's one wrapper checks arguments and result with the named axes kept.
"""

import dataclasses
import functools
import inspect
import types
import typing

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import _storage
from jaxtyping._array_types import AbstractArray

jaxtyped = jaxtyping.jaxtyped
beartyped = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))
NEEDS = {}  # code of a function -> its check; functions within others are decorated at each call of the outer one


def names_shapes(annotation):
    """Whether arrays of jaxtyping's, or trees of them, are in an annotation; what is written as text may hold some."""
    if isinstance(annotation, str | typing.ForwardRef):  # jaxtyping leaves unchecked what it cannot resolve
        return True
    if isinstance(annotation, type) and (issubclass(annotation, AbstractArray) or annotation.__module__.startswith("jaxtyping")):
        return True
    inner = annotation if isinstance(annotation, list | tuple) else typing.get_args(annotation)  # a list: the arguments of a Callable
    return any(map(names_shapes, inner))


def is_simple(annotation):
    """Whether arrays in an annotation name their axes without text that is evaluated, and neither trees nor other text is in it."""
    if isinstance(annotation, str | typing.ForwardRef):
        return False
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return "{" not in annotation.dim_str
    if isinstance(annotation, type) and annotation.__module__.startswith("jaxtyping"):
        return False
    return all(map(is_simple, annotation if isinstance(annotation, list | tuple) else typing.get_args(annotation)))


def choose_check(function):
    annotations = function.__annotations__
    if not annotations:
        return "nothing"
    if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function) or any(map(names_shapes, annotations.values())):
        return "shapes"
    return "types"


def check_shapes(function):
    """In place of jaxtyping's check, which binds the arguments by their signature and checks them again beside the result."""
    checked = beartyped(function)

    @functools.wraps(function)
    def call(*arguments, **named):
        __tracebackhide__ = True
        _storage.push_shape_memo({})
        try:
            return checked(*arguments, **named)
        except jaxtyping.TypeCheckError as error:
            if not getattr(error, "__notes__", None):
                error.add_note(_storage.shape_str(_storage.get_shape_memo()))
            raise
        finally:
            _storage.pop_shape_memo()

    return call


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


def check_as_needed(function, need, typechecker):
    simple = need == "shapes" and not inspect.isgeneratorfunction(function) and not inspect.isasyncgenfunction(function)
    if simple and all(map(is_simple, function.__annotations__.values())):
        check = check_shapes
    else:
        check = typechecker if need == "types" else functools.partial(jaxtyped, typechecker=typechecker)
    return check_from_first_call(function, check)


def check_lightly(function=jaxtyping._decorator._sentinel, *, typechecker=jaxtyping._decorator._sentinel):
    """In place of `jaxtyping.jaxtyped`."""
    if isinstance(function, types.FunctionType) and callable(typechecker):
        code = function.__code__
        if code not in NEEDS:
            NEEDS[code] = choose_check(function)
        if NEEDS[code] == "nothing":
            return function
        return check_as_needed(function, NEEDS[code], typechecker)
    elif isinstance(function, type) and dataclasses.is_dataclass(function) and "__init__" in vars(function):
        init = function.__init__
        if callable(typechecker) and not hasattr(init, "__wrapped__") and choose_check(init) != "nothing":
            function.__init__ = check_as_needed(init, choose_check(init), typechecker)
        return function
    elif function is jaxtyping._decorator._sentinel:
        return lambda function: check_lightly(function, typechecker=typechecker)
    return jaxtyped(function, typechecker=typechecker)


jaxtyping.jaxtyped = check_lightly
