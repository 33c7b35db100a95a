"""The cheap checks of annotations refuse what jaxtyping's refuse."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import pytest
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Array, Float, PyTree, TypeCheckError
from support import type_checks

from scenefactory_jax.core import geometry, safe_names

Road, Counted = Float[Array, "points 2"], Float[Array, "{count} 2"]


def decorated(function):
    return type_checks.check_lightly(typechecker=beartype)(function)


def test_shapes_are_checked_wherever_an_annotation_names_them():
    for annotation in (Road, Road | None, tuple[Road, ...], dict[str, Road], Callable[[Road], None], PyTree[Road], "Road"):

        def function(value: annotation):
            return value

        assert type_checks.choose_check(function) == "shapes", annotation

    @decorated
    def both(one: Road, other: Road) -> Road:
        return one + other

    both(jnp.ones((3, 2)), jnp.ones((3, 2)))
    with pytest.raises(TypeCheckError) as caught:
        both(jnp.ones((3, 2)), jnp.ones((1, 2)))
    assert "points=3" in caught.value.__notes__[0]

    @decorated
    def shorten(value: Road) -> Road:
        return both(value, value)[1:]

    with pytest.raises(TypeCheckError):
        shorten(jnp.ones((3, 2)))


def test_sizes_that_arguments_decide_are_checked():
    @decorated
    def fill(count: int, size: int) -> Counted:
        return jnp.ones((size, 2))

    assert fill(3, 3).shape == (3, 2)
    with pytest.raises(TypeCheckError):
        fill(3, 4)


def test_fields_of_a_dataclass_are_checked():
    @dataclasses.dataclass(frozen=True)
    class Pair:
        one: Road
        other: Road | None = None

    checked = decorated(Pair)
    assert checked is Pair and checked(jnp.ones((3, 2))).other is None
    for other in (jnp.ones((1, 2)), 2.0):
        with pytest.raises(TypeCheckError):
            checked(jnp.ones((3, 2)), other)
    with pytest.raises(TypeCheckError):
        dataclasses.replace(checked(jnp.ones((3, 2))), other=jnp.ones((1, 2)))


def test_plain_types_are_checked_without_shapes():
    @decorated
    def double(number: int, *, names: list[str] | None = None) -> int:
        return 2 * number if names is None else names  # pyright: ignore

    assert double(2) == 4
    for arguments, named in (((2.0,), {}), ((2,), {"names": [1]}), ((2,), {"names": ["a"]})):
        with pytest.raises(BeartypeCallHintViolation):
            double(*arguments, **named)
    assert type_checks.choose_check(lambda x: x) == "nothing"


def test_the_package_is_checked():
    with pytest.raises(TypeCheckError):
        geometry.rotate(jnp.ones((3, 5)), jnp.ones(2))
    with pytest.raises(BeartypeCallHintViolation):
        safe_names.to_file_name(3)  # pyright: ignore[reportArgumentType]
