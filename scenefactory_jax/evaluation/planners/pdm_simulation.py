"""PDM-Closed's simulation of proposals: nuPlan's LQR tracker and its kinematic bicycle with lags, for all proposals of one agent at once.

The speeds and curvatures that are tracked are those of the proposal and of its path themselves, where nuPlan fits them to sampled poses.
"""

import dataclasses
import math
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.geometry import cross, dot, heading_vector, wrap_angle
from scenefactory_jax.core.schema import Bounds, Count, NonNegative, Positive
from scenefactory_jax.env.observations.planning import PlanningView
from scenefactory_jax.evaluation.planners import pdm_proposals
from scenefactory_jax.evaluation.planners.pdm_proposals import PathPoints, Proposals
from scenefactory_jax.evaluation.planners.tracker import Tracker, find_largest_angle

SLOW_MPS = 0.5  # slower, any friction holds the car in the sharpest bend


@dataclasses.dataclass(frozen=True)
class SimulationConfig:
    """The key `simulation`; described in `conf/policy/pdm_closed.yaml`."""

    steps: Count
    dt_s: Positive
    horizon: Count
    speed_weight: Positive
    acceleration_weight: Positive
    lateral_weight: NonNegative
    heading_weight: NonNegative
    steering_rate_weight: Positive
    stop_mps: NonNegative
    stop_gain: NonNegative
    acceleration_lag_s: NonNegative
    steering_lag_s: NonNegative
    steering_limit_rad: Annotated[float, Bounds(above=0, below=math.pi / 2)]


class Car(NamedTuple):
    """States of the bicycle about its rear axle, one for each proposal."""

    position: Float[Array, "*n 2"]
    yaw: Float[Array, "*n"]
    speed: Float[Array, "*n"]
    acceleration: Float[Array, "*n"]
    steer: Float[Array, "*n"]


class Simulated(NamedTuple):
    """States of proposals over time, the present first, and what the tracker asks at present."""

    car: Car  # [N, T]
    acceleration: Float[Array, " N"]  # asked at the first step
    steer: Float[Array, " N"]


def simulate(
    view: PlanningView,
    proposals: Proposals,
    config: SimulationConfig,
    tracker: Tracker,
    *,
    limit_mps2: Float[Array, ""] | None = None,
) -> Simulated:
    """Simulates all proposals of one agent; they cover the steps of the simulation and of the tracker's horizon behind it.

    Args:
        limit_mps2: see `advance`.
    """
    offset = proposals.offset[:, None]
    path = pdm_proposals.find_path_points(view.line, proposals.arc - tracker.rear_m, offset)
    count = len(proposals.offset)
    flat = lambda value: jnp.broadcast_to(value, (count,))  # noqa: E731
    start = Car(
        position=jnp.broadcast_to(jnp.array([-tracker.rear_m, 0.0], jnp.float32), (count, 2)),
        yaw=jnp.zeros(count, jnp.float32),
        speed=flat(jnp.maximum(view.velocity[0], 0.0)),
        acceleration=jnp.zeros(count, jnp.float32),
        steer=flat(view.steer),
    )
    limit = min(config.steering_limit_rad, find_largest_angle(tracker))
    span = jnp.arange(config.steps)[:, None] + jnp.arange(config.horizon)
    steps = (
        jax.tree.map(lambda leaf: jnp.moveaxis(leaf[:, : config.steps], 1, 0), path),
        jnp.moveaxis(path.curvature[:, span], 1, 0),
        proposals.speed[:, config.horizon : config.horizon + config.steps].T,
    )

    def step(car: Car, at: tuple[PathPoints, Array, Array]) -> tuple[Car, tuple[Car, Array, Array]]:
        acceleration, rate = track(car, *at, config, wheelbase=tracker.wheelbase_m)
        asked = car.steer + rate * config.dt_s
        numbers = {"wheelbase": tracker.wheelbase_m, "limit": limit, "limit_mps2": limit_mps2}
        return advance(car, acceleration, asked, config, **numbers), (car, acceleration, asked)

    last, (cars, acceleration, asked) = jax.lax.scan(step, start, steps)
    cars = jax.tree.map(lambda leaf, end: jnp.moveaxis(jnp.concatenate([leaf, end[None]]), 0, 1), cars, last)
    return Simulated(cars, acceleration[0], asked[0])


