"""Surrogate safety measures between moving circles: time to collision (TTC) and deceleration rate to avoid a crash (DRAC)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import EPSILON, cross, dot, heading_vector, safe_norm
from scenefactory_jax.core.pytree import is_finite
from scenefactory_jax.core.types import Boxes, Motion


class RoadUsers(NamedTuple):
    """Everybody on the road: the cars, and the boxes after them."""

    position: Float[Array, "B 2"]
    yaw: Float[Array, " B"]
    velocity: Float[Array, "B 2"]
    yaw_rate: Float[Array, " B"]
    size: Float[Array, "B 2"]
    present: Bool[Array, " B"]


class Pairs(NamedTuple):
    """Each car (row) with each other body (column); on the diagonal what means nobody: inf, and 0 for DRAC."""

    ttc: Float[Array, "A B"]  # s
    drac: Float[Array, "A B"]  # m/s^2
    gap: Float[Array, "A B"]  # m
    ahead: Float[Array, "A B"]  # m


def collect_road_users(motion: Motion, size: Float[Array, "A 2"], active: Bool[Array, " A"], boxes: Boxes) -> RoadUsers:
    """Cars and boxes as one list; its first rows are the cars. Who has no size, or a number that is not finite, is not present."""
    cars = (motion.position[:, :2], motion.yaw, motion.velocity[:, :2], motion.yaw_rate, size, active)
    beside = (boxes.position, boxes.yaw, boxes.velocity, boxes.yaw_rate, boxes.size, boxes.present)
    everyone = RoadUsers(*(jnp.concatenate(pair) for pair in zip(cars, beside, strict=True)))
    return everyone._replace(present=everyone.present & is_finite(everyone[:-1]) & jnp.all(everyone.size > 0, axis=1))


def compare_pairs(
    centres: Float[Array, "B 3 2"],
    radius: Float[Array, " B"],
    velocity: Float[Array, "B 2"],
    yaw: Float[Array, " A"],
    *,
    drac_gap_floor_m: float,
) -> Pairs:
    """TTC, DRAC and gaps of each car with each other body, both moving on with their present velocities.

    TTC: first time at which a circle of the column's body, ahead of the row car's own circle, touches it; 0 when they overlap, inf when
    their paths never meet. DRAC = closing^2 / (2 gap), largest over the circle pairs in any direction, gap not below a floor (the published
    evaluation uses 1 m). Gap: between the nearest circles, negative where they overlap. Ahead: how far the car could move straight on until
    circles touch, inf for bodies beside its way. The first rows of the bodies are the cars, as many as there are in `yaw`.
    """
    cars = len(yaw)
    apart = centres[None, :, None, :, :] - centres[:cars, None, :, None, :]  # [row, column, own circle, other circle, xy]
    relative = (velocity[None] - velocity[:cars, None])[:, :, None, None, :]
    reach = (radius[:cars, None] + radius[None])[:, :, None, None]
    distance = safe_norm(apart)
    facing = heading_vector(yaw)[:, None, None, None, :]
    along = dot(apart, facing)
    ahead = along > 0

    a = dot(relative, relative)
    b = dot(apart, relative)
    c = distance**2 - reach**2
    discriminant = b * b - a * c
    meets = (a > EPSILON) & (discriminant >= 0) & (b < 0) & (c > 0)
    root = jnp.sqrt(jnp.where(meets, discriminant, 1.0))
    enter = (-b - root) / jnp.where(meets, a, 1.0)
    time = jnp.where(c <= 0, 0.0, jnp.where(meets, jnp.maximum(enter, 0.0), jnp.inf))
    ttc = jnp.min(jnp.where(ahead, time, jnp.inf), axis=(2, 3))

    closing = jnp.maximum(-b / jnp.maximum(distance, EPSILON), 0.0)
    gap = distance - reach
    drac = jnp.max(closing**2 / (2 * jnp.maximum(gap, drac_gap_floor_m)), axis=(2, 3))

    beside = reach**2 - cross(facing, apart) ** 2
    free = along - jnp.sqrt(jnp.where(beside > 0, beside, 0.0))
    free = jnp.min(jnp.where(ahead & (beside > 0), jnp.maximum(free, 0.0), jnp.inf), axis=(2, 3))

    own = jnp.eye(cars, len(radius), dtype=bool)
    ttc, gap, free = (jnp.where(own, jnp.inf, pairs) for pairs in (ttc, jnp.min(gap, axis=(2, 3)), free))
    return Pairs(ttc=ttc, drac=jnp.where(own, 0.0, drac), gap=gap, ahead=free)


def minimum_over_pairs(of: Float[Array, "A B"], other: Bool[Array, " B"]) -> Float[Array, " A"]:
    """Smallest TTC or distance over the columns that count as present; inf where nobody is."""
    return jnp.min(jnp.where(other[None], of, jnp.inf), axis=1)
