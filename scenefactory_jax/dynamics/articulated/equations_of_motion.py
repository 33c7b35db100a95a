"""A car's equations of motion in closed form: M(q) a + bias(q, v) = forces, for a free chassis with four sprung, steered, spinning wheels.

Everything is seen in the car's own axes, the linear acceleration of the chassis too. MuJoCo's free joint has that one in the world's axes;
a rotation of unknowns changes nothing about the motion, and without it M depends on suspension and steering alone and is mostly zeros.
A wheel is round: its inertia is `across` 1 + (`about` - `across`) axle axle^T, whatever its spin angle, which is why none appears here.

M comes from the kinetic energy, bias from the accelerations of all bodies while no joint accelerates (Featherstone, Rigid Body Dynamics
Algorithms, chapters 2 and 5; MuJoCo documentation, "Computation", general framework). Gravity is an upward acceleration of everything.
"""

from typing import NamedTuple

from scenefactory_jax.dynamics.articulated.parameters import AHEAD, GRAVITY, CarParameters
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, over_wheels, wheels

FRONT = 0.5 * (1.0 + AHEAD)  # 1 for the wheels that steer
Matrix = list[list[Number]]


class Forces(NamedTuple):
    """Generalised forces, N and N m, in a car's axes."""

    force: Vector  # on the chassis
    torque: Vector  # about the box's centre
    suspension: Number  # of each wheel's joints
    spin: Number
    steer: Number  # zero for the rear wheels


class Drift(NamedTuple):
    """Accelerations of the wheels while no joint accelerates."""

    hub: Vector  # m/s^2
    turn: Vector  # rad/s^2


class Unsprung(NamedTuple):
    """Masses of the wheels with all that moves with them."""

    mass: Number  # [4] kg
    about: Number  # inertia about the axle, kg m^2
    across: Number  # [4] about any axis across it


def compute_unsprung(car: CarParameters) -> Unsprung:
    """Sums of the parts."""
    about, across = car.wheel_inertia
    mass = car.wheel_mass + car.carrier_mass + FRONT * car.knuckle_mass
    return Unsprung(mass, about, across + car.carrier_inertia + FRONT * car.knuckle_inertia)


def total_mass(car: CarParameters) -> Number:
    """Of the whole car, kg; the cars may have an axis."""
    return car.mass + 4 * (car.wheel_mass + car.carrier_mass) + 2 * car.knuckle_mass


def centre_of_mass(car: CarParameters) -> Vector:
    """Of the chassis' mass, from the box's centre, m."""
    return Vector(car.mass_forward, 0.0, car.mass_height)


def compute_loads(car: CarParameters) -> Number:
    """Weight of the chassis on each wheel at rest, N."""
    return 0.5 * car.mass * GRAVITY * (0.5 + AHEAD * (car.mass_forward / car.wheelbase))


def compute_bias_acceleration(state: CarState) -> Drift:
    """Centripetal, Coriolis and gyroscopic accelerations."""
    rate, up = state.rate, Vector(0.0, 0.0, 1.0)
    steered = up * state.steering
    hub = cross(rate, cross(rate, state.hub) + up * (2.0 * state.sinking))
    return Drift(hub, cross(rate, steered) + cross(rate + steered, state.axle * state.spin))


def compute_mass_matrix(car: CarParameters, state: CarState) -> tuple[Matrix, Matrix, Matrix]:
    """M: of the chassis (6 x 6, linear before angular), between chassis and wheels (6 x 3), of the wheels' own joints (3 x 3).

    The own joints are suspension, spin and steering. They do not meet: the axle is across the other two, and the hub lies on all three.
    A rear wheel, which has no steering, gets a row of zeros with a unit diagonal.
    """
    wheel, axle, hub = compute_unsprung(car), state.axle, state.hub
    oval, total = wheel.about - wheel.across, total_mass(car)
    x, y, z = centre_of_mass(car) * car.mass + wheels(hub * wheel.mass)
    shift = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # linear momentum of a turn

    def second_moment(i: int, j: int) -> Number:
        chassis, hubs = _second_moment(i, j, car.mass, centre_of_mass(car)), _second_moment(i, j, wheel.mass, hub)
        own = chassis + over_wheels(hubs + oval * axle[i] * axle[j])
        return own + car.inertia[i] + over_wheels(wheel.across) if i == j else own

    lower = [[second_moment(i, j) for j in range(i + 1)] for i in range(3)]
    linear = [[*(total if i == j else 0.0 for j in range(3)), *shift[i]] for i in range(3)]
    angular = [[*(shift[j][i] for j in range(3)), *(lower[max(i, j)][min(i, j)] for j in range(3))] for i in range(3)]
    across = [
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [wheel.mass, 0.0, 0.0],
        [wheel.mass * hub.y, wheel.about * axle.x, 0.0],
        [-wheel.mass * hub.x, wheel.about * axle.y, 0.0],
        [0.0, 0.0, FRONT * wheel.across],
    ]
    pivot = FRONT * (wheel.across + car.steering_inertia) + (1.0 - FRONT)
    return [*linear, *angular], across, [[wheel.mass, 0.0, 0.0], [0.0, wheel.about, 0.0], [0.0, 0.0, pivot]]


def compute_bias_force(car: CarParameters, state: CarState, drift: Drift) -> Forces:
    """What keeps every joint from accelerating: the bodies' masses times `drift`, and their weight."""
    wheel, rate, axle, weightless = compute_unsprung(car), state.rate, state.axle, state.up * GRAVITY
    chassis = (cross(rate, cross(rate, centre_of_mass(car))) + weightless) * car.mass
    push = (drift.hub + weightless) * wheel.mass
    whole = rate + Vector(0.0, 0.0, state.steering) + axle * state.spin
    oval = wheel.about - wheel.across
    torque = drift.turn * wheel.across + axle * (oval * dot(axle, drift.turn)) + cross(whole, axle) * (oval * dot(axle, whole))
    roll, pitch, yaw = car.inertia
    still = cross(centre_of_mass(car), chassis) + cross(rate, Vector(roll * rate.x, pitch * rate.y, yaw * rate.z))
    return Forces(
        force=chassis + wheels(push),
        torque=still + wheels(cross(state.hub, push) + torque),
        suspension=push.z,
        spin=dot(axle, torque),
        steer=FRONT * torque.z,
    )


def _second_moment(i: int, j: int, mass: Number, arm: Vector) -> Number:
    """Element of the inertia of a point mass about the origin."""
    return mass * ((dot(arm, arm) if i == j else 0.0) - arm[i] * arm[j])
