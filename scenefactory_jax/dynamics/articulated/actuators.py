"""What acts on an articulated car besides gravity and its tyres, in its own axes: springs, servo, engine, stops, dampings, air, others.

And how much its tyres yield.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.articulated import equations_of_motion
from scenefactory_jax.dynamics.articulated.equations_of_motion import FRONT, Forces
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, FADES, LATENT_FRICTION, LEFT, ROLLS_BACK, CarParameters
from scenefactory_jax.dynamics.articulated.state import CarState
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, cross, dot, length, wheels


class Command(NamedTuple):
    """What one car is told for a control step, and what the road and others do to it."""

    steer: Float[Array, ""]  # wanted angle
    drive: Float[Array, ""]  # torque of a front wheel
    brake: Float[Array, "4"]  # largest torque of each wheel's brake
    mu: Float[Array, "4"]
    force: Float[Array, "2"]  # from other cars, in the world's plane
    torque: Float[Array, ""]  # of it, about the box's centre


class PhysicsStepInput(NamedTuple):
    """What a physics step is told of one car besides its state."""

    force: Forces
    mu: Float[Array, "4"]
    friction: Float[Array, "4"] | None  # dry friction of each wheel's joint, N m; none with latched brakes
    slip_damping: Number


def decode_action(car: CarParameters, action: Float[Array, "A 3"]) -> tuple[Float[Array, " A"], Float[Array, " A"], Float[Array, "A 4"]]:
    """Throttle, steer and brake in [-1, 1] as steering angle, torque of a driven wheel, and largest torque of each brake."""
    throttle, steer, brake = jnp.clip(action, -1.0, 1.0).T
    brake = jnp.maximum(brake, 0.0)
    front, rear = car.brake_torque_front * brake, car.brake_torque_rear * brake
    return car.steering_limit * steer, car.drive_torque * jnp.maximum(throttle, 0.0), jnp.stack([front, front, rear, rear], axis=-1)


def make_step_input(car: CarParameters, state: CarState, command: Command, wheel_torque: Float[Array, "4"]) -> Forces:
    """All forces on one car that MuJoCo's model of it does not know.

    Args:
        wheel_torque: of engine and latched brakes on each wheel.
    """
    servo = car.steering_stiffness * (command.steer - state.steer) - car.steering_damping * state.steering
    servo = jnp.clip(servo, -car.steering_torque, car.steering_torque)
    stop = -car.stop_stiffness * (state.travel - jnp.clip(state.travel, -car.suspension_travel, car.suspension_travel))

    east, north = (dot(axis, state.velocity) for axis in (state.east, state.north))
    drag = car.air_drag * length(east, north)
    slowing = state.east * (-drag * east) + state.north * (-drag * north) + Vector(0.0, -car.lateral_damping * state.velocity.y, 0.0)
    others = state.east * command.force[0] + state.north * command.force[1]
    # the chassis' joint is at the box's centre. What slows the car acts at the centre of mass; others push at its height, and where along
    # the box is in their torque already
    torque = (
        state.up * command.torque
        + cross(Vector(0.0, 0.0, car.mass_height), others)
        + cross(equations_of_motion.centre_of_mass(car), slowing)
    )
    torque = torque + Vector(0.0, 0.0, -car.yaw_damping * state.rate.z)
    ground, ground_torque = compute_body_ground_force(car, state)
    return Forces(slowing + others + ground, torque + ground_torque, suspension=stop, spin=wheel_torque, steer=FRONT * servo)


def compute_suspension_forces(car: CarParameters, state: CarState) -> Forces:
    """Springs and dampers of the joints, which MuJoCo's model has of its own."""
    none = Vector(0.0, 0.0, 0.0)
    carried = equations_of_motion.compute_loads(car) * car.suspension_preload  # at mid travel
    return Forces(
        none,
        none,
        suspension=-carried - car.suspension_stiffness * state.travel - car.suspension_damping * state.sinking,
        spin=-car.wheel_damping * state.spin,
        steer=-car.steering_friction * state.steering,
    )


def compute_drive_torque(car: CarParameters, drive: Float[Array, ""], spin: Float[Array, "4"]) -> Float[Array, "4"]:
    """Torque of the engine on each wheel, N m: on the front ones, less from 0.9 of `spin_limit` on. So a wheel in the air stays finite."""
    left = jnp.clip((car.spin_limit - spin) / (FADES * car.spin_limit), 0.0, 1.0)
    return drive * left * FRONT


def compute_net_wheel_torque(
    engine: Float[Array, "4"], friction: Float[Array, "4"], spin: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Torque and dry friction of each wheel, N m, with what one takes of the other taken off.

    A wheel that turns forward moves by engine - friction: the same whichever way it is written. But MuJoCo's dry friction is soft: a joint
    that holds a torque yields at a rate in proportion to it, and a car would creep against its brakes. Less the part of the engine that the
    friction takes up, nothing is left to yield to. A wheel that rolls back is slowed by engine and friction: there both stay.
    """
    taken = jnp.where(spin > -ROLLS_BACK, jnp.minimum(engine, friction), 0.0)
    return engine - taken, jnp.maximum(friction - taken, LATENT_FRICTION)


def compute_body_ground_force(car: CarParameters, state: CarState) -> tuple[Vector, Vector]:
    """Force and torque about the box's centre of the ground on the chassis' corners.

    A car on its wheels never touches; one that rolls over comes to lie on springs and dampers instead of sinking through the road.
    Friction is the damper's force, cut at the cone.
    """
    total = turn = Vector(0.0, 0.0, 0.0)
    for side in (0.5, -0.5):  # the roof's corners and the floor's, in the order of the wheels
        arm = Vector(AHEAD * (car.length / 2), LEFT * (car.width / 2), side * car.height)
        depth = -(state.height + dot(state.up, arm))
        velocity = state.velocity + cross(state.rate, arm)
        sinking = dot(state.up, velocity)
        push = jnp.where(depth > 0.0, jnp.maximum(car.body_stiffness * depth - car.body_damping * sinking, 0.0), 0.0)
        sliding = velocity - state.up * sinking
        drag = length(*sliding) * car.body_damping
        share = jnp.minimum(1.0, car.body_friction * push / jnp.maximum(drag, 1.0))
        force = state.up * push - sliding * (share * car.body_damping)
        total, turn = total + wheels(force), turn + wheels(cross(arm, force))
    return total, turn


def compute_slip_damping(car: CarParameters, state: CarState) -> Number:
    """Damping of the tyres' friction reference at the car's speed, 1/s: `tyre_slip_damping` up to `tyre_slip_speed`, then as 1/speed.

    MuJoCo's friction below the cone obeys R f = b u - a: u the slip velocity, b = damping / impedance, R the contact's regularisation and
    a the slip's acceleration, 0 in steady braking and, with `tyres.turning`, in a steady turn: f = b u / R along the wheel and across.
    A tyre's force is a stiffness times slip angle or slip ratio, which are u / speed (Pacejka, Tyre and Vehicle Dynamics, linear range).
    b ~ 1/speed makes it so: the stiffness is b speed / R, the same at every speed above `tyre_slip_speed`. Below, slip ratios lose their
    meaning and the tyre is a damper.
    """
    speed = length(dot(state.east, state.velocity), dot(state.north, state.velocity))
    return car.tyre_slip_damping / jnp.maximum(speed / car.tyre_slip_speed, 1.0)
