"""What acts on an articulated car besides gravity and its tyres, as generalised forces: servo, engine, bump stops, dampings, air, others.

And how much its tyres yield.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.car import AHEAD, FADES, LATENT_FRICTION, LEFT, ROLLS_BACK, CarParameters, Places
from scenefactory_jax.geometry import norm

CORNERS = np.array([[x, y, z] for x in (0.5, -0.5) for y in (0.5, -0.5) for z in (0.5, -0.5)])  # of a box of size one


class Command(NamedTuple):
    """What one car is told for a control step, and what the road and others do to it."""

    steer: Float[Array, ""]  # wanted angle
    drive: Float[Array, ""]  # torque of a front wheel
    brake: Float[Array, "4"]  # largest torque of each wheel's brake
    mu: Float[Array, "4"]
    force: Float[Array, "2"]  # from other cars, in the world's plane
    torque: Float[Array, ""]


def wanted(car: CarParameters, action: Float[Array, "A 3"]) -> tuple[Float[Array, " A"], Float[Array, " A"], Float[Array, "A 4"]]:
    """Throttle, steer and brake in [-1, 1] as steering angle, torque of a driven wheel, and largest torque of each brake."""
    throttle, steer, brake = jnp.clip(action, -1.0, 1.0).T
    brake = jnp.maximum(brake, 0.0)
    front, rear = car.brake_torque_front * brake, car.brake_torque_rear * brake
    return car.steering_limit * steer, car.drive_torque * jnp.maximum(throttle, 0.0), jnp.stack([front, front, rear, rear], axis=-1)


def generalised(
    car: CarParameters,
    at: Places,
    qpos: Float[Array, "17"],
    qvel: Float[Array, "16"],
    command: Command,
    wheel_torque: Float[Array, "4"],
) -> Float[Array, "16"]:
    """All applied forces of one car, N and N m, in MuJoCo's joint space.

    Args:
        car: numbers of this car.
        at: addresses of its joints.
        wheel_torque: of engine and latched brakes on each wheel.
    """
    angle, rate = qpos[at.steer_q], qvel[at.steer_v]
    servo = car.steering_stiffness * (command.steer - angle) - car.steering_damping * rate
    servo = jnp.clip(servo, -car.steering_torque, car.steering_torque)
    travel = qpos[at.suspension_q]
    stop = -car.stop_stiffness * (travel - jnp.clip(travel, -car.suspension_travel, car.suspension_travel))

    rotation = matrix(qpos[3:7])
    sideways = -car.lateral_damping * (qvel[:3] @ rotation[:, 1]) * rotation[:, 1]
    air = -car.air_drag * norm(qvel[:2]) * qvel[:2]
    force = sideways + jnp.concatenate([command.force + air, jnp.zeros(1)])
    # the free joint's torque is about the box's centre and in the body's frame; forces act at the centre of mass below it
    arm = jnp.stack([jnp.asarray(x, jnp.float32) for x in (car.mass_forward, 0.0, car.mass_height)])
    torque = command.torque * rotation[2] + jnp.cross(arm, force @ rotation)
    torque = torque.at[2].add(-car.yaw_damping * qvel[5])
    ground, ground_torque = scrape(car, qpos, qvel, rotation)
    applied = jnp.zeros(16).at[:3].set(force + ground).at[3:6].set(torque + ground_torque)
    return applied.at[at.suspension_v].set(stop).at[at.steer_v].set(servo).at[at.spin_v].set(wheel_torque)


def pulling(car: CarParameters, drive: Float[Array, ""], spin: Float[Array, "4"]) -> Float[Array, "4"]:
    """Torque of the engine on each wheel, N m: on the front ones, less from 0.9 of `spin_limit` on. So a wheel in the air stays finite."""
    left = jnp.clip((car.spin_limit - spin) / (FADES * car.spin_limit), 0.0, 1.0)
    return drive * left * jnp.array([1.0, 1.0, 0.0, 0.0])


def held(
    engine: Float[Array, "4"], friction: Float[Array, "4"], spin: Float[Array, "4"]
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Torque and dry friction of each wheel, N m, with what one takes of the other taken off.

    A wheel that turns forward moves by engine - friction: the same whichever way it is written. But MuJoCo's dry friction is soft: a joint
    that holds a torque yields at a rate in proportion to it, and a car would creep against its brakes. Less the part of the engine that the
    friction takes up, nothing is left to yield to. A wheel that rolls back is slowed by engine and friction: there both stay.
    """
    taken = jnp.where(spin > -ROLLS_BACK, jnp.minimum(engine, friction), 0.0)
    return engine - taken, jnp.maximum(friction - taken, LATENT_FRICTION)


