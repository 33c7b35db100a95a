"""Contact forces between cars, and of other objects on cars: boxes seen from above that crush and rub.

Every unordered pair of cars is evaluated once, and its force acts on both with opposite sign at the same point: linear and angular
momentum are conserved to rounding.

**Normal.** The separating-axis theorem has four candidate axes for two boxes. While boxes are apart, their velocities say on which axis
they touch last; once they overlap, this axis stays theirs until they are apart. So it depends neither on the phase of the time step nor
on how deep a fast box is when it is first seen. The face of the axis is clipped against the other box's nearest face, which leaves two
contact points, each with half the stiffness. A contact that begins within a step acts for the rest of the step.

**Force.** F = stiffness depth (1 + dissipation closing speed), never negative: K. H. Hunt and F. R. E. Crossley, Coefficient of restitution
interpreted as damping in vibroimpact, Journal of Applied Mechanics 42 (1975). Its restitution falls with the speed v of the impact, from 1
to 1 / (dissipation v). With 1 s/m it is 0.3 at 3 m/s and 0.1 at 10 m/s. Cars: 0.2 to 0.4 in impacts of some m/s, and about 0.1 at medium
and high speed (R. P. Howard, J. Bomar and C. Bare, SAE 931842, 1993; K. L. Monson and G. J. Germane, SAE 1999-01-0097, 1999). The force is
implicit in the closing speed: it is stable at any dissipation, and stops two boxes at any speed.
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
from scenefactory_jax.core.geometry import safe_norm
from scenefactory_jax.core.pytree import is_finite, replace
from scenefactory_jax.core.schema import Bounds, ConfigError, NonNegative, Positive
from scenefactory_jax.core.types import Boxes, Motion
from scenefactory_jax.dynamics.planar import Planar, cross, dot, find_all, find_any, find_largest, pick, rotate_90, select

OFF_CENTRE = 3.7  # effective mass of a contact at the middle of two cars' faces over that at their corners
REPORT_S = 1e-3  # time step of forces that are reported and do not move cars
NO_AXIS = -1  # of boxes that have not been seen yet


class Separation(NamedTuple):
    """Two boxes along their four candidate axes: the first box's two, then the second's."""

    sign: tuple[Array, ...]  # of the second box's side
    gap: tuple[Array, ...]  # m; below zero: overlap
    closing: tuple[Array, ...]  # m/s


class BoxContact(NamedTuple):
    """The two contact points of two boxes. The normal points from the first to the second."""

    normal: Planar
    points: tuple[Planar, Planar]
    depths: tuple[Array, Array]  # m; below zero: apart


class ContactState(NamedTuple):
    """Axis of every pair, times two, plus one for the negative side; `NO_AXIS` for a new pair."""

    cars: Int[Array, "A A"]  # row: the first car of a pair; only pairs with a second of a larger index are used
    traffic: Int[Array, "A M"]


class Neighbours(NamedTuple):
    """Objects that each car can touch in a control step."""

    boxes: Boxes  # [A, K, ...]
    rows: Int[Array, "A K"]  # of the traffic


class Axes(NamedTuple):
    """What `ContactState` has, of the pairs that can touch in a control step."""

    cars: Int[Array, "A A"]
    beside: Int[Array, "A K"]


class Contact(NamedTuple):
    """The contact model. Neighbours are selected once per control step, forces computed once per physics step."""

    init: Callable[[int, int], ContactState]  # (cars, objects of traffic)
    neighbours: Callable[[Boxes, Boxes], Neighbours]  # (cars, traffic)
    forces: Callable[[Axes, Boxes, Neighbours], tuple[Axes, Array, Array, Array]]  # see `compute_forces`


@dataclasses.dataclass(frozen=True)
class ContactLaw:
    """The config `dynamics.contact`."""

    stiffness: Positive  # along a whole face of two cars, N/m
    dissipation: NonNegative  # s/m
    friction: NonNegative  # Coulomb coefficient of the bodies; below the limit, what ends the sliding within eight steps
    mass: Positive  # of the two cars that `stiffness` is meant for, kg
    momentum_transfer_s: Positive  # time in which a box of finite mass may get the car's speed
    max_neighbours: Annotated[int, Bounds(min=0)]  # objects that a car may touch, beside other cars


def make_contact(entry: Mapping[str, Any], *, height: float, step_s: float) -> Contact:
    """Makes the contact model of a config's `dynamics.contact`.

    Args:
        height: of the boxes, m; two whose elevations differ by more do not touch.
        step_s: time step of the forces, s.

    Raises:
        ConfigError: a number out of range, or a contact too stiff for `step_s`, by name.
    """
    law = schema.read(entry, ContactLaw, where="dynamics.contact")
    load = OFF_CENTRE * law.stiffness * step_s**2 / (law.mass / 2)
    if load >= 4.0:  # see `compute_forces`
        raise ConfigError(
            f"dynamics.contact.stiffness: {law.stiffness:g} cannot be integrated: {OFF_CENTRE} k dt^2 / m, m half the mass: expected below "
            f"4, got {load:.2f} at a time step of {step_s:.5f} s"
        )
    neighbours = functools.partial(find_neighbours, max_neighbours=law.max_neighbours)
    return Contact(init, neighbours, functools.partial(compute_forces, law=law, height=height, step_s=step_s))


def init(cars: int, objects: int) -> ContactState:
    """Pairs that have not been seen yet."""
    return ContactState(jnp.full((cars, cars), NO_AXIS, jnp.int32), jnp.full((cars, objects), NO_AXIS, jnp.int32))


def read_axes(state: ContactState, neighbours: Neighbours) -> Axes:
    """Reads the axes of the pairs that can touch in a control step."""
    return Axes(state.cars, state.traffic[jnp.arange(len(neighbours.rows))[:, None], neighbours.rows])


def keep_axes(axes: Axes, neighbours: Neighbours, state: ContactState) -> ContactState:
    """Keeps the axes after a control step; objects that were not among the neighbours are new when they are again."""
    places = jnp.arange(len(neighbours.rows))[:, None], neighbours.rows
    return ContactState(axes.cars, jnp.full_like(state.traffic, NO_AXIS).at[places].set(axes.beside))


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


def find_neighbours(cars: Boxes, traffic: Boxes, *, max_neighbours: int) -> Neighbours:
    """Finds the boxes of `traffic` nearest to each car, by the distance to their bounding circles."""
    gap = safe_norm(traffic.position[None] - cars.position[:, None]) - 0.5 * safe_norm(traffic.size)
    gap = jnp.where(_is_valid(traffic) & jnp.isfinite(gap), gap, jnp.inf)
    _, rows = jax.lax.top_k(-gap, min(max_neighbours, gap.shape[1]))
    return Neighbours(jax.tree.map(lambda leaf: leaf[rows], traffic), rows)


def advance_boxes(boxes: Boxes, seconds: float | Float[Array, ""]) -> Boxes:
    """Moves neighbours `[A, K, ...]` with constant velocities."""
    move = lambda box: replace(box, position=box.position + box.velocity * seconds, yaw=box.yaw + box.yaw_rate * seconds)  # noqa: E731
    return jax.vmap(move)(boxes)


def report_forces(contact: Contact, cars: Boxes, traffic: Boxes, seconds: float) -> Float[Array, " A"]:
    """Computes the largest contact force of each car now, N, for cars that contacts do not move; `traffic` is as it was `seconds` ago."""
    beside = contact.neighbours(cars, traffic)
    beside = beside._replace(boxes=advance_boxes(beside.boxes, seconds))
    return contact.forces(read_axes(contact.init(cars.mass.shape[0], traffic.mass.shape[0]), beside), cars, beside)[3]


def compute_forces(
    axes: Axes, cars: Boxes, neighbours: Neighbours, *, law: ContactLaw, height: float, step_s: float
) -> tuple[Axes, Float[Array, "A 2"], Float[Array, " A"], Float[Array, " A"]]:
    """Computes the horizontal force and yaw torque on each car's box centre, and the largest force of a single pair, N and N m.

    The stiffness of a pair scales with its reduced mass over that of two cars: 1 between cars, 2 against a wall, little against a
    pedestrian. So k dt^2 / m is the same for every pair: 0.008 at 1.2e5 N/m and 120 Hz (m the reduced mass), and 0.03 off centre
    (`OFF_CENTRE`). Semi-implicit Euler is stable while that is below 4.

    Args:
        cars: boxes that are not present, have no size or no finite state take no part. Two whose elevations differ by more than `height` do
            not touch.
        neighbours: they follow their path and feel no force. If their mass is finite, the force is limited to what gives them the car's
            speed within `momentum_transfer_s`, and ends after that time.
    """
    count, objects = neighbours.rows.shape
    beside = count * objects  # pairs of a car and a neighbour, before those of two cars: one call for both, of half the kernels
    rows_first, rows_second, rows = _find_pairs(count, objects)
    if not rows.size:
        zero = jnp.zeros(count)
        return axes, jnp.zeros((count, 2)), zero, zero
    flat = jax.tree.map(lambda leaf: leaf.reshape(beside, *leaf.shape[2:]), neighbours.boxes)
    bodies = _sanitize(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), cars, flat), law.mass)
    first, second = (jax.tree.map(lambda leaf: leaf[chosen], bodies) for chosen in (rows_first, rows_second))  # noqa: B023
    pairs = rows_first[beside:], rows_second[beside:]
    previous = jnp.concatenate([axes.beside.ravel(), axes.cars[pairs]])
    touch = jax.vmap(functools.partial(_compute_pair_force, law=law, height=height, step_s=step_s))
    axis, force, torque_first, torque_second = touch(previous, first, second, jnp.arange(len(rows_first)) < beside)

    join = lambda of_first, of_second: jnp.concatenate([of_first, of_second[beside:]])[rows]  # noqa: E731  # [A, pairs of a car]
    touching = safe_norm(force) > 0.0
    contacts = jnp.pad(join(touching, touching).sum(1, dtype=jnp.float32), (0, beside))
    scale = _scale_of_many(jnp.maximum(contacts[rows_first], contacts[rows_second]))
    force, largest = scale[:, None] * force, safe_norm(scale[:, None] * force)
    torque = join(scale * torque_first, scale * torque_second).sum(1)
    found = Axes(axes.cars.at[pairs].set(axis[beside:]), axis[:beside].reshape(count, objects))
    return found, join(-force, force).sum(1), torque, join(largest, largest).max(1)


def _scale_of_many(contacts: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the scale of a pair's force where one of the two has this many contacts.

    N springs and dampers on one car add up to N times what the explicit integrator must carry: 16 cars at one position became NaN within a
    second. Two are stable at full strength; more are scaled to the strength of two. Both cars have the same scale: momentum is kept.
    """
    return jnp.minimum(1.0, 2.0 / jnp.maximum(contacts, 1.0))


