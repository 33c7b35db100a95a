"""Position and velocity of a car in its own axes: conversion from and to MuJoCo's arrays, and integration in time."""

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.types import Elevation
from scenefactory_jax.dynamics.articulated.parameters import AHEAD, LEFT, CarParameters
from scenefactory_jax.dynamics.articulated.vector import Number, Vector, dot, length
from scenefactory_jax.roadgraph.elevation import Ground, find_ground

TINY = 1e-6  # rad/s


class CarState(NamedTuple):
    """A car's position and velocity, in its own axes."""

    height: Array  # of the box's centre over the plane of the road (on hills: over that under each wheel), m
    normal: Vector  # of that plane
    east: Vector  # the x, y and z axes of the world
    north: Vector
    up: Vector
    velocity: Vector  # of the box's centre, m/s
    rate: Vector  # angular velocity, rad/s
    travel: Float[Array, "4"]  # of each suspension, m
    travel_rate: Float[Array, "4"]  # m/s
    steer: Float[Array, "4"]  # rad; 0 for the rear wheels
    steer_rate: Float[Array, "4"]  # rad/s
    spin: Float[Array, "4"]  # rate, rad/s
    hub: Vector  # position of each wheel centre, m
    axle: Vector  # spin axis of each wheel


def from_mujoco(car: CarParameters, qpos: Float[Array, "17"], qvel: Float[Array, "16"], elevation: Elevation | None = None) -> CarState:
    """Computes the state from MuJoCo's arrays, on a flat road or on one with heights."""
    east, north, up = (Vector(*row) for row in rotation_matrix(qpos[3:7]))
    velocity = east * qvel[0] + north * qvel[1] + up * qvel[2]
    travel, steer, _ = _split_joints(qpos[7:])
    travel_rate, steer_rate, spin = _split_joints(qvel[6:])
    hub = Vector(AHEAD * (car.wheelbase / 2), LEFT * (car.track / 2), car.wheel_height + travel)
    axle = Vector(-jnp.sin(steer), jnp.cos(steer), 0.0)
    height, normal = (qpos[2], up) if elevation is None else _find_road(car, elevation, qpos, (east, north, up), hub)
    joints = travel, travel_rate, steer, steer_rate, spin
    return CarState(height, normal, east, north, up, velocity, Vector(*qvel[3:6]), *joints, hub, axle)


def _find_road(
    car: CarParameters, elevation: Elevation, qpos: Float[Array, "17"], axes: tuple[Vector, Vector, Vector], hub: Vector
) -> tuple[Array, Vector]:
    """Computes the tangent plane of the road under each wheel: distance of the box's centre from it, m, and its normal."""
    x, y, z = (qpos[i] + dot(axis, hub) for i, axis in enumerate(axes))
    ground = find_ground(elevation, jnp.stack([x, y], axis=-1), z - car.wheel_radius)
    along_x, along_y = ground.slope[:, 0], ground.slope[:, 1]
    upright = 1.0 / jnp.sqrt(1.0 + along_x**2 + along_y**2)
    east, north, up = axes
    normal = (up - east * along_x - north * along_y) * upright
    return (z - ground.height) * upright - dot(normal, hub), normal


def place_on_road(ground: Ground, qpos: Float[Array, "17"], qvel: Float[Array, "16"]) -> tuple[Array, Array]:
    """Places an upright car over a flat road at height 0 on the road at its place: tilted, with its velocity, by the shortest turn."""
    x, y = ground.slope
    upright = 1.0 / jnp.sqrt(1.0 + x**2 + y**2)
    tilt = jnp.stack([1.0 + upright, y * upright, -x * upright, jnp.zeros_like(x)])  # from the world's up to the normal
    tilt = tilt / length(*tilt)
    velocity = [dot(Vector(*row), Vector(*qvel[:3])) for row in rotation_matrix(tilt)]
    place = [*qpos[:2], ground.height + qpos[2] / upright, *multiply_quaternions(tilt, qpos[3:7])]
    return jnp.concatenate([jnp.stack(place), qpos[7:]]), qvel.at[:3].set(jnp.stack(velocity))


def multiply_quaternions(first: Iterable[Array], second: Iterable[Array]) -> list[Array]:
    """Computes the rotation by the second quaternion (w, x, y, z), then by the first."""
    w, i, j, k = first
    a, b, c, d = second
    return [w * a - i * b - j * c - k * d, w * b + i * a + j * d - k * c, w * c - i * d + j * a + k * b, w * d + i * c - j * b + k * a]


def rotation_matrix(quaternion: Float[Array, "4 *cars"]) -> list[list[Array]]:
    """Computes the rotation matrix of a unit quaternion (w, x, y, z).

    Its columns are the body's axes in the world, its rows the world's axes in the body.
    """
    w, x, y, z = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def flatten(base: list[Number], wheel: list[Number], state: CarState) -> Float[Array, "16"]:
    """Arranges velocities, accelerations or forces by joint, in MuJoCo's order and axes.

    Args:
        base: 3 linear and 3 angular components of the chassis, in the car's axes.
        wheel: suspension, spin and steering of the wheels.
    """
    linear = Vector(*base[:3])
    world = [dot(axis, linear) for axis in (state.east, state.north, state.up)]
    suspension, spin, steer = wheel
    joints = [number[wheel] for wheel in range(4) for number in ((suspension, steer, spin) if wheel < 2 else (suspension, spin))]
    return jnp.stack([*world, *base[3:], *joints])


def unflatten(joints: Float[Array, "16"], state: CarState) -> tuple[list[Number], list[Number]]:
    """Computes the inverse of `flatten`."""
    linear = state.east * joints[0] + state.north * joints[1] + state.up * joints[2]
    suspension, steer, spin = _split_joints(joints[6:])
    return [*linear, *joints[3:6]], [suspension, spin, steer]


def _split_joints(joints: Float[Array, "10"]) -> tuple[Float[Array, "4"], Float[Array, "4"], Float[Array, "4"]]:
    """Splits joints, which MuJoCo stores wheel by wheel (rear wheels without steering), into suspension, steering and spin [4]."""
    front, rear = joints[:6].reshape(2, 3), joints[6:].reshape(2, 2)
    suspension, spin = jnp.concatenate([front[:, 0], rear[:, 0]]), jnp.concatenate([front[:, 2], rear[:, 1]])
    return suspension, jnp.concatenate([front[:, 1], jnp.zeros(2)]), spin


def integrate(
    qpos: Float[Array, "17"], qvel: Float[Array, "16"], acceleration: Float[Array, "16"], *, physics_dt: float
) -> tuple[Float[Array, "17"], Float[Array, "16"]]:
    """Integrates by semi-implicit Euler: the new velocities move the car. Angular velocity is in the car's axes."""
    qvel = qvel + physics_dt * acceleration
    x, y, z = qvel[3:6]
    rate = length(x, y, z)
    rotates, half = rate > TINY, 0.5 * physics_dt
    scale = jnp.where(rotates, jnp.sin(half * rate) / jnp.where(rotates, rate, 1.0), half)
    a, b, c, d = jnp.cos(half * rate), scale * x, scale * y, scale * z
    rotated = multiply_quaternions(qpos[3:7], (a, b, c, d))
    unit = length(*rotated)
    joints = qpos[7:] + physics_dt * qvel[6:]
    return jnp.concatenate([qpos[:3] + physics_dt * qvel[:3], jnp.stack([part / unit for part in rotated]), joints]), qvel
