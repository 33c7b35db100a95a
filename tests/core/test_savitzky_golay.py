"""Savitzky-Golay filters against SciPy's."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from scenefactory_jax.core.savitzky_golay import filter_range


@pytest.mark.parametrize(("width", "order", "derivative"), [(8, 2, 0), (15, 2, 1), (5, 2, 1), (5, 3, 2)])
def test_range_is_filtered_as_if_it_were_all(width, order, derivative):
    values = np.random.default_rng(width).normal(size=40).astype(np.float32)
    first, last = 3, 30
    found = filter_range(jnp.asarray(values), jnp.int32(first), jnp.int32(last), width=width, order=order, derivative=derivative, dt=0.1)
    expected = savgol_filter(values[first : last + 1].astype(float), width, order, deriv=derivative, delta=0.1)
    np.testing.assert_allclose(found[first : last + 1], expected, atol=1e-6 * 10 ** (2 * derivative))