def _compute_pair_force(
    axis: Int[Array, ""], first: Boxes, second: Boxes, limited: Bool[Array, ""], *, law: ContactLaw, height: float, step_s: float
) -> tuple[Int[Array, ""], Float[Array, "2"], Float[Array, ""], Float[Array, ""]]:
    """Computes the axis of a pair, the force on its second box (the first has the opposite), and the torques on both."""
    separation = compute_separation(first, second)
    axis = select_axis(separation, axis)
    begin, touches = find_begin(separation, axis, step_s=step_s)
    contact = find_contact_points(axis, first, second, begin)
    near = touches & first.present & second.present & (jnp.abs(first.elevation - second.elevation) < height)
    normal, left = contact.normal, step_s - begin  # of the step
    arms = [tuple(point - _place(box, begin) for box in (first, second)) for point in contact.points]
    speeds = [_velocity_at(to_second, second) - _velocity_at(to_first, first) for to_first, to_second in arms]
    closing, sliding = [-dot(speed, normal) for speed in speeds], [dot(speed, rotate_90(normal)) for speed in speeds]

    acts = jnp.where(near, left / step_s, 0.0)
    scale = 2.0 / (law.mass / first.mass + law.mass / second.mass)
    springs = [
        0.5 * law.stiffness * scale * _average_depth(depth, along, left) * acts
        for depth, along in zip(contact.depths, closing, strict=True)
    ]
    damping, reduced, forces = step_s * law.dissipation * (springs[0] + springs[1]), 0.5 * law.mass * scale, []
    for spring, depth, along, across, (to_first, to_second) in zip(springs, contact.depths, closing, sliding, arms, strict=True):
        levers = 1.0 / first.mass + 1.0 / second.mass + _lever(to_first, normal, first) + _lever(to_second, normal, second)
        push = spring * jnp.maximum(1.0 + law.dissipation * along, 0.0) / (1.0 + damping * levers)
        # limited per contact point; at a constant closing speed, the depth that it reaches in that time says when it is over
        approach = jnp.maximum(along, 0.0)
        limit = jnp.where(depth < approach * law.momentum_transfer_s, 0.5 * reduced * approach / law.momentum_transfer_s, 0.0)
        push = jnp.where(limited & jnp.isfinite(second.mass), jnp.minimum(push, limit), push)
        drag = jnp.clip(0.125 * reduced / step_s * across, -law.friction * push, law.friction * push)
        forces.append(normal * push - rotate_90(normal) * drag)
    torque_first = -(cross(arms[0][0], forces[0]) + cross(arms[1][0], forces[1]))
    torque_second = cross(arms[0][1], forces[0]) + cross(arms[1][1], forces[1])
    return axis, (forces[0] + forces[1]).stack(), torque_first, torque_second


