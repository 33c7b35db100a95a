"""Schemas: dataclasses check configs, and their errors name the key, what is expected and the value."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest

from scenefactory_jax.core import schema
from scenefactory_jax.core.schema import Bounds, ConfigError, Count, Fraction, NonNegative


@dataclass(frozen=True)
class Part:
    limit_m: NonNegative
    mode: Literal["a", "b", "c"] = "a"


@dataclass(frozen=True)
class Whole:
    count: Count
    share: Fraction | None
    sizes: list[Annotated[float, Bounds(above=0)]]
    pair: tuple[float, float]
    parts: dict[str, Part]
    part: Part | None
    entry: dict[str, Any]

    def __post_init__(self) -> None:
        if self.pair[0] > self.pair[1]:
            raise ConfigError(f"pair: expected [min, max], got {list(self.pair)}")


GOOD = {"count": 3, "share": None, "sizes": [1, 2.5], "pair": [0, 1], "parts": {"x": {"limit_m": 1}}, "part": None}
GOOD["entry"] = {"_target_": "f"}


def test_a_mapping_becomes_an_instance_with_its_parts():
    read = schema.read({**GOOD, "part": {"limit_m": 2, "mode": "b"}}, Whole, where="whole")
    assert read.count == 3 and read.part == Part(2.0, "b") and read.parts == {"x": Part(1.0)} and read.entry == {"_target_": "f"}
    assert isinstance(read.sizes[0], float) and isinstance(read.parts["x"].limit_m, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "whole.count: expected an integer >= 1, got 0"),
        ({"count": True}, "whole.count: expected an integer >= 1, got True"),
        ({"share": 1.5}, "whole.share: expected a number >= 0 and <= 1 or null, got 1.5"),
        ({"share": float("nan")}, "whole.share: expected a number"),
        ({"sizes": [1, 0]}, "whole.sizes: expected a number > 0, got 0"),
        ({"sizes": 1}, "whole.sizes: expected a list, each a number > 0, got 1"),
        ({"pair": [1, 0]}, "whole.pair: expected [min, max], got [1.0, 0.0]"),
        ({"pair": [1]}, "whole.pair: expected [a number, a number], got [1]"),
        ({"parts": {"x": {"limit_m": -1}}}, "whole.parts.x.limit_m: expected a number >= 0, got -1"),
        ({"part": {"limit_m": 1, "mode": "d"}}, "whole.part.mode: expected one of a, b, c, got 'd'"),
        ({"part": {"limit": 1}}, "whole.part.limit: unknown key; valid: limit_m, mode"),
        ({"part": {}}, "whole.part.limit_m: missing; whole.part needs limit_m, mode"),
        ({"part": 3}, "whole.part: expected a mapping or null, got 3"),
    ],
)
def test_values_that_do_not_fit_are_named(change, message):
    with pytest.raises(ConfigError) as caught:
        schema.check({**GOOD, **change}, Whole, where="whole")
    assert str(caught.value).startswith(message)
