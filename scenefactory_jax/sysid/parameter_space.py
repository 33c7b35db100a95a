"""The fitted parameters: their ranges, the unit box of the search, and the conversion to `CarParameters`."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, check_range
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.dynamics.articulated.randomization import with_values
from scenefactory_jax.sysid.manoeuvres import SURFACES

FRICTION = tuple(f"friction_{name}" for name in SURFACES)  # parameters of the road, not of the car


class Space(NamedTuple):
    """P parameters and their ranges; `logarithmic` ones are searched by their logarithm."""

    names: tuple[str, ...]
    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    logarithmic: np.ndarray  # bool [P]
    start: Float[np.ndarray, " P"]  # of the search


@dataclasses.dataclass(frozen=True)
class SearchRange:
    """An entry of `sysid.space`."""

    range: list[float]  # [min, max]
    scale: Literal["linear", "log"]
    start: float

    def __post_init__(self) -> None:
        low, high = check_range(self.range, where="range", least=None)
        if low == high or (self.scale == "log" and low <= 0.0):
            raise ConfigError(f"range: expected [min, max] with min < max, and min > 0 with scale log, got {self.range}")
        if not low <= self.start <= high:
            raise ConfigError(f"start: expected a number in {self.range}, got {self.start:g}")


def make(ranges: Mapping[str, Any], *, where: str = "sysid.space") -> Space:
    """Makes the space of a config: name -> `SearchRange`.

    Raises:
        ConfigError: a name that is neither a number of the car nor a surface's friction, or a bad range, scale or start.
    """
    valid = [*(name for name in CarParameters.__dataclass_fields__ if name not in ("inertia", "wheel_inertia")), *FRICTION]
    schema.check_names(ranges, valid, where=where, required=[])
    entries = [schema.read(entry, SearchRange, where=f"{where}.{name}") for name, entry in ranges.items()]
    low, high, start = np.array([(*entry.range, entry.start) for entry in entries], float).reshape(-1, 3).T
    return Space(tuple(ranges), low, high, np.array([entry.scale == "log" for entry in entries], bool), start)


def to_unit_box(space: Space, values: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    """Scales values to the unit box; values outside of their range are outside of the box."""
    low, high, values = (_take_log(space, np.asarray(x, float)) for x in (space.low, space.high, values))
    return (values - low) / (high - low)


def from_unit_box(space: Space, points: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    """Computes the inverse of `to_unit_box`."""
    low, high = _take_log(space, space.low), _take_log(space, space.high)
    values = low + np.asarray(points, float) * (high - low)
    return np.where(space.logarithmic, np.exp(np.where(space.logarithmic, values, 0.0)), values)


def _take_log(space: Space, x: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n P"]:
    return np.where(space.logarithmic, np.log(np.where(space.logarithmic, np.maximum(x, 1e-12), 1.0)), x)


def set_parameters(
    space: Space, car: CarParameters, friction: Sequence[float], row: Float[Array, " P"]
) -> tuple[CarParameters, Float[Array, "3"]]:
    """Computes a car with these values (scalar leaves) and the friction of each surface; parameters outside of the space stay."""
    fitted = {name: row[index] for index, name in enumerate(space.names)}
    values = {
        name: [jnp.float32(x) for x in value] if isinstance(value, (list, tuple)) else jnp.asarray(fitted.get(name, value), jnp.float32)
        for name, value in vars(car).items()
    }
    road = [jnp.asarray(fitted.get(name, value), jnp.float32) for name, value in zip(FRICTION, friction, strict=True)]
    return with_values(car, values), jnp.stack(road)
