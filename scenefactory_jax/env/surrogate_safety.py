"""Surrogate safety measures between moving circles: time to collision (TTC) and deceleration rate to avoid a crash (DRAC)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from scenefactory_jax.core.geometry import SMALLEST, cross, dot, heading_vector, safe_norm
from scenefactory_jax.core.pytree import is_finite
from scenefactory_jax.core.types import Boxes, Motion, Scene
from scenefactory_jax.roadgraph.elevation import LEVEL_M


class RoadUsers(NamedTuple):
    """The agents' cars, and the boxes of the traffic after them."""

    position: Float[Array, "B 2"]
    yaw: Float[Array, " B"]
    velocity: Float[Array, "B 2"]
    yaw_rate: Float[Array, " B"]
    size: Float[Array, "B 2"]
    present: Bool[Array, " B"]


class Pairs(NamedTuple):
    """Measures of each car (row) with each other road user (column); inf on the diagonal, 0 for DRAC."""

    ttc: Float[Array, "A B"]  # s
    drac: Float[Array, "A B"]  # m/s^2
    clearance: Float[Array, "A B"]  # m
    ahead: Float[Array, "A B"]  # m


def collect_road_users(motion: Motion, size: Float[Array, "A 2"], active: Bool[Array, " A"], boxes: Boxes) -> RoadUsers:
    """Joins cars and boxes; a row with a size of 0 or a number that is not finite is not present."""
    cars = (motion.position[:, :2], motion.yaw, motion.velocity[:, :2], motion.yaw_rate, size, active)
    traffic = (boxes.position, boxes.yaw, boxes.velocity, boxes.yaw_rate, boxes.size, boxes.present)
    users = RoadUsers(*(jnp.concatenate(pair) for pair in zip(cars, traffic, strict=True)))
    return users._replace(present=users.present & is_finite(users[:-1]) & jnp.all(users.size > 0, axis=1))


def compare_pairs(
    centres: Float[Array, "B 3 2"],
    radius: Float[Array, " B"],
    velocity: Float[Array, "B 2"],
    yaw: Float[Array, " A"],
    *,
    drac_gap_floor_m: float,
) -> Pairs:
    """Computes TTC, DRAC and clearances of each car with each other road user, at constant velocities.

    TTC: first time at which a circle of the column, ahead of the row car's own circle, touches it; 0 when they overlap, inf when they never
    meet. DRAC = closing^2 / (2 clearance), largest over the circle pairs in any direction, clearance not below a floor (the published
    evaluation uses 1 m). Clearance: between the nearest circles, negative where they overlap. Ahead: distance that the car could move
    straight on until circles touch, inf for road users beside its path. The first rows are the cars, as many as there are in `yaw`.
    """
    cars = len(yaw)
    apart = centres[None, :, None, :, :] - centres[:cars, None, :, None, :]  # [row, column, circle of the row, of the column, xy]
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
    meets = (a > SMALLEST) & (discriminant >= 0) & (b < 0) & (c > 0)
    root = jnp.sqrt(jnp.where(meets, discriminant, 1.0))
    enter = (-b - root) / jnp.where(meets, a, 1.0)
    time = jnp.where(c <= 0, 0.0, jnp.where(meets, jnp.maximum(enter, 0.0), jnp.inf))
    ttc = jnp.min(jnp.where(ahead, time, jnp.inf), axis=(2, 3))

    closing = jnp.maximum(-b / jnp.maximum(distance, SMALLEST), 0.0)
    clearance = distance - reach
    drac = jnp.max(closing**2 / (2 * jnp.maximum(clearance, drac_gap_floor_m)), axis=(2, 3))

    beside = reach**2 - cross(facing, apart) ** 2
    free = along - jnp.sqrt(jnp.where(beside > 0, beside, 0.0))
    free = jnp.min(jnp.where(ahead & (beside > 0), jnp.maximum(free, 0.0), jnp.inf), axis=(2, 3))

    diagonal = jnp.eye(cars, len(radius), dtype=bool)
    ttc, clearance, free = (jnp.where(diagonal, jnp.inf, pairs) for pairs in (ttc, jnp.min(clearance, axis=(2, 3)), free))
    return Pairs(ttc=ttc, drac=jnp.where(diagonal, 0.0, drac), clearance=clearance, ahead=free)


def separate_levels(pairs: Pairs, scene: Scene, motion: Motion) -> Pairs:
    """Takes pairs on different levels of the road for infinitely far apart; scenes of one level stay as they are."""
    apart = find_other_levels(scene, motion)
    if apart is None:
        return pairs
    ttc, clearance, ahead = (jnp.where(apart, jnp.inf, measure) for measure in (pairs.ttc, pairs.clearance, pairs.ahead))
    return Pairs(ttc, jnp.where(apart, 0.0, pairs.drac), clearance, ahead)


def find_other_levels(scene: Scene, motion: Motion) -> Bool[Array, "A B"] | None:
    """Mask of the road users that are on another level than each car; None in a scene of one level."""
    height = find_heights(scene, motion, scene.traffic)
    return None if height is None else jnp.abs(motion.position[:, 2:] - height) >= LEVEL_M


def find_heights(scene: Scene, motion: Motion, boxes: Boxes) -> Float[Array, " B"] | None:
    """Heights of the cars and of the traffic, m; None in a scene of one level."""
    return None if scene.edges.height is None else jnp.concatenate([motion.position[:, 2], boxes.elevation])


def minimum_over_pairs(values: Float[Array, "A B"], present: Bool[Array, " B"]) -> Float[Array, " A"]:
    """Computes the minimum over the columns that are present; inf if there is none."""
    return jnp.min(jnp.where(present[None], values, jnp.inf), axis=1)
