"""The CommonRoad multi-body car (`vehicle_dynamics_mb`, Althoff and Wuersching 2020) with our car's masses, as rates of a state.

Source: M. Althoff, G. Wuersching, "CommonRoad: Vehicle Models" (2020), package commonroad-vehicle-models, BSD licence; the model is that
of the US DOT (R. W. Allen et al. 1992): sprung mass and two axles with compliant joints, Pacejka tyres with combined slip, 29 states.
Vehicle 2 is a BMW 320i. Its parameters here:

    mass, inertia, axles,              ours. p.m is the car, m_s the chassis, m_uf and m_ur an axle's wheels, carriers, knuckles;
    wheel radius and inertia           I_z is the car's: chassis and wheels
    K_sf, K_sdf, K_sr, K_sdr           x sprung mass on the axle: ride frequencies and damping ratios stay
    K_tsf, K_tsr                       x the same x track^2: so does the share of roll stiffness
    K_ras, K_rad                       x sprung mass
    K_zt                               x mass of the car: the tyres' static deflection stays
    K_lt                               / mass of the car
    I_uf, I_ur                         x unsprung mass x track^2
    D_f, D_r                           / track: camber per roll angle stays
    E_f, E_r, I_xz_s, h_raf, h_rar     as they are (0)
    Pacejka's coefficients             as they are, but the shifts (ply steer, conicity) p_hx1, p_vx1, p_hy1, p_vy1, r_hx1, r_hy1, r_by3,
                                       r_vy1 are 0: mirrored commands give the mirrored path, and a wheel that rolls freely pulls nowhere
    limits of steering, acceleration   out of reach: those of `rates` apply

Signs: the model is written for y to the right (SAE). Mirrored, its positive yaw, steer and y are left, its "left" wheels are our right
ones, and its roll angle is minus ours.

`rates` adds what the model lacks; the model's input of acceleration stays 0:
    torque of every wheel              drive, brake and rolling resistance at once; it would brake or drive, with one split for all
    drag                               a force against the car's forward speed
    friction under every wheel         p.tire is read wheel by wheel, in turns: one tyre each
    standstill                         below 0.1 m/s the model rolls without slip or resistance: here with resistance, and brakes hold; from
                                       there to 0.2 m/s rolling passes into the tyre model, in the plane, without a jump
    a car that slides sideways         or backwards: a floor under the speeds that the model divides by; only the end of the slide is right
"""

import dataclasses
import itertools
import math
import types
from collections.abc import Callable, Sequence
from typing import Annotated, Any, no_type_check

import numpy as np
from jaxtyping import Float

from scenefactory_jax.core.schema import Bounds, ConfigError, Positive
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY, CarParameters

