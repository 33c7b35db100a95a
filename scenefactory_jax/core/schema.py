"""Checks configs against frozen dataclasses: the annotations are the types, `Bounds` the ranges, `__post_init__` what joins several keys.

    @dataclass(frozen=True)
    class Timing:
        control_hz: Annotated[float, Bounds(above=0)]
        episode_s: Annotated[float, Bounds(min=0.1)] = 50.0          # a key with a default may be missing

    timing = schema.read(config["timing"], Timing, where="timing")    # an instance; ConfigError names the first key that does not fit
    schema.check(config["timing"], Timing, where="timing")            # the same, when the mapping is used as it is

A field may be another dataclass, `T | None`, `Literal[...]`, `list[T]`, `tuple[T, ...]` or `dict[str, T]` of these.
Parameters of a function that `_target_` selects are checked by the same annotations (`instantiate`), `Bounds` included.
"""

import dataclasses
import functools
import math
import os
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

T = TypeVar("T")


class ConfigError(ValueError):
    """A config entry that cannot be used; the message names the key, the value and what would be valid."""


@dataclass(frozen=True)
class Bounds:
    """Range of a finite number, or of each number of a list: `min <= x <= max`, `above < x < below`.

    With `is_range` the list of two numbers is itself a range, [min, max].
    """

    min: float | int | None = None
    max: float | int | None = None
    above: float | int | None = None
    below: float | int | None = None
    is_range: bool = False

    def __contains__(self, number: float | int) -> bool:
        inside = (self.min is None or number >= self.min) and (self.max is None or number <= self.max)
        return inside and (self.above is None or number > self.above) and (self.below is None or number < self.below)

    def admit(self, numbers: list[Any]) -> bool:
        """Whether all numbers are finite and inside the bounds and, of a range, in ascending order."""
        ascending = not self.is_range or (len(numbers) == 2 and numbers[0] <= numbers[1])
        return ascending and all(math.isfinite(number) and number in self for number in numbers)

    def __str__(self) -> str:
        signs = {">=": self.min, ">": self.above, "<=": self.max, "<": self.below}
        return " and ".join(f"{sign} {bound:g}" for sign, bound in signs.items() if bound is not None)


Count = Annotated[int, Bounds(min=1)]
Seed = Annotated[int, Bounds(min=0)]
NonNegative = Annotated[float, Bounds(min=0)]
Positive = Annotated[float, Bounds(above=0)]
Fraction = Annotated[float, Bounds(min=0, max=1)]
Range = Annotated[tuple[float, float], Bounds(min=0, is_range=True)]  # [min, max]
CountRange = Annotated[tuple[int, int], Bounds(min=0, is_range=True)]
Weight = float | Annotated[tuple[float, float], Bounds(is_range=True)]  # a number, or a range that it is drawn from


def check(config: Any, schema: type, *, where: str = "") -> None:
    """Checks a mapping against a dataclass, as `read`."""
    read(config, schema, where=where)


def read(config: Any, schema: type[T], *, where: str = "") -> T:
    """Checks a mapping against a dataclass and returns it as an instance; nested mappings become instances, too.

    Args:
        where: the mapping's place in the config, for messages ("evaluation.video").

    Raises:
        ConfigError: `key: expected X, got Y` for the first key that is missing, unknown, of another type or out of range; or an error of
            `__post_init__`, with `where` in front.
    """
    if not isinstance(config, Mapping):
        raise ConfigError(f"{where or 'config'}: expected a mapping, got {config!r}")
    fields = dataclasses.fields(typing.cast(Any, schema))
    required = [field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING]
    check_names(config, [field.name for field in fields], where=where, required=required)
    hints = read_hints(schema)
    values = {name: read_value(value, hints[name], where=_join(where, name)) for name, value in config.items()}
    try:
        return schema(**values)
    except ConfigError as error:
        raise ConfigError(_join(where, error)) from None


def check_names(config: Mapping[str, Any], valid: list[str], *, where: str, required: list[str], hint: str = "") -> None:
    """Checks that a mapping has all required keys and no unknown ones.

    Args:
        hint: end of the message of an unknown key, `{key}` in it.

    Raises:
        ConfigError: naming the first missing or unknown key, and the valid ones.
    """
    if unknown := [key for key in config if key not in valid]:
        key = _join(where, unknown[0])
        raise ConfigError(f"{key}: unknown key; valid: {', '.join(sorted(valid)) or 'none'}{hint.format(key=key)}")
    if missing := [key for key in required if key not in config]:
        raise ConfigError(f"{_join(where, missing[0])}: missing; {where or 'the config'} needs {', '.join(sorted(valid))}")


