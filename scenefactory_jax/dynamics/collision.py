"""Forces between cars that touch, and on cars that touch something else: upright boxes seen from above, pushed apart by spring-dampers
with friction.

Every unordered pair of cars is evaluated once and its force enters both with opposite sign at the same point, so linear and angular
momentum are kept to rounding. Depth and normal come from the separating-axis theorem; the face of least depth is cut against the
other box's nearest face, which leaves two contact points, each with half the stiffness.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from scenefactory_jax.core.geometry import cross, dot, safe_norm
from scenefactory_jax.core.instantiate import ConfigError, check_numbers
from scenefactory_jax.core.pytree import is_finite, replace
from scenefactory_jax.core.types import Boxes, Motion

OFF_CENTRE = 3.7  # times as much mass moves with a contact in the middle of two cars' faces as with one at their corners


class BoxContact(NamedTuple):
    """Where two boxes touch. The normal points from the first to the second; depths are zero or less where a point does not touch."""

    normal: Float[Array, "2"]
    points: Float[Array, "2 2"]
    depths: Float[Array, "2"]


class Contact(NamedTuple):
    """The contact model bound to its numbers. Choose each car's neighbours once a control step, then ask for forces every substep."""

    neighbours: Callable[[Boxes, Boxes], Boxes]  # (cars, others) -> those that each car may touch
    forces: Callable[[Boxes, Boxes], tuple[Array, Array, Array]]  # (cars, their neighbours) -> see `forces`


def make(
    *,
    stiffness: float,
    damping: float,
    friction: float,
    mass: float,
    momentum_transfer_s: float,
    nearest: int,
    height: float,
    physics_dt: float | None = None,
) -> Contact:
    """`forces` and `neighbours` with their numbers.

    Args:
        nearest: of the others that a car may touch; 0: none.
        physics_dt: s, of the steps in which the forces move cars; None: they are reported and move nobody.

    Raises:
        ConfigError: a number out of its range, or a contact too stiff for `physics_dt`, by name.
    """
    check_numbers({"stiffness": stiffness, "mass": mass, "momentum_transfer_s": momentum_transfer_s}, where="dynamics.contact", above=0.0)
    check_numbers({"damping": damping, "friction": friction, "nearest": nearest}, where="dynamics.contact", least=0.0)
    if physics_dt is not None:
        _check_stable(stiffness, damping, mass / 2, physics_dt=physics_dt)
    numbers = dict(
        stiffness=stiffness, damping=damping, friction=friction, mass=mass, momentum_transfer_s=momentum_transfer_s, height=height
    )
    return Contact(functools.partial(find_neighbours, nearest=nearest), functools.partial(compute_forces, **numbers))


def _check_stable(stiffness: float, damping: float, reduced: float, *, physics_dt: float) -> None:
    """Refuse a contact that the integrator cannot carry, by the bound of `forces` for cars that meet off centre."""
    load = OFF_CENTRE * (stiffness * physics_dt + 2 * damping) * physics_dt / reduced
    if load >= 4.0:
        message = f"{OFF_CENTRE} (k dt + 2 c) dt / m is {load:.2f} at physics_dt {physics_dt:.5f}, m half the mass; it must stay below 4"
        raise ConfigError(f"dynamics.contact: stiffness {stiffness:g} and damping {damping:g} cannot be integrated: {message}")


def collect_boxes(motion: Motion, size: Float[Array, "A 2"], active: Bool[Array, " A"], mass: float | Float[Array, "*A"]) -> Boxes:
    """Cars as boxes; `mass` of each, or of all."""
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


def find_neighbours(cars: Boxes, others: Boxes, *, nearest: int) -> Boxes:
    """Each car's nearest others that are present, by the distance to the circle around a box: leaves `[A, K, ...]`, K at most `nearest`."""
    reach = 0.5 * safe_norm(others.size)
    gap = safe_norm(others.position[None] - cars.position[:, None]) - reach
    gap = jnp.where(_sound(others) & jnp.isfinite(gap), gap, jnp.inf)
    _, rows = jax.lax.top_k(-gap, min(nearest, gap.shape[1]))
    return jax.tree.map(lambda leaf: leaf[rows], others)


def advance_boxes(boxes: Boxes, seconds: float | Float[Array, ""]) -> Boxes:
    """Neighbours `[A, K, ...]` moved on with their present velocities."""
    moved = lambda box: replace(box, position=box.position + box.velocity * seconds, yaw=box.yaw + box.yaw_rate * seconds)  # noqa: E731
    return jax.vmap(moved)(boxes)