def _average_depth(depth: Array, closing: Array, seconds: Array) -> Array:
    """Computes the mean of max(0, depth) over a time with a constant closing speed, m."""
    after = depth + closing * seconds
    low, high = jnp.minimum(depth, after), jnp.maximum(depth, after)
    partly = 0.5 * jnp.maximum(high, 0.0) ** 2 / jnp.maximum(high - low, 1e-9)
    return jnp.where(low >= 0.0, 0.5 * (low + high), partly)


def _lever(arm: Planar, normal: Planar, box: Boxes) -> Array:
    """Computes what rotation adds to the inverse mass of a contact point, 1/kg; a box has the inertia of a homogeneous one."""
    inertia = box.mass * (box.size[0] ** 2 + box.size[1] ** 2) / 12.0
    return cross(arm, normal) ** 2 / inertia


def _is_valid(boxes: Boxes) -> Bool[Array, "*n"]:
    """Selects boxes that are present and have a positive size and a finite state."""
    state = boxes.position, boxes.velocity, boxes.size, boxes.elevation, boxes.yaw, boxes.yaw_rate
    return boxes.present & is_finite(state) & (boxes.size > 0).all(-1)


def _sanitize(boxes: Boxes, mass: float) -> Boxes:
    """Replaces boxes that take no part by absent ones of 1 m at rest at the origin, so that no NaN propagates: theirs or that of 0 / 0."""
    valid = _is_valid(boxes)
    clean = jax.tree.map(lambda x: jnp.where(valid.reshape((-1,) + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x)), boxes)
    size = jnp.where(valid[:, None], boxes.size, 1.0)
    return replace(clean, size=size, mass=jnp.where(valid, boxes.mass, mass), present=valid)