def _join(where: str, key: Any) -> str:
    return f"{where}.{key}" if where else str(key)


@functools.cache
def read_hints(target: Any) -> Mapping[str, Any]:
    """The annotations of a dataclass or of a function."""
    return typing.get_type_hints(target, include_extras=True)


def read_value(value: Any, hint: Any, *, where: str) -> Any:
    """Checks one value against an annotation; a mapping that the annotation takes as a dataclass is returned as an instance.

    Raises:
        ConfigError: naming `where`, what is expected and the value.
    """
    value = os.fspath(typing.cast(Any, value)) if isinstance(value, os.PathLike) else value
    kinds = [(kind, bounds) for kind, bounds in _list_kinds(hint) if _is_kind(value, kind)]
    kind, bounds = kinds[0] if kinds else (None, None)
    numbers = [number for number in (value if isinstance(value, (list, tuple)) else [value]) if _is_kind(number, float)]
    if not kinds or (bounds is not None and value is not None and not bounds.admit(numbers)):
        raise ConfigError(f"{where}: expected {describe(hint)}, got {value!r}")
    items = typing.get_args(kind)
    if isinstance(value, Mapping) and dataclasses.is_dataclass(kind):
        return read(value, typing.cast(type, kind), where=where)
    if isinstance(value, Mapping) and items:
        return {key: read_value(item, items[1], where=_join(where, key)) for key, item in value.items()}
    if isinstance(value, (list, tuple)) and items and typing.get_origin(kind) in (list, tuple):
        hints = items if _is_fixed(kind) else items[:1] * len(value)
        places = [f"{where}[{i}]" if isinstance(item, Mapping) else where for i, item in enumerate(value)]
        found = [read_value(item, item_hint, where=place) for item, item_hint, place in zip(value, hints, places, strict=True)]
        return found if typing.get_origin(kind) is list else tuple(found)
    return float(typing.cast(float, value)) if kind is float else value


def _list_kinds(hint: Any, bounds: Bounds | None = None) -> list[tuple[Any, Bounds | None]]:
    """The types that an annotation allows, with their bounds."""
    origin, items = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return _list_kinds(hint.__origin__, next((extra for extra in hint.__metadata__ if isinstance(extra, Bounds)), bounds))
    if origin in (typing.Union, types.UnionType):
        return [pair for option in items for pair in _list_kinds(option, bounds)]
    return [(hint, bounds)]


def _is_kind(value: Any, kind: Any) -> bool:
    """Whether a value is of a type, whatever its items are; an int passes for a float, never a bool for a number."""
    origin = typing.get_origin(kind) or kind
    if origin is Literal:
        return value in typing.get_args(kind)
    if origin in (float, int):
        return isinstance(value, (int, origin)) and not isinstance(value, bool)
    if origin in (bool, str, type(None)):
        return isinstance(value, origin)
    if origin in (list, tuple):
        return isinstance(value, (list, tuple)) and (not _is_fixed(kind) or len(value) == len(typing.get_args(kind)))
    if dataclasses.is_dataclass(kind) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return isinstance(value, Mapping)
    return True  # any value; arrays and callables: no value of a config is checked against these


def _is_fixed(kind: Any) -> bool:
    """Whether a type is of tuples with a type for each item."""
    return typing.get_origin(kind) is tuple and Ellipsis not in typing.get_args(kind)


WORDS = {float: "a number", int: "an integer", bool: "true or false", str: "a text", type(None): "null", list: "a list"}


def describe(hint: Any) -> str:
    """Describes an annotation for an error message: "an integer >= 1", "a number or null", "one of a, b"."""
    return " or ".join(_describe(kind, bounds) for kind, bounds in _list_kinds(hint))


def _describe(kind: Any, bounds: Bounds | None) -> str:
    if bounds is not None and kind is not type(None):
        return f"{'[min, max]' if bounds.is_range else _describe(kind, None)} {bounds}".strip()
    origin, items = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return " or ".join(map(str, items)) if len(items) < 3 else f"one of {', '.join(map(str, items))}"
    if _is_fixed(kind):
        return f"[{', '.join(map(describe, items))}]"
    if origin in (list, tuple):
        return f"a list, each {describe(items[0])}"
    if dataclasses.is_dataclass(kind) or (isinstance(origin or kind, type) and issubclass(origin or kind, Mapping)):
        return "a mapping"
    return WORDS.get(kind, getattr(kind, "__name__", str(kind)))
