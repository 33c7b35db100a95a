"""Rain: the open road's water film over an episode.

`weather.rain` names a function (key, weather) -> Rain; it gets the sampled weather, so the film can start from there. Films are linear
between knots.
"""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError, check_range
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Rain, Weather

SPAN = 5.0  # time constants covered by the knots: 99.3 % of the change


def advance_rain(weather: Weather, *, dt: float | Float[Array, ""]) -> Weather:
    """Computes the weather `dt` seconds later; without knots the film is constant."""
    rain = replace(weather.rain, now_s=weather.rain.now_s + dt)
    film_mm = jnp.interp(rain.now_s, rain.time_s, rain.film_mm) if rain.time_s.shape[0] else weather.film_mm
    return replace(weather, film_mm=film_mm, rain=rain)


def schedule(key: PRNGKeyArray, weather: Weather, *, time_s: list[float], film_mm: list[float]) -> Rain:
    """Makes the same film schedule in every episode, instead of the sampled film.

    Args:
        time_s: knots, ascending, s since the start of the episode.
        film_mm: film at the knots.

    Raises:
        ConfigError: lists of different lengths, times that do not ascend, or a negative film.
    """
    if not time_s or len(time_s) != len(film_mm):
        raise ConfigError(f"film_mm: expected one film per time and at least one, got {len(film_mm)} films for {len(time_s)} times")
    if any(after <= before for before, after in itertools.pairwise(time_s)):
        raise ConfigError(f"time_s: expected ascending times, got {time_s}")
    if min(film_mm) < 0:
        raise ConfigError(f"film_mm: expected numbers >= 0, got {film_mm}")
    return _make_rain(jnp.asarray(time_s, jnp.float32), jnp.asarray(film_mm, jnp.float32))


def onset(
    key: PRNGKeyArray,
    weather: Weather,
    *,
    start_s: list[float],
    rain_mm_h: list[float],
    film_per_rain: float,
    film_max_mm: float,
    tau_s: list[float],
    knots: int,
) -> Rain:
    """Samples the start of rain: from there on the film relaxes to the balance of rain and drainage.

    h' = (min(rain film_per_rain, film_max) - h) / tau. Ranges are [min, max].

    Args:
        start_s: range of the start.
        rain_mm_h: range of the intensity.
        film_per_rain: balance film, mm per mm/h.
        film_max_mm: largest balance film.
        tau_s: range of the time constant.
        knots: of the film; 16 give the exponential within 0.2 % of its change.

    Raises:
        ConfigError: a number out of range, by name.
    """
    for name, number in (("film_per_rain", film_per_rain), ("film_max_mm", film_max_mm)):
        if number < 0:
            raise ConfigError(f"{name}: expected a number >= 0, got {number}")
    start_key, rain_key, tau_key = jax.random.split(key, 3)
    balance = jnp.minimum(_uniform(rain_key, rain_mm_h, name="rain_mm_h") * film_per_rain, film_max_mm)
    time_s, film_mm = _relax(weather.film_mm, balance, _uniform(tau_key, tau_s, name="tau_s"), knots=knots)
    return _make_rain(_uniform(start_key, start_s, name="start_s") + time_s, film_mm)


def drying(key: PRNGKeyArray, weather: Weather, *, tau_s: list[float], knots: int) -> Rain:
    """Samples an exponential decay of the film from the start.

    Args:
        tau_s: range of the time constant, [min, max].
        knots: of the film.

    Raises:
        ConfigError: a number out of range, by name.
    """
    return _make_rain(*_relax(weather.film_mm, jnp.float32(0.0), _uniform(key, tau_s, name="tau_s"), knots=knots))


def _relax(
    film_mm: Float[Array, ""], balance: Float[Array, ""], tau_s: Float[Array, ""], *, knots: int
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Computes knots of balance + (film - balance) exp(-t / tau), equidistant in exp(-t / 2 tau)."""
    if knots < 2:
        raise ConfigError(f"knots: expected an integer >= 2, got {knots}")
    half = 1.0 - jnp.linspace(0.0, 1.0, knots) * (1.0 - jnp.exp(-SPAN / 2))
    return -2.0 * tau_s * jnp.log(half), balance + (film_mm - balance) * half**2


def _make_rain(time_s: Float[Array, " K"], film_mm: Float[Array, " K"]) -> Rain:
    return Rain(now_s=jnp.float32(0.0), time_s=time_s, film_mm=film_mm)


def _uniform(key: PRNGKeyArray, span: Sequence[float | int], *, name: str) -> Float[Array, ""]:
    low, high = check_range(span, where=name)
    return jax.random.uniform(key, (), jnp.float32, low, high)
