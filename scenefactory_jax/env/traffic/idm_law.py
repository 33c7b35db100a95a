"""The intelligent driver model: acceleration of a vehicle from its speed, the speed that it drives at on a free road, and its leaders.

a = acceleration (1 - (v / v0)^exponent - (s* / s)^2), s* = gap + max(0, v headway + v (v - v_leader) / (2 sqrt(acceleration braking)))
(M. Treiber, A. Hennecke and D. Helbing, Congested traffic states in empirical observations and microscopic simulations, Physical Review E
62, 2000, equations 3 and 4). Of several leaders the one with the largest (s* / s)^2 counts. Everything is elementwise, in any unit.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.schema import NonNegative, Positive

SMALLEST_SPEED = 0.1  # of a target: a vehicle that should stand has this one


@dataclasses.dataclass(frozen=True)
class IdmLaw:
    """The numbers of the model."""

    gap_m: Positive  # to a leader that stands
    headway_s: NonNegative
    acceleration_mps2: Positive
    braking_mps2: Positive  # comfortable
    exponent: Positive


class LimitedLaw(NamedTuple):
    """The numbers of the model, with accelerations of each vehicle."""

    gap_m: float
    headway_s: float
    acceleration_mps2: Float[Array, "*n"]
    braking_mps2: Float[Array, "*n"]
    exponent: float


def limit_law(law: IdmLaw, limit_mps2: Float[Array, "*n"]) -> LimitedLaw:
    """Limits acceleration and braking, as to a part of mu g."""
    acceleration, braking = (jnp.minimum(value, limit_mps2) for value in (law.acceleration_mps2, law.braking_mps2))
    return LimitedLaw(law.gap_m, law.headway_s, acceleration, braking, law.exponent)


def compute_interaction(
    speed: Float[Array, "*#n"], gap: Float[Array, "*#n"], leader_speed: Float[Array, "*#n"], law: IdmLaw | LimitedLaw
) -> Float[Array, "*#n"]:
    """Computes (s* / s)^2; 0 at an infinite gap. A gap below the one at rest counts as that one, as in nuPlan."""
    approach = speed * (speed - leader_speed) / (2.0 * (law.acceleration_mps2 * law.braking_mps2) ** 0.5)
    desired = law.gap_m + jnp.maximum(0.0, speed * law.headway_s + approach)
    return (desired / jnp.maximum(gap, law.gap_m)) ** 2


def compute_acceleration(
    speed: Float[Array, "*#n"], target_speed: Float[Array, "*#n"], interaction: Float[Array, "*#n"], law: IdmLaw | LimitedLaw
) -> Float[Array, "*#n"]:
    """Computes the acceleration; a vehicle faster than its target brakes comfortably, unless a leader demands more."""
    free = 1.0 - (speed / jnp.maximum(target_speed, SMALLEST_SPEED)) ** law.exponent
    free = jnp.maximum(free, -law.braking_mps2 / law.acceleration_mps2)
    return law.acceleration_mps2 * (free - interaction)


def compute_arrival(speed: Float[Array, "*#n"], distance: Float[Array, "*#n"], acceleration: float) -> Float[Array, "*#n"]:
    """Computes the time in which a vehicle that accelerates covers a distance; 0 for one behind it, inf for an infinite one."""
    distance = jnp.maximum(distance, 0.0)
    return 2.0 * distance / (speed + jnp.sqrt(speed**2 + 2.0 * acceleration * distance) + 1e-6)


def can_stop(speed: Float[Array, "*#n"], distance: Float[Array, "*#n"], braking: float | Float[Array, "*#n"]) -> Bool[Array, "*#n"]:
    """Mask of vehicles that can stop within a distance."""
    return distance >= speed**2 / (2.0 * braking)


def compute_safe_gap(speed: Float[Array, "*#n"], leader_speed: Float[Array, "*#n"], law: IdmLaw) -> Float[Array, "*#n"]:
    """Computes the gap at which a vehicle can follow or stop behind a leader with comfortable braking."""
    slower = jnp.minimum(speed, leader_speed)
    return law.gap_m + law.headway_s * slower + jnp.maximum(speed**2 - leader_speed**2, 0.0) / (2.0 * law.braking_mps2)
