"""The road condition of an episode, drawn at reset: first the open road's, then patches on it, then its course over time.

Each part is an entry of the `weather` config and a pure function of its key: `draw` (key, scene) -> Weather, every entry of `patches`
(key, scene, weather) -> Patches, and `rain` (key, weather) -> Rain.
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
    """A `weather` config -> the function that draws an episode's weather.

    Args:
        config: `draw`; `patches`, name -> entry, of which those that are null are left out; `rain`, an entry or null. `grip` is the
            dynamics' business.

    Raises:
        ConfigError: naming the entry and key that does not fit; numbers out of range are named by the first draw.
    """
    keys = ("draw", "patches", "rain", "grip")
    if unknown := [key for key in config if key not in keys]:
        raise ConfigError(f"weather.{unknown[0]}: unknown key; weather has: {', '.join(keys)}")
    if "draw" not in config:
        raise ConfigError("weather.draw: missing; weather needs draw and grip")
    entries, course = config.get("patches") or {}, config.get("rain")
    if not isinstance(entries, Mapping):
        raise ConfigError(f"weather.patches: {entries!r}; wanted is name -> entry")
    road = instantiate(config["draw"], builtins=__name__, where="weather.draw")
    builders = {
        f"weather.patches.{name}": instantiate(entry, builtins="scenefactory_jax.weather.patch_layouts", where=f"weather.patches.{name}")
        for name, entry in entries.items()
        if entry is not None
    }
    rain = None if course is None else instantiate(course, builtins="scenefactory_jax.weather.rain", where="weather.rain")
    if not builders and rain is None:
        return road

    def episode(key: PRNGKeyArray, scene: Scene) -> Weather:
        road_key, rain_key, *keys = jax.random.split(key, 2 + len(builders))
        weather = road(road_key, scene)
        built = [_named(where, make, key, scene, weather) for key, (where, make) in zip(keys, builders.items(), strict=True)]
        weather = replace(weather, patches=join_patches([weather.patches, *built]))
        if rain is None:
            return weather
        return advance_rain(replace(weather, rain=_named("weather.rain", rain, rain_key, weather)), dt=0.0)

    return episode


def _named(where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a part that does not know what its entry is called, for its messages."""
    try:
        return function(*arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One road condition that may be drawn, and how often relative to the others."""

    surface: str
    film_mm: float
    weight: float


def sample_condition(key: PRNGKeyArray, scene: Scene, *, cases: list[dict[str, Any]]) -> Weather:
    """A road condition for one episode, drawn from `cases` with probability proportional to their weights.

    Raises:
        ConfigError: no case, an unknown surface, a film or weight below 0 or not finite, or no positive weight.
    """
    chosen = _cases(cases)
    weights = jnp.asarray([case.weight for case in chosen], jnp.float32)
    index = jax.random.choice(key, len(chosen), p=weights / weights.sum())
    film = jnp.asarray([case.film_mm for case in chosen], jnp.float32)
    surface = jnp.asarray([SURFACES.index(case.surface) for case in chosen], jnp.int32)
    return make_uniform(film[index], surface[index])


def _cases(cases: Sequence[Mapping[str, Any]]) -> list[Case]:
    make: Callable[..., Case]
    chosen = []
    for i, numbers in enumerate(cases):
        where = f"weather.draw.cases[{i}]"
        make = instantiate({**numbers, "_target_": "Case"}, builtins=__name__, where=where)
        case = make()
        if case.surface not in SURFACES:
            raise ConfigError(f"{where}.surface: {case.surface!r}; valid: {', '.join(SURFACES)}")
        check_numbers({"film_mm": case.film_mm, "weight": case.weight}, where=where, least=0.0)
        chosen.append(case)
    if sum(case.weight for case in chosen) <= 0:
        raise ConfigError("weather.draw.cases: no case with a positive weight")
    return chosen


def keep_condition(key: PRNGKeyArray, scene: Scene) -> Weather:
    """The scene's own road condition, as it was packed."""
    return scene.weather
