"""Binds the numbers of a config entry to the function that its `_target_` names: the one extension mechanism.

    reward.jerk: {_target_: my_terms.jerk, weight: -0.1, limit: 3.0}

A target without a dot is a public function of a given module. A dotted target is imported; of a module of this package, only functions that
it defines itself are found. The numbers are the keyword-only parameters of the function, checked against their annotations (`schema`) and
bound as `schema` reads them: a mapping that the annotation takes as a dataclass becomes its instance.
"""

import functools
import importlib
import inspect
import math
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scenefactory_jax.core.schema import Bounds, ConfigError, check_names, read_hints, read_value


def instantiate(entry: Mapping[str, Any], *, builtins: types.ModuleType | str, where: str, **context: Any) -> Callable[..., Any]:
    """Returns the function that `_target_` names with the numbers of `entry` bound.

    Args:
        builtins: module of targets without a dot.
        where: key of the entry, for messages ("reward.progress").
        context: values that the program supplies to targets that declare them (time steps, friction): they need no key.

    Raises:
        ConfigError: no or unknown target, an unknown or missing key, a value of the wrong type.
    """
    if not isinstance(entry, Mapping) or "_target_" not in entry:
        hint = f"; if the option in use has no such entry, ~{where} takes it out" if isinstance(entry, Mapping) and "." in where else ""
        raise ConfigError(f"{where}: expected a mapping with `_target_` and its numbers, got {entry!r}{hint}")
    function = resolve_target(entry["_target_"], builtins=builtins, where=where)
    parameters = {p.name: p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY}
    numbers = {key: value for key, value in entry.items() if key != "_target_"}
    supplied = {key: value for key, value in context.items() if key in parameters}
    tunable = [name for name in parameters if name not in supplied]

    required = [name for name in tunable if parameters[name].default is inspect.Parameter.empty]
    check_names(numbers, tunable, where=where, required=required, hint="; if the option in use has no such key, ~{key} takes it out")
    hints = read_hints(inspect.unwrap(function))
    values = {key: read_value(value, hints.get(key, Any), where=f"{where}.{key}") for key, value in numbers.items()}
    return functools.partial(function, **values, **supplied)


def resolve_target(target: str, *, builtins: types.ModuleType | str, where: str) -> Callable[..., Any]:
    """Finds the function that `target` names: a public one of `builtins`, or a dotted path.

    Raises:
        ConfigError: no such function, or one that a module of this package only imports.
    """
    module = importlib.import_module(builtins) if isinstance(builtins, str) else builtins
    if not isinstance(target, str) or not all(map(str.isidentifier, target.split("."))):
        raise ConfigError(f"{where}._target_: expected the name of a function, got {target!r}")
    if "." in target:
        path, name = target.rsplit(".", 1)
        try:
            module = importlib.import_module(path)
        except ImportError as error:
            raise ConfigError(f"{where}._target_: cannot import {path!r} for {target!r}: {error}") from error
    else:
        name = target
    function = getattr(module, name, None)
    foreign = module.__name__.partition(".")[0] != __name__.partition(".")[0]
    if not callable(function) or name.startswith("_") or not (foreign or _is_defined_in(function, module)):
        functions = [name for name, value in vars(module).items() if inspect.isfunction(value) and _is_defined_in(value, module)]
        valid = ", ".join(sorted(name for name in functions if not name.startswith("_")))
        raise ConfigError(f"{where}._target_: {target!r} is not in {module.__name__}; valid: {valid}, or a dotted path")
    return function


def _is_defined_in(function: Callable[..., Any], module: types.ModuleType) -> bool:
    """Whether a function is defined in a module, or in a module of a package."""
    place = getattr(inspect.unwrap(function), "__module__", None) or ""
    return place == module.__name__ or (hasattr(module, "__path__") and place.startswith(f"{module.__name__}."))


def check_number(
    value: float | int, *, where: str, above: float | int | None = None, least: float | int | None = None, below: float | int | None = None
) -> None:
    """Checks that a number of a config is finite and within its bounds; raises a ConfigError that names `where`."""
    bounds = Bounds(min=least, above=above, below=below)
    if not math.isfinite(value) or value not in bounds:
        kind = "number" if math.isfinite(value) else "finite number"
        raise ConfigError(f"{where}: expected a {' '.join(filter(None, [kind, str(bounds)]))}, got {value:g}")


def check_numbers(values: Mapping[str, float], *, where: str, **bounds: float) -> None:
    """Checks several keys of the entry `where` against the same bounds, as `check_number`."""
    for name, value in values.items():
        check_number(value, where=f"{where}.{name}", **bounds)


def check_range(span: Sequence[float | int], *, where: str, least: float | None = 0.0) -> tuple[float | int, float | int]:
    """Returns the ends of a range of a config, [min, max]; raises a ConfigError that names `where`."""
    if len(span) != 2 or span[0] > span[1]:
        raise ConfigError(f"{where}: expected [min, max], got {list(span)}")
    if least is not None and span[0] < least:
        raise ConfigError(f"{where}: expected [min, max] with min >= {least:g}, got {list(span)}")
    return span[0], span[1]
