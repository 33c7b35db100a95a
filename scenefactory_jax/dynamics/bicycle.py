"""Kinematic single-track cars: one integration a control step, no forces, no tyres.

The same wheelbase, steering limit and longitudinal capability as the articulated car, so that the two differ in physics and in nothing
else. Contact is reported with the articulated cars' contact model, as the force that would act, and moves nobody.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm, wrap_angle
from scenefactory_jax.core.instantiate import check_number, check_numbers, instantiate
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.types import Dynamics, Motion, Scene
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.dynamics.collision import Contact, advance_boxes, collect_boxes


@pytree_dataclass
class Body:
    """Cars of one world; every leaf has the agent axis first."""

    position: Float[Array, "A 2"]  # of the box's centre
    yaw: Float[Array, " A"]
    speed: Float[Array, " A"]
    steer: Float[Array, " A"]
    slip_angle: Float[Array, " A"]  # between the heading and the velocity of the box's centre
    yaw_rate: Float[Array, " A"]
    contact_force: Float[Array, " A"]
    grip: Float[Array, " A"]
    friction_utilization: Float[Array, " A"]


def make(
    *,
    mass: float,
    wheelbase: float,
    rear_length: float,
    centre_height: float,
    steering_limit: float,
    acceleration: float,
    deceleration: float,
    rolling: float,
    drag: float,
    air_drag: float,
    speed_limit: float,
    contact: dict[str, Any],
    grip: Callable[..., Any],
    control_dt: float,
) -> Dynamics:
    """Kinematic bicycles, SceneFactory's (arXiv:2605.08528, section 4.4), integrated once a control step.

    The published code integrates four times.

    Args:
        mass: kg; it decides the contact force and nothing else.
        wheelbase: m.
        rear_length: from the rear axle to the box's centre, m.
        centre_height: of the box's centre above the ground, m.
        steering_limit: rad; steering follows the command at once.
        acceleration: at full throttle, m/s^2.
        deceleration: at full brake, m/s^2; it stops the car and never reverses it.
        rolling: deceleration of rolling resistance, m/s^2.
        drag: deceleration per speed, 1/s; `air_drag` per speed squared, 1/m.
        speed_limit: m/s.
        contact: numbers of `contact.make`.
        grip: (weather, position, speed) -> friction coefficient. Unused: `friction_utilization` is the acceleration over friction times
            gravity and exceeds one where a real car would slide.

    Raises:
        ConfigError: a number that no car has, or an unknown, missing or wrong one of `contact`, by name.
    """
    check_numbers({"mass": mass, "wheelbase": wheelbase, "speed_limit": speed_limit}, where="dynamics", above=0.0)
    check_number(steering_limit, where="dynamics.steering_limit", above=0.0, below=math.pi / 2)
    pushes = {"acceleration": acceleration, "deceleration": deceleration, "rolling": rolling, "drag": drag, "air_drag": air_drag}
    check_numbers({"rear_length": rear_length, "centre_height": centre_height, **pushes}, where="dynamics", least=0.0)
    entry = {**contact, "_target_": "make"}
    meet: Contact = instantiate(entry, builtins="scenefactory_jax.dynamics.collision", where="dynamics.contact", height=math.inf)()
    limits = Limits(wheelbase, rear_length, steering_limit, acceleration, deceleration, rolling, drag, air_drag, speed_limit)

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        moved = integrate_bicycle(body, jnp.clip(action, -1.0, 1.0), limits, dt=control_dt)
        mu = grip(scene.weather, body.position, body.speed)
        cars = collect_boxes(read(moved, height=centre_height), scene.agents.size, active, mass)
        _, _, force = meet.forces(cars, advance_boxes(meet.neighbours(cars, scene.traffic), control_dt))
        along, across = (moved.speed - body.speed) / control_dt, moved.yaw_rate * moved.speed
        wanted = safe_norm(jnp.stack([along, across], axis=-1))
        moved = replace(moved, contact_force=force, grip=mu, friction_utilization=wanted / (mu * GRAVITY))
        held = replace(body, contact_force=jnp.zeros_like(force), friction_utilization=jnp.zeros_like(force))
        return tree_where(active, moved, held)

    return Dynamics(init=init, advance=advance, read=functools.partial(read, height=centre_height))


class Limits(NamedTuple):
    """The numbers of `make` that decide how a car moves."""

    wheelbase: float
    rear_length: float
    steering: float
    acceleration: float
    deceleration: float
    rolling: float
    drag: float
    air_drag: float
    speed: float


def init(key: PRNGKeyArray, scene: Scene) -> Body:
    """Cars at their starts."""
    agents = scene.agents
    zeros = (jnp.zeros(agents.yaw.shape, jnp.float32) for _ in range(6))  # an array each: none may be donated twice
    return Body(agents.position, agents.yaw, agents.speed, *zeros)


def integrate_bicycle(body: Body, action: Float[Array, "A 3"], limits: Limits, *, dt: float) -> Body:
    """One integration of throttle, steer and brake over `dt` seconds."""
    throttle, brake = jnp.maximum(action[:, 0], 0.0), jnp.maximum(action[:, 2], 0.0)
    push = limits.acceleration * throttle - limits.deceleration * brake
    push = push - limits.rolling - (limits.drag + limits.air_drag * body.speed) * body.speed
    speed = jnp.clip(body.speed + push * dt, 0.0, limits.speed)
    mean = 0.5 * (body.speed + speed)
    steer = limits.steering * action[:, 1]
    slip_angle = jnp.arctan(limits.rear_length / limits.wheelbase * jnp.tan(steer))
    yaw_rate = mean * jnp.cos(slip_angle) * jnp.tan(steer) / limits.wheelbase
    chord = heading_vector(body.yaw + slip_angle + 0.5 * yaw_rate * dt)  # the chord of an arc points along the heading half way
    return replace(
        body,
        position=body.position + (mean * dt)[:, None] * chord,
        yaw=wrap_angle(body.yaw + yaw_rate * dt),
        speed=speed,
        steer=steer,
        slip_angle=slip_angle,
        yaw_rate=yaw_rate,
    )


def read(body: Body, *, height: float) -> Motion:
    """What the rest of the system may know of the cars."""
    flat = body.speed[:, None] * heading_vector(body.yaw + body.slip_angle)
    zero = jnp.zeros_like(body.speed)
    return Motion(
        position=jnp.concatenate([body.position, jnp.full_like(zero, height)[:, None]], axis=-1),
        velocity=jnp.concatenate([flat, zero[:, None]], axis=-1),
        yaw=body.yaw,
        yaw_rate=body.yaw_rate,
        upright=jnp.ones_like(zero),
        steer=body.steer,
        contact_force=body.contact_force,
        mu=body.grip,
        friction_utilization=body.friction_utilization,
        slip=zero,
    )