def track(
    car: Car, path: PathPoints, curvature: Float[Array, "N H"], speed: Float[Array, " N"], config: SimulationConfig, *, wheelbase: float
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Computes acceleration and steering rate: the best constant inputs over the horizon for quadratic costs at its end (nuPlan's LQR).

    Args:
        path: the point where the car should be now.
        curvature: of the path from now on.
        speed: at the end of the horizon.
    """
    dt, horizon = config.dt_s, config.horizon
    span = horizon * dt
    acceleration = config.speed_weight * span * (speed - car.speed) / (config.speed_weight * span**2 + config.acceleration_weight)
    along = jnp.arctan2(path.direction[:, 1], path.direction[:, 0])
    offset, heading = cross(path.direction, car.position - path.position), wrap_angle(car.yaw - along)
    speeds = jnp.maximum(car.speed[:, None] + acceleration[:, None] * dt * jnp.arange(horizon), 0.0)
    rate = solve_lateral(offset, heading, car.steer, speeds, curvature, config, wheelbase=wheelbase)
    stops = (car.speed < config.stop_mps) & (speed < config.stop_mps)
    return jnp.where(stops, -config.stop_gain * (car.speed - speed), acceleration), jnp.where(stops, 0.0, rate)


def solve_lateral(
    offset: Float[Array, "*n"],
    heading: Float[Array, "*n"],
    steer: Float[Array, "*n"],
    speeds: Float[Array, "*n H"],
    curvature: Float[Array, "*n H"],
    config: SimulationConfig,
    *,
    wheelbase: float,
) -> Float[Array, "*n"]:
    """Computes the constant steering rate u that minimises the costs of offset and heading at the end of the horizon, and of u.

    With x = (offset, heading, steering) and x_N = A x + B u + g it is u = -(B'QB + R)^-1 B'Q (A x + g). Linear in small angles:
    offset' = v heading, heading' = v (steering / wheelbase - curvature), steering' = u.
    """
    dt = config.dt_s
    free_offset, free_heading = offset, heading  # A x + g
    unit_offset = unit_heading = jnp.zeros_like(offset)  # B
    for index in range(config.horizon):
        way = speeds[..., index] * dt
        free_offset, free_heading = free_offset + way * free_heading, free_heading + way * (steer / wheelbase - curvature[..., index])
        unit_offset, unit_heading = unit_offset + way * unit_heading, unit_heading + way * (index * dt) / wheelbase
    q_offset, q_heading = config.lateral_weight, config.heading_weight
    pull = q_offset * unit_offset * free_offset + q_heading * unit_heading * free_heading
    return -pull / (q_offset * unit_offset**2 + q_heading * unit_heading**2 + config.steering_rate_weight)


def advance(
    car: Car,
    acceleration: Float[Array, " N"],
    steer: Float[Array, " N"],
    config: SimulationConfig,
    *,
    wheelbase: float,
    limit: float,
    limit_mps2: Float[Array, ""] | None = None,
) -> Car:
    """Advances the bicycle by one Euler step; acceleration and steering follow what is asked with first-order lags.

    Args:
        limit: of the steering angle, rad.
        limit_mps2: of the acceleration: a car that is steered into a sharper bend runs wide, and what the bend leaves brakes; None: none.
    """
    dt = config.dt_s
    push = car.acceleration + dt / (dt + config.acceleration_lag_s) * (acceleration - car.acceleration)
    turned = car.steer + dt / (dt + config.steering_lag_s) * (steer - car.steer)
    turned = jnp.clip(turned, -limit, limit)
    curvature, driven = jnp.tan(turned) / wheelbase, push
    if limit_mps2 is not None:
        sharpest = limit_mps2 / jnp.maximum(car.speed, SLOW_MPS) ** 2
        curvature = jnp.clip(curvature, -sharpest, sharpest)
        rest = jnp.sqrt(jnp.maximum(limit_mps2**2 - (car.speed**2 * curvature) ** 2, 0.0))
        driven = jnp.clip(push, -rest, rest)
    return Car(
        position=car.position + (car.speed * dt)[..., None] * heading_vector(car.yaw),
        yaw=wrap_angle(car.yaw + car.speed * dt * curvature),
        speed=jnp.maximum(car.speed + driven * dt, 0.0),
        acceleration=push,
        steer=turned,
    )


def measure_line(
    view: PlanningView, proposals: Proposals, centre: Float[Array, "N T 2"]
) -> tuple[Float[Array, "N T"], Float[Array, "N T"]]:
    """Measures arc and offset of boxes' centres on the centre line, from the points where the proposals have them."""
    arc = proposals.arc[:, : centre.shape[1]]
    near = pdm_proposals.find_path_points(view.line, arc, jnp.zeros_like(arc))
    apart = centre - near.position
    return arc + dot(near.direction, apart), cross(near.direction, apart)
