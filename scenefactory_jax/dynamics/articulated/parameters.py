"""Parameters of the articulated car and of its solver, with their ranges.

Sources of the car's numbers: SceneFactory's vehicle (URDF and system identification), arXiv:2605.08528, Table 6.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from scenefactory_jax.core import schema
from scenefactory_jax.core.pytree import pytree
from scenefactory_jax.core.schema import Bounds, ConfigError, Count, NonNegative, Positive

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")  # the order of every array with a wheel axis
FRONT_WHEELS = WHEELS[:2]
AHEAD, LEFT = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1.0, -1.0, 1.0, -1.0])  # signs of the wheels' x and y
GRAVITY = 9.81  # m/s^2, MuJoCo's default
DRIVE_FADE_FRACTION = 0.1  # of the spin limit, over which the drive torque falls to zero


Finite = Annotated[float, Bounds()]
OpenFraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Angle = Annotated[float, Bounds(min=0.0, below=math.pi / 2)]
Moments = Annotated[list[float], Bounds(above=0.0)]


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class CarParameters:
    """Parameters of one car (plain numbers), or of several cars (arrays with an agent axis, made by `randomization`)."""

    length: Positive  # chassis box, m
    width: Positive  # chassis box, m
    height: Positive  # chassis box, m
    mass: Positive  # chassis, kg
    inertia: Moments  # chassis about its centre of mass: roll, pitch, yaw, kg m^2
    mass_forward: Finite  # chassis centre of mass, forward of the box's centre, m
    mass_height: Finite  # chassis centre of mass, above the box's centre, m
    wheelbase: Positive  # m
    track: Positive  # between the wheel centres, m
    wheel_height: Finite  # wheel centres above the box's centre at mid travel, m
    wheel_radius: Positive  # m
    wheel_width: Positive  # m
    wheel_mass: Positive  # spinning part, kg
    wheel_inertia: Moments  # spinning part: about and across the spin axis, kg m^2
    wheel_damping: NonNegative  # viscous drag of a wheel bearing, N m s/rad
    rolling_torque: NonNegative  # rolling resistance of a wheel (coefficient x load x radius), N m
    carrier_mass: NonNegative  # part of a wheel that does not spin, kg
    carrier_inertia: NonNegative  # the same part, about any axis, kg m^2
    knuckle_mass: NonNegative  # steering knuckle, front only, kg
    knuckle_inertia: NonNegative  # steering knuckle, kg m^2
    suspension_stiffness: Positive  # per corner, N/m
    suspension_damping: NonNegative  # per corner, N s/m
    suspension_preload: NonNegative  # fraction of the corner load that the spring carries at mid travel
    suspension_travel: NonNegative  # from mid travel to either stop, m
    stop_stiffness: NonNegative  # bump stops beyond the travel, N/m
    steering_limit: Angle  # rad
    steering_stiffness: NonNegative  # steering servo, N m/rad
    steering_damping: NonNegative  # steering servo, N m s/rad
    steering_torque: NonNegative  # largest torque of the steering servo, N m
    steering_friction: NonNegative  # viscous, steering joint, N m s/rad
    steering_inertia: NonNegative  # steering wheel, rack and motor, reduced to a front wheel's joint, kg m^2
    drive_torque: NonNegative  # per front wheel at full throttle and low speed, N m
    drive_power: NonNegative  # of the engine, W
    spin_limit: Positive  # rad/s; the drive torque falls to zero over the last 10 %
    reverse_spin_limit: Positive  # rad/s, of the reverse gear
    reverse_speed: NonNegative  # m/s forward, below which the reverse gear engages
    brake_torque_front: NonNegative  # per front wheel at full brake, N m
    brake_torque_rear: NonNegative  # per rear wheel at full brake, N m
    abs_slip: OpenFraction  # slip that the anti-lock controller holds at most
    abs_speed: NonNegative  # m/s of a wheel's centre, above which it acts
    body_stiffness: NonNegative  # chassis corner on the ground (roll-over), N/m
    body_damping: NonNegative  # chassis corner on the ground, N s/m
    body_friction: NonNegative  # chassis corner on the ground, Coulomb coefficient
    lateral_damping: NonNegative  # force against the chassis' lateral speed, N s/m
    yaw_damping: NonNegative  # torque against the chassis' yaw rate, N m s/rad
    air_drag: NonNegative  # force over speed squared: 1/2 density x drag area, N s^2/m^2
    tyre_time_constant: Positive  # solref of the ground contact, s
    tyre_impedance: OpenFraction  # solimp of the ground contact: at 0.5 the tyre sinks in 2 cm under its load, at 0.95 it is rigid
    tyre_slip_stiffness: Positive  # slip stiffness over load, per rad of slip angle or unit of slip
    tyre_relaxation_length: Positive  # m
    tyre_shape: Annotated[float, Bounds(above=1.0, below=2.0)]  # shape factor of the magic formula
    tyre_stiffness_fall: NonNegative  # relative fall of the slip stiffness over load at twice the nominal load
    tyre_peak_fall: NonNegative  # the same of the friction coefficient
    tyre_sliding_fraction: Annotated[float, Bounds(above=0.0, max=1.0)]  # friction at a high sliding speed over the peak
    tyre_sliding_speed: Positive  # m/s, over which sliding friction falls


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solver:
    """Settings of the contact solver."""

    algorithm: Literal["closed_form", "newton"]  # `contact_solver`, or `mjx.step` with MJX's Newton (`mjx_backend`)
    integrator: Literal["Euler", "implicitfast"]
    iterations: Count
    line_search: Count  # iterations; `newton` only
    tolerance: NonNegative  # `newton` only


def read_parameters(entry: Mapping[str, Any]) -> tuple[CarParameters, Solver]:
    """Reads the car and the solver of a `dynamics` config.

    Raises:
        ConfigError: an unknown, missing or out-of-range number, by name.
    """
    car = schema.read(entry["car"], CarParameters, where="dynamics.car")
    solver = schema.read(entry["solver"], Solver, where="dynamics.solver")
    for name, axes in {"inertia": (0, 1, 2), "wheel_inertia": (0, 1, 1)}.items():  # a wheel is a body of revolution
        _check_moments(list(getattr(car, name)), axes, where=f"dynamics.car.{name}")
    return car, solver


def _check_moments(moments: list[float], axes: tuple[int, ...], *, where: str) -> None:
    """Checks that no moment of inertia is larger than the sum of the other two."""
    if len(moments) != max(axes) + 1:
        raise ConfigError(f"{where}: expected {max(axes) + 1} moments, got {moments}")
    three = [moments[axis] for axis in axes]
    if 2.0 * max(three) > sum(three) * (1.0 + 1e-9):
        raise ConfigError(f"{where}: expected no moment above the sum of the other two, got {moments}")


def check_stability(car: CarParameters, *, physics_dt: float, where: str) -> None:
    """Checks that the explicit integrator is stable for the car's springs and dampers.

    Semi-implicit Euler with an explicit damper is stable for a mass m on a spring k and damper c if k dt^2 / m + 2 c dt / m < 4. The tyres
    of a car at rest are springs of `tyre_slip_stiffness` x load / `tyre_relaxation_length`. Their force is that of the deflection one step
    ahead, which adds a damper of k dt. A push from the side moves and rolls the chassis.

    Raises:
        ConfigError: naming `where`, the spring, the sum and the bound.
    """
    weight = car.mass + 4 * (car.wheel_mass + car.carrier_mass) + 2 * car.knuckle_mass
    tread = car.tyre_slip_stiffness * weight * GRAVITY / car.tyre_relaxation_length
    height = car.wheel_radius - car.wheel_height + car.mass_height
    rolled = 1.0 / (1.0 / weight + height**2 / car.inertia[0])
    steering_inertia = car.wheel_inertia[1] + car.carrier_inertia + car.knuckle_inertia + car.steering_inertia
    suspension = car.suspension_stiffness + car.stop_stiffness
    springs = {  # name: mass, stiffness, damping
        "suspension and stop": (car.wheel_mass + car.carrier_mass, suspension, car.suspension_damping),
        "steering": (steering_inertia, car.steering_stiffness, car.steering_damping + car.steering_friction),
        "wheel bearing": (car.wheel_inertia[0], 0.0, car.wheel_damping),
        "lateral damping": (car.mass, 0.0, car.lateral_damping),
        "yaw damping": (car.inertia[2], 0.0, car.yaw_damping),
        "tyres' slip stiffness over relaxation length": (rolled, tread, tread * physics_dt),
        "body on the ground": (compute_effective_corner_mass(car), car.body_stiffness, car.body_damping),
    }
    for name, (mass, stiffness, damping) in springs.items():
        load = (stiffness * physics_dt + 2 * damping) * physics_dt / mass
        if load >= 4.0:
            raise ConfigError(
                f"{where}: the {name} cannot be integrated: (k dt + 2 c) dt / m: expected below 4, got {load:.2f} at physics_dt "
                f"{physics_dt:.5f}"
            )


def compute_effective_corner_mass(car: CarParameters) -> float:
    """Computes the mass that a vertical force on a corner of the chassis accelerates, rotation included, kg."""
    roll, pitch, _ = car.inertia
    return 1.0 / (1.0 / car.mass + (car.width / 2) ** 2 / roll + (car.length / 2) ** 2 / pitch)
