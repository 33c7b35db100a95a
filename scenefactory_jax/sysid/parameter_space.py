"""The parameters that are fitted: their ranges, a unit box in which the search moves, and the way into `CarParameters`."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core.instantiate import ConfigError, check_range
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.dynamics.articulated.randomization import with_values
from scenefactory_jax.sysid.manoeuvres import SURFACES

FRICTION = tuple(f"friction_{name}" for name in SURFACES)  # what the road has to give, not the car


class Space(NamedTuple):
    """P parameters and their ranges; `logarithmic` ones are searched by their logarithm."""

    names: tuple[str, ...]
    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    logarithmic: np.ndarray  # bool [P]
    start: Float[np.ndarray, " P"]  # where a search begins


def make(ranges: Mapping[str, Any]) -> Space:
    """From a config: name -> {range: [least, most], scale: linear or log, start: where a search begins}.

    Raises:
        ConfigError: a name that is neither a number of the car nor a surface's friction, a bad range, a logarithm of zero, or a start
            outside the range.
    """
    valid = [name for name in CarParameters.__dataclass_fields__ if name not in ("inertia", "wheel_inertia")]
    low, high, logarithmic, starts = [], [], [], []
    for name, entry in ranges.items():
        if name not in valid and name not in FRICTION:
            raise ConfigError(f"sysid.space.{name}: unknown parameter; valid: {', '.join((*valid, *FRICTION))}")
        if not isinstance(entry, Mapping) or set(entry) != {"range", "scale", "start"} or entry["scale"] not in ("linear", "log"):
            raise ConfigError(f"sysid.space.{name}: {entry}; write {{range: [least, most], scale: linear or log, start: a number}}")
        least, most = check_range(entry["range"], where=f"sysid.space.{name}", least=None)
        if not least < most or (entry["scale"] == "log" and least <= 0.0):
            raise ConfigError(f"sysid.space.{name}: [{least:g}, {most:g}] is no range to search")
        if not least <= entry["start"] <= most:
            raise ConfigError(f"sysid.space.{name}.start: {entry['start']}; it must be in [{least:g}, {most:g}]")
        low, high, logarithmic = [*low, least], [*high, most], [*logarithmic, entry["scale"] == "log"]
        starts.append(float(entry["start"]))
    return Space(tuple(ranges), np.array(low, float), np.array(high, float), np.array(logarithmic, bool), np.array(starts, float))


def unit(space: Space, values: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    """Values as places in the unit box; what lies outside its range lies outside the box."""
    low, high, values = (_log(space, np.asarray(x, float)) for x in (space.low, space.high, values))
    return (values - low) / (high - low)


def values(space: Space, places: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    """The inverse of `unit`."""
    low, high = _log(space, space.low), _log(space, space.high)
    found = low + np.asarray(places, float) * (high - low)
    return np.where(space.logarithmic, np.exp(np.where(space.logarithmic, found, 0.0)), found)


def _log(space: Space, x: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    return np.where(space.logarithmic, np.log(np.where(space.logarithmic, np.maximum(x, 1e-12), 1.0)), x)


def apply(
    space: Space, car: CarParameters, friction: Sequence[float], row: Float[Array, " P"]
) -> tuple[CarParameters, Float[Array, "3"]]:  # fmt: skip
    """One car with these values (scalar leaves), and the friction of each surface; what is not in the space stays."""
    chosen = {name: row[index] for index, name in enumerate(space.names)}
    numbers = {name: chosen.get(name, value) for name, value in vars(car).items()}
    road = [jnp.asarray(chosen.get(name, value), jnp.float32) for name, value in zip(FRICTION, friction, strict=True)]
    numbers = {name: [jnp.float32(x) for x in value] if isinstance(value, (list, tuple)) else jnp.asarray(value, jnp.float32)
               for name, value in numbers.items()}  # fmt: skip
    return with_values(car, numbers), jnp.stack(road)