def compute_forces(
    cars: Boxes, near: Boxes, *, stiffness: float, damping: float, friction: float, mass: float, momentum_transfer_s: float, height: float
) -> tuple[Float[Array, "A 2"], Float[Array, " A"], Float[Array, " A"]]:
    """Horizontal force and yaw torque on each car's box centre, and the largest force of a single pair, N and N m.

    Stiffness and damping of a pair are those given times its reduced mass over the reduced mass of two cars: 1 between cars, 2 against a
    wall, little against a pedestrian. So every pair bounces alike, with k dt^2 / m of 0.07 at 1e6 N/m and 120 Hz (m its reduced mass) and
    `OFF_CENTRE` times that, 0.26, where cars meet off centre; semi-implicit Euler with an explicit damper is stable while that plus
    2 c dt / m stays below 4: 0.58 and 2.1 with 3e4 N s/m.

    Args:
        cars: bodies that are not present, have no size, or have a state that is not finite take no part. Two whose elevations differ by
            more than `height` do not meet.
        near: what each car may touch, leaves `[A, K, ...]`: see `neighbours`. It is on its way and feels nothing. One of finite mass cannot
            yield as it would, so its push ends where it would have taken on the car's speed within `momentum_transfer_s`.
        stiffness: of a contact along a whole face of two cars, N/m.
        damping: along the same face, N s/m. A contact never pulls.
        friction: Coulomb coefficient of the bodies. Below the cone `damping` resists sliding, which is as stable as the normal force.
        mass: of the two cars that `stiffness` and `damping` are meant for, kg.
        momentum_transfer_s: s in which a body of finite mass takes on the speed of the car that hits it.
        height: of the boxes, m.
    """
    count, beside = near.mass.shape
    numbers = dict(stiffness=stiffness, damping=damping, friction=friction, mass=mass, height=height)
    cars = _still(cars, mass)
    total, torque, largest, touched = jnp.zeros((count, 2)), jnp.zeros(count), jnp.zeros(count), jnp.zeros(count)
    if beside:
        one = jax.tree.map(lambda leaf: jnp.repeat(leaf, beside, axis=0), cars)
        other = _still(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), near), mass)
        pushed = tuple(leaf.reshape(count, beside, *leaf.shape[1:]) for leaf in _between(one, other, momentum_transfer_s, **numbers)[:2])
        touched = (safe_norm(pushed[0]) > 0.0).sum(1, dtype=jnp.float32)
    if count > 1:
        first, second = np.triu_indices(count, 1)
        one, other = jax.tree.map(lambda leaf: leaf[first], cars), jax.tree.map(lambda leaf: leaf[second], cars)
        force, torque_one, torque_other = _between(one, other, None, **numbers)
        rows = _rows_of(count)  # each car's pairs, as the first of them or the second
        touched = touched + jnp.tile(safe_norm(force) > 0.0, 2)[rows].sum(1, dtype=jnp.float32)
        share = _share(jnp.maximum(touched[first], touched[second]))
        force = share[:, None] * force
        total = jnp.concatenate([-force, force])[rows].sum(1)
        torque = jnp.concatenate([share * torque_one, share * torque_other])[rows].sum(1)
        largest = jnp.tile(safe_norm(force), 2)[rows].max(1)
    if beside:
        share = _share(touched)[:, None]
        force, torque_one = share[..., None] * pushed[0], share * pushed[1]
        total, torque = total - force.sum(1), torque + torque_one.sum(1)
        largest = jnp.maximum(largest, safe_norm(force).max(1))
    return total, torque, largest


