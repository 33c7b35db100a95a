"""Cars that differ: mass, size, torques, tyres and the rest drawn per agent at each reset, in one compiled model.

A `Fleet` carries `CarParameters` with an agent axis and what MuJoCo's compiler derives from them, as its `mj_setConst` does.
"""

import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from scenefactory_jax.core.instantiate import ConfigError, check_numbers, check_range
from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.core.types import Scene
from scenefactory_jax.dynamics.articulated import bounds, contact_solver, equations_of_motion
from scenefactory_jax.dynamics.articulated import parameters as cars
from scenefactory_jax.dynamics.articulated import state as states
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.dynamics.articulated.vector import over_wheels


@pytree_dataclass
class CarConstants:
    """The cars of one world, every leaf with the agent axis first; or one car, without it."""

    car: CarParameters
    spin_weight: Float[Array, "*cars 4"]  # inverse inertia that a wheel's spin joint feels in the car's rest pose (dof_invweight0)
    wheel_weight: Float[Array, "*cars 4"]  # inverse mass that a force at a wheel's centre feels, mean over directions (body_invweight0)


def draw_cars(
    *,
    car: CarParameters,
    physics_dt: float,
    size: Literal["reference", "logged"],
    length_m: list[float],
    width_m: list[float],
    scale: dict[str, list[float]],
) -> Callable[[PRNGKeyArray, Scene], CarParameters]:
    """(key, scene) -> parameters of every agent's car, drawn anew at each start.

    Args:
        car: the reference car.
        physics_dt: s, for which the softest, stiffest, lightest and most damped of the cars must be stable together.
        size: `logged` takes length and width from `scene.agents.size`; wheelbase and track keep their share of them. Masses, springs,
            dampers and torques grow with the footprint, so a larger car of the same shape accelerates and brakes like the reference.
        length_m, width_m: [least, most]; logged sizes beyond are cut.
        scale: name of a parameter -> [least, most] of a factor, drawn uniformly for each agent on its own. `mass` scales the chassis'
            inertia too.

    Raises:
        ConfigError: an unknown parameter, a bad range, or a spread that the integrator cannot carry, by name.
    """
    spans = {name: check_range(span, where=f"dynamics.fleet.{name}") for name, span in (("length_m", length_m), ("width_m", width_m))}
    check_numbers({name: span[0] for name, span in spans.items()}, where="dynamics.fleet", above=0.0)
    factors = {}
    for name, span in scale.items():
        if name not in vars(car):
            raise ConfigError(f"dynamics.fleet.scale.{name}: unknown parameter; valid: {', '.join(vars(car))}")
        factors[name] = check_range(span, where=f"dynamics.fleet.scale.{name}")
        for end in factors[name]:
            bounds.check(scale_parameters(car, {name: end}), where="dynamics.fleet.scale")
    hardest = find_worst(car, factors)
    cars.stable_limits(hardest, physics_dt=physics_dt, where="dynamics.fleet.scale")
    if size == "logged":
        for extreme in itertools.product(*spans.values()):
            cars.stable_limits(resize_car(hardest, np.array(extreme)), physics_dt=physics_dt, where=f"dynamics.fleet, size {extreme}")
    return functools.partial(draw_parameters, car=car, size_m=spans if size == "logged" else None, scale=factors)


def draw_parameters(
    key: PRNGKeyArray,
    scene: Scene,
    *,
    car: CarParameters,
    size_m: Mapping[str, tuple[float, float]] | None,
    scale: Mapping[str, tuple[float, float]],
) -> CarParameters:
    """Parameters with an agent axis: see `drawn`. Without `size_m` every car is as large as the reference."""
    count = scene.agents.yaw.shape[0]
    fleet = jax.tree.map(lambda leaf: jnp.full((count,), leaf, jnp.float32), car)
    if size_m is not None:
        least, most = zip(size_m["length_m"], size_m["width_m"], strict=True)
        fleet = resize_car(fleet, jnp.clip(scene.agents.size, jnp.asarray(least), jnp.asarray(most)))
    factors = {}
    for place, (name, (low, high)) in enumerate(scale.items()):
        factors[name] = jax.random.uniform(jax.random.fold_in(key, place), (count,), jnp.float32, low, high)
    return scale_parameters(fleet, factors)


def scale_parameters(car: CarParameters, factors: Mapping[str, Any]) -> CarParameters:
    """Parameters times factors; that of `mass` is the chassis' inertia's as well."""
    numbers = dict(vars(car))
    for name, factor in factors.items():
        for part in (name, "inertia") if name == "mass" else (name,):
            numbers[part] = jax.tree.map(lambda leaf, by=factor: leaf * by, numbers[part])
    return with_numbers(car, numbers)


def find_worst(car: CarParameters, scale: Mapping[str, tuple[float, float]]) -> CarParameters:
    """The car that is hardest to integrate: masses and what divides the slip's damping at their least, all else at its most."""
    least = ("mass", "inertia", "tyre_impedance")
    return scale_parameters(car, {name: span[0 if any(part in name for part in least) else 1] for name, span in scale.items()})


