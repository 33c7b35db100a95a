"""Random indices in given proportions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scenefactory_jax.core.random_index import draw_index


@pytest.mark.parametrize("shape", [(), (7,), (40, 50)])
@pytest.mark.parametrize("chances", [[1.0], [0.0, 0.25, 0.0, 0.75, 0.0], [0.2] * 5])
def test_indices_are_those_of_jax(chances, shape):
    drawn = draw_index(jax.random.key(3), jnp.array(chances), shape)
    np.testing.assert_array_equal(drawn, jax.random.choice(jax.random.key(3), len(chances), shape, p=jnp.array(chances)))
    assert np.all(np.array(chances)[np.asarray(drawn)] > 0.0)