def _share(touched: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """What is left of a contact's strength where one of the two touches that many others.

    N springs and dampers on one car add up to N times what the explicit integrator must carry: 16 cars at one place became NaN within a
    second. Two at a time are stable as they are; where it is more, they share the strength of two. A pair shares alike: momentum stays.
    """
    return jnp.minimum(1.0, 2.0 / jnp.maximum(touched, 1.0))


def _between(
    one: Boxes,
    other: Boxes,
    momentum_transfer_s: float | None,
    *,
    stiffness: float,
    damping: float,
    friction: float,
    mass: float,
    height: float,
) -> tuple[Float[Array, "N 2"], Float[Array, " N"], Float[Array, " N"]]:
    """Force on the second box of each pair, which the first feels with opposite sign, and the torques on both."""
    normal, points, depths = jax.vmap(find_box_contact)(one.position, one.yaw, one.size / 2.0, other.position, other.yaw, other.size / 2.0)
    meet = one.present & other.present & (jnp.abs(one.elevation - other.elevation) < height)
    depths = jnp.where(meet[:, None], depths, 0.0)

    arm_one, arm_other = points - one.position[:, None], points - other.position[:, None]
    speed = _velocity_at(arm_other, other.velocity, other.yaw_rate) - _velocity_at(arm_one, one.velocity, one.yaw_rate)
    tangent = _turn(normal)
    closing = -dot(speed, normal[:, None])
    sliding = dot(speed, tangent[:, None])
    scale = (2.0 / (mass / one.mass + mass / other.mass))[:, None]
    push = jnp.where(depths > 0.0, jnp.maximum(scale * (0.5 * stiffness * depths + 0.5 * damping * closing), 0.0), 0.0)
    if momentum_transfer_s is not None:
        reduced = 0.5 * mass * scale
        most = 0.5 * reduced * jnp.maximum(closing, 0.0) / momentum_transfer_s  # one of two points
        push = jnp.where(jnp.isfinite(other.mass)[:, None], jnp.minimum(push, most), push)
    drag = jnp.clip(scale * (0.5 * damping * sliding), -friction * push, friction * push)
    force = push[..., None] * normal[:, None] - drag[..., None] * tangent[:, None]
    return force.sum(1), -cross(arm_one, force).sum(1), cross(arm_other, force).sum(1)


def _sound(boxes: Boxes) -> Bool[Array, "*n"]:
    """Boxes that are there, have a size, and whose state is finite."""
    state = boxes.position, boxes.velocity, boxes.size, boxes.elevation, boxes.yaw, boxes.yaw_rate
    return boxes.present & is_finite(state) & (boxes.size > 0).all(-1)


def _still(boxes: Boxes, mass: float) -> Boxes:
    """Those that touch nobody as boxes at rest at the origin, so that their numbers spoil nothing."""
    sound = _sound(boxes)
    clean = lambda x: jnp.where(sound.reshape((-1,) + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))  # noqa: E731
    return replace(jax.tree.map(clean, boxes), mass=jnp.where(sound, boxes.mass, mass), present=sound)


def _rows_of(count: int) -> Int[np.ndarray, "A partners"]:
    """For each car the rows of its pairs, in the table of all pairs' first bodies followed by all pairs' second bodies."""
    first, second = np.triu_indices(count, 1)
    bodies = np.concatenate([first, second])
    return np.stack([np.flatnonzero(bodies == car) for car in range(count)])


def find_box_contact(
    centre: Float[Array, "2"],
    yaw: Float[Array, ""],
    half: Float[Array, "2"],
    other_centre: Float[Array, "2"],
    other_yaw: Float[Array, ""],
    other_half: Float[Array, "2"],
) -> BoxContact:
    """Contact of two oriented boxes with half sizes `half`; depths are not positive where they do not overlap."""
    gap = other_centre - centre
    axes, other_axes = _axes(yaw), _axes(other_yaw)
    every = jnp.concatenate([axes, other_axes])  # 4 candidates for a separating axis
    reach = jnp.abs(every @ axes.T) @ half + jnp.abs(every @ other_axes.T) @ other_half
    along = every @ gap
    overlap = reach - jnp.abs(along)
    best = jnp.argmin(overlap)
    normal = every[best] * jnp.where(along[best] < 0.0, -1.0, 1.0)

    # the box that owns the axis lends the flat face ("reference"), the other one touches it with its nearest face ("incident")
    owner = best < 2
    pick = functools.partial(jnp.where, owner)
    outward = pick(normal, -normal)
    reference_half = pick(half, other_half)
    front, side = reference_half[best % 2], reference_half[1 - best % 2]
    incident_axes, incident_half = pick(other_axes, axes), pick(other_half, half)
    facing = incident_axes @ outward
    face = jnp.argmax(jnp.abs(facing))
    towards = -jnp.where(facing[face] < 0.0, -1.0, 1.0) * incident_axes[face]
    middle = pick(gap, -gap) + towards * incident_half[face]  # of the incident face, from the reference box's centre
    along_face = incident_axes[1 - face] * incident_half[1 - face]

    # cut the incident face at the reference face's sides, |w| <= side; it lies within 45 degrees across `outward`, so w_along is not 0
    tangent = _turn(outward)
    w_middle, w_along = middle @ tangent, along_face @ tangent
    w_along = jnp.where(jnp.abs(w_along) < 1e-6, 1e-6, w_along)
    low, high = (-side - w_middle) / w_along, (side - w_middle) / w_along
    ends = jnp.clip(jnp.stack([low, high]), -1.0, 1.0)
    points = middle + ends[:, None] * along_face
    depths = front - points @ outward
    points = points + 0.5 * depths[:, None] * outward + pick(centre, other_centre)
    return BoxContact(normal=normal, points=points, depths=jnp.where(overlap[best] > 0.0, depths, jnp.minimum(depths, 0.0)))


def _axes(yaw: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Unit vectors along a box's length and width."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])


def _turn(v: Float[Array, "*shape 2"]) -> Float[Array, "*shape 2"]:
    """A quarter turn counter-clockwise."""
    return jnp.stack([-v[..., 1], v[..., 0]], axis=-1)


def _velocity_at(arm: Float[Array, "N 2 2"], velocity: Float[Array, "N 2"], yaw_rate: Float[Array, " N"]) -> Float[Array, "N 2 2"]:
    """Velocity of the points `arm` away from a centre that moves and turns."""
    return velocity[:, None] + yaw_rate[:, None, None] * _turn(arm)
