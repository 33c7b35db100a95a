"""How planners drive a car: from acceleration and curvature to throttle, steer and brake, with numbers of each dynamics backend."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from scenefactory_jax.core.schema import Bounds, ConfigError, NonNegative, Positive
from scenefactory_jax.dynamics.articulated.parameters import GRAVITY

DEFAULT = "articulated_car"  # where a policy is made without the config of its run
SMALLEST_MPS = 0.1  # slower, the power of the engine is no limit
HOLD = 2.0  # times the weight along the road: brakes that hold a car for certain


@dataclasses.dataclass(frozen=True)
class Tracker:
    """Numbers of one kind of car; described in `conf/tracker/`."""

    wheelbase_m: Positive
    steering_limit_rad: Annotated[float, Bounds(above=0, below=math.pi / 2)]
    curvature_limit_radpm: Positive | None
    rear_m: NonNegative
    throttle_mps2: Positive
    power_m2ps3: Positive | None
    brake_mps2: Positive
    rolling_mps2: NonNegative
    air_drag_radpm: NonNegative
    stop_s: NonNegative
    look_ahead_m: Positive
    look_ahead_s: NonNegative
    lateral_mps2: Positive
    braking_mps2: Positive
    feels_grades: bool


def select_tracker(trackers: Mapping[str, Tracker], dynamics: Mapping[str, Any] | None) -> Tracker:
    """Selects the numbers for the dynamics of a run, by the module of its `_target_`.

    Raises:
        ConfigError: a backend without numbers.
    """
    name = dynamics["_target_"].split(".")[-2] if dynamics else DEFAULT
    if name not in trackers:
        raise ConfigError(f"policy.trackers: expected numbers for the dynamics {name}, got those of {', '.join(sorted(trackers))}")
    return trackers[name]


def compute_steer(curvature: Float[Array, "*n"], tracker: Tracker) -> Float[Array, "*n"]:
    """Computes the steering action for a curvature of the rear axle's path, 1/m."""
    if tracker.curvature_limit_radpm is not None:
        return jnp.clip(curvature / tracker.curvature_limit_radpm, -1.0, 1.0)
    return jnp.clip(jnp.arctan(tracker.wheelbase_m * curvature) / tracker.steering_limit_rad, -1.0, 1.0)


def find_largest_angle(tracker: Tracker) -> float:
    """Finds the largest angle of the front wheels, rad; for cars that are steered by curvature, the one that belongs to it."""
    curvature = tracker.curvature_limit_radpm
    return tracker.steering_limit_rad if curvature is None else math.atan(tracker.wheelbase_m * curvature)


def make_action(
    acceleration: Float[Array, "*n"],
    curvature: Float[Array, "*n"],
    speed: Float[Array, "*n"],
    tracker: Tracker,
    *,
    grade: Float[Array, "*n"] | None = None,
) -> Float[Array, "*n 3"]:
    """Makes the action for an acceleration (m/s^2) and a curvature (1/m) at a speed (m/s).

    Rolling resistance and air drag are added to what the engine gives and subtracted from what the brakes do. A throttle below zero and
    the brake say the same, so that actions with one pedal, with two and with an acceleration do the same.

    Args:
        grade: rise over run of the road under the car along its heading, whose gravity is added, too; a car that is to stand there has its
            brakes on. None: the road is flat.
    """
    speed = jnp.maximum(speed, 0.0)
    if tracker.stop_s > 0:
        acceleration = jnp.maximum(acceleration, -speed / tracker.stop_s)
    push = acceleration + tracker.rolling_mps2 + tracker.air_drag_radpm * speed**2
    standing = jnp.minimum(acceleration, 0.0)  # a car that stands has no drag
    if grade is not None and tracker.feels_grades:
        weight = GRAVITY * grade / jnp.sqrt(1.0 + grade**2)
        push, standing = push + weight, standing - HOLD * jnp.abs(weight)
    push = jnp.where((speed < SMALLEST_MPS) & (acceleration <= 0), standing, push)
    available = jnp.full_like(speed, tracker.throttle_mps2)
    if tracker.power_m2ps3 is not None:
        available = jnp.minimum(available, tracker.power_m2ps3 / jnp.maximum(speed, SMALLEST_MPS))
    throttle, brake = jnp.clip(push / available, 0.0, 1.0), jnp.clip(-push / tracker.brake_mps2, 0.0, 1.0)
    return jnp.stack([throttle - brake, compute_steer(curvature, tracker), jnp.where(brake > 0, brake, -1.0)], axis=-1)


def make_braking_action(speed: Float[Array, "*n"], tracker: Tracker) -> Float[Array, "*n 3"]:
    """Makes the action of full brakes and wheels straight ahead: of an agent that has nothing to follow."""
    return make_action(jnp.full_like(speed, -tracker.brake_mps2), jnp.zeros_like(speed), speed, tracker)
