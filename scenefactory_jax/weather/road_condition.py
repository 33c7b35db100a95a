"""Samples the road condition of an episode at reset: the open road, patches on it, and rain.

Each part is an entry of the `weather` config: `sampler` (key, scene) -> Weather, every entry of `patches` (key, scene, weather) -> Patches,
and `rain` (key, weather) -> Rain.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import instantiate
from scenefactory_jax.core.pytree import replace
from scenefactory_jax.core.random_index import draw_index
from scenefactory_jax.core.schema import ConfigError, NonNegative
from scenefactory_jax.core.types import SURFACES, Scene, SurfaceName, Weather
from scenefactory_jax.weather.friction import make_uniform
from scenefactory_jax.weather.patches import join_patches
from scenefactory_jax.weather.rain import advance_rain


@dataclasses.dataclass(frozen=True)
class WeatherConfig:
    """Entries of a `weather` config; null leaves a part out."""

    sampler: Mapping[str, Any]
    patches: Mapping[str, Mapping[str, Any] | None] | None = None
    rain: Mapping[str, Any] | None = None
    friction: Mapping[str, Any] | None = None  # of the dynamics
    hidden: bool = False  # observations read a dry road, whatever it is like


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A road condition and its relative weight."""

    surface: SurfaceName
    film_mm: NonNegative
    weight: NonNegative


def make(config: Mapping[str, Any]) -> Callable[[PRNGKeyArray, Scene], Weather]:
    """Makes the function (key, scene) -> Weather of a `weather` config.

    Raises:
        ConfigError: naming the entry and key that does not fit.
    """
    read = schema.read(config, WeatherConfig, where="weather")
    sample_road = instantiate(read.sampler, builtins=__name__, where="weather.sampler")
    layouts = [
        instantiate(entry, builtins="scenefactory_jax.weather.patch_layouts", where=f"weather.patches.{name}")
        for name, entry in (read.patches or {}).items()
        if entry is not None
    ]
    sample_rain = instantiate(read.rain, builtins="scenefactory_jax.weather.rain", where="weather.rain") if read.rain else None
    if not layouts and sample_rain is None:
        return sample_road

    def sample_weather(key: PRNGKeyArray, scene: Scene) -> Weather:
        road_key, rain_key, *keys = jax.random.split(key, 2 + len(layouts))
        weather = sample_road(road_key, scene)
        patches = [layout(key, scene, weather) for key, layout in zip(keys, layouts, strict=True)]
        weather = replace(weather, patches=join_patches([weather.patches, *patches]))
        if sample_rain is None:
            return weather
        return advance_rain(replace(weather, rain=sample_rain(rain_key, weather)), dt=0.0)

    return sample_weather


def sample_condition(key: PRNGKeyArray, scene: Scene, *, cases: list[Case]) -> Weather:
    """Samples a road condition from `cases` with probability proportional to their weights."""
    if sum(case.weight for case in cases) <= 0:
        raise ConfigError("weather.sampler.cases: expected a case with a positive weight, got none")
    weights = jnp.asarray([case.weight for case in cases], jnp.float32)
    index = draw_index(key, weights / weights.sum())
    film = jnp.asarray([case.film_mm for case in cases], jnp.float32)
    surface = jnp.asarray([SURFACES.index(case.surface) for case in cases], jnp.int32)
    return make_uniform(film[index], surface[index])


def make_dry() -> Weather:
    """Makes the weather that observations read with `weather.hidden`: dry asphalt concrete without patches."""
    return make_uniform(jnp.float32(0.0), jnp.int32(SURFACES.index("AC")))


def keep_condition(key: PRNGKeyArray, scene: Scene) -> Weather:
    """Returns the scene's road condition, as packed."""
    return scene.weather