CREEP = 0.1  # m/s; the model's limit between rolling and tyres; up to twice this the two are blended
SLIDE = 0.3  # m/s sideways; a car that slides faster than this does not roll, however slowly it goes forward
FLOOR = 0.05  # m/s, least forward speed of a wheel on which the model may divide
SHIFTS = ("p_hx1", "p_vx1", "p_hy1", "p_vy1", "r_hx1", "r_hy1", "r_by3", "r_vy1")
OUR_WHEELS = (1, 0, 3, 2)  # index of the model's left front, right front, left rear, right rear wheel in `parameters.WHEELS`
# rows of the state
X, Y, STEER, FORWARD, YAW, YAW_RATE, ROLL, PITCH, SIDEWAYS, HEIGHT = 0, 1, 2, 3, 4, 5, 6, 8, 10, 11
SIDEWAYS_FRONT, HEIGHT_FRONT, SIDEWAYS_REAR, HEIGHT_REAR, SPIN = 15, 16, 20, 21, slice(23, 27)
PLANAR = (FORWARD, YAW_RATE, SIDEWAYS, *range(23, 27))
STATES = 29
READS = (  # all parameters of our car that the reference car has
    "mass", "inertia", "mass_forward", "wheelbase", "track", "wheel_radius", "wheel_mass", "wheel_inertia", "carrier_mass",
    "carrier_inertia", "knuckle_mass", "knuckle_inertia",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferenceVehicle:
    """Parameters of the reference car: `conf/sysid/teacher.yaml`, and the car that has the same masses. Plain data, for processes."""

    car: CarParameters
    sprung_height: float  # of the sprung mass's centre above the ground at rest, m
    drive_torque: float  # of each front wheel at full throttle, N m
    brake_torque_front: float  # of each front wheel at full brake, N m
    brake_torque_rear: float  # of each rear wheel
    rolling_resistance: float  # force over load
    drag_area: float  # drag coefficient times frontal area, m^2
    air_density: float  # kg/m^3
    steering_lock: float  # angle of the front wheels at full command, rad
    steering_lag_s: Positive  # time constant of the steering
    steering_rate_max: Positive  # rad/s
    grip: Annotated[list[float], Bounds(above=0)]  # factors on Pacejka's peak frictions, one a surface
    contact_m: Positive  # distance over which friction changes where two surfaces meet
    stop_speed: Positive  # m/s; resistance to motion is its full torque times tanh(speed / this) near standstill
    lock_spin: Positive  # rad/s; the same for a wheel whose car still moves
    settle_s: Positive  # time constant of rolling below 0.1 to 0.2 m/s
    tolerance: Positive  # of the integrator, relative to each state


class Body(types.SimpleNamespace):
    """Parameters as `vehicle_dynamics_mb` reads them. It reads `tire` once per wheel, in turns: front left, right, rear left, right."""

    tyres: list[types.SimpleNamespace]
    turn: "itertools.cycle[types.SimpleNamespace]"

    @property
    @no_type_check
    def tire(self) -> types.SimpleNamespace:
        return next(self.turn)


class Vehicle:
    """The multi-body model with its parameters and one tyre for each wheel; it has no state of the car."""

    def __init__(self, reference: ReferenceVehicle) -> None:
        self.reference, car = reference, reference.car
        self.model, bmw = _commonroad()
        self.body = make_body(car, bmw, sprung_height=reference.sprung_height)
        self.peak = (bmw.tire.p_dx1, bmw.tire.p_dy1)
        self.load = self.body.m * GRAVITY / 4
        self.rolling_mass = self.body.m + 4 * car.wheel_inertia[0] / car.wheel_radius**2

    @no_type_check
    def set_grip(self, factors: Sequence[float]) -> None:
        """Sets the factor on the peak friction of each of the model's wheels."""
        for tyre, factor in zip(self.body.tyres, factors, strict=True):
            tyre.p_dx1, tyre.p_dy1 = self.peak[0] * factor, self.peak[1] * factor


def _commonroad() -> tuple[Callable[..., Any], Any]:
    """Imports the model and the BMW 320i; ConfigError: the package is missing."""
    try:
        from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
        from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
    except ImportError as error:
        raise ConfigError(f"teacher: CommonRoad's vehicle models are missing; pip install scenefactory_jax[sysid] ({error})") from error
    return vehicle_dynamics_mb, parameters_vehicle2()


def make_body(car: CarParameters, bmw: Any, *, sprung_height: float) -> Body:
    """Computes the parameters of the model: see the table above."""
    front, rear = (2 * (car.wheel_mass + car.carrier_mass) + extra for extra in (2 * car.knuckle_mass, 0.0))
    a, b = car.wheelbase / 2 - car.mass_forward, car.wheelbase / 2 + car.mass_forward
    mass = car.mass + front + rear
    across = 2 * (2 * (car.wheel_inertia[1] + car.carrier_inertia) + car.knuckle_inertia)
    wheels_yaw = across + front * (a**2 + (car.track / 2) ** 2) + rear * (b**2 + (car.track / 2) ** 2)
    span = bmw.a + bmw.b
    on_front = (car.mass * b / car.wheelbase) / (bmw.m_s * bmw.b / span)
    on_rear = (car.mass * a / car.wheelbase) / (bmw.m_s * bmw.a / span)
    sprung, total = car.mass / bmw.m_s, mass / bmw.m
    wider_f, wider_r = car.track / bmw.T_f, car.track / bmw.T_r
    far = types.SimpleNamespace(min=-10.0, max=10.0, v_min=-100.0, v_max=100.0)
    free = types.SimpleNamespace(a_max=1e3, v_max=1e3, v_min=-1e3, v_switch=1e3)
    pacejka = {name: value for name, value in vars(bmw.tire).items()} | dict.fromkeys(SHIFTS, 0.0)
    tyres = [types.SimpleNamespace(**pacejka) for _ in range(4)]
    return Body(
        m=mass, m_s=car.mass, m_uf=front, m_ur=rear, a=a, b=b,
        I_Phi_s=car.inertia[0], I_y_s=car.inertia[1], I_z=car.inertia[2] + wheels_yaw, I_xz_s=bmw.I_xz_s,
        h_s=sprung_height, R_w=car.wheel_radius, I_y_w=car.wheel_inertia[0],
        T_f=car.track, T_r=car.track,
        K_sf=bmw.K_sf * on_front, K_sdf=bmw.K_sdf * on_front, K_sr=bmw.K_sr * on_rear, K_sdr=bmw.K_sdr * on_rear,
        K_tsf=bmw.K_tsf * on_front * wider_f**2, K_tsr=bmw.K_tsr * on_rear * wider_r**2,
        K_ras=bmw.K_ras * sprung, K_rad=bmw.K_rad * sprung, K_zt=bmw.K_zt * total, K_lt=bmw.K_lt / total,
        I_uf=bmw.I_uf * front / bmw.m_uf * wider_f**2, I_ur=bmw.I_ur * rear / bmw.m_ur * wider_r**2,
        D_f=bmw.D_f / wider_f, D_r=bmw.D_r / wider_r, E_f=bmw.E_f, E_r=bmw.E_r, h_raf=bmw.h_raf, h_rar=bmw.h_rar,
        T_sb=0.5, T_se=1.0,  # unused: no torque goes through the model's input
        steering=far, longitudinal=free, tyres=tyres, turn=itertools.cycle(tyres),
    )  # fmt: skip


def start(vehicle: Vehicle, speed: float) -> Float[np.ndarray, "29"]:
    """Computes the state of a car that rolls straight at `speed`, settled on springs and tyres, the box's centre at the origin."""
    p, state = vehicle.body, np.zeros(STATES)
    front = (p.m_s * p.b / (p.a + p.b) + p.m_uf) * GRAVITY / (2 * p.K_zt)
    rear = (p.m_s * p.a / (p.a + p.b) + p.m_ur) * GRAVITY / (2 * p.K_zt)
    state[X], state[FORWARD], state[SPIN] = vehicle.reference.car.mass_forward, speed, speed / p.R_w
    state[HEIGHT_FRONT], state[HEIGHT_REAR] = front, rear
    state[PITCH] = (rear - front) / (p.a + p.b)
    state[HEIGHT] = front + p.a * state[PITCH]
    return state


@no_type_check  # called thousands of times a simulated second
def rates(state: Float[np.ndarray, "29"], time: float, vehicle: Vehicle, command: Sequence[float], road: Any) -> list[float]:
    """Computes the time derivative of the state under a command: throttle, steer, brake.

    `road(x, y)` is the factor on the peak friction at a position; None: the tyres keep theirs.
    """
    p, reference, x = vehicle.body, vehicle.reference, state.tolist()
    angle, forward, yaw, yaw_rate, sideways = x[STEER], x[FORWARD], x[YAW], x[YAW_RATE], x[SIDEWAYS]
    rate = (reference.steering_lock * command[1] - angle) / reference.steering_lag_s
    steering = min(max(rate, -reference.steering_rate_max), reference.steering_rate_max)
    if road is not None:
        vehicle.set_grip([road(*position) for position in _wheel_positions(p, x)])
    spins = x[SPIN]
    rolling = 0.0 if abs(sideways) > SLIDE else min(max(2.0 - forward / CREEP, 0.0), 1.0)
    if rolling < 1.0:
        extra = missing_speed(p, x)
        x[FORWARD] += extra
    else:
        extra, x[FORWARD] = 0.0, max(-0.9 * CREEP, min(forward, 0.9 * CREEP))
    turned = extra * math.cos(angle) / p.R_w
    for row, shift in enumerate((turned, turned, extra / p.R_w, extra / p.R_w), start=SPIN.start):
        x[row] = max(x[row], 0.0) + shift
    p.turn = itertools.cycle(p.tyres)
    f = vehicle.model(x, (steering, 0.0), p)

    f[X] = forward * math.cos(yaw) - sideways * math.sin(yaw)
    f[Y] = forward * math.sin(yaw) + sideways * math.cos(yaw)
    f[STEER], f[YAW] = steering, yaw_rate
    for row in (SIDEWAYS, SIDEWAYS_FRONT, SIDEWAYS_REAR):  # turning couples with the true forward speed
        f[row] += yaw_rate * extra
    f[FORWARD] -= 0.5 * reference.air_density * reference.drag_area * forward * abs(forward) / p.m
    drive, hold = _torques(vehicle, command)
    for wheel, spin in enumerate(spins):
        f[SPIN.start + wheel] += (drive[wheel] - hold[wheel] * math.tanh(spin / reference.lock_spin)) / p.I_y_w
    if rolling > 0.0:
        slow = _roll(vehicle, (sum(drive), sum(hold)), spins, angle, steering, forward, yaw_rate, sideways)
        for row, rate in zip(PLANAR, slow, strict=True):
            f[row] += rolling * (rate - f[row])
    return f


@no_type_check  # called thousands of times a simulated second
def _torques(vehicle: Vehicle, command: Sequence[float]) -> tuple[list[float], list[float]]:
    """Computes the drive torque of each wheel and the largest torque that resists its rotation, N m."""
    reference = vehicle.reference
    drive, resistance = reference.drive_torque * command[0], reference.rolling_resistance * vehicle.load * vehicle.body.R_w
    front, rear = reference.brake_torque_front * command[2] + resistance, reference.brake_torque_rear * command[2] + resistance
    return [drive, drive, 0.0, 0.0], [front, front, rear, rear]


@no_type_check  # called thousands of times a simulated second
def _roll(vehicle: Vehicle, torque: tuple[float, float], spins: list[float], angle: float, steering: float, *motion: float) -> list[float]:
    """Computes the rates of PLANAR for rolling without slip, below the speeds of the tyre model; resistance stops the car."""
    p, settle_s = vehicle.body, vehicle.reference.settle_s
    forward, yaw_rate, sideways = motion
    drive, hold = torque
    gain = (drive - hold * math.tanh(forward / vehicle.reference.stop_speed)) / (p.R_w * vehicle.rolling_mass)
    bend = math.tan(angle) / (p.a + p.b)
    turn, turning = forward * bend, gain * bend + forward * steering / math.cos(angle) ** 2 / (p.a + p.b)
    speeds = _wheel_speeds(p, angle, forward, yaw_rate, sideways)
    spinning = [gain / p.R_w + (speed / p.R_w - spin) / settle_s for speed, spin in zip(speeds, spins, strict=True)]
    return [gain, turning + (turn - yaw_rate) / settle_s, p.b * turning + (p.b * turn - sideways) / settle_s, *spinning]


@no_type_check  # called thousands of times a simulated second
def _wheel_speeds(p: Body, angle: float, forward: float, yaw_rate: float, sideways: float) -> list[float]:
    """Computes the speed of each of the model's wheels along its plane, m/s."""
    half, across = 0.5 * p.T_f * yaw_rate, (sideways + p.a * yaw_rate) * math.sin(angle)
    front = [(forward + side * half) * math.cos(angle) + across for side in (1, -1)]
    return [*front, forward + 0.5 * p.T_r * yaw_rate, forward - 0.5 * p.T_r * yaw_rate]


@no_type_check  # called thousands of times a simulated second
def missing_speed(p: Body, x: list[float]) -> float:
    """Computes the forward speed to add to car and wheels, at the same sliding, so that the model divides by no speed below FLOOR."""
    swing, angle = 0.5 * abs(x[YAW_RATE]), x[STEER]
    across = (x[SIDEWAYS] + p.a * x[YAW_RATE]) * math.sin(angle)
    least = max(CREEP, swing * p.T_r + FLOOR, swing * p.T_f + (FLOOR - across) / math.cos(angle))
    return max(0.0, least - x[FORWARD])


@no_type_check  # called thousands of times a simulated second
def _wheel_positions(p: Body, x: list[float]) -> list[tuple[float, float]]:
    """Computes the positions of the model's wheels; its left ones are our right ones."""
    cos, sin, half = math.cos(x[YAW]), math.sin(x[YAW]), p.T_f / 2
    corners = ((p.a, -half), (p.a, half), (-p.b, -half), (-p.b, half))
    return [(x[X] + along * cos - aside * sin, x[Y] + along * sin + aside * cos) for along, aside in corners]
