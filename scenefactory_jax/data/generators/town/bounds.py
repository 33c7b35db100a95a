"""Groups of numbers from the config as named tuples, refused by name where they do not fit."""

import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from scenefactory_jax.core.instantiate import ConfigError, check_type
from scenefactory_jax.data.generators.procedural.road_layout import check_range

Group = TypeVar("Group")


def fill(kind: Callable[..., Group], numbers: Mapping[str, Any], where: str, **known: Any) -> Group:
    """A named tuple from a mapping that has its keys: ranges ascend, shares (`*_share`) lie between 0 and 1.

    Args:
        kind: a NamedTuple.
        where: the group's place in the config, for messages.
        known: fields that are no numbers of the config.

    Raises:
        ConfigError: a key that is missing or unknown, a value of the wrong type or out of range.
    """
    hints = typing.get_type_hints(kind)
    wanted = [name for name in hints if name not in known]
    if set(numbers) != set(wanted):
        wrong = sorted(set(numbers) ^ set(wanted))[0]
        raise ConfigError(f"{where}.{wrong}: missing or unknown; valid: {', '.join(wanted)}")
    for name, value in numbers.items():
        check_type(value, hints[name], where=f"{where}.{name}")
        shares = value if isinstance(value, (list, tuple)) else [value]
        if name.endswith("_share") and not all(0 <= share <= 1 for share in shares):
            raise ConfigError(f"{where}.{name}: {value!r} must lie between 0 and 1")
        if hints[name] in (list[float], list[int]):
            check_range(list(value), f"{where}.{name}", low=0.0)
    fixed = {name: tuple(value) for name, value in numbers.items() if typing.get_origin(hints[name]) is tuple}
    return kind(**(known | dict(numbers) | fixed))
