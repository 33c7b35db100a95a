"""Contact forces between cars, and of other objects on cars: boxes seen from above, pushed apart by spring-dampers with friction.

Every unordered pair of cars is evaluated once, and its force acts on both with opposite sign at the same point: linear and angular
momentum are conserved to rounding. Depth and normal come from the separating-axis theorem. The face of least depth is clipped against the
other box's nearest face, which leaves two contact points, each with half the stiffness.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core import schema
from scenefactory_jax.core.geometry import cross, dot, safe_norm
from scenefactory_jax.core.pytree import is_finite, replace
from scenefactory_jax.core.schema import Bounds, ConfigError, NonNegative, Positive
from scenefactory_jax.core.types import Boxes, Motion

OFF_CENTRE = 3.7  # effective mass of a contact at the middle of two cars' faces over that at their corners


class BoxContact(NamedTuple):
    """Contact of two boxes. The normal points from the first to the second; a depth <= 0 is a point that does not touch."""

    normal: Float[Array, "2"]
    points: Float[Array, "2 2"]
    depths: Float[Array, "2"]


class Contact(NamedTuple):
    """The contact model. Neighbours are selected once per control step, forces computed once per physics step."""

    neighbours: Callable[[Boxes, Boxes], Boxes]  # (cars, traffic) -> neighbours [A, K, ...]
    forces: Callable[[Boxes, Boxes], tuple[Array, Array, Array]]  # (cars, neighbours) -> see `compute_forces`


@dataclasses.dataclass(frozen=True)
class ContactLaw:
    """The config `dynamics.contact`: a spring-damper with friction between two boxes."""

    stiffness: Positive  # along a whole face of two cars, N/m
    damping: NonNegative  # along the same face, N s/m; a contact never pulls
    friction: NonNegative  # Coulomb coefficient; below the limit `damping` resists sliding, which is as stable as the normal force
    mass: Positive  # of the two cars that `stiffness` and `damping` are meant for, kg
    momentum_transfer_s: Positive  # time in which a box of finite mass may get the car's speed
    max_neighbours: Annotated[int, Bounds(min=0)]  # objects that a car may touch, beside other cars


def make_contact(entry: Mapping[str, Any], *, height: float, physics_dt: float | None = None) -> Contact:
    """Makes the contact model of a config's `dynamics.contact`.

    Args:
        height: of the boxes, m; two whose elevations differ by more do not touch.
        physics_dt: s, if the forces move cars; None: they are only reported.

    Raises:
        ConfigError: a number out of range, or a contact too stiff for `physics_dt`, by name.
    """
    law = schema.read(entry, ContactLaw, where="dynamics.contact")
    dt = physics_dt or 0.0
    load = OFF_CENTRE * (law.stiffness * dt + 2 * law.damping) * dt / (law.mass / 2)
    if load >= 4.0:  # see `compute_forces`
        raise ConfigError(
            f"dynamics.contact: stiffness {law.stiffness:g} and damping {law.damping:g} cannot be integrated: {OFF_CENTRE} (k dt + 2 c) dt "
            f"/ m, m half the mass: expected below 4, got {load:.2f} at physics_dt {dt:.5f}"
        )
    neighbours = functools.partial(find_neighbours, max_neighbours=law.max_neighbours)
    return Contact(neighbours, functools.partial(compute_forces, law=law, height=height))


def collect_boxes(motion: Motion, size: Float[Array, "A 2"], active: Bool[Array, " A"], mass: float | Float[Array, "*A"]) -> Boxes:
    """Collects cars as boxes; `mass` per car, or one for all."""
    return Boxes(
        position=motion.position[:, :2],
        elevation=motion.position[:, 2],
        yaw=motion.yaw,
        velocity=motion.velocity[:, :2],
        yaw_rate=motion.yaw_rate,
        size=size,
        mass=jnp.broadcast_to(jnp.asarray(mass, jnp.float32), motion.yaw.shape),
        present=active,
    )


def find_neighbours(cars: Boxes, traffic: Boxes, *, max_neighbours: int) -> Boxes:
    """Finds the boxes of `traffic` nearest to each car, by the distance to their bounding circles: leaves `[A, K, ...]`."""
    reach = 0.5 * safe_norm(traffic.size)
    gap = safe_norm(traffic.position[None] - cars.position[:, None]) - reach
    gap = jnp.where(_is_valid(traffic) & jnp.isfinite(gap), gap, jnp.inf)
    _, rows = jax.lax.top_k(-gap, min(max_neighbours, gap.shape[1]))
    return jax.tree.map(lambda leaf: leaf[rows], traffic)


def advance_boxes(boxes: Boxes, seconds: float | Float[Array, ""]) -> Boxes:
    """Moves neighbours `[A, K, ...]` with constant velocities."""

    def move(box: Boxes) -> Boxes:
        return replace(box, position=box.position + box.velocity * seconds, yaw=box.yaw + box.yaw_rate * seconds)

    return jax.vmap(move)(boxes)


def compute_forces(
    cars: Boxes, neighbours: Boxes, *, law: ContactLaw, height: float
) -> tuple[Float[Array, "A 2"], Float[Array, " A"], Float[Array, " A"]]:
    """Computes the horizontal force and yaw torque on each car's box centre, and the largest force of a single pair, N and N m.

    Stiffness and damping of a pair scale with its reduced mass over that of two cars: 1 between cars, 2 against a wall, little against a
    pedestrian. So k dt^2 / m is the same for every pair: 0.07 at 1e6 N/m and 120 Hz (m the reduced mass), and 0.26 off centre
    (`OFF_CENTRE`). Semi-implicit Euler with an explicit damper is stable while that plus 2 c dt / m is below 4; 2 c dt / m is 0.58 and
    2.1 with 3e4 N s/m.

    Args:
        cars: boxes that are not present, have no size, or have a state that is not finite take no part. Two whose elevations differ by
            more than `height` do not touch.
        neighbours: of each car, leaves `[A, K, ...]`: see `find_neighbours`. They follow their path and feel no force. If their mass is
            finite, the force is limited to what gives them the car's speed within `momentum_transfer_s`.
    """
    count, beside = neighbours.mass.shape
    cars = _sanitize(cars, law.mass)
    total, torque, largest, contacts = jnp.zeros((count, 2)), jnp.zeros(count), jnp.zeros(count), jnp.zeros(count)
    if beside:
        first = jax.tree.map(lambda leaf: jnp.repeat(leaf, beside, axis=0), cars)
        second = _sanitize(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), neighbours), law.mass)
        pair_force, pair_torque, _ = _compute_pair_forces(first, second, law, height=height, limited=True)
        pair_force, pair_torque = pair_force.reshape(count, beside, 2), pair_torque.reshape(count, beside)
        contacts = (safe_norm(pair_force) > 0.0).sum(1, dtype=jnp.float32)
    if count > 1:
        rows_first, rows_second = np.triu_indices(count, 1)
        first, second = jax.tree.map(lambda leaf: leaf[rows_first], cars), jax.tree.map(lambda leaf: leaf[rows_second], cars)
        force, torque_first, torque_second = _compute_pair_forces(first, second, law, height=height, limited=False)
        rows = _find_pairs(count)
        contacts = contacts + jnp.tile(safe_norm(force) > 0.0, 2)[rows].sum(1, dtype=jnp.float32)
        scale = _scale_of_many(jnp.maximum(contacts[rows_first], contacts[rows_second]))
        force = scale[:, None] * force
        total = jnp.concatenate([-force, force])[rows].sum(1)
        torque = jnp.concatenate([scale * torque_first, scale * torque_second])[rows].sum(1)
        largest = jnp.tile(safe_norm(force), 2)[rows].max(1)
    if beside:
        scale = _scale_of_many(contacts)[:, None]
        force = scale[..., None] * pair_force
        total, torque = total - force.sum(1), torque + (scale * pair_torque).sum(1)
        largest = jnp.maximum(largest, safe_norm(force).max(1))
    return total, torque, largest


def _scale_of_many(contacts: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the scale of a pair's force where one of the two has this many contacts.

    N springs and dampers on one car add up to N times what the explicit integrator must carry: 16 cars at one position became NaN within a
    second. Two are stable at full strength; more are scaled to the strength of two. Both cars have the same scale: momentum is kept.
    """
    return jnp.minimum(1.0, 2.0 / jnp.maximum(contacts, 1.0))


