"""Forces of the car's actuators and of its body: engine, brakes, steering servo, springs, stops, air, and contact of the chassis."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated.constants import CarConstants
from scenefactory_jax.dynamics.articulated.contact_solver import IMPEDANCE_RANGE, MIN_REGULARIZATION, BrakeRows
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, Forces
from scenefactory_jax.dynamics.articulated.parameters import (
    AHEAD,
    DRIVE_FADE_FRACTION,
    LEFT,
    MIN_FRICTION_LOSS,
    ROLLBACK_SPIN,
    CarParameters,
)
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length, sum_vectors

BRAKE_TIME_CONSTANT = 0.02  # s, MuJoCo's default, with its damping ratio of 1: a brake has no position and therefore no stiffness


class Command(NamedTuple):
    """Actuator commands of one car, constant in a control step."""

    steer: Float[Array, "*cars"]  # angle of the front wheels, rad
    drive_torque: Float[Array, "*cars"]  # of each front wheel, N m
    brake_torque: Float[Array, "*cars 4"]  # of each wheel, N m


class PlanarForce(NamedTuple):
    """Force on a car from other cars and objects."""

    force: Float[Array, "*cars 2"]  # in the world's plane, N
    torque: Float[Array, "*cars"]  # about the box's centre, N m


def compute_command(car: CarParameters, action: Float[Array, "A 3"]) -> Command:
    """Computes the actuator commands from an action: throttle, steer and brake in [-1, 1]."""
    throttle, steer, brake = jnp.clip(action, -1.0, 1.0).T
    brake = jnp.maximum(brake, 0.0)
    front, rear = car.brake_torque_front * brake, car.brake_torque_rear * brake
    drive_torque = car.drive_torque * jnp.maximum(throttle, 0.0)
    return Command(car.steering_limit * steer, drive_torque, jnp.stack([front, front, rear, rear], axis=-1))


def compute_wheel_torques(
    car: CarParameters, command: Command, spin: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Computes drive torque and friction loss of each wheel joint, N m, for brakes that are joint friction.

    A wheel that turns forward is accelerated by drive - brake. MuJoCo's joint friction is soft: a joint that holds a torque yields at a
    rate proportional to it, and a car would creep against its brakes. So the part that drive and brake have in common is subtracted from
    both. A wheel that rolls back is slowed by both, and both stay.
    """
    drive, brake = compute_drive_torque(car, command.drive_torque, spin), command.brake_torque + car.rolling_torque
    common = jnp.where(spin > -ROLLBACK_SPIN, jnp.minimum(drive, brake), 0.0)
    return drive - common, jnp.maximum(brake - common, MIN_FRICTION_LOSS)


def compute_drive_torque(car: CarParameters, drive_torque: Float[Array, ""], spin: Float[Array, "4"]) -> Float[Array, "4"]:
    """Computes the engine's torque on each wheel, N m: front wheels only, falling to zero over the last tenth of `spin_limit`."""
    fade = jnp.clip((car.spin_limit - spin) / (DRIVE_FADE_FRACTION * car.spin_limit), 0.0, 1.0)
    return drive_torque * fade * FRONT


def make_brake_rows(constants: CarConstants, spin: Number, friction_loss: Float[Array, "4"], *, physics_dt: float) -> BrakeRows:
    """Computes the constraint rows of the wheels' joint friction; their Jacobian is the spin itself."""
    impedance = jnp.clip(constants.car.brake_impedance, *IMPEDANCE_RANGE)
    damping = 2.0 / (impedance * max(BRAKE_TIME_CONSTANT, 2 * physics_dt))
    weight = 1.0 / jnp.maximum(constants.spin_weight * (1.0 - impedance) / impedance, MIN_REGULARIZATION)
    return BrakeRows(-damping * spin, weight, friction_loss)


def compute_applied_forces(car: CarParameters, state: CarState, steer: Number, wheel_torque: Number, push: PlanarForce) -> Forces:
    """Computes all forces that MuJoCo's model of the car lacks.

    Args:
        steer: commanded angle, rad.
        wheel_torque: of engine and latched brakes on each wheel, N m.
        push: from other cars and objects.
    """
    servo = car.steering_stiffness * (steer - state.steer) - car.steering_damping * state.steer_rate
    servo = jnp.clip(servo, -car.steering_torque, car.steering_torque)
    stop = -car.stop_stiffness * (state.travel - jnp.clip(state.travel, -car.suspension_travel, car.suspension_travel))

    east, north = (dot(axis, state.velocity) for axis in (state.east, state.north))
    drag = car.air_drag * length(east, north)
    drag_force = state.east * (-drag * east) + state.north * (-drag * north) + Vector(0.0, -car.lateral_damping * state.velocity.y, 0.0)
    push_force = state.east * push.force[0] + state.north * push.force[1]
    # the chassis' joint is at the box's centre. Drag acts at the centre of mass. A push acts at its height; the arm along the box is in
    # the push's own torque
    torque = (
        state.up * push.torque
        + cross(Vector(0.0, 0.0, car.mass_height), push_force)
        + cross(equations_of_motion.centre_of_mass(car), drag_force)
    )
    torque = torque + Vector(0.0, 0.0, -car.yaw_damping * state.rate.z)
    ground, ground_torque = compute_body_ground_force(car, state)
    return Forces(drag_force + push_force + ground, torque + ground_torque, suspension=stop, spin=wheel_torque, steer=FRONT * servo)


def compute_suspension_forces(car: CarParameters, state: CarState) -> Forces:
    """Computes springs and dampers of the joints, which MuJoCo's model has itself."""
    zero = Vector(0.0, 0.0, 0.0)
    preload = equations_of_motion.compute_loads(car) * car.suspension_preload
    return Forces(
        zero,
        zero,
        suspension=-preload - car.suspension_stiffness * state.travel - car.suspension_damping * state.travel_rate,
        spin=-car.wheel_damping * state.spin,
        steer=-car.steering_friction * state.steer_rate,
    )


def compute_body_ground_force(car: CarParameters, state: CarState) -> tuple[Vector, Vector]:
    """Computes force and torque about the box's centre of the ground on the chassis' corners.

    A car on its wheels never touches. A car that rolls over lies on springs and dampers. Friction is the damper's force, limited by
    `body_friction` times the normal force.
    """
    force = torque = Vector(0.0, 0.0, 0.0)
    for side in (0.5, -0.5):  # the roof's corners, then the floor's, in the order of the wheels
        arm = Vector(AHEAD * (car.length / 2), LEFT * (car.width / 2), side * car.height)
        depth = -(state.height + dot(state.up, arm))
        velocity = state.velocity + cross(state.rate, arm)
        vertical = dot(state.up, velocity)
        normal = jnp.where(depth > 0.0, jnp.maximum(car.body_stiffness * depth - car.body_damping * vertical, 0.0), 0.0)
        sliding = velocity - state.up * vertical
        drag = length(*sliding) * car.body_damping
        scale = jnp.minimum(1.0, car.body_friction * normal / jnp.maximum(drag, 1.0))
        corner = state.up * normal - sliding * (scale * car.body_damping)
        force, torque = force + sum_vectors(corner), torque + sum_vectors(cross(arm, corner))
    return force, torque
