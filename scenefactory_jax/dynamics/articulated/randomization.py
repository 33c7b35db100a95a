"""Random car parameters: mass, size, torques, tyres and others, drawn per agent at each reset, in one compiled model."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core import schema
from scenefactory_jax.core.instantiate import ConfigError, check_numbers, check_range
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated.parameters import CarParameters, check_stability

WHERE = "dynamics.randomization"
SCALE_WITH_FOOTPRINT = (  # every parameter with a newton, a kilogram or a watt in its unit
    "mass", "inertia", "wheel_mass", "wheel_inertia", "wheel_damping", "carrier_mass", "carrier_inertia", "knuckle_mass", "knuckle_inertia",
    "suspension_stiffness", "suspension_damping", "stop_stiffness", "steering_stiffness", "steering_damping", "steering_torque",
    "steering_friction", "steering_inertia", "drive_torque", "drive_power", "brake_torque_front", "brake_torque_rear", "body_stiffness",
    "body_damping", "lateral_damping", "yaw_damping", "rolling_torque", "air_drag",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class LongVehicles:
    """Where vans, trucks and buses have their mass: higher and further back than cars."""

    from_m: Positive  # length
    mass_height_per_m: NonNegative  # rise of the chassis' centre of mass per length beyond `from_m`
    rear_load_per_m: NonNegative  # part of the chassis' weight that moves to the rear axle per length beyond `from_m`, 1/m


def car_parameter_sampler(
    *,
    car: CarParameters,
    physics_dt: float,
    size: Literal["reference", "logged"],
    length_m: list[float],
    width_m: list[float],
    long_vehicles: LongVehicles,
    scale: dict[str, list[float]],
) -> Callable[[PRNGKeyArray, Scene], CarParameters]:
    """Makes the sampler (key, scene) -> parameters of every agent's car, called at each start.

    Args:
        car: the reference car.
        physics_dt: s; the stiffest combination of all ranges must be stable with it.
        size: `logged` takes length and width from `scene.agents.size`. Wheelbase and track scale with them. Masses, springs, dampers and
            torques scale with the footprint: a larger car of the same shape accelerates and brakes like the reference.
        length_m, width_m: [min, max]; logged sizes are clipped to it.
        long_vehicles: see `LongVehicles`.
        scale: parameter -> [min, max] of a factor, uniform and independent per agent. `mass` scales the chassis inertia, too.

    Raises:
        ConfigError: an unknown parameter, a bad range, or a range that the integrator cannot carry, by name.
    """
    spans = {name: check_range(span, where=f"{WHERE}.{name}") for name, span in (("length_m", length_m), ("width_m", width_m))}
    check_numbers({name: span[0] for name, span in spans.items()}, where=WHERE, above=0.0)
    rear = 0.5 + long_vehicles.rear_load_per_m * max(spans["length_m"][1] - long_vehicles.from_m, 0.0)
    if rear >= 1.0:
        raise ConfigError(
            f"{WHERE}.long_vehicles.rear_load_per_m: expected a rear axle load below 1 of the weight, got {rear:.2f} at "
            f"{spans['length_m'][1]:g} m"
        )
    factors = {}
    for name, span in scale.items():
        if name not in vars(car):
            raise ConfigError(f"{WHERE}.scale.{name}: unknown parameter; valid: {', '.join(vars(car))}")
        factors[name] = check_range(span, where=f"{WHERE}.scale.{name}")
        for end in factors[name]:
            schema.check(vars(scale_parameters(car, {name: end})), CarParameters, where=f"{WHERE}.scale")
    stiffest = find_stiffest(car, factors)
    check_stability(stiffest, physics_dt=physics_dt, where=f"{WHERE}.scale")
    if size == "logged":
        for extreme in itertools.product(*spans.values()):
            check_stability(resize_car(stiffest, np.array(extreme), long_vehicles), physics_dt=physics_dt, where=f"{WHERE}, size {extreme}")
    sizes = spans if size == "logged" else None
    return functools.partial(sample_car_parameters, car=car, size_m=sizes, long_vehicles=long_vehicles, scale=factors)


def sample_car_parameters(
    key: PRNGKeyArray,
    scene: Scene,
    *,
    car: CarParameters,
    size_m: Mapping[str, tuple[float, float]] | None,
    long_vehicles: LongVehicles,
    scale: Mapping[str, tuple[float, float]],
) -> CarParameters:
    """Samples parameters with an agent axis: see `car_parameter_sampler`. Without `size_m` every car has the reference size."""
    count = scene.agents.yaw.shape[0]
    cars = jax.tree.map(lambda leaf: jnp.full((count,), leaf, jnp.float32), car)
    if size_m is not None:
        low, high = zip(size_m["length_m"], size_m["width_m"], strict=True)
        cars = resize_car(cars, jnp.clip(scene.agents.size, jnp.asarray(low), jnp.asarray(high)), long_vehicles)
    factors = {}
    for index, (name, (low, high)) in enumerate(scale.items()):
        factors[name] = jax.random.uniform(jax.random.fold_in(key, index), (count,), jnp.float32, low, high)
    return scale_parameters(cars, factors)


def scale_parameters(car: CarParameters, factors: Mapping[str, Any]) -> CarParameters:
    """Multiplies parameters by factors; that of `mass` applies to the chassis inertia as well."""
    values = dict(vars(car))
    for name, factor in factors.items():
        for part in (name, "inertia") if name == "mass" else (name,):
            values[part] = jax.tree.map(lambda leaf, by=factor: leaf * by, values[part])
    return with_values(car, values)


def find_stiffest(car: CarParameters, scale: Mapping[str, tuple[float, float]]) -> CarParameters:
    """Computes the car that is hardest to integrate: masses and the tyres' lengths at their minimum, all else at its maximum."""
    low = ("mass", "inertia", "tyre_impedance", "tyre_relaxation_length")
    return scale_parameters(car, {name: span[0 if any(part in name for part in low) else 1] for name, span in scale.items()})


def resize_car(car: CarParameters, size: Float[Array | np.ndarray, "*cars 2"], long_vehicles: LongVehicles) -> CarParameters:
    """Scales a car to another length and width; the inertia by the second moments of the mass along each axis."""
    numbers = jnp if isinstance(size, Array) else np
    longer, wider = size[..., 0] / car.length, size[..., 1] / car.width
    values = dict(vars(car))
    values |= {name: jax.tree.map(lambda leaf: leaf * longer * wider, values[name]) for name in SCALE_WITH_FOOTPRINT}
    roll, pitch, yaw = values["inertia"]
    along, across, up = (pitch + yaw - roll) / 2 * longer**2, (yaw + roll - pitch) / 2 * wider**2, (roll + pitch - yaw) / 2
    values["inertia"] = type(car.inertia)((across + up, along + up, along + across))
    beyond = numbers.maximum(size[..., 0] - long_vehicles.from_m, 0.0)
    lengths = {name: values[name] * longer for name in ("length", "wheelbase", "mass_forward")}
    lengths["mass_forward"] = lengths["mass_forward"] - long_vehicles.rear_load_per_m * beyond * lengths["wheelbase"]
    lengths["mass_height"] = values["mass_height"] + long_vehicles.mass_height_per_m * beyond
    return with_values(car, values | lengths | {name: values[name] * wider for name in ("width", "track")})


def with_values(car: CarParameters, values: Mapping[str, Any]) -> CarParameters:
    """Builds parameters whose values may be arrays: past `__init__`, whose annotations require numbers."""
    return jax.tree.unflatten(jax.tree.structure(car), jax.tree.leaves([values[name] for name in vars(car)]))
