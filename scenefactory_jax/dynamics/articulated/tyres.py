"""The tyres: contact patches, constraint rows and outputs.

A tyre is an ellipsoid with its short axis along the axle, pressed into a plane. Its contact is a MuJoCo constraint in three directions, the
road's normal and two tangents: rows J, a_ref and D in closed form. a_ref = -b J v - k r, with k and b from `solref`, and D from the
impedance `solimp` and the inverse weight (MuJoCo documentation, "Computation", constraint model, and "Modeling", solver parameters).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.pytree import pytree_dataclass
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.contact_solver import IMPEDANCE_RANGE, MIN_REGULARIZATION, TyreRows
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, WheelAcceleration
from scenefactory_jax.dynamics.articulated.parameters import CarParameters
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length


class TyreInput(NamedTuple):
    """Inputs of a car's tyres in one physics step."""

    mu: Float[Array, "4"]  # friction coefficient under each wheel
    slip_damping: Number  # of the friction reference, 1/s


@pytree_dataclass
class Tyres:
    """Outputs of the tyres in the last physics step, in the order of `WHEELS`."""

    mu: Float[Array, "*cars 4"]  # friction coefficient under the wheel
    normal: Float[Array, "*cars 4"]  # force, N
    tangent: Float[Array, "*cars 4"]  # force, N
    slip: Float[Array, "*cars 4"]  # speed of the tyre's surface over the ground, m/s; zero in the air


class Patch(NamedTuple):
    """Contact patches of the four tyres, in the car's axes."""

    depth: Number  # of the tyre in the road, m; below zero in the air
    arm: Vector  # from the hub to the contact, halfway between the road and the tyre's lowest point, m
    velocity: Vector  # of the tyre at the contact, m/s


def find_contact_patches(car: CarParameters, state: CarState) -> Patch:
    """Computes the lowest point of each ellipsoid: -S up / sqrt(up . S up) from its centre, S the matrix of its squared half axes."""
    up, axle = state.up, state.axle
    lean = dot(axle, up)
    round_, oval = car.wheel_radius**2, (car.wheel_width / 2) ** 2 - car.wheel_radius**2
    reach = jnp.sqrt(round_ + oval * lean * lean)  # from the hub down to the lowest point
    depth = reach - state.height - dot(up, state.hub)
    arm = up * (0.5 * depth - round_ / reach) - axle * (oval * lean / reach)
    rotation = Vector(0.0, 0.0, state.steer_rate) + axle * state.spin
    velocity = state.velocity + cross(state.rate, state.hub + arm) + Vector(0.0, 0.0, state.travel_rate) + cross(rotation, arm)
    return Patch(depth, arm, velocity)


def compute_slip_damping(car: CarParameters, state: CarState) -> Number:
    """Computes the damping of the friction reference, 1/s: `tyre_slip_damping` up to `tyre_slip_speed`, then proportional to 1/speed.

    Below the friction limit MuJoCo's friction obeys R f = b u - a: u the slip velocity, b = damping / impedance, R the regularisation, a
    the acceleration of the slip, which is 0 in steady braking and (with `compute_jdot_qvel`) in a steady turn. So f = b u / R.
    A tyre's force is a stiffness times slip angle or slip ratio, which are u / speed (Pacejka, Tyre and Vehicle Dynamics, linear range).
    With b ~ 1/speed the stiffness b speed / R is the same at every speed above `tyre_slip_speed`. Below, slip ratios are not defined and
    the tyre is a damper.
    """
    speed = length(dot(state.east, state.velocity), dot(state.north, state.velocity))
    return car.tyre_slip_damping / jnp.maximum(speed / car.tyre_slip_speed, 1.0)


def compute_jdot_qvel(patch: Patch, drift: WheelAcceleration) -> Vector:
    """Computes dJ/dt qvel, the part of the slip's acceleration at each contact that J qacc lacks, m/s^2.

    MuJoCo's reference ignores it. A wheel that rolls through a bend has constant slip: J qacc is the centripetal acceleration and
    dJ/dt qvel its opposite. Without it the tyre would be softer in a bend than along the wheel. The contact stays below the hub: the
    wheel's spin does not rotate it.
    """
    return drift.hub + cross(drift.angular, patch.arm)


def make_tyre_rows(
    constants: CarConstants,
    state: CarState,
    patch: Patch,
    drift: WheelAcceleration,
    tyre: TyreInput,
    *,
    friction_ratio: float,
    physics_dt: float,
) -> TyreRows:
    """Computes the constraint rows of the tyres; `friction_ratio` is MuJoCo's impratio."""
    car, arm = constants.car, patch.arm
    impedance = jnp.clip(car.tyre_impedance, *IMPEDANCE_RANGE)
    constant = jnp.maximum(car.tyre_time_constant, 2 * physics_dt)  # MuJoCo's `refsafe`
    slip_drift, position = compute_jdot_qvel(patch, drift), state.hub + arm
    axes = (state.up, state.north, -state.east)  # MuJoCo's frame for a plane
    jacobian = []
    for axis in axes:
        lever = cross(arm, axis)
        jacobian.append([*axis, *cross(position, axis), axis.z, dot(state.axle, lever), FRONT * lever.z])
    rate = [dot(axis, patch.velocity) for axis in axes]
    normal_reference = patch.depth / (impedance * constant**2) - 2.0 / (impedance * constant) * rate[0]
    friction_reference = [
        -tyre.slip_damping / impedance * speed - dot(axis, slip_drift) for axis, speed in zip(axes[1:], rate[1:], strict=True)
    ]
    pressed = jnp.where(patch.depth > 0.0, 1.0, 0.0)
    regularization = constants.wheel_weight * (1.0 - impedance) / impedance
    normal, tangent = (
        pressed / jnp.maximum(part, MIN_REGULARIZATION) for part in (regularization, regularization / friction_ratio)
    )
    cone = tyre.mu / friction_ratio**0.5
    return TyreRows(jacobian, [normal_reference, *friction_reference], [normal, tangent, tangent], tyre.mu, cone)


def compute_tyre_outputs(state: CarState, patch: Patch, force: list[Number], tyre: TyreInput) -> Tyres:
    """Computes the outputs from a step's contact forces: normal and two tangents."""
    slip = length(dot(state.east, patch.velocity), dot(state.north, patch.velocity))
    return Tyres(mu=tyre.mu, normal=force[0], tangent=length(*force[1:]), slip=jnp.where(patch.depth > 0.0, slip, 0.0))
