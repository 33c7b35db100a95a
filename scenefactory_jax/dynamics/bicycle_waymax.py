"""Waymax's invertible bicycle: acceleration and curvature in place of pedals and a steering angle, and its inverse.

Formulas: Waymax (arXiv:2310.08710). The speed is the length of the velocity, so a car that brakes below zero moves backwards in
that step and forwards in the next. On a road with heights, motion and velocity are those seen from above. Contact forces are computed as
between articulated cars; they are reported and do not move the cars.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm, wrap_angle
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.schema import NonNegative, Positive
from scenefactory_jax.core.types import Dynamics, Motion, Scene
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.dynamics.bicycle import make_motion
from scenefactory_jax.dynamics.collision import REPORT_S, collect_boxes, make_contact, report_forces
from scenefactory_jax.roadgraph.elevation import LEVEL_M, Ground, find_ground, find_start_ground

STANDING_MPS = 0.6  # slower, the direction of the velocity says nothing about the heading


@pytree_dataclass
class Body:
    """Cars of one world; every leaf has the agent axis first."""

    position: Float[Array, "A 2"]  # of the box's centre
    yaw: Float[Array, " A"]
    velocity: Float[Array, "A 2"]
    yaw_rate: Float[Array, " A"]
    curvature: Float[Array, " A"]  # of the last step, 1/m
    contact_force: Float[Array, " A"]
    mu: Float[Array, " A"]
    friction_utilization: Float[Array, " A"]
    ground: Ground | None = None  # the road under the box's centre; None: it is flat


def make(
    *,
    mass: Positive,
    wheelbase: Positive,
    centre_height: NonNegative,
    acceleration: Positive,
    curvature: Positive,
    contact: dict[str, Any],
    friction: Callable[..., Any],
    control_dt: float,
) -> Dynamics:
    """Makes the backend. The acceleration is `acceleration` x (throttle - brake), the curvature `curvature` x steering.

    With `actions=acceleration` the two numbers are Waymax's normalised action. Waymax steps at 10 Hz (`timing=waymax`).

    Args:
        mass: kg; for the contact force only.
        wheelbase: m; for the report of a steering angle only.
        centre_height: of the box's centre above the ground, m.
        acceleration: of an action of 1, m/s^2.
        curvature: of a steering of 1, 1/m.
        contact: values of `ContactLaw`.
        friction: (weather, position, speed) -> friction coefficient. It does not limit the motion.

    Raises:
        ConfigError: a number out of range, or an unknown, missing or wrong value of `contact`, by name.
    """
    collision = make_contact(contact, height=LEVEL_M, step_s=REPORT_S)
    read_motion = functools.partial(read, height=centre_height, wheelbase=wheelbase)

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        throttle, steer, brake = jnp.clip(action, -1.0, 1.0).T
        push, bend = acceleration * (throttle - brake), curvature * steer
        moved = integrate_acceleration(body, push, bend, dt=control_dt)
        if scene.elevation is not None and body.ground is not None:
            moved = replace(moved, ground=find_ground(scene.elevation, moved.position, body.ground.height))
        speed = safe_norm(moved.velocity)
        mu = friction(scene.weather, body.position, speed)
        cars = collect_boxes(read_motion(moved), scene.agents.size, active, mass)
        force = report_forces(collision, cars, scene.traffic, control_dt)
        total = safe_norm(jnp.stack([push, moved.yaw_rate * speed], axis=-1))
        moved = replace(moved, contact_force=force, mu=mu, friction_utilization=total / (mu * GRAVITY))
        inactive = replace(body, contact_force=jnp.zeros_like(force), friction_utilization=jnp.zeros_like(force))
        return tree_where(active, moved, inactive)

    return Dynamics(init=init, advance=advance, read=read_motion)


def init(key: PRNGKeyArray, scene: Scene) -> Body:
    """Places cars at their starts."""
    agents = scene.agents
    velocity = agents.speed[:, None] * heading_vector(agents.yaw)
    zeros = (jnp.zeros(agents.yaw.shape, jnp.float32) for _ in range(5))  # separate arrays: none may be donated twice
    return Body(agents.position, agents.yaw, velocity, *zeros, ground=find_start_ground(scene))


def integrate_acceleration(body: Body, acceleration: Float[Array, " A"], curvature: Float[Array, " A"], *, dt: float) -> Body:
    """Integrates an acceleration (m/s^2) and a curvature (1/m) over `dt` seconds."""
    speed = safe_norm(body.velocity)
    way = speed * dt + 0.5 * acceleration * dt**2
    yaw = wrap_angle(body.yaw + curvature * way)
    return replace(
        body,
        position=body.position + body.velocity * dt + (0.5 * acceleration * dt**2)[:, None] * heading_vector(body.yaw),
        yaw=yaw,
        velocity=(speed + acceleration * dt)[:, None] * heading_vector(yaw),
        yaw_rate=curvature * way / dt,
        curvature=curvature,
    )


def compute_inverse_action(
    yaw: Float[Array, "*n"], velocity: Float[Array, "*n 2"], next_yaw: Float[Array, "*n"], next_velocity: Float[Array, "*n 2"], *, dt: Any
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes the acceleration (m/s^2) and the curvature (1/m) that lead from one state to the next, not clipped.

    The next heading is the direction of the next velocity above STANDING_MPS, else `next_yaw`. The curvature is 0 if either speed is below
    STANDING_MPS.
    """
    speed, next_speed = safe_norm(velocity), safe_norm(next_velocity)
    acceleration = (next_speed - speed) / dt
    moving = next_speed > STANDING_MPS
    course = jnp.where(moving, jnp.arctan2(next_velocity[..., 1], jnp.where(moving, next_velocity[..., 0], 1.0)), next_yaw)
    way = speed * dt + 0.5 * acceleration * dt**2
    standing = (speed < STANDING_MPS) | (next_speed < STANDING_MPS)
    curvature = wrap_angle(course - yaw) / jnp.where(standing, 1.0, way)
    return acceleration, jnp.where(standing, 0.0, curvature)


def read(body: Body, *, height: float, wheelbase: float) -> Motion:
    """Reads the motion of the cars."""
    return make_motion(body, body.velocity, jnp.arctan(wheelbase * body.curvature), height=height)