def _compute_pair_forces(
    first: Boxes, second: Boxes, law: ContactLaw, *, height: float, limited: bool
) -> tuple[Float[Array, "N 2"], Float[Array, " N"], Float[Array, " N"]]:
    """Computes the force on the second box of each pair (the first has the opposite), and the torques on both.

    `limited`: the second box may have a finite mass and follows its path, see `compute_forces`.
    """
    normal, points, depths = jax.vmap(find_box_contact)(
        first.position, first.yaw, first.size / 2.0, second.position, second.yaw, second.size / 2.0
    )
    near = first.present & second.present & (jnp.abs(first.elevation - second.elevation) < height)
    depths = jnp.where(near[:, None], depths, 0.0)

    arm_first, arm_second = points - first.position[:, None], points - second.position[:, None]
    speed = _velocity_at(arm_second, second.velocity, second.yaw_rate) - _velocity_at(arm_first, first.velocity, first.yaw_rate)
    tangent = _rotate_90(normal)
    closing = -dot(speed, normal[:, None])
    sliding = dot(speed, tangent[:, None])
    scale = (2.0 / (law.mass / first.mass + law.mass / second.mass))[:, None]
    push = jnp.where(depths > 0.0, jnp.maximum(scale * (0.5 * law.stiffness * depths + 0.5 * law.damping * closing), 0.0), 0.0)
    if limited:
        reduced = 0.5 * law.mass * scale
        limit = 0.5 * reduced * jnp.maximum(closing, 0.0) / law.momentum_transfer_s  # per contact point
        push = jnp.where(jnp.isfinite(second.mass)[:, None], jnp.minimum(push, limit), push)
    drag = jnp.clip(scale * (0.5 * law.damping * sliding), -law.friction * push, law.friction * push)
    force = push[..., None] * normal[:, None] - drag[..., None] * tangent[:, None]
    return force.sum(1), -cross(arm_first, force).sum(1), cross(arm_second, force).sum(1)


