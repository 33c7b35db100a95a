"""Kinematic bicycle model: one integration per control step, no forces, no tyres.

Wheelbase, steering limit and longitudinal accelerations are those of the articulated car. On a road with heights, the speed is that along
the road, and gravity acts along it; a car that stands on a grade does not roll back. Contact forces are computed by the same model as
between articulated cars; they are reported and do not move the cars.
"""

import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from scenefactory_jax.core.geometry import heading_vector, safe_norm, wrap_angle
from scenefactory_jax.core.pytree import pytree_dataclass, replace, tree_where
from scenefactory_jax.core.schema import Bounds, NonNegative, Positive
from scenefactory_jax.core.types import Dynamics, Motion, Scene
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY
from scenefactory_jax.dynamics.collision import REPORT_S, collect_boxes, make_contact, report_forces
from scenefactory_jax.roadgraph.elevation import LEVEL_M, Ground, compute_grade, find_ground, find_start_ground, lift_motion


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
    mu: Float[Array, " A"]
    friction_utilization: Float[Array, " A"]
    ground: Ground | None = None  # the road under the box's centre; None: it is flat


def make(
    *,
    mass: Positive,
    wheelbase: Positive,
    rear_length: NonNegative,
    centre_height: NonNegative,
    steering_limit: Annotated[float, Bounds(above=0.0, below=math.pi / 2)],
    acceleration: NonNegative,
    deceleration: NonNegative,
    rolling: NonNegative,
    drag: NonNegative,
    air_drag: NonNegative,
    speed_limit: Positive,
    contact: dict[str, Any],
    friction: Callable[..., Any],
    control_dt: float,
    acceleration_lag_s: NonNegative = 0.0,
    steering_lag_s: NonNegative = 0.0,
) -> Dynamics:
    """Makes the backend: SceneFactory's bicycles (arXiv:2605.08528, section 4.4), integrated once per control step instead of four times.

    Args:
        mass: kg; for the contact force only.
        wheelbase: m.
        rear_length: from the rear axle to the box's centre, m.
        centre_height: of the box's centre above the ground, m.
        steering_limit: rad; steering follows the command without delay.
        acceleration: at full throttle, m/s^2.
        deceleration: at full brake, m/s^2; it stops the car and never reverses it.
        rolling: deceleration of rolling resistance, m/s^2.
        drag: deceleration per speed, 1/s; `air_drag` per speed squared, 1/m.
        speed_limit: m/s.
        contact: values of `ContactLaw`.
        friction: (weather, position, speed) -> friction coefficient. It does not limit the motion: `friction_utilization` is the
            acceleration over mu g, above 1 where a real car would slide.
        acceleration_lag_s, steering_lag_s: time constants of first-order lags of the pedals and of the steering; 0: none.

    Raises:
        ConfigError: a number out of range, or an unknown, missing or wrong value of `contact`, by name.
    """
    collision = make_contact(contact, height=LEVEL_M, step_s=REPORT_S)
    limits = Limits(wheelbase, rear_length, steering_limit, acceleration, deceleration, rolling, drag, air_drag, speed_limit)

    def advance(scene: Scene, body: Body, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> Body:
        moved = integrate_bicycle(body, jnp.clip(action, -1.0, 1.0), limits, dt=control_dt)
        if scene.elevation is not None and body.ground is not None:
            moved = replace(moved, ground=find_ground(scene.elevation, moved.position, body.ground.height))
        mu = friction(scene.weather, body.position, body.speed)
        cars = collect_boxes(read(moved, height=centre_height), scene.agents.size, active, mass)
        force = report_forces(collision, cars, scene.traffic, control_dt)
        along, across = (moved.speed - body.speed) / control_dt, moved.yaw_rate * moved.speed
        acceleration = safe_norm(jnp.stack([along, across], axis=-1))
        moved = replace(moved, contact_force=force, mu=mu, friction_utilization=acceleration / (mu * GRAVITY))
        inactive = replace(body, contact_force=jnp.zeros_like(force), friction_utilization=jnp.zeros_like(force))
        return tree_where(active, moved, inactive)

    plain = Dynamics(init=init, advance=advance, read=functools.partial(read, height=centre_height))
    if acceleration_lag_s == 0.0 and steering_lag_s == 0.0:
        return plain
    return lag_commands(plain, acceleration_lag_s=acceleration_lag_s, steering_lag_s=steering_lag_s, control_dt=control_dt)


@pytree_dataclass
class LaggedBody:
    """Cars of one world whose commands act with a lag."""

    body: Body
    command: Float[Array, "A 3"]  # throttle, steer and brake as they act


def lag_commands(plain: Dynamics, *, acceleration_lag_s: float, steering_lag_s: float, control_dt: float) -> Dynamics:
    """Makes a backend whose throttle, steer and brake follow their commands with first-order lags, as in nuPlan's kinematic bicycle.

    x' = x + dt / (dt + lag) (command - x): the implicit Euler step. Acceleration is linear in the pedals, so their lag is its lag.
    """
    share = control_dt / (control_dt + jnp.array([acceleration_lag_s, steering_lag_s, acceleration_lag_s], jnp.float32))

    def start(key: PRNGKeyArray, scene: Scene) -> LaggedBody:
        return LaggedBody(plain.init(key, scene), jnp.zeros((len(scene.agents.yaw), 3), jnp.float32))

    def advance(scene: Scene, body: LaggedBody, action: Float[Array, "A 3"], active: Bool[Array, " A"]) -> LaggedBody:
        lowest = jnp.array([0.0, -1.0, 0.0])  # a released pedal is at 0, not below
        command = body.command + share * (jnp.clip(action, lowest, 1.0) - body.command)
        command = jnp.where(active[:, None], command, body.command)
        return LaggedBody(plain.advance(scene, body.body, command, active), command)

    return Dynamics(init=start, advance=advance, read=lambda body: plain.read(body.body))


class Limits(NamedTuple):
    """Parameters of the motion: see `make`."""

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
    """Places cars at their starts."""
    agents = scene.agents
    zeros = (jnp.zeros(agents.yaw.shape, jnp.float32) for _ in range(6))  # separate arrays: none may be donated twice
    return Body(agents.position, agents.yaw, agents.speed, *zeros, ground=find_start_ground(scene))


def integrate_bicycle(body: Body, action: Float[Array, "A 3"], limits: Limits, *, dt: float) -> Body:
    """Integrates throttle, steer and brake over `dt` seconds."""
    throttle, brake = jnp.maximum(action[:, 0], 0.0), jnp.maximum(action[:, 2], 0.0)
    push = limits.acceleration * throttle - limits.deceleration * brake
    push = push - limits.rolling - (limits.drag + limits.air_drag * body.speed) * body.speed
    sine, cosine = (None, None) if body.ground is None else compute_grade(body.ground, body.yaw)
    push = push if sine is None else push - GRAVITY * sine
    speed = jnp.clip(body.speed + push * dt, 0.0, limits.speed)
    mean = 0.5 * (body.speed + speed)
    steer = limits.steering * action[:, 1]
    slip_angle = jnp.arctan(limits.rear_length / limits.wheelbase * jnp.tan(steer))
    yaw_rate = mean * jnp.cos(slip_angle) * jnp.tan(steer) / limits.wheelbase
    chord = heading_vector(body.yaw + slip_angle + 0.5 * yaw_rate * dt)  # the chord of an arc points along the heading at half the arc
    way = mean * dt if cosine is None else mean * dt * cosine
    return replace(
        body,
        position=body.position + way[:, None] * chord,
        yaw=wrap_angle(body.yaw + yaw_rate * dt),
        speed=speed,
        steer=steer,
        slip_angle=slip_angle,
        yaw_rate=yaw_rate,
    )


def read(body: Body, *, height: float) -> Motion:
    """Reads the motion of the cars."""
    flat = body.speed[:, None] * heading_vector(body.yaw + body.slip_angle)
    if body.ground is not None:
        flat = flat * compute_grade(body.ground, body.yaw)[1][:, None]
    return make_motion(body, flat, body.steer, height=height)


def make_motion(body: Any, velocity: Float[Array, "A 2"], steer: Float[Array, " A"], *, height: float) -> Motion:
    """Makes the motion of upright cars without tyres, lifted onto the road."""
    zero = jnp.zeros_like(body.yaw)
    motion = Motion(
        position=jnp.concatenate([body.position, jnp.full_like(zero, height)[:, None]], axis=-1),
        velocity=jnp.concatenate([velocity, zero[:, None]], axis=-1),
        yaw=body.yaw,
        yaw_rate=body.yaw_rate,
        upright=jnp.ones_like(zero),
        steer=steer,
        contact_force=body.contact_force,
        mu=body.mu,
        friction_utilization=body.friction_utilization,
        slip=zero,
    )
    return lift_motion(motion, body.ground)
