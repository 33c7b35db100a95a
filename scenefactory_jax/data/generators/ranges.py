"""Ranges of the config: checks and random draws."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from scenefactory_jax.core import schema
from scenefactory_jax.core.schema import ConfigError

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


def read_group(numbers: Mapping[str, Any], group: type[Group], where: str) -> Group:
    """Reads a group of numbers as a dataclass; its fields of two numbers are ranges.

    Raises:
        ConfigError: a key that is missing or unknown, a value of the wrong type or out of range.
    """
    result = schema.read(numbers, group, where=where)
    for name, value in vars(result).items():
        if isinstance(value, list) and len(value) == 2 and not isinstance(value[0], list):
            check_range(value, f"{where}.{name}")
    return result