FORCES = (
    "mass", "inertia", "wheel_mass", "wheel_inertia", "wheel_damping", "carrier_mass", "carrier_inertia", "knuckle_mass", "knuckle_inertia",
    "suspension_stiffness", "suspension_damping", "stop_stiffness", "steering_stiffness", "steering_damping", "steering_torque",
    "steering_friction", "steering_inertia", "drive_torque", "brake_torque_front", "brake_torque_rear", "body_stiffness", "body_damping",
    "lateral_damping", "yaw_damping", "rolling_torque", "air_drag",
)  # fmt: skip


def resize_car(car: CarParameters, size: Float[Array | np.ndarray, "*cars 2"]) -> CarParameters:
    """The same car at another length and width: everything with a newton or a kilogram in it grows with the footprint.

    Inertia by the second moments of the mass along each axis, so that it stays one that a body can have.
    """
    longer, wider = size[..., 0] / car.length, size[..., 1] / car.width
    numbers = dict(vars(car))
    numbers |= {name: jax.tree.map(lambda leaf: leaf * longer * wider, numbers[name]) for name in FORCES}
    roll, pitch, yaw = numbers["inertia"]
    along, across, up = (pitch + yaw - roll) / 2 * longer**2, (yaw + roll - pitch) / 2 * wider**2, (roll + pitch - yaw) / 2
    numbers["inertia"] = type(car.inertia)((across + up, along + up, along + across))
    lengths = {name: numbers[name] * longer for name in ("length", "wheelbase", "mass_forward")}
    return with_numbers(car, numbers | lengths | {name: numbers[name] * wider for name in ("width", "track")})


def with_numbers(like: CarParameters, numbers: Mapping[str, Any]) -> CarParameters:
    """Built past `__init__`, whose annotations speak of plain numbers."""
    return jax.tree.unflatten(jax.tree.structure(like), jax.tree.leaves([numbers[name] for name in vars(like)]))


def derive_constants(car: CarParameters) -> CarConstants:
    """One car (scalar leaves) with its derived constants; `vmap` for many.

    M^-1 of the rest pose: the wheels' own joints eliminated, the inverse of the chassis' 6 x 6 that is left.
    """
    rest = states.from_mujoco(car, jnp.zeros(17).at[3].set(1.0), jnp.zeros(16))
    base, across, own = equations_of_motion.compute_mass_matrix(car, rest)
    shed = [[sum(row[k] * other[k] / own[k][k] for k in range(contact_solver.OWN)) for other in across] for row in across]
    left = [[base[i][j] - over_wheels(shed[i][j]) for j in range(contact_solver.BASE)] for i in range(contact_solver.BASE)]
    inverse = contact_solver.invert_arrow_matrix(jnp.stack([jnp.stack(row) for row in left]))
    zero, one, (x, y, h) = jnp.zeros(4), jnp.ones(4), rest.hub
    forward = jnp.stack([one, zero, zero, zero, h, -y], axis=-1)  # velocity of a wheel's centre along x, and along y
    aside = jnp.stack([zero, one, zero, -h, zero, x], axis=-1)
    along = jnp.stack([forward, aside])[..., :, None] * jnp.stack([forward, aside])[..., None, :]  # [2, wheels, 6, 6]
    flat = (along * inverse).sum((0, -2, -1))  # as sums: XLA's Triton has no kernel for so small a product in deterministic mode
    wheel = equations_of_motion.compute_unsprung(car)
    return CarConstants(car=car, spin_weight=1.0 / wheel.about + inverse[4, 4] * one, wheel_weight=(flat + 1.0 / wheel.mass) / 3)


def place_at_rest(fleet: CarConstants, *, physics_dt: float) -> tuple[Float[Array, ""], Float[Array, "4"]]:
    """Height of the box's centre and travel of the suspension, m, of a level car at rest.

    Springs: k q + k_stop (q - travel beyond the stop) = load less preload. Tyres: MuJoCo's contact carries a force N at a depth of
    N w (1 - d) tau^2 for constant impedance d, time constant tau and inverse mass w.
    """
    car = fleet.car
    rest = equations_of_motion.compute_loads(car) * (1.0 - car.suspension_preload)
    free = rest / car.suspension_stiffness
    beyond = (rest - car.suspension_stiffness * car.suspension_travel) / (car.suspension_stiffness + car.stop_stiffness)
    travel = jnp.where(free > car.suspension_travel, car.suspension_travel + beyond, free)
    constant = jnp.maximum(car.tyre_time_constant, 2 * physics_dt)
    depth = (
        (equations_of_motion.compute_loads(car) + equations_of_motion.compute_unsprung(car).mass * cars.GRAVITY)
        * fleet.wheel_weight
        * (1.0 - car.tyre_impedance)
        * constant**2
    )
    return (car.wheel_radius - car.wheel_height - depth - travel).mean(), travel
