"""What acts on an articulated car besides gravity and its tyres, as generalised forces: servo, engine, bump stops, dampings, air, others.

And how much its tyres yield.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from scenefactory_jax.dynamics.car import CarParameters, Places
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


def slip_damping(car: CarParameters, qvel: Float[Array, "16"]) -> Float[Array, ""]:
    """Damping of the tyres' friction reference at the car's speed, 1/s: `tyre_slip_damping` up to `tyre_slip_speed`, then as 1/speed.

    MuJoCo's friction below the cone obeys R f = b u - a: u the slip velocity, b = damping / impedance, R the contact's regularisation and
    a the acceleration of its row, J qacc. Under steady braking a is 0. In a steady turn it is the centripetal acceleration f / m, m the
    mass on the wheel: the row does not see that the rolling direction turns. So f = b u / R along the wheel and f = b u / (R + 1/m) across.
    A tyre's force is a stiffness times slip angle or slip ratio, which are u / speed (Pacejka, Tyre and Vehicle Dynamics, linear range).
    b ~ 1/speed makes it so: the cornering stiffness is b speed / (R + 1/m), the same at every speed above `tyre_slip_speed`. Below, slip
    ratios lose their meaning and the tyre is a damper.
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
