"""Rain: the open road's water film over an episode.

`weather.rain` names a function (key, weather) -> Rain; it gets the sampled weather, so the film can start from there. Films are linear
between knots.
"""

import itertools
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.schema import Bounds, ConfigError, NonNegative, Range
from scenefactory_jax.core.types import Rain, Weather

SPAN = 5.0  # time constants covered by the knots: 99.3 % of the change
Knots = Annotated[int, Bounds(min=2)]  # of the film; 16 give the exponential within 0.2 % of its change


def advance_rain(weather: Weather, *, dt: float | Float[Array, ""]) -> Weather:
    """Computes the weather `dt` seconds later; without knots the film is constant."""
    rain = replace(weather.rain, now_s=weather.rain.now_s + dt)
    return replace(weather, film_mm=_read_film(rain) if rain.time_s.shape[0] else weather.film_mm, rain=rain)


def _read_film(rain: Rain) -> Float[Array, ""]:
    """Reads the film between the knots; `jnp.interp` searches in a loop, whose steps are kernels of their own."""
    after = jnp.clip(jnp.sum(rain.time_s <= rain.now_s), 1, len(rain.time_s) - 1)
    start, end = rain.time_s[after - 1], rain.time_s[after]
    part = jnp.clip((rain.now_s - start) / jnp.maximum(end - start, 1e-9), 0.0, 1.0)
    return rain.film_mm[after - 1] + part * (rain.film_mm[after] - rain.film_mm[after - 1])


def schedule(key: PRNGKeyArray, weather: Weather, *, time_s: list[NonNegative], film_mm: list[NonNegative]) -> Rain:
    """Makes the same film schedule in every episode, instead of the sampled film.

    Args:
        time_s: knots, ascending, s since the start of the episode.
        film_mm: film at the knots.
    """
    if not time_s or len(time_s) != len(film_mm):
        raise ConfigError(f"weather.rain.film_mm: expected a film for each of {len(time_s)} times, got {len(film_mm)}")
    if any(after <= before for before, after in itertools.pairwise(time_s)):
        raise ConfigError(f"weather.rain.time_s: expected ascending times, got {time_s}")
    return _make_rain(jnp.asarray(time_s, jnp.float32), jnp.asarray(film_mm, jnp.float32))


def onset(
    key: PRNGKeyArray,
    weather: Weather,
    *,
    start_s: Range,
    rain_mm_h: Range,
    film_per_rain: NonNegative,
    film_max_mm: NonNegative,
    tau_s: Range,
    knots: Knots,
) -> Rain:
    """Samples the start of rain: from there on the film relaxes to the balance of rain and drainage.

    h' = (min(rain film_per_rain, film_max) - h) / tau.

    Args:
        start_s: range of the start.
        rain_mm_h: range of the intensity.
        film_per_rain: balance film, mm per mm/h.
        film_max_mm: largest balance film.
        tau_s: range of the time constant.
    """
    start_key, rain_key, tau_key = jax.random.split(key, 3)
    balance = jnp.minimum(_sample(rain_key, rain_mm_h) * film_per_rain, film_max_mm)
    time_s, film_mm = _relax(weather.film_mm, balance, _sample(tau_key, tau_s), knots)
    return _make_rain(_sample(start_key, start_s) + time_s, film_mm)


def drying(key: PRNGKeyArray, weather: Weather, *, tau_s: Range, knots: Knots) -> Rain:
    """Samples an exponential decay of the film from the start; `tau_s` is the range of the time constant."""
    return _make_rain(*_relax(weather.film_mm, jnp.float32(0.0), _sample(key, tau_s), knots))


def _relax(
    film_mm: Float[Array, ""], balance: Float[Array, ""], tau_s: Float[Array, ""], knots: int
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Computes knots of balance + (film - balance) exp(-t / tau), equidistant in exp(-t / 2 tau)."""
    half = 1.0 - jnp.linspace(0.0, 1.0, knots) * (1.0 - jnp.exp(-SPAN / 2))
    return -2.0 * tau_s * jnp.log(half), balance + (film_mm - balance) * half**2


def _make_rain(time_s: Float[Array, " K"], film_mm: Float[Array, " K"]) -> Rain:
    return Rain(now_s=jnp.float32(0.0), time_s=time_s, film_mm=film_mm)


def _sample(key: PRNGKeyArray, span: tuple[float, float]) -> Float[Array, ""]:
    return jax.random.uniform(key, (), jnp.float32, *span)
