"""The smallest value of a row, its derivative and its place; distances to many points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.core.geometry import BLOCK, find_smallest, squared_distances, take_largest, take_smallest


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


@pytest.mark.parametrize("count", [1, BLOCK, 2 * BLOCK, 2 * BLOCK + 1, 5 * BLOCK - 1])
def test_the_place_of_the_smallest_is_the_first_one(count):
    """As `argmin`: among equal values in different blocks, in rows that are infinite everywhere, at the end."""
    rng = np.random.default_rng(0)
    ties = rng.integers(0, 40, (4, 5, count)).astype(np.float32)
    ties[0, 0], ties[0, 1] = np.inf, np.where(np.arange(count) == count - 1, 1.0, np.inf)
    found = jax.jit(find_smallest)(ties)
    np.testing.assert_array_equal(found, np.argmin(ties, axis=-1))
    assert found.dtype == jnp.int32


@pytest.mark.parametrize("dimension", [2, 3])
def test_distances_to_many_points(dimension):
    rng = np.random.default_rng(0)
    point, points = rng.normal(size=(3, 4, dimension)).astype(np.float32), rng.normal(size=(6, dimension)).astype(np.float32)
    expected = np.sum((point[:, :, None] - points) ** 2, axis=-1)
    np.testing.assert_allclose(squared_distances(jnp.asarray(point), jnp.asarray(points)), expected, rtol=1e-5)
