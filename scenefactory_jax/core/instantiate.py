"""A config entry -> a function with its numbers bound.

The one extension mechanism. An entry is a mapping with `_target_` and numbers: `{_target_: my_terms.jerk, limit: 3.0}`. A target without a
dot is looked up among the built-ins of a module, a dotted one is imported; of the package's own modules only what they define counts, not
what they import. The numbers must be the function's keyword-only parameters, all
of them, with the annotated types: a misspelt, missing or mistyped key fails here, by name, with what would be valid.
"""

import functools
import importlib
import inspect
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scenefactory_jax.core.schema import ConfigError


def instantiate(entry: Mapping[str, Any], *, builtins: types.ModuleType | str, where: str, **context: Any) -> Callable[..., Any]:
    """Bind the numbers of `entry` to the function that `_target_` names.

    Args:
        entry: mapping with `_target_`, and a value for every keyword-only parameter of the target.
        builtins: module in which a target without a dot is looked up.
        where: the entry's place in the config, for messages ("reward.progress").
        context: values that the program supplies to targets that declare them (time steps, grip): they need no key.

    Raises:
        ConfigError: no or unknown target, an unknown or missing key, a value of the wrong type.
    """
    if not isinstance(entry, Mapping) or "_target_" not in entry:
        raise ConfigError(f"{where}: {entry!r} is no entry; write a mapping with `_target_` and its numbers")
    function = resolve_target(entry["_target_"], builtins=builtins, where=where)
    parameters = {p.name: p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY}
    numbers = {key: value for key, value in entry.items() if key != "_target_"}
    supplied = {key: value for key, value in context.items() if key in parameters}
    tunable = [name for name in parameters if name not in supplied]

    if unknown := [key for key in numbers if key not in tunable]:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key of {entry['_target_']}; valid: {', '.join(sorted(tunable)) or 'none'}")
    missing = [name for name in tunable if name not in numbers and parameters[name].default is inspect.Parameter.empty]
    if missing:
        raise ConfigError(f"{where}.{missing[0]}: missing; {entry['_target_']} needs {', '.join(sorted(tunable))}")
    hints = typing.get_type_hints(inspect.unwrap(function))
    for key, value in numbers.items():
        check_type(value, hints.get(key, Any), where=f"{where}.{key}")
    return functools.partial(function, **numbers, **supplied)


def resolve_target(target: str, *, builtins: types.ModuleType | str, where: str) -> Callable[..., Any]:
    """The function that `target` names: a public one of `builtins`, or a dotted path to import.

    Raises:
        ConfigError: no such function, or one that a module of the package only imports.
    """
    module = importlib.import_module(builtins) if isinstance(builtins, str) else builtins
    if not isinstance(target, str) or not all(map(str.isidentifier, target.split("."))):
        raise ConfigError(f"{where}._target_: {target!r} is no name of a function")
    if "." in target:
        path, name = target.rsplit(".", 1)
        try:
            module = importlib.import_module(path)
        except ImportError as error:
            raise ConfigError(f"{where}._target_: cannot import {path!r} for {target!r}: {error}") from error
    else:
        name = target
    function = getattr(module, name, None)
    if not callable(function) or name.startswith("_") or not _is_own(function, module):
        valid = ", ".join(list_functions(module))
        raise ConfigError(f"{where}._target_: {target!r} is not in {module.__name__}; valid: {valid}, or a dotted path of your own")
    return function


def list_functions(module: types.ModuleType) -> list[str]:
    """Public functions that a module defines itself."""
    own = [n for n, f in vars(module).items() if inspect.isfunction(f) and inspect.unwrap(f).__module__ == module.__name__]
    return sorted(n for n in own if not n.startswith("_"))


def _is_own(function: Callable[..., Any], module: types.ModuleType) -> bool:
    """Whether a module of the package defines the function itself; modules of others may gather theirs as they like."""
    package = __name__.partition(".")[0]
    return module.__name__.partition(".")[0] != package or getattr(inspect.unwrap(function), "__module__", None) == module.__name__


def check_type(value: Any, hint: Any, *, where: str) -> None:
    """Refuse a config value that does not fit the annotation; an int passes for a float, never a bool for a number.

    Raises:
        ConfigError: naming `where`, the value and the type that is wanted.
    """
    if not _fits(value, hint):
        wanted = getattr(hint, "__name__", None) if not typing.get_args(hint) else None
        raise ConfigError(f"{where}: {value!r} is of type {type(value).__name__}, wanted {wanted or hint}")


def check_number(
    value: float | int, *, where: str, above: float | int | None = None, least: float | int | None = None, below: float | int | None = None
) -> None:
    """Refuse a number of the config that is not finite or beyond a bound.

    Raises:
        ConfigError: naming `where`, the value and what is wanted.
    """
    within = (above is None or value > above) and (least is None or value >= least) and (below is None or value < below)
    if not math.isfinite(value) or not within:
        bounds = {"above": above, "of at least": least, "below": below}
        wanted = " and ".join(f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None)
        kind = "number" if math.isfinite(value) else "finite number"
        raise ConfigError(f"{where}: {value:g}; wanted is a {kind} {wanted}".rstrip())


def check_numbers(values: Mapping[str, float], *, where: str, **bounds: float) -> None:
    """`check_number` for several keys of the entry `where`, all of the same bounds."""
    for name, value in values.items():
        check_number(value, where=f"{where}.{name}", **bounds)


def check_fraction(value: float | int, *, where: str) -> None:
    """Refuse a share of the config that is none.

    Raises:
        ConfigError: a number outside 0 to 1.
    """
    if not 0 <= value <= 1:
        raise ConfigError(f"{where}: {value}; wanted is a number from 0 to 1")


def check_range(span: Sequence[float | int], *, where: str, least: float | None = 0.0) -> tuple[float | int, float | int]:
    """The ends of a range of the config, [least, most].

    Raises:
        ConfigError: other than two ascending numbers, or one below `least`.
    """
    if len(span) != 2 or span[0] > span[1] or (least is not None and span[0] < least):
        raise ConfigError(f"{where}: {list(span)}; wanted is [least, most]" + (f", nothing below {least:g}" if least is not None else ""))
    return span[0], span[1]


def find_differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Dotted keys of which two configs have different values -> both; None, or a group as a whole, where one of them has no such key."""
    found = {}
    for key in {**before, **now}:
        held, wanted = before.get(key), now.get(key)
        if isinstance(held, Mapping) and isinstance(wanted, Mapping):
            found |= find_differences(held, wanted, f"{prefix}{key}.")
        elif held != wanted:
            found[f"{prefix}{key}"] = held, wanted
    return found


def _fits(value: Any, hint: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or isinstance(hint, typing.TypeVar):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in args)
    if origin is typing.Literal:
        return value in args
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (bool, str, type(None)):
        return isinstance(value, hint if hint is not None else type(None))
    if origin in (list, tuple) or hint in (list, tuple):
        if not isinstance(value, (list, tuple)):
            return False
        fixed = origin is tuple and Ellipsis not in args
        if fixed:
            return len(value) == len(args) and all(_fits(v, a) for v, a in zip(value, args, strict=True))
        return not args or all(_fits(v, args[0]) for v in value)
    if origin in (dict, Mapping) or hint in (dict, Mapping) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return isinstance(value, Mapping) and (not args or all(_fits(v, args[1]) for v in value.values()))
    return True  # a type that no config value can be checked against (arrays, callables): the function's own business