def _find_pairs(count: int, objects: int) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"], Int[np.ndarray, "A partners"]]:
    """Finds the bodies of all pairs: of each car and its neighbours, which follow the cars, then of two cars.

    Returns:
        First and second bodies; and for each car the rows of its pairs in the table of all first bodies followed by the second ones of the
        pairs of cars.
    """
    cars_first, cars_second = np.triu_indices(count, 1)
    first = np.concatenate([np.repeat(np.arange(count), objects), cars_first])
    second = np.concatenate([count + np.arange(count * objects), cars_second])
    bodies = np.concatenate([first, cars_second])
    return first, second, np.stack([np.flatnonzero(bodies == car) for car in range(count)])


def compute_separation(first: Boxes, second: Boxes) -> Separation:
    """Computes gaps and closing speeds of two boxes along their candidate axes."""
    offset, speed = (Planar.read(b) - Planar.read(a) for a, b in ((first.position, second.position), (first.velocity, second.velocity)))
    sides = [(_axes(box.yaw), box.size / 2.0) for box in (first, second)]
    found = []
    for axis in (axis for axes, _ in sides for axis in axes):
        reach = [jnp.abs(dot(axis, axes[0])) * half[0] + jnp.abs(dot(axis, axes[1])) * half[1] for axes, half in sides]
        along = dot(axis, offset)
        sign = jnp.where(along < 0.0, -1.0, 1.0)
        found.append((sign, jnp.abs(along) - (reach[0] + reach[1]), -sign * dot(axis, speed)))
    return Separation(*zip(*found, strict=True))


def select_axis(separation: Separation, previous: Int[Array, ""]) -> Int[Array, ""]:
    """Selects the axis on which two boxes touch last, or touched: see the module."""
    apart = [gap > 0.0 for gap in separation.gap]
    any_apart = find_any(apart)
    seconds = [
        jnp.where(gap > 0.0, jnp.where(closing > 0.0, gap / jnp.where(closing > 0.0, closing, 1.0), 1e6), -1.0)
        for gap, closing in zip(separation.gap, separation.closing, strict=True)
    ]
    best = jnp.where(any_apart, find_largest(seconds), find_largest(separation.gap))
    found = 2 * best + (pick(best, separation.sign) < 0.0)
    return jnp.where(any_apart | (previous == NO_AXIS), found, previous)


