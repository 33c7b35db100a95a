"""A car's equations of motion in closed form: M(q) a + bias(q, v) = forces, for a free chassis with four sprung, steered, spinning wheels.

All quantities are in the car's axes, the linear acceleration of the chassis too (MuJoCo's free joint has it in the world's axes). In these
axes M depends on suspension and steering alone and is mostly zeros. A wheel is a body of revolution: its inertia is
`across` 1 + (`about` - `across`) axle axle^T at any spin angle.

M comes from the kinetic energy, bias from the accelerations of all bodies while no joint accelerates (Featherstone, Rigid Body Dynamics
Algorithms, chapters 2 and 5; MuJoCo documentation, "Computation", general framework). Gravity is an upward acceleration of everything.
"""

from typing import NamedTuple

from scenefactory_jax.dynamics.articulated.parameters import AHEAD, GRAVITY, CarParameters
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, sum_vectors, sum_wheels

FRONT = 0.5 * (1.0 + AHEAD)  # 1 for the wheels that steer
Matrix = list[list[Number]]


class Forces(NamedTuple):
    """Generalised forces, N and N m, in a car's axes."""

    force: Vector  # on the chassis
    torque: Vector  # about the box's centre
    suspension: Number  # of each wheel's joints
    spin: Number
    steer: Number  # zero for the rear wheels


class WheelAcceleration(NamedTuple):
    """Accelerations of the wheels while no joint accelerates."""

    hub: Vector  # m/s^2
    angular: Vector  # rad/s^2


class Unsprung(NamedTuple):
    """Masses of the wheels with carriers and knuckles."""

    mass: Number  # [4] kg
    about: Number  # inertia about the axle, kg m^2
    across: Number  # [4] about any axis across it


def compute_unsprung(car: CarParameters) -> Unsprung:
    """Computes the masses and inertias of the wheels, carriers and knuckles."""
    about, across = car.wheel_inertia
    mass = car.wheel_mass + car.carrier_mass + FRONT * car.knuckle_mass
    return Unsprung(mass, about, across + car.carrier_inertia + FRONT * car.knuckle_inertia)


def total_mass(car: CarParameters) -> Number:
    """Computes the mass of the whole car, kg; the parameters may have a car axis."""
    return car.mass + 4 * (car.wheel_mass + car.carrier_mass) + 2 * car.knuckle_mass


def centre_of_mass(car: CarParameters) -> Vector:
    """Computes the centre of mass of the chassis, from the box's centre, m."""
    return Vector(car.mass_forward, 0.0, car.mass_height)


def compute_loads(car: CarParameters) -> Number:
    """Computes the weight of the chassis on each wheel at rest, N: the axle nearer to the centre of mass carries more."""
    return 0.5 * car.mass * GRAVITY * (0.5 + AHEAD * (car.mass_forward / car.wheelbase))


def compute_wheel_loads(car: CarParameters) -> Number:
    """Computes the load of each tyre at rest, N."""
    return compute_loads(car) + compute_unsprung(car).mass * GRAVITY


def compute_bias_acceleration(state: CarState) -> WheelAcceleration:
    """Computes centripetal, Coriolis and gyroscopic accelerations."""
    rate, up = state.rate, Vector(0.0, 0.0, 1.0)
    steered = up * state.steer_rate
    hub = cross(rate, cross(rate, state.hub) + up * (2.0 * state.travel_rate))
    return WheelAcceleration(hub, cross(rate, steered) + cross(rate + steered, state.axle * state.spin))


def compute_mass_matrix(car: CarParameters, state: CarState) -> tuple[Matrix, Matrix, Matrix]:
    """Computes M in blocks: chassis (6 x 6, linear before angular), chassis-wheel coupling (6 x 3), wheel joints (3 x 3).

    The wheel joints are suspension, spin and steering. They are decoupled: the axle is across the other two, and the hub lies on all three.
    A rear wheel has no steering: its row is zero with a unit diagonal.
    """
    wheel, axle, hub = compute_unsprung(car), state.axle, state.hub
    oval, total = wheel.about - wheel.across, total_mass(car)
    x, y, z = centre_of_mass(car) * car.mass + sum_vectors(hub * wheel.mass)
    shift = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # linear momentum of a rotation

    def second_moment(i: int, j: int) -> Number:
        chassis, hubs = _second_moment(i, j, car.mass, centre_of_mass(car)), _second_moment(i, j, wheel.mass, hub)
        moment = chassis + sum_wheels(hubs + oval * axle[i] * axle[j])
        return moment + car.inertia[i] + sum_wheels(wheel.across) if i == j else moment

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


def compute_bias_force(car: CarParameters, state: CarState, drift: WheelAcceleration) -> Forces:
    """Computes the bias force: the bodies' masses times `drift`, and their weight."""
    wheel, rate, axle, gravity = compute_unsprung(car), state.rate, state.axle, state.up * GRAVITY
    chassis = (cross(rate, cross(rate, centre_of_mass(car))) + gravity) * car.mass
    push = (drift.hub + gravity) * wheel.mass
    total = rate + Vector(0.0, 0.0, state.steer_rate) + axle * state.spin
    oval = wheel.about - wheel.across
    torque = drift.angular * wheel.across + axle * (oval * dot(axle, drift.angular)) + cross(total, axle) * (oval * dot(axle, total))
    roll, pitch, yaw = car.inertia
    bias = cross(centre_of_mass(car), chassis) + cross(rate, Vector(roll * rate.x, pitch * rate.y, yaw * rate.z))
    return Forces(
        force=chassis + sum_vectors(push),
        torque=bias + sum_vectors(cross(state.hub, push) + torque),
        suspension=push.z,
        spin=dot(axle, torque),
        steer=FRONT * torque.z,
    )


def _second_moment(i: int, j: int, mass: Number, arm: Vector) -> Number:
    """Computes an element of the inertia of a point mass about the origin."""
    return mass * ((dot(arm, arm) if i == j else 0.0) - arm[i] * arm[j])
