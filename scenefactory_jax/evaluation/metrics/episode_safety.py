"""Surrogate safety of one car over an episode: post-encroachment time, and the speeds of impacts."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.boxes import find_overlaps
from scenefactory_jax.core.geometry import dot, heading_vector
from scenefactory_jax.core.pytree import unchecked
from scenefactory_jax.core.types import Boxes
from scenefactory_jax.dynamics.collision import NO_AXIS, compute_separation, select_axis
from scenefactory_jax.dynamics.planar import pick
from scenefactory_jax.evaluation.metrics.episode_record import EpisodeRecord

CROSSING_COSINE = 0.8660254  # 30 degrees between headings, in either direction


def compute_encroachment(
    record: EpisodeRecord, step: Int[Array, ""], counted: Bool[Array, " T"], *, dt: float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Computes the post-encroachment time at one state of the car: the shortest time between it and a state of another road user whose
    rectangle overlaps the car's; 0 in a collision, inf if nothing else was or will be there.

    States are compared as they are, a time step apart: a road user that moves by more than its length in a step may be missed.

    Args:
        counted: states that count.

    Returns:
        The time for all road users, and for those only whose path the car's crosses there by more than 30 degrees.
    """
    others, position = record.others, record.ego.position[step, :2]
    overlap = find_overlaps(position, record.ego.yaw[step], record.size, others.position, others.yaw, others.size[:, None])
    overlap &= others.valid & counted & counted[step]
    apart = dt * jnp.abs(jnp.arange(len(counted)) - step).astype(jnp.float32)
    crossing = jnp.abs(dot(heading_vector(record.ego.yaw[step]), heading_vector(others.yaw))) < CROSSING_COSINE
    return jnp.min(jnp.where(overlap, apart, jnp.inf)), jnp.min(jnp.where(overlap & crossing, apart, jnp.inf))


class Impact(NamedTuple):
    """The worst of a car's first contacts with other road users; zeros without any, or where the bodies part."""

    speed: Float[Array, ""]  # m/s, along the normal of the faces that touch
    delta_v: Float[Array, ""]  # m/s, of the car, if both bodies go on together and have equal masses
    weighted_delta_v: Float[Array, ""]  # ... and with the masses of the record


def compute_impact(record: EpisodeRecord, touching: Bool[Array, "T O"]) -> Impact:
    """Computes the speeds of impacts from the states before the first contacts, which no simulated contact has changed yet."""
    others, rows = record.others, touching.shape[0]
    hit = jnp.any(touching, axis=0)
    before = jnp.maximum(jnp.argmax(touching, axis=0) - 1, 0)
    users = jnp.arange(touching.shape[1])
    valid = others.valid[users, before]
    before = jnp.where(valid, before, jnp.minimum(before + 1, rows - 1))  # of a road user that appears in contact

    def measure_closing(row: Int[Array, ""], other: Int[Array, ""]) -> Float[Array, ""]:
        car = _make_box(record.ego.position[row, :2], record.ego.yaw[row], record.ego.velocity[row], record.size)
        user = _make_box(others.position[other, row], others.yaw[other, row], others.velocity[other, row], others.size[other])
        separation = compute_separation(car, user)
        return jnp.maximum(pick(select_axis(separation, jnp.int32(NO_AXIS)) // 2, separation.closing), 0.0)

    closing = jnp.where(hit, jax.vmap(measure_closing)(before, users), 0.0)
    if record.mass is None or record.other_mass is None:
        weighted = jnp.zeros_like(closing)
    else:
        weighted = closing / (1.0 + record.mass / record.other_mass)
    return Impact(jnp.max(closing), 0.5 * jnp.max(closing), jnp.max(weighted))


def _make_box(position: Float[Array, "2"], yaw: Float[Array, ""], velocity: Float[Array, "2"], size: Float[Array, "2"]) -> Boxes:
    """One box without an axis of boxes, as `compute_separation` reads it."""
    zero = jnp.zeros(())
    rest = {"elevation": zero, "yaw_rate": zero, "mass": zero, "present": jnp.ones((), bool)}
    return unchecked(Boxes, position=position, yaw=yaw, velocity=velocity, size=size, **rest)
