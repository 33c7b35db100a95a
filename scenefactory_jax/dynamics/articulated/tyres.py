"""What a tyre and a brake are to the solver: rows J, a_ref and D of MuJoCo's constraints, in closed form.

A tyre is an ellipsoid with its short axis along the axle, pressed into a plane; its contact yields in three directions, along the road's
normal and two tangents. A brake is dry friction in the wheel's joint. MuJoCo documentation, "Computation", constraint model, and
"Modeling", solver parameters: a_ref = -b J v - k r, with k and b from `solref`, and D from the impedance `solimp` and the inverse weight.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, Drift
from scenefactory_jax.dynamics.articulated.randomization import CarConstants
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length

BRAKE_TIME_CONSTANT = 0.02  # s, MuJoCo's default, and with its damping ratio of 1: it has no stiffness without a position to hold
IMPEDANCE = 1e-4, 1.0 - 1e-4  # MuJoCo keeps impedances within
SMALL = 1e-15  # MuJoCo's mjMINVAL: the least regularisation


@pytree_dataclass
class Tyres:
    """What the contact patches of a car did in the last physics step, in the order of `car.WHEELS`."""

    mu: Float[Array, "*cars 4"]  # friction coefficient of the road under the wheel
    normal: Float[Array, "*cars 4"]  # force, N
    tangent: Float[Array, "*cars 4"]  # force, N
    slip: Float[Array, "*cars 4"]  # |velocity of the tyre's surface over the ground|, m/s; zero where it is in the air


class Patch(NamedTuple):
    """Contacts of the tyres, in the car's axes; all have four wheels."""

    depth: Number  # of the tyre in the road, m; below zero in the air
    arm: Vector  # from the hub to the contact, halfway between the road and the tyre's lowest point, m
    velocity: Vector  # of the tyre there, m/s


class Rows(NamedTuple):
    """Constraint rows of a tyre: normal, two tangents."""

    jacobian: list[list[Number]]  # 6 columns of the chassis, 3 of the wheel's own
    reference: list[Number]  # a_ref
    weight: list[Number]  # D; zero in the air


def find_contact_patches(own: CarConstants, state: CarState) -> Patch:
    """Where an ellipsoid is lowest: at -S up / sqrt(up . S up) from its centre, S the matrix of its squared half axes."""
    car, up, axle = own.car, state.up, state.axle
    lean = dot(axle, up)
    round_, oval = car.wheel_radius**2, (car.wheel_width / 2) ** 2 - car.wheel_radius**2
    reach = jnp.sqrt(round_ + oval * lean * lean)  # from the hub down to the lowest point
    depth = reach - state.height - dot(up, state.hub)
    arm = up * (0.5 * depth - round_ / reach) - axle * (oval * lean / reach)
    turn = Vector(0.0, 0.0, state.steering) + axle * state.spin
    velocity = state.velocity + cross(state.rate, state.hub + arm) + Vector(0.0, 0.0, state.sinking) + cross(turn, arm)
    return Patch(depth, arm, velocity)


def compute_jdot_qvel(patch: Patch, drift: Drift) -> Vector:
    """Part of the slip's acceleration at each tyre's contact that J qacc leaves out, m/s^2.

    A contact's slip u = J qvel changes by J qacc + dJ/dt qvel. MuJoCo's reference leaves the second term out. A wheel that rolls through a
    bend has u constant, J qacc the centripetal acceleration, and dJ/dt qvel its opposite, from the axle that turns with the car: without
    it, the tyre would be softer in a bend than along the wheel, by the car's mass (see `slip_damping`).

    The contact stays below the hub: it is no point of the wheel, and the wheel's spin does not carry it round.
    """
    return drift.hub + cross(drift.turn, patch.arm)


def make_friction_rows(
    own: CarConstants, state: CarState, patch: Patch, drift: Drift, damping: Number, *, friction_ratio: float, physics_dt: float
) -> Rows:  # fmt: skip
    """Of the tyres.

    Args:
        damping: of the friction reference, 1/s: `forces.slip_damping`.
        friction_ratio: MuJoCo's impratio.
    """
    car, arm = own.car, patch.arm
    impedance = jnp.clip(car.tyre_impedance, *IMPEDANCE)
    constant = jnp.maximum(car.tyre_time_constant, 2 * physics_dt)  # MuJoCo's `refsafe`
    away, place = compute_jdot_qvel(patch, drift), state.hub + arm
    axes = (state.up, state.north, -state.east)  # MuJoCo's frame for a plane
    jacobian = []
    for axis in axes:
        lever = cross(arm, axis)
        jacobian.append([*axis, *cross(place, axis), axis.z, dot(state.axle, lever), FRONT * lever.z])
    rate = [dot(axis, patch.velocity) for axis in axes]
    push = patch.depth / (impedance * constant**2) - 2.0 / (impedance * constant) * rate[0]
    slow = [-damping / impedance * speed - dot(axis, away) for axis, speed in zip(axes[1:], rate[1:], strict=True)]
    pressed = jnp.where(patch.depth > 0.0, 1.0, 0.0)
    yields = own.wheel_weight * (1.0 - impedance) / impedance
    normal, tangent = (pressed / jnp.maximum(part, SMALL) for part in (yields, yields / friction_ratio))
    return Rows(jacobian, [push, *slow], [normal, tangent, tangent])


def make_brake_rows(own: CarConstants, spin: Number, *, physics_dt: float) -> tuple[Number, Number]:
    """a_ref and D of the wheels' dry friction; J is the spin itself."""
    impedance = jnp.clip(own.car.brake_impedance, *IMPEDANCE)
    damping = 2.0 / (impedance * max(BRAKE_TIME_CONSTANT, 2 * physics_dt))
    return -damping * spin, 1.0 / jnp.maximum(own.spin_weight * (1.0 - impedance) / impedance, SMALL)


def compute_tyre_outputs(state: CarState, patch: Patch, force: list[Number], mu: Float[Array, "4"]) -> Tyres:
    """Of a step's contact forces, normal and two tangents."""
    slip = length(dot(state.east, patch.velocity), dot(state.north, patch.velocity))
    return Tyres(mu=mu, normal=force[0], tangent=length(*force[1:]), slip=jnp.where(patch.depth > 0.0, slip, 0.0))
