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
import math
import os
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeGuard, TypeVar

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
        return not (self.is_range and numbers[0] > numbers[1]) and all(math.isfinite(number) and number in self for number in numbers)

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


def check(config: Any, schema: type, *, where: str = "") -> None:
    """Checks a mapping against a dataclass.

    Raises:
        ConfigError: `key: expected X, got Y` for the first key that is missing, unknown, of another type or out of range.
    """
    read(config, schema, where=where)


def read(config: Any, schema: type[T], *, where: str = "") -> T:
    """Checks a mapping against a dataclass and returns it as an instance; nested mappings become instances, too.

    Args:
        where: the mapping's place in the config, for messages ("evaluation.video").

    Raises:
        ConfigError: see `check`; one that `__post_init__` raises gets `where` in front.
    """
    if not isinstance(config, Mapping):
        raise ConfigError(f"{where or 'config'}: expected a mapping, got {config!r}")
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, schema))}
    check_names(config, list(fields), where=where, required=[name for name, field in fields.items() if _is_required(field)])
    hints = typing.get_type_hints(schema, include_extras=True)
    values = {name: read_value(config[name], hints[name], where=_join(where, name)) for name in fields if name in config}
    try:
        return schema(**values)
    except ConfigError as error:
        raise ConfigError(f"{_join(where, '')}{error}") from None


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def check_names(config: Mapping[str, Any], valid: list[str], *, where: str, required: list[str]) -> None:
    """Checks that a mapping has all required keys and no unknown ones.

    Raises:
        ConfigError: naming the first missing or unknown key, and the valid ones.
    """
    if unknown := [key for key in config if key not in valid]:
        raise ConfigError(f"{_join(where, unknown[0])}: unknown key; valid: {', '.join(sorted(valid)) or 'none'}")
    if missing := [key for key in required if key not in config]:
        raise ConfigError(f"{_join(where, missing[0])}: missing; {where or 'the config'} needs {', '.join(sorted(valid))}")


def _join(where: str, key: Any) -> str:
    return f"{where}.{key}" if where else str(key)


def read_value(value: Any, hint: Any, *, where: str) -> Any:
    """Checks one value against an annotation; a mapping that the annotation takes as a dataclass is returned as an instance.

    Raises:
        ConfigError: naming `where`, what is expected and the value.
    """
    value = os.fspath(typing.cast(Any, value)) if isinstance(value, os.PathLike) else value
    plain, bounds = _split(hint)
    options = typing.get_args(plain) if typing.get_origin(plain) in (typing.Union, types.UnionType) else (plain,)
    for option in options:
        origin, items = typing.get_origin(option), typing.get_args(option)
        if isinstance(value, Mapping) and dataclasses.is_dataclass(option):
            return read(value, typing.cast(type, option), where=where)
        if isinstance(value, Mapping) and items and isinstance(origin, type) and issubclass(origin, Mapping):
            return {key: read_value(item, items[1], where=_join(where, key)) for key, item in value.items()}
    if not _fits(value, plain):
        raise ConfigError(f"{where}: expected {describe(hint)}, got {value!r}")
    numbers: list[Any] = [number for number in (value if isinstance(value, (list, tuple)) else [value]) if _is_number(number)]
    if bounds is not None and value is not None and not bounds.admit(numbers):
        raise ConfigError(f"{where}: expected {describe(hint)}, got {value!r}")
    if isinstance(value, (list, tuple)) and (items := _item_hints(options)):
        hints = items if len(items) == len(value) and Ellipsis not in items else items[:1] * len(value)
        places = [f"{where}[{i}]" if isinstance(item, Mapping) else where for i, item in enumerate(value)]
        items_read = [read_value(item, item_hint, where=place) for item, item_hint, place in zip(value, hints, places, strict=True)]
        return items_read if any(list in (option, typing.get_origin(option)) for option in options) else tuple(items_read)
    as_float = isinstance(value, int) and not isinstance(value, bool) and float in options and int not in options
    return float(typing.cast(int, value)) if as_float else value


def _split(hint: Any) -> tuple[Any, Bounds | None]:
    """The type of an annotation, and its bounds, also those inside of an optional one."""
    if typing.get_origin(hint) is Annotated:
        return hint.__origin__, next((extra for extra in hint.__metadata__ if isinstance(extra, Bounds)), None)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        found = [_split(option) for option in typing.get_args(hint)]
        return typing.Union[tuple(plain for plain, _ in found)], next((bounds for _, bounds in found if bounds is not None), None)  # noqa: UP007
    return hint, None


def _item_hints(options: tuple[Any, ...]) -> tuple[Any, ...]:
    return next((typing.get_args(option) for option in options if typing.get_origin(option) in (list, tuple)), ())


def _is_number(value: Any) -> TypeGuard[float | int]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a type; an int passes for a float, never a bool for a number."""
    hint, _ = _split(hint)
    origin, items = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in items)
    if origin is Literal:
        return value in items
    if hint in (float, int):
        return _is_number(value) and (hint is float or isinstance(value, int))
    if hint in (bool, str):
        return isinstance(value, hint)
    if hint in (None, type(None)):
        return value is None
    if origin in (list, tuple) or hint in (list, tuple):
        if not isinstance(value, (list, tuple)):
            return False
        if origin is tuple and Ellipsis not in items:
            return len(value) == len(items) and all(_fits(item, hint) for item, hint in zip(value, items, strict=True))
        return not items or all(_fits(item, items[0]) for item in value)
    if dataclasses.is_dataclass(hint):
        return isinstance(value, Mapping)
    if hint in (dict, Mapping) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return isinstance(value, Mapping) and (not items or all(_fits(item, items[1]) for item in value.values()))
    return True  # arrays and callables: no value of a config is checked against these


WORDS = {float: "a number", int: "an integer", bool: "true or false", str: "a text", type(None): "null", list: "a list", dict: "a mapping"}


def describe(hint: Any) -> str:
    """Describes an annotation for an error message: "an integer >= 1", "a number or null", "one of a, b"."""
    if typing.get_origin(hint) is Annotated:
        plain, bounds = _split(hint)
        kind = "[min, max]" if bounds is not None and bounds.is_range else describe(plain)
        return f"{kind} {bounds or ''}".strip()
    origin, items = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(item) for item in items)
    if origin is Literal:
        return " or ".join(map(str, items)) if len(items) < 3 else f"one of {', '.join(map(str, items))}"
    if origin is tuple and Ellipsis not in items:
        return f"[{', '.join(describe(item) for item in items)}]"
    if origin in (list, tuple):
        return f"a list, each {describe(items[0])}"
    if hint is Mapping or dataclasses.is_dataclass(hint) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return "a mapping"
    return WORDS.get(hint, getattr(hint, "__name__", str(hint)))