def find_begin(separation: Separation, axis: Int[Array, ""], *, step_s: float) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Computes when in this step the contact of two boxes begins, s, and whether they touch in it at all."""
    gap, closing = pick(axis // 2, separation.gap), pick(axis // 2, separation.closing)
    begin = jnp.where(gap > 0.0, jnp.where(closing > 0.0, gap / jnp.where(closing > 0.0, closing, 1.0), step_s), 0.0)
    begin = jnp.clip(begin, 0.0, step_s)
    sides = enumerate(zip(separation.gap, separation.closing, strict=True))
    beside = [(gap - closing * begin < 0.0) | (axis // 2 == row) for row, (gap, closing) in sides]
    return begin, (begin < step_s) & find_all(beside)


def find_contact_points(axis: Int[Array, ""], first: Boxes, second: Boxes, begin: Float[Array, ""]) -> BoxContact:
    """Computes the contact points of two boxes at `begin`, s; their reference face has the axis `axis` (see `ContactState`)."""
    best, sign = axis // 2, 1.0 - 2.0 * (axis % 2)
    axes, other_axes = _axes(first.yaw), _axes(second.yaw)
    place, other_place = _place(first, begin), _place(second, begin)
    gap, half, other_half = other_place - place, Planar.read(first.size / 2.0), Planar.read(second.size / 2.0)
    normal = pick(best, (*axes, *other_axes)) * sign

    # the box of the axis has the reference face, the other box touches it with its nearest ("incident") face
    choose = functools.partial(select, best < 2)
    outward = choose(normal, -normal)
    reference = choose(half, other_half)
    front, side = select(best % 2 == 0, (reference.x, reference.y), (reference.y, reference.x))
    incident_axes, incident = choose(other_axes, axes), choose(other_half, half)
    facing = [dot(axis, outward) for axis in incident_axes]
    is_side = jnp.abs(facing[1]) > jnp.abs(facing[0])
    (face, face_half), (along, along_half) = select(
        is_side,
        ((incident_axes[1], incident.y), (incident_axes[0], incident.x)),
        ((incident_axes[0], incident.x), (incident_axes[1], incident.y)),
    )
    towards = face * -jnp.where(jnp.where(is_side, facing[1], facing[0]) < 0.0, -1.0, 1.0)
    middle = choose(gap, -gap) + towards * face_half  # of the incident face, from the reference box's centre
    along_face = along * along_half

    # clip the incident face at the reference face's sides, |w| <= side; it lies within 45 degrees across `outward`, so w_along is not 0
    tangent = rotate_90(outward)
    w_middle, w_along = dot(middle, tangent), dot(along_face, tangent)
    w_along = jnp.where(jnp.abs(w_along) < 1e-6, 1e-6, w_along)
    ends = [jnp.clip((edge - w_middle) / w_along, -1.0, 1.0) for edge in (-side, side)]
    points = [middle + along_face * end for end in ends]
    depths = tuple(front - dot(point, outward) for point in points)
    reference_place = choose(place, other_place)
    points = tuple(point + outward * (0.5 * depth) + reference_place for point, depth in zip(points, depths, strict=True))
    return BoxContact(normal=normal, points=points, depths=depths)


def find_box_contact(first: Boxes, second: Boxes) -> BoxContact:
    """Computes the contact points of two boxes at this moment; depths are not positive if they do not overlap."""
    separation = compute_separation(first, second)
    contact = find_contact_points(select_axis(separation, jnp.int32(NO_AXIS)), first, second, jnp.float32(0.0))
    overlap = find_all([gap < 0.0 for gap in separation.gap])
    return contact._replace(depths=tuple(jnp.where(overlap, depth, jnp.minimum(depth, 0.0)) for depth in contact.depths))


def _axes(yaw: Float[Array, ""]) -> tuple[Planar, Planar]:
    """Computes unit vectors along a box's length and width."""
    along = Planar(jnp.cos(yaw), jnp.sin(yaw))
    return along, rotate_90(along)


def _place(box: Boxes, seconds: Float[Array, ""]) -> Planar:
    """Computes where a box's centre is after that time."""
    return Planar.read(box.position) + Planar.read(box.velocity) * seconds


def _velocity_at(arm: Planar, box: Boxes) -> Planar:
    """Computes the velocity of the point at `arm` from the centre of a box."""
    return Planar.read(box.velocity) + rotate_90(arm) * box.yaw_rate
