"""Savitzky-Golay filters: derivatives of polynomials fitted by least squares to windows of equally spaced values."""

import functools
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


@functools.cache
def compute_weights(width: int, order: int, derivative: int, place: float) -> tuple[float, ...]:
    """Computes the weights of a window's values in the derivative of its fitted polynomial, for values 1 apart.

    Args:
        order: of the polynomial.
        place: in the window at which the derivative is taken: 0 at its first value, width - 1 at its last one.
    """
    powers = np.arange(order + 1)
    fit = np.linalg.pinv((np.arange(width) - place)[:, None] ** powers)  # [order + 1, width]
    return tuple((math.factorial(derivative) * fit[derivative]).tolist())


def filter_inside(values: Float[Array, "*a K"], *, width: int, order: int, derivative: int, dt: float) -> Float[Array, "*a M"]:
    """Computes the derivative at the middle of every window that lies inside of the values, [K - width + 1]."""
    weights, count = compute_weights(width, order, derivative, (width - 1) / 2), values.shape[-1] - width + 1
    total = sum((weight * values[..., place : place + count] for place, weight in enumerate(weights)), start=jnp.float32(0.0))
    return total / dt**derivative


def filter_range(
    values: Float[Array, " T"],
    first: Int[Array, ""],
    last: Int[Array, ""],
    *,
    width: int,
    order: int,
    derivative: int,
    dt: float,
) -> Float[Array, " T"]:
    """Computes the derivative at every value from `first` to `last`; elsewhere it has no meaning, nor where these are fewer than `width`.

    Towards both ends the first and the last window's polynomials count. Of a window of even width the middle lies between two values: the
    derivative half a value later is taken, as in SciPy's `savgol_filter`.
    """
    places = (*map(float, range(width)), (width - 1) / 2)
    table = jnp.array([compute_weights(width, order, derivative, place) for place in places], jnp.float32)
    row = jnp.arange(values.shape[0])
    inside = (row >= first + width // 2) & (row <= last - width // 2)
    start = jnp.where(inside, row - (width - 1) // 2, jnp.where(row < first + width // 2, first, last - width + 1))
    place = jnp.where(inside, width, jnp.clip(row - start, 0, width - 1))
    window = values[jnp.clip(start[:, None] + jnp.arange(width), 0, values.shape[0] - 1)]
    return jnp.sum(table[place] * window, axis=1) / dt**derivative
