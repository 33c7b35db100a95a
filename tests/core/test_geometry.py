"""The smallest value of a row and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.core.geometry import take_largest, take_smallest


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_the_derivative_of_the_smallest_is_that_of_the_first(mode):
    values = jnp.array([[3.0, 1.0, 2.0], [5.0, 4.0, 4.0], [jnp.inf, jnp.inf, 7.0]])
    np.testing.assert_array_equal(take_smallest(values), [1.0, 4.0, 7.0])
    np.testing.assert_array_equal(jnp.einsum("iij->ij", mode(take_smallest)(values)), [[0, 1, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(jnp.einsum("iij->ij", mode(take_largest)(-values)), [[0, 1, 0], [0, 1, 0], [0, 0, 1]])


def test_rows_without_values_are_infinitely_far():
    empty = jnp.zeros((2, 0))
    assert (take_smallest(empty) == jnp.inf).all() and (take_largest(empty) == -jnp.inf).all()
    assert jax.grad(lambda values: jnp.where(jnp.isfinite(take_smallest(values)), 1.0, 0.0).sum())(empty).shape == (2, 0)
