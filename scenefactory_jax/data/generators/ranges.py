"""Ranges and groups of numbers from the config: checks by name, and random draws."""

import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from scenefactory_jax.core.instantiate import ConfigError, check_type

Group = TypeVar("Group")


def draw(rng: np.random.Generator, span: list[float], name: str, *, low: float = 0.0) -> float:
    """Draws a number from a range of the config.

    Raises:
        ConfigError: the range is not two numbers in ascending order, or begins below `low`.
    """
    check_range(span, name, low=low)
    return float(rng.uniform(span[0], span[1]))


def draw_count(rng: np.random.Generator, span: list[int]) -> int:
    """Draws a whole number from a range that is known to be valid, both ends included."""
    return int(rng.integers(span[0], span[1] + 1))


def check_range(span: Sequence[float | int], name: str, *, low: float = 0.0) -> None:
    """Raises a ConfigError unless a range is two ascending numbers, none below `low`."""
    if len(span) != 2 or not low <= span[0] <= span[1]:
        raise ConfigError(f"{name}: expected [min, max] with {low:g} <= min <= max, got {list(span)!r}")


def check_positive(value: float, name: str) -> None:
    """Raises a ConfigError unless a number is above zero."""
    if not value > 0:
        raise ConfigError(f"{name}: expected a number > 0, got {value!r}")


def fill(kind: Callable[..., Group], numbers: Mapping[str, Any], where: str, **known: Any) -> Group:
    """Makes a named tuple from a mapping with its keys; ranges must ascend, fractions (`*_fraction`) must lie in [0, 1].

    Args:
        kind: a NamedTuple.
        where: place of the group in the config, for messages.
        known: fields that are not in the config.

    Raises:
        ConfigError: a key that is missing or unknown, a value of the wrong type or out of range.
    """
    hints = typing.get_type_hints(kind)
    keys = [name for name in hints if name not in known]
    if set(numbers) != set(keys):
        raise ConfigError(f"{where}.{min(set(numbers) ^ set(keys))}: missing or unknown; expected {', '.join(keys)}")
    for name, value in numbers.items():
        check_type(value, hints[name], where=f"{where}.{name}")
        if hints[name] in (list[float], list[int]):
            check_range(value, f"{where}.{name}")
        values = value if isinstance(value, Sequence) else [value]
        if name.endswith("_fraction") and not all(0 <= number <= 1 for number in values):
            raise ConfigError(f"{where}.{name}: expected a number in [0, 1], got {value!r}")
    fixed = {name: tuple(value) for name, value in numbers.items() if typing.get_origin(hints[name]) is tuple}
    return kind(**(known | dict(numbers) | fixed))
