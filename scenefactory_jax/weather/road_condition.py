"""Samples the road condition of an episode at reset: the open road, patches on it, and rain.

Each part is an entry of the `weather` config: `sampler` (key, scene) -> Weather, every entry of `patches` (key, scene, weather) -> Patches,
and `rain` (key, weather) -> Rain.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError, check_numbers, instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.types import SURFACES, Scene, Weather
from scenefactory_jax.weather.friction import make_uniform
from scenefactory_jax.weather.patches import join_patches
from scenefactory_jax.weather.rain import advance_rain


def make(config: Mapping[str, Any]) -> Callable[[PRNGKeyArray, Scene], Weather]:
    """Makes the function (key, scene) -> Weather of a `weather` config.

    Args:
        config: `sampler`; `patches`, name -> entry or null; `rain`, an entry or null. `friction` belongs to the dynamics.

    Raises:
        ConfigError: naming the entry and key that does not fit; numbers out of range are found by the first sample.
    """
    keys = ("sampler", "patches", "rain", "friction")
    if unknown := [key for key in config if key not in keys]:
        raise ConfigError(f"weather.{unknown[0]}: unknown key; weather has: {', '.join(keys)}")
    if "sampler" not in config:
        raise ConfigError("weather.sampler: missing; weather needs sampler and friction")
    entries, course = config.get("patches") or {}, config.get("rain")
    if not isinstance(entries, Mapping):
        raise ConfigError(f"weather.patches: expected a mapping, got {entries!r}")
    road = instantiate(config["sampler"], builtins=__name__, where="weather.sampler")
    builders = {
        f"weather.patches.{name}": instantiate(entry, builtins="scenefactory_jax.weather.patch_layouts", where=f"weather.patches.{name}")
        for name, entry in entries.items()
        if entry is not None
    }
    rain = None if course is None else instantiate(course, builtins="scenefactory_jax.weather.rain", where="weather.rain")
    if not builders and rain is None:
        return road

    def sample_weather(key: PRNGKeyArray, scene: Scene) -> Weather:
        road_key, rain_key, *keys = jax.random.split(key, 2 + len(builders))
        weather = road(road_key, scene)
        sampled = [_call(where, make, key, scene, weather) for key, (where, make) in zip(keys, builders.items(), strict=True)]
        weather = replace(weather, patches=join_patches([weather.patches, *sampled]))
        if rain is None:
            return weather
        return advance_rain(replace(weather, rain=_call("weather.rain", rain, rain_key, weather)), dt=0.0)

    return sample_weather


def _call(where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a part and prefixes its error messages with its place in the config."""
    try:
        return function(*arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A road condition and its relative weight."""

    surface: str
    film_mm: float
    weight: float


def sample_condition(key: PRNGKeyArray, scene: Scene, *, cases: list[dict[str, Any]]) -> Weather:
    """Samples a road condition from `cases` with probability proportional to their weights.

    Raises:
        ConfigError: no case, an unknown surface, a film or weight below 0 or not finite, or no positive weight.
    """
    chosen = _read_cases(cases)
    weights = jnp.asarray([case.weight for case in chosen], jnp.float32)
    index = jax.random.choice(key, len(chosen), p=weights / weights.sum())
    film = jnp.asarray([case.film_mm for case in chosen], jnp.float32)
    surface = jnp.asarray([SURFACES.index(case.surface) for case in chosen], jnp.int32)
    return make_uniform(film[index], surface[index])


def _read_cases(cases: Sequence[Mapping[str, Any]]) -> list[Case]:
    make: Callable[..., Case]
    chosen = []
    for i, numbers in enumerate(cases):
        where = f"weather.sampler.cases[{i}]"
        make = instantiate({**numbers, "_target_": "Case"}, builtins=__name__, where=where)
        case = make()
        if case.surface not in SURFACES:
            raise ConfigError(f"{where}.surface: {case.surface!r}; valid: {', '.join(SURFACES)}")
        check_numbers({"film_mm": case.film_mm, "weight": case.weight}, where=where, least=0.0)
        chosen.append(case)
    if sum(case.weight for case in chosen) <= 0:
        raise ConfigError("weather.sampler.cases: no case with a positive weight")
    return chosen


def keep_condition(key: PRNGKeyArray, scene: Scene) -> Weather:
    """Returns the scene's road condition, as packed."""
    return scene.weather