def _is_valid(boxes: Boxes) -> Bool[Array, "*n"]:
    """Selects boxes that are present and have a positive size and a finite state."""
    state = boxes.position, boxes.velocity, boxes.size, boxes.elevation, boxes.yaw, boxes.yaw_rate
    return boxes.present & is_finite(state) & (boxes.size > 0).all(-1)


def _sanitize(boxes: Boxes, mass: float) -> Boxes:
    """Replaces boxes that take no part by absent ones at rest at the origin, so that their NaN values do not propagate."""
    valid = _is_valid(boxes)
    clean = jax.tree.map(lambda x: jnp.where(valid.reshape((-1,) + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x)), boxes)
    return replace(clean, mass=jnp.where(valid, boxes.mass, mass), present=valid)


def _find_pairs(count: int) -> Int[np.ndarray, "A partners"]:
    """Finds the rows of each car's pairs in the table of all pairs' first bodies followed by all pairs' second bodies."""
    bodies = np.concatenate(np.triu_indices(count, 1))
    return np.stack([np.flatnonzero(bodies == car) for car in range(count)])


def find_box_contact(
    centre: Float[Array, "2"],
    yaw: Float[Array, ""],
    half: Float[Array, "2"],
    other_centre: Float[Array, "2"],
    other_yaw: Float[Array, ""],
    other_half: Float[Array, "2"],
) -> BoxContact:
    """Computes the contact of two oriented boxes with half sizes `half`; depths are not positive if they do not overlap."""
    gap = other_centre - centre
    axes, other_axes = _axes(yaw), _axes(other_yaw)
    candidates = jnp.concatenate([axes, other_axes])  # separating axes
    reach = jnp.abs(candidates @ axes.T) @ half + jnp.abs(candidates @ other_axes.T) @ other_half
    along = candidates @ gap
    overlap = reach - jnp.abs(along)
    best = jnp.argmin(overlap)
    normal = candidates[best] * jnp.where(along[best] < 0.0, -1.0, 1.0)

    # the box of the best axis has the reference face, the other box touches it with its nearest ("incident") face
    pick = functools.partial(jnp.where, best < 2)
    outward = pick(normal, -normal)
    reference_half = pick(half, other_half)
    front, side = reference_half[best % 2], reference_half[1 - best % 2]
    incident_axes, incident_half = pick(other_axes, axes), pick(other_half, half)
    facing = incident_axes @ outward
    face = jnp.argmax(jnp.abs(facing))
    towards = -jnp.where(facing[face] < 0.0, -1.0, 1.0) * incident_axes[face]
    middle = pick(gap, -gap) + towards * incident_half[face]  # of the incident face, from the reference box's centre
    along_face = incident_axes[1 - face] * incident_half[1 - face]

    # clip the incident face at the reference face's sides, |w| <= side; it lies within 45 degrees across `outward`, so w_along is not 0
    tangent = _rotate_90(outward)
    w_middle, w_along = middle @ tangent, along_face @ tangent
    w_along = jnp.where(jnp.abs(w_along) < 1e-6, 1e-6, w_along)
    low, high = (-side - w_middle) / w_along, (side - w_middle) / w_along
    ends = jnp.clip(jnp.stack([low, high]), -1.0, 1.0)
    points = middle + ends[:, None] * along_face
    depths = front - points @ outward
    points = points + 0.5 * depths[:, None] * outward + pick(centre, other_centre)
    return BoxContact(normal=normal, points=points, depths=jnp.where(overlap[best] > 0.0, depths, jnp.minimum(depths, 0.0)))


def _axes(yaw: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Computes unit vectors along a box's length and width."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])


def _rotate_90(v: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
    """Rotates by 90 degrees counter-clockwise."""
    return jnp.stack([-v[..., 1], v[..., 0]], axis=-1)


def _velocity_at(arm: Float[Array, "N 2 2"], velocity: Float[Array, "N 2"], yaw_rate: Float[Array, " N"]) -> Float[Array, "N 2 2"]:
    """Computes the velocity of points at `arm` from a centre that moves and rotates."""
    return velocity[:, None] + yaw_rate[:, None, None] * _rotate_90(arm)
