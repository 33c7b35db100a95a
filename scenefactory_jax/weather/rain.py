"""The open road's water film over an episode: how it moves on, and the courses that an episode can draw.

A course is a function (key, weather) -> Rain, named by the entry `weather.rain`; the weather that it is given is the drawn one, so a course
can start from its film. Films between knots are linear.
"""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError, check_range
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import Rain, Weather

SPAN = 5.0  # time constants that knots cover: 0.7 % of the change is still to come then


def advance_rain(weather: Weather, *, dt: float | Float[Array, ""]) -> Weather:
    """The weather `dt` seconds later; without knots its film stays as it is."""
    rain = replace(weather.rain, now_s=weather.rain.now_s + dt)
    film_mm = jnp.interp(rain.now_s, rain.time_s, rain.film_mm) if rain.time_s.shape[0] else weather.film_mm
    return replace(weather, film_mm=film_mm, rain=rain)


def schedule(key: PRNGKeyArray, weather: Weather, *, time_s: list[float], film_mm: list[float]) -> Rain:
    """A given course, the same in every episode; it replaces the drawn film from the start.

    Args:
        time_s: knots, ascending, seconds since the episode began.
        film_mm: the film at each of them.

    Raises:
        ConfigError: lists of different lengths, times that do not ascend, or a negative film.
    """
    if not time_s or len(time_s) != len(film_mm):
        raise ConfigError(f"film_mm: {len(film_mm)} films for {len(time_s)} times; wanted is one for each, and at least one")
    if any(after <= before for before, after in itertools.pairwise(time_s)):
        raise ConfigError(f"time_s: {time_s}; wanted are ascending times")
    if min(film_mm) < 0:
        raise ConfigError(f"film_mm: {film_mm}; wanted is nothing below 0")
    return _course(jnp.asarray(time_s, jnp.float32), jnp.asarray(film_mm, jnp.float32))


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
    """Rain sets in: the film stays as drawn until then, and from there on relaxes towards what rain and drainage balance at.

    h' = (min(rain film_per_rain, film_max) - h) / tau. Ranges are [least, most].

    Args:
        start_s: range of the time at which it begins to rain.
        rain_mm_h: range of the intensity.
        film_per_rain: film in balance with rain, mm per mm/h.
        film_max_mm: deepest film in balance.
        tau_s: range of the time constant.
        knots: of the film's course; 16 follow the exponential within 0.2 % of its change.

    Raises:
        ConfigError: a number out of range, by name.
    """
    for name, number in (("film_per_rain", film_per_rain), ("film_max_mm", film_max_mm)):
        if number < 0:
            raise ConfigError(f"{name}: {number}; wanted is at least 0")
    begin, strength, pace = jax.random.split(key, 3)
    balance = jnp.minimum(_uniform(strength, rain_mm_h, name="rain_mm_h") * film_per_rain, film_max_mm)
    time_s, film_mm = _relax(weather.film_mm, balance, _uniform(pace, tau_s, name="tau_s"), knots=knots)
    return _course(_uniform(begin, start_s, name="start_s") + time_s, film_mm)


def drying(key: PRNGKeyArray, weather: Weather, *, tau_s: list[float], knots: int) -> Rain:
    """The road dries: the drawn film decays exponentially from the start.

    Args:
        tau_s: range of the time constant, [least, most].
        knots: of the film's course.

    Raises:
        ConfigError: a number out of range, by name.
    """
    return _course(*_relax(weather.film_mm, jnp.float32(0.0), _uniform(key, tau_s, name="tau_s"), knots=knots))


def _relax(
    film_mm: Float[Array, ""], balance: Float[Array, ""], tau_s: Float[Array, ""], *, knots: int
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Knots of balance + (film - balance) exp(-t / tau), equally far apart in exp(-t / 2 tau): where it bends more there are more."""
    if knots < 2:
        raise ConfigError(f"knots: {knots}; wanted are at least 2")
    half = 1.0 - jnp.linspace(0.0, 1.0, knots) * (1.0 - jnp.exp(-SPAN / 2))
    return -2.0 * tau_s * jnp.log(half), balance + (film_mm - balance) * half**2


def _course(time_s: Float[Array, " K"], film_mm: Float[Array, " K"]) -> Rain:
    return Rain(now_s=jnp.float32(0.0), time_s=time_s, film_mm=film_mm)


def _uniform(key: PRNGKeyArray, span: Sequence[float | int], *, name: str) -> Float[Array, ""]:
    low, high = check_range(span, where=name)
    return jax.random.uniform(key, (), jnp.float32, low, high)
