"""Which parameters of a test are among the fast tests."""

from collections.abc import Iterable
from typing import Any

import pytest


def slow_except(values: Iterable[Any], *fast: Any) -> list[Any]:
    """Parameters, of which all but a few are left to `pytest -m slow`; a tuple is of as many arguments."""
    values = list(values)
    missing = [one for one in fast if one not in values]
    assert not missing, f"no parameters: {missing}"
    return [one if one in fast else pytest.param(*(one if isinstance(one, tuple) else (one,)), marks=pytest.mark.slow) for one in values]
