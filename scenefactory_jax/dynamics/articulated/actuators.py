"""Forces of the car's actuators and of its body: engine, brakes, steering servo, springs, stops, air, and contact of the chassis."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, Forces
from scenefactory_jax.dynamics.articulated.parameters import (
    AHEAD,
    DRIVE_FADE_FRACTION,
    LEFT,
    CarParameters,
)
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length, sum_vectors


class Command(NamedTuple):
    """Actuator commands of one car, constant in a control step."""

    steer: Float[Array, "*cars"]  # angle of the front wheels, rad
    throttle: Float[Array, "*cars"]  # -1 to 1; below zero: reverse gear
    brake_torque: Float[Array, "*cars 4"]  # of each wheel, N m


class PlanarForce(NamedTuple):
    """Force on a car from other cars and objects."""

    force: Float[Array, "*cars 2"]  # in the world's plane, N
    torque: Float[Array, "*cars"]  # about the box's centre, N m


def compute_command(car: CarParameters, action: Float[Array, "A 3"]) -> Command:
    """Computes the actuator commands from an action: throttle, steer and brake in [-1, 1]; a brake below zero is released."""
    throttle, steer, brake = jnp.clip(action, -1.0, 1.0).T
    brake = jnp.maximum(brake, 0.0)
    front, rear = car.brake_torque_front * brake, car.brake_torque_rear * brake
    return Command(car.steering_limit * steer, throttle, jnp.stack([front, front, rear, rear], axis=-1))


def compute_drive_torque(car: CarParameters, throttle: Number, state: CarState) -> Number:
    """Computes the engine's torque on each wheel, N m: front wheels only.

    A throttle above zero asks for its fraction of the torque that the engine has at the wheel's spin: `drive_torque`, at most half of
    `drive_power` over the spin. A throttle below zero asks for the same backwards, if the car rolls forward slower than
    `reverse_speed`; above it, the reverse gear cannot be engaged and the engine idles. The torque falls to zero over the last tenth of
    `spin_limit`, backwards of `reverse_spin_limit`.
    """
    speed = jnp.abs(state.spin)
    available = jnp.minimum(car.drive_torque, 0.5 * car.drive_power / jnp.maximum(speed, 1.0))
    limit = jnp.where(throttle < 0.0, car.reverse_spin_limit, car.spin_limit)
    fade = jnp.clip((limit - speed) / (DRIVE_FADE_FRACTION * limit), 0.0, 1.0)
    engaged = (throttle >= 0.0) | (state.velocity.x < car.reverse_speed)
    return jnp.where(engaged, throttle, 0.0) * available * fade * FRONT


def compute_applied_forces(car: CarParameters, state: CarState, steer: Number, push: PlanarForce) -> Forces:
    """Computes all forces that MuJoCo's model of the car lacks, but those of tyres, engine and brakes.

    Args:
        steer: commanded angle, rad.
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
    return Forces(drag_force + push_force + ground, torque + ground_torque, suspension=stop, spin=jnp.zeros(4), steer=FRONT * servo)


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
    force, torque, up = Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0), state.normal
    for side in (0.5, -0.5):  # the roof's corners, then the floor's, in the order of the wheels
        arm = Vector(AHEAD * (car.length / 2), LEFT * (car.width / 2), side * car.height)
        depth = -(state.height + dot(up, arm))
        velocity = state.velocity + cross(state.rate, arm)
        vertical = dot(up, velocity)
        normal = jnp.where(depth > 0.0, jnp.maximum(car.body_stiffness * depth - car.body_damping * vertical, 0.0), 0.0)
        sliding = velocity - up * vertical
        drag = length(*sliding) * car.body_damping
        scale = jnp.minimum(1.0, car.body_friction * normal / jnp.maximum(drag, 1.0))
        corner = up * normal - sliding * (scale * car.body_damping)
        force, torque = force + sum_vectors(corner), torque + sum_vectors(cross(arm, corner))
    return force, torque
