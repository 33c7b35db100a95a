"""Forces between cars that touch: upright boxes seen from above, pushed apart by spring-dampers with friction.

Every unordered pair is evaluated once and its force enters both cars with opposite sign at the same point, so linear and angular
momentum are kept to rounding. Depth and normal come from the separating-axis theorem; the face of least depth is cut against the
other box's nearest face, which leaves two contact points, each with half the stiffness.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scenefactory_jax.geometry import cross, dot, norm


class Touch(NamedTuple):
    """Where two boxes touch. The normal points from the first to the second; depths are zero or less where a point does not touch."""

    normal: Float[Array, "2"]
    points: Float[Array, "2 2"]
    depths: Float[Array, "2"]


def forces(
    position: Float[Array, "A 3"],
    yaw: Float[Array, " A"],
    velocity: Float[Array, "A 2"],
    yaw_rate: Float[Array, " A"],
    size: Float[Array, "A 2"],
    active: Bool[Array, " A"],
    *,
    stiffness: float,
    damping: float,
    friction: float,
    height: float,
) -> tuple[Float[Array, "A 2"], Float[Array, " A"], Float[Array, " A"]]:
    """Horizontal force and yaw torque on each car's box centre, and the largest force of a single pair, N and N m.

    Args:
        position: centres of the boxes. Cars that differ by more than `height` in elevation do not meet.
        active: cars that can touch. Cars whose state is not finite touch nobody, whatever this says.
        stiffness: of a contact along a whole face, N/m. Two cars of 1.98 t bounce with k dt^2 / m of 0.07 at 1e6 N/m and 120 Hz, and
            0.26 where they meet off centre (reduced masses 0.99 t and 0.26 t); semi-implicit Euler with an explicit damper is stable
            while that plus 2 c dt / m stays below 4: 0.58 and 2.1 with 3e4 N s/m.
        damping: along the same face, N s/m. A contact never pulls.
        friction: Coulomb coefficient of the bodies. Below the cone `damping` resists sliding, which is as stable as the normal force.
        height: of the boxes, m.
    """
    count = position.shape[0]
    if count < 2:
        zero = jnp.zeros((count,), position.dtype)
        return jnp.zeros((count, 2), position.dtype), zero, zero
    finite = jnp.isfinite(jnp.concatenate([position, velocity, yaw[:, None], yaw_rate[:, None]], axis=-1)).all(-1)
    alive = active & finite
    position, yaw, velocity, yaw_rate = (jnp.where(_rows(alive, x), x, 0.0) for x in (position, yaw, velocity, yaw_rate))
    first, second = np.triu_indices(count, 1)

    box = (position[:, :2], yaw, size / 2.0)
    one, other = jax.tree.map(lambda x: x[first], box), jax.tree.map(lambda x: x[second], box)
    normal, points, depths = jax.vmap(touch)(*one, *other)
    meet = alive[first] & alive[second] & (jnp.abs(position[first, 2] - position[second, 2]) < height)
    depths = jnp.where(meet[:, None], depths, 0.0)

    arm_one, arm_other = points - one[0][:, None], points - other[0][:, None]
    speed = _velocity_at(arm_other, velocity[second], yaw_rate[second]) - _velocity_at(arm_one, velocity[first], yaw_rate[first])
    tangent = _turn(normal)
    closing = -dot(speed, normal[:, None])
    sliding = dot(speed, tangent[:, None])
    push = jnp.where(depths > 0.0, jnp.maximum(0.5 * stiffness * depths + 0.5 * damping * closing, 0.0), 0.0)
    drag = jnp.clip(0.5 * damping * sliding, -friction * push, friction * push)
    # on the second car; the first feels the opposite
    force = push[..., None] * normal[:, None] - drag[..., None] * tangent[:, None]

    total = force.sum(1)
    torque_one, torque_other = -cross(arm_one, force).sum(1), cross(arm_other, force).sum(1)
    sum_force = jnp.zeros((count, 2), position.dtype).at[first].add(-total).at[second].add(total)
    sum_torque = jnp.zeros((count,), position.dtype).at[first].add(torque_one).at[second].add(torque_other)
    strength = norm(total)
    largest = jnp.zeros((count,), position.dtype).at[first].max(strength).at[second].max(strength)
    return sum_force, sum_torque, largest


def _rows(mask: Bool[Array, " A"], like: Array) -> Array:
    return mask.reshape((-1,) + (1,) * (like.ndim - 1))


def touch(
    centre: Float[Array, "2"],
    yaw: Float[Array, ""],
    half: Float[Array, "2"],
    other_centre: Float[Array, "2"],
    other_yaw: Float[Array, ""],
    other_half: Float[Array, "2"],
) -> Touch:
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
    return Touch(normal=normal, points=points, depths=jnp.where(overlap[best] > 0.0, depths, jnp.minimum(depths, 0.0)))


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