def scrape(
    car: CarParameters, qpos: Float[Array, "17"], qvel: Float[Array, "16"], rotation: Float[Array, "3 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Force (world) and torque about the box's centre (body frame) of the ground on the chassis' corners.

    A car on its wheels never touches; one that rolls over comes to lie on springs and dampers instead of sinking through the road.
    Friction is the damper's force, cut at the cone.
    """
    arm = CORNERS * jnp.stack([jnp.asarray(x, jnp.float32) for x in (car.length, car.width, car.height)])
    depth = -(qpos[2] + arm @ rotation[2])
    velocity = qvel[:3] + jnp.cross(qvel[3:6], arm) @ rotation.T
    push = jnp.where(depth > 0.0, jnp.maximum(car.body_stiffness * depth - car.body_damping * velocity[:, 2], 0.0), 0.0)
    drag = -car.body_damping * velocity[:, :2]
    share = jnp.minimum(1.0, car.body_friction * push / jnp.maximum(norm(drag), 1.0))
    force = jnp.concatenate([share[:, None] * drag, push[:, None]], axis=1)
    return force.sum(0), jnp.cross(arm, force @ rotation).sum(0)


def turning(
    car: CarParameters, at: Places, qpos: Float[Array, "17"], qvel: Float[Array, "16"], arm: Float[Array, "4 3"]
) -> Float[Array, "4 3"]:
    """Part of the slip's acceleration at each tyre's contact that J qacc leaves out, in the world's axes, m/s^2.

    A contact's slip u = J qvel changes by J qacc + dJ/dt qvel. MuJoCo's reference leaves the second term out. A wheel that rolls through a
    bend has u constant, J qacc the centripetal acceleration, and dJ/dt qvel its opposite, from the axle that turns with the car: without
    it, the tyre would be softer in a bend than along the wheel, by the car's mass (see `slip_damping`).

    The contact stays below the hub: it is no point of the wheel, and the wheel's spin does not carry it round.

    Args:
        arm: from each hub to its contact, in the world's axes, m.
    """
    rotation = matrix(qpos[3:7])
    up, whirl = rotation[:, 2], rotation @ qvel[3:6]
    angle, rate = (jnp.concatenate([x, jnp.zeros(2)]) for x in (qpos[at.steer_q], qvel[at.steer_v]))
    place = jnp.stack([AHEAD * car.wheelbase / 2, LEFT * car.track / 2, car.wheel_height + qpos[at.suspension_q]], axis=-1) @ rotation.T
    axle = jnp.stack([-jnp.sin(angle), jnp.cos(angle), jnp.zeros(4)], axis=-1) @ rotation.T
    hub = jnp.cross(whirl, jnp.cross(whirl, place) + 2.0 * qvel[at.suspension_v][:, None] * up)
    steered = rate[:, None] * up
    spun = jnp.cross(whirl, steered) + jnp.cross(whirl + steered, qvel[at.spin_v][:, None] * axle)
    return hub + jnp.cross(spun, arm)


def slip_damping(car: CarParameters, qvel: Float[Array, "16"]) -> Float[Array, ""]:
    """Damping of the tyres' friction reference at the car's speed, 1/s: `tyre_slip_damping` up to `tyre_slip_speed`, then as 1/speed.

    MuJoCo's friction below the cone obeys R f = b u - a: u the slip velocity, b = damping / impedance, R the contact's regularisation and
    a the slip's acceleration, 0 in steady braking and, with `turning`, in a steady turn: f = b u / R along the wheel and across.
    A tyre's force is a stiffness times slip angle or slip ratio, which are u / speed (Pacejka, Tyre and Vehicle Dynamics, linear range).
    b ~ 1/speed makes it so: the stiffness is b speed / R, the same at every speed above `tyre_slip_speed`. Below, slip ratios lose their
    meaning and the tyre is a damper.
    """
    return car.tyre_slip_damping / jnp.maximum(norm(qvel[:2]) / car.tyre_slip_speed, 1.0)


def matrix(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a unit quaternion (w, x, y, z); its columns are the body's axes in the world."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
